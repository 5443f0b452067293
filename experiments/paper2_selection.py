"""Choices of the NARX, on trip 1 alone: orders, units and regularisation by blocks of time and the edge of the data.

The number that decides is the MSE of rows left out, one step ahead, of blocks and edge together. A setting is judged by
both rules that make one model of several starts: the start of least training loss, and the mean of all starts.
"""

from collections.abc import Iterator
from typing import Any, Literal

import jax
import numpy as np
from pydantic import Field

from experiments.config import Strict
from experiments.paper2_data import kia_fingerprint, kia_trips
from experiments.paper2_models import Settings, structure
from experiments.tables import write_tables
from hdev_jax.learn.selection import validated
from hdev_jax.rundir import Run

__all__ = ["SOURCES", "Config", "Group", "collect", "run", "tasks"]

SOURCES = ("paper2_selection.py", "paper2_models.py", "paper2_data.py")
RULES = ("least", "ensemble")


class Group(Strict):
    """What is tried of one model: each entry replaces keys of its settings.

    `decides`: whether the best entry is what the tables' model has to be; else it is shown beside it.
    """

    model: str
    tried: dict[str, dict[str, Any]]
    decides: bool = True


class Config(Strict):
    """Models of the tables, and what is tried of them."""

    experiment: Literal["paper2_selection"]
    artefact: str
    caption: str
    show: list[str] = Field(default_factory=list)
    order: list[str] = Field(default_factory=list)
    models: dict[str, Settings]
    groups: dict[str, Group]
    starts: int = 4
    blocks: int = 3
    steps: int = 80
    rows: int = 0
    train: str = "1"
    seed: int = 0


def tasks(config: Config) -> Iterator[dict[str, Any]]:
    """One for each entry."""
    for key, group in config.groups.items():
        for name, keys in group.tried.items():
            yield {
                "group": key, "name": name, "settings": _settings(config, group, keys), "starts": config.starts,
                "blocks": config.blocks, "steps": config.steps, "rows": config.rows, "train": config.train,
                "seed": config.seed, "data": kia_fingerprint(),
            }  # fmt: skip


def _settings(config: Config, group: Group, keys: dict[str, Any]) -> dict[str, Any]:
    """The settings that a structure and its loss are made of."""
    base = config.models[group.model].model_dump(mode="json")
    full = Settings.model_validate({**base, **keys}).model_dump(mode="json")
    return {k: full[k] for k in Settings.STRUCTURE}


def run(task: dict[str, Any]) -> dict[str, Any]:
    """Errors of rows left out, one step ahead."""
    trip, s = kia_trips(task["rows"] or None)[task["train"]], task["settings"]
    score = validated(
        structure(s), trip, key=jax.random.key(task["seed"]), count=task["starts"], blocks=task["blocks"],
        huber=s["huber_kw"] or np.inf, ridge={"size": s["ridge_size"], "slope": s["ridge_slope"]}, steps=task["steps"],
    )  # fmt: skip
    return {
        "least_mse": score.least, "ensemble_mse": score.ensemble, "mean_mse": score.mse,
        "median_mse": float(np.median(score.by_start)), "blocks_mse": score.blocks, "edge_mse": score.edge,
        "starts": len(score.by_start), "parameters": structure(s).shape.size,
    }  # fmt: skip


def collect(config: Config, results: Any, run: Run) -> dict[str, Any]:
    """In the order tried, with the best of each group, and whether the tables' model is that."""
    found = {(task["group"], task["name"]): (task, result) for task, result in results}
    rows, lines, missed = [], [], []
    for key, group in config.groups.items():
        own = {n: found[key, n] for n in group.tried if (key, n) in found}
        best = min(own, key=lambda n: _best(own[n][1])[0])
        rule = _best(own[best][1])[1]
        for name, (task, result) in own.items():
            chosen = name == best
            used = task["settings"] == _settings(config, group, {})
            rows.append({"name": f"{key}: {name}", "paper": None, "ours": {**result, "best": chosen, "used": used}})
            line = {"model": key, "tried": name, "one start": result["least_mse"], "all starts": result["ensemble_mse"]}
            line |= {k.replace("_mse", ""): result[k] for k in ("median_mse", "blocks_mse", "edge_mse")}
            lines.append({**line, "parameters": result["parameters"], "best": chosen, "in the tables": used})
            if chosen and group.decides and not used:
                missed.append(f"the tables' {group.model} is not {name}, the best on trip 1")
        declared = config.models[group.model].rule
        if group.decides and own[best][1]["starts"] > 1 and declared != rule:
            missed.append(f"the tables' {group.model} is {declared}, on trip 1 {rule} is better")
    write_tables(run, config.artefact.rpartition("/")[2], lines, config.caption)
    return {
        "artefact": config.artefact, "data": "kia_niro", "synthetic": False, "rows": rows,
        "better_than_paper": 0, "of": 0, "logs": 1, "missed": missed,
        "notes": [
            "The paper chose its orders on the trips that it validates with; here rows of trip 1 are left out instead, "
            "and no other trip is read",
        ],
    }  # fmt: skip


def _best(result: dict[str, Any]) -> tuple[float, str]:
    """The number that decides, and the rule that has it."""
    return min((result[f"{rule}_mse"], rule) for rule in RULES)
