"""The page of measured logs, made from kept diagnosis.json files: text, tables and figures, no number typed in.

Only the numbers of the paper that ours stand beside, with their source, are written here.
"""

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from experiments.measured import figures
from experiments.measured.compared import changes, fold_and_what, new_names, withheld
from experiments.measured.road_load import road_load
from experiments.measured.switching import loads_section
from experiments.measured.tables import (
    Runs,
    by_chance,
    found_ids,
    found_table,
    left_table,
    named,
    pooled_interval,
    pooled_rmse,
    signature,
    size_rows,
    size_table,
    table,
    together,
)
from experiments.measured.withheld import WITHHELD
from experiments.runner.pages.site import folded, wrapped
from hdev_jax.diagnosis.gates.gates import RESAMPLES
from hdev_jax.report import names

__all__ = ["page", "write"]

Results = Mapping[str, Mapping[str, Any]]
FOLDER = "figures/real_logs"
STABILITY = (
    "The number after *found* is the share of resampled sets of training data in which the effect, or one of its "
    "class, ranks first again."
)
COLD_C = 12.0  # heating runs below: splits the missions of ZTBus into about a third and two thirds
HEAD = """# Measured logs

What the diagnosis finds in two public logs, how much that depends on the training trips, and what stays unexplained.
`python -m experiments.measured.logs --work DIR --write` makes this page from the diagnosis.json of each run. All data
are measured. Errors are on held-out test trips and, unless a table says otherwise, in free run: without measured power.
The library was extended while looking at both logs, so errors on a new log may be larger; logs whose true effects are
known, with seeds not used in development, are in [planted effects](planted_summary.md). Cost: wall-clock time of one
run, compiling included, on a shared machine, and its peak memory."""
READING = """- **before** is the declared sheet, calibrated; **after** is the sheet with the effects found.
- *found*: the diagnosis added the effect. *one of a class*: it added one of several that this log cannot distinguish.
- The number after it is its *stability*: of {draws} resampled training sets (drawn with replacement from {clusters}),
  the share in which the effect, or one of its class, ranks first again.
- Sizes are as in diagnosis.json with their standard deviation. *largest difference*: between two training sets, in
  standard deviations of the difference as if the two were independent. Sizes *agree* if that difference is
  not significant at 5 %, that is, at most {chance} sets (Tukey's studentized range)."""


def page(results: Results, *, warm: Mapping[str, float], rest: Mapping[str, Any]) -> tuple[str, dict[str, bytes]]:
    """The page's text and its figures by file name, of the runs that are there.

    **Arguments:** `results`, diagnosis.json by the name of the run; `warm`, mean outside temperature [°C] by mission;
    `rest`, by withheld channel, what the two logs have in common.
    """
    niro = {k.removeprefix("niro_"): r for k, r in results.items() if re.fullmatch(r"niro_\d", k)}
    folds = {k.removeprefix("ztbus_"): r for k, r in results.items() if re.fullmatch(r"ztbus_\d", k)}
    held = {k: r for k, r in results.items() if "_no_" in k and k.partition("_no_")[0] in results}
    lines, drawn = [HEAD], {}
    if short := _short(niro, folds, held):
        lines += ["", "## In short", "", *short]
    for section in (
        _niro(niro) if niro else None,
        _road(results["niro_road"]) if "niro_road" in results else None,
        _ztbus(folds, warm) if folds else None,
        withheld(folds, held, rest, f"{FOLDER}/ztbus_withheld.png") if held else None,
        (load, {}) if (load := road_load(results)) else None,
    ):
        if section:
            lines += ["", *section[0]]
            drawn |= section[1]
    return wrapped("\n".join(lines).rstrip()) + "\n", drawn


def write(docs: Path, text: str, drawn: Mapping[str, bytes]) -> None:
    """The page and its figures; figures of an earlier page that this one lacks go."""
    folder = docs / FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    for old in folder.glob("*.png"):
        if old.name not in drawn:
            old.unlink()
    for name, content in drawn.items():
        (folder / name).write_bytes(content)
    (docs / "real_logs.md").write_text(text, encoding="utf-8")


