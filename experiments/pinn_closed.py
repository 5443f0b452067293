"""The kernel with a list of effects, by closed form on a vehicle's training rows; what networks take over from it.

Sizes are linear, or nearly, and have a closed form. A threshold (where a battery stops charging, how late a reading is)
is not: it is searched between closed forms of all else.
"""

import json
from collections.abc import Iterable, Mapping
from functools import cache
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from experiments.paper1_halves import fitted
from experiments.pinn_data import Data, Member
from hdev_jax.inference import Fit, effect_coefficients, padded, predict
from hdev_jax.learn.pinn import Sized
from hdev_jax.learn.pinn_rows import row_wise
from hdev_jax.physics import LIBRARY, Effect, Parameter, Vehicle, at_null, most_group

__all__ = ["Known", "kernel", "known", "said", "sized", "trainable"]

_ROUNDS = 5  # of a search: the threshold's grid, then each time a quarter of the steps about the best
_LEAST_GAIN = 10.0  # variances of the noise: what a threshold has to take off the sum of squares


def trainable(effects: Iterable[str]) -> tuple[str, ...]:
    """Those whose sizes a network may train: they have some, no threshold, and act within a row."""
    kinds = {e: {p.kind for p in LIBRARY[e].parameters} for e in effects}
    return tuple(e for e, k in kinds.items() if "size" in k and "limit" not in k and row_wise(LIBRARY[e]))


def sized(effects: Mapping[str, Mapping[str, float]]) -> tuple[Sized, ...]:
    """Effects by id as a network trains them: shapes as they are given, sizes that are not given are trained."""
    out = []
    for id, given in effects.items():
        kind = LIBRARY[id]
        groups = {"": 0, "road_surface": 4, "gear": 13}
        sizes = tuple((p.name, groups[p.by]) for p in kind.parameters if p.kind == "size" and p.name not in given)
        fixed = tuple((p.name, float(given.get(p.name, p.null))) for p in kind.parameters
                      if p.name not in dict(sizes))  # fmt: skip
        out.append(Sized(kind, sizes, fixed))
    return tuple(out)


def said(vehicle: Vehicle, m: Member) -> np.ndarray:
    """Energy of every row of a vehicle by the kernel [Wh]."""
    rows = padded(m.segments, m.energy_wh)
    return np.asarray(predict(vehicle, rows.segments, "energy_wh"))[: rows.rows]


def kernel(m: Member, effects: Mapping[str, Mapping[str, float]]) -> Vehicle:
    """The whole kernel, efficiency map included, with these effects; parameters that are not given are fitted to the
    training rows. A shape that is not given has its usual value."""
    train = m.where(0)
    segments, energy = m.segments.take(train), m.energy_wh[train]
    rows, row_s = padded(segments, energy), float(np.median(np.asarray(segments.duration_s)))
    car, table, searches = m.vehicle, m.table, []
    for id, given in effects.items():
        e = _as_given(id, given, m)
        car = car.plus(e)
        sizes = [p.name for p in e.parameters if p.kind == "size" and p.name not in given]
        by = tuple(p.by for p in e.parameters if p.by)
        groups = tuple(str(g) for g in range(1, most_group(m.segments, by) + 1))
        table = table.plus(*effect_coefficients(e, sizes, shapes=False, groups=groups))
        searches += [_Search(id, p, row_s) for p in e.parameters if p.kind == "limit" and p.name not in given]

    def fit(car: Vehicle) -> Vehicle:
        return table.insert(car, fitted(car, table, segments, energy, "energy_wh", paper=True).values)

    car = fit(car)
    for _ in range(_ROUNDS if searches else 0):
        for search in searches:
            car = search.best(car, rows)
        car = fit(car)
    return car


def _as_given(id: str, given: Mapping[str, float], m: Member) -> Effect:
    """An effect at what is given of its parameters, the others at their null values."""
    kind = LIBRARY[id]
    e = at_null(kind, gears=most_group(m.segments, tuple(p.by for p in kind.parameters if p.by)))
    for name, value in given.items():
        e = eqx.tree_at(lambda e, name=name: getattr(e, name), e, np.asarray(float(value)))
    return e


