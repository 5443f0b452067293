"""Pages of the networks' studies: the table with figures 6 and 7, error against the amount of data, loss weights."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from experiments.pinn.figures import (
    MODELS,
    NAMED,
    OURS,
    PAPER_MODEL,
    coefficient_boxes,
    in_words,
    learning_curves,
    model_bars,
    weight_maps,
)
from experiments.pinn.results import (
    FORM,
    PHYSICS,
    WAYS,
    Results,
    distinct,
    diverged,
    gathered_scores,
    still_better,
    trainings,
)
from experiments.pinn.scores import QUANTILES, TAUGHT, pooled
from experiments.runner.tables import write_tables
from hdev_jax.errors import InputError
from hdev_jax.physics import LIBRARY
from hdev_jax.report import names
from hdev_jax.rundir import Run

__all__ = ["coefficients", "grid", "shares", "table"]

THEIRS = "the paper's RMSE and PE are of its private fleet; ours are of {}, so that the two are not comparable"
HELD = ("the inputs include the energy of the calibrated kernel and the efficiencies at its operating point, so only "
        "models with 'log columns only' are without physics")  # fmt: skip
GIVEN = "models 'ours' and 'known effects' are given the effects that the fleet hides"
DIAGNOSED = "models 'as diagnosed' have the effects that the diagnosis of training routes names"
RATIO = "coefficient error: size of the median ratio of predicted to true value, minus one; spray counts as air drag"
LEARNED = f"{OURS} without effects"
LEAST_LEARNED = 0.05  # of the squared error; a share of less says nothing
NAMEABLE = {
    WAYS["kernel"]: "a linear fit of the known effects",
    f"{OURS}, effects as diagnosed, {FORM}": "a linear fit of the effects named by diagnosis, for all vehicles,",
}


def _line(
    name: str, use: str, found: list[dict[str, Any]], of: tuple[int, int], paper: Mapping[str, float]
) -> dict[str, Any]:
    """A row of the table; of several seeds, errors are of all of them together."""
    p = pooled(found)
    return {
        "model": in_words(name) if use == "test" else f"{in_words(name)}: {use}",
        "RMSE [Wh]": p["rmse_wh"], "paper RMSE": paper.get("rmse"),
        "PE [%]": p["pe_percent"], "paper PE": paper.get("pe"), "|PE| of a trip, median [%]": p["trip_pe_median"],
        "c_rr error, median of vehicles [%]": p.get("c_rr_error_percent"),
        "C_d·A error, median of vehicles [%]": p.get("cda_m2_error_percent"),
        "coverage of 90 % interval": p.get("share_inside_90"),
        "PE of a trip, mean [%]": p["trip_pe_mean"], "n": of[0], "trips": of[1],
    }  # fmt: skip


def table(config: Any, results: Results, run: Run) -> dict[str, Any]:
    """Every model on the same rows, the paper's numbers beside those that it prints."""
    gathered = gathered_scores(results)
    data = "measured (ZTBus)" if config.data == "ztbus" else "synthetic fleet"
    every = distinct(results)
    rows, lines = [], []
    for (way, use), found in gathered.items():
        p = pooled(found)
        name = NAMED.get(way, way)
        paper = config.paper.get(name) if use == "test" else None
        lines.append(_line(way, use, found, every[way, use], paper or {}))
        mine = {"rmse": p.pop("rmse_wh"), "pe": p.pop("pe_percent"), **p}
        rows.append({"name": name if use == "test" else f"{name} ({use})", "paper": paper, "ours": mine})
    for model, (n, lost) in trainings(results).items():
        if n == lost:
            name, said = NAMED.get(model, model), f"diverged, {lost} of {n} trainings"
            lines.append({"model": f"{in_words(model)}: {said}", "n": 0})
            rows.append({"name": name, "paper": config.paper.get(name), "ours": None, "reason": said})
    write_tables(run, "table", lines, config.caption)
    at_bound = _at_bound(results)
    if at_bound:
        bound = [
            {"model": in_words(n), "c_rr": 100 * b["c_rr"], "C_d·A": 100 * b["cda_m2"]} for n, b in at_bound.items()
        ]
        caption = "Test rows whose predicted coefficient lies within 1 % of the end of its range, over all seeds [%]"
        write_tables(run, "bounds", bound, caption)
    effects = _effects(results)
    if effects:
        write_tables(
            run, "effects", effects, "Effects found by diagnosing single vehicles: in how many, median of parameters"
        )
    model_bars(run, gathered, data)
    used = {t["name"]: r["effects"] for t, r in results if "effects" in r and t["model"].get("effects")}
    return {
        "artefact": config.artefact, "data": data, "synthetic": config.data == "fleet", "rows": rows,
        "better_than_paper": 0, "of": 0, "headline": "rmse", "missed": _missed(config, gathered, at_bound),
        "findings": [
            *([THEIRS.format("measured buses" if config.data == "ztbus" else "a synthetic one with other noise")]
              if any(r["paper"] for r in rows) else []),
            *([GIVEN] if config.data == "fleet" else []),
            *([DIAGNOSED] if any("diagnosed" in way for way, _ in gathered) else []),
            *_of_fewer(lines),
        ],
        "notes": [
            "training, validation and test sets are split by route" if config.data == "fleet"
            else "the test missions of each fold are held out",
            HELD,
            *([RATIO] if any(x.get("c_rr error, median of vehicles [%]") is not None for x in lines) else []),
            *diverged(results),
            *still_better(results),
            *(f"effects in '{way}': {', '.join(map(names.effect, e)) or 'none'}" for way, e in used.items()),
            *_nameable(gathered),
        ],
    }  # fmt: skip


