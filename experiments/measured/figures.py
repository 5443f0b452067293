"""Figures of the page of measured logs: errors by trip, sizes by training set, and what a withheld channel changes."""

import io
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from experiments.measured.tables import Runs, SizeRow, all_found, found_ids, size_rows
from hdev_jax.report import names
from hdev_jax.report.canvas import AFTER, BEFORE, GREY, INK, axis_label, figure, png, style, tidy
from hdev_jax.report.figures import WIDTH, short

__all__ = ["errors", "sizes", "withheld"]

CONNECT, PALE = "#c4ccd3", "#7fb3d9"
SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def errors(blocks: Mapping[str, Sequence[tuple[str, float, float]]], title: str, unit: str) -> bytes:
    """A line for each test trip from the error before to the error after; `blocks[heading]` = (name, before, after)."""
    count = sum(map(len, blocks.values()))
    with style():
        fig = figure(WIDTH, 1.3 + 0.2 * count + 0.1 * len(blocks))
        ax = fig.add_subplot()
        labels, y, at = [], [], 0.0
        for heading, lines in blocks.items():
            for name, before, after in lines:
                ax.hlines(at, before, after, color=CONNECT, linewidth=2, zorder=1)
                ax.scatter([before], [at], s=30, color=BEFORE, zorder=3)
                ax.scatter([after], [at], s=30, color=AFTER, zorder=3)
                labels.append(f"{heading}{name}")
                y.append(at)
                at -= 1.0
            at -= 0.5
        ax.set_yticks(y, labels)
        ax.set_ylim(min(y) - 0.7, 0.7)
        ax.set_xlim(0, 1.06 * max(max(b, a) for lines in blocks.values() for _, b, a in lines))
        ax.set_xlabel(axis_label("RMSE per row on a trip not used for training", unit))
        ax.set_title(title)
        tidy(ax, grid="x")
        _legend(fig, [("before: declared model", BEFORE), ("after: with the effects found", AFTER)])
        return _small(fig)


