"""Routes: where the road goes and climbs, what is allowed, where it stops, the traffic, the load and the weather.

Everything is drawn with NumPy from one generator for a batch of routes of one vehicle. Roads are a chain of stretches
of four kinds (urban, suburban, rural, motorway) in shares that the use of the vehicle sets. Slopes are two smooth
Gaussian processes (hills of about 300 m and of about 2 km) whose size is that of the terrain."""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d

from hdev_jax.fleet.config import FleetConfig
from hdev_jax.fleet.driver import STEP_M
from hdev_jax.fleet.variants import Variant

__all__ = ["KINDS", "SEGMENT_M", "STEPS", "SURFACES", "RouteBatch", "draw_routes"]

SEGMENT_M = 100.0
STEPS = round(SEGMENT_M / STEP_M)
KINDS = ("urban", "suburban", "rural", "motorway")
SURFACES = ("smooth asphalt", "coarse asphalt", "concrete", "setts or gravel")
_NODES = 2  # of the noise in a segment: one every 50 m

_SHARES = {  # of the distance, by use
    "urban": (0.50, 0.32, 0.12, 0.06),
    "regional": (0.10, 0.20, 0.45, 0.25),
    "long_haul": (0.03, 0.07, 0.20, 0.70),
    "construction": (0.18, 0.27, 0.45, 0.10),
    "city_bus": (0.68, 0.28, 0.04, 0.00),
}
_STRETCH_M = np.array([1200.0, 1600.0, 4000.0, 8000.0])
_LIMITS_KMH = ((30.0, 50.0, 50.0), (50.0, 50.0, 60.0), (60.0, 70.0, 80.0), (80.0, 85.0, 89.0))
_BEND = np.array([1.5e-3, 1.0e-3, 1.6e-3, 1.5e-4])  # scale of curvature [1/m]
_TURN = np.array([0.07, 0.04, 0.006, 0.0])  # junctions where it turns, per segment
_LIGHT = np.array([0.10, 0.05, 0.006, 0.0])  # stops, per segment
_ROUNDABOUT = np.array([0.015, 0.03, 0.015, 0.0])
_JAM = np.array([0.55, 0.40, 0.15, 0.18])  # how much the traffic slows
_JAMMED = 0.8  # of the speed that a jam takes at most
_SURFACE = {"construction": (0.35, 0.35, 0.12, 0.18)}
_SURFACE_USUAL = (0.52, 0.32, 0.12, 0.04)
_TERRAIN = ((0.30, 0.45, 0.21, 0.04), (0.005, 0.012, 0.022, 0.033))  # share of the routes; sd of the slope
_STEEPEST = np.array([0.08, 0.08, 0.09, 0.06])
_BUS_STOP = 0.22  # one in 450 m
_LATERAL = 1.4  # m/s², comfortable in bends


@dataclass(frozen=True)
class RouteBatch:
    """Routes of one vehicle, padded to the same number of segments. By route [r], segment [r, n], node or step.

    `length` is the number of segments in use. `halt_s[r, k]` is the time stood before segment k.
    """

    length: np.ndarray
    cap_mps: np.ndarray  # [r, n·STEPS + 1]
    grade_step: np.ndarray  # [r, n·STEPS]
    halt_s: np.ndarray
    mass_kg: np.ndarray
    grade_rad: np.ndarray
    altitude_m: np.ndarray
    curvature_1pm: np.ndarray
    heading_rad: np.ndarray
    road_kind: np.ndarray
    road_surface: np.ndarray
    limit_mps: np.ndarray
    ambient_temp_c: np.ndarray
    wind_speed_mps: np.ndarray
    wind_from_rad: np.ndarray
    wet_road: np.ndarray
    accel_mps2: np.ndarray
    brake_mps2: np.ndarray  # [r, n·STEPS]
    friction: np.ndarray
    drag_factor: np.ndarray


