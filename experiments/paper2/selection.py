"""Choices of the NARX and of recurrent networks on trip 1 alone: by blocks of time and, of a NARX, the data's edge.

The number that decides is the MSE of rows left out, one step ahead, of all that is left out, as a mean over starts;
`choice.py` says which is best by it.
"""

from collections.abc import Iterator
from typing import Any, Literal

import jax
import numpy as np
from pydantic import Field

from experiments.paper2.choice import chosen_keys, collect
from experiments.paper2.data import TripName, kia_fingerprint, kia_trips
from experiments.paper2.fits import recurrent
from experiments.paper2.models import Settings, penalised, structure
from experiments.runner.config import Strict
from hdev_jax.errors import InputError
from hdev_jax.learn import Trip
from hdev_jax.learn.narx.selection import Score, by_blocks, validated

__all__ = ["SOURCES", "Config", "Group", "collect", "run", "tasks"]

SOURCES = ("models.py", "data.py", "fits.py")


class Group(Strict):
    """What is tried of one model: each entry replaces keys of its settings.

    `decides`: whether the best entry is what the tables' model has to be; else it is shown beside it.
    """

    model: str
    tried: dict[str, dict[str, Any]]
    decides: bool = True


class Config(Strict):
    """Models of the tables, and what is tried of them."""

    experiment: Literal["paper2.selection"]
    artefact: str
    caption: str
    models: dict[str, Settings]
    groups: dict[str, Group]
    only: list[str] = Field(default_factory=list)  # of the groups; none: all
    starts: int = Field(4, ge=1)
    blocks: int = Field(3, ge=2)
    steps: int = Field(80, ge=1)
    recurrent_starts: int = Field(2, ge=1)
    recurrent_steps: int = Field(1000, ge=1)
    rows: int = Field(0, ge=0)
    train: TripName = "1"
    seed: int = Field(0, ge=0)

    @property
    def picked(self) -> dict[str, Group]:
        """The groups that are asked for."""
        if odd := [name for name in self.only if name not in self.groups]:
            raise InputError(f"config, key only: no group {odd[0]!r}; there are {', '.join(self.groups)}")
        return {name: g for name, g in self.groups.items() if not self.only or name in self.only}


def tasks(config: Config) -> Iterator[dict[str, Any]]:
    """One for each entry."""
    for key, group in config.picked.items():
        for name, keys in group.tried.items():
            settings = chosen_keys(config.models[group.model], keys)
            recurs = settings.get("kind") == "recurrent"
            yield {
                "group": key, "name": name, "settings": settings, "blocks": config.blocks,
                "starts": config.recurrent_starts if recurs else config.starts,
                "steps": config.recurrent_steps if recurs else config.steps,
                "rows": config.rows, "train": config.train, "seed": config.seed, "data": kia_fingerprint(),
            }  # fmt: skip


def run(task: dict[str, Any]) -> dict[str, Any]:
    """Errors of rows left out, one step ahead."""
    trip, s = kia_trips(task["rows"] or None)[task["train"]], task["settings"]
    score, parameters = (_recurrent if s.get("kind") == "recurrent" else _narx)(task, trip)
    return {
        "least_mse": score.least, "ensemble_mse": score.ensemble, "mean_mse": score.mse,
        "median_mse": float(np.median(score.by_start)), "blocks_mse": score.blocks, "edge_mse": score.edge,
        "starts": len(score.by_start), "parameters": parameters,
    }  # fmt: skip


def _narx(task: dict[str, Any], trip: Trip) -> tuple[Score, int]:
    s = task["settings"]
    score = validated(
        structure(s), trip, key=jax.random.key(task["seed"]), count=task["starts"], blocks=task["blocks"],
        steps=task["steps"], **penalised(s),
    )  # fmt: skip
    return score, structure(s).shape.size


def _recurrent(task: dict[str, Any], trip: Trip) -> tuple[Score, int]:
    sizes = []

    def fit(without: np.ndarray) -> Any:
        s = {**task["settings"], "starts": task["starts"], "steps": task["steps"]}
        models = recurrent(s, trip, task["seed"], without).models
        sizes.append(models[0].parameters)
        return models

    return by_blocks(fit, trip, count=task["blocks"]), sizes[0]
