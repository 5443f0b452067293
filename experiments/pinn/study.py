"""Paper 1, table 2 and figures 6 and 7, and the studies around them: networks with physics against what they must beat.

One task is one model on one fold of the data; of the vehicle-by-vehicle ones (tables, regression, the kernel with
diagnosed effects) one vehicle. Networks that differ in seed and loss weights alone train side by side in one program.
"""

import json
from collections.abc import Iterator, Sequence
from typing import Any, Literal

import numpy as np
from pydantic import Field

from experiments.pinn import pages as pinn_pages
from experiments.pinn import sweeps
from experiments.pinn.buses import bus_sources
from experiments.pinn.closed import kernel, said, trainable
from experiments.pinn.data import Data, load
from experiments.pinn.diagnosed import diagnosed, found_effects
from experiments.pinn.known import known, of_fleet
from experiments.pinn.models import bayesian, boosted, names_of, trained
from experiments.pinn.scores import scores
from experiments.runner.config import Strict
from experiments.runner.data import fingerprint
from hdev_jax.errors import InputError
from hdev_jax.learn.pinn.fit import PAPER_WEIGHTS
from hdev_jax.learn.pinn.model import Choices
from hdev_jax.physics import LIBRARY
from hdev_jax.rundir import Run

__all__ = ["SOURCES", "Config", "Model", "chosen", "collect", "run", "run_together", "tasks", "together"]

SOURCES = (
    "closed.py", "data.py", "diagnosed.py", "known.py", "models.py", "pooled.py", "scores.py", "buses.py",
    "../paper1/halves.py",
)  # fmt: skip


# frozen as `Choices` is: by the setting of `Strict`, which a type checker does not see
class Model(Strict, Choices):  # pyright: ignore[reportGeneralTypeIssues]
    """A row of the table. `kind`: what by vehicle needs no network (`vehicles`), LightGBM, or a network, whose recipe
    is made of these choices."""

    kind: Literal["vehicles", "lightgbm", "network"] = "network"
    like: str = ""  # another model of the config, of which this one is a delta
    features: Literal["printed", "channels", "unitless", "raw"] = "channels"
    # of the choices, what a config can get wrong; strict would refuse a list of TOML for a tuple
    units: tuple[int, ...] = Field(Choices.units, strict=False)
    dropout: float = Field(Choices.dropout, ge=0, lt=1)
    stretch: int = Field(Choices.stretch, ge=1)
    # as physics: those of the config, or what the diagnosis of its `diagnosed` vehicles finds
    effects: bool | Literal["diagnosed"] = False
    # what vehicles and the fleet have of coefficients and effects: trained, or what rows say in closed form
    sizes: Literal["trained", "closed form"] = "trained"
    weights: tuple[float, float, float] = Field(PAPER_WEIGHTS, strict=False)
    members: int = Field(1, ge=1)  # of an ensemble
    rate: float = Field(0.005, gt=0)
    batch: int = Field(1024, ge=1)


class Config(Strict):
    """Data, split, what is compared, and grids over seeds, loss weights and the amount of data."""

    experiment: Literal["pinn.study"]
    artefact: str
    caption: str
    data: Literal["fleet", "ztbus"] = "fleet"
    routes: int = 5000  # ztbus: missions of each bus, 0 for all
    variants: list[str] = Field(default_factory=lambda: ["all"])
    held_variants: list[str] = Field(default_factory=list)
    warmer_than_c: float | None = None
    folds: list[int] = Field(default_factory=lambda: [0])
    shares: list[float] = Field(default_factory=lambda: [1.0])
    models: dict[str, Model]
    only: list[str] = Field(default_factory=list)  # of the models; none: all
    grid_values: list[list[float]] = Field(default_factory=list)  # of λ₁, λ₂, λ₃: every pair, the third as printed
    seeds: list[int] = Field(default_factory=lambda: [0])
    effects: dict[str, dict[str, float]] = Field(default_factory=dict)
    diagnosed: list[str] = Field(default_factory=list)  # vehicles that the whole diagnosis is made of, or "all"
    epochs: int = 100
    patience: int = 5
    stop_after: int = 15
    page: Literal["table", "coefficients", "shares", "grid"] = "table"
    coefficient: Literal["c_rr", "cda_m2"] = "c_rr"
    paper: dict[str, dict[str, float]] = Field(default_factory=dict)
    seed: int = Field(1, ge=0)


