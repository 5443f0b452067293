"""The plain values of diagnosis.json, from the final state of the search."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy import stats

from hdev_jax.diagnosis.competition.state import Found, State, Verdict
from hdev_jax.diagnosis.gates.gates import MOST_IN_CLASS
from hdev_jax.diagnosis.gates.rejection import Kind, Rejection
from hdev_jax.diagnosis.remainder.remainder import Remainder
from hdev_jax.diagnosis.result import notes
from hdev_jax.diagnosis.result.coefficients import as_they_end, baseline_block
from hdev_jax.diagnosis.result.hidden import Given, state_block
from hdev_jax.diagnosis.result.intervals import Open
from hdev_jax.diagnosis.result.modes import mode_block
from hdev_jax.diagnosis.settings import Settings
from hdev_jax.diagnosis.training import Training
from hdev_jax.inference import Calibration, cluster_rows
from hdev_jax.physics import Choice, ModeChange, Parameter, StepChange
from hdev_jax.problem import Problem, Split, metrics

__all__ = ["parameters_of", "summarise"]

MOST_HINTED = 3


def _sized(value: float, error: float, clusters: int) -> dict[str, Any]:
    """A size with its uncertainty from few clusters: Student's t with `clusters` − 1 degrees of freedom.

    **Arguments:** `error`, the standard error jackknifed over clusters.

    **Returns:** `value`, the distribution's standard deviation `sd` (wider than the standard error; of three degrees
    of freedom where there are fewer, which have none) and the central `interval_90`.
    """
    half = error * float(stats.t.ppf(0.95, _freedom(clusters)))
    return {"value": value, "sd": error * _heavier(clusters), "interval_90": [value - half, value + half]}


def _freedom(clusters: int) -> int:
    return max(clusters - 1, 1)


def _heavier(clusters: int) -> float:
    """Standard deviation of Student's t over its scale."""
    freedom = max(_freedom(clusters), 3)
    return float(np.sqrt(freedom / (freedom - 2)))


def _opened(fitted: dict[str, Any], p: Parameter, left: Open, error: float | None, clusters: int) -> dict[str, Any]:
    """A parameter with the uncertainty that its effect's shapes or other size add, inside its plausible range: as
    `fitted`, with a wider interval where that is too narrow.

    `error`: its standard error where those are held; None where it was fitted with them or is one of them.
    """
    low, high = (fitted["value"] + x for x in left.interval(0.9, _freedom(clusters), error))
    inner = fitted.get("interval_90", [fitted["value"]] * 2)
    sd = max(fitted["sd"], left.error(error) * _heavier(clusters))
    within = np.clip([min(low, inner[0]), max(high, inner[1])], p.lower, p.upper).tolist()
    return {
        "value": fitted["value"],
        "sd": sd,
        "interval_90": [min(within[0], fitted["value"]), max(within[1], fitted["value"])],
    }


def parameters_of(f: Found, fit: Calibration, leeway: Mapping[str, Open], clusters: int) -> dict[str, dict[str, Any]]:
    """A found effect's parameters, each with value, sd, unit and, unless it is a choice, its 90 % interval.

    With an empty `leeway` these are the sheet's numbers, which belong together: what was held has an sd of 0. With the
    uncertainty from its shapes or its other size each number can be read by itself.
    """
    c = f.score.candidate
    prefix = f"effects.{f.id}."
    rows = [r for r in zip(fit.table.free, fit.values, fit.errors, strict=True) if r[0].path.startswith(prefix)]
    fitted = {row.path.removeprefix(prefix) for row, _, _ in rows}
    held = fitted <= set(c.sizes)
    parameters: dict[str, dict[str, Any]] = {}
    for row, value, sd in rows:
        name, error = row.name.removeprefix(prefix), float(sd)
        known = _sized(float(value), error, clusters)
        if name in leeway:
            known = _opened(known, c.parameter(name), leeway[name], error if held else None, clusters)
        parameters[name] = {**known, "unit": row.unit}
    for name, value in c.shapes:
        p = next((p for p in c.effect.parameters if p.name == name and name not in fitted), None)
        if p:
            now = getattr(fit.vehicle.effect(f.id), name)  # where it is held: a limit may have moved since it was found
            known = {"value": value if now is None else float(np.asarray(now)), "sd": 0.0}
            known = _opened(known, p, leeway[name], None, clusters) if name in leeway else known
            parameters[name] = {**known, "unit": p.unit}
    return parameters


