"""Tables of the planted study: one row for each setting, targets and results."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from experiments.planted import scores as scores
from experiments.planted.config import Config
from experiments.planted.figures import confusion_figure, false_figure, power_figure
from experiments.planted.rivals import comparable
from experiments.planted.rivals_table import rival_rows
from experiments.planted.scores import Group
from experiments.planted.sizes import CAPTION as SIZED
from experiments.planted.sizes import NEAR_ORACLE, sized_rows
from experiments.runner.tables import wilson, worded, write_tables
from hdev_jax.report.names import verbose_join
from hdev_jax.rundir import Run

__all__ = ["collect"]

# What a row of a setting holds, by table: caption and columns, beside its name and its number of logs. Settings that
# a table's first column says nothing of are not in it.
TABLES = {
    "planted": (
        "Planted effects: share of logs with the right answer, and with a false name",
        ("right", "interval_95", "wanted", "met", "false_name", "called_unexplained"),
    ),
    "planted_errors": (
        "Planted effects: errors, coefficients, time",
        ("within_5_percent_of_oracle", "after_over_noise", "size_within_3_sd", "size_covered_90", "seconds"),
    ),
    "planted_names": (
        "Planted effects: names with classes and without",
        ("named_exactly", "named_first", "mean_class", "named_exactly_no_class", "separable", "no_class_of_separable",
         "redrawn"),
    ),
    "planted_undecided": (
        "Planted effects: what is absorbed, and what more trips would tell",
        ("asked", "furthest_coefficient_sd", "called_not_decidable", "names_not_decidable", "clusters",
         "clusters_needed"),
    ),
}  # fmt: skip
WANTED = {  # what may be wanted of a setting: column with the share, in words, column with the least
    "right": ("right", "wanted"),
    "named_exactly_no_class": ("named alone", "no_class_wanted"),
    "called_unexplained": ("called unexplained", "unexplained_wanted"),
}
MOST_SAID = 6  # counts that a page begins with
BY_TWIN = "Planted effects: one without a twin has to be named alone, one with a twin in a class with it"
LEGEND = {  # of each table that is there; the first of every page
    "": (
        "Effect/noise: RMS of what the effect adds to a row and the declared coefficients cannot absorb, divided by "
        "the RMS of the noise. Noise: white; AR(1) with a coefficient of {ar:g}; AR(1) + white, a fifth of the "
        "variance is white; random intercepts of trips, half of the variance; Student's t, AR(1) with innovations of "
        "3 degrees of freedom; variance by trip, AR(1) whose variance differs by trip. Logs hold energy by road "
        "segment{shaft}",
    ),
    "planted": (
        "Right: the share of logs with the right answer, with Wilson's 95 % interval. If effects of the library were "
        "planted, the answer is right if it names exactly them, each alone or in a class of at most three. If nothing "
        "was planted, it has no name. If the cause is outside the library, it has no wrong name (a constant load is "
        "right for a load that switches). If a coefficient absorbs the effect or more trips are needed, it says so. "
        "Target met: the share reaches its target{unexplained}",
        "False name: share of logs in which an effect is named that was not planted. Called unexplained: share of "
        "logs in which significant structure remains (random intercepts of trips count, although they are noise here)",
    ),
    "planted_errors": (
        "Within 5 % of a fit that knows the cause: share of logs whose test RMSE is at most 5 % above that of such "
        "a fit on the same training trips. Test RMSE over noise: test RMSE divided by the RMS of the noise, median. "
        "Coefficients: of planted effects that are the name, or the first name, of an entry. Seconds: of one "
        "diagnosis, median, with others running on the same machine; the first logs of each kind include compiling",
    ),
    "planted_names": (
        "Top-ranked: share of logs in which the planted effect is the first of each class. Named alone: share "
        "in which each entry is a single name. Separable: share in which no other effect fits as well as the true one "
        "under this noise. Drawn anew: number of logs simulated again because the effect acted in only one training "
        "trip, or because a value of the noise was outside the range that the reader of logs accepts",
    ),
    "planted_names_by_twin": (
        "Twins: mass_scale and power_gain cannot be distinguished by any log of road segments under this sheet, once "
        "rolling resistance and drag area are fitted. The right answer is a class of at most three that contains "
        "both. In the first table either name alone counts too, although it is a guess. Target met: both shares reach "
        "their targets, if they have one",
    ),
    "planted_rivals": (
        "Ours is right if an entry (a name or a class) contains the planted effect; *first name only*: if the first "
        "name of each entry is the planted effect, so a twin named first is false. A rival's name is right if it "
        "is the planted effect, its twin, an effect that this log cannot distinguish from it, or in our class. Our "
        "seconds include compiling, which weighs more where there are few logs of a kind",
    ),
}


def collect(config: Config, results: Group, run: Run) -> dict[str, Any]:
    """Tables and figures of the study; `metrics.json`."""
    done = [(t, r) for t, r in results if "skipped" not in r]
    skipped = [{"seed": t["seed"], "effects": t["effects"], "why": r["skipped"]} for t, r in results if "skipped" in r]
    groups = grouped(config, done)
    rows = [_row(config, name, group) for name, group in groups]
    for key, case in config.cases.items():
        group = [(t, r) for t, r in done if t["case"] == key]
        if case.wanted_pooled is not None and group:
            row = _row(config, f"{case.name}, all together", group)
            rows.append(_met({**row, "wanted": case.wanted_pooled}))
    shown, drawn = [""], f"synthetic logs, seeds from {config.seed}, FDR {100 * config.fdr:g} %"
    for table, (caption, columns) in TABLES.items():
        part = [{k: r[k] for k in ("name", "n", *columns)} for r in rows if r[columns[0]] is not None]
        if part:
            write_tables(run, table, part, f"{caption}; {drawn}")
            shown.append(table)
    apart = [row for name, group in groups for row in _by_twin(config, name, group)]
    if apart:
        write_tables(run, "planted_names_by_twin", apart, f"{BY_TWIN}; {drawn}")
        shown.append("planted_names_by_twin")
    able = [(t, r) for t, r in done if config.cases[t["case"]].asked == "named"]
    sized = sized_rows(able)
    if sized:
        write_tables(run, "planted_sizes", sized, f"{SIZED}; {drawn}")
    against = rival_rows(groups, config.rivals)
    if against:
        write_tables(run, "planted_rivals", against, f"Rivals on the same logs, synthetic{_not_compared(groups)}")
        shown.append("planted_rivals")
    on_road = [(t, r) for t, r in able if t["noise"] == "ar1" and t["entry"] == "road"]
    power_figure(run, on_road, config.rivals)
    false_figure(run, [(t, r) for t, r in able if not t["effects"]], config.rivals)
    confusion_figure(run, [(t, r) for t, r in able if t["effects"]])
    missed = [f"{worded(r['name'])} ({_short_of(r)})" for r in (*rows, *apart, *sized) if r["met"] is False]
    wanted = _unexplained_wanted(config, done)
    said = {"ar": config.ar_coefficient, "unexplained": wanted, "shaft": _shaft(config, done)}
    return {
        "artefact": "studies/planted", "data": "synthetic_log", "synthetic": True, "logs": len(done),
        "rows": [{"name": r["name"], "paper": None, "ours": {k: v for k, v in r.items() if k not in ("name", "paper")}}
                 for r in (*rows, *apart, *sized, *against)],
        "better_than_paper": 0, "of": 0,
        "skipped": skipped, "missed": missed, "findings": _findings(config, done),
        "notes": [line.format(**said) for table in shown for line in LEGEND.get(table, ())],
    }  # fmt: skip


def _findings(config: Config, done: Group) -> list[str]:
    """What leads the page: right answers where nothing was planted, and where one effect is to be named."""
    groups: dict[str, list[bool]] = {}
    for task, result in done:
        case, planted = config.cases[task["case"]], task["effects"]
        if case.asked == "named" and (not planted or (len(planted) == 1 and scores.nameable(planted))):
            name = f"{case.name}{_sized(task)}" + (f", {task['trips']} trips" if planted else "")
            groups.setdefault(name, []).append(_right(case.asked, task, result))
    said = [f"{sum(hits)} of {len(hits)} logs with {name}" for name, hits in groups.items()]
    return [f"The answer is right in {verbose_join(said)}"] if 0 < len(said) <= MOST_SAID else []


def _unexplained_wanted(config: Config, done: Group) -> str:
    """The further targets of logs with a cause outside the library; empty where there are none."""
    wanted = [w for t, _ in done if (w := config.cases[t["case"]].wanted_unexplained) is not None]
    return f" and, with a cause outside the library, {max(wanted):g} of logs are called unexplained" if wanted else ""


def _shaft(config: Config, done: Group) -> str:
    """What logs called shaft hold, where there are some."""
    what = "; logs called shaft hold samples of electric power with the motor's torque and speed"
    return what if any(config.cases[t["case"]].entry == "shaft" for t, _ in done) else ""


def _not_compared(groups: Sequence[tuple[str, Group]]) -> str:
    """Which logs the table of rivals lacks: where an effect is sought elsewhere than in columns, they have no column
    to choose."""
    left = [t["effects"] for _, group in groups for t, r in group if r["rivals"] == {} and not comparable(t["effects"])]
    what = sorted({k for effects in left for k in effects if not comparable([k])})
    if not left:
        return ""
    words = " or ".join(k.replace("_", " ") for k in what)
    out = f"; without {len(left)} logs of {words}, which is no column that could be offered to the other methods"
    return f"{out}; the first table has all logs"


def _met(row: dict[str, Any]) -> dict[str, Any]:
    """The row with whether each share meets its target."""
    asked = [(row[share], row[least]) for share, (_, least) in WANTED.items() if row.get(least) is not None]
    return {**row, "met": all(share >= least for share, least in asked) if asked else None}


def _short_of(row: dict[str, Any]) -> str:
    """What a row below its target has, and the target."""
    if "wanted_range" in row:
        low, high = row["wanted_range"]
        return f"{row['share']:.3g}, target {low:g} to {high:g}"
    return "; ".join(
        f"{words} {row[share]:.3g}, target {row[least]:g}"
        for share, (words, least) in WANTED.items() if row.get(least) is not None and row[share] < row[least]
    )  # fmt: skip


def _sized(task: dict[str, Any]) -> str:
    return f", effect/noise {task['size']:g}" if task["effects"] and task["size"] else ""


def grouped(config: Config, done: Group) -> list[tuple[str, Group]]:
    """Logs by setting: the case, effect/noise, the number of trips and the noise."""
    groups: dict[tuple[str, str], Group] = {}
    for task, result in done:
        key = f"{config.cases[task['case']].name}{_sized(task)}, {task['trips']} trips, {task['noise']}"
        key += "" if task["entry"] == "road" else f", {task['entry']}"
        groups.setdefault((task["case"], key), []).append((task, result))
    return [(name, group) for (_, name), group in groups.items()]


def _right(asked: str, task: dict[str, Any], result: dict[str, Any]) -> bool:
    """Whether the log says what its case asks for."""
    planted = task["effects"]
    if asked == "absorbed":
        return scores.absorbed(planted, result) if planted else scores.untouched(result)
    if asked == "not_decidable":
        return scores.not_decidable(planted, result)
    if scores.nameable(planted):
        return scores.exact(planted, result["named"])
    return not scores.false(planted, result["named"])


def _asked(asked: str, planted: bool) -> str:
    return asked.replace("_", " ") if planted else f"not {asked}"


def _alone(result: dict[str, Any]) -> bool:
    """Whether each entry is one name."""
    return all(x["class_size"] == 1 for x in result["named"])


def _with_classes(planted: Sequence[str], named: Sequence[scores.Entry]) -> bool:
    """Whether exactly what was planted is named, and what has a twin in a class with it."""
    return scores.exact(planted, named) and scores.with_twins(planted, named)


def _by_twin(config: Config, setting: str, group: Group) -> list[dict[str, Any]]:
    """Names in one setting's logs: of all, of what has no twin, and of what has one, for which a class is asked."""
    case = config.cases[group[0][0]["case"]]
    without = [(t, r) for t, r in group if not scores.has_twin(t["effects"])]
    twins = [(t, r) for t, r in group if scores.has_twin(t["effects"])]
    if case.asked != "named" or not (twins or case.wanted_alone):
        return []
    rows = []
    for words, part in (("all", group if twins else []), ("no twin", without), ("a twin", twins)):
        n, lone = len(part), words != "a twin"
        hits = [r for t, r in part if _with_classes(t["effects"], r["named"])]
        alone = sum(_alone(r) for r in hits)
        if part:
            rows.append(_met({
                "name": f"{setting}: {words}", "n": n,
                "right": len(hits) / n,
                "interval_95": list(wilson(len(hits), n)),
                "wanted": case.wanted if words != "all" else None,
                "named_exactly_no_class": alone / n if lone else None,
                "no_class_interval_95": list(wilson(alone, n)) if lone else None,
                "no_class_wanted": case.wanted_alone if lone else None,
            }))  # fmt: skip
    return rows


