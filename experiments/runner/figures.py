"""Figures of a run, and of a page of many: the project's look, PNG and PDF."""

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from hdev_jax.report.canvas import AFTER, BEFORE, GREY, INK, figure, plain_log, png, style, tidy
from hdev_jax.rundir import Run

__all__ = ["LEAST_COMPARED", "against_paper", "save_figure", "styled"]

LEAST_COMPARED = 3  # models beside the paper's in a figure; fewer are read from the table


def styled(draw: Callable[..., None]) -> Callable[..., None]:
    """The project's look while a figure is drawn and saved."""

    @functools.wraps(draw)
    def inside(*args: Any, **kwargs: Any) -> None:
        with style():
            draw(*args, **kwargs)

    return inside


def save_figure(run: Run, fig: Any, name: str) -> None:
    """`figures/NAME.png` and `figures/NAME.pdf`, the same bytes each time."""
    run.path("figures", f"{name}.png").write_bytes(png(fig))
    fig.savefig(run.path("figures", f"{name}.pdf"), metadata={"CreationDate": None, "Creator": None, "Producer": None})


def against_paper(rows: Sequence[Mapping[str, Any]]) -> bytes | None:
    """The deciding error of each model over the paper's, as PNG; None where fewer than `LEAST_COMPARED` have both.

    **Arguments:** `rows`: `part, name, quantity, paper, ours, ratio` (`compare.merged`) and, over all random starts of
    a fit, `range over starts`. Those without a ratio, or of 0, are left out.
    """
    models = [x for x in rows if x["ratio"]]
    if len(models) < LEAST_COMPARED:
        return None
    with style():
        fig = figure(7.0, 0.9 + 0.24 * len(models))
        ax = fig.subplots()
        ends = []
        for i, x in enumerate(models):
            ratio = x["ratio"]
            span = [abs(end / x["paper"]) for end in x.get("range over starts") or ()]
            if span:
                ax.plot(span, [i, i], color="#c3cad1", linewidth=4, solid_capstyle="butt")
            ax.plot(ratio, i, "o", color=AFTER if ratio <= 1.0 else BEFORE, markersize=5)
            ax.annotate(f"{ratio:.2f}", (ratio, i), (0, 4), textcoords="offset points", ha="center",
                        va="bottom", fontsize=6.5, color=INK)  # fmt: skip
            ends += [1.0, ratio, *span]
        ax.axvline(1.0, color=GREY, linewidth=0.9)
        ax.set_yticks(range(len(models)), [f"{x['name']}, {x['quantity']} ({x['part']})" for x in models])
        ax.set_ylim(len(models) - 0.5, -0.7)
        ax.set_xscale("log")
        low, high = min(ends) / 1.15, max(ends) * 1.15
        ax.set_xlim(low, high)
        ticks = (0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0, 5.0, 10.0, 20.0, 50.0, 100.0)
        ax.set_xticks([t for t in ticks if low <= t <= high])
        plain_log(ax.xaxis)
        ax.minorticks_off()
        ax.set_xlabel("ratio; grey: range over random starts")
        fig.suptitle("Our error over the paper's: below 1 ours is smaller", fontsize=10)
        tidy(ax, grid="x")
        return png(fig)
