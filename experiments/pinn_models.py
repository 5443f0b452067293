"""What is compared on the same rows: tables, the paper's regression, trees, networks, the kernel with found effects."""

import json
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from experiments.paper1_halves import fitted
from experiments.pinn_data import Data, Member
from hdev_jax.inference import Fit, effect_coefficients, padded, predict
from hdev_jax.learn.pinn import Recipe, Sized
from hdev_jax.learn.pinn_fit import Ensemble, fit
from hdev_jax.learn.pinn_fit import Member as Seed
from hdev_jax.learn.pinn_rows import FEATURES, Rows, row_wise
from hdev_jax.learn.train import Plan
from hdev_jax.physics import LIBRARY, Parameter, Vehicle, at_null

__all__ = ["Known", "bayesian", "boosted", "kernel", "known", "names_of", "networks", "said", "sized", "trainable"]

_ZOOMS = 5  # of a threshold's search: its grid, then each time what is between two neighbours in eight steps


def names_of(features: str, data: Data) -> tuple[str, ...]:
    """A set of `FEATURES`, without those whose channels this data lacks."""
    have = data.vehicles[0].segments
    needs = {
        "wind_along": ("wind_speed_mps",), "wind_across": ("wind_speed_mps",), "wet": ("wet_road",),
        "surface_1": ("road_surface",), "surface_2": ("road_surface",), "surface_3": ("road_surface",),
        "cornering": ("curvature_1pm",), "temperature": ("ambient_temp_c",), "ambient_temp_c": ("ambient_temp_c",),
    }  # fmt: skip
    return tuple(n for n in FEATURES[features] if have.has(*needs.get(n, ())))


def thresholds(effects: Iterable[str]) -> tuple[str, ...]:
    """Those of the effects that have no size: where a battery or a drive begins to say no, how late a reading is."""
    return tuple(e for e in effects if not any(p.kind == "size" for p in LIBRARY[e].parameters))


def trainable(effects: Iterable[str]) -> tuple[str, ...]:
    """Those whose sizes a network may train: they have some, and act within a row."""
    listed = tuple(effects)
    return tuple(e for e in listed if e not in thresholds(listed) and row_wise(LIBRARY[e]))


def sized(effects: Mapping[str, Mapping[str, float]]) -> tuple[Sized, ...]:
    """Effects by id, with the shapes that they keep and the sizes that are left open; those without sizes apart."""
    out = []
    for id, shapes in effects.items():
        if id in thresholds(effects):
            continue
        kind = LIBRARY[id]
        groups = {"": 0, "road_surface": 4, "gear": 13}
        sizes = tuple((p.name, groups[p.by]) for p in kind.parameters if p.kind == "size" and p.name not in shapes)
        fixed = tuple((p.name, float(shapes.get(p.name, p.null))) for p in kind.parameters
                      if p.name not in dict(sizes))  # fmt: skip
        out.append(Sized(kind, sizes, fixed))
    return tuple(out)


def said(vehicle: Vehicle, m: Member) -> np.ndarray:
    """Energy of every row of a vehicle by the kernel [Wh]."""
    rows = padded(m.segments, m.energy_wh)
    return np.asarray(predict(vehicle, rows.segments, "energy_wh"))[: rows.rows]


def bayesian(m: Member) -> tuple[Vehicle, list[float]]:
    """The paper's regression on the training rows: the vehicle and its coefficients."""
    train = m.where(0)
    one = fitted(m.vehicle, m.table, m.segments.take(train), m.energy_wh[train], "energy_wh", paper=True)
    return m.table.insert(m.vehicle, one.values), [float(x) for x in one.values]


def kernel(m: Member, effects: Mapping[str, Mapping[str, float]]) -> Vehicle:
    """The whole kernel, efficiency map included, with these effects, by the closed form on the training rows.

    Thresholds, in which the energy is not linear, are searched between closed forms of all else.
    """
    car, table = m.vehicle, m.table
    for s in sized(effects):
        e = at_null(s.kind, gears=3 if any(n for _, n in s.sizes) else 1)
        for name, value in s.fixed:
            e = eqx.tree_at(lambda e, name=name: getattr(e, name), e, np.asarray(value))
        car = car.plus(e)
        table = table.plus(*effect_coefficients(e, [n for n, _ in s.sizes], shapes=False, groups=("1", "2", "3")))
    train = m.where(0)
    segments, energy = m.segments.take(train), m.energy_wh[train]

    def fit(car: Vehicle) -> Vehicle:
        return table.insert(car, fitted(car, table, segments, energy, "energy_wh", paper=True).values)

    car = car.plus(*(at_null(LIBRARY[e]) for e in thresholds(effects)))
    rows, row_s = padded(segments, energy), float(np.median(np.asarray(segments.duration_s)))
    open_ = [(e, p) for e in thresholds(effects) for p in LIBRARY[e].parameters if p.kind == "limit"]
    spans = [(p.null, *(x * (row_s if p.in_rows else 1.0) for x in p.grid)) for _, p in open_]
    car = fit(car)
    for _ in range(_ZOOMS if open_ else 0):
        for k, (id, p) in enumerate(open_):
            car, spans[k] = _searched(car, id, p, spans[k], rows)
        car = fit(car)
    return car