def _of_fewer(lines: list[dict[str, Any]]) -> list[str]:
    """Models that were evaluated on fewer trips than the others: their errors do not compare."""
    tested = [x for x in lines if x.get("trips") and ": " not in x["model"]]
    most = max((x["trips"] for x in tested), default=0)
    return [
        f"'{x['model']}' was evaluated on {x['trips']} of the {most} trips, so that its errors do not compare"
        for x in tested if x["trips"] < most
    ]  # fmt: skip


def _nameable(gathered: Mapping[tuple[str, str], list[dict[str, Any]]]) -> list[str]:
    """How much of what a network learns named effects explain: the squared error that the physics with effects takes
    off the calibrated declared physics, over what ours without effects takes off (over 100 %: the network misses some).
    """
    square = {way: pooled(f)["rmse_wh"] ** 2 for (way, use), f in gathered.items() if use == "test"}
    base, learned = square.get(WAYS["bayesian"]), square.get(LEARNED)
    if base is None or learned is None or base - learned < LEAST_LEARNED * base:
        return []
    what = (
        f"'{LEARNED}' lowers the RMSE of the calibrated declared physics from {base**0.5:.4g} to {learned**0.5:.4g} Wh"
    )
    out = []
    for way, whose in NAMEABLE.items():
        if way in square:
            share = (base - square[way]) / (base - learned)
            removed = f"lowers the squared error {share:.2f} times as much" if share > 0 else "does not lower the error"
            out.append(f"{what}; {whose} {removed}, without a network")
    return out


def coefficients(config: Any, results: Results, run: Run) -> dict[str, Any]:
    """Figures 6 and 7: quantiles of a coefficient by truck model, the truth beside."""
    quantiles, name = _quantiles(results), config.coefficient
    coefficient_boxes(run, quantiles, name, {"c_rr": "c_rr", "cda_m2": "C_d·A [m²]"}[name])
    rows, lines = [], []
    for way, found in quantiles.items():
        for m in MODELS:
            if way not in ("tables", PAPER_MODEL, OURS) or m not in found:
                continue
            q, t = found[m][name], found[m][f"{name}_true"]
            lines.append({"vehicle": m, "method": in_words(way),
                          **{f"{k} %": x for k, x in zip(QUANTILES, q, strict=True)},
                          "coefficient error [%]": 100 * found[m][f"{name}_error"]})  # fmt: skip
            rows.append({"name": f"{m}, {way}", "paper": None, "ours": {"median": q[2], "true_median": t[2]}})
    write_tables(run, "coefficients", lines, config.caption)
    return {
        "artefact": config.artefact, "data": "synthetic fleet", "synthetic": True, "rows": rows,
        "better_than_paper": 0, "of": 0, "missed": [],
        "notes": [
            "the paper prints no numbers for its boxes, and its true values are unknown",
            "coefficient error: size of the median over rows of predicted over true value, minus one; it is not the "
            "error of the column 50 %",
            *diverged(results),
        ],
    }  # fmt: skip


