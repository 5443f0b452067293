"""What networks take over of each vehicle from its closed form and the fleet's: all that they do not train."""

import json
from functools import cache
from typing import Any

import jax.numpy as jnp
import numpy as np

from experiments.paper1.halves import MASS_SD
from experiments.pinn.closed import closed, opened, said, trainable
from experiments.pinn.data import Data, Known, Member, weighed
from experiments.pinn.pooled import fleet
from hdev_jax.learn.pinn.rows import row_wise
from hdev_jax.physics import LIBRARY, Parameter, Vehicle

__all__ = ["known", "of_fleet"]


@cache
def known(data: Data, effects: str) -> tuple[Known, ...]:
    """Of each vehicle, what its training rows tell (`kernel`) of the effects that no network can train.

    A vehicle without such rows has the others' medians of thresholds, of a power for each kilogram of the declared
    mass, and of how far trips' masses are apart; and nothing of what acts across rows. Arguments and errors are those
    of `closed`.
    """
    data.trains()
    listed: dict[str, dict[str, float]] = json.loads(effects)
    across = [e for e in listed if not row_wise(LIBRARY[e])]
    within = [e for e in listed if e not in across and e not in trainable(listed)]
    names = [(e, p) for e in within for p in LIBRARY[e].parameters]
    fits = closed(data, effects) if listed else (None,) * len(data.vehicles)
    alike = fleet(data, effects) if listed else None
    found = np.array([
        [np.nan if f is None else float(getattr(f.vehicle.effect(e), p.name)) / _unit(m, p) for e, p in names]
        for f, m in zip(fits, data.vehicles, strict=True)
    ])  # fmt: skip
    found = np.where(np.isnan(found), np.nanmedian(found, axis=0, keepdims=True) if names else found, found)
    told = [f.payload_sd for f in fits if f is not None and np.isfinite(f.payload_sd)]
    usual = float(np.median(told)) if told else MASS_SD * ("scale" in opened(listed, "mass_scale"))
    out = []
    for k, (m, f, own) in enumerate(zip(data.vehicles, fits, found, strict=True)):
        values: dict[str, dict[str, Any]] = {e: {} for e in within}
        for (e, p), x in zip(names, own, strict=True):
            values[e][p.name] = jnp.asarray(x * _unit(m, p))
        car = m.vehicle.plus(*(LIBRARY[e](**v) for e, v in values.items()))
        fitted = None if alike is None else alike.put(car, m, k, {e: listed[e] for e in trainable(listed)})
        whole = fitted or car
        moved, payload = np.zeros(len(m.use)), np.zeros(len(m.use))
        if f is None or np.isnan(f.payload_sd):  # of no trip
            loose = _loose(whole, m, usual)
        else:
            payload, loose = f.payload, np.where(m.use == 0, 0.0, _loose(whole, m, f.payload_sd))
        if f is not None and across:
            late = whole.plus(*(f.vehicle.effect(e) for e in across))
            moved = said(late, m, f.weighed(m)) - said(whole, m, f.weighed(m))
        out.append(Known(car, fitted, moved, payload, loose))
    return tuple(out)


def of_fleet(own: Known, m: Member) -> np.ndarray:
    """Energy of every row of a vehicle by the fleet's closed form alone [Wh], no network having a say."""
    return said(own.fitted or own.vehicle, m, weighed(m.segments, own.payload)) + own.across_wh


def _loose(car: Vehicle, m: Member, sd: float) -> np.ndarray:
    """What a mass that is by a share of `sd` higher adds to each row's energy [Wh]."""
    if sd == 0:
        return np.zeros(len(m.use))
    return said(car, m, weighed(m.segments, np.full(len(m.use), sd))) - said(car, m)


def _unit(m: Member, p: Parameter) -> float:
    """The unit in which a parameter is alike in all vehicles."""
    return float(m.vehicle.mass_kg) if p.unit == "W" else 1.0
