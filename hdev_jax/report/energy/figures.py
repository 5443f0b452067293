"""Figures of energy: where it goes, by week, against conditions; road load; what a change does."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from hdev_jax.energy.ledger import SUM, TOTAL, UNEXPLAINED
from hdev_jax.energy.road_load import SHOWN_KMH, RoadLoad
from hdev_jax.report import names
from hdev_jax.report.canvas import AFTER, BEFORE, GREY, INK, MEASURED, figure, tidy
from hdev_jax.report.figures import WIDTH, short

__all__ = ["BACK", "by_week", "consumption", "differences", "forces", "label", "trip_intervals", "waterfall"]

# Okabe and Ito (2008), as the other figures
COLOURS = ("#0072B2", "#56B4E9", "#009E73", "#E69F00", "#D55E00", "#CC79A7", "#F0E442", "#7F7F7F")
BACK = COLOURS[2]  # green: energy that comes back
MOST_TRIPS = 40
NOTHING = 1e-9  # of a bar that is left out


def label(cause: str) -> str:
    """A cause as a reader calls it."""
    return cause if cause in (UNEXPLAINED, TOTAL, SUM) else names.effect(cause)


def waterfall(rows: pd.DataFrame, per: str, unit: str) -> Any:
    """Bars that begin where the one before ended, from nothing to the measured energy; one block of the
    ledger, by its column `per`."""
    lines = {str(r["cause"]): r for r in rows.to_dict("records")}
    total = lines.pop(TOTAL)
    k = total[per] / total["kwh"] if total["kwh"] else 1.0
    there = [c for c, r in lines.items() if abs(r["kwh"]) > NOTHING and c != UNEXPLAINED]
    causes = [*sorted(there, key=lambda c: -lines[c]["kwh"]), UNEXPLAINED]
    value, low, high = (k * np.array([lines[c][n] for c in causes]) for n in ("kwh", "lower", "upper"))
    total = k * total["kwh"]
    ends = np.cumsum(value)
    starts = ends - value
    y = np.arange(len(causes) + 1)[::-1].astype(float)
    fig = figure(WIDTH, 1.3 + 0.38 * len(y))
    ax = fig.add_subplot()
    colours = [GREY if c == UNEXPLAINED else AFTER if v >= 0 else BACK
               for c, v in zip(causes, value, strict=True)]  # fmt: skip
    ax.barh(y[:-1], value, left=starts, color=colours, height=0.62)
    ax.barh(y[-1], total, color=MEASURED, height=0.62)
    open_ = low < high
    ax.hlines(y[:-1][open_], (starts + low)[open_], (starts + high)[open_], color=INK, linewidth=1.1)
    for a, b, x in zip(y[:-1], y[1:], ends, strict=True):
        ax.vlines(x, b, a, color=GREY, linewidth=0.6, linestyle=":")
    reach = max(float(np.max(np.abs(np.r_[starts, ends, starts + high, total]))), 1e-9)
    edges = np.r_[np.max([starts, ends, starts + high], axis=0), max(total, 0.0)]
    for at, edge, text in zip(y, edges, np.r_[value, total], strict=True):
        share = f"  ({100 * text / total:.1f} %)" if abs(total) > 1e-9 and at != y[-1] else ""
        ax.text(edge + 0.01 * reach, at, f"{text:.3g}{share}".replace("-", "−"), va="center", fontsize=8, color=INK)
    ax.set_yticks(y, [*(short(label(c), 40) for c in causes), TOTAL])
    ax.set_xlim(min(0.0, float(np.min(np.r_[starts, ends, starts + low])) * 1.05), reach * 1.14)
    ax.axvline(0, color=GREY, linewidth=0.8)
    ax.set_xlabel(unit)
    ax.set_title("Where the energy goes: each bar begins where the one above it ends; line: 90 % interval")
    tidy(ax, grid="x")
    return fig


def by_week(rows: pd.DataFrame) -> Any | None:
    """Stacked bars of each week, kWh/100 km by cause, what was measured as a dot. None for fewer than two weeks."""
    weeks = list(dict.fromkeys(rows["name"]))
    if len(weeks) < 2:
        return None
    table = rows.pivot(index="name", columns="cause", values="kwh_per_100km").loc[weeks]
    causes = [c for c in table if c != TOTAL and np.nanmax(np.abs(table[c])) > 1e-9]
    causes.sort(key=lambda c: (c == UNEXPLAINED, -float(np.nanmean(table[c]))))
    fig = figure(WIDTH, 3.8)
    ax = fig.add_subplot()
    x, up, down = np.arange(len(weeks)), np.zeros(len(weeks)), np.zeros(len(weeks))
    for k, c in enumerate(causes):
        v = np.nan_to_num(table[c].to_numpy(float))
        base = np.where(v >= 0, up, down)
        colour = GREY if c == UNEXPLAINED else COLOURS[k % len(COLOURS)]
        ax.bar(x, v, bottom=base, color=colour, width=0.8, label=label(c))
        up, down = up + np.maximum(v, 0.0), down + np.minimum(v, 0.0)
    ax.plot(x, table[TOTAL], "o", color=MEASURED, markersize=4, label=TOTAL)
    step = max(1, len(weeks) // 14)
    ax.set_xticks(x[::step], weeks[::step], rotation=0 if len(weeks) < 9 else 45)
    ax.set_ylabel("kWh/100 km")
    ax.set_title("Energy by cause, week by week")
    ax.axhline(0, color=GREY, linewidth=0.8)
    tidy(ax)
    fig.legend(loc="outside right upper")
    return fig


def consumption(trips: pd.DataFrame, conditions: dict[str, tuple[str, np.ndarray]]) -> Any | None:
    """Measured kWh/100 km of each trip against its speed, temperature, mass, with the model's and its trend.

    **Arguments:** `trips` with `kwh_per_100km` and `model_per_100km`; `conditions`: words → unit and value by trip.
    """
    shown = {k: v for k, v in conditions.items() if np.sum(np.isfinite(v[1])) > 2 and np.nanstd(v[1]) > 0}
    if not shown or len(trips) < 3:
        return None
    fig = figure(WIDTH, 3.2)
    axes = fig.subplots(1, len(shown), sharey=True, squeeze=False)[0]
    y, model = trips["kwh_per_100km"].to_numpy(float), trips["model_per_100km"].to_numpy(float)
    for ax, (name, (unit, x)) in zip(axes, shown.items(), strict=True):
        ax.plot(x, y, "o", color=MEASURED, markersize=3.6, alpha=0.75, label="measured")
        ax.plot(x, model, "o", markersize=3.6, markerfacecolor="none", color=AFTER, label="model")
        there = np.isfinite(x) & np.isfinite(model)
        line = np.linspace(np.nanmin(x), np.nanmax(x), 40)
        degree = 2 if there.sum() >= 8 else 1
        ax.plot(line, np.polynomial.Polynomial.fit(x[there], model[there], degree)(line), color=AFTER, linewidth=1.4,
                label="trend of the model")  # fmt: skip
        ax.set_xlabel(f"{name} [{unit}]")
        tidy(ax)
    axes[0].set_ylabel("kWh/100 km")
    axes[0].set_title("Consumption of each trip")
    handles, words = axes[0].get_legend_handles_labels()
    fig.legend(handles, words, loc="outside upper right", ncols=3)
    return fig


def forces(load: RoadLoad) -> Any:
    """Force against speed with its interval, its parts, and where the log was driven."""
    fig = figure(WIDTH, 4.0)
    ax = fig.add_subplot()
    v = load.speeds_kmh
    ax.axvspan(*load.driven_kmh, color="#eef2f5", zorder=0, label="where 90 % of the way was driven")
    ax.fill_between(v, load.force_lower, load.force_upper, color=AFTER, alpha=0.25, linewidth=0, label="90 % interval")
    ax.plot(v, load.force, color=AFTER, linewidth=2, label="A + B·v + C·v²")
    a, b, _ = load.abc
    ax.plot(v, np.full(len(v), a), color=GREY, linewidth=1, linestyle="--", label="A")
    ax.plot(v, a + b * v / 3.6, color=BEFORE, linewidth=1, linestyle="--", label="A + B·v")
    for u in SHOWN_KMH:
        k = int(np.argmin(np.abs(v - u)))
        ax.plot(v[k], load.force[k], "o", color=INK, markersize=4)
        ax.annotate(f"{load.force[k]:,.0f} N", (v[k], load.force[k]), (-6, 8), textcoords="offset points", ha="right")
    ax.set_xlabel("speed [km/h]")
    ax.set_ylabel("force [N]")
    ax.set_ylim(min(0.0, float(np.min(load.force_lower))))
    ax.set_title(f"Road load at {load.mass_kg:,.0f} kg")
    ax.legend(loc="upper left")
    tidy(ax)
    return fig


def differences(rows: pd.DataFrame, unit: str, title: str) -> Any:
    """A bar for each cause with the interval of its difference, the whole last."""
    rows = pd.DataFrame(rows[(rows["difference"].abs() > NOTHING) | rows["cause"].isin([TOTAL, SUM])])
    y = np.arange(len(rows))[::-1].astype(float)
    value, low, high = (rows[c].to_numpy(float) for c in ("difference", "lower", "upper"))
    fig = figure(WIDTH, 1.3 + 0.38 * max(len(rows), 1))
    ax = fig.add_subplot()
    colours = [MEASURED if c in (TOTAL, SUM) else GREY if c == UNEXPLAINED else BEFORE if v > 0 else AFTER
               for c, v in zip(rows["cause"], value, strict=True)]  # fmt: skip
    ax.barh(y, value, color=colours, height=0.62)
    ax.hlines(y, low, high, color=INK, linewidth=1.1)
    reach = max(float(np.max(np.abs(np.r_[value, low, high]))), 1e-9)
    for at, v, edge in zip(
        y, value, np.where(value >= 0, np.maximum(value, high), np.minimum(value, low)), strict=True
    ):
        ax.text(edge + 0.012 * reach * (1 if v >= 0 else -1), at, f"{v:+.3g}".replace("-", "−"), va="center",
                ha="left" if v >= 0 else "right", fontsize=8, color=INK)  # fmt: skip
    ax.set_yticks(y, [short(label(c), 40) for c in rows["cause"]])
    ax.axvline(0, color=GREY, linewidth=0.8)
    ends = np.r_[value, low, high, 0.0]
    ax.set_xlim(float(np.min(ends)) - 0.16 * reach, float(np.max(ends)) + 0.16 * reach)
    ax.set_xlabel(unit)
    ax.set_title(title)
    tidy(ax, grid="x")
    return fig


def trip_intervals(
    names_: Sequence[str], intervals: np.ndarray, unit: str, title: str,
    whole: tuple[float, float, float] | None = None,
) -> Any:  # fmt: skip
    """A dot with its interval for each trip (`intervals`: value, lower, upper in columns), and as a band what holds for
    all of them."""
    value, lower, upper = intervals.T
    n = len(value)
    named = n <= MOST_TRIPS
    fig = figure(WIDTH, 1.3 + (0.26 * n if named else 4.5))
    ax = fig.add_subplot()
    y = np.arange(n)[::-1].astype(float)
    if whole is not None:
        ax.axvspan(whole[1], whole[2], color=AFTER, alpha=0.18, linewidth=0)
        ax.axvline(whole[0], color=AFTER, linewidth=1.4, label="all trips together, 90 % interval")
        ax.legend(loc="best")
    ax.hlines(y, lower, upper, color="#8fa3b3", linewidth=1.6 if named else 0.7)
    ax.plot(value, y, "o", color=INK, markersize=4 if named else 2)
    ax.axvline(0, color=GREY, linewidth=0.8)
    ax.set_yticks(*((y, [short(t) for t in names_]) if named else ([], [])))
    ax.set_ylabel("" if named else f"{n} trips in the order of the log")
    ax.set_ylim(-0.8, n - 0.2)
    ax.set_xlabel(unit)
    ax.set_title(title)
    tidy(ax, grid="x")
    return fig