def _effect_block(
    f: Found, fit: Calibration, leeway: Mapping[str, Open], before: float, after: float, clusters: int, most: int
) -> dict[str, Any]:
    c = f.score.candidate
    return {
        "id": f.id,
        "stage": c.effect.stage,
        "verdict": "one_of_class" if f.alike else "found",
        "parameters": parameters_of(f, fit, leeway, clusters),
        "equation": c.effect.equation,
        "separated_by": c.effect.separated_by,
        "q_value": f.q_value,
        "stability": f.stability,
        "test_rmse_before": before,
        "test_rmse_after": after,
        "indistinguishable_from": list(f.alike[:most]),
        "class_size": 1 + len(f.alike),
    }


def summarise(
    problem: Problem,
    split: Split,
    state: State,
    steps: list[Calibration],
    predicted: list[np.ndarray],
    left: Remainder,
    leeway: Mapping[str, Mapping[str, Open]],
    training: Training,
    given: Given | None = None,
) -> dict[str, Any]:
    """The contract's diagnosis.json. `leeway`: by effect and parameter, what is left open; `given`: the decoded states
    of loads that switch."""
    weight, y = problem.weight(), problem.measured
    train, test = problem.rows(split.train), problem.rows(split.test)

    def block(p: np.ndarray) -> dict[str, Any]:
        at = {problem.log.trip_names[i]: problem.rows([i]) for i in split.test}
        return {
            "train": metrics(y[train], p[train], weight[train]),
            "test": metrics(y[test], p[test], weight[test]),
            "test_by_trip": {k: metrics(y[m], p[m], weight[m]) for k, m in at.items()},
        }

    after = block(predicted[-1])
    if given:  # one step ahead, and given the decoded states
        seen = block(given.predicted)
        after |= {"one_step": metrics(y[test], given.ahead[test], weight[test]), "given_states": seen["test"],
                  "given_states_by_trip": seen["test_by_trip"]}  # fmt: skip
    rmse = [metrics(y[test], p[test], weight[test])["rmse"] for p in predicted]
    clusters = cluster_rows(problem.segments.take(train))
    effects = [
        {
            **_effect_block(f, steps[-1], leeway[f.id], rmse[k], rmse[k + 1], clusters.count, MOST_IN_CLASS),
            "order": k + 1,
            **({"state": state_block(problem, split, given, f.id)} if given and f.id in given.ids else {}),
            **({"modes": mode_block(problem, steps[-1])} if f.id == ModeChange.id else {}),
        }
        for k, f in enumerate(state.found)
    ]
    verdict = {
        (False, False): "nothing_missing",
        (True, False): "effects_found",
        (False, True): "unexplained_structure",
        (True, True): "effects_found_and_unexplained_structure",
    }[bool(effects), left.significant]
    candidates = [_candidate(v.id, v.score, v.q_value, v.rejection) for v in state.verdicts]
    considered = {c["id"] for c in candidates}
    for e in state.fit.vehicle.effects:  # in the vehicle already: listed with the candidates too
        if e.parameters and e.id not in considered:
            f = next((f for f in state.found if f.id == e.id), None)
            here = (f.gain, f.q_value, Kind.FOUND) if f else (None, 1.0, Kind.DECLARED)
            candidates.append(_candidate(e.id, *here[:2], Rejection(here[2])))
    return {
        "schema": "hdev-diagnosis/1",
        "target": problem.target,
        "split": {
            "train_trips": split.names(split.train),
            "test_trips": split.names(split.test),
            "unused_trips": split.names(split.unused),
        },
        "before": block(predicted[0]),
        "after": after,
        "baseline": {"parameters": baseline_block(steps[0], state.absorbs)},
        "coefficients": as_they_end(steps[-1], state, training.settings),
        "effects": effects,
        "candidates": candidates,
        "unexplained": {
            "significant": left.significant,
            "share_of_test_variance": left.share,
            "share_borne_out": left.confirmed,
            "noise_floor_rmse": left.noise_floor_rmse,
            "depends_on": list(left.depends_on),
            "signature": left.signature,
            "scales_with": left.scales_with,
            "correction": left.correction,
            "expression": left.expression,
            "behaves_like": left.behaves_like,
            "sd": left.sd,
            "memory_s": left.memory_s,
            "course": left.course,
        },
        "missing_channels": list(left.missing_channels),
        "not_decidable": _not_decidable(state.verdicts, left, training.settings),
        "verdict": verdict,
        "parameters_fitted": _fitted(state),
        "clusters": {"kind": clusters.kind, "count": clusters.count, "trips": len(split.train)},
        "subsets": _subsets(problem, test, predicted[0], predicted[-1]),
        "notes": [
            *problem.notes,
            *notes.warnings(steps, state, training.settings),
            *notes.known(problem, state, steps[-1], training, test, rmse[-1]),
            *notes.by_trip(problem, state),
            *(notes.of_last_vehicle(problem, train) if any(c["id"] == StepChange.id for c in candidates) else ()),
            *notes.odd_rows(problem, predicted[0], training.settings),
        ],
    }