def _short(niro: Runs, folds: Runs, held: Results) -> list[str]:
    """The answer first: a line or two for each log and each withheld channel."""
    out = []
    for runs, what, each in ((niro, "Kia Niro", "training trips"), (folds, "ZTBus", "folds")):
        if runs:
            b, a = (pooled_rmse([r[when]["test"] for r in runs.values()]) for when in ("before", "after"))
            always = [i for i in found_ids(next(iter(runs.values()))) if all(i in found_ids(r) for r in runs.values())]
            open_ = sum(r["unexplained"]["significant"] for r in runs.values())
            by_trip: dict[str, list[Any]] = {}
            for trip, m in (x for r in runs.values() for x in r["after"]["test_by_trip"].items()):
                by_trip.setdefault(trip, []).append(m)
            within = ""
            if len(by_trip) > 1:
                low, high = pooled_interval(by_trip)
                within = f" (90 %: {low:.2f} to {high:.2f}, over {len(by_trip)} test trips)"
            found = f"All {len(runs)} find {named(always)}." if always else "No effect is found by all."
            for pair, correlations in together(runs):
                if len(correlations) == len(runs) > 1:
                    found += f" {pair} are strongly correlated in every run: only their combination is determined."
            if turned := [r for r in size_rows(runs) if len({np.sign(v) for _, v, _ in r.cells.values()}) > 1]:
                said = names.verbose_join([" or ".join(f"`{p}`" for p in row.paths) for row in turned])
                found += f" The sign of {said} differs."
            if len(runs) > 1:
                found += f" {_agreeing(runs)}"
            slow = sum(r["unexplained"]["memory_s"] is not None for r in runs.values())
            out.append(
                f"- **{what}**: test RMSE {b:.2f} → {a:.2f} kW{within}, pooled over {len(runs)} {each}. {found} "
                f"In {open_} of {len(runs)} the diagnosis reports structure that no effect explains. In {slow} of "
                f"{len(runs)} the residual drifts within trips, which is reported, but does not count as such "
                "structure."
            )
    for name, r in held.items():
        fold, what = fold_and_what(name)
        full = folds[fold]
        lost = changes(r, full).lost
        new = new_names(r, full, {k: v for k, v in folds.items() if k != fold})
        a, b = r["after"]["test"]["rmse"], full["after"]["test"]["rmse"]
        rest = [signature(x["unexplained"]) for x in (r, full)]
        says = f" Unexplained, without: {rest[0]}; with: {rest[1]}." if rest[0] != rest[1] else ""
        out.append(
            f"- **{WITHHELD[what][0].capitalize()} withheld** (fold {fold}): test RMSE {a:.2f} kW without, {b:.2f} "
            f"with; lost: {named(lost)}; new names: {named(new)}.{says}"
        )
    return out


def _picture(name: str, words_: str) -> list[str]:
    return ["", f"![{words_}]({FOLDER}/{name})", ""]


def _cost(result: Mapping[str, Any]) -> str:
    cost = result.get("cost") or {}
    return f"{cost['seconds']:.0f} s, {cost['peak_gib']:.1f} GiB" if cost else "–"


def _reading(runs: Runs) -> list[str]:
    count = {f"{r['clusters']['count']}" for r in runs.values()}
    kind = {"trip": "trips"}.get(next(iter(runs.values()))["clusters"]["kind"], "stretches of at least 5 minutes")
    clusters = f"{names.verbose_join(sorted(count, key=int), 'or')} {kind}"
    chance = names.verbose_join([f"{by_chance(k):.2f} for {k}" for k in range(2, max(2, len(runs)) + 1)])
    return READING.format(draws=RESAMPLES, clusters=clusters, chance=chance).splitlines()


def _details(runs: Runs, head: str, caution: str) -> list[str]:
    """How to read the tables, and every size, folded."""
    sizes = [*size_table(runs, head), "", *_agreement(runs, caution)]
    lines = folded("How to read this", "\n".join(_reading(runs)))
    return [*lines, "", *folded("Every size", "\n".join(sizes)), ""]


def _agreement(runs: Runs, caution: str) -> list[str]:
    """How many sizes agree between training sets, and which do not."""
    lines = [f"{_agreeing(runs)} {caution}"]
    if pairs := together(runs):
        lines += ["", "Strongly correlated coefficients (training set: correlation), of which a log determines only a "
                  "combination:", ""]  # fmt: skip
        lines += [f"- {pair} ({', '.join(f'{k}: {c:.2f}' for k, c in each)})." for pair, each in pairs]
    return lines


