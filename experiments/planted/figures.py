"""Figures of the planted study: power against size, false discoveries against noise, confusion between causes."""

import textwrap
from collections.abc import Mapping, Sequence
from itertools import cycle
from typing import Any

import numpy as np
from matplotlib.patches import Rectangle

from experiments.planted.rivals import comparable
from experiments.planted.rivals_table import LABELS, outcome
from experiments.planted.scores import MOST, PLANTABLE, Group, names
from experiments.runner.figures import save_figure, styled
from experiments.runner.tables import wilson, worded
from hdev_jax.physics import LIBRARY
from hdev_jax.report import names as named
from hdev_jax.report.canvas import figure, tidy
from hdev_jax.rundir import Run

__all__ = ["confusion_figure", "false_figure", "power_figure", "share_figure"]

COLOURS = {
    "ours": "#1b4f8a",
    "ours_first": "#7fb3d9",
    "stlsq": "#c26a1f",
    "lasso_cv": "#3d8a5f",
    "forward_bic": "#8a3d6f",
}
LEAST_SIZES = 3  # of a curve
LEVEL = 5.0  # per cent of logs with nothing planted that may be given a name


def _methods(rivals: Sequence[str]) -> list[str]:
    known = [r for r in rivals if r in COLOURS]
    return ["ours", *(["ours_first"] if known else []), *known]


def _compared(done: Group, rivals: Sequence[str]) -> Group:
    """All logs; those that rivals could name too, where there are any."""
    return [(t, r) for t, r in done if not rivals or (r["rivals"] and comparable(t["effects"]))]


@styled
def power_figure(run: Run, done: Group, rivals: Sequence[str]) -> None:
    """Share named exactly, against the size of what was planted; single effects that the library holds.

    Its caller leaves out what is planted to be called something else than by its name.
    """
    done = _compared(done, rivals)
    single = [(t, r) for t, r in done if t["size"] and len(t["effects"]) == 1 and t["effects"][0] in LIBRARY]
    lengths = sorted({t["trips"] for t, _ in single})
    if not any(len({t["size"] for t, _ in single if t["trips"] == n}) >= LEAST_SIZES for n in lengths):
        return  # fewer are rows of a table
    fig = figure(6.4, 3.8)
    axes = fig.add_subplot()
    series = [(m, trips) for m in _methods(rivals) for trips in lengths]
    dashes = dict(zip(lengths, cycle(("--", "-", ":", "-."))))
    colours, lowest = list(COLOURS.values()), 0.0 if rivals else 50.0
    for k, (method, trips) in enumerate(series):
        points = []
        kinds = len({t["effects"][0] for t, _ in single if t["trips"] == trips})
        for size in sorted({t["size"] for t, _ in single}):
            hits = [outcome(t["effects"], r, method)[0] for t, r in single if (t["size"], t["trips"]) == (size, trips)]
            if hits:
                points.append((size, np.mean(hits), *wilson(sum(hits), len(hits))))
        if not points:
            continue
        # where one method stands alone, colours tell the lengths apart
        colour = COLOURS[method] if rivals else colours[k % len(colours)]
        x, y, low, high = np.array(points).T
        beside = x * 1.02 ** (k - (len(series) - 1) / 2)  # so that no interval hides another
        axes.plot(beside, 100 * y, dashes[trips], color=colour, marker="o", ms=4,
                  label=f"{LABELS[method]}, {trips} trips ({kinds} effects)")  # fmt: skip
        axes.vlines(beside, 100 * low, 100 * high, color=colour, lw=1)
        lowest = min(lowest, 95 * float(np.min(low)))
    axes.set(xscale="log", xlabel="effect/noise (RMS)", ylim=(lowest, 102),
             ylabel="named exactly [%]", title="Synthetic logs of road segments with one planted effect")  # fmt: skip
    sizes = sorted({t["size"] for t, _ in single})
    axes.set_xticks(sizes, [f"{s:g}" for s in sizes])
    axes.minorticks_off()
    tidy(axes)
    fig.legend(fontsize=7, loc="outside right center")
    save_figure(run, fig, "power")


