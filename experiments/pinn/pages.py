"""Pages of the networks' studies: the table of models, and figures 6 and 7."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from experiments.pinn.figures import coefficient_boxes, model_bars
from experiments.pinn.results import (
    FORM,
    HELD,
    MODELS,
    OURS,
    PAPER_MODEL,
    PHYSICS,
    WAYS,
    Results,
    distinct,
    diverged,
    gathered_scores,
    given,
    in_words,
    named,
    still_better,
    trainings,
)
from experiments.pinn.scores import QUANTILES, pooled
from experiments.runner.tables import write_tables
from hdev_jax.physics import LIBRARY
from hdev_jax.report import names, words
from hdev_jax.rundir import Run

__all__ = ["coefficients", "table"]

THEIRS = (
    "the paper's RMSE and PE (percentage error of the total energy, with its sign) are of its private fleet; ours are "
    "of {}, so that the two are not comparable"
)
RATIO = "coefficient error: median ratio of predicted to true value, minus one, no sign; spray counts as air drag"
LEARNED = f"{OURS} without effects"
LEAST_LEARNED = 0.05  # of the squared error; a share of less says nothing
NAMEABLE = (WAYS["kernel"], f"{OURS}, effects as diagnosed, {FORM}")


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
        name = named(way)
        paper = config.paper.get(name) if use == "test" else None
        lines.append(_line(way, use, found, every[way, use], paper or {}))
        mine = {"rmse": p.pop("rmse_wh"), "pe": p.pop("pe_percent"), **p}
        rows.append({"name": name if use == "test" else f"{name} ({use})", "paper": paper, "ours": mine})
    for model, (n, lost) in trainings(results).items():
        if n == lost:
            name, said = named(model), f"diverged, {lost} of {n} trainings"
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
            *(given(results) if config.data == "fleet" else []),
            *_of_fewer(lines),
        ],
        "notes": [
            "training, validation and test sets are split by route" if config.data == "fleet"
            else "the test missions of each fold are held out",
            HELD,
            *([RATIO] if any(x.get("c_rr error, median of vehicles [%]") is not None for x in lines) else []),
            *diverged(results),
            *still_better(results),
            *(f"effects in '{in_words(way)}': {', '.join(map(names.effect, e)) or 'none'}" for way, e in used.items()),
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
    off the calibrated declared physics, over what our network without effects takes off (over 1: it misses some).
    """
    square = {way: pooled(f)["rmse_wh"] ** 2 for (way, use), f in gathered.items() if use == "test"}
    base, learned = square.get(WAYS["bayesian"]), square.get(LEARNED)
    if base is None or learned is None or base - learned < LEAST_LEARNED * base:
        return []
    parts = [
        f"{(base - square[way]) / (base - learned):.2f} by '{in_words(way)}' ({square[way] ** 0.5:.4g} Wh)"
        for way in NAMEABLE if way in square
    ]  # fmt: skip
    if not parts:
        return []
    return [
        f"how far named effects, without a network, lower the mean squared error of the calibrated declared physics "
        f"(RMSE {base**0.5:.4g} Wh), as a multiple of what '{in_words(LEARNED)}' lowers it ({learned**0.5:.4g} Wh): "
        f"{', '.join(parts)}"
    ]


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
            rows.append({"name": f"{m}, {named(way)}", "paper": None, "ours": {"median": q[2], "true_median": t[2]}})
    write_tables(run, "coefficients", lines, config.caption)
    return {
        "artefact": config.artefact, "data": "synthetic fleet", "synthetic": True, "rows": rows,
        "better_than_paper": 0, "of": 0, "missed": [],
        "notes": [
            "the paper prints no numbers for its boxes, and its true values are unknown",
            "coefficient error: median over rows of predicted over true value, minus one, without its sign; it is "
            "not the error of the column 50 %",
            *diverged(results),
        ],
    }  # fmt: skip


def _missed(config: Any, gathered: Mapping[Any, list[dict[str, Any]]], at_bound: Mapping[str, Any]) -> list[str]:
    """What ours is meant to reach, and does not."""
    test = {way: pooled(f) for (way, use), f in gathered.items() if use == "test"}
    every, out = [], []
    if {PAPER_MODEL, f"{PAPER_MODEL}, {PHYSICS}", WAYS["tabular"]} <= set(test) and config.data == "fleet":
        order = [test[k]["rmse_wh"] for k in (PAPER_MODEL, f"{PAPER_MODEL}, {PHYSICS}", WAYS["tabular"])]
        if not order[0] < order[1] < order[2]:
            every.append("RMSE is not in the order of table 2: " + ", ".join(f"{x:.2f}" for x in order))
    if OURS in test:
        mine = test[OURS]
        limit = 1.0 if config.data == "fleet" else 3.0
        pe = mine["pe_percent"] if config.data == "fleet" else mine["trip_pe_mean"]
        if abs(pe) > limit:
            out.append(f"PE {pe:+.2f} %, target ±{limit:g}")
        if PAPER_MODEL in test and mine["rmse_wh"] > 0.9 * test[PAPER_MODEL]["rmse_wh"]:
            out.append(f"RMSE {mine['rmse_wh'] / test[PAPER_MODEL]['rmse_wh']:.3g} times the paper's, target 0.9")
        best = min(test, key=lambda k: test[k]["rmse_wh"])
        if config.data == "ztbus" and best != OURS:
            out.append(f"RMSE {mine['rmse_wh']:.1f} Wh, the best is {in_words(best)} with {test[best]['rmse_wh']:.1f}")
        for k, shown in (("c_rr", "c_rr"), ("cda_m2", "C_d·A")):
            if mine.get(f"{k}_error_percent", 0.0) > 5.0:
                out.append(f"{shown} off by {mine[f'{k}_error_percent']:.1f} % in the median of vehicles, target 5")
            if mine.get(f"{k}_error_worst", 0.0) > 5.0:
                out.append(f"{shown} off by {mine[f'{k}_error_worst']:.1f} % in the worst vehicle, target 5")
    out += [f"{100 * max(b.values()):.1f} % at a bound" for n, b in at_bound.items() if n == OURS]
    return [*every, *(f"{in_words(OURS)}: {x}" for x in out)]


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
    for id in sorted({e for f in found for e in f}, key=lambda e: (-sum(e in f for f in found), names.effect(e))):
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
    return words.number(x, unit="" if unit in (None, "1") else unit)


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
