"""What is compared on the same rows: the paper's regression, trees, networks of one recipe trained side by side."""

import json
from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import numpy as np

from experiments.paper1.halves import fitted
from experiments.pinn.closed import sized, trainable
from experiments.pinn.data import Data, Member
from experiments.pinn.pooled import sizes_of
from experiments.pinn.scores import scores
from hdev_jax import progress
from hdev_jax.learn.pinn.fit import Ensemble, Sizes, fit
from hdev_jax.learn.pinn.fit import Member as Seed
from hdev_jax.learn.pinn.model import C_RR_LIMIT, Choices, Recipe, Sized
from hdev_jax.learn.pinn.rows import FEATURES, Rows, energy, with_coefficients
from hdev_jax.learn.train import DivergedError, Plan
from hdev_jax.physics import Vehicle

__all__ = ["bayesian", "boosted", "names_of", "networks", "trained"]

_LEAST_STEPS = 16  # of an epoch


def names_of(features: str, data: Data) -> tuple[str, ...]:
    """A set of `FEATURES`, without those whose channels this data lacks."""
    needs = {
        "wind_along": ("wind_speed_mps",), "wind_across": ("wind_speed_mps",), "wet": ("wet_road",),
        "surface_1": ("road_surface",), "surface_2": ("road_surface",), "surface_3": ("road_surface",),
        "wind_sine": ("wind_from_rad", "heading_rad"), "wind_cosine": ("wind_from_rad", "heading_rad"),
        "wind_speed_mps": ("wind_speed_mps",), "wet_road": ("wet_road",), "curvature_1pm": ("curvature_1pm",),
        "gear": ("gear",), "cornering": ("curvature_1pm",), "temperature": ("ambient_temp_c",),
        "ambient_temp_c": ("ambient_temp_c",),
    }  # fmt: skip
    return tuple(n for n in FEATURES[features] if all(m.segments.has(*needs.get(n, ())) for m in data.vehicles))


def bayesian(m: Member) -> tuple[Vehicle, list[float]]:
    """The paper's regression on the training rows: the vehicle and its coefficients."""
    train = m.where(0)
    one = fitted(m.vehicle, m.table, m.segments.take(train), m.energy_wh[train], "energy_wh", paper=True)
    return m.table.insert(m.vehicle, one.values), [float(x) for x in one.values]


def boosted(rows: Rows, use: np.ndarray, seed: int) -> np.ndarray:
    """LightGBM on the same features, stopped by the validation rows: energy of every row [Wh]. It learns the energy in
    the row's unit, the squares being of Wh all the same."""
    import lightgbm as lgb

    x, unit = np.asarray(rows.features), np.asarray(rows.unit, float)
    y, weight = np.asarray(rows.energy_wh, float) / unit, unit**2 / np.mean(unit[use == 0] ** 2)
    train, held = (lgb.Dataset(x[at], y[at], weight=weight[at]) for at in (use == 0, use == 1))
    # one thread: beside other work, threads that wait for each other take ten times as long
    settings = {
        "objective": "regression", "learning_rate": 0.05, "num_leaves": 63, "min_data_in_leaf": 20, "verbosity": -1,
        "num_threads": 1, "seed": seed, "deterministic": True, "force_row_wise": True,
    }  # fmt: skip
    stop = [lgb.early_stopping(50, verbose=False)]
    model = lgb.train(settings, train, 2000, valid_sets=[held], callbacks=stop)
    return unit * np.asarray(model.predict(x))


def networks(
    rows: Rows, use: np.ndarray, recipe: Recipe, data: Data, members: Sequence[tuple[int, Sequence[float]]], *,
    plan: Plan, rate: float, effects: tuple[Sized, ...], sizes: Sizes | None,
) -> Ensemble:  # fmt: skip
    """Members by seed and weights, trained side by side on the training rows, kept at their best on the validation."""
    seeds = [Seed(s, (float(w[0]), float(w[1]), float(w[2]))) for s, w in members]

    def tell(epoch: int, loss: float, score: float) -> None:
        if epoch % 10 == 9:
            progress.step(f"epoch {epoch + 1}: loss {loss:.4g}, validation {score:.4g}")

    return fit(
        recipe, rows.take(use == 0), rows.take(use == 1), vehicles=data.trained, plan=plan, rate=rate,
        members=seeds, effects=effects, sizes=sizes, tell=tell,
    )  # fmt: skip


