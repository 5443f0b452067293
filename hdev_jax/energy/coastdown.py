"""Road load from a coast-down log: time-based, both directions, slope, wind and weather corrected.

The convention is that of SAE J1263 (road load by coast-down) and J2263 (with wind): the vehicle rolls in neutral, in
both directions, and m·λ·dv/dt = −(A + B·v + C·(v + w)²) − m·g·sin θ. Here the equation is taken integrated over time
from the start of each run, so that noise of the speed is not differentiated:

    m·λ·(v₀ − v(t)) − m·g·h(t) = A·t + B·x(t) + C·∫(v + w)² dt

which is linear in A, B and C, with the speed v₀ of each run free. Wind along the road that is not logged adds ±2Cw·x
and C·w²·t: each run has a term in x of its own, whose mean over both directions is B and whose spread gives the winds,
so that C·w² can be taken off. A slope that is not logged adds ±m·g·sin θ·t, estimated beside them. Where a temperature
is logged, A and B are at 20 °C by the factor 1 + K₀·(T − 20 °C) of UN GTR 15, annex 4, and C at the standard density.

Intervals: the jackknife over runs, whose errors are correlated within a run (gusts, a slope that is not even).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy import stats
from scipy.integrate import cumulative_trapezoid
from scipy.linalg import block_diag

from hdev_jax.energy.fitted import LEVEL
from hdev_jax.energy.road_load import RoadLoad, driven_range, speeds_kmh
from hdev_jax.errors import InputError
from hdev_jax.logs import Log
from hdev_jax.physics.road import density_of_weather
from hdev_jax.segments import Segments, trip_slices
from hdev_jax.units import AIR_DENSITY_KGPM3, GRAVITY_MPS2

__all__ = ["coast_down", "directions_of", "is_coast_down"]

LEAST_MPS = 15.0 / 3.6  # below, the last brakes and gears count: where coast-downs end (SAE J1263)
LEAST_ROWS = 8  # of a run
# A run that gains more speed than this, slopes taken off, is driven: speeds read to 0.2 m/s at worst jump by less
GAIN_MPS = 1.0
K0_PER_K, REFERENCE_C = 8.6e-3, 20.0  # UN GTR 15, annex 4, 4.5.3: rolling resistance with temperature
T, X, Q, Y, N = range(5)
WIND = ("wind_speed_mps", "wind_from_rad", "heading_rad")


def is_coast_down(log: Log) -> bool:
    """Whether nothing drives the vehicle in this log: force or torque are 0 throughout, or nothing is measured."""
    driving = [np.asarray(log.segments.channels[k]) for k in ("traction_force_n", "motor_torque_nm")
               if log.segments.has(k)]  # fmt: skip
    return not log.measured and not any(np.any(x != 0) for x in driving)


def directions_of(segments: Segments) -> tuple[Float[np.ndarray, " run"], str]:
    """+1 or −1 for each run, and how it is known: by heading, else every other run the other way."""
    slices = [s for _, s in trip_slices(np.asarray(segments.trip))]
    if not segments.has("heading_rad"):
        signs = np.where(np.arange(len(slices)) % 2 == 0, 1.0, -1.0)
        return signs, "the log has no heading_rad: every other run is taken as the other direction"
    heading = np.asarray(segments.channels["heading_rad"])
    mean = [np.angle(np.mean(np.exp(1j * heading[s]))) for s in slices]
    return np.where(np.cos(np.array(mean) - mean[0]) > 0, 1.0, -1.0), "directions are those of heading_rad"


def coast_down(log: Log, mass_kg: float, rotating: float, *, level: float = LEVEL) -> RoadLoad:
    """A, B, C of a coast-down log, each trip a run; intervals by Student's t, errors of a run being correlated.

    **Arguments:** `mass_kg` where the log has no mass; `rotating`, the factor for what turns (SAE J1263: 1.03 where it
    is not known). **Raises:** `InputError` for fewer than two runs, for one that something drives, or speeds that do
    not tell A, B and C apart.
    """
    s = log.segments
    for k, r in trip_slices(np.asarray(s.trip)):
        gain = _gained(s.take(np.arange(r.start, r.stop)), rotating)
        if gain > GAIN_MPS:
            raise InputError(
                f"trip '{log.trip_names[k]}' is not a coast-down: it gains {gain:.1f} m/s"
                f"{' beyond what the slope gives' if s.has('grade_rad') else ''}; coast in neutral from speed, or give "
                "a log that measures energy_wh, battery_power_w (_kw), motor_torque_nm or traction_force_n"
            )
    signs, how = directions_of(s)
    blocks = [_run(s.take(np.arange(r.start, r.stop)), mass_kg, rotating)
              for _, r in trip_slices(np.asarray(s.trip))]  # fmt: skip
    kept = [(b, d) for b, d in zip(blocks, signs, strict=True) if b is not None]
    if len(kept) < 2:
        raise InputError(
            f"{len(kept)} usable coast-down runs of at least {LEAST_ROWS} rows above {3.6 * LEAST_MPS:.0f} km/h; at "
            "least two are expected, one in each direction"
        )
    wind, both = s.has(*WIND), len({d for _, d in kept}) > 1
    runs = _Runs(np.stack([b for b, _ in kept]), np.array([d for _, d in kept]))
    count = [int(np.sum(runs.direction == d)) for d in ((1.0, -1.0) if both else (runs.direction[0],))]
    if min(count) < (2 if both else 3):
        raise InputError(
            f"coast-down runs by direction: {' and '.join(map(str, count))}; at least 2 in each of two directions, or "
            "3 in one, are expected"
        )
    kmh, powers = speeds_kmh(driven_range(fast := s.take(np.asarray(s.speed_mps) >= LEAST_MPS))), np.arange(3)
    what = np.concatenate([np.eye(3), (kmh[:, None] / 3.6) ** powers])  # A, B, C, then the force at each speed
    best, w = _estimate(runs, by_wind=both and not wind)
    without = [_estimate(runs.take(np.arange(len(kept)) != k), by_wind=both and not wind)[0] for k in range(len(kept))]
    known = what @ best
    off = np.stack(without) @ what.T
    n = len(kept)
    se = np.sqrt((n - 1) / n * np.sum((off - off.mean(axis=0)) ** 2, axis=0))
    half = float(stats.t.ppf(0.5 + level / 2, n - len(count))) * se
    low, high = known - half, known + half
    inside = np.interp(kmh, driven_range(fast), (1.0, 1.0), left=0.0, right=0.0) > 0
    if np.all(low[3:][inside] <= 0):
        raise InputError(
            "this is not a coast-down: no resistance shows at any speed driven; coast in neutral, or give a log that "
            "measures energy_wh, battery_power_w (_kw), motor_torque_nm or traction_force_n"
        )
    mass = float(np.mean(np.asarray(s.get("mass_kg", mass_kg))))
    notes = [how] if both else ["all runs go one way: A includes any slope, A and B any wind along the road"]
    if both and not wind:
        notes.append(f"wind along the road, from the two directions: {w:.2g} m/s (root mean square)")
    slow = len(s) - len(fast)
    if slow:
        notes.append(f"{slow} rows below {3.6 * LEAST_MPS:.0f} km/h are not used")
    if dropped := len(blocks) - len(kept):
        notes.append(f"{dropped} runs are too short: they have fewer than {LEAST_ROWS} rows above that speed")
    if not s.has("ambient_temp_c"):
        notes.append("no ambient_temp_c in the log: A and B are those of the day, not at 20 °C")
    if not s.has("ambient_temp_c") and not s.has("air_density_kgpm3"):
        notes.append("no air density or temperature in the log: for C the air is assumed to have the standard density")
    return RoadLoad(
        known[:3], low[:3], high[:3], kmh, known[3:], low[3:], high[3:], mass, driven_range(fast),
        f"coast-down of {len(kept)} runs (SAE J1263, J2263), mass factor {rotating:g} of rotating parts", tuple(notes),
    )  # fmt: skip


@dataclass(frozen=True)
class _Runs:
    """Of each run: sums of squares and products of t, x, q = ∫(v + w)² dt and y, about their means, and behind them on
    the diagonal how many rows; its direction, +1 or −1."""

    gram: Float[np.ndarray, "run 5 5"]
    direction: Float[np.ndarray, " run"]

    def take(self, which: np.ndarray) -> "_Runs":
        """Some of the runs."""
        return _Runs(self.gram[which], self.direction[which])


def _estimate(runs: _Runs, *, by_wind: bool) -> tuple[Float[np.ndarray, " 3"], float]:
    """A, B, C, and the root mean square of the winds along the road; each run has a term in x of its own."""
    g, s = runs.gram, runs.direction
    xx = g[:, X, X]
    rest = g - g[:, :, X, None] * g[:, None, X, :] / xx[:, None, None]  # what x does not explain
    signed = len(set(s)) > 1
    tt, tq, qq, ty, qy = (rest[:, i, k] for i, k in ((T, T), (T, Q), (Q, Q), (T, Y), (Q, Y)))
    left = np.array([[tt.sum(), tq.sum(), s @ tt], [tq.sum(), qq.sum(), s @ tq], [s @ tt, s @ tq, tt.sum()]])
    right = np.array([ty.sum(), qy.sum(), s @ ty])
    k = 3 if signed else 2
    scale = np.sqrt(np.diag(left)[:k])
    theta = np.linalg.solve(left[:k, :k] / np.outer(scale, scale), right[:k] / scale) / scale
    a, c, e = theta[0], theta[1], theta[2] if signed else 0.0
    slopes = (g[:, X, Y] - (a + e * s) * g[:, X, T] - c * g[:, X, Q]) / xx
    sides = [slopes[s == d] for d in ((1.0, -1.0) if signed else (s[0],))]
    weights = [xx[s == d] for d in ((1.0, -1.0) if signed else (s[0],))]
    b = float(np.mean([np.average(d, weights=w) for d, w in zip(sides, weights, strict=True)]))
    if not by_wind:
        return np.array([a, b, c]), 0.0
    solved = np.stack([-(a + e * s), 0.0 * s, -c + 0.0 * s, 1.0 + 0.0 * s, 0.0 * s], axis=1)
    leftover = np.einsum("ri,rij,rj->r", solved, rest, solved)  # squares of what each run leaves
    noise = np.maximum(leftover.sum(), 0.0) / max(float(g[:, N, N].sum()) - 2 * len(s) - 3, 1.0) / xx
    square = max(float(np.mean((slopes - b) ** 2 - noise)), 0.0) / (4.0 * c**2)  # of the wind
    return np.array([a - c * square, b, c]), float(np.sqrt(square))


def _gained(s: Segments, rotating: float) -> float:
    """The most speed that a run gains from any moment on, with what slopes give taken off [m/s].

    λ·dv/dt + g·sin θ = −(what holds the vehicle back)/m, which is never above 0 while it coasts.
    """
    s = s.take(np.asarray(s.speed_mps) >= LEAST_MPS)
    if len(s) < LEAST_ROWS:
        return 0.0
    climb = np.sin(np.asarray(s.get("grade_rad", np.zeros(len(s)))))
    t, v = np.asarray(s.time_s) + 0.5 * np.asarray(s.duration_s), np.asarray(s.speed_mps)
    level = v + GRAVITY_MPS2 / rotating * cumulative_trapezoid(climb, t, initial=0.0)
    return float(np.max(level - np.minimum.accumulate(level)))


def _run(s: Segments, mass_kg: float, rotating: float) -> Float[np.ndarray, "5 5"] | None:
    """Sums of squares and products of the equation's columns over one run; None for a run that is too short."""
    s = s.take(np.asarray(s.speed_mps) >= LEAST_MPS)
    if len(s) < LEAST_ROWS:
        return None
    t = np.asarray(s.time_s) + 0.5 * np.asarray(s.duration_s)
    v = np.asarray(s.speed_mps)
    ones = np.ones(len(s))
    mass = np.asarray(s.get("mass_kg", mass_kg * ones))
    warm = 1.0 + K0_PER_K * (np.asarray(s.get("ambient_temp_c", REFERENCE_C * ones)) - REFERENCE_C)
    usual = density_of_weather(s) if s.has("ambient_temp_c") else AIR_DENSITY_KGPM3 * ones
    thick = np.asarray(s.get("air_density_kgpm3", np.asarray(usual)))
    air = v
    if s.has(*WIND):
        c = s.channels
        air = v + np.asarray(c["wind_speed_mps"]) * np.cos(
            np.asarray(c["wind_from_rad"]) - np.asarray(c["heading_rad"])
        )

    def along(x: np.ndarray) -> np.ndarray:
        return cumulative_trapezoid(x, t, initial=0.0)

    climb = along(mass * GRAVITY_MPS2 * np.sin(np.asarray(s.get("grade_rad", 0.0 * ones))))
    drag = along(air * np.abs(air) * thick / AIR_DENSITY_KGPM3)
    columns = np.stack([along(1.0 / warm), along(v / warm), drag, -rotating * mass * v - climb], axis=1)
    columns -= columns.mean(axis=0)
    return np.asarray(block_diag(columns.T @ columns, len(s)))
