"""Loads that switch: the figure of their levels, courses and shares, and their sentence."""

from typing import Any

import numpy as np

from hdev_jax.physics.loads import STANDSTILL_MPS
from hdev_jax.report import names
from hdev_jax.report.canvas import GREY, INK, MEASURED, axis_label, figure, tidy
from hdev_jax.report.data import ReportData, test_rows
from hdev_jax.report.figures import WIDTH, short
from hdev_jax.targets import as_watts

__all__ = ["loads", "on_column", "switching_loads"]

COLOURS = ("#009E73", "#CC79A7")  # of the loads; Okabe and Ito (2008)
STRETCH_S = 1800.0


def on_column(effect_id: str) -> str:
    """The column of a report's rows that holds the share of each row that a load is on."""
    return f"on:{effect_id}"


def loads(data: ReportData) -> list[dict[str, Any]]:
    """The effects of diagnosis.json that have a state."""
    return [e for e in data.summary.get("effects", []) if "state" in e]


def _power_kw(data: ReportData, name: str) -> np.ndarray:
    """A column of the target as a power [kW]."""
    seconds = np.maximum(data.row("duration_s"), 1e-9)
    return as_watts(data.summary["target"], data.row(name), seconds) / 1e3


def switching_loads(data: ReportData) -> Any | None:
    """Power at standstill with the levels on it; half an hour with the loads switching; share of time on by
    temperature. None where no load has a state, or its rows are not there."""
    found = [e for e in loads(data) if on_column(e["id"]) in data.rows]
    if not found or "given" not in data.rows:
        return None
    rows = test_rows(data)
    fig = figure(WIDTH, 5.4)
    grid = fig.add_gridspec(2, 2, height_ratios=[1, 1.15])
    _levels(data, found, rows, fig.add_subplot(grid[0, 0]))
    _shares(found, fig.add_subplot(grid[0, 1]))
    _course(data, found, rows, fig.add_subplot(grid[1, :]))
    return fig


def _levels(data: ReportData, found: list[dict[str, Any]], rows: np.ndarray, ax: Any) -> None:
    standing = rows & (np.asarray(data.channels["speed_mps"]) < STANDSTILL_MPS)
    chosen = standing if standing.sum() > 200 else rows
    kw = _power_kw(data, "measured")[chosen]
    low, high = np.quantile(kw, (0.002, 0.998))
    power = [e["parameters"]["power_w"]["value"] / 1e3 for e in found]
    off = chosen & np.all([data.row(on_column(e["id"])) < 0.1 for e in found], axis=0)
    base = float(np.median(_power_kw(data, "measured")[off])) if off.any() else float(np.min(kw))
    levels = {0.0: "all off"}
    for k, e in enumerate(found):
        levels[power[k]] = names.effect(e["id"])
    if len(found) == 2:
        levels[sum(power)] = "both"
    ax.hist(kw, bins=np.linspace(low, max(high, base + sum(power)), 90), color="#b3bdc6")
    for level, words in levels.items():
        ax.axvline(base + level, color=INK, linewidth=0.9, linestyle="--")
        ax.text(base + level, 0.97, words, rotation=90, va="top", ha="left", fontsize=7,
                bbox={"facecolor": "white", "alpha": 0.7, "linewidth": 0, "pad": 1.0},
                transform=ax.get_xaxis_transform())  # fmt: skip
    ax.set_xlabel("measured battery power [kW]")
    ax.set_ylabel("rows")
    ax.set_title("Power at standstill and the levels" if standing.sum() > 200 else "Power and the levels")
    tidy(ax)


def _loads_kw(data: ReportData, found: list[dict[str, Any]]) -> np.ndarray:
    each = [e["parameters"]["power_w"]["value"] / 1e3 * data.row(on_column(e["id"])) for e in found]
    return np.sum(each, axis=0)


def _shares(found: list[dict[str, Any]], ax: Any) -> None:
    drawn = False
    for k, e in enumerate(found):
        if points := e["state"]["share_on"]:
            c, share, low, high = np.array(points).T
            ax.errorbar(c + 0.3 * k, 100 * share, yerr=100 * np.array([share - low, high - share]), fmt="o-",
                        color=COLOURS[k % 2], markersize=4, capsize=2.5, label=_label(e))  # fmt: skip
            drawn = True
        else:
            ax.axhline(100 * e["state"]["mean_share_on"], color=COLOURS[k % 2], label=_label(e))
    ax.set_ylim(0, 100)
    ax.set_xlabel(axis_label("outside temperature", "°C") if drawn else "no temperature in this log")
    ax.set_ylabel("share of time on [%]")
    ax.set_title("How often it is on (90 % intervals)")
    ax.legend(loc="upper center")
    tidy(ax)


def _label(e: dict[str, Any]) -> str:
    return f"{names.effect(e['id'])}, {e['parameters']['power_w']['value'] / 1e3:.3g} kW"


def _course(data: ReportData, found: list[dict[str, Any]], rows: np.ndarray, ax: Any) -> None:
    """Half an hour of the test trip in which the first load switches most."""
    trip, time, on = data.row("trip"), data.row("time_s"), data.row(on_column(found[0]["id"]))
    best: tuple[float, np.ndarray] | None = None
    for t in np.unique(trip[rows]):
        at = np.flatnonzero(rows & (trip == t))
        start = time[at[0]]
        while start < time[at[-1]]:
            here = at[(time[at] >= start) & (time[at] < start + STRETCH_S)]
            changes = float(np.sum(np.abs(np.diff(on[here])))) if len(here) > 20 else -1.0
            if best is None or changes > best[0]:
                best = changes, here
            start += STRETCH_S
    assert best is not None
    here = best[1]
    minutes = time[here] / 60.0
    left = (_power_kw(data, "measured") - _power_kw(data, "given") + _loads_kw(data, found))[here]
    floor = np.zeros(len(here))
    for k, e in enumerate(found):
        top = floor + e["parameters"]["power_w"]["value"] / 1e3 * data.row(on_column(e["id"]))[here]
        ax.fill_between(minutes, floor, top, color=COLOURS[k % 2], alpha=0.55, linewidth=0, step="mid", label=_label(e))
        floor = top
    ax.plot(minutes, left, color=MEASURED, linewidth=0.7, label="measured power less all else in the model")
    low, high = np.quantile(left, (0.005, 0.995))
    ax.set_ylim(min(low, -2.0), 1.3 * max(high, float(floor.max())))
    name = data.trip_names[int(trip[here[0]])]
    ax.set_title(f"Half an hour of {short(name, 30)}: when they are on")
    ax.set_xlabel(axis_label("time since start of the trip", "min"))
    ax.set_ylabel("power [kW]")
    ax.axhline(0, color=GREY, linewidth=0.6)
    ax.margins(x=0.005)
    ax.legend(loc="upper right", ncols=3, framealpha=0.9, frameon=True, edgecolor="none", fontsize=7.5)
    tidy(ax)
