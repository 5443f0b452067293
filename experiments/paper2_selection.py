"""Choices of the NARX, on trip 1 alone: orders, units and regularisation by blocks of time and the edge of the data."""

from collections.abc import Iterator
from typing import Any

import jax
import numpy as np
from pydantic import Field

from experiments.config import Strict
from experiments.paper2 import Settings
from experiments.paper2_data import kia_trips
from experiments.paper2_fits import structure
from experiments.tables import write_tables
from hdev_jax.learn.selection import validated
from hdev_jax.rundir import Run

__all__ = ["SOURCES", "Config", "collect", "run", "tasks"]

SOURCES = ("paper2_selection.py", "paper2.py", "paper2_data.py", "paper2_fits.py")


class Config(Strict):
    """A base model and what is tried of it: each entry replaces keys of the base."""

    experiment: str
    artefact: str
    caption: str
    show: list[str] = Field(default_factory=list)
    order: list[str] = Field(default_factory=list)
    models: dict[str, Settings]
    model: str = "NARXP"
    tried: dict[str, dict[str, Any]]
    starts: int = 4
    blocks: int = 3
    rows: int = 0
    train: str = "1"
    seed: int = 1


def tasks(config: Config) -> Iterator[dict[str, Any]]:
    """One for each entry."""
    base = config.models[config.model].model_dump(mode="json", exclude={"why"})
    for name, keys in config.tried.items():
        settings = Settings.model_validate({**base, **keys}).model_dump(mode="json", exclude={"why"})
        yield {
            "name": name, "settings": settings, "starts": config.starts, "blocks": config.blocks, "rows": config.rows,
            "train": config.train, "seed": config.seed,
        }  # fmt: skip


def run(task: dict[str, Any]) -> dict[str, Any]:
    """Errors of rows left out, one step ahead."""
    trip, s = kia_trips(task["rows"] or None)[task["train"]], task["settings"]
    score = validated(
        structure(s), trip, key=jax.random.key(task["seed"]), count=task["starts"], blocks=task["blocks"],
        huber=s["huber_kw"] or np.inf, ridge={"size": s["ridge_size"], "slope": s["ridge_slope"]},
    )  # fmt: skip
    return {
        "mse": score.mse, "blocks_mse": score.blocks, "edge_mse": score.edge,
        "median_mse": float(np.median(score.by_start)), "parameters": structure(s).shape.size,
    }  # fmt: skip


def collect(config: Config, results: Any, run: Run) -> dict[str, Any]:
    """Ordered as tried."""
    lines = [{"tried": task["name"], "paper": None, **result} for task, result in results]
    write_tables(run, config.artefact.rpartition("/")[2], lines, config.caption)
    rows = [{"name": task["name"], "paper": None, "ours": result} for task, result in results]
    return {
        "artefact": config.artefact, "data": "kia_niro", "synthetic": False, "rows": rows,
        "better_than_paper": 0, "of": 0, "logs": 1, "skipped": [], "missed": [],
        "notes": ["the paper chose its orders on the validation trips; here rows of trip 1 are left out instead"],
    }  # fmt: skip