@styled
def false_figure(run: Run, done: Group, rivals: Sequence[str]) -> None:
    """Share of logs with nothing planted in which something was named, by colour of the noise."""
    empty = [(t, r) for t, r in _compared(done, rivals) if not t["effects"]]
    if not any(outcome([], r, m)[1] for _, r in empty for m in _methods(rivals)):
        return  # a row of zeros is read from the table
    noises = list(dict.fromkeys(t["noise"] for t, _ in empty))
    methods = [m for m in _methods(rivals) if m != "ours_first"]  # no name is right here, with classes or without
    fig = figure(6.8, 3.6)
    axes = fig.add_subplot()
    highest = 10.0
    for i, method in enumerate(methods):
        for k, noise in enumerate(noises):
            hits = [outcome([], r, method)[1] for t, r in empty if t["noise"] == noise]
            low, high = wilson(sum(hits), len(hits))
            x, y = k + 0.8 * (i + 0.5) / len(methods) - 0.4, float(np.mean(hits))
            axes.bar(x, 100 * y, 0.75 / len(methods), color=COLOURS[method], label=LABELS[method] if k == 0 else None)
            axes.vlines(x, 100 * low, 100 * high, color="#333", lw=1)
            highest = max(highest, 102 * high)
    axes.axhline(LEVEL, color="#333", lw=0.8, ls=":", label=f"target: at most {LEVEL:g} %")
    axes.set_xticks(range(len(noises)), [textwrap.fill(worded(n), 12) for n in noises], fontsize=8)
    axes.set(ylabel="something named [%]", ylim=(0, highest), title="Synthetic logs with nothing missing")
    tidy(axes)
    fig.legend(fontsize=7, loc="outside right center")
    save_figure(run, fig, "false_discoveries")


@styled
def confusion_figure(run: Run, done: Group) -> None:
    """What was named (columns) where one effect was planted (rows), in per cent of its logs. A class that holds what
    was planted counts as that."""
    single = [(t, r) for t, r in done if len(t["effects"]) == 1]
    if not single:
        return
    planted = list(dict.fromkeys(t["effects"][0] for t, _ in single))
    others = {n["id"] for t, r in single for n in r["named"]} - set(planted)
    right = {p: names([p])[0] for p in planted}
    columns = list(dict.fromkeys(r for r in right.values() if r in LIBRARY))
    columns += [*sorted(others - set(columns)), "nothing"]
    share = np.zeros((len(planted), len(columns)))
    rows = []
    for i, p in enumerate(planted):
        logs = [r for t, r in single if t["effects"][0] == p]
        rows.append(f"{p.replace('_', ' ')} ({len(logs)})")
        for r in logs:
            for name in {right[p] if _answers(n, right[p]) else n["id"] for n in r["named"]} or {"nothing"}:
                share[i, columns.index(name)] += 100 / len(logs)
    outlined = [[right[p] if right[p] in LIBRARY else "nothing", *PLANTABLE[p].partly] for p in planted]
    share_figure(
        run, "confusion", rows, columns, share, outlined,
        ylabel="planted (logs)", title="Synthetic logs: what was named [%]",
    )  # fmt: skip


def _answers(entry: Mapping[str, Any], right: str) -> bool:
    return right in entry["class"] and entry["class_size"] <= MOST


def _in_words(name: str) -> str:
    """Of an effect, or of a declared coefficient."""
    return named.coefficient(name)[0] if "." in name else name.replace("_", " ")


def share_figure(
    run: Run, name: str, rows: Sequence[str], columns: Sequence[str], share: np.ndarray, right: Sequence[Sequence[str]],
    *, ylabel: str, title: str,
) -> None:  # fmt: skip
    """What was named (columns), in per cent of the logs of each row: a table in shades.

    **Arguments:** `right`, for each row the columns that are right; they are outlined.
    """
    fig = figure(max(0.32 * len(columns) + 2.5, 4.9), 0.3 * len(rows) + 1.8)  # the title's at least
    axes = fig.add_subplot()
    image = axes.imshow(share, cmap="Blues", vmin=0, vmax=100, aspect="auto")
    axes.set_xticks(range(len(columns)), [_in_words(c) for c in columns], rotation=90, fontsize=7.5)
    axes.set_yticks(range(len(rows)), rows, fontsize=7.5)
    for i, k in zip(*np.nonzero(share >= 0.5), strict=True):
        axes.text(k, i, f"{share[i, k]:.0f}", ha="center", va="center", fontsize=6,
                  color="white" if share[i, k] > 55 else "#222")  # fmt: skip
    for i, of_row in enumerate(right):
        for k in (columns.index(c) for c in of_row if c in columns):
            axes.add_patch(Rectangle((k - 0.5, i - 0.5), 1, 1, fill=False, edgecolor="#c26a1f", linewidth=1.2))
    axes.set(
        xlabel="named (outlined: right); logs with several names make a row sum to more than 100",
        ylabel=ylabel,
        title=title,
    )
    fig.colorbar(image, ax=axes, shrink=0.6, pad=0.02)
    save_figure(run, fig, name)
