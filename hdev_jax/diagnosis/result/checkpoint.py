"""A step of the competition as plain values and back, so that a run that was killed goes on where it stood."""

from collections.abc import Mapping
from dataclasses import asdict, replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from hdev_jax.diagnosis.candidates.candidate import Candidate, realised
from hdev_jax.diagnosis.candidates.unnamed import Factor, Term, describing
from hdev_jax.diagnosis.competition.state import Found, Hidden, State, Verdict
from hdev_jax.diagnosis.gates.rejection import Kind, Rejection
from hdev_jax.diagnosis.scores.evidence import Score
from hdev_jax.diagnosis.training import Training
from hdev_jax.inference import Calibration, Coefficient, ParameterTable
from hdev_jax.inference.states import Switching
from hdev_jax.physics import Effect, Vehicle

__all__ = ["from_plain", "to_plain"]

_FIT = ("values", "sd", "covariance", "predicted", "sigma", "inflation", "converged", "message", "steps")


def to_plain(state: State) -> dict[str, Any]:
    """Dicts, lists, numbers and arrays; the declared vehicle is not in it, `from_plain` takes it."""
    return {
        "table": [asdict(c) for c in state.fit.table.rows],
        "fit": {k: getattr(state.fit, k) for k in _FIT},
        "held": _held(state.fit.table, state.fit.vehicle).values(state.fit.vehicle),
        "found": [_found(f) for f in state.found],
        "terms": [
            {"factors": [asdict(f) for f in t.factors], "scale": t.scale, "values": t.values} for t in state.terms
        ],
        "verdicts": [{**vars(v), "rejection": _rejection(v.rejection)} for v in state.verdicts],
        "absorbs": {k: list(v) for k, v in state.absorbs.items()},
        "removed": {k: _rejection(v) for k, v in state.removed.items()},
        "refused": list(state.refused),
        "tested": list(state.tested),
        "trail": dict(state.trail),
        "finished": state.finished,
        "hidden": None
        if state.hidden is None
        else {"ids": list(state.hidden.ids), "model": dict(vars(state.hidden.model)), "on": state.hidden.on},
    }


def from_plain(plain: Mapping[str, Any], declared: Vehicle, training: Training) -> State:
    """The state again, its vehicle being the declared one with the effects found so far."""
    known = [None if row["known"] is None else tuple(map(float, row["known"])) for row in plain["table"]]
    table = ParameterTable(
        tuple(Coefficient(**{**row, "known": k}) for row, k in zip(plain["table"], known, strict=True))
    )
    found = tuple(_from_found(f, training.library) for f in plain["found"])
    terms = tuple(
        Term(tuple(Factor(**f) for f in t["factors"]), float(t["scale"]), t["values"]) for t in plain["terms"]
    )
    vehicle = declared.plus(*[realised(f.score.candidate, f.score.beta, gears=training.gears) for f in found])
    vehicle = vehicle.plus(*[describing(training.target)(np.asarray(1.0)) for _ in terms])
    fit = dict(plain["fit"])
    vehicle = _held(table, vehicle).insert(vehicle, jnp.asarray(plain["held"]))
    vehicle = table.insert(vehicle, jnp.asarray(fit["values"]))
    return State(
        Calibration(vehicle=vehicle, table=table, **fit),
        found,
        terms,
        tuple(Verdict(**{**v, "rejection": _from_rejection(v["rejection"])}) for v in plain["verdicts"]),
        dict(plain["absorbs"]),
        {k: _from_rejection(v) for k, v in plain["removed"].items()},
        tuple(plain["refused"]),
        tuple(plain["tested"]),
        dict(plain["trail"]),
        bool(plain["finished"]),
        _hidden(plain["hidden"]),
    )


def _hidden(plain: Mapping[str, Any] | None) -> Hidden | None:
    if plain is None:
        return None
    model: dict[str, Any] = {**plain["model"], "base_w": float(plain["model"]["base_w"])}
    return Hidden(tuple(plain["ids"]), Switching(**model), plain["on"])


def _held(table: ParameterTable, vehicle: Vehicle) -> ParameterTable:
    """The effects' held coefficients that the vehicle has, as a table: a limit may be held where it was not found."""

    def there(path: str) -> bool:
        _, id_, name = path.split(".")
        return vehicle.has(id_) and getattr(vehicle.effect(id_), name) is not None

    held = (c for c in table.rows if not c.free and c.path.startswith("effects.") and there(c.path))
    return ParameterTable(tuple(replace(c, free=True) for c in held))


def _rejection(r: Rejection) -> dict[str, Any]:
    return {"kind": str(r.kind), "numbers": dict(r.numbers)}


def _from_rejection(plain: Mapping[str, Any]) -> Rejection:
    return Rejection(Kind(plain["kind"]), dict(plain["numbers"]))


def _found(f: Found) -> dict[str, Any]:
    s, c = f.score, f.score.candidate
    return {
        "id": f.id, "q_value": f.q_value, "stability": f.stability, "alike": list(f.alike), "gain": f.gain,
        "between": f.between,
        "sizes": list(c.sizes), "groups": [-1 if g is None else g for g in c.groups], "kind": c.kind,
        "shapes": [[n, v] for n, v in c.shapes], "columns": list(c.columns), "beta": np.asarray(s.beta),
        "score": [s.gain, s.p_model, s.p_cluster, s.left_out_gain, s.left], "plain": s.plain,
    }  # fmt: skip


def _from_found(plain: Mapping[str, Any], library: Mapping[str, type[Effect]]) -> Found:
    groups = tuple(None if g < 0 else int(g) for g in plain["groups"])
    shapes = tuple((str(n), float(v)) for n, v in plain["shapes"])
    candidate = Candidate(
        library[plain["id"]], tuple(plain["sizes"]), groups, shapes, plain["kind"], tuple(plain["columns"])
    )
    score = Score(candidate, np.asarray(plain["beta"]), *map(float, plain["score"]), plain=bool(plain["plain"]))
    return Found(
        plain["id"], score, float(plain["q_value"]), float(plain["stability"]), tuple(plain["alike"]),
        float(plain["gain"]), bool(plain["between"]),
    )  # fmt: skip
