"""The figures that look at the residual itself: against each channel, and in time."""

from typing import Any, NamedTuple

import numpy as np

from hdev_jax.report import names
from hdev_jax.report.canvas import AFTER, GREY, MEASURED, axis_label, figure, plain_log, tidy
from hdev_jax.report.data import ReportData, test_rows
from hdev_jax.report.figures import WIDTH, legend, models, short
from hdev_jax.report.statistics import (
    Binned,
    autocorrelation,
    binned,
    blocks,
    dependence,
    edges_of,
    row_seconds,
    variance_by_period,
)

__all__ = ["Panel", "drift_course", "panels", "residual_by_channel", "residual_in_time"]

PANELS = 12
# what the target is made from, and columns that say nothing about driving
_HIDDEN = {"energy_wh", "battery_power_w", "battery_power_kw", "duration_s", "distance_m", "time_s", "trip_id"}


class Panel(NamedTuple):
    """The residual against one channel: `means` by model, `share` of its variance that the channel explains."""

    name: str
    shown: names.Shown
    means: dict[str, Binned]
    share: dict[str, float]


def _columns(data: ReportData) -> dict[str, tuple[names.Shown, np.ndarray]]:
    standing = {
        "time_s": (names.channel("time_s"), data.row("time_s")),
        "distance_since_start_m": (names.channel("distance_since_start_m"), data.row("distance_since_start_m")),
        "\x00predicted": (
            names.Shown(f"predicted {names.target(data.summary['target'])[1]}", data.unit),
            data.row("after"),
        ),
    }
    hidden = _HIDDEN | {data.summary["target"]} | set(standing)
    logged = {k: (names.channel(k), np.asarray(v)) for k, v in data.channels.items() if k not in hidden}
    numeric = {
        k: v for k, v in logged.items() if v[1].dtype.kind in "fiub" and v[1].shape == data.row("measured").shape
    }
    return {**standing, **numeric}


def panels(data: ReportData) -> tuple[list[Panel], int]:
    """At most 12 panels, the channels that the residual depends on most first, and how many channels there were.

    Time and distance since the start and the predicted value are always among them; constant channels never are.
    """
    rows = test_rows(data)
    cluster = blocks(data, rows).ids
    residual = {w: data.residual(w)[rows] for w, _, _ in models(data)}
    found = []
    for name, (shown, column) in _columns(data).items():
        x = column[rows].astype(float)
        edges = edges_of(x)
        if edges is None:
            continue
        share = {w: dependence(x, r, edges) for w, r in residual.items()}
        found.append((max(share.values()), name, shown, x, edges, share))
    standing = 3
    first, rest = found[:0], []
    for f in found:
        (first if f[1] in ("time_s", "distance_since_start_m", "\x00predicted") else rest).append(f)
    rest = sorted(rest, key=lambda f: -f[0])[: PANELS - standing]
    chosen = sorted([*first, *rest], key=lambda f: -f[0])
    out = [
        Panel(
            name, shown, {w: binned(shown.factor * x, r, cluster, shown.factor * e) for w, r in residual.items()}, share
        )
        for _, name, shown, x, e, share in chosen
    ]
    return [p for p in out if any(len(m.x) for m in p.means.values())], len(found)


def residual_by_channel(data: ReportData, shown: list[Panel]) -> Any | None:
    """Small multiples with one vertical scale: the mean residual by bin of each channel, with its standard error."""
    if not shown:
        return None
    across = min(4, len(shown))
    down = -(-len(shown) // across)
    fig = figure(WIDTH, 0.5 + 1.95 * down)
    axes = np.atleast_1d(fig.subplots(down, across, sharey=True, squeeze=False)).ravel()
    colour = {w: c for w, _, c in models(data)}
    for ax, panel in zip(axes, shown, strict=False):
        for when, m in panel.means.items():
            ax.fill_between(m.x, m.mean - m.error, m.mean + m.error, color=colour[when], alpha=0.2, linewidth=0)
            ax.plot(m.x, m.mean, color=colour[when], marker="o", markersize=2.6, linewidth=1.1)
        ax.set_xlabel(axis_label(short(panel.shown.label, 30), panel.shown.unit))
        ax.margins(x=0.04)
        tidy(ax, zero=True)
    for ax in axes[len(shown) :]:
        ax.remove()
    tops = [
        np.abs(m.mean) + np.minimum(np.nan_to_num(m.error), np.abs(m.mean)) for p in shown for m in p.means.values()
    ]
    reach = 1.12 * float(np.max(np.concatenate(tops))) or 1.0
    axes[0].set_ylim(-reach, reach)
    for ax in axes[: len(shown) : across]:
        ax.set_ylabel(f"mean error [{data.unit}]")
    legend(fig, data)
    return fig


def residual_in_time(data: ReportData) -> Any | None:
    """How long an error lasts (autocorrelation) and in which cycles it lies. None for fewer than 20 rows."""
    rows = test_rows(data)
    if rows.sum() < 20:
        return None
    trip = data.row("trip")[rows]
    seconds, even = row_seconds(data, rows)
    longest = int(np.max(np.unique(trip, return_counts=True)[1]))
    lags = int(np.clip(longest // 4, 5, 60 if not even else max(60, min(300.0 / seconds, 600))))
    fig = figure(WIDTH, 2.9)
    left, right = fig.subplots(1, 2)
    lag = np.arange(lags + 1) * (seconds if even else 1)
    for when, _, colour in models(data):
        r = data.residual(when)[rows]
        left.plot(lag, autocorrelation(r, trip, lags), color=colour)
        period, variance = variance_by_period(r, trip, seconds if even else 1.0)
        if len(period):
            right.plot(period, variance, color=colour, marker="o", markersize=2.6)
    left.set_xlabel("time between two errors [s]" if even else "rows between two errors")
    left.set_ylabel("correlation")
    left.set_title("How long an error lasts")
    left.margins(x=0.01)
    tidy(left, zero=True)
    right.set_title("In which cycles the error lies")
    right.set_xlabel("length of a cycle [s]" if even else "length of a cycle [rows]")
    right.set_ylabel(f"variance per octave [{data.unit}²]")
    if right.lines:
        right.set_xscale("log")
        plain_log(right.xaxis)
        right.set_ylim(bottom=0)
        tidy(right)
    else:
        right.set_axis_off()
        right.text(0.5, 0.5, "trips too short for a spectrum", ha="center", color=GREY, transform=right.transAxes)
    legend(fig, data)
    return fig


def drift_course(data: ReportData) -> Any | None:
    """The smoothed course of what drifts, in one test trip; None where nothing does."""
    if not (c := data.summary.get("unexplained", {}).get("course")):
        return None
    fig = figure(WIDTH, 2.4)
    ax = fig.add_subplot(1, 1, 1)
    minutes = np.asarray(c["time_s"]) / 60.0
    left, mean, low, high = (np.asarray(c[k]) / 1e3 for k in ("left_w", "power_w", "lower_w", "upper_w"))
    ax.plot(minutes, left, ".", color=MEASURED, markersize=4, label="measured less predicted, by minute")
    ax.fill_between(minutes, low, high, color=AFTER, alpha=0.25, linewidth=0, label="90 % interval")
    ax.plot(minutes, mean, color=AFTER, label="smoothed")
    ax.axhline(0, color=GREY, linewidth=0.6)
    ax.set_title(f"What drifts, in {short(c['trip'], 30)}")
    ax.set_xlabel(axis_label("time since start of the trip", "min"))
    ax.set_ylabel("power [kW]")
    ax.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.1, ncols=3)  # beside the title
    tidy(ax)
    return fig
