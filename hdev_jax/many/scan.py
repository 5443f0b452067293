"""What a vehicle's log says of every effect that its model lacks, too little to name it alone: a size and its error.

The first-order estimate of each candidate with one size beside the fitted model, by generalised least squares, and its
standard error from trips left out in turn (`hdev_jax.diagnosis.scores`). Effects that the vehicle's own diagnosis named
are in the model, with their fitted sizes. Those of several sizes at once are not added up over vehicles.
"""

from typing import Any

import numpy as np

from hdev_jax.diagnosis.candidates.candidate import Candidate
from hdev_jax.diagnosis.diagnose import Outcome, training_of
from hdev_jax.diagnosis.scores.scores import score_all
from hdev_jax.diagnosis.settings import Settings
from hdev_jax.physics import LIBRARY
from hdev_jax.problem import Split

__all__ = ["FOUND", "key_of", "scan_of"]

FOUND = "found"  # in place of shapes: a size that the vehicle's own diagnosis fitted
LEAST_LEFT = 1e-3  # share of a column outside the fitted coefficients' span, below which no log tells it from them


def key_of(candidate: Candidate) -> str:
    """A candidate's name, the same for every vehicle: `tyre_warmup.size tau_s=900`."""
    shapes = " ".join(f"{n}={v:.6g}" for n, v in candidate.shapes)
    return f"{candidate.id}.{candidate.sizes[0]} {shapes}".strip()


def scan_of(outcome: Outcome, split: Split, settings: Settings) -> dict[str, dict[str, Any]]:
    """Size and standard error of each candidate, from its null, by its key (`key_of`).

    **Returns:** of each `id`, `value`, `sd`, `clusters` (how many trips, or blocks, it rests on), `left` (share of its
    column that the fitted coefficients do not hold). Empty where the model has loads with a state.
    """
    problem, fit = outcome.problem, outcome.fit
    if outcome.given is not None:
        return {}
    training, _ = training_of(problem, split, LIBRARY, settings)
    if outcome.found:
        fit = training.calibrate(fit.vehicle, fit.table)
    else:
        fit = training.calibrate(problem.vehicle, problem.table)
    scores = score_all(training, fit)
    evidence = scores.white
    squares = np.diag(evidence.totals()[0])[evidence.base : -1]
    out = {}
    for c in scores.source.candidates:
        one = len(c.columns) == 1 and c.groups[0] is None
        if not one or not squares[c.columns[0]] > 1e-20 or evidence.left(c.columns) < LEAST_LEFT:
            continue
        value, sd = (float(x[0]) for x in evidence.estimate(c))
        if np.isfinite(value) and np.isfinite(sd) and sd > 0:
            out[key_of(c)] = {
                "id": c.id, "value": value, "sd": sd, "clusters": evidence.rests_on(c), "left": evidence.left(c.columns)
            }  # fmt: skip
    for id_, parameters in outcome.found.items():
        for name, (value, sd, _) in parameters.items():
            p = next(p for p in LIBRARY[id_].parameters if p.name == name)
            if p.has_column and sd > 0 and np.isfinite(p.null):
                away = value - float(p.null)
                out[f"{id_}.{name} {FOUND}"] = {
                    "id": id_, "value": away, "sd": sd, "clusters": float(evidence.count), "left": 1.0
                }  # fmt: skip
    return out