def _row(config: Config, setting: str, group: Group) -> dict[str, Any]:
    """What the table says of one setting."""
    case = config.cases[group[0][0]["case"]]
    n = len(group)
    named = all(scores.nameable(t["effects"]) for t, _ in group) and case.asked == "named"
    right = sum(_right(case.asked, t, r) for t, r in group)
    hits = [(t, r) for t, r in group if scores.exact(t["effects"], r["named"])]
    first = sum({x["id"] for x in r["named"]} == set(scores.names(t["effects"])) for t, r in hits)
    alone = sum(_alone(r) for _, r in hits)
    apart = [
        (t, r) for t, r in group
        if r["alike"] and not any(r["alike"].values()) and not scores.has_twin(t["effects"])
    ]  # fmt: skip
    asked_oracle = named and all(r["alike"] for _, r in group)  # it knows nothing of a form that the library lacks
    alone_apart = [scores.exact(t["effects"], r["named"]) and _alone(r) for t, r in apart]
    unexplained = sum(r["unexplained"] for _, r in group)
    pairs = [s for _, r in group for s in r["sizes"]] if case.asked == "named" else []
    z = np.array([abs(s["found"] - s["true"]) / s["sd"] for s in pairs])
    after = np.array([r["test_rmse"]["after"] for _, r in group])
    ratio = after / np.array([r["oracle_rmse"] for _, r in group])
    far = [max((abs(b["prior_z"]) for b in r["baseline"].values()), default=0.0) for _, r in group]
    needed = [
        c["clusters_needed"] for t, r in group for c in r["not_decidable"] if c["id"] in scores.names(t["effects"])
    ]
    return _met({
        "name": setting, "n": n, "paper": None,
        "right": right / n,
        "interval_95": list(wilson(right, n)),
        "wanted": case.wanted,
        "asked": _asked(case.asked, bool(group[0][0]["effects"])) if case.asked != "named" else None,
        "named_exactly": len(hits) / n if named else None,
        "named_first": first / n if named else None,  # classes set aside: what each entry is called
        "named_exactly_no_class": alone / n if named else None,
        "separable": len(apart) / n if asked_oracle else None,  # from every other effect, by a test that knows both
        "no_class_of_separable": float(np.mean(alone_apart)) if named and apart else None,
        "redrawn": sum(r["redrawn"] for _, r in group),
        "false_name": sum(scores.false(t["effects"], r["named"]) for t, r in group) / n,
        "furthest_coefficient_sd": float(np.median(far)) if case.asked == "absorbed" else None,
        "called_not_decidable": sum(bool(r["not_decidable"]) and not r["named"] for _, r in group) / n,
        "names_not_decidable": (
            float(np.mean([len(r["not_decidable"]) for _, r in group])) if case.asked == "not_decidable" else None
        ),
        "clusters": float(np.median([r["clusters"] for _, r in group])) if case.asked == "not_decidable" else None,
        "clusters_needed": float(np.median(needed)) if needed and case.asked == "not_decidable" else None,
        "called_unexplained": unexplained / n,
        "unexplained_wanted": case.wanted_unexplained,
        "mean_class": float(np.mean([x["class_size"] for _, r in group for x in r["named"]] or [0.0])),
        "size_within_3_sd": float(np.mean(z < 3)) if len(z) else None,
        "size_covered_90": float(np.mean([s["covered"] for s in pairs])) if pairs else None,
        "within_5_percent_of_oracle": float(np.mean(ratio < NEAR_ORACLE)),
        "after_over_noise": float(np.median(after / np.array([r["noise_rmse"] for _, r in group]))),
        "seconds": float(np.median([r["seconds"] for _, r in group])),
    })  # fmt: skip
