"""Figures of paper 2: speeds, signals, and measured beside predicted power."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from pydantic import Field

from experiments.config import Strict
from experiments.paper2 import Settings
from experiments.paper2_data import kia_trips
from experiments.paper2_fits import evaluated, fitted
from experiments.tables import write_tables
from hdev_jax.learn import Trip
from hdev_jax.rundir import Run, atomic_file

__all__ = ["SOURCES", "Config", "collect", "run", "signals_figure", "speeds_figure", "tasks"]

SOURCES = ("paper2_figures.py", "paper2.py", "paper2_data.py", "paper2_fits.py")
MPH = 0.44704


class Config(Strict):
    """One model's prediction of trip 1: the whole trip, or the seconds `window`."""

    experiment: str
    artefact: str
    caption: str
    show: list[str] = Field(default_factory=list)
    order: list[str] = Field(default_factory=list)
    model: str = "NARXP"
    models: dict[str, Settings]
    window: list[float] = Field(default_factory=list)
    paper: dict[str, dict[str, float]] = Field(default_factory=dict)
    rows: int = 0
    train: str = "1"
    seed: int = 0


def tasks(config: Config) -> Iterator[dict[str, Any]]:
    """The one model."""
    settings = config.models[config.model].model_dump(mode="json", exclude={"why"})
    yield {"settings": settings, "rows": config.rows, "train": config.train, "seed": config.seed}


def run(task: dict[str, Any]) -> dict[str, Any]:
    """Its prediction of the training trip, row by row."""
    trip = kia_trips(task["rows"] or None)[task["train"]]
    model = fitted(task["settings"], trip, task["seed"])[0][0]
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
    inside = np.ones(len(clock), dtype=bool)
    if config.window and clock[-1] > config.window[0]:
        inside = (clock >= config.window[0]) & (clock <= config.window[1])
    prediction_figure(run, config.artefact, clock[inside], measured[inside], predicted[inside])
    worst = int(np.argmax(np.abs(predicted - measured)))
    ours = {
        "fit_percent": found["step_fit"], "mse": found["step_mse"],
        "worst_error_kw": float(predicted[worst] - measured[worst]), "worst_at_s": float(clock[worst]),
    }  # fmt: skip
    paper = config.paper.get(config.model)
    ratio = {k: ours[k] / paper[k] for k in ours if paper and paper.get(k)}
    lines = [{"number": k, "paper": (paper or {}).get(k), "ours": x, "ratio": ratio.get(k)} for k, x in ours.items()]
    write_tables(run, config.artefact.rpartition("/")[2], lines, config.caption)
    better = bool(paper) and "fit_percent" in (paper or {}) and ours["fit_percent"] >= (paper or {})["fit_percent"]
    return {
        "artefact": config.artefact, "data": "kia_niro", "synthetic": False,
        "rows": [{"name": config.model, "paper": paper, "ours": {**ours, "ratio": ratio}}],
        "better_than_paper": int(better), "of": int(bool(paper)), "logs": 1, "skipped": [], "missed": [],
    }  # fmt: skip


def prediction_figure(run: Run, artefact: str, clock: Any, measured: Any, predicted: Any) -> None:
    """Figures 12 and 13: measured and predicted power, and their difference below."""
    from hdev_jax.report.canvas import AFTER, GREY, MEASURED, figure, style, tidy

    with style():
        fig = figure(7.0, 4.0)
        above, below = fig.subplots(2, 1, sharex=True, height_ratios=[2, 1])
        above.plot(clock, measured, color=MEASURED, label="measured")
        above.plot(clock, predicted, color=AFTER, label="one step ahead", linestyle="--")
        above.set_ylabel("battery power [kW]")
        above.legend(loc="upper right")
        below.plot(clock, predicted - measured, color=GREY)
        below.set_ylabel("error [kW]")
        below.set_xlabel("time [s]")
        tidy(above)
        tidy(below, zero=True)
        _save(run, fig, artefact.rpartition("/")[2])


def speeds_figure(run: Run, trips: Mapping[str, Trip]) -> None:
    """Figure 4: box plot of speed by trip."""
    from hdev_jax.report.canvas import AFTER, figure, style, tidy

    with style():
        fig = figure(4.5, 3.2)
        ax = fig.subplots()
        speeds = [t.inputs["speed_mps"] / MPH for t in trips.values()]
        ax.boxplot(speeds, tick_labels=[f"trip {t}" for t in trips], showfliers=False, medianprops={"color": AFTER})
        ax.set_ylabel("speed [mph]")
        tidy(ax)
        _save(run, fig, "fig4")


def signals_figure(run: Run, trip: Trip) -> None:
    """Figures 5-8: torque, speed and power of a trip."""
    from hdev_jax.report.canvas import MEASURED, figure, style, tidy

    clock = np.arange(len(trip)) * trip.dt_s
    rows = (
        (trip.inputs["motor_torque_nm"], "torque [Nm]"), (trip.inputs["speed_mps"], "speed [m/s]"),
        (np.asarray(trip.target), "power [kW]"),
    )  # fmt: skip
    with style():
        fig = figure(7.0, 4.6)
        panels = fig.subplots(3, 1, sharex=True)
        for ax, (y, label) in zip(panels, rows, strict=True):
            ax.plot(clock, y, color=MEASURED, linewidth=0.5)
            ax.set_ylabel(label)
            tidy(ax)
        panels[-1].set_xlabel("time [s]")
        _save(run, fig, f"trip{trip.name}")


def _save(run: Run, fig: Any, name: str) -> None:
    for ending in ("png", "pdf"):
        with atomic_file(run.path("figures", f"{name}.{ending}")) as temporary, open(temporary, "wb") as file:
            fig.savefig(file, format=ending, metadata={"Software": None} if ending == "png" else {"CreationDate": None})