def sizes(runs: Runs, title: str, head: str) -> bytes:
    """One panel a size: the value of each training set with its `interval_90`, in the unit of diagnosis.json."""
    rows = [row for row in size_rows(runs) if row.cells]
    columns = min(3, len(rows)) or 1
    deep = -(-len(rows) // columns) or 1
    labels = list(runs)
    with style():
        fig = figure(WIDTH, 0.5 + deep * (0.75 + 0.2 * len(labels)))
        axes = np.atleast_1d(fig.subplots(deep, columns)).ravel()
        for ax in axes[len(rows) :]:
            ax.set_axis_off()
        for k, (ax, row) in enumerate(zip(axes, rows, strict=False)):
            power = _power(row)
            for i, label in enumerate(labels):
                if label in row.cells:
                    value = row.cells[label][1] / 10.0**power
                    low, high = (x / 10.0**power for x in row.intervals[label])
                    bar = [[value - low], [high - value]]
                    ax.errorbar(value, -i, xerr=bar, fmt="o", color=AFTER, markersize=4.5, capsize=2.5)
                else:
                    there = {p.partition(".")[0] for p in row.paths} & set(found_ids(runs[label]))
                    said = "found, without this parameter" if there else "not found"
                    place: Any = {"transform": ax.get_yaxis_transform(), "ha": "center", "va": "center"}
                    ax.text(0.5, -i, said, color=GREY, fontsize=7.5, **place)
            ax.set_yticks(-np.arange(len(labels)), [f"{head} {label}" for label in labels] if k % columns == 0 else [])
            ax.set_ylim(-len(labels) + 0.4, 0.6)
            ax.set_title(_panel(row.paths), fontsize=8)
            ax.set_xlabel(_scaled(row.unit, power), labelpad=1)
            ax.margins(x=0.15)
            ax.locator_params(axis="x", nbins=5)
            if ax.get_xlim()[0] < 0 < ax.get_xlim()[1]:
                ax.axvline(0, color=GREY, linewidth=0.8, zorder=1)
            tidy(ax, grid="x")
        fig.suptitle(title, x=0.01, ha="left", fontsize=9.5, fontweight="bold")
        return _small(fig)


def withheld(runs: Mapping[str, Mapping[str, Any]], pairs: Mapping[str, str], title: str, unit: str) -> bytes:
    """Left: test RMSE before and after of each run; right: which effects each found.

    **Arguments:** `runs`, diagnosis.json by label, `fold: what is withheld`; `pairs[label]`, for a run
    without a channel, the run that has it: a dashed line marks the error of that one.
    """
    labels, ids = list(runs), all_found(runs)
    y = -np.arange(len(labels)).astype(float)
    with style():
        fig = figure(WIDTH, 1.5 + 0.26 * max(len(ids), 1.4 * len(labels)))
        left, right = fig.subplots(1, 2, width_ratios=[1.0, 1.75])
        for at, label in zip(y, labels, strict=True):
            before, after = (runs[label][when]["test"]["rmse"] for when in ("before", "after"))
            fill = "white" if label in pairs else AFTER
            left.hlines(at, after, before, color=CONNECT, linewidth=2, zorder=1)
            left.scatter([before], [at], s=32, color=BEFORE, zorder=3)
            left.scatter([after], [at], s=32, facecolor=fill, edgecolor=AFTER, zorder=3, linewidth=1.3)
            left.text(after, at + 0.2, f"{after:.2f}", ha="center", va="bottom", fontsize=7.5, color=INK)
            if label in pairs:
                full = runs[pairs[label]]["after"]["test"]["rmse"]
                left.vlines(full, at - 0.4, at + 0.15, color=AFTER, linewidth=1.0, linestyle=(0, (2, 1.5)), zorder=2)
        left.set_yticks(y, labels)
        left.set_ylim(y[-1] - 0.6, 0.8)
        left.set_xlim(0, 1.08 * max(r[when]["test"]["rmse"] for r in runs.values() for when in ("before", "after")))
        left.set_xlabel(axis_label("RMSE on test missions", unit))
        left.set_title(title)
        tidy(left, grid="x")
        for x, label in enumerate(labels):
            twins = {t for e in runs[label]["effects"] for t in e["indistinguishable_from"]}
            for k, id_ in enumerate(ids):
                colour = PALE if label in pairs else AFTER
                there = id_ in found_ids(runs[label])
                right.add_patch(_cell(x, -k, colour if there else "white", hatch=not there and id_ in twins))
        right.set_xlim(-0.55, len(labels) - 0.45)
        right.set_ylim(-len(ids) + 0.4, 0.6)
        right.set_yticks(-np.arange(len(ids)), [short(names.effect(i), 36) for i in ids])
        said = [
            ": ".join(part.replace(" ", "\n" if n else " ") for n, part in enumerate(x.split(": "))) for x in labels
        ]
        right.set_xticks(range(len(labels)), [x.replace(": ", "\n") for x in said])
        hatched = any(patch.get_hatch() for patch in right.patches)
        right.set_title("Effects found" + " (hatched: another of its class is)" * hatched)
        for side in ("left", "bottom"):
            right.spines[side].set_visible(False)
        right.tick_params(length=0)
        right.tick_params(axis="x", labelsize=7)
        withheld_ = {"markerfacecolor": "white", "markeredgecolor": AFTER, "markeredgewidth": 1.3}
        _legend(fig, [("before", BEFORE), ("after", AFTER), ("after, channel withheld (pale on the right)", withheld_),
                      ("dashed: with every channel", None)])  # fmt: skip
        return _small(fig)


def _small(fig: Any) -> bytes:
    """The figure as PNG with a palette of 64 colours: a third of the bytes, and nothing that the eye would miss."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.open(io.BytesIO(png(fig))).convert("RGB").quantize(64).save(buffer, format="png", optimize=True)
    return buffer.getvalue()


def _power(row: SizeRow) -> int:
    """The power of ten that an axis is drawn in: 0, or what brings very small or very large numbers to a few digits."""
    largest = max(abs(x) for interval in row.intervals.values() for x in interval)
    exponent = math.floor(math.log10(largest)) if largest else 0
    return exponent if exponent < -2 or exponent > 4 else 0


def _scaled(unit: str, power: int) -> str:
    text = f"10{str(power).translate(SUPERSCRIPT)}" if power else ""
    return " ".join(filter(None, (text, "(no unit)" if unit == "1" else unit)))


def _cell(x: float, y: float, colour: str, *, hatch: bool) -> Any:
    from matplotlib.patches import Rectangle

    marks: Any = {"hatch": "////"} if hatch else {}
    return Rectangle((x - 0.44, y - 0.4), 0.88, 0.8, facecolor=colour, edgecolor="#9aa4ad", linewidth=0.7, **marks)


def _panel(paths: Sequence[str]) -> str:
    """A size in few words; sizes of one class share a panel."""
    if len(paths) > 1:
        parts = [p.partition(".") for p in paths]
        return "one of a class:\n" + "\n".join(
            f"{short(names.effect(id_), 40)}: {names.parameter(name)}" for id_, _, name in parts
        )
    id_, _, name = paths[0].partition(".")
    return f"{short(names.effect(id_), 40)}:\n{names.parameter(name)}"


def _legend(fig: Any, entries: Sequence[tuple[str, str | Mapping[str, Any] | None]]) -> None:
    """One legend above the panels, where it covers nothing: words with a dot's colour or look, or, for None, a dash."""
    from matplotlib.lines import Line2D

    dash: Any = {"linestyle": (0, (2, 1.5)), "color": AFTER, "linewidth": 1.0}
    dot: Any = {"linestyle": "none", "marker": "o", "markersize": 5}
    handles = [
        Line2D([], [], label=w, **(dash if e is None else dot | ({"color": e} if isinstance(e, str) else dict(e))))
        for w, e in entries
    ]
    fig.legend(handles=handles, loc="outside upper right", ncols=len(handles), columnspacing=1.6)