def _candidate(id_: str, score: float | None, q_value: float, rejection: Rejection) -> dict[str, Any]:
    return {"id": id_, "score": score, "q_value": q_value, "kind": str(rejection.kind), "why_not": str(rejection)}


def _not_decidable(verdicts: Sequence[Verdict], left: Remainder, settings: Settings) -> list[dict[str, Any]]:
    """What more trips (or stretches of driving) would decide, the nearest of each kind first.

    Either it is significant by rows but not yet by clusters (rain in one trip), three at most; or random intercepts of
    trips are significant or suspected, and it differs between trips alone.
    """
    able = sorted((v for v in verdicts if v.needed is not None), key=lambda v: v.needed or 0)
    open_to_doubt = [v for v in able if v.by_rows or v.q_value < settings.half]
    hinted = [v for v in open_to_doubt if (v.score or 0.0) > settings.suspicious][:MOST_HINTED]
    listed = [*hinted, *(v for v in able if left.trips_differ and v.between and v not in hinted)]
    return [{"id": v.id, "clusters_needed": v.needed, "why_not": str(v.rejection)} for v in listed]


def _fitted(state: State) -> int:
    """Every fitted or grid-chosen number: free coefficients, and choices among more than one value."""
    choices = sum(
        len(p.grid) != 1
        for f in state.found
        for p in f.score.candidate.effect.parameters
        if isinstance(p, Choice) and any(p.name == n for n, _ in f.score.candidate.shapes)
    )
    by_trip = sum(len(x) for f in state.found for x in f.score.candidate.by_trip.values())
    return len(state.fit.table.free) + choices + by_trip


def _subsets(problem: Problem, test: np.ndarray, before: np.ndarray, after: np.ndarray) -> dict[str, Any]:
    """Errors on parts of the test rows: standing, moving, without friction brake."""
    s, weight = problem.segments, problem.weight()
    moving = np.asarray(s.speed_mps) > 2.0
    parts = {"standing still": np.asarray(s.speed_mps) < 0.1, "above 2 m/s": moving}
    if s.has("brake_pressure_pa") or s.has("brake_pedal_pct"):
        brake = np.asarray(s.get("brake_pressure_pa", s.get("brake_pedal_pct", 0.0)))
        off = brake < 0.005 * np.max(np.abs(brake))
        parts["above 2 m/s, friction brake off"] = moving & off
    y = problem.measured
    return {
        name: {k: metrics(y[m], p[m], weight[m]) for k, p in (("before", before), ("after", after))}
        for name, rows in parts.items()
        if (m := rows & test).sum() > 50
    }
