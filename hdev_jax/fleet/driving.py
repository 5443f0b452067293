"""How a synthetic truck was driven: road, weather and kinematics by trip, before any energy is known. Plain NumPy.

Shares no code with `hdev_jax.physics`. The route is drawn as a function of distance (smooth hills, a winding road,
speed limits, stops), the driver follows it within brake, comfort and power bounds, and the result is cut into rows:
road segments of 60-140 m with standstill rows at the stops (`segments`), or samples at a fixed rate (`samples`).
"""

from collections.abc import Callable, Collection
from dataclasses import dataclass

import numpy as np

__all__ = [
    "FINAL_DRIVE",
    "GEAR_RATIOS",
    "WHEEL_RADIUS_M",
    "Drive",
    "drive_trips",
    "hold",
    "smooth_noise",
    "standard_density_kgpm3",
]

Columns = dict[str, np.ndarray]

GEAR_RATIOS = (9.16, 5.27, 3.33, 2.16)  # the example sheet of contract.md, section 2
FINAL_DRIVE = 4.5  # keeps the shaft under 470 rad/s at 90 km/h
WHEEL_RADIUS_M = 0.50  # 315/70 R22.5, loaded
_HOLDS = ("ambient_temp_c", "air_density_kgpm3", "wind_speed_mps", "wet_road", "humidity_pct")
_NODES = 10  # simulation steps in a road segment, about 10 m each
_LIMITS_KMH = {"city": (30, 50, 50, 60), "regional": (50, 70, 80, 80), "motorway": (70, 80, 90, 90)}
_POWER_W = 380e3  # traction power of the drive, bounds the driver's acceleration
_BRAKE_W = 280e3  # what the driver lets the machine take back, uphill or down; the truth has no friction brake
_STANDING_MPS = 0.1  # below, a vehicle stands
_G = 9.81  # only for what the driver can climb and hold


@dataclass(frozen=True)
class Drive:
    """Rows of all trips in time order. `columns` has contract names in SI plus `trip` (0-based id); `grade_at(lag_s)`
    is the slope [rad] of every row as met `lag_s` seconds later: what a channel that lags by `lag_s` should have said.
    """

    columns: Columns
    grade_at: Callable[[float], np.ndarray]
    mode: str
    sample_s: float


def smooth_noise(rng: np.random.Generator, n: int, correlation: float) -> np.ndarray:
    """Unit-variance Gaussian noise of `n` points, once differentiable (a critically damped Ornstein-Uhlenbeck process:
    white noise through x·exp(−x)); `correlation` is its time constant in points."""
    x = np.arange(int(8 * correlation) + 2) / correlation
    kernel = x * np.exp(-x)
    kernel /= np.sqrt(np.sum(kernel**2))
    white = rng.standard_normal(n + len(kernel) - 1)
    size = 1 << int(np.ceil(np.log2(len(white) + len(kernel))))
    return np.fft.irfft(np.fft.rfft(white, size) * np.fft.rfft(kernel, size), size)[len(kernel) - 1 : len(white)]


@dataclass(frozen=True)
class _Road:
    """One trip's road on a 10 m grid."""

    s_m: np.ndarray
    grade: np.ndarray
    curvature: np.ndarray
    heading: np.ndarray
    turn: np.ndarray  # heading without the U-turn of an out-and-back road
    limit_mps: np.ndarray

    def at(self, name: str, s_m: np.ndarray) -> np.ndarray:
        return np.interp(s_m, self.s_m, getattr(self, name))


