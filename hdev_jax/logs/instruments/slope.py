"""The slope of every row from altitudes, or from slopes that are noisy themselves, with its standard deviation."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from hdev_jax.logs.instruments.smoother import HEIGHT, SLOPE, Course, course_of, lanes_of, smoothed
from hdev_jax.logs.instruments.steps import step_of
from hdev_jax.logs.limits import MAX_GRADE_RAD

__all__ = ["MATTERS", "Slope", "slope_of"]

CELL_M, CELL_S = 20.0, 10.0  # rows that are one reading: a road's vertical curve is longer, standing is one place
# Share of the slopes' variance that is error, from which it is said and carried on: what a payload would be off by if
# the error counted as slope (attenuation by Var θ/(Var θ + σ²): Carroll et al., Measurement Error, chapter 3).
MATTERS = 0.01


@dataclass(frozen=True)
class Slope:
    """What came of the readings: slope and its standard deviation by row [rad]; the instrument's step (0: none seen),
    the model's numbers; `error_rad`, the RMS of the standard deviation where the vehicle moves; `span_m`, the length of
    road whose line of least squares would be off by as much; `noisy`, whether the error matters; `jumps`, how often the
    altitude began anew."""

    grade_rad: Float[np.ndarray, " row"]
    sd_rad: Float[np.ndarray, " row"]
    step: float
    course: Course
    error_rad: float
    span_m: float
    noisy: bool
    jumps: int


def slope_of(
    trip: Int[np.ndarray, " row"], distance_m: Float[np.ndarray, " row"], duration_s: Float[np.ndarray, " row"],
    reading: Float[np.ndarray, " row"], *, of_slope: bool = False,
) -> Slope | None:  # fmt: skip
    """The slope from readings by row of the altitude [m], or of the slope [rad]; NaN where there is none.

    **Returns:** None where slopes that were logged have no noise that matters, or there is no reading in motion.
    """
    there = np.isfinite(reading)
    if not (there & (distance_m > 0)).any():
        return None
    z = np.tan(np.where(there, reading, 0.0)) if of_slope else np.where(there, reading, 0.0)
    middle, clock = np.cumsum(distance_m) - 0.5 * distance_m, np.cumsum(duration_s) - 0.5 * duration_s
    new_trip = np.r_[True, trip[1:] != trip[:-1]]
    progress = np.floor(np.cumsum(distance_m / CELL_M + duration_s / CELL_S))
    first = np.flatnonzero(new_trip | np.r_[True, np.diff(progress) > 0])

    def mean(x: np.ndarray, weight: np.ndarray) -> np.ndarray:
        total = np.add.reduceat(weight, first)
        return np.add.reduceat(x * weight, first) / np.where(total > 0, total, 1.0)

    # what is held from row to row, in steps or because the instrument is slower than the log, is one reading
    fresh = there & (new_trip | np.r_[True, np.diff(z) != 0])
    readings = np.where(np.add.reduceat(there, first) > 0, np.maximum(np.add.reduceat(fresh, first), 1), 0)
    every, seen = np.ones(len(trip)), there.astype(float)
    at, height = np.where(readings > 0, mean(middle, seen), mean(middle, every)), mean(z, seen)
    if of_slope and not _rough(trip[first], height, readings, np.add.reduceat(distance_m, first)):
        return None
    broken = np.zeros(len(first), bool) if of_slope else _jumps(trip[first], at, height, readings)
    kind = SLOPE if of_slope else HEIGHT
    part = np.cumsum(broken | new_trip[first])
    lanes = lanes_of(part, at, mean(clock, every), height, readings.astype(float), kind=kind)
    step = step_of(z[there])
    course = course_of(lanes, kind, least=max(step / np.sqrt(12.0), 1e-5 if of_slope else 1e-3))
    slope, sd = smoothed(lanes, course, kind)
    run = np.cumsum(new_trip) - 1.0
    apart = float(middle[-1]) + 1.0  # trips on one line, further apart than any is long
    place, places = middle + apart * run, at + apart * run[first]
    by_row, sd_by_row = np.interp(place, places, slope), np.interp(place, places, sd)
    moves = distance_m > 0
    error = float(np.sqrt(np.mean(sd_by_row[moves] ** 2)))
    share = error**2 / max(course.slope**2, 1e-12)
    apart_m = float(np.sum(distance_m)) / max(float(np.sum(readings[np.add.reduceat(moves, first) > 0])), 1.0)
    span = float(np.cbrt(12.0 * course.white**2 * apart_m / max(error, 1e-9) ** 2))
    if not moves.any() or (of_slope and share < MATTERS):
        return None
    return Slope(np.arctan(by_row), sd_by_row, step, course, error, span, share >= MATTERS, int(broken.sum()))


def _jumps(trip: np.ndarray, at: np.ndarray, height: np.ndarray, readings: np.ndarray) -> np.ndarray:
    """Cells where the altitude begins anew: it jumps by more than the steepest road and ten times its usual change."""
    seen = np.flatnonzero(readings > 0)
    change, way = np.abs(np.diff(height[seen])), np.diff(at[seen])
    same = trip[seen[1:]] == trip[seen[:-1]]
    usual = float(np.median(change[same])) if same.any() else 0.0
    out = np.zeros(len(trip), bool)
    out[seen[1:]] = same & (change > np.tan(MAX_GRADE_RAD) * way + np.maximum(10.0 * usual, 1.0))
    return out


def _rough(trip: np.ndarray, slope: np.ndarray, count: np.ndarray, way: np.ndarray) -> bool:
    """Whether logged slopes could have noise that matters: their second differences bound it: of white noise they
    have 6 times the variance, of what is smooth little."""
    inner = (trip[2:] == trip[:-2]) & (np.minimum(np.minimum(count[2:], count[1:-1]), count[:-2]) > 0)
    inner &= (np.minimum(way[2:], way[:-2]) > 0) & (way[1:-1] < 2.0 * CELL_M)
    if inner.sum() < 50:
        return False
    bound = float(np.mean((slope[2:] - 2.0 * slope[1:-1] + slope[:-2])[inner] ** 2)) / 6.0
    return bound > MATTERS * float(np.var(slope[count > 0]))
