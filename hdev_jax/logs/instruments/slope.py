"""The slope of every row from altitudes, or from slopes that are noisy themselves, with its standard deviation."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from hdev_jax.logs.instruments.passes import Cells, pooled
from hdev_jax.logs.instruments.places import places_of
from hdev_jax.logs.instruments.smoother import HEIGHT, SLOPE, Course, Lanes, course_of, lanes_of, smoothed
from hdev_jax.logs.instruments.steps import step_of
from hdev_jax.logs.limits import MAX_GRADE_RAD

__all__ = ["MATTERS", "Repeated", "Slope", "slope_of"]

CELL_M, CELL_S = 20.0, 10.0  # rows that are one reading: a road's vertical curve is longer, standing is one place
# Share of the slopes' variance that is error, from which it is said and carried on: what a payload would be off by if
# the error counted as slope (attenuation by Var θ/(Var θ + σ²): Carroll et al., Measurement Error, chapter 3).
MATTERS = 0.01


@dataclass(frozen=True)
class Repeated:
    """Cells that were passed twice or more often, how often in the middle, of all cells in motion; the slope's error
    there by one pass and by all [rad]; visits that disagree with most others of their place, and were kept apart."""

    cells: int
    passes: float
    of: int
    alone_rad: float
    together_rad: float
    disagree: int

    def line(self) -> str:
        """How many cells several passes tell the slope of, and how well."""
        return (
            f"{self.cells} of {self.of} cells lie in places passed more than once, {self.passes:.0f} times in the "
            f"median: error of their slope {100 * self.alone_rad:.2g} % from one pass, "
            f"{100 * self.together_rad:.2g} % from all"
        )


@dataclass(frozen=True)
class Slope:
    """What came of the readings: slope and its standard deviation by row [rad]; the instrument's step (0: none seen),
    the model's numbers; `error_rad`, the RMS of the standard deviation where the vehicle moves; `span_m`, the length of
    road whose line of least squares would be off by as much; `noisy`, whether the error matters; `jumps`, how often the
    altitude began anew; `repeated`, where several passes of a place were put together."""

    grade_rad: Float[np.ndarray, " row"]
    sd_rad: Float[np.ndarray, " row"]
    step: float
    course: Course
    error_rad: float
    span_m: float
    noisy: bool
    jumps: int
    repeated: Repeated | None = None


def slope_of(
    trip: Int[np.ndarray, " row"], distance_m: Float[np.ndarray, " row"], duration_s: Float[np.ndarray, " row"],
    reading: Float[np.ndarray, " row"], *, of_slope: bool = False, place: Float[np.ndarray, "row 2"] | None = None,
) -> Slope | None:  # fmt: skip
    """The slope from readings by row of the altitude [m], or of the slope [rad]; NaN where there is none. With the
    `place` [m] of each row, altitudes of several passes of one place are put together.

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
    least = max(step / np.sqrt(12.0), 1e-5 if of_slope else 1e-3)
    course = course_of(lanes, kind, least=least)
    slope, sd = smoothed(lanes, course, kind)
    repeated = None
    if place is not None and not of_slope:
        known = np.isfinite(place[:, 0])
        where = np.stack([mean(np.where(known, x, 0.0), known.astype(float)) for x in place.T], axis=1)
        where[np.add.reduceat(known, first) == 0] = np.nan
        way = np.add.reduceat(distance_m, first)
        cells = Cells(part - 1, at, mean(clock, every), height, readings.astype(float), slope)
        found = _together(cells, where, way, lanes, course, least)
        course, slope, sd, repeated = found or (course, slope, sd, None)
    run = np.cumsum(new_trip) - 1.0
    apart = float(middle[-1]) + 1.0  # trips on one line, further apart than any is long
    line, on_line = middle + apart * run, at + apart * run[first]
    by_row, sd_by_row = np.interp(line, on_line, slope), np.interp(line, on_line, sd)
    moves = distance_m > 0
    error = float(np.sqrt(np.mean(sd_by_row[moves] ** 2)))
    share = error**2 / max(course.slope**2, 1e-12)
    apart_m = float(np.sum(distance_m)) / max(float(np.sum(readings[np.add.reduceat(moves, first) > 0])), 1.0)
    span = float(np.cbrt(12.0 * course.white**2 * apart_m / max(error, 1e-9) ** 2))
    if not moves.any() or (of_slope and share < MATTERS):
        return None
    return Slope(np.arctan(by_row), sd_by_row, step, course, error, span, share >= MATTERS, int(broken.sum()), repeated)


def _together(
    cells: Cells, where: np.ndarray, way: np.ndarray, lanes: Lanes, course: Course, least: float
) -> tuple[Course, np.ndarray, np.ndarray, Repeated] | None:
    """The numbers of the model, slope and its sd by cell, from the readings of all passes of each place; None where no
    place was passed twice."""
    places = places_of(cells.part, cells.at_m, where, CELL_M)
    if places is None:
        return None
    whole = replace(course, white=float(np.hypot(course.white, course.drift)), drift=0.0)
    level, _ = smoothed(lanes, whole, HEIGHT, level=True)
    them = pooled(cells, level, places, course, least=least)
    twice = (way > 0) & (them.visits > 1) if them is not None else np.zeros(len(way), bool)
    if them is None or not twice.any():
        return None
    lanes_of_all = lanes_of(
        cells.part, cells.at_m, cells.clock_s, them.height, them.count, kind=HEIGHT, passes=them.passes
    )
    course = course_of(lanes_of_all, HEIGHT, least=least, errors=them.errors)
    slope, sd = smoothed(lanes_of_all, course, HEIGHT)
    _, alone = smoothed(lanes, course, HEIGHT)
    one, every = (float(np.sqrt(np.mean(x[twice] ** 2))) for x in (alone, sd))
    passes = float(np.median(them.visits[twice]))
    return course, slope, sd, Repeated(int(twice.sum()), passes, int(np.sum(way > 0)), one, every, them.disagree)


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
