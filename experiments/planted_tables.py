"""Tables of the planted study: one row for each setting, what was asked of it beside what came out."""

from typing import TYPE_CHECKING, Any

import numpy as np

from experiments.planted_figures import confusion_figure, false_figure, power_figure
from experiments.tables import wilson, write_tables
from hdev_jax.physics import LIBRARY
from hdev_jax.rundir import Run

if TYPE_CHECKING:
    from experiments.planted import Case, Config

__all__ = ["collect"]

COVERED = (0.85, 0.95)  # of 90 % intervals, after selection
ORACLE = 0.90  # of the logs within NEAR_ORACLE of the error of an oracle that knows the cause
NEAR_ORACLE = 1.05


def collect(config: "Config", results: list[tuple[dict[str, Any], dict[str, Any]]], run: Run) -> dict[str, Any]:
    """Tables and figures of the study; `metrics.json`."""
    done = [(t, r) for t, r in results if "skipped" not in r]
    skipped = [{"seed": t["seed"], "effects": t["effects"], "why": r["skipped"]} for t, r in results if "skipped" in r]
    rows = [_row(config, name, group) for name, group in grouped(done)]
    for case in config.cases.values():
        group = [(t, r) for t, r in done if t["case"] == case.name]
        if case.wanted_pooled is not None and group:
            row = _row(config, f"{case.name}, all together", group)
            rows.append({**row, "wanted": case.wanted_pooled, "met": row["as_asked"] >= case.wanted_pooled})
    write_tables(run, "planted", rows, f"Planted effects, synthetic logs, seed {config.seed} on, --fdr {config.fdr}")
    sized = _sized([(t, r) for t, r in done if t["effects"] and all(k in LIBRARY for k in t["effects"])])
    write_tables(run, "planted_sizes", sized, "Sizes and errors after the loop, every log with a planted effect")
    able = [(t, r) for t, r in done if t["noise"] == "ar1" and not _case(config, t).absorbed]
    power_figure(run, able, config.rivals)
    false_figure(run, done, config.rivals)
    confusion_figure(run, done)
    missed = [r["name"] for r in (*rows, *sized) if r["met"] is False]
    return {
        "artefact": "studies/planted", "data": "synthetic_log", "synthetic": True, "logs": len(done),
        "rows": [{"name": r["name"], "paper": None, "ours": {k: v for k, v in r.items() if k not in ("name", "paper")}}
                 for r in (*rows, *sized)],
        "better_than_paper": 0, "of": 0,
        "skipped": skipped, "missed": missed,
    }  # fmt: skip


def _sized(group: list) -> list[dict[str, Any]]:
    """Do intervals hold what they should, and is the error after the loop that of an oracle, over all these logs."""
    if not group:
        return []
    covered = [s["covered"] for _, r in group for s in r["sizes"]]
    ratio = [r["test_rmse"]["after"] / r["oracle_rmse"] for _, r in group if r["oracle_rmse"]]
    near = sum(x < NEAR_ORACLE for x in ratio)
    shares = {
        "90 % intervals that hold the planted size": (sum(covered), len(covered), COVERED),
        "test error after within 5 % of an oracle's": (near, len(ratio), (ORACLE, 1.0)),
    }
    return [
        {"name": name, "n": n, "share": k / n, "interval_95": list(wilson(k, n)), "wanted_range": list(wanted),
         "met": wanted[0] <= k / n <= wanted[1]}
        for name, (k, n, wanted) in shares.items() if n
    ]  # fmt: skip


def grouped(done: list[tuple[dict[str, Any], dict[str, Any]]]) -> list[tuple[str, list]]:
    """Logs by setting: the case, the size, the number of trips and the noise."""
    groups: dict[str, list] = {}
    for task, result in done:
        size = f", size {task['size']:g}" if task["effects"] else ""
        key = f"{task['case']}{size}, {task['trips']} trips, {task['noise']}"
        key += "" if task["entry"] == "road" else f", {task['entry']}"
        groups.setdefault(key, []).append((task, result))
    return list(groups.items())


