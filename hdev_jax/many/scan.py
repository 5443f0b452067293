"""The size and standard error of every effect that a vehicle's model lacks, to be pooled over vehicles.

Each candidate with one size is estimated to first order, in addition to the fitted model, by generalised least squares;
its standard error is a jackknife over trips (`hdev_jax.diagnosis.scores`). Effects that the vehicle's own diagnosis
named are in the model, with their fitted sizes. Candidates with several sizes are not pooled.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from hdev_jax.diagnosis.candidates.candidate import Candidate
from hdev_jax.diagnosis.diagnose import Outcome, training_of
from hdev_jax.diagnosis.scores.scores import score_all
from hdev_jax.diagnosis.settings import Settings
from hdev_jax.diagnosis.training import Training
from hdev_jax.inference import ParameterTable
from hdev_jax.physics import Effect, Vehicle
from hdev_jax.problem import Problem, Split

__all__ = ["FOUND", "key_of", "scan_beside", "scan_of"]

FOUND = "found"  # in place of shapes: a size that the vehicle's own diagnosis fitted
MANY = 1e3  # clusters of an error that has few clusters in it already


def key_of(candidate: Candidate) -> str:
    """A candidate's name, the same for every vehicle: `tyre_warmup.size tau_s=900`."""
    shapes = " ".join(f"{n}={v:.6g}" for n, v in candidate.shapes)
    return f"{candidate.id}.{candidate.sizes[0]} {shapes}".strip()


def scan_of(outcome: Outcome) -> dict[str, dict[str, Any]]:
    """Size (from its null) and standard error of each candidate, by its key (`key_of`), with the found effects in.

    **Returns:** of each `id`, `kind` ("size", or "limit": a switch, whose size is a share of its full difference),
    `value`, `sd`, `clusters` (how many trips, or blocks, it rests on). Empty where the model has loads with a state.
    """
    if outcome.given is not None:
        return {}
    vehicle = outcome.fit.vehicle if outcome.found else outcome.problem.vehicle
    table = outcome.fit.table if outcome.found else outcome.problem.table
    out = _scanned(outcome.training, vehicle, table)
    for id_, parameters in outcome.found.items():
        for name, (value, sd, _) in parameters.items():
            p = next((p for p in outcome.training.library[id_].parameters if p.name == name), None)
            if p is not None and p.has_column and sd > 0 and np.isfinite(p.null):
                away = value - float(p.null)
                out[f"{id_}.{name} {FOUND}"] = {
                    "id": id_, "kind": "size", "value": away, "sd": sd, "clusters": MANY
                }  # fmt: skip
    return out


def scan_beside(
    problem: Problem, split: Split, library: Mapping[str, type[Effect]], settings: Settings
) -> dict[str, dict[str, Any]]:
    """As `scan_of`, for a sheet that has the effects in it; it is calibrated with them."""
    training, _ = training_of(problem, split, library, settings)
    return _scanned(training, problem.vehicle, problem.table)


def _scanned(training: Training, vehicle: Vehicle, table: ParameterTable) -> dict[str, dict[str, Any]]:
    scores = score_all(training, training.calibrate(vehicle, table))
    evidence = scores.white
    squares = np.diag(evidence.totals()[0])[evidence.base : -1]
    out = {}
    for c in scores.source.candidates:
        one = len(c.columns) == 1 and c.groups[0] is None and not _of_own_trips(c)
        if not one or not squares[c.columns[0]] > 1e-20 or evidence.left(c.columns) < training.settings.absorbed:
            continue
        value, sd = (float(x[0]) for x in evidence.estimate(c))
        if np.isfinite(value) and np.isfinite(sd) and sd > 0:
            known = {"value": value, "sd": sd, "clusters": evidence.rests_on(c)}
            out[key_of(c)] = {"id": c.id, "kind": c.kind, **known}
    return out


def _of_own_trips(c: Candidate) -> bool:
    """Whether it compares trips of the one log with each other: another vehicle's have nothing to do with them."""
    return bool(c.by_trip) or any(p.name == "at_trip" for p in c.effect.parameters)