def _road(rng: np.random.Generator, length_m: float, shape: str, kind: str) -> _Road:
    """Hills of a few per cent over 250 m - 1 km, bends, limits. `shape`: open (a net climb), round (returns to its
    height and its heading) or back (out and back on the same road)."""
    n = int(np.ceil(length_m / 10.0)) + 1
    half = (n + 1) // 2
    hilly = rng.uniform(0.008, 0.020)
    bends = {"city": 1 / 300, "regional": 1 / 450, "motorway": 1 / 1500}[kind] * rng.uniform(0.7, 1.3)
    m = half if shape == "back" else n
    grade = np.clip(hilly * smooth_noise(rng, m, rng.uniform(15, 40)), -0.045, 0.045)
    curvature = bends * smooth_noise(rng, m, 8.0) * np.clip(smooth_noise(rng, m, 30.0), 0.1, None)
    grade -= grade.mean()
    curvature -= curvature.mean()
    heading0 = rng.uniform(0, 2 * np.pi)
    net_climb, spin = rng.uniform(-0.006, 0.006), rng.choice([-1.0, 1.0])
    if shape == "open":
        grade, curvature = grade + net_climb, curvature + rng.normal(0, 1.0) / length_m
    elif shape == "round":
        curvature = curvature + spin * 2 * np.pi / length_m
    heading = heading0 + np.cumsum(curvature) * 10.0
    if shape == "back":
        grade = np.r_[grade, -grade[::-1]][:n]
        heading = np.r_[heading, heading[::-1] + np.pi][:n]
        curvature = np.r_[curvature, -curvature[::-1]][:n]
    longest = {"city": 1800, "regional": 4000, "motorway": 7000}[kind]
    edges = np.cumsum(rng.uniform(600, longest, int(length_m / 600) + 2))
    speeds = rng.choice(np.array(_LIMITS_KMH[kind]), len(edges) + 1) / 3.6
    s = np.arange(n) * 10.0
    limit = speeds[np.searchsorted(edges, s)]
    limit = limit * (0.97 - 0.025 * np.abs(smooth_noise(rng, n, 25.0)))  # a driver is not a cruise control
    limit = np.minimum(limit, np.sqrt(rng.uniform(1.2, 2.0) / np.maximum(np.abs(curvature), 1e-6)))  # lateral comfort
    return _Road(s, grade, curvature, heading, np.cumsum(curvature) * 10.0, limit)


def _follow(s: np.ndarray, limit: np.ndarray, grade: np.ndarray, mass: np.ndarray, comfort, brake) -> np.ndarray:
    """Speeds [m/s] at the nodes, shape (trip, node), of a driver who keeps to `limit`, brakes in time (v² envelope,
    closed form) and accelerates within comfort and power (a recurrence over nodes)."""
    top = limit**2 + 2 * brake[:, None] * s
    top = np.minimum.accumulate(top[:, ::-1], axis=1)[:, ::-1] - 2 * brake[:, None] * s
    v2 = np.zeros_like(top)
    v2[:, 0] = top[:, 0]
    for i in range(s.shape[1] - 1):
        v = np.sqrt(np.maximum(v2[:, i], 1.0))
        spare = _POWER_W / (mass[:, i] * v) - _G * (grade[:, i] + 0.006) - 3.4 * v**2 / mass[:, i]
        a = np.minimum(comfort, spare)
        faster = v2[:, i] + 2 * a * (s[:, i + 1] - s[:, i])
        v2[:, i + 1] = np.minimum(top[:, i + 1], np.maximum(faster, 9.0))  # never crawls below 3 m/s on a hill
    return np.sqrt(np.maximum(v2, 0.0))


def _weather(rng: np.random.Generator, t: np.ndarray, altitude: np.ndarray) -> Columns:
    """Channels of air and rain at times `t` [s] of one trip, from the trip's own day."""
    n = int(t[-1] / 10.0) + 2
    grid = np.arange(n) * 10.0

    def slow(seconds: float) -> np.ndarray:
        return np.interp(t, grid, smooth_noise(rng, n, seconds / 10.0))

    base, hour, swing = rng.uniform(-5, 30), rng.uniform(5, 18), rng.uniform(2, 6)
    hours = hour + t / 3600
    temp = base + swing * (np.sin((hours - 9) * np.pi / 12) - np.sin((hour - 9) * np.pi / 12))
    temp = temp - 6.5e-3 * (altitude - altitude[0]) + 0.3 * slow(300.0)  # ISO 2533 lapse rate
    pressure = rng.normal(1.0, 0.008)  # of the day, over the standard one
    mean_wind, gusty = rng.uniform(1.0, 8.0), rng.uniform(0.15, 0.3)
    wind = np.abs(mean_wind * (1 + gusty * slow(60.0)))
    from_rad = rng.uniform(0, 2 * np.pi) + 0.25 * slow(400.0)
    rainy = rng.random() < 0.45
    rain = 1 / (1 + np.exp(-4 * (slow(400.0) - 0.2)))
    return {
        "ambient_temp_c": temp,
        "air_density_kgpm3": pressure * standard_density_kgpm3(altitude, temp),
        "wind_speed_mps": wind,
        "wind_from_rad": np.mod(from_rad, 2 * np.pi),
        "wet_road": rain if rainy else np.zeros_like(t),
        "humidity_pct": np.clip(rng.normal(68, 8) + 9 * slow(350.0), 15, 100),
        "cloud_cover": np.clip(0.5 + 0.35 * slow(900.0), 0, 1),
        "gps_hdop": 0.9 + 0.25 * slow(120.0) ** 2,
        "tyre_pressure_kpa_display": np.round(850 + 8 * slow(1500.0) + 0.4 * (temp - base)),
    }


