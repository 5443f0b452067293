"""A step of the competition as plain values and back, so that a run that was killed goes on where it stood."""

from collections.abc import Mapping
from dataclasses import fields, replace
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
from hdev_jax.physics import Vehicle

__all__ = ["from_plain", "to_plain"]

_TAG = "class:"  # which no id of an effect can be
# What a state is made of. A vehicle is not among it, nor an effect: they are made again.
_KEPT: dict[str, type] = {
    c.__name__: c
    for c in (
        Calibration, Candidate, Coefficient, Factor, Found, Hidden, ParameterTable, Rejection, Score, State, Switching,
        Term, Verdict,
    )
}  # fmt: skip


def to_plain(state: State) -> dict[str, Any]:
    """Dicts, lists, numbers and arrays; the declared vehicle is not in it, `from_plain` takes it."""
    return {**_plain(state), "held": _held(state.fit.table, state.fit.vehicle).values(state.fit.vehicle)}


def _plain(x: Any) -> Any:
    if _KEPT.get(type(x).__name__) is type(x):
        kept = {f.name: _plain(getattr(x, f.name)) for f in fields(x) if f.init and f.name != "vehicle"}
        return {_TAG: type(x).__name__, **kept}
    if isinstance(x, Mapping):
        return {k: _plain(v) for k, v in x.items()}
    if isinstance(x, tuple | list):
        return type(x)(map(_plain, x))
    return x.id if isinstance(x, type) else str(x) if isinstance(x, Kind) else x


def from_plain(plain: Mapping[str, Any], declared: Vehicle, training: Training) -> State:
    """The state again, its vehicle being the declared one with the effects found so far."""

    def back(x: Any) -> Any:
        if isinstance(x, tuple | list):
            return type(x)(map(back, x))
        if not isinstance(x, Mapping):
            return x
        values = {k: back(v) for k, v in x.items()}
        name = values.pop(_TAG, None)
        if name == "Candidate":
            values["effect"] = training.library[values["effect"]]
        elif name == "Rejection":
            values["kind"] = Kind(values["kind"])
        elif name == "Calibration":
            values["vehicle"] = declared  # its effects are put in below
        return values if name is None else _KEPT[name](**values)

    state: State = back({k: v for k, v in plain.items() if k != "held"})
    vehicle = declared.plus(*[realised(f.score.candidate, f.score.beta, gears=training.gears) for f in state.found])
    vehicle = vehicle.plus(*[describing(training.target)(np.asarray(1.0)) for _ in state.terms])
    vehicle = _held(state.fit.table, vehicle).insert(vehicle, jnp.asarray(plain["held"]))
    vehicle = state.fit.table.insert(vehicle, jnp.asarray(state.fit.values))
    return replace(state, fit=replace(state.fit, vehicle=vehicle))


def _held(table: ParameterTable, vehicle: Vehicle) -> ParameterTable:
    """The effects' held coefficients that the vehicle has, as a table: a limit may be held where it was not found."""

    def there(path: str) -> bool:
        _, id_, name = path.split(".")
        return vehicle.has(id_) and getattr(vehicle.effect(id_), name) is not None

    held = (c for c in table.rows if not c.free and c.path.startswith("effects.") and there(c.path))
    return ParameterTable(tuple(replace(c, free=True) for c in held))