def _searched(
    car: Vehicle, id: str, p: Parameter, span: tuple[float, ...], rows: Fit
) -> tuple[Vehicle, tuple[float, ...]]:
    """The vehicle with the value of a threshold that leaves the least squares, and a finer span about it. The first of
    a span is the null value, away from all others but where the energy changes smoothly about it."""
    cars = [eqx.tree_at(lambda c: getattr(c.effect(id), p.name), car, jnp.asarray(value)) for value in span]
    left = [float(jnp.sum(rows.weight * (rows.measured - predict(c, rows.segments, "energy_wh")) ** 2)) for c in cars]
    best = int(np.argmin(left))
    if best == 0 and not p.smooth:
        return cars[0], span
    order = sorted(span if p.smooth else span[1:])
    at = order.index(span[best])
    low, high = order[max(at - 1, 0)], order[min(at + 1, len(order) - 1)]
    finer = tuple(float(x) for x in np.linspace(low, high, 9))
    return cars[best], finer if p.smooth else (p.null, *finer)


class Known(NamedTuple):
    """What networks take over from the closed form: a `vehicle` as declared, with the thresholds that act within a row,
    and what effects that act across rows add to each row (`moved_wh`)."""

    vehicle: Vehicle
    moved_wh: np.ndarray


@cache
def known(data: Data, effects: str) -> tuple[Known, ...]:
    """Of each vehicle, what its training rows tell (`kernel`) of the effects that no network can train.

    A vehicle without such rows has the others' medians of thresholds, of a power for each kilogram of the declared
    mass, and nothing of what acts across rows. **Arguments:** `effects`, by id with their shapes, as JSON, so that the
    answer can be kept.
    """
    listed = json.loads(effects)
    across = [e for e in listed if not row_wise(LIBRARY[e])]
    names = [(e, p) for e in thresholds(listed) if e not in across for p in LIBRARY[e].parameters]
    if not names and not across:
        return tuple(Known(m.vehicle, np.zeros(len(m.energy_wh))) for m in data.vehicles)
    fits = [kernel(m, listed) if np.any(m.use == 0) else None for m in data.vehicles]
    found = [
        [np.nan if f is None else float(getattr(f.effect(e), p.name)) / _unit(m, p) for e, p in names]
        for f, m in zip(fits, data.vehicles, strict=True)
    ]
    found = np.where(np.isnan(found), np.nanmedian(found, axis=0, keepdims=True), found)
    out = []
    for m, f, own in zip(data.vehicles, fits, found, strict=True):
        values: dict[str, dict[str, Any]] = {e: {} for e, _ in names}
        for (e, p), x in zip(names, own, strict=True):
            values[e][p.name] = jnp.asarray(x * _unit(m, p))
        moved = np.zeros(len(m.energy_wh)) if f is None else said(f, m) - said(f.minus(*across), m)
        out.append(Known(m.vehicle.plus(*(LIBRARY[e](**v) for e, v in values.items())), moved))
    return tuple(out)


def _unit(m: Member, p: Parameter) -> float:
    """What a threshold is told in for vehicles to be alike."""
    return float(m.vehicle.mass_kg) if p.unit == "W" else 1.0


def boosted(rows: Rows, use: np.ndarray, seed: int) -> np.ndarray:
    """LightGBM on the same features, stopped by the validation rows: energy of every row [Wh]."""
    import lightgbm as lgb

    x, y = np.asarray(rows.features), np.asarray(rows.energy_wh, float)
    train, held = lgb.Dataset(x[use == 0], y[use == 0]), lgb.Dataset(x[use == 1], y[use == 1])
    # one thread: beside other work, threads that wait for each other take ten times as long
    settings = {
        "objective": "regression", "learning_rate": 0.05, "num_leaves": 63, "min_data_in_leaf": 20, "verbosity": -1,
        "num_threads": 1, "seed": seed, "deterministic": True, "force_row_wise": True,
    }  # fmt: skip
    stop = [lgb.early_stopping(50, verbose=False)]
    model = lgb.train(settings, train, 2000, valid_sets=[held], callbacks=stop)
    return np.asarray(model.predict(x))


def networks(
    rows: Rows, use: np.ndarray, recipe: Recipe, data: Data, members: Sequence[tuple[int, Sequence[float]]], *,
    plan: Plan, rate: float, effects: tuple[Sized, ...],
) -> Ensemble:  # fmt: skip
    """Members by seed and weights, trained side by side on the training rows, kept at their best on the validation."""
    from hdev_jax import progress

    seeds = [Seed(s, (float(w[0]), float(w[1]), float(w[2]))) for s, w in members]

    def tell(epoch: int, loss: float, score: float) -> None:
        if epoch % 10 == 9:
            progress.step(f"epoch {epoch + 1}: loss {loss:.4g}, validation {score:.4g}")

    return fit(
        recipe, rows.take(use == 0), rows.take(use == 1), vehicles=data.trained, plan=plan, rate=rate,
        members=seeds, effects=effects, tell=tell,
    )  # fmt: skip
