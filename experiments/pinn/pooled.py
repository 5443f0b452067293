"""Coefficients and sizes of networks that are not trained: what the rows of each vehicle say in closed form, vehicles
of one fleet being alike as far as their rows say so.

A vehicle alone hardly distinguishes some things (drag, and a rolling resistance that grows with v²). What is alike in
all vehicles (the second, over its usual size) is estimated from all of their rows, and then the first is known too.
Rows count as independent, and the sheets' own sds are not used: how far tables are off is learned from the fleet.
"""

import json
from collections.abc import Mapping, Sequence
from functools import cache
from typing import NamedTuple

import numpy as np

from experiments.pinn.closed import Closed, closed, listed, trainable
from experiments.pinn.data import Data, Member
from hdev_jax import progress
from hdev_jax.errors import InputError
from hdev_jax.inference import Coefficient
from hdev_jax.inference.posterior.hierarchy import Sums, resembling
from hdev_jax.learn.pinn.fit import Sizes
from hdev_jax.learn.pinn.loss import LOG_SD
from hdev_jax.learn.pinn.model import Sized
from hdev_jax.physics import LIBRARY, Vehicle

__all__ = ["Fleet", "fleet", "sizes_of"]

_LOGS = ("road.c_rr", "road.cda_m2")
_LEAST_SHARE = 0.05  # of its table that a coefficient is, so that it has a logarithm
_PASSES = 5  # linearisations, the first at the tables; products (mass and rolling resistance) settle in a few


class _Unit(NamedTuple):
    """The units of the fleet's coefficients: as logarithms over their tables, or from null values, in usual sizes."""

    null: float
    size: float
    log: bool

    @classmethod
    def of(cls, m: Member, c: Coefficient) -> "_Unit":
        if c.path in _LOGS:
            e = m.vehicle.effect("rolling" if c.path == "road.c_rr" else "aero")
            return cls(float(e.c_rr if c.path == "road.c_rr" else e.cda_m2), LOG_SD, True)
        _, id, name = c.path.split(".")
        p = next(p for p in LIBRARY[id].parameters if p.name == name)
        return cls(p.null, p.scale, False)

    def scaled(self, value: float) -> tuple[float, float]:
        """A value in these units, and how much of its own unit one of these is there."""
        if not self.log:
            return (value - self.null) / self.size, self.size
        value = max(value, _LEAST_SHARE * self.null)
        return float(np.log(value / self.null)) / self.size, value * self.size

    def value(self, scaled: float) -> float:
        """The value of a number in these units."""
        return self.null * float(np.exp(self.size * scaled)) if self.log else self.null + self.size * scaled


class Fleet(NamedTuple):
    """Coefficients by name, and of each trained vehicle its value in units of `_Unit` [vehicle, coefficient]. One that
    has no training rows, or none that tell a coefficient, has what the fleet has of it."""

    names: tuple[str, ...]
    theta: np.ndarray

    def put(self, car: Vehicle, m: Member, number: int, effects: Mapping[str, Mapping[str, float]]) -> Vehicle:
        """A vehicle with these effects, all as vehicle `number` has them; past the trained ones as their medians."""
        own = self.theta[number] if number < len(self.theta) else np.median(self.theta, axis=0)
        given = dict(zip(self.names, own, strict=True))
        whole, table = listed(m, effects)
        car = car.plus(*(whole.effect(id) for id in effects))
        table = table.with_free(**{c.name: c.name in given for c in table.free})
        return table.insert(car, np.array([_Unit.of(m, c).value(given[c.name]) for c in table.free]))


