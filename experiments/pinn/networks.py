"""Networks of one recipe, trained side by side, and how the mean of an ensemble scores on other rows."""

import json
from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import numpy as np

from experiments.pinn.closed import sized, trainable
from experiments.pinn.data import Data
from experiments.pinn.models import names_of, networks
from experiments.pinn.pooled import sizes_of
from experiments.pinn.scores import scores
from hdev_jax import progress
from hdev_jax.learn.pinn.model import C_RR_LIMIT, Choices, Recipe
from hdev_jax.learn.pinn.rows import Rows, energy, with_coefficients
from hdev_jax.learn.train import DivergedError, Plan

__all__ = ["trained"]

_LEAST_STEPS = 16  # of an epoch


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
