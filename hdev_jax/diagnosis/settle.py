"""Coefficients as whitened rows have them: where candidates are scored from, and what is known of a size beforehand."""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from hdev_jax.diagnosis.sums import distance_from_table, evidence_of
from hdev_jax.diagnosis.whiten import Noise
from hdev_jax.inference import Calibration, predict

if TYPE_CHECKING:
    from hdev_jax.diagnosis.look import Loop

__all__ = ["settle"]

STEPS = 6
SETTLED = 0.05  # standard errors that the last step may move by
EDGE = 1e-3  # of a support that is bounded on both sides


def settle(problem: "Loop", fit: Calibration, noise: Noise) -> tuple[Calibration, Float[np.ndarray, " free"]]:
    """Gauss-Newton on whitened rows from a fit, every free coefficient moving.

    Rows of equal weight leave a size uncertain where errors are slow; what they miss of it would look like another
    effect to whitened rows, which see it far better.

    **Returns:** the fit with these values in place of its own, and their standard errors. The fit itself, with errors
    that are infinite, where the steps do not settle or do not lower the misfit.
    """
    failed = fit, np.full(len(fit.values), np.inf)
    if not len(fit.values):
        return failed
    here, first = fit, np.inf
    for k in range(STEPS + 1):
        evidence = evidence_of(problem.ground(here, noise))
        moved, sd = distance_from_table(here)
        misfit = evidence.misfit() + 0.5 * float(np.sum((moved / sd) ** 2))
        if k == 0:
            first = misfit
        step, error = evidence.step()
        if not (np.all(np.isfinite(step)) and np.isfinite(misfit) and misfit <= first + 1e-6 * abs(first)):
            return failed
        if np.max(np.abs(step) / np.maximum(error, 1e-300)) < SETTLED:
            return here, error
        here = _at(problem, here, here.values + step)
    return failed


def _at(problem: "Loop", fit: Calibration, values: Float[np.ndarray, " free"]) -> Calibration:
    """The fit with other values, inside their supports."""
    inside = []
    for c, x in zip(fit.table.free, values, strict=True):
        edge = EDGE * (c.upper - c.lower) if np.isfinite(c.upper - c.lower) and c.upper < 1e9 else 0.0
        inside.append(float(np.clip(x, c.lower + edge, c.upper - edge)))
    theta = np.array(inside)
    vehicle = fit.table.insert(fit.vehicle, theta)
    rows = problem.rows
    predicted = np.asarray(predict(vehicle, rows.segments, problem.target))[: rows.rows]
    return replace(fit, vehicle=vehicle, values=theta, predicted=predicted)
