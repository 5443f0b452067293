"""Generalised least squares: the coefficients at which candidates are scored."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from hdev_jax.diagnosis.scores.evidence import Evidence
from hdev_jax.diagnosis.scores.passes import Baseline, distance_from_table, evidence_of
from hdev_jax.inference import Calibration

__all__ = ["generalised"]

STEPS = 6
SETTLED = 0.05  # standard errors that the last step may move by
EDGE = 1e-3  # of a support that is bounded on both sides


def generalised(baseline: Baseline) -> tuple[Calibration, Float[np.ndarray, "free free"]]:
    """Gauss-Newton steps of generalised least squares from the fit, in every free coefficient. One that would leave its
    support is held at its bound, and the others are fitted beside it.

    Ordinary least squares leave a size uncertain where errors are slow; scored by generalised least squares, the error
    of that estimate would look like another effect.

    **Returns:** the fit with these values in place of its own, and their covariance. The fit itself, with variances
    that are infinite, where the steps do not settle or do not lower the misfit. `predicted`, `sd` and `covariance` stay
    the fit's own.
    """
    fit = baseline.fit
    failed = fit, np.diag(np.full(len(fit.values), np.inf))
    if not len(fit.values):
        return failed
    here, first = fit, np.inf
    for k in range(STEPS + 1):
        evidence = evidence_of(replace(baseline, fit=here))
        moved, sd = distance_from_table(here)
        misfit = evidence.misfit() + 0.5 * float(np.sum((moved / sd) ** 2))
        if k == 0:
            first = misfit
        if not (np.isfinite(misfit) and misfit <= first + 1e-6 * abs(first)):
            return failed
        step, covariance = _step(evidence, here)
        if not np.all(np.isfinite(step)):
            return failed
        there = _inside(here, here.values + step)
        if np.max(np.abs(there - here.values) / np.maximum(np.sqrt(np.diag(covariance)), 1e-300)) < SETTLED:
            return replace(here, vehicle=here.table.insert(here.vehicle, here.values)), covariance
        here = replace(here, values=there)  # the Jacobian is at the values, whatever the vehicle has
    return failed


def _step(evidence: Evidence, here: Calibration) -> tuple[np.ndarray, np.ndarray]:
    """The step of all coefficients, and their covariance. A coefficient that would leave its support is held at its
    bound, with its own variance."""
    step, covariance = evidence.step()
    held = np.zeros(len(step), dtype=bool)
    for _ in range(len(step)):
        inside = _inside(here, here.values + step)
        out = ~held & (np.abs(inside - (here.values + step)) > 1e-9 * np.sqrt(np.diag(covariance)))
        if not np.any(out) or not np.all(np.isfinite(step)):
            break
        held |= out
        step[held] = (inside - here.values)[held]
        if np.all(held):
            break
        rest = ~held
        moved = evidence.moved(step * held).holding(held)
        step[rest], covariance[np.ix_(rest, rest)] = moved.step()
        covariance[np.ix_(rest, held)] = covariance[np.ix_(held, rest)] = 0.0
    return step, covariance


def _inside(fit: Calibration, values: Float[np.ndarray, " free"]) -> Float[np.ndarray, " free"]:
    """Other values of the fit's coefficients, inside their supports."""
    inside = []
    for c, x in zip(fit.table.free, values, strict=True):
        edge = EDGE * (c.upper - c.lower) if np.isfinite(c.upper - c.lower) and c.upper < 1e9 else 0.0
        inside.append(float(np.clip(x, c.lower + edge, c.upper - edge)))
    return np.array(inside)
