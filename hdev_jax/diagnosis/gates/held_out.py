"""The last gate: do the held-out trips contradict what was found?"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from hdev_jax.diagnosis.noise.noise import Noise, estimate_noise, whiten
from hdev_jax.problem import Problem, Split
from hdev_jax.segments import trip_slices

__all__ = ["held_out_gain"]


def held_out_gain(
    problem: Problem, split: Split, before: Float[np.ndarray, " row"], after: Float[np.ndarray, " row"], *, levels: bool
) -> float:
    """Gain in log-likelihood of one prediction of the held-out trips over another, with the noise that the second
    leaves on the training trips (`levels`: with random intercepts). A plain error would be blind to what is small
    beside slow noise."""
    s = problem.segments
    trip, seconds = np.asarray(s.trip), np.asarray(s.duration_s)
    train, test = problem.rows(split.train), problem.rows(split.test)
    noise = estimate_noise((problem.measured - after)[train], trip[train], seconds[train], levels=levels)
    noise = replace(noise, trip_scale=np.ones(1))
    return _log_likelihood((problem.measured - after)[test], noise, trip[test], seconds[test]) - _log_likelihood(
        (problem.measured - before)[test], noise, trip[test], seconds[test]
    )


def _log_likelihood(residual: np.ndarray, noise: Noise, trip: np.ndarray, seconds: np.ndarray) -> float:
    """Log-likelihood of a residual but for a constant, random intercepts of trips integrated out."""
    z, one = whiten(residual[:, None], noise, trip, seconds).T
    total = -0.5 * float(z @ z)
    for _, rows in trip_slices(trip):
        uz, uu = float(one[rows] @ z[rows]), float(one[rows] @ one[rows])
        total += 0.5 * noise.level_sd**2 * uz**2 / (1.0 + noise.level_sd**2 * uu)
    return total
