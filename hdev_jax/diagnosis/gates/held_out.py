"""The last gate: do the held-out trips contradict what was found?"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from hdev_jax.diagnosis.noise.noise import estimate_noise, log_likelihood_of_trip, whiten
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
    both = problem.measured[test, None] - np.stack([before, after], axis=1)[test]
    white = whiten(both, noise, trip[test], seconds[test])
    each = [log_likelihood_of_trip(white[rows], noise.level_sd) for _, rows in trip_slices(trip[test])]
    was, now = np.sum(each, axis=0)
    return float(now - was)