def trained(
    data: Data, rows: Rows, use: np.ndarray, tasks: Sequence[dict[str, Any]], spec: Any
) -> list[dict[str, Any]]:
    """Of each task of the model `spec`, scores of its members' mean on test and unseen rows; or that all diverged."""
    choices = {f.name: getattr(spec, f.name) for f in fields(Choices)}
    recipe = Recipe(features=names_of(spec.features, data), **choices)
    # few rows: passes over the data count together, so that every epoch has as many steps as of many
    passes = max(1, -(-_LEAST_STEPS * spec.batch // max(1, int(np.sum(use == 0)))))
    epochs, patience, stop_after = (passes * tasks[0][k] for k in ("epochs", "patience", "stop_after"))
    plan = Plan(epochs, spec.batch, 0.5, patience, stop_after=stop_after)
    members = [(t["seed"] * 1000 + k, t["weights"]) for t in tasks for k in range(spec.members)]
    effects = tasks[0]["effects"]
    opened = sized({e: effects[e] for e in trainable(effects)})
    try:
        sizes = sizes_of(data, json.dumps(effects), opened) if spec.sizes == "closed form" else None
        ensemble = networks(rows, use, recipe, data, members, plan=plan, rate=spec.rate, effects=opened, sizes=sizes)
    except DivergedError as e:
        progress.step(f"{tasks[0]['name']}: {e}")
        return [{"diverged": True} for _ in tasks]
    shown = np.isin(use, (2, 3))
    picked, uses = rows.take(shown), use[shown]
    every = ensemble.predict(picked)
    out = []
    for i, _ in enumerate(tasks):
        at = range(i * spec.members, (i + 1) * spec.members)
        own = [every[j] for j in at if not ensemble.diverged[j]]
        if not own:
            out.append({"diverged": True})
            continue
        out.append(_scored(data, use, shown, picked, uses, own, recipe))
        ends = ensemble.trained.scores.reshape(len(members), -1)[i * spec.members]
        out[-1] |= {
            "counts": data.counts(),
            "effects": list(effects),
            "epochs": int(np.isfinite(ends).sum()),
            "still_better": bool(np.nanargmin(ends) == epochs - 1),
        }
    return out


def _scored(
    data: Data, use: np.ndarray, shown: np.ndarray, picked: Any, uses: np.ndarray, own: Sequence[Any], recipe: Recipe
) -> dict[str, Any]:
    """Of an ensemble: its prediction, its physics alone; how near the bounds its coefficients are."""

    def whole(x: np.ndarray) -> np.ndarray:
        full = np.full(len(use), np.nan)
        full[shown] = x
        return full

    mean = {k: np.mean([np.asarray(getattr(p, k), float) for p in own], axis=0)
            for k in ("energy_wh", "physics_wh", "c_rr", "cda_m2")}  # fmt: skip
    noise = np.mean([np.asarray(p.sd_wh, float) ** 2 for p in own], axis=0)
    sd = np.sqrt(noise + np.var([p.energy_wh for p in own], axis=0))
    out: dict[str, Any] = {}
    both: dict[str, Any] = {"c_rr": whole(mean["c_rr"]), "cda_m2": whole(mean["cda_m2"])}
    if recipe.coefficients == "table":
        both = {}
    out["network"] = scores(data, use, whole(mean["energy_wh"]), sd_wh=whole(sd), **both)
    if recipe.coefficients != "table" or recipe.predicted != "alone":
        physics = mean["physics_wh"] if recipe.physics == "battery" else _at_battery(picked, mean)
        out["physics"] = scores(data, use, whole(physics), **both)
    if recipe.coefficients == "bounded" and np.any(uses == 2):
        out["at_bound"] = _at_bound(recipe, np.asarray(picked.cda_m2), own, uses == 2)
    return out


def _at_bound(recipe: Recipe, table: np.ndarray, own: Sequence[Any], at: np.ndarray) -> dict[str, int]:
    """Of the rows `at`, over all members: how many predictions there are, and how many are within 1 % of the range of
    either bound of each coefficient."""
    ranges = {"c_rr": (0.0, C_RR_LIMIT), "cda_m2": (1.0 - recipe.clamp, 1.0 + recipe.clamp)}
    out = {"rows": len(own) * int(at.sum()), "c_rr": 0, "cda_m2": 0}
    for p in own:
        for name, x in (("c_rr", np.asarray(p.c_rr)), ("cda_m2", np.asarray(p.cda_m2) / table)):
            low, high = ranges[name]
            near = 0.01 * (high - low)
            out[name] += int(np.sum((x[at] <= low + near) | (x[at] >= high - near)))
    return out


def _at_battery(rows: Any, mean: dict[str, np.ndarray]) -> np.ndarray:
    """Battery energy with coefficients that were learned against the energy at the wheels."""
    car = with_coefficients(rows.car, np.asarray(mean["c_rr"], np.float32), np.asarray(mean["cda_m2"], np.float32))
    return np.asarray(energy(car, rows.segments) + rows.across_wh, float)
