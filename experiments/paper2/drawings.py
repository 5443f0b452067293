"""What paper 2's figures show: speeds, signals, and measured beside predicted power."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from experiments.paper2.data import MPH
from experiments.runner.figures import save_figure, styled
from hdev_jax.learn import Trip
from hdev_jax.report.canvas import AFTER, GREY, MEASURED, figure, tidy
from hdev_jax.rundir import Run

__all__ = ["prediction_figure", "signals_figure", "speeds_figure"]


@styled
def prediction_figure(run: Run, artefact: str, clock: Any, measured: Any, predicted: Any) -> None:
    """Figures 12 and 13: measured and predicted power, and their difference below."""
    fig = figure(7.0, 4.0)
    above, below = fig.subplots(2, 1, sharex=True, height_ratios=[2, 1])
    above.plot(clock, measured, color=MEASURED, label="measured", linewidth=1.6)
    above.plot(clock, predicted, color=AFTER, label="predicted one step ahead", linewidth=0.8)
    above.set_ylabel("battery power [kW]")
    above.legend(loc="upper right")
    below.plot(clock, predicted - measured, color=GREY)
    below.set_ylabel("error [kW]")
    below.set_xlabel("time [s]")
    tidy(above)
    tidy(below, zero=True)
    save_figure(run, fig, artefact.rpartition("/")[2])


@styled
def speeds_figure(run: Run, trips: Mapping[str, Trip]) -> None:
    """Figure 4: box plot of speed by trip."""
    fig = figure(4.5, 3.2)
    ax = fig.subplots()
    speeds = [t.inputs["speed_mps"] / MPH for t in trips.values()]
    ax.boxplot(speeds, tick_labels=[f"trip {t}" for t in trips], showfliers=False, medianprops={"color": AFTER})
    ax.set_ylabel("speed [mph]")
    ax.set_title("Kia Niro: speeds of the trips")
    tidy(ax)
    save_figure(run, fig, "fig4")


@styled
def signals_figure(run: Run, trip: Trip) -> None:
    """Figures 5-8: torque, speed and power of a trip."""
    clock = np.arange(len(trip)) * trip.dt_s
    rows = (
        (trip.inputs["motor_torque_nm"], "torque [Nm]"), (trip.inputs["speed_mps"], "speed [m/s]"),
        (np.asarray(trip.target), "battery power [kW]"),
    )  # fmt: skip
    fig = figure(7.0, 4.6)
    panels = fig.subplots(3, 1, sharex=True)
    for ax, (y, label) in zip(panels, rows, strict=True):
        ax.plot(clock, y, color=MEASURED, linewidth=0.5)
        ax.set_ylabel(label)
        tidy(ax)
    panels[0].set_title(f"Kia Niro, trip {trip.name.removeprefix('trip')}")
    panels[-1].set_xlabel("time [s]")
    save_figure(run, fig, f"trip{trip.name}")