@cache
def fleet(data: Data, effects: str) -> Fleet:
    """What vehicles that resemble say together of what networks have: c_rr, C_d·A and the effects that they could
    train, all else being as each vehicle's closed form has it. Arguments and errors are those of `closed`."""
    kept = (*_LOGS, *(f"effects.{id}." for id in trainable(json.loads(effects))))
    pairs = list(zip(data.vehicles[: data.trained], closed(data, effects), strict=False))
    values = [np.zeros(0) if c is None else np.array(c.fit.values) for _, c in pairs]
    places, names = [], {}
    for m, c in pairs:
        free = () if c is None else c.fit.table.free
        mine = [(i, x) for i, x in enumerate(free) if x.path.startswith(kept)]
        places.append([(i, names.setdefault(x.name, len(names)), _Unit.of(m, x)) for i, x in mine])
    alone = np.full((len(pairs), len(names)), np.nan)
    for v, at in enumerate(places):
        for i, j, unit in at:
            alone[v, j] = unit.scaled(values[v][i])[0]
            values[v][i] = unit.value(0.0)  # what a few rows say alone may be anything; products of that more so
    spread = np.log(np.clip(np.nan_to_num(np.nanstd(alone, axis=0), nan=1.0), 0.02, 2.0))
    for _ in range(_PASSES):
        found = resembling(_sums(pairs, values, places, len(names)), np.r_[spread, 0.0])
        spread = np.log(found.spread)
        for v, at in enumerate(places):
            for i, j, unit in at:
                values[v][i] = unit.value(found.theta[v, j])
    if not found.converged:
        progress.step("closed form of the fleet: how far vehicles are apart has not settled")
    return Fleet(tuple(names), found.theta)


def _sums(
    pairs: Sequence[tuple[Member, Closed | None]],
    values: Sequence[np.ndarray],
    places: Sequence[Sequence[tuple[int, int, _Unit]]],
    k: int,
) -> Sums:
    """Σxxᵀ, Σxr and Σr² of each vehicle's rows about zero, in units of `_Unit` and in those of the noise of its rows,
    linearised at `values`. `places`: of each coefficient its place in the vehicle's and in the fleet's, and its unit.
    """
    gram, moment = np.zeros((len(pairs), k, k)), np.zeros((len(pairs), k))
    square = rows = 0.0
    for v, (m, c) in enumerate(pairs):
        if c is None:
            continue
        fit, noise = c.again(m, values[v]), float(c.fit.posterior.sigma)
        mine, at = [i for i, _, _ in places[v]], [j for _, j, _ in places[v]]
        where, size = np.array([unit.scaled(float(fit.at[i])) for i, _, unit in places[v]]).T
        step = size / np.asarray(fit.scale)[mine]
        here = np.asarray(fit.statistics.gram)[np.ix_(mine, mine)] * np.outer(step, step) / noise**2
        slope = np.asarray(fit.statistics.moment)[mine] * step / noise**2
        gram[np.ix_([v], at, at)], moment[v, at] = here, slope + here @ where
        square += float(fit.statistics.square) / noise**2 + float(where @ (2.0 * slope + here @ where))
        rows += float(fit.statistics.rows)
    return Sums(gram, moment, square, rows)


def sizes_of(data: Data, effects: str, opened: tuple[Sized, ...]) -> Sizes:
    """Those of a network with the effects `opened`. Arguments and errors are those of `closed`; `InputError` where the
    closed form estimates what no network has."""
    for c in closed(data, effects):
        for x in () if c is None else c.fit.table.free:
            if x.path not in _LOGS and not x.path.startswith("effects."):
                raise InputError(
                    f"sizes in closed form: {x.name} is estimated, and no network has it; list auxiliary_power"
                )
    names, theta = fleet(data, effects)
    theta = theta * np.where(np.isin(names, _LOGS), LOG_SD, 1.0)  # networks tell plain logarithms
    place = {n: k for k, n in enumerate(names)}
    mean = theta.mean(axis=0)
    own = theta - mean

    def picked(values: np.ndarray, name: str) -> np.ndarray:
        """0 for a group (a surface, a gear) that no row is of."""
        return values[..., place[name]] if name in place or "[" not in name else np.zeros(values.shape[:-1])

    def both(of: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
        return np.stack([picked(mean, n) for n in of]), np.stack([picked(own, n) for n in of], axis=-1)

    sizes, own_sizes = {}, {}
    for e in opened:
        for name, groups in e.sizes:
            path = f"{e.kind.id}.{name}"
            if groups:
                sizes[path], own_sizes[path] = both([f"effects.{path}[{g}]" for g in range(groups)])
            else:
                sizes[path], own_sizes[path] = picked(mean, f"effects.{path}"), picked(own, f"effects.{path}")
    return Sizes(*both(_LOGS), sizes, own_sizes)
