"""Speed that is read in steps, smoothed as far as the steps ask."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from hdev_jax.logs.instruments.slope import MATTERS
from hdev_jax.logs.instruments.smoother import DRIVE, Course, Lanes, course_of, lanes_of, smoothed, usual_sd
from hdev_jax.logs.instruments.steps import step_of
from hdev_jax.units import GRAVITY_MPS2

__all__ = ["end_speeds", "speed_of"]

QUARTILES = 1.349  # a normal distribution's quartiles are so many standard deviations apart
REPEATED = 0.5  # of the rows in motion: the error of a reading that repeats the one before is no other error
# A tenth of a truck's rolling resistance, c_rr 0.006 (tyres of EU label class C): less acceleration is no matter.
LEAST_MPS2 = 0.1 * 0.006 * GRAVITY_MPS2
LONG = 8.0  # rows of a chain, in the mean, from which on neighbours say something of a speed


class _Steps(NamedTuple):
    """Readings in steps, by chains of neighbours, and the course that smooths them."""

    lanes: Lanes
    course: Course
    reading: np.ndarray
    step: float

    def speeds(self) -> tuple[np.ndarray, np.ndarray]:
        """Posterior speeds [m/s], none further off than half a step, and their standard deviations; 0 stays 0."""
        speed, sd = smoothed(self.lanes, self.course, DRIVE, level=True)
        half, stands = 0.5 * self.step, self.reading <= 0
        speed = np.clip(speed, np.maximum(self.reading - half, 0.0), self.reading + half)
        return np.where(stands, 0.0, speed), np.where(stands, 0.0, np.minimum(sd, self.step / np.sqrt(12.0)))


def speed_of(
    trip: Int[np.ndarray, " row"], time_s: Float[np.ndarray, " row"], reading: Float[np.ndarray, " row"]
) -> tuple[Float[np.ndarray, " row"], Float[np.ndarray, " row"], float] | None:
    """Speeds [m/s] of samples as what is read in steps tells of them, none further off than half a step; the standard
    deviation of their acceleration [m/s²]; the step [m/s].

    A speed in steps of 1 km/h, read each second, has accelerations of 0.06 m/s² that are none: an inertia of a truck's
    5 kN. A reading of 0 is standing.

    **Returns:** None where there is no step, or too small a one to matter beside the gentle accelerations, which weigh
    most in a calibration where noise grows with power, or beside rolling resistance.
    """
    found = _steps(trip, time_s, reading, step_of(reading), span=2)
    if found is None:
        return None
    sd = np.full(len(trip), usual_sd(found.lanes, found.course, DRIVE))
    return found.speeds()[0], sd, found.step


def end_speeds(
    trip: Int[np.ndarray, " row"], time_s: Float[np.ndarray, " row"], duration_s: Float[np.ndarray, " row"],
    start: Float[np.ndarray, " row"], end: Float[np.ndarray, " row"],
) -> tuple[Float[np.ndarray, " row"], Float[np.ndarray, " row"], Float[np.ndarray, " row"], float] | None:  # fmt: skip
    """The same of the speeds at both ends of intervals: start, end, standard deviation of the acceleration, step.

    The end of a row is one reading with the start of the next where both say the same and no time is between.
    **Returns:** None where `speed_of` does, where few rows are joined, or where rows are so short that a reading mostly
    repeats the one before.
    """
    step = step_of(np.r_[start, end])
    short = np.minimum(duration_s[1:], duration_s[:-1])
    joined = (trip[1:] == trip[:-1]) & (np.abs(start[1:] - end[:-1]) < 0.1 * step)  # however a file rounds them
    joined &= np.abs(time_s[1:] - time_s[:-1] - duration_s[:-1]) <= 0.5 * short
    chain = np.cumsum(np.r_[True, ~joined]) - 1
    chains = int(chain[-1]) + 1
    repeats = np.abs(end - start)[start + end > 0] < 0.1 * step
    if len(trip) < LONG * chains or np.mean(repeats) > REPEATED:
        return None
    at_end = np.arange(len(trip)) + chain + 1  # a chain has a reading more than it has rows
    at_start, readings = at_end - 1, len(trip) + chains
    of, length, speed = np.empty(readings, int), np.zeros(readings), np.empty(readings)
    for place, read in ((at_start, start), (at_end, end)):
        of[place], speed[place] = chain, read
    length[at_end] = duration_s  # a clock that is rounded otherwise than the durations would run back
    if (found := _steps(of, np.cumsum(length), speed, step, span=1)) is None:
        return None
    speed, sd = found.speeds()
    return speed[at_start], speed[at_end], np.hypot(sd[at_start], sd[at_end]) / duration_s, step


def _steps(chain: np.ndarray, time_s: np.ndarray, reading: np.ndarray, step: float, *, span: int) -> _Steps | None:
    """The readings with their course; None where the step is too small to matter. `span`: over how many readings the
    acceleration of a row goes, 2 between the neighbours of a sample, 1 between the ends of an interval."""
    first = np.flatnonzero((chain[span:] == chain[:-span]) & (reading[span:] + reading[:-span] > 0))
    if step == 0.0 or not len(first):
        return None
    apart_s = time_s[first + span] - time_s[first]
    acceleration = (reading[first + span] - reading[first]) / apart_s
    noise = step / np.sqrt(6.0) / float(np.median(apart_s))
    low, high = np.quantile(acceleration, [0.25, 0.75])
    if noise < max(np.sqrt(MATTERS) * float(high - low) / QUARTILES, LEAST_MPS2):
        return None
    lanes = lanes_of(chain, time_s, time_s, reading, np.ones(len(chain)), kind=DRIVE)
    return _Steps(lanes, course_of(lanes, DRIVE, least=step / np.sqrt(12.0)), reading, step)