def standard_density_kgpm3(altitude_m: np.ndarray, temperature_c: np.ndarray) -> np.ndarray:
    """Density of the air at the standard pressure of an altitude (ISO 2533)."""
    return 101325.0 * (1 - 2.25577e-5 * altitude_m) ** 5.25588 / (287.05 * (temperature_c + 273.15))


def drive_trips(
    route: np.random.Generator, weather: np.random.Generator, *, rows: np.ndarray, mode: str, sample_s: float
) -> Drive:
    """Trips with `rows[i]` rows each.

    **Arguments:** two independent generators, the number of rows by trip, `mode` ("segments" or "samples") and the
    sampling time [s] of "samples". **Returns:** a `Drive`.
    """
    trips = len(rows)
    stand, moving = [], []
    for n in rows:
        if mode == "segments":
            standing = max(2, round(route.uniform(0.05, 0.12) * n))
            moving.append(int(n) - standing)
        else:
            standing = max(2, round(n * sample_s / 300 * route.uniform(0.6, 2.0)))
            moving.append(int(n * sample_s * 25.0 / 100.0) + 15)  # longer than can be driven; cut below
        stops = max(1, min(round(standing / 1.7), moving[-1] // 3))
        stand.append(np.bincount(route.integers(0, stops, max(standing - stops, 0)), minlength=stops) + 1)
    nodes = max(moving) * _NODES + 1
    s, limit, grade, mass = (np.zeros((trips, nodes)) for _ in range(4))
    roads, stops_at = [], []
    for i, n in enumerate(moving):
        step = np.repeat(route.uniform(6, 14, n), _NODES)
        s[i] = np.pad(np.r_[0.0, np.cumsum(step)], (0, nodes - len(step) - 1), mode="reflect", reflect_type="odd")
        kind = ("regional", "motorway", "city")[int(route.choice(3, p=[0.5, 0.3, 0.2]))]
        road = _road(route, s[i, n * _NODES], ("open", "round", "back")[i % 3], kind)
        at = np.r_[0, np.sort(route.choice(np.arange(2, n - 1), len(stand[i]) - 1, replace=False))] * _NODES
        limit[i], grade[i] = road.at("limit_mps", s[i]), road.at("grade", s[i])
        mass[i] = route.uniform(18e3, 40e3)
        if route.random() < 0.25 and len(at) > 2:  # unloads at one stop
            mass[i, at[len(at) // 2] :] = max(16e3, mass[i, 0] - route.uniform(4e3, 14e3))
        limit[i] = np.minimum(limit[i], _BRAKE_W / (mass[i] * _G * np.maximum(-grade[i] - 0.008, 1e-3)))
        limit[i, at] = limit[i, n * _NODES] = 0.0
        roads.append(road)
        stops_at.append(at)
    brake = route.uniform(0.4, 0.7, trips) * (20e3 / mass[:, 0]) ** 0.8
    speed = _follow(s, limit, grade, mass, route.uniform(0.35, 0.8, trips), brake)

    parts: list[Columns] = []
    lags: list[Callable[[float], np.ndarray]] = []
    for i, n in enumerate(moving):
        last = n * _NODES
        dwell = [route.uniform(10, 35, k) for k in stand[i]]
        part, lag = _rows(s[i, : last + 1], speed[i, : last + 1], mass[i], roads[i], stops_at[i], dwell,
                          mode, sample_s, int(rows[i]))  # fmt: skip
        mid = part["time_s"] + (0.5 * part["duration_s"] if mode == "segments" else 0.0)
        lowest = route.uniform(5, 450)
        part["altitude_m"] = lowest + part["altitude_m"] - part["altitude_m"].min()
        part |= _weather(weather, mid, part["altitude_m"])
        part["door_open"] = ((part["distance_m"] == 0) & (route.random(rows[i]) < 0.5)).astype(float)
        part["trip"] = np.full(rows[i], i)
        parts.append(part)
        lags.append(lag)
    columns = {k: np.concatenate([p[k] for p in parts]) for k in parts[0]}
    mean_speed = columns["distance_m"] / columns["duration_s"]
    columns["standstill_flag"] = (mean_speed < _STANDING_MPS).astype(float)
    shift = mean_speed * np.where(columns["grade_rad"] > 0.015, 0.85, 1.0)  # holds the lower gear uphill
    columns["gear"] = 1.0 + np.searchsorted([5.0, 9.0, 14.0], shift)
    return Drive(columns, lambda lag_s: np.concatenate([f(lag_s) for f in lags]), mode, sample_s)


def _rows(s, v, mass, road, stops, dwell, mode, sample_s, count) -> tuple[Columns, Callable[[float], np.ndarray]]:
    """One trip's nodes cut into rows, and its slope as a function of a lag. Acceleration is constant between nodes."""
    dt = np.r_[0.0, 2 * np.diff(s) / np.maximum(v[1:] + v[:-1], 1e-9)]
    is_stop = np.zeros(len(s), int)
    is_stop[stops] = np.arange(1, len(stops) + 1)
    wait = np.r_[0.0, [d.sum() for d in dwell]][is_stop]
    depart = np.cumsum(dt + wait)
    arrive = depart - wait
    # every node twice, as arrived at and as left: a plateau in t where the truck stands
    t2, s2, v2 = np.ravel(np.stack([arrive, depart], 1)), np.repeat(s, 2), np.repeat(v, 2)
    keep = np.r_[True, np.diff(t2) > 0]
    t2, s2, v2 = t2[keep], s2[keep], v2[keep]
    # climb as a function of distance, so that slopes of rows add up to heights exactly
    climb = np.r_[0.0, np.cumsum(np.sin(0.5 * (road.grade[1:] + road.grade[:-1])) * np.diff(road.s_m))]

    if mode == "segments":
        rows = []  # (start time, duration, first node, last node)
        for node in range(0, len(s) - 1, _NODES):
            if is_stop[node]:
                waits = dwell[is_stop[node] - 1]
                begins = arrive[node] + np.cumsum(waits) - waits
                rows += [(begin, w, node, node) for begin, w in zip(begins, waits, strict=True)]
            rows.append((depart[node], arrive[node + _NODES] - depart[node], node, node + _NODES))
        start, duration, first, last = (np.array(x) for x in zip(*rows, strict=True))
        distance, moves = s[last] - s[first], last > first
        mid_s = 0.5 * (s[first] + s[last])

        def grade_at(lag_s: float) -> np.ndarray:
            """Mean slope over the distance of a row, each point read `lag_s` later in time."""
            seen = road.at("grade", np.interp(depart + lag_s, t2, s2)) if lag_s else road.at("grade", s)
            total = np.r_[0.0, np.cumsum(0.5 * (seen[1:] + seen[:-1]) * np.diff(s))]
            return np.where(moves, (total[last] - total[first]) / np.where(moves, distance, 1.0), seen[first])

        turned = (road.at("turn", s[last]) - road.at("turn", s[first])) / np.where(moves, distance, 1.0)
        ends = {"speed_start_mps": v[first], "speed_end_mps": v[last]}
        tread = first
    else:
        start = np.arange(count) * sample_s
        speed = np.interp(start, t2, v2)
        speed = np.where(speed < 1e-6, 0.0, speed)
        # contract: the ends of a sample are the means with its neighbours; at both ends of a trip a parabola leads on
        inner = 0.5 * (speed[:-1] + speed[1:])
        head, tail = (np.polyfit(np.arange(len(x)), x, min(len(x) - 1, 2)) for x in (speed[:5], speed[:-6:-1]))
        ends = {
            "speed_mps": speed,
            "speed_start_mps": np.r_[max(inner[0] - head[-2], 0.0), inner],
            "speed_end_mps": np.r_[inner, max(inner[-1] - tail[-2], 0.0)],
        }
        duration, distance = np.full(count, sample_s), speed * sample_s
        mid_s = np.interp(start, t2, s2)

        def grade_at(lag_s: float) -> np.ndarray:
            return road.at("grade", np.interp(start + lag_s, t2, s2))

        turned = road.at("curvature", mid_s)
        tread = np.clip(np.searchsorted(s, mid_s, side="right") - 1, 0, len(mass) - 1)
    part = {
        "time_s": start,
        "duration_s": duration,
        "distance_m": distance,
        **ends,
        "grade_rad": grade_at(0.0),
        "mass_kg": np.round(mass[tread], -1),
        "heading_rad": np.mod(road.at("heading", mid_s), 2 * np.pi),
        "curvature_1pm": turned,
        "altitude_m": np.interp(mid_s, road.s_m, climb),
    }
    return part, grade_at


def hold(drive: Drive, channels: Collection[str]) -> None:
    """Set these channels of the weather to their mean over each trip, in place.

    **Raises:** `ValueError` for a channel of which a mean would mean nothing.
    """
    if unknown := set(channels) - set(_HOLDS):
        raise ValueError(f"held: unknown {', '.join(sorted(unknown))}; known: {', '.join(_HOLDS)}")
    trip = drive.columns["trip"]
    for name in channels:
        drive.columns[name] = (np.bincount(trip, drive.columns[name]) / np.bincount(trip))[trip]
