"""Coefficients and sizes of networks that are not trained: what the rows of each vehicle say in closed form, vehicles
of one fleet being alike as far as their rows say so.

A vehicle alone hardly tells some things apart (drag and a rolling resistance that grows with v²). What is alike in all
vehicles (the second, over its usual size) is told by all of their rows, and then the first is known too.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from experiments.pinn_closed import closed
from experiments.pinn_data import Data, Member
from hdev_jax.errors import InputError
from hdev_jax.inference import Coefficient, LinearFit
from hdev_jax.inference.hierarchy import Sums, resembling
from hdev_jax.learn.pinn import Sized
from hdev_jax.learn.pinn_fit import Sizes
from hdev_jax.learn.pinn_loss import LOG_SD
from hdev_jax.physics import LIBRARY

__all__ = ["pooled", "sizes_of"]

_LOGS = ("road.c_rr", "road.cda_m2")
_LEAST_SHARE = 0.05  # of its table that a coefficient is, so that it has a logarithm


class _Unit(NamedTuple):
    """How the fleet's coefficients are told: as logarithms over their tables, or from null values, in usual sizes."""

    null: float
    size: float
    log: bool

    @classmethod
    def of(cls, m: Member, c: Coefficient) -> "_Unit":
        if c.path in _LOGS:
            e = m.vehicle.effect("rolling" if c.path == "road.c_rr" else "aero")
            return cls(float(e.c_rr if c.path == "road.c_rr" else e.cda_m2), LOG_SD, True)
        if not c.path.startswith("effects."):
            return cls(c.value, c.scale, False)
        _, id, name = c.path.split(".")
        p = next(p for p in LIBRARY[id].parameters if p.name == name)
        return cls(p.null, p.scale, False)

    def told(self, value: float) -> tuple[float, float]:
        """A value in these units, and how much of its own unit one of these is there."""
        if not self.log:
            return (value - self.null) / self.size, self.size
        value = max(value, _LEAST_SHARE * self.null)
        return float(np.log(value / self.null)) / self.size, value * self.size


def pooled(data: Data, effects: str) -> tuple[tuple[str, ...], np.ndarray]:
    """Coefficients by name, and each trained vehicle's value of them as networks tell them [vehicle, coefficient]:
    c_rr and C_d·A as logarithms over their tables, effects' sizes from their null value in usual sizes.

    One that has no training rows, or none that tell a coefficient, has what the fleet has of it. Arguments and errors
    are those of `closed`.
    """
    pairs = list(zip(data.vehicles[: data.trained], closed(data, effects), strict=False))
    fits = [(m, c.fit if c is not None else None) for m, c in pairs]
    names = tuple(dict.fromkeys(c.name for _, f in fits if f is not None for c in f.table.free))
    k = len(names)
    gram, moment = np.zeros((len(fits), k, k)), np.zeros((len(fits), k))
    seen = np.full((len(fits), k), np.nan)
    square = rows = 0.0
    for v, (m, f) in enumerate(fits):
        if f is not None:
            at = [names.index(c.name) for c in f.table.free]
            gram[np.ix_([v], at, at)], moment[v, at], left, seen[v, at] = _in_units(m, f)
            square, rows = square + left, rows + float(f.statistics.rows)
    apart = np.clip(np.nan_to_num(np.nanstd(seen, axis=0), nan=1.0), 0.02, 2.0)
    _, _, theta = resembling(Sums(gram, moment, square, rows), np.r_[np.log(apart), 0.0])
    return names, theta * np.where(np.isin(names, _LOGS), LOG_SD, 1.0)


def _in_units(m: Member, fit: LinearFit) -> tuple[np.ndarray, np.ndarray, float, np.ndarray]:
    """Σxxᵀ, Σxr and Σr² of a vehicle's rows about zero, in units of `_Unit` and in those of the noise of its
    rows; and what it says by itself."""
    values, noise = np.asarray(fit.values), float(fit.posterior.sigma)
    told = [_Unit.of(m, c).told(float(x)) for c, x in zip(fit.table.free, values, strict=True)]
    where, size = np.array(told).T
    step = size / np.asarray(fit.scale)
    here = fit.statistics.about(fit.posterior.mean)  # at what it says, where logarithms are straight
    gram = np.asarray(here.gram) * np.outer(step, step) / noise**2
    moment = np.asarray(here.moment) * step / noise**2
    square = float(here.square) / noise**2 + where @ (2.0 * moment + gram @ where)
    return gram, moment + gram @ where, float(square), where


def sizes_of(data: Data, effects: str, opened: tuple[Sized, ...]) -> Sizes:
    """Those of a network with the effects `opened`. Arguments and errors are those of `closed`; `InputError` where the
    closed form estimates what no network has."""
    names, theta = pooled(data, effects)
    if other := [n for n in names if n not in _LOGS and not n.startswith("effects.")]:
        raise InputError(f"sizes in closed form: {other[0]} is estimated, and no network has it; list auxiliary_power")
    place = {n: k for k, n in enumerate(names)}
    mean = theta.mean(axis=0)
    own = theta - mean

    def picked(values: np.ndarray, of: Sequence[str]) -> np.ndarray:
        return np.stack([values[..., place[n]] if n in place else np.zeros(values.shape[:-1]) for n in of], axis=-1)

    sizes, own_sizes = {}, {}
    for e in opened:
        for name, groups in e.sizes:
            path = f"{e.kind.id}.{name}"
            of = [f"effects.{path}[{g}]" for g in range(groups)] if groups else [f"effects.{path}"]
            both = picked(mean, of), picked(own, of)
            sizes[path], own_sizes[path] = both if groups else (both[0][0], both[1][:, 0])
    return Sizes(picked(mean, _LOGS), picked(own, _LOGS), sizes, own_sizes)