def _agreeing(runs: Runs) -> str:
    rows = [row for row in size_rows(runs) if len(row.cells) > 1 and not row.at_bound]
    apart = sorted((row for row in rows if not row.agrees()), key=lambda row: -row.furthest())
    bound = any(row.at_bound for row in size_rows(runs))
    close = len(rows) - len(apart)
    text = f"Of {len(rows)} sizes found in more than one training set{', none at a bound,' if bound else ','} "
    text += f"{close} {'agrees' if close == 1 else 'agree'} within chance."
    if apart:
        said = names.verbose_join([f"{' or '.join(f'`{p}`' for p in r.paths)} ({r.furthest():.1f} sd)" for r in apart])
        text += f" These do not: {said}."
    return text


def _left_notes(runs: Runs) -> list[str]:
    on = {c for r in runs.values() for c in r["unexplained"]["depends_on"]}
    of = {"predicted": "final model", "declared": "calibrated sheet, without the effects found"}
    said = [f"`{name}` is the prediction of the {model}." for name, model in of.items() if name in on]
    return ["", " ".join(said)] if said else []


def _niro(runs: Runs) -> tuple[list[str], dict[str, bytes]]:
    lines = ["## Kia Niro: battery power from motor torque and speed", ""]
    lines += [
        "The sheet declares an efficiency for driving and one for braking. Each trip in turn is the training trip; "
        "the others are tested.",
        "",
    ]
    rows = []
    for trip, r in runs.items():
        before, after = ([m["mse"] for m in r[when]["test_by_trip"].values()] for when in ("before", "after"))
        worst = max((m["pe_percent"] for m in r["after"]["test_by_trip"].values()), key=abs)
        rows.append(
            [trip, f"{np.mean(before):.3f}", f"{np.mean(after):.4f}", str(r["parameters_fitted"]), f"{worst:+.2f} %",
             str(len(r["effects"])), _cost(r)]
        )  # fmt: skip
    lines += _picture("niro_errors.png", "Kia Niro: test error before and after, by trip")[1:]
    lines += table(
        ["trained on trip", "test MSE before [kW²]", "test MSE after [kW²]", "parameters", "energy error, worst trip",
         "effects found", "cost"],
        rows,
    )  # fmt: skip
    lines += [
        "",
        "Paper 2's best network (NARXS, its table VIII), trained on trip 1: MSE 0.1604 kW² in free run; its LSTM: "
        "0.2322 kW².",
    ]
    lines += ["", "### Stability over training trips", "", STABILITY, "", *found_table(runs, "trip")]
    lines += _picture("niro_sizes.png", "Kia Niro: sizes by training trip with 90 % bars")
    lines += _details(runs, "trip", f"No two of the {len(runs)} training sets share a row.")
    lines += ["### What stays unexplained", "", *left_table(runs, "trained on trip", "kW"), *_left_notes(runs)]
    blocks = {
        f"trained on trip {trip}, tested on ": [
            (k, r["before"]["test_by_trip"][k]["rmse"], m["rmse"]) for k, m in r["after"]["test_by_trip"].items()
        ]
        for trip, r in runs.items()
    }
    return lines, {
        "niro_errors.png": figures.errors(blocks, "Kia Niro (measured): error of battery power", "kW"),
        "niro_sizes.png": figures.sizes(runs, "Kia Niro (measured): size by training trip, with 90 % bars", "trip"),
    }


def _road(r: Mapping[str, Any]) -> tuple[list[str], dict[str, bytes]]:
    lines = ["## Kia Niro: traction force, no slope in the log, trained on trip 1", ""]
    lines += [
        "The sheet declares mass, rolling resistance and drag area; the log has an accelerometer and no slope.",
        "",
    ]
    rows = []
    for name, m in {"all": {k: r[k]["test"] for k in ("before", "after")}, **r["subsets"]}.items():
        b, a = m["before"]["rmse"], m["after"]["rmse"]
        rows.append([name, str(m["after"]["n"]), f"{b:.1f}", f"{a:.1f}", f"{100 * (1 - a / b):.1f} %"])
    lines += table(["rows of trips 2-4", "n", "before, RMSE [N]", "after", "reduction"], rows)
    lines += [
        "",
        f"Training trip: {r['before']['train']['rmse']:.0f} N before. Found: {named(found_ids(r))}. Cost: {_cost(r)}.",
    ]
    lines += [
        "",
        "### What stays unexplained",
        "",
        *left_table({"1": r}, "trained on trip", "N"),
        *_left_notes({"1": r}),
    ]
    return lines, {}


