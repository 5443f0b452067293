"""Pages of the networks' sweeps: error against the amount of data, and over loss weights."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from experiments.pinn.figures import learning_curves, weight_maps
from experiments.pinn.results import HELD, OURS, Results, diverged, gathered_scores, given, in_words, still_better
from experiments.pinn.scores import TAUGHT, pooled
from experiments.runner.tables import write_tables
from hdev_jax.errors import InputError
from hdev_jax.rundir import Run

__all__ = ["grid", "shares"]


def shares(config: Any, results: Results, run: Run) -> dict[str, Any]:
    """Error by the amount of training data: a learning curve of each model, with the spread over seeds."""
    lines, curves, routes = [], {}, {}
    for share in sorted({t["data"]["share"] for t, _ in results}):
        part = [(t, r) for t, r in results if t["data"]["share"] == share]
        counts = next((r["counts"] for _, r in part if "counts" in r), None)
        routes |= {share: counts["routes"]} if counts and counts["routes"] else {}
        gathered = gathered_scores(part)
        if any(use == TAUGHT for _, use in curves) and not any(use == TAUGHT for _, use in gathered):
            # by now every vehicle has training routes
            gathered |= {(way, TAUGHT): found for (way, use), found in gathered.items() if use == "test"}
        for (way, use), found in gathered.items():
            seeds = [pooled([f])["rmse_wh"] for f in found]
            curves.setdefault((way, use), []).append((share, seeds))
            lines.append({"share [%]": 100.0 * share, "training routes": counts and counts["routes"],
                          "model": in_words(way), "evaluated on": use, "RMSE [Wh]": float(np.median(seeds)),
                          "smallest": min(seeds), "largest": max(seeds), "PE [%]": pooled(found)["pe_percent"],
                          "training rows": counts and counts["training"],
                          "n": found[0]["rows"], "seeds": len(seeds)})  # fmt: skip
    write_tables(run, "shares", lines, config.caption)
    learning_curves(run, curves, routes)
    return {
        "artefact": config.artefact, "data": "synthetic fleet", "synthetic": True, "better_than_paper": 0, "of": 0,
        "rows": [{"name": f"{x['model']}, {x['share [%]']:g} %, {x['evaluated on']}", "paper": None,
                  "ours": {"rmse_wh": x["RMSE [Wh]"], "pe_percent": x["PE [%]"]}} for x in lines],
        "missed": _against_black_boxes(config, curves),
        "notes": [
            "Figure: the line is the median over seeds, the band covers all of them. A seed draws a network's first "
            "weights; routes are drawn once, and LightGBM draws nothing",
            f"{TAUGHT}: vehicles without a training route are left out",
            HELD, *given(results), *still_better(results), *diverged(results),
        ],
    }  # fmt: skip


def _against_black_boxes(config: Any, curves: Mapping[tuple[str, str], list[tuple[float, list[float]]]]) -> list[str]:
    """Where ours is not 30 % better than the network without physics or LightGBM, at the least data and on unseen."""
    out = []
    if (OURS, "test") not in curves:
        return out
    for use in ("test", TAUGHT, "unseen"):
        for other in ("network without physics", "network, no kernel", "lightgbm", "LightGBM, no kernel"):
            if (other, use) not in curves or (OURS, use) not in curves:
                continue
            others, mine_at = dict(curves[other, use]), dict(curves[OURS, use])
            for share in sorted(others)[: None if use == "unseen" else 1]:
                if share not in mine_at:
                    out.append(f"{100 * share:g} % of the routes, {use}: our network has no result")
                    continue
                ratio = float(np.median(mine_at[share]) / np.median(others[share]))
                if ratio > 0.7:
                    out.append(
                        f"{100 * share:g} % of the routes, {use}: RMSE {ratio:.3g} times that of {in_words(other)}, "
                        "target 0.7"
                    )
    return out


def grid(config: Any, results: Results, run: Run) -> dict[str, Any]:
    """Heat maps of the error over pairs of loss weights, the third as printed; medians over seeds."""
    found: dict[tuple[float, ...], list[float]] = {}
    for task, result in results:
        if "network" in result:
            found.setdefault(tuple(task["weights"]), []).append(pooled([result["network"]["test"]])["rmse_wh"])
    if not found:
        raise InputError("every training of the grid diverged; lower the rate")
    lines = [{"λ₁": w[0], "λ₂": w[1], "λ₃": w[2], "seeds": len(x), "RMSE [Wh]": float(np.median(x)), "smallest": min(x),
              "largest": max(x)} for w, x in sorted(found.items())]  # fmt: skip
    write_tables(run, "grid", lines, config.caption)
    weight_maps(run, {w: float(np.median(x)) for w, x in found.items()})
    best = min(lines, key=lambda x: x["RMSE [Wh]"])
    lost = sum("diverged" in r for _, r in results)
    where = f"{best['λ₁']:g}, {best['λ₂']:g}, {best['λ₃']:g}"
    medians, spread = [x["RMSE [Wh]"] for x in lines], max(x["largest"] - x["smallest"] for x in lines)
    note = (
        f"The lowest median RMSE is {best['RMSE [Wh]']:.2f} Wh, at λ = {where}; the {len(lines)} medians differ by at "
        f"most {max(medians) - min(medians):.1f} Wh, the seeds of one setting by at most {spread:.1f} Wh; {lost} of "
        f"{len(results)} trainings diverged"
    )
    return {
        "artefact": config.artefact, "data": "synthetic fleet", "synthetic": True, "better_than_paper": 0, "of": 0,
        "rows": [{"name": f"{x['λ₁']:g}, {x['λ₂']:g}, {x['λ₃']:g}", "paper": None, "ours": {"rmse_wh": x["RMSE [Wh]"]}}
                 for x in lines],
        "missed": [], "findings": [note], "notes": ["Table 2 has the paper's weights, not the best of this grid"],
    }  # fmt: skip