def tasks(config: Config) -> Iterator[dict[str, Any]]:
    """By fold and share of the data: vehicles one by one, then models by seed and weights.

    **Raises:** `InputError`; `MissingDataError` where the data is of buses and is not there.
    """
    _checked(config)
    for fold in config.folds:
        for share in config.shares:
            data = {
                "kind": config.data, "seed": config.seed, "routes": config.routes, "held": config.held_variants,
                "share": share, "warmer_than": config.warmer_than_c, "fold": fold, "variants": config.variants,
            }  # fmt: skip
            if config.data == "ztbus":
                data["files"] = fingerprint(bus_sources(config.routes))
            for name, model in chosen(config).items():
                yield from _of_model(config, data, name, model)


def chosen(config: Config) -> dict[str, Model]:
    """The models of a config that are run, each with what it takes over from the one that it is like.

    **Raises:** `InputError` for a name that is no model's.
    """
    if config.grid_values and len(config.grid_values) != 3:
        raise InputError(
            f"config, key grid_values: values of λ₁, λ₂ and λ₃ are expected, found {len(config.grid_values)}"
        )
    for name in [*config.only, *(m.like for m in config.models.values() if m.like)]:
        if name not in config.models:
            raise InputError(f"config: no model {name!r}; it has {', '.join(config.models)}")

    def whole(model: Model, seen: tuple[str, ...]) -> dict[str, Any]:
        if model.like in seen:
            raise InputError(f"config: model {model.like!r} is like itself")
        base = whole(config.models[model.like], (*seen, model.like)) if model.like else {}
        return base | {k: getattr(model, k) for k in model.model_fields_set if k != "like"}

    names = config.only or list(config.models)
    return {name: Model(**whole(config.models[name], (name,))) for name in names}


def _checked(config: Config) -> None:
    """Raises `InputError` for what is not of the library, the fleet or the data."""
    for id, shapes in config.effects.items():
        if id not in LIBRARY:
            raise InputError(f"config, key effects: {id!r} is no effect of the library; see `hdev effects`")
        known = [p.name for p in LIBRARY[id].parameters]
        if odd := set(shapes) - set(known):
            raise InputError(f"config, key effects.{id}: {sorted(odd)[0]!r} is none of {', '.join(known)}")
    for name, m in chosen(config).items():
        if m.kind == "network" and m.sizes == "closed form" and not (m.coefficients == "free" and m.by_vehicle):
            raise InputError(
                f"config, model {name!r}: sizes in closed form want coefficients that are free, by vehicle"
            )
    named = [n for n, m in chosen(config).items() if m.effects == "diagnosed"]
    if named and not config.diagnosed:
        raise InputError(f"config: model {named[0]!r} has the effects of a diagnosis, key diagnosed names no vehicle")
    if config.data == "ztbus":
        if config.held_variants or config.warmer_than_c is not None or config.diagnosed:
            raise InputError("config: held_variants, warmer_than_c and diagnosed are of the fleet, data is ztbus")
        return
    from hdev_jax.fleet import VARIANTS

    known = [v.id for v in VARIANTS]
    for key, names in (("variants", config.variants), ("held_variants", config.held_variants),
                       ("diagnosed", config.diagnosed)):  # fmt: skip
        if names != ["all"] and (
            odd := [n for n in names if n not in known] or [n for n in names if names.count(n) > 1]
        ):
            raise InputError(
                f"config, key {key}: {odd[0]!r} is no variant, or there twice; they are {', '.join(known)}"
            )
    if config.folds != [0]:
        raise InputError("config, key folds: the fleet is split once, [0]; folds are of ztbus")


def _weights(config: Config, model: Model) -> list[tuple[float, ...]]:
    """Loss weights that a model is trained with."""
    if not config.grid_values:
        return [model.weights]
    found = []
    for i, j in ((0, 1), (0, 2), (1, 2)):
        for a in config.grid_values[i]:
            for b in config.grid_values[j]:
                w: list[float] = list(PAPER_WEIGHTS)
                w[i], w[j] = a, b
                found.append(tuple(w))
    return list(dict.fromkeys(found))


