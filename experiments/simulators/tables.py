"""Tables and the figure of the study with simulators: what was changed, what was named, and what rivals say."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from experiments.planted.figures import share_figure
from experiments.runner.figures import styled
from experiments.runner.tables import wilson, write_tables
from experiments.simulators import scores as scores
from experiments.simulators.config import Config
from experiments.simulators.plants import FORMS, PLANTS
from hdev_jax.report import names
from hdev_jax.rundir import Run

__all__ = ["Group", "change_row", "collect", "confusion", "headwind_note", "rival_rows"]

Group = Sequence[tuple[dict[str, Any], dict[str, Any]]]  # tasks with their results
ARTEFACT = "studies/simulators"
NOTES = (
    "Right, if nothing changed: no false name, and either the form of the efficiency is named (regenerating "
    "efficiency, losses by load), or the sheet already declares two efficiencies, or the diagnosis reports "
    "unexplained structure. Right, with one change: an entry or a class of at most three contains it, or the "
    "declared coefficient that absorbs it moves the right way, with a 90 % interval that excludes the sheet's "
    "value. (Of a class at most three names are printed; a class of more than three counts as its first name alone.) "
    "Right, with no slope in the log: no false name, and the diagnosis reports unexplained structure or that "
    "the slope is missing",
    "False name: an entry that is neither the change nor the form of the efficiency. (The sheet declares one "
    "efficiency, or two where force or torque is measured; of the simulated vehicles, FASTSim's depends on the load "
    "while driving and is constant while braking, SUMO's is one number for each direction.) In logs whose "
    "samples are means of the past second, a late slope, a time skew or a filter is not false either. Impossible "
    "size: a size or a coefficient that no vehicle has",
    "A fit that knows the cause: the kernel with the simulator's true parameters, the change and the form of the "
    "efficiency, calibrated on the same training trips. The ratio of test RMSEs is the median over logs with a slope, "
    "because that fit knows the slope (in the table of rivals: over all logs). Covered: share of 90 % intervals "
    "that contain the true size. Coefficients covered: the same for rolling resistance and drag area, whatever was "
    "changed. Rows of 100 m hold means over distance and the standard deviation of the acceleration inside; both "
    "fits use them",
    "Neither simulator has wind, so a headwind is driven as the slope with the same force. FASTSim does not "
    "split braking between motor and friction brakes, so regeneration that is lost is taken from the electric power",
    "Each log has a drive, a vehicle and noise of its own. No log of these seeds was looked at while the method was "
    "changed; of others, with the same vehicles and changes, some were",
    "Rivals get the declared model's residual and every effect's column. *Named* is over the logs whose change is an "
    "effect of the library, *nothing changed* over the logs without a change, all else over all n. A name is right if "
    "it is the change, and false if it is neither the change nor the form of the efficiency. LightGBM names nothing",
)


def collect(config: Config, results: Group, run: Run) -> dict[str, Any]:
    """Tables, the figure, `metrics.json`."""
    rows = [change_row(config, PLANTS[plant].words, g) for plant, g in _by(results, lambda t: t["plant"])]
    changed = [(t, r) for t, r in results if t["plant"] != "nothing"]
    if changed:
        rows.append(change_row(config, ANY, changed))
    drawn = f"seeds from {config.seed}, FDR {100 * config.fdr:g} %"
    head = f"Vehicles of FASTSim and SUMO: one change in the simulator, none in the sheet; {drawn}"
    write_tables(run, "table", _shown(rows), head)
    by_line = [
        change_row(config, f"{key}, {'nothing' if plant == 'nothing' else 'one change'}", g)
        | {"coefficients_covered": _mean([ok for _, r in g for ok in scores.covered(r)])}
        for key, of_line in _by(results, lambda t: t["line"])
        for plant, g in _by(of_line, lambda t: "nothing" if t["plant"] == "nothing" else "changed")
    ]
    write_tables(run, "table_by_log", _shown(by_line), f"The same by kind of log; {drawn}")
    against = rival_rows(config, results)
    if against:
        write_tables(run, "table_rivals", against, "Rivals on the same logs")
    write_tables(
        run,
        "table_said",
        said_rows(results),
        "The diagnosis of each log: names with sizes, held-out error [kW; logs of 100 m: Wh per row]",
    )
    _figure(run, *confusion(results))
    missed = [f"{r['name']} ({r['short_of']})" for r in rows if r["name"] in ("nothing", ANY) and r["short_of"]]
    return {
        "artefact": ARTEFACT, "data": "FASTSim 3.1, SUMO 1.28", "synthetic": True, "logs": len(results),
        "rows": [{"name": r["name"], "paper": None, "ours": {k: v for k, v in r.items() if k != "name"}}
                 for r in (*rows, *by_line, *against)],
        "better_than_paper": 0, "of": 0, "missed": missed, "notes": [*NOTES, *headwind_note(results)],
        "findings": _findings(rows),
    }  # fmt: skip


def headwind_note(results: Group) -> list[str]:
    """A change that no log can tell from a declared coefficient: how often the report says so."""
    names = PLANTS["headwind"].names
    wind, still = (
        [bool(names & {*r["reasons"]}) for t, r in results if (t["plant"] == "headwind") is there]
        for there in (True, False)
    )
    if not wind:
        return []
    return [
        "Wind from the front at all times looks like more drag area. "
        f"In {sum(wind)} of {len(wind)} logs with a headwind the report says that a coefficient is far above the "
        f"sheet's value and that a headwind may be the reason, as it does in {sum(still)} of the {len(still)} others. "
        "That is not counted as right"
    ]


def _findings(rows: Sequence[dict[str, Any]]) -> list[str]:
    """What leads the page: answers and false names, with one change and with none."""
    words = {ANY: "With one change", PLANTS["nothing"].words: "With none"}
    return [
        f"{words[r['name']]}, the answer is right in {100 * r['right']:.0f} % of {r['n']} logs; a false name is "
        f"given in {100 * r['false_name']:.0f} "
        f"%{', also in some logs whose answer is right' if r['name'] == ANY else ''}"
        for r in reversed(rows) if r["name"] in words
    ]  # fmt: skip


LABELS = {"ours": "hdev_jax", "stlsq": "STLSQ (PySINDy)", "lasso_cv": "LassoCV", "lightgbm": "LightGBM"}
ANY = "any change"
UNSHOWN = ("interval_95", "met", "short_of")


def _shown(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    return [{k: v for k, v in r.items() if k not in UNSHOWN} for r in rows]


def _by(results: Group, key: Callable[[dict[str, Any]], str]) -> list[tuple[str, Group]]:
    groups: dict[str, list[tuple[dict[str, Any], dict[str, Any]]]] = {}
    for t, r in results:
        groups.setdefault(key(t), []).append((t, r))
    order = [k for k in PLANTS if k in groups]
    return [(k, groups[k]) for k in (order if len(order) == len(groups) else groups)]


def change_row(config: Config, name: str, group: Group) -> dict[str, Any]:
    """What the first table says of one change: eight columns, and which targets are missed."""
    n = len(group)
    hits = sum(scores.right(t, r) for t, r in group)
    false = float(np.mean([bool(scores.false(t, r["named"])) for t, r in group]))
    blamed = float(np.mean([bool(scores.blamed(t, r["named"])) for t, r in group]))
    sizes = [s for t, r in group if (s := scores.sized(t, r))]
    covered = float(np.mean([s["low"] <= s["true"] <= s["high"] for s in sizes])) if sizes else None
    ratios = [r["test_rmse"]["after"] / r["refit_rmse"] for t, r in group if not PLANTS[t["plant"]].missing]
    error = float(np.median(ratios)) if ratios else None
    impossible = float(np.mean([bool(scores.implausible(r)) for _, r in group]))
    nothing = all(t["plant"] == "nothing" for t, _ in group)
    checks = (
        ("right", hits / n, config.wanted_right, hits / n >= config.wanted_right),
        ("false name", false, *_at_most(false, config.wanted_false if nothing else config.wanted_beside)),
        ("instrument or payload falsely named", blamed, *_at_most(blamed, 0.0 if nothing else 1.0)),
        ("covered", covered, config.wanted_covered, covered is None or covered >= config.wanted_covered),
        (
            "test RMSE over that of a fit that knows the cause",
            error,
            config.wanted_error,
            error is None or error <= config.wanted_error,
        ),
        ("impossible size", impossible, *_at_most(impossible, 0.0)),
    )
    return {
        "name": name, "n": n, "right": hits / n, "false_name": false, "blamed": blamed, "covered": covered,
        "error_over_refit": error, "impossible": impossible,
        "interval_95": list(wilson(hits, n)),
        "met": all(ok for *_, ok in checks),
        "short_of": "; ".join(f"{what} {value:.3g}, target {wanted:g}" for what, value, wanted, ok in checks if not ok),
    }  # fmt: skip


def _at_most(value: float, wanted: float) -> tuple[float, bool]:
    return wanted, value <= wanted


def confusion(results: Group) -> tuple[list[str], list[str], np.ndarray, list[list[str]]]:
    """Changes with their number of logs, what was named, its share of each change's logs [%], which names are right.

    An entry that holds the change is shown as it; so is a declared coefficient that tells it; a log without a name
    is "nothing", or "unexplained" where it is called so.
    """
    groups = _by(results, lambda t: t["plant"])
    cells: list[dict[str, float]] = []
    for plant, group in groups:
        row: dict[str, float] = {}
        for t, r in group:
            fine = PLANTS[plant].names
            said = {next(iter(fine & set(e["class"])), e["id"]) for e in r["named"]}
            if scores.moved(t, r):
                said |= {k for k in PLANTS[plant].coefficients[:1] if not said & fine}
            for name in said or {"unexplained" if r["unexplained"] else "nothing"}:
                row[name] = row.get(name, 0.0) + 100.0 / len(group)
        cells.append(row)
    wanted = [k for plant, _ in groups for k in (*sorted(PLANTS[plant].names), *PLANTS[plant].coefficients[:1])]
    named = {k for row in cells for k in row}
    ends = [k for k in ("unexplained", "nothing") if k in named]
    own = {k for plant, _ in groups for k in PLANTS[plant].names}  # what was changed has a column, named or not
    columns = [k for k in dict.fromkeys(wanted) if k in named | own]
    columns += [*sorted(named - set(columns) - set(ends)), *ends]
    share = np.array([[row.get(k, 0.0) for k in columns] for row in cells]).reshape(len(cells), len(columns))
    return [f"{PLANTS[plant].words} ({len(g)})" for plant, g in groups], columns, share, _right(results)


def _right(results: Group) -> list[list[str]]:
    """The columns that are right, by change: it, or the coefficient that takes it up; with nothing changed, the form of
    the efficiency; without a slope, that something is unexplained."""
    out = []
    for key, group in _by(results, lambda t: t["plant"]):
        plant = PLANTS[key]
        forms = {k for t, _ in group for k in FORMS[t["simulator"]]} if key == "nothing" else set()
        out.append([*plant.names, *plant.coefficients[:1], *forms, *(["unexplained"] if plant.missing else [])])
    return out


@styled
def _figure(
    run: Run, rows: Sequence[str], columns: Sequence[str], share: np.ndarray, right: Sequence[Sequence[str]]
) -> None:
    share_figure(run, "confusion", rows, columns, share, right, ylabel="changed in the simulator (logs)",
                 title="Vehicles of FASTSim and SUMO: what was named [%]")  # fmt: skip


def said_rows(results: Group) -> list[dict[str, Any]]:
    """A row for each log."""
    rows = []
    for t, r in results:
        entries = [f"{' or '.join(e['class'])} ({_sizes(e)})" for e in r["named"]]
        moved = PLANTS[t["plant"]].coefficients[:1] if scores.moved(t, r) else ()
        told = [f"{names.coefficient(k)[0]} moved from the sheet" for k in moved]
        rows.append({
            "log": f"{t['line']}, {t['vehicle']}, seed {t['seed']}", "changed": PLANTS[t["plant"]].words,
            "said": "; ".join([*entries, *told]) or "nothing", "right": scores.right(t, r),
            "unexplained": r["unexplained"],
            "before": r["test_rmse"]["before"], "after": r["test_rmse"]["after"],
            "a fit that knows the cause": r["refit_rmse"],
        })  # fmt: skip
    return rows


def _sizes(entry: dict[str, Any]) -> str:
    return ", ".join(f"{k} {p['value']:.3g}" for k, p in entry["parameters"].items())


def rival_rows(config: Config, results: Group) -> list[dict[str, Any]]:
    """A row for each method: named, false names, errors, over logs whose change has a name and over those with none."""
    group = [(t, r) for t, r in results if r["rivals"]]
    if not group:
        return []
    rows = []
    for method in ("ours", *config.rivals):
        ours, names = method == "ours", method != "lightgbm"

        def said(r: dict[str, Any], ours: bool = ours, method: str = method) -> list[dict[str, Any]]:
            if ours:
                return r["named"]
            return [{"id": k, "class": [k], "class_size": 1} for k in r["rivals"][method]["named"]]

        able = [(t, said(r)) for t, r in group if PLANTS[t["plant"]].names]
        calm = [(t, said(r)) for t, r in group if t["plant"] == "nothing"]
        every = [(t, said(r)) for t, r in group]
        error = [
            (r["test_rmse"]["after"] if ours else r["rivals"][method]["test_rmse"]) / r["refit_rmse"] for _, r in group
        ]
        took = [r["seconds"] if ours else r["rivals"][method]["seconds"] for _, r in group]
        rows.append({
            "name": LABELS[method],
            "n": len(group),
            "named": _mean([scores.named(t, {"named": s}) for t, s in able]) if names else None,
            "false_name": _mean([bool(scores.false(t, s)) for t, s in every]) if names else None,
            "blamed_when_nothing": _mean([bool(scores.blamed(t, s)) for t, s in calm]) if names else None,
            "names_per_log": _mean([len(s) for _, s in every]) if names else None,
            "error_over_refit": float(np.median(error)),
            "seconds": float(np.median(took)),
        })  # fmt: skip
    return rows


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if values else None
