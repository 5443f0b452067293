"""The accelerator pedal as a third input (paper 2, section III-C). Only trip 1 has it, so the trip is split: trained on
its first two thirds, judged on its last; the paper judged on trips that the public files hold no pedal of.
"""

import time
from collections.abc import Iterator
from typing import Any, Literal

import numpy as np
from pydantic import Field

from experiments.paper2.data import kia_fingerprint, kia_trips
from experiments.paper2.diagnosed import diagnosis_key
from experiments.paper2.fits import evaluated, fitted
from experiments.paper2.models import Settings
from experiments.runner.config import Strict
from experiments.runner.tables import readable, write_tables
from hdev_jax.rundir import Run

__all__ = ["SOURCES", "Config", "alone", "collect", "run", "tasks"]

SOURCES = ("models.py", "data.py", "fits.py")


class Config(Strict):
    """One model, with the pedal among its inputs and without."""

    experiment: Literal["paper2.pedal"]
    artefact: str
    caption: str
    model: str = "NARXP"
    models: dict[str, Settings]
    share: float = Field(2 / 3, gt=0, lt=1)  # of trip 1, to train on
    paper: dict[str, dict[str, float]] = Field(default_factory=dict)
    rows: int = Field(0, ge=0)
    seed: int = Field(0, ge=0)


def tasks(config: Config) -> Iterator[dict[str, Any]]:
    """Without the pedal, then with it."""
    settings = config.models[config.model].task()
    for inputs in (settings["inputs"], [*settings["inputs"], "accelerator_pct"]):
        task = {"settings": {**settings, "inputs": inputs}, "share": config.share}
        yield {
            **task,
            **diagnosis_key(settings),
            "rows": config.rows,
            "seed": config.seed,
            "data": kia_fingerprint("1"),
        }


def alone(task: dict[str, Any]) -> bool:
    """Both are timed against each other."""
    return True


def run(task: dict[str, Any]) -> dict[str, Any]:
    """Errors on the part of trip 1 that was left out, for every start."""
    trip = kia_trips(task["rows"] or None, only="1")["1"]
    cut = int(task["share"] * len(trip))
    fitted(task["settings"], trip.part(0, cut), task["seed"])  # compiled: the time below is of the fit alone
    started = time.perf_counter()
    models = fitted(task["settings"], trip.part(0, cut), task["seed"]).models
    seconds = time.perf_counter() - started
    left = trip.part(cut, len(trip))
    every = [evaluated(m, left) for m in models]
    return {**every[0], "median_mse": float(np.median([e["step_mse"] for e in every])), "fit_seconds": seconds}


def collect(config: Config, results: Any, run: Run) -> dict[str, Any]:
    """The change that the pedal makes, beside the paper's."""
    without, with_pedal = (result for _, result in results)
    change = {
        "mse_change_percent": 100 * (with_pedal["step_mse"] / without["step_mse"] - 1),
        "median_mse_change_percent": 100 * (with_pedal["median_mse"] / without["median_mse"] - 1),
        "time_change_percent": 100 * (with_pedal["fit_seconds"] / without["fit_seconds"] - 1),
        "mse_without": without["step_mse"], "mse_with": with_pedal["step_mse"],
        "pe_without": without["step_pe"], "pe_with": with_pedal["step_pe"],
    }  # fmt: skip
    paper = config.paper.get("pedal", {})
    lines = [
        {"number": readable(k), "paper": paper.get(k), "ours": x, "ratio": x / paper[k] if k in paper else None}
        for k, x in change.items()
    ]
    write_tables(run, config.artefact.rpartition("/")[2], lines, config.caption)
    return {
        "artefact": config.artefact, "data": "kia_niro", "synthetic": False,
        "rows": [{"name": "pedal", "paper": paper or None, "ours": change}],
        "better_than_paper": 0, "of": 0, "logs": 1,
        "notes": [
            "Trained on the first two thirds of trip 1 and tested on the last; the paper tested on the other trips, "
            "whose public files have no pedal",
        ],
    }  # fmt: skip
