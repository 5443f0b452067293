"""A step of the loop as plain values and back, so that a run that was killed goes on where it stood."""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import jax.numpy as jnp
import numpy as np

from hdev_jax.diagnosis.candidates.candidate import Candidate, realised
from hdev_jax.diagnosis.scores.evidence import Score
from hdev_jax.diagnosis.scores.look import Found, Search, Verdict
from hdev_jax.inference import Calibration, Coefficient, ParameterTable
from hdev_jax.physics import Effect, Vehicle

__all__ = ["from_plain", "to_plain"]

_FIT = ("values", "sd", "covariance", "predicted", "sigma", "inflation", "converged", "message", "steps")


def to_plain(state: Search) -> dict[str, Any]:
    """Dicts, lists, numbers and arrays; the declared vehicle is not in it, `from_plain` is given it again."""
    return {
        "table": [asdict(c) for c in state.table.rows],
        "fit": {k: getattr(state.fit, k) for k in _FIT},
        "found": [_found(f) for f in state.found],
        "verdicts": [asdict(v) for v in state.verdicts],
        "absorbs": {k: list(v) for k, v in state.absorbs.items()},
        "taken_out": list(state.taken_out),
        "exchanged": list(state.exchanged),
        "refused": list(state.refused),
        "trail": state.trail,
        "finished": state.finished,
    }


def from_plain(plain: Mapping[str, Any], declared: Vehicle, library: Mapping[str, type[Effect]], gears: int) -> Search:
    """The state again, its vehicle being the declared one with the effects found so far."""
    told = [None if row["told"] is None else tuple(map(float, row["told"])) for row in plain["table"]]
    table = ParameterTable(
        tuple(Coefficient(**{**row, "told": t}) for row, t in zip(plain["table"], told, strict=True))
    )
    found = [_score(f, library) for f in plain["found"]]
    vehicle = declared.plus(*[realised(f.score.candidate, f.score.beta, gears=gears) for f in found])
    fit = dict(plain["fit"])
    vehicle = table.insert(vehicle, jnp.asarray(fit["values"]))
    calibration = Calibration(vehicle=vehicle, table=table, **fit)
    verdicts = [Verdict(**v) for v in plain["verdicts"]]
    absorbs, out = dict(plain["absorbs"]), tuple(plain["taken_out"])
    return Search(
        vehicle,
        table,
        calibration,
        found,
        verdicts,
        absorbs,
        out,
        tuple(plain["exchanged"]),
        tuple(plain["refused"]),
        dict(plain["trail"]),
        bool(plain["finished"]),
    )


def _found(f: Found) -> dict[str, Any]:
    s, c = f.score, f.score.candidate
    return {
        "id": f.id, "q_value": f.q_value, "stability": f.stability, "twins": list(f.twins), "gain": f.gain,
        "between": f.between, "alike": f.alike,
        "sizes": list(c.sizes), "groups": [-1 if g is None else g for g in c.groups], "kind": c.kind,
        "shapes": [[n, v] for n, v in c.shapes], "columns": list(c.columns), "beta": np.asarray(s.beta),
        "score": [s.gain, s.p_model, s.p_cluster, s.left_out_gain, s.left], "plain": s.plain,
    }  # fmt: skip


def _score(plain: Mapping[str, Any], library: Mapping[str, type[Effect]]) -> Found:
    groups = tuple(None if g < 0 else int(g) for g in plain["groups"])
    shapes = tuple((str(n), float(v)) for n, v in plain["shapes"])
    candidate = Candidate(
        library[plain["id"]], tuple(plain["sizes"]), groups, shapes, plain["kind"], tuple(plain["columns"])
    )
    score = Score(candidate, np.asarray(plain["beta"]), *map(float, plain["score"]), plain=bool(plain["plain"]))
    return Found(
        plain["id"],
        score,
        float(plain["q_value"]),
        float(plain["stability"]),
        tuple(plain["twins"]),
        plain["gain"],
        bool(plain["between"]),
        int(plain["alike"]),
    )
