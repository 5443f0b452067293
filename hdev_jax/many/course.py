"""Trip by trip: what each trip says of every coefficient, what it took and in which conditions.

With the rows whitened, J the Jacobian of the fitted coefficients and r the residual, and J⊥ a coefficient's column less
what the others explain of it, a trip tells of that coefficient the information a = J⊥ᵀJ⊥ and the score b = J⊥ᵀr: b/a
is its own estimate, less the fitted one, and its variance 1/a where the noise is as it was taken.
"""

from typing import Any

import numpy as np

from hdev_jax.diagnosis.diagnose import Outcome
from hdev_jax.diagnosis.noise.noise import estimate_noise, whiten
from hdev_jax.energy.saved import conditions
from hdev_jax.inference import jacobian, padded
from hdev_jax.segments import trip_slices
from hdev_jax.targets import TARGETS

__all__ = ["CONDITIONS", "course_of"]

CONDITIONS = {"speed in motion": "speed_kmh", "outside temperature": "ambient_temp_c", "mass": "mass"}


def course_of(outcome: Outcome) -> dict[str, Any]:
    """By trip, in the order of the log: `trip`, `started_s` (None without a date), `km`, `hours`, `kwh` (measured),
    `model_kwh`, conditions; `coefficients`, by name `information`, `score` and `kwh_per_unit`, the energy that a unit
    of the coefficient costs in the trip."""
    problem, fit = outcome.problem, outcome.fit
    log = problem.log
    names = log.trip_names
    there, first = np.unique(log.trip, return_index=True)
    there = there[np.argsort(first, kind="stable")]
    seconds, meters = np.asarray(problem.segments.duration_s), np.asarray(problem.segments.distance_m)
    per_kwh = TARGETS[problem.target].per_kwh
    weight = problem.weight() / (per_kwh or 1.0)

    def by_trip(x: np.ndarray) -> list[float]:
        return np.bincount(log.trip, weights=x, minlength=len(names))[there].tolist()

    out: dict[str, Any] = {
        "trip": [names[i] for i in there],
        "started_s": [log.started_s.get(names[i]) for i in there],
        "km": by_trip(meters / 1e3), "hours": by_trip(seconds / 3600.0),
    }  # fmt: skip
    if per_kwh is not None and TARGETS[problem.target].of_battery:
        out |= {"kwh": by_trip(weight * problem.measured), "model_kwh": by_trip(weight * outcome.predicted_after)}
    for words, (_, x) in conditions(problem).items():
        if words in CONDITIONS:
            out[CONDITIONS[words]] = x[there].tolist()
    free = fit.table.free
    if not free or outcome.given is not None:
        return {**out, "coefficients": {}}
    rows = padded(problem.segments, problem.measured)
    j = np.asarray(jacobian(fit.vehicle, fit.table, rows.segments, problem.target))[: rows.rows]
    residual = problem.measured - outcome.predicted_after
    trip = np.asarray(problem.segments.trip)
    levels = len(list(trip_slices(trip))) > 1
    noise = estimate_noise(residual, trip, seconds, levels=levels)
    white = whiten(np.column_stack([j, residual]), noise, trip, seconds)[:, :-1]
    k = len(free)
    scale = np.sqrt(np.maximum(np.sum(white[:, :k] ** 2, axis=0), 1e-300))
    told: dict[str, Any] = {}
    declared = {c.name for c in problem.table.free}
    for i, c in enumerate(free):
        if c.name not in declared:
            continue
        other = [n for n in range(k) if n != i]
        own = white[:, i]
        if other:
            beside = white[:, other] / scale[other]
            own = own - beside @ np.linalg.lstsq(beside, own, rcond=1e-10)[0]
        told[c.name] = {
            "information": by_trip(own * own), "score": by_trip(own * white[:, k]),
            "kwh_per_unit": by_trip(weight * j[:, i]) if per_kwh is not None else None,
        }  # fmt: skip
    return {**out, "coefficients": told}