def _case(config: "Config", task: dict[str, Any]) -> "Case":
    """The case that a task is of; several may share a name and differ in their settings."""
    return next(
        c for c in config.cases.values()
        if c.name == task["case"] and task["trips"] in c.trips and task["noise"] in c.noises
        and (not task["effects"] or task["size"] in c.sizes)
    )  # fmt: skip


def _row(config: "Config", setting: str, group: list) -> dict[str, Any]:
    """What the table says of one setting, ours first."""
    one = group[0][0]
    n, planted = len(group), bool(one["effects"])
    in_library = all(k in LIBRARY for t, _ in group for k in t["effects"])
    exactly = sum(r["exact"] for _, r in group)
    first = sum(r["exact"] and {x["id"] for x in r["named"]} == set(t["effects"]) for t, r in group)
    alone = sum(r["exact"] and all(len(x["class"]) == 1 for x in r["named"]) for _, r in group)
    false = sum(any(not set(x["class"]) & set(t["effects"]) for x in r["named"]) for t, r in group)
    pairs = [s for _, r in group for s in r["sizes"]]
    z = np.array([abs(s["found"] - s["true"]) / s["sd"] for s in pairs])
    ratio = np.array([r["test_rmse"]["after"] / r["oracle_rmse"] for _, r in group if r["oracle_rmse"]])
    case = _case(config, one)
    absorbed = sum(set(t["effects"]) <= set(r["absorbed"]) and not r["named"] for t, r in group)
    unexplained = sum(r["unexplained"] for _, r in group)
    named = planted and in_library and not case.absorbed
    # how many logs did as asked: named what was planted, called it absorbed, or named nothing
    as_asked = exactly if named else absorbed if case.absorbed else n - false
    enough = [case.wanted is None or as_asked / n >= case.wanted]
    enough.append(case.wanted_unexplained is None or unexplained / n >= case.wanted_unexplained)
    row = {
        "name": setting, "n": n, "paper": None,
        "as_asked": as_asked / n,
        "interval_95": list(wilson(as_asked, n)),
        "wanted": case.wanted,
        "met": all(enough) if case.wanted is not None else None,
        "named_exactly": exactly / n if named else None,
        "named_first": first / n if named else None,  # classes set aside: what each entry is called
        "named_exactly_no_class": alone / n if named else None,
        "something_false": false / n,
        "called_absorbed": absorbed / n if case.absorbed else None,
        "called_not_decidable": sum(bool(r["not_decidable"]) and not r["named"] for _, r in group) / n,
        "called_unexplained": unexplained / n,
        "unexplained_wanted": case.wanted_unexplained,
        "mean_class": float(np.mean([len(x["class"]) for _, r in group for x in r["named"]] or [0.0])),
        "size_within_3_sd": float(np.mean(z < 3)) if len(z) else None,
        "size_covered_90": float(np.mean([s["covered"] for s in pairs])) if pairs else None,
        "within_5_percent_of_oracle": float(np.mean(ratio < NEAR_ORACLE)) if len(ratio) else None,
        "seconds": float(np.median([r["seconds"] for _, r in group])),
    }  # fmt: skip
    for name in config.rivals:
        both = [(set(t["effects"]), set(r["rivals"][name]["named"])) for t, r in group]
        row[f"{name}_exactly"] = float(np.mean([a == b for a, b in both])) if named and name != "lightgbm" else None
        row[f"{name}_false"] = float(np.mean([bool(b - a) for a, b in both])) if name != "lightgbm" else None
        error = [r["rivals"][name]["test_rmse"] / r["oracle_rmse"] for _, r in group if r["oracle_rmse"]]
        row[f"{name}_test_over_oracle"] = float(np.median(error)) if error else None
    return row
