"""Paper 2 on its own data: tables IV-X and the studies around them. Settings are chosen on rows of trip 1; trips 2-4
are read for the report alone. What was known of them beforehand is what table II says: they brake and accelerate
harder, which is why rows at the edge of power are left out too. One task is one model: tables that show it share its
fit.
"""

from collections.abc import Iterator
from typing import Any, Literal, Self

from pydantic import Field, model_validator

from experiments.paper2.data import TripName, kia_fingerprint, kia_trips
from experiments.paper2.diagnosed import diagnosis_key
from experiments.paper2.fits import Mean, evaluated, fitted, step_seconds
from experiments.paper2.models import Settings
from experiments.paper2.tables import OF_SOME, collect
from experiments.runner.config import Strict

__all__ = ["SOURCES", "Config", "alone", "collect", "run", "tasks"]

SOURCES = ("models.py", "data.py", "fits.py")


class Config(Strict):
    """One table: its models, and the paper's numbers for them (keys as in `metrics.json`)."""

    experiment: Literal["paper2.study"]
    artefact: str
    caption: str
    # what the table compares: keys of the metrics, the first decides which is better
    show: list[str] = Field(min_length=1)
    models: dict[str, Settings]
    order: list[str] = Field(min_length=1)  # rows of the table
    paper: dict[str, dict[str, float]] = Field(default_factory=dict)
    free_run: bool = False  # which of the two configurations the table's columns are of
    timed: bool = False  # also the time of a step
    notes: list[str] = Field(default_factory=list)
    rows: int = Field(0, ge=0)  # of each trip; 0: all
    train: TripName = "1"
    test: list[TripName] = Field(default_factory=lambda: ["2", "3", "4"], min_length=1)
    seed: int = Field(0, ge=0)

    @model_validator(mode="after")
    def _test_trips_are_others(self) -> Self:
        if self.train in self.test:
            raise ValueError(f"test: trip {self.train} is the training trip")
        if self.show[0] in OF_SOME:
            raise ValueError(f"show: {self.show[0]!r} decides no table; name another number first")
        return self


def tasks(config: Config) -> Iterator[dict[str, Any]]:
    """One for each model of the table; where it is `timed`, one more for each."""
    common = {"rows": config.rows, "train": config.train, "data": kia_fingerprint()}
    for name in config.order:
        settings = config.models[name].task()
        task = {"name": name, "settings": settings, **diagnosis_key(settings), **common}
        yield {**task, "test": config.test, "seed": config.seed}
        if config.timed and config.models[name].kind == "narx":
            yield {**task, "timed": True}


def alone(task: dict[str, Any]) -> bool:
    """Whether it measures time."""
    return bool(task.get("timed"))


def run(task: dict[str, Any]) -> dict[str, Any]:
    """Fit on the training trip, then every trip once: the chosen model, each start, and the mean of all starts."""
    trips = kia_trips(task["rows"] or None)
    train = trips[task["train"]]
    if task.get("timed"):
        return {"step_seconds": step_seconds(task["settings"], train)}
    fit = fitted(task["settings"], train, task["seed"])
    models = fit.models
    names = (task["train"], *task["test"])
    starts = [{t: evaluated(m, trips[t]) for t in names} for m in models]
    mean = Mean.of(models, train)
    ensemble = {t: evaluated(mean, trips[t]) for t in names} if len(models) > 1 else starts[0]
    is_mean = task["settings"]["rule"] == "ensemble"
    return {
        "trips": ensemble if is_mean else starts[0],
        "parameters": (mean if is_mean else models[0]).parameters,
        "losses": fit.losses,
        "converged": fit.converged,
        "starts": {t: {k: [s[t][k] for s in starts] for k in ("step_mse", "free_mse")} for t in names},
        "ensemble": {t: {k: ensemble[t][k] for k in ("step_mse", "free_mse")} for t in names},
        "settings_found": getattr(models[0], "settings", {}),
    }
