"""What the networks' studies show: figures 6 and 7, errors by model, learning curves, maps over loss weights."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from experiments.pinn.results import MODELS, NAMED, OURS, PAPER_MODEL, in_words
from experiments.pinn.scores import TAUGHT, pooled
from experiments.runner.figures import save_figure, styled
from hdev_jax.errors import InputError
from hdev_jax.learn.pinn.fit import PAPER_WEIGHTS
from hdev_jax.report.canvas import AFTER, BEFORE, GREY, INK, figure, plain_log, tidy
from hdev_jax.rundir import Run

__all__ = ["coefficient_boxes", "learning_curves", "model_bars", "weight_maps"]

MOST_BARS = 20


@styled
def coefficient_boxes(run: Run, quantiles: Mapping[str, Any], name: str, label: str) -> None:
    """Figures 6 and 7: the prediction by truck model, and what the paper could not know, the truth."""
    ways = [k for k in (PAPER_MODEL, OURS) if k in quantiles]
    if not ways:
        raise InputError("every training of the networks diverged; lower the rate")
    models = [m for m in MODELS if all(m in quantiles[k] for k in ways)]
    fig = figure(8.0, 3.4)
    ax = fig.add_subplot()
    for i, m in enumerate(models):
        for j, way in enumerate(ways):
            c = quantiles[way][m]
            _spread(ax, i + 0.25 * (j - 1), c[name], (BEFORE, AFTER)[way == OURS], in_words(way) if i == 0 else None)
        _spread(ax, i + 0.25, quantiles[ways[0]][m][f"{name}_true"], GREY, "truth (synthetic)" if i == 0 else None)
        table = quantiles.get("tables", {}).get(m)
        if table:
            ax.plot([i - 0.4, i + 0.4], [table[name][2]] * 2, color="#c03030", linewidth=1.4,
                    label="value from tables" if i == 0 else None)  # fmt: skip
    ax.set_xticks(range(len(models)), [f"type {m}" for m in models])
    ax.set_ylabel(label)
    ax.set_ylim(bottom=0)
    ax.set_title(f"{label} on test routes of the synthetic fleet: 5, 25, 50, 75, 95 %")
    ax.legend(ncols=4, loc="upper left")
    ax.set_ylim(top=1.25 * ax.get_ylim()[1])
    tidy(ax)
    save_figure(run, fig, name)


def _spread(ax: Any, at: float, q: Sequence[float], colour: str, label: str | None) -> None:
    """A box of five quantiles."""
    box = {"whislo": q[0], "q1": q[1], "med": q[2], "q3": q[3], "whishi": q[4]}
    drawn = ax.bxp([box], positions=[at], widths=0.2, showfliers=False, patch_artist=True, manage_ticks=False)
    drawn["boxes"][0].set(facecolor=colour, alpha=0.6)
    drawn["medians"][0].set(color="black")
    if label:
        ax.plot([], [], color=colour, linewidth=5, alpha=0.6, label=label)


@styled
def model_bars(run: Run, gathered: Mapping[tuple[str, str], list[dict[str, Any]]], data: str) -> None:
    """RMSE and PE of every model on test rows, the best first; of many models, those with all of their parts."""
    test = [(way, pooled(f)) for (way, use), f in gathered.items() if use == "test"]
    if len(test) > MOST_BARS:
        test = [(way, p) for way, p in test if way in NAMED or not way.endswith("alone")]
    test.sort(key=lambda x: x[1]["rmse_wh"])
    fig = figure(9.0, 0.9 + 0.28 * len(test))
    for k, (key, label) in enumerate((("rmse_wh", "RMSE [Wh]"), ("pe_percent", "PE of all trips [%]"))):
        ax = fig.add_subplot(1, 2, k + 1)
        colours = [AFTER if way == OURS else BEFORE if way == PAPER_MODEL else GREY for way, _ in test]
        ax.barh(range(len(test)), [p[key] for _, p in test], color=colours, alpha=0.75)
        ax.set_yticks(range(len(test)), [in_words(way) for way, _ in test] if k == 0 else [])
        ax.set_ylim(len(test) - 0.4, -0.6)
        ax.set_xlabel(label)
        ax.axvline(0, color="black", linewidth=0.6)
        tidy(ax, grid="x")
    fig.suptitle(f"Errors on test rows, {data}; blue: our network, orange: the paper's network")
    save_figure(run, fig, "models")


@styled
def learning_curves(
    run: Run, curves: Mapping[tuple[str, str], list[tuple[float, list[float]]]], routes: Mapping[float, int]
) -> None:
    """Error by how many routes train (`routes` by share): median over seeds, and a band of all."""
    uses = [u for u in ("test", TAUGHT, "unseen") if any(k[1] == u for k in curves)]
    fig = figure(4.6 * len(uses), 3.6)
    for i, use in enumerate(uses):
        ax = fig.add_subplot(1, len(uses), i + 1)
        for way in dict.fromkeys(k[0] for k in curves if k[1] == use and "alone" not in k[0]):
            points = curves[way, use]
            x = [routes[s] for s, _ in points]
            drawn = ax.plot(x, [np.median(v) for _, v in points], "o-", markersize=3, label=in_words(way))
            ax.fill_between(x, [min(v) for _, v in points], [max(v) for _, v in points], alpha=0.2,
                            color=drawn[0].get_color(), linewidth=0)  # fmt: skip
        ax.set_xscale("log")
        ax.set_yscale("log")
        ax.set_xlabel("training routes")
        ax.set_ylabel("RMSE [Wh]")
        ax.set_xticks(sorted({routes[s] for k, points in curves.items() if k[1] == use for s, _ in points}))
        for axis in (ax.xaxis, ax.yaxis):
            plain_log(axis)
        ax.minorticks_off()
        ax.set_yticks(
            [y for y in (5, 7, 10, 15, 20, 30, 50, 70, 100, 200) if ax.get_ylim()[0] <= y <= ax.get_ylim()[1]]
        )
        title = {"test": "Test routes", TAUGHT: "Test routes, vehicles trained on", "unseen": "Never trained on"}
        ax.set_title(title[use] + " (synthetic)")
        ax.legend(fontsize=7)
        tidy(ax)
    save_figure(run, fig, "shares")


@styled
def weight_maps(run: Run, found: Mapping[tuple[float, ...], float]) -> None:
    """RMSE over pairs of loss weights, the third as the paper printed it."""
    pairs = [(i, j) for i, j in ((1, 2), (0, 1), (0, 2))
             if len({(w[i], w[j]) for w in found if _held(w, i, j)}) > 3]  # fmt: skip
    fig = figure(3.6 * max(len(pairs), 1), 3.2)
    low, high = min(found.values()), np.percentile(list(found.values()), 95)
    for k, (i, j) in enumerate(pairs):
        part = {(w[i], w[j]): x for w, x in found.items() if _held(w, i, j)}
        rows, columns = sorted({a for a, _ in part}), sorted({b for _, b in part})
        values = np.array([[part.get((a, b), np.nan) for b in columns] for a in rows])
        ax = fig.add_subplot(1, len(pairs), k + 1)
        ax.imshow(values, origin="lower", vmin=low, vmax=high, cmap="viridis_r", aspect="auto")
        for a in range(len(rows)):
            for b in range(len(columns)):
                dark = values[a, b] > 0.5 * (low + high)
                ax.text(b, a, f"{values[a, b]:.1f}", ha="center", va="center", fontsize=7, color="w" if dark else INK)
        ax.set_xticks(range(len(columns)), [f"{x:g}" for x in columns])
        ax.set_yticks(range(len(rows)), [f"{x:g}" for x in rows])
        ax.set_xlabel(f"λ{'₁₂₃'[j]}")
        ax.set_ylabel(f"λ{'₁₂₃'[i]}")
        third = ({0, 1, 2} - {i, j}).pop()
        ax.set_title(f"RMSE [Wh], λ{'₁₂₃'[third]} = {PAPER_WEIGHTS[third]:g} (synthetic)")
    save_figure(run, fig, "grid")


def _held(w: tuple[float, ...], i: int, j: int) -> bool:
    """Whether the weight that is in neither axis is the printed one."""
    return all(w[k] == PAPER_WEIGHTS[k] for k in range(3) if k not in (i, j))
