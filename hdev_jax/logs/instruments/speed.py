"""Speed that is read in steps, smoothed as far as the steps ask."""

import numpy as np
from jaxtyping import Float, Int

from hdev_jax.logs.instruments.slope import MATTERS
from hdev_jax.logs.instruments.smoother import DRIVE, course_of, lanes_of, smoothed, usual_sd
from hdev_jax.logs.instruments.steps import step_of

__all__ = ["speed_of"]


def speed_of(
    trip: Int[np.ndarray, " row"], time_s: Float[np.ndarray, " row"], reading: Float[np.ndarray, " row"]
) -> tuple[Float[np.ndarray, " row"], Float[np.ndarray, " row"], float] | None:
    """Speeds [m/s] of samples as what is read in steps tells of them, none further off than half a step; the standard
    deviation of their acceleration [m/s²]; the step [m/s].

    A speed in steps of 1 km/h, read each second, has accelerations of 0.06 m/s² that are none: an inertia of a truck's
    5 kN. A reading of 0 is standing. **Returns:** None where there is no step, or too small a one to matter.
    """
    step = step_of(reading)
    inner = np.flatnonzero((trip[2:] == trip[:-2]) & (reading[2:] + reading[:-2] > 0)) + 1
    if step == 0.0 or not len(inner):
        return None
    acceleration = (reading[inner + 1] - reading[inner - 1]) / (time_s[inner + 1] - time_s[inner - 1])
    noise = step**2 / 6.0 / float(np.median(time_s[inner + 1] - time_s[inner - 1])) ** 2
    if noise < MATTERS * float(np.var(acceleration)):
        return None
    lanes = lanes_of(trip, time_s, time_s, reading, np.ones(len(trip)), kind=DRIVE)
    course = course_of(lanes, DRIVE, least=step / np.sqrt(12.0))
    speed = np.clip(smoothed(lanes, course, DRIVE, level=True)[0], reading - 0.5 * step, reading + 0.5 * step)
    sd = np.full(len(trip), usual_sd(lanes, course, DRIVE))
    return np.where(reading > 0, np.maximum(speed, 0.0), 0.0), sd, step
