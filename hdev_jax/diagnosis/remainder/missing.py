"""A channel that the model needs and the log lacks: does what remains behave like it?"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from hdev_jax.diagnosis.remainder.drift import Drift, Slow, drift_of
from hdev_jax.diagnosis.settings import Settings
from hdev_jax.problem import Problem, Split
from hdev_jax.units import GRAVITY_MPS2

__all__ = ["MissingSlope", "missing_slope"]

HILL_S = 10.0  # hills change within seconds, what drifts within minutes


@dataclass(frozen=True)
class MissingSlope:
    """A slope that the log lacks: its standard deviation, and the RMS of its power over that of the residual."""

    sd: float
    rms: float

    @property
    def words(self) -> str:
        """As a part of a sentence."""
        return (
            f"a force that varies like that of a slope of at least {100 * self.sd:.1f} % (standard deviation), or of "
            "gusts; the log has no slope: add it first"
        )


def missing_slope(
    problem: Problem, split: Split, residual_w: Float[np.ndarray, " row"], predicted_w: Float[np.ndarray, " row"],
    drift: Drift, settings: Settings,
) -> MissingSlope | None:  # fmt: skip
    """The slope that the residual of the training rows [W] behaves like, where the log has none: a force, in the means
    over minutes (`drift`) or over `HILL_S`, whichever shows more of it, with a share of the residual's variance. None
    where there is no sign of it.
    """
    s = problem.segments
    if problem.vehicle.entry != "road" or s.has("grade_rad"):
        return None
    seconds, trip, speed = np.asarray(s.duration_s), np.asarray(s.trip), np.asarray(s.speed_mps)
    quick = Slow.of(residual_w, predicted_w, speed, seconds, trip, HILL_S)
    quickly = drift_of(quick.take(np.isin(quick.trip, split.train)), settings)
    sd = max((d.sd for d in (drift, quickly) if d.like == "force"), default=0.0)
    if not sd > 0.0:
        return None
    rows = np.isin(trip, split.train)
    share = sd**2 * float(np.mean(speed[rows] ** 2)) / max(float(np.mean(residual_w[rows] ** 2)), 1e-300)
    if share <= settings.least_share:
        return None
    mass_kg = s.channels["mass_kg"] if s.has("mass_kg") else problem.vehicle.mass_kg
    weight_n = GRAVITY_MPS2 * float(np.mean(np.asarray(mass_kg)))
    return MissingSlope(sd / weight_n, min(float(np.sqrt(share)), 1.0))
