"""Trip by trip: each trip's information on the coefficients, its energy and its conditions.

A trip's information is its normal equations JᵀJ and Jᵀr, with whitened rows, J the Jacobian of the fitted coefficients
and r the residual. Those of several trips add up, so a step of a coefficient at any trip is tested from them alone
(`hdev_jax.many.unlike`).
"""

from typing import Any

import numpy as np

from hdev_jax.diagnosis.diagnose import Outcome
from hdev_jax.diagnosis.noise.noise import estimate_noise, whiten
from hdev_jax.energy.saved import conditions
from hdev_jax.inference import padded
from hdev_jax.physics import Effect
from hdev_jax.targets import TARGETS

__all__ = ["CONDITIONS", "course_of"]

CONDITIONS = {"speed in motion": "speed_kmh", "outside temperature": "ambient_temp_c", "mass": "mass"}


def course_of(outcome: Outcome) -> dict[str, Any]:
    """By trip, in the order of the log: `trip`, `started_s` (None without a date), `km`, `hours`, `kwh` (measured),
    `model_kwh`, conditions; `coefficients` (None where none is free): `names`, which of them the sheet has
    (`declared`), and by trip `gram` (upper triangle of JᵀJ, row by row), `score` Jᵀr, `kwh_per_unit`, the energy that a
    unit of each costs in the trip."""
    problem = outcome.problem
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
    vehicle, table, predicted = outcome.fit.vehicle, outcome.fit.table, outcome.predicted_after
    if outcome.given is not None or any(_compares_trips(outcome.training.library[e]) for e in outcome.found):
        vehicle, table, predicted = outcome.before, problem.table, outcome.predicted_before
    if not table.free:
        return {**out, "coefficients": None}
    rows = padded(problem.segments, problem.measured)
    j = outcome.training.kernel.linearised(vehicle, table, rows.segments, problem.target)[1][: rows.rows]
    residual = problem.measured - predicted
    trip = np.asarray(problem.segments.trip)
    noise = estimate_noise(residual, trip, seconds, levels=len(there) > 1)
    white = whiten(np.column_stack([j, residual]), noise, trip, seconds)[:, :-1]
    k = len(table.free)
    upper = np.triu_indices(k)
    declared = {c.name for c in problem.table.free}
    at = [np.flatnonzero(log.trip == i) for i in there]
    return {**out, "coefficients": {
        "names": [c.name for c in table.free], "declared": [c.name in declared for c in table.free],
        "gram": [(white[a, :k].T @ white[a, :k])[upper] for a in at],
        "score": [white[a, :k].T @ white[a, k] for a in at],
        "kwh_per_unit": None if per_kwh is None else [weight[a] @ j[a] for a in at],
    }}  # fmt: skip


def _compares_trips(effect: type[Effect]) -> bool:
    """Whether an effect is a difference between trips itself: what changed is then not left to be found."""
    return bool(effect.searched) or any(p.name == "at_trip" for p in effect.parameters)