class _Search:
    """A threshold's values that are tried next: first its grid, then finer steps about the best of the last."""

    def __init__(self, id: str, p: Parameter, row_s: float):
        self.id, self.p = id, p
        self.span = [x * (row_s if p.in_rows else 1.0) for x in p.grid]

    def best(self, car: Vehicle, rows: Fit) -> Vehicle:
        """The vehicle with the value that leaves the least squares; with the null value if none takes off enough."""
        null = float(self.p.null)
        left = {x: self._left(car, x, rows) for x in (null, *self.span)}
        value = min(left, key=lambda x: left[x])
        noise = left[value] / float(np.sum(rows.weight))
        if value != null or self.p.smooth:
            self._finer(value, left)
        return self._at(car, value if left[null] - left[value] > _LEAST_GAIN * noise else null)

    def _finer(self, value: float, left: Mapping[float, float]) -> None:
        """Steps of a quarter about a value; as wide as before where it was the last that was tried on its side."""
        # where nothing changes smoothly at the null value, it is no neighbour of the others
        order = sorted(x for x in left if self.p.smooth or x != self.p.null)
        at, gaps = order.index(value), np.diff(order)
        step = float(np.max(gaps[max(at - 1, 0) : at + 1], initial=0.0))
        reach = step if 0 < at < len(order) - 1 else 4.0 * step
        self.span = list(np.clip(value + reach * np.linspace(-1, 1, 9), self.p.lower, self.p.upper))

    def _at(self, car: Vehicle, value: float) -> Vehicle:
        return eqx.tree_at(lambda c: getattr(c.effect(self.id), self.p.name), car, jnp.asarray(value))

    def _left(self, car: Vehicle, value: float, rows: Fit) -> float:
        off = rows.measured - predict(self._at(car, value), rows.segments, "energy_wh")
        return float(jnp.sum(rows.weight * off**2))


class Known(NamedTuple):
    """What networks take over from the closed form: a `vehicle`, as declared but with its thresholds that act within a
    row, and what effects that act across rows add to each row (`across_wh`)."""

    vehicle: Vehicle
    across_wh: np.ndarray


@cache
def known(data: Data, effects: str) -> tuple[Known, ...]:
    """Of each vehicle, what its training rows tell (`kernel`) of the effects that no network can train.

    A vehicle without such rows has the others' medians of thresholds, of a power for each kilogram of the declared
    mass, and nothing of what acts across rows. **Arguments:** `effects`, by id with what is given of their parameters,
    as JSON, so that the answer can be kept. Raises `InputError` where no vehicle has a training row.
    """
    data.trains()
    listed: dict[str, dict[str, float]] = json.loads(effects)
    across = [e for e in listed if not row_wise(LIBRARY[e])]
    within = [e for e in listed if e not in across and e not in trainable(listed)]
    names = [(e, p) for e in within for p in LIBRARY[e].parameters]
    needed = bool(names or across)
    fits = [kernel(m, listed) if needed and np.any(m.use == 0) else None for m in data.vehicles]
    found = np.array([
        [np.nan if f is None else float(getattr(f.effect(e), p.name)) / _unit(m, p) for e, p in names]
        for f, m in zip(fits, data.vehicles, strict=True)
    ])  # fmt: skip
    found = np.where(np.isnan(found), np.nanmedian(found, axis=0, keepdims=True) if names else found, found)
    out = []
    for m, f, own in zip(data.vehicles, fits, found, strict=True):
        values: dict[str, dict[str, Any]] = {e: {} for e in within}
        for (e, p), x in zip(names, own, strict=True):
            values[e][p.name] = jnp.asarray(x * _unit(m, p))
        moved = said(f, m) - said(f.minus(*across), m) if f is not None and across else np.zeros(len(m.energy_wh))
        out.append(Known(m.vehicle.plus(*(LIBRARY[e](**v) for e, v in values.items())), moved))
    return tuple(out)


def _unit(m: Member, p: Parameter) -> float:
    """What a parameter is told in for vehicles to be alike."""
    return float(m.vehicle.mass_kg) if p.unit == "W" else 1.0