def _missed(config: Any, gathered: Mapping[Any, list[dict[str, Any]]], at_bound: Mapping[str, Any]) -> list[str]:
    """What ours is meant to reach, and does not."""
    test = {way: pooled(f) for (way, use), f in gathered.items() if use == "test"}
    out = []
    if {PAPER_MODEL, f"{PAPER_MODEL}, {PHYSICS}", WAYS["tabular"]} <= set(test) and config.data == "fleet":
        order = [test[k]["rmse_wh"] for k in (PAPER_MODEL, f"{PAPER_MODEL}, {PHYSICS}", WAYS["tabular"])]
        if not order[0] < order[1] < order[2]:
            out.append("RMSE is not in the order of table 2: " + ", ".join(f"{x:.2f}" for x in order))
    if OURS in test:
        mine = test[OURS]
        limit = 1.0 if config.data == "fleet" else 3.0
        pe = mine["pe_percent"] if config.data == "fleet" else mine["trip_pe_mean"]
        if abs(pe) > limit:
            out.append(f"ours: PE {pe:+.2f} %, target ±{limit:g}")
        if PAPER_MODEL in test and mine["rmse_wh"] > 0.9 * test[PAPER_MODEL]["rmse_wh"]:
            out.append(f"ours: RMSE {mine['rmse_wh'] / test[PAPER_MODEL]['rmse_wh']:.3g} times the paper's, target 0.9")
        best = min(test, key=lambda k: test[k]["rmse_wh"])
        if config.data == "ztbus" and best != OURS:
            out.append(f"ours: RMSE {mine['rmse_wh']:.1f} Wh, the best is {best} with {test[best]['rmse_wh']:.1f}")
        for k in ("c_rr", "cda_m2"):
            if mine.get(f"{k}_error_percent", 0.0) > 5.0:
                out.append(f"ours: {k} off by {mine[f'{k}_error_percent']:.1f} % in the median of vehicles, target 5")
            if mine.get(f"{k}_error_worst", 0.0) > 5.0:
                out.append(f"ours: {k} off by {mine[f'{k}_error_worst']:.1f} % in the worst vehicle, target 5")
    out += [f"{n}: {100 * max(b.values()):.1f} % at a bound" for n, b in at_bound.items() if n == OURS]
    return out


def _at_bound(results: Results) -> dict[str, dict[str, float]]:
    """By model, the shares of predictions at a bound of each coefficient, over all its seeds and folds."""
    found: dict[str, list[dict[str, int]]] = {}
    for task, result in results:
        if "at_bound" in result:
            found.setdefault(task["name"], []).append(result["at_bound"])
    return {
        name: {k: sum(b[k] for b in every) / sum(b["rows"] for b in every) for k in ("c_rr", "cda_m2")}
        for name, every in found.items()
    }


def _effects(results: Results) -> list[dict[str, Any]]:
    """Effects by how many vehicles' diagnoses named them, with medians of their parameters."""
    found = [r["found"] for _, r in results if "found" in r]
    out = []
    for id in sorted({e for f in found for e in f}, key=lambda e: -sum(e in f for f in found)):
        having = [f[id] for f in found if id in f]
        keys = sorted({k for h in having for k in h})
        values = {k: float(np.median([h[k] for h in having if k in h])) for k in keys}
        units = {p.name: p.unit for p in LIBRARY[id].parameters} if id in LIBRARY else {}
        text = ", ".join(
            f"{names.parameter(k, id)} {_with_unit(x, units.get(k.partition('[')[0]))}" for k, x in values.items()
        )
        out.append({"effect": names.effect(id), "vehicles": f"{len(having)} of {len(found)}", "median": text})
    return out


def _with_unit(x: float, unit: str | None) -> str:
    return f"{x:.3g}" if unit in (None, "1") else f"{x:.3g} {unit}"


def _quantiles(results: Results) -> dict[str, dict[str, Any]]:
    """Quantiles of coefficients by network and vehicle, of the first seed."""
    out: dict[str, dict[str, Any]] = {}
    for task, result in results:
        if task["model"]["kind"] == "vehicles":
            tab = result.get("tabular", {}).get("test", {}).get("coefficients", {})
            for id, c in tab.items():
                out.setdefault("tables", {})[id] = c
        elif "network" in result:
            into = out.setdefault(task["name"], {})
            for id, c in result["network"].get("test", {}).get("coefficients", {}).items():
                into.setdefault(id, c)
    return out


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
            HELD, GIVEN, *still_better(results), *diverged(results),
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
                    out.append(f"{100 * share:g} % of the routes, {use}: ours has no result")
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