def _ztbus(runs: Runs, warm: Mapping[str, float]) -> tuple[list[str], dict[str, bytes]]:
    after = {n: m for r in runs.values() for n, m in r["after"]["test_by_trip"].items()}
    before = {n: m for r in runs.values() for n, m in r["before"]["test_by_trip"].items()}
    lines = ["## ZTBus: electric power from traction force and speed", ""]
    lines += [
        "Two trolleybuses in Zurich; their sheet declares an efficiency for driving and one for braking. Each fold "
        "holds every third mission out.",
        "",
    ]
    rows = [
        [k, f"{len(r['split']['train_trips'])} / {len(r['split']['test_trips'])}",
         *(f"{r[when]['test']['rmse']:.2f}" for when in ("before", "after")), str(r["parameters_fitted"]),
         str(len(r["effects"])), _cost(r)]
        for k, r in runs.items()
    ]  # fmt: skip
    lines += _picture("ztbus_errors.png", "ZTBus: test error before and after, by mission")[1:]
    lines += table(
        ["fold", "missions to train / test", "before, RMSE [kW]", "after", "parameters", "effects found", "cost"], rows
    )
    lines += ["", *_pooled(before, after, warm), "", *loads_section(runs, "fold", "kW")]
    lines += ["### Stability over folds", "", STABILITY, "", *found_table(runs, "fold")]
    lines += _picture("ztbus_sizes.png", "ZTBus: sizes by fold with 90 % bars")
    caution = "Folds share training missions, so the differences in sd are lower limits."
    lines += _details(runs, "fold", caution)
    lines += ["### What stays unexplained", "", *left_table(runs, "fold", "kW"), *_left_notes(runs), ""]
    lines += folded("Where the remaining error is", "\n".join(["Test RMSE [kW] before → after:", "", *_subsets(runs)]))
    order = sorted(after, key=lambda n: warm.get(n, 0.0))
    label = {n: f"{n[:18]} h{f', {warm[n]:.1f} °C' if n in warm else ''}".replace("_", " ") for n in order}
    blocks = {"": [(label[n], before[n]["rmse"], after[n]["rmse"]) for n in order]}
    title = "ZTBus (measured): error of electric power" + (", missions from cold to warm" if warm else "")
    return lines, {
        "ztbus_errors.png": figures.errors(blocks, title, "kW"),
        "ztbus_sizes.png": figures.sizes(runs, "ZTBus (measured): size by fold, with 90 % bars", "fold"),
    }


def _pooled(before: Mapping[str, Any], after: Mapping[str, Any], warm: Mapping[str, float]) -> list[str]:
    """All missions together: each from the fold in which it was held out."""
    error = np.array([m["pe_percent"] for m in after.values()])
    rows = [
        ["RMSE before → after", f"{pooled_rmse([*before.values()]):.2f} → {pooled_rmse([*after.values()]):.2f} kW"],
        ["mean energy error of missions, signed", f"{error.mean():+.2f} %"],
        ["mean absolute energy error", f"{np.abs(error).mean():.2f} %"],
    ]
    for label, cold in ((f"missions at {COLD_C:.0f} °C and colder", True), ("warmer missions", False)):
        if chosen := [m for n, m in after.items() if n in warm and (warm[n] <= COLD_C) == cold]:
            rows.append([f"{label} ({len(chosen)}), RMSE after", f"{pooled_rmse(chosen):.2f} kW"])
    worst = max(after, key=lambda n: after[n]["rmse"])
    rows.append(["worst mission", f"{worst}, {after[worst]['rmse']:.2f} kW, {after[worst]['pe_percent']:+.1f} %"])
    return table([f"all {len(after)} missions", "value"], rows)


def _subsets(runs: Runs) -> list[str]:
    def cell(r: Mapping[str, Any], part: str) -> str:
        m = r["subsets"].get(part)
        return f"{m['before']['rmse']:.2f} → {m['after']['rmse']:.2f}" if m else "–"

    parts: Iterable[str] = dict.fromkeys(p for r in runs.values() for p in r["subsets"])
    rows = [[part, *(cell(r, part) for r in runs.values())] for part in parts]
    return table(["rows", *(f"fold {k}" for k in runs)], rows)