def draw_routes(v: Variant, config: FleetConfig, routes: int, width: int, rng: np.random.Generator) -> RouteBatch:
    """`routes` routes for this vehicle, each padded to `width` segments."""
    mean = config.segments_per_route
    length = rng.integers(round(0.5 * mean), round(1.5 * mean), endpoint=True, size=routes)
    length = np.minimum(length, width)
    kind, limit, surface = _stretches(v, routes, width, rng)
    grade_step, altitude = _hills(kind, config, rng)
    curvature_step = _bends(kind, rng)
    halt, stops = _halts(v, kind, length, config, rng)
    cap = _caps(v, kind, limit, curvature_step, halt, length, config, rng)
    mass = _masses(v, stops, rng)
    heading_nodes = np.concatenate(
        [np.zeros((routes, 1)), np.cumsum(curvature_step * STEP_M, axis=1)], axis=1
    ) + rng.uniform(0, 2 * np.pi, (routes, 1))
    ends = heading_nodes[:, ::STEPS]
    climb = np.diff(altitude[:, ::STEPS], axis=1)
    temp, wind, wind_from, wet = _weather(altitude[:, :-1:STEPS], config, rng)
    heavy = (mass[:, 0] - v.mass_kg[0]) / (v.mass_kg[1] - v.mass_kg[0])
    eager = rng.uniform(0.8, 1.2, routes) * config.driving.comfort
    brake = np.exp(0.3 * _smooth(rng, routes, width * _NODES + 1, 2.0))  # no two halts are alike
    return RouteBatch(
        length=length, cap_mps=cap, grade_step=grade_step, halt_s=halt, mass_kg=mass,
        grade_rad=np.arcsin(np.clip(climb / SEGMENT_M, -0.3, 0.3)),
        altitude_m=0.5 * (altitude[:, :-1:STEPS] + altitude[:, STEPS::STEPS]),
        curvature_1pm=np.diff(ends, axis=1) / SEGMENT_M,
        heading_rad=np.mod(heading_nodes[:, STEPS // 2 :: STEPS][:, :width], 2 * np.pi),
        road_kind=kind, road_surface=surface, limit_mps=limit,
        ambient_temp_c=temp, wind_speed_mps=wind, wind_from_rad=wind_from, wet_road=wet,
        accel_mps2=((1.0 if v.bus else 0.95) - 0.35 * heavy) * eager,
        brake_mps2=_to_steps(brake, STEPS // _NODES) * (((1.0 if v.bus else 0.85) - 0.1 * heavy) * eager)[:, None],
        friction=np.where(wet.max(axis=1) > 0, 0.45, 0.70),
        drag_factor=np.maximum(1 + 0.1 * rng.standard_normal(routes), 0.7),
    )  # fmt: skip


def _smooth(rng: np.random.Generator, routes: int, count: int, nodes: float) -> np.ndarray:
    """Gaussian noise of unit variance with a correlation length of about `nodes`."""
    margin = int(4 * nodes) + 1
    x = gaussian_filter1d(rng.standard_normal((routes, count + 2 * margin)), nodes, axis=1)[:, margin : margin + count]
    return x * np.sqrt(2 * np.sqrt(np.pi) * nodes)


def _to_steps(nodes: np.ndarray, per: int) -> np.ndarray:
    """Linear between nodes: `per` values for each interval, at its steps' middles."""
    t = (np.arange(per) + 0.5) / per
    x = nodes[:, :-1, None] * (1 - t) + nodes[:, 1:, None] * t
    return x.reshape(len(nodes), -1)


def _stretches(v: Variant, routes: int, width: int, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Kind, limit [m/s] and surface by segment."""
    share = np.array(_SHARES[v.usage])
    chance = np.cumsum(share / _STRETCH_M / np.sum(share / _STRETCH_M))
    many = width // 3 + 1  # stretches of at least three segments
    kinds = np.searchsorted(chance, rng.uniform(size=(routes, many)) * chance[-1])
    lengths = 3 + np.floor(rng.exponential(_STRETCH_M[kinds] / SEGMENT_M)).astype(int)
    pick = rng.integers(0, 3, (routes, many))
    limits = np.array(_LIMITS_KMH)[kinds, pick] / 3.6
    surfaces = np.searchsorted(np.cumsum(_SURFACE.get(v.usage, _SURFACE_USUAL))[:-1], rng.uniform(size=(routes, many)))
    surfaces = np.where((kinds == 3) & (surfaces == 3), 0, surfaces)  # no setts on a motorway
    at = np.sum(np.cumsum(lengths, axis=1)[:, None, :] <= np.arange(width)[None, :, None], axis=2)
    at = np.minimum(at, many - 1)
    rows = np.arange(routes)[:, None]
    limit = np.where(surfaces[rows, at] == 3, np.minimum(limits[rows, at], 40 / 3.6), limits[rows, at])
    return kinds[rows, at], limit, surfaces[rows, at]


def _hills(kind: np.ndarray, config: FleetConfig, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Slope by step, and altitude at the steps' ends [m]."""
    routes, width = kind.shape
    count = width * _NODES + 1
    shares, sizes = _TERRAIN
    terrain = np.searchsorted(np.cumsum(shares)[:-1], rng.uniform(size=routes))
    size = np.array(sizes)[terrain][:, None] * config.driving.hills
    shape = 0.6 * _smooth(rng, routes, count, 3.0) + 0.8 * _smooth(rng, routes, count, 14.0)
    # motorways are graded: their slopes are smaller
    soft = np.repeat(np.where(kind == 3, 0.65, 1.0), _NODES, axis=1)
    slope = size * shape * np.concatenate([soft, soft[:, -1:]], axis=1)
    steep = np.repeat(_STEEPEST[kind], _NODES, axis=1)
    steep = np.concatenate([steep, steep[:, -1:]], axis=1)
    slope = steep * np.tanh(slope / steep)
    grade = _to_steps(slope, STEPS // _NODES)
    climb = np.concatenate([np.zeros((routes, 1)), np.cumsum(np.sin(grade) * STEP_M, axis=1)], axis=1)
    return grade, climb + rng.uniform(50.0, 600.0, (routes, 1))


def _bends(kind: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Curvature by step [1/m], junctions where it turns off included."""
    routes, width = kind.shape
    x = _smooth(rng, routes, width * _NODES + 1, 2.0)
    scale = np.repeat(_BEND[kind], STEPS, axis=1)
    curvature = scale * _to_steps(x * np.abs(x), STEPS // _NODES)
    turns = rng.uniform(size=kind.shape) < _TURN[kind]
    side = np.where(rng.uniform(size=kind.shape) < 0.5, 1.0, -1.0)
    by_step = curvature.reshape(routes, width, STEPS)
    by_step[:, :, :4] += np.where(turns, side, 0.0)[:, :, None] * (0.5 * np.pi / (4 * STEP_M))  # 90° in 20 m
    return by_step.reshape(routes, -1)


def _halts(
    v: Variant, kind: np.ndarray, length: np.ndarray, config: FleetConfig, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Time stood before each segment [s], and whether a passenger stop is there."""
    busy = 0.4 + 0.6 * config.driving.traffic
    lights = rng.uniform(size=kind.shape) < _LIGHT[kind] * busy
    wait = np.where(lights, rng.uniform(4.0, 50.0, kind.shape), 0.0)
    served = (rng.uniform(size=kind.shape) < _BUS_STOP) & (kind < 3) & v.bus
    wait += np.where(served, np.exp(rng.normal(np.log(16.0), 0.5, kind.shape)), 0.0)
    inside = (np.arange(kind.shape[1]) > 0) & (np.arange(kind.shape[1]) < length[:, None])
    wait = np.where(inside, np.round(wait, 1), 0.0)
    return wait, served & inside


def _caps(
    v: Variant, kind: np.ndarray, limit: np.ndarray, curvature: np.ndarray, halt: np.ndarray, length: np.ndarray,
    config: FleetConfig, rng: np.random.Generator,
) -> np.ndarray:  # fmt: skip
    """The highest speed at each node that law, bends, traffic, roundabouts and habit allow; 0 at a halt."""
    routes, width = kind.shape
    habit = rng.normal(0.985, 0.03, (routes, 1))
    law = np.minimum(limit, 0.97 * v.top_speed_mps) * habit
    jam = np.maximum(_smooth(rng, routes, width * _NODES + 1, 5.0) + rng.normal(-0.4, 0.6, (routes, 1)), 0.0)
    dense = _to_steps(jam, STEPS // _NODES) * np.repeat(_JAM[kind], STEPS, axis=1) * config.driving.traffic
    slowed = 1 - _JAMMED * np.tanh(dense / _JAMMED)
    wander = 1 + 0.012 * _to_steps(_smooth(rng, routes, width * _NODES + 1, 4.0), STEPS // _NODES)
    cap = np.maximum(np.repeat(law, STEPS, axis=1) * slowed * wander, 2.0)
    cap = np.minimum(cap, np.sqrt(_LATERAL / np.maximum(np.abs(curvature), 1e-6)))
    round_abouts = rng.uniform(size=kind.shape) < _ROUNDABOUT[kind]
    by_step = cap.reshape(routes, width, STEPS)
    by_step[:, :, :8] = np.where(round_abouts[:, :, None], np.minimum(by_step[:, :, :8], 6.5), by_step[:, :, :8])
    # a node is held to both of its steps
    nodes = np.empty((routes, width * STEPS + 1))
    nodes[:, 1:-1] = np.minimum(cap[:, :-1], cap[:, 1:])
    nodes[:, 0], nodes[:, -1] = cap[:, 0], 0.0
    nodes[:, :-1:STEPS] = np.where(halt > 0, 0.0, nodes[:, :-1:STEPS])
    nodes[np.arange(routes), length * STEPS] = 0.0
    return nodes


def _masses(v: Variant, served: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Total mass by segment [kg]: a truck's load for the route, a bus's passengers (68 kg each) from stop to stop."""
    routes, width = served.shape
    empty, full = v.mass_kg
    if not v.bus:
        loaded = rng.beta(2.2, 1.7, (routes, 1))
        share = np.where(rng.uniform(size=(routes, 1)) < 0.2, 0.03 * loaded, loaded)
        return np.repeat(np.round(empty + share * (full - empty), -1), width, axis=1)
    seats = (full - empty) / 68.0
    crowd = np.clip(0.32 + 0.25 * rng.standard_normal((routes, 1)) + 0.15 * _smooth(rng, routes, width, 8.0), 0.0, 1.0)
    # passengers change at stops only
    last = np.maximum.accumulate(np.where(served, np.arange(width), 0), axis=1)
    return np.round(empty + 68.0 * np.round(np.take_along_axis(crowd, last, axis=1) * seats))


def _weather(altitude: np.ndarray, config: FleetConfig, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Temperature [°C], wind speed [m/s] and where it blows from [rad], water on the road (0 to 1), by segment."""
    w = config.weather
    routes, width = altitude.shape
    day = rng.uniform(size=(routes, 1))
    base = w.mean_c - w.season_c * np.cos(2 * np.pi * day) + w.day_sd_c * rng.standard_normal((routes, 1))
    temp = base - 0.0065 * (altitude - altitude[:, :1]) + 0.3 * _smooth(rng, routes, width, 6.0)
    # wind speeds follow Weibull's distribution of shape 2, whose mean is Γ(1.5) of its scale (Troen and Petersen 1989)
    speed = w.wind_mps / 0.8862 * rng.weibull(2.0, (routes, 1))
    wind = np.maximum(speed * (1 + 0.2 * _smooth(rng, routes, width, 3.0)), 0.0)
    wind_from = np.mod(rng.uniform(0, 2 * np.pi, (routes, 1)) + 0.25 * _smooth(rng, routes, width, 4.0), 2 * np.pi)
    rains = rng.uniform(size=(routes, 1)) < w.rain_share
    wet = np.where(rains, np.clip(0.55 + 0.4 * _smooth(rng, routes, width, 15.0), 0.0, 1.0), 0.0)
    return temp, wind, wind_from, wet
