"""Speed that is read in steps, smoothed as far as the steps ask."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from hdev_jax.logs.instruments.slope import MATTERS
from hdev_jax.logs.instruments.smoother import DRIVE, course_of, lanes_of, smoothed, usual_sd
from hdev_jax.logs.instruments.steps import step_of

__all__ = ["Speed", "end_speeds", "speed_of"]

QUARTILES = 1.349  # a normal distribution's quartiles are so many standard deviations apart


class Speed(NamedTuple):
    """Speeds [m/s], the standard deviation of each [m/s] and of the acceleration of an even rate [m/s²], the step."""

    mps: Float[np.ndarray, " reading"]
    sd_mps: Float[np.ndarray, " reading"]
    acceleration_sd: float
    step: float


def speed_of(
    trip: Int[np.ndarray, " reading"], time_s: Float[np.ndarray, " reading"], reading: Float[np.ndarray, " reading"],
    *, span: int = 2,
) -> Speed | None:  # fmt: skip
    """Speeds [m/s] as what is read in steps tells of them, none further off than half a step.

    A speed in steps of 1 km/h, read each second, has accelerations of 0.06 m/s² that are none: an inertia of a truck's
    5 kN. A reading of 0 is standing. `span`: over how many steps in time a row's acceleration is taken, 2 between the
    neighbours of a sample, 1 between the ends of an interval.

    **Returns:** None where there is no step, or too small a one to matter beside the gentle accelerations, which weigh
    most in a calibration where noise grows with power.
    """
    step = step_of(reading)
    first = np.flatnonzero((trip[span:] == trip[:-span]) & (reading[span:] + reading[:-span] > 0))
    if step == 0.0 or not len(first):
        return None
    apart_s = time_s[first + span] - time_s[first]
    acceleration = (reading[first + span] - reading[first]) / apart_s
    noise = step**2 / 6.0 / float(np.median(apart_s)) ** 2
    low, high = np.quantile(acceleration, [0.25, 0.75])
    if noise < MATTERS * float((high - low) / QUARTILES) ** 2:
        return None
    lanes = lanes_of(trip, time_s, time_s, reading, np.ones(len(trip)), kind=DRIVE)
    course = course_of(lanes, DRIVE, least=step / np.sqrt(12.0))
    speed, sd = smoothed(lanes, course, DRIVE, level=True)
    speed = np.clip(speed, reading - 0.5 * step, reading + 0.5 * step)
    return Speed(
        np.where(reading > 0, np.maximum(speed, 0.0), 0.0),
        np.where(reading > 0, np.minimum(sd, step / np.sqrt(12.0)), 0.0),
        usual_sd(lanes, course, DRIVE),
        step,
    )


def end_speeds(
    trip: Int[np.ndarray, " row"], time_s: Float[np.ndarray, " row"], duration_s: Float[np.ndarray, " row"],
    start: Float[np.ndarray, " row"], end: Float[np.ndarray, " row"],
) -> tuple[Float[np.ndarray, " row"], Float[np.ndarray, " row"], Float[np.ndarray, " row"], float] | None:  # fmt: skip
    """The speeds at both ends of intervals [m/s], the standard deviation of their acceleration [m/s²] and the step, as
    `speed_of` has them; the end of a row is one reading with the start of the next where they have one value and one
    time. **Returns:** None where `speed_of` does."""
    joined = (trip[1:] == trip[:-1]) & (start[1:] == end[:-1])
    joined &= np.abs(time_s[1:] - time_s[:-1] - duration_s[:-1]) <= 0.01 * duration_s[:-1]
    opens = np.r_[True, ~joined]
    chain = np.cumsum(opens) - 1
    at_end = np.arange(len(trip)) + chain + 1  # a chain has a reading more than it has rows
    at_start = at_end - 1
    readings = len(trip) + int(chain[-1]) + 1
    of, at, speed = np.empty(readings, int), np.empty(readings), np.empty(readings)
    for place, when, read in ((at_start, time_s, start), (at_end, time_s + duration_s, end)):
        of[place], at[place], speed[place] = chain, when, read
    if (found := speed_of(of, at, speed, span=1)) is None:
        return None
    sd = np.hypot(found.sd_mps[at_start], found.sd_mps[at_end]) / np.maximum(duration_s, 1e-9)
    return found.mps[at_start], found.mps[at_end], sd, found.step
