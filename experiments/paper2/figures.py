"""Figures 12 and 13 of paper 2: measured beside predicted power, and the fit of the prediction."""

from collections.abc import Iterator
from typing import Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from experiments.paper2.data import TripName, kia_fingerprint, kia_trips
from experiments.paper2.diagnosed import diagnosis_key
from experiments.paper2.drawings import prediction_figure
from experiments.paper2.fits import Mean, evaluated, fitted
from experiments.paper2.models import Settings
from experiments.runner.compare import tally
from experiments.runner.config import Strict
from experiments.runner.tables import readable, write_tables
from hdev_jax.errors import InputError
from hdev_jax.rundir import Run

__all__ = ["SOURCES", "Config", "collect", "run", "tasks"]

SOURCES = ("models.py", "data.py", "fits.py")


class Config(Strict):
    """One model's prediction of trip 1: the whole trip, or the seconds `window`."""

    experiment: Literal["paper2.figures"]
    artefact: str
    caption: str
    model: str = "NARXP"
    models: dict[str, Settings]
    window: list[float] | None = Field(None, min_length=2, max_length=2)
    paper: dict[str, dict[str, float]] = Field(default_factory=dict)
    rows: int = Field(0, ge=0)
    train: TripName = "1"
    seed: int = Field(0, ge=0)

    @model_validator(mode="after")
    def _window_has_a_length(self) -> Self:
        if self.window and self.window[1] <= self.window[0]:
            raise ValueError(f"window: ends at {self.window[1]:g} s, before it begins at {self.window[0]:g} s")
        return self


def tasks(config: Config) -> Iterator[dict[str, Any]]:
    """The one model."""
    settings = config.models[config.model].task()
    task = {"settings": settings, "rows": config.rows, "train": config.train, "seed": config.seed}
    yield {**task, **diagnosis_key(settings), "data": kia_fingerprint()}


def run(task: dict[str, Any]) -> dict[str, Any]:
    """Its prediction of the training trip, row by row."""
    trip = kia_trips(task["rows"] or None)[task["train"]]
    models = fitted(task["settings"], trip, task["seed"]).models
    model = Mean.of(models, trip) if task["settings"]["rule"] == "ensemble" else models[0]
    predicted = model.predict(trip)
    return {
        "first": len(trip) - len(predicted), "predicted": [round(float(p), 4) for p in predicted],
        **evaluated(model, trip),
    }  # fmt: skip


def collect(config: Config, results: Any, run: Run) -> dict[str, Any]:
    """The figure, and the fit it is captioned with."""
    _, found = next(iter(results))
    trip = kia_trips(config.rows or None)[config.train]
    predicted = np.asarray(found["predicted"])
    measured = np.asarray(trip.target)[found["first"] :]
    clock = np.arange(found["first"], len(trip)) * trip.dt_s
    first, last = config.window or (clock[0], clock[-1])
    inside = (clock >= first) & (clock <= last)
    if not inside.any():
        raise InputError(f"config, key window: no row from {first:g} to {last:g} s; the trip ends at {clock[-1]:.0f} s")
    prediction_figure(run, config.artefact, clock[inside], measured[inside], predicted[inside])
    worst = int(np.argmax(np.abs(predicted - measured)))
    ours = {
        "fit_percent": found["step_fit"], "training_mse": found["step_mse"],
        "worst_error_kw": float(predicted[worst] - measured[worst]), "worst_at_s": float(clock[worst]),
    }  # fmt: skip
    paper = config.paper.get(config.model, {})
    lines = [
        {"quantity": readable(k), "paper": paper.get(k), "ours": x, "ratio": x / paper[k] if k in paper else None}
        for k, x in ours.items()
    ]
    write_tables(run, config.artefact.rpartition("/")[2], lines, config.caption)
    rows = [{"name": config.model, "paper": paper or None, "ours": ours}]
    whole = config.window is None  # the same numbers are compared once
    return {
        "artefact": config.artefact, "data": "kia_niro", "synthetic": False,
        "rows": rows, "logs": 1, **(tally(rows, "training_mse") if whole else {"better_than_paper": 0, "of": 0}),
    }  # fmt: skip