def _of_model(config: Config, data: dict[str, Any], name: str, model: Model) -> Iterator[dict[str, Any]]:
    task: dict[str, Any] = {"data": data, "name": name, "model": model.model_dump(mode="json", exclude={"like"})}
    if model.kind == "vehicles":
        for vehicle in _vehicles(config):
            known = config.diagnosed == ["all"] or (config.data == "fleet" and _id(config, vehicle) in config.diagnosed)
            yield {**task, "vehicle": vehicle, "effects": config.effects if model.effects is True else {},
                   "diagnose": known}  # fmt: skip
        return
    plan = {"epochs": config.epochs, "patience": config.patience, "stop_after": config.stop_after}
    task |= {**plan, "effects": config.effects if model.effects is True else {}}
    if model.effects == "diagnosed":
        task["diagnosed"] = config.diagnosed
    # LightGBM draws nothing here: its seeds would be alike
    for seed in config.seeds[: None if model.kind == "network" else 1]:
        for weights in _weights(config, model) if model.kind == "network" else [[]]:
            yield {**task, "seed": seed, "weights": list(weights)}


def _id(config: Config, vehicle: int) -> str:
    """The id of a vehicle by its place, those that are held out last."""
    from hdev_jax.fleet import VARIANTS

    ids = [v.id for v in VARIANTS if config.variants == ["all"] or v.id in config.variants]
    return sorted(ids, key=lambda i: i in config.held_variants)[vehicle]


def _vehicles(config: Config) -> list[int]:
    if config.data == "ztbus":
        return [0, 1]
    from hdev_jax.fleet import VARIANTS

    return list(range(len(VARIANTS) if config.variants == ["all"] else len(config.variants)))


def together(task: dict[str, Any]) -> str | None:
    """Networks that differ in seed and weights alone, ensembles apart."""
    if task["model"]["kind"] != "network" or task["model"]["members"] > 1:
        return None
    return json.dumps({k: v for k, v in task.items() if k not in ("seed", "weights")}, sort_keys=True)


def run(task: dict[str, Any]) -> dict[str, Any]:
    """Scores on rows that nothing was chosen on."""
    return run_together([task])[0]


def run_together(tasks: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The same for several that may train side by side."""
    task, d = tasks[0], tasks[0]["data"]
    data = load(d["kind"], d["seed"], d["routes"], tuple(d["held"]), d["share"], d["warmer_than"], d["fold"],
                tuple(d["variants"]))  # fmt: skip
    effects = data.shown(task.get("effects", {}))
    if "diagnosed" in task:
        effects = found_effects(data, tuple(task["diagnosed"]))
    tasks = [{**t, "effects": effects} for t in tasks]
    task = tasks[0]
    if task["model"]["kind"] == "vehicles":
        return [_by_vehicle(data, task)]
    names = names_of(task["model"]["features"], data)
    own = known(data, json.dumps(effects))
    rows, use = data.rows(names, trainable(effects), own)
    if task["model"]["kind"] == "lightgbm":
        return [{"lightgbm": scores(data, use, boosted(rows, use, t["seed"])), "counts": data.counts()} for t in tasks]
    out = trained(data, rows, use, tasks, Model(**task["model"]))
    if task["model"]["sizes"] == "closed form" and effects:
        of = zip(own, data.vehicles, strict=True)
        form = scores(data, use, np.concatenate([of_fleet(k, m) for k, m in of]))
        out = [r if "diverged" in r else {**r, "form": form} for r in out]
    return out


def _by_vehicle(data: Data, task: dict[str, Any]) -> dict[str, Any]:
    """The table, the paper's regression, and the kernel with what the diagnosis found on the training routes."""
    k = task["vehicle"]
    if k >= len(data.vehicles):
        return {}
    m = data.vehicles[k]
    one = np.ones(len(m.energy_wh))

    def scored(car: Any) -> dict[str, Any]:
        c = (car.effect("rolling").c_rr, car.effect("aero").cda_m2)
        return scores(data, m.use, said(car, m), only=k, c_rr=float(c[0]) * one, cda_m2=float(c[1]) * one)

    out: dict[str, Any] = {"vehicle": m.id, "tabular": scored(m.vehicle)}
    if not np.any(m.use == 0):
        return out
    out["bayesian"] = scored(bayesian(m)[0])
    if task["effects"]:
        out["kernel"] = scores(data, m.use, said(kernel(m, task["effects"]).vehicle, m), only=k)
    if task["diagnose"]:
        car, out["found"], out["coefficients"] = diagnosed(m, seed=0)
        out["diagnosed"] = scores(data, m.use, said(car, m), only=k)
    return out


def collect(config: Config, results: Sequence[tuple[dict[str, Any], dict[str, Any]]], run: Run) -> dict[str, Any]:
    """Tables and figures of the page that the config asks for."""
    pages = {"table": pinn_pages.table, "coefficients": pinn_pages.coefficients, "shares": sweeps.shares,
             "grid": sweeps.grid}  # fmt: skip
    return pages[config.page](config, results, run)
