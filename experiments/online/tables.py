"""Tables and the figure of the study of estimates, forecasts and alarms while a vehicle drives."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy import stats

from experiments.runner.figures import save_figure, styled
from experiments.runner.tables import wilson, worded, write_tables
from hdev_jax.errors import InputError
from hdev_jax.report.canvas import AFTER, BEFORE, GREY, figure, tidy
from hdev_jax.rundir import Run

__all__ = ["tabulate"]

SHEETS = {"laps": ("declared",), "forecast": ("declared", "diagnosed")}
TRIPS = {"laps": "laps of a track", "forecast": "routes"}
TWICE = 2.0  # times the rows that a diagnosis needs: an alarm should come by then

Results = Sequence[tuple[dict[str, Any], dict[str, Any]]]
Line = dict[str, Any]


def tabulate(
    results: Results, run: Run, caption: str, held: tuple[float, float], within_percent: Mapping[str, float]
) -> tuple[list[str], list[str], list[Line]]:
    """Write three tables and a figure. Returns what was found, the targets missed, and the rows of all tables."""
    kinds = ("laps", "forecast", "estimates", "alarms", "batch")
    laps, forecasts, ends, streams, batch = ([(t, r) for t, r in results if t["kind"] == k] for k in kinds)
    shares = sorted(forecasts[0][0]["shares"])
    lines = [(kind, sheet) for kind, sheets in SHEETS.items() for sheet in sheets]
    rest = {(k, x): [_rest([*laps, *forecasts], k, x, share) for share in shares] for k, x in lines}
    rests = [line for each in rest.values() for line in each]
    noises = list(dict.fromkeys(t["noise"] for t, _ in ends))
    estimates = [line for noise in noises for line in _of_noise(ends, noise)]
    quiet = [_of_alarms(streams, planted=None, noise=noise) for noise in noises]
    planted = list(dict.fromkeys(t["planted"] for t, _ in streams if t["planted"]))
    alarms = [_of_alarms(streams, planted=e, noise="ar1") | _beside(streams, batch, e) for e in planted]
    write_tables(run, "ahead", rests, caption)
    write_tables(run, "estimates", estimates, "Estimates at the end of a log, mass after 10 km of each trip; synthetic")
    write_tables(run, "alarms", [*quiet, *alarms], "Alarms; synthetic")
    _figure(run, [*laps, *forecasts], shares, alarms)
    low, high = held
    missed = []
    if unknown := within_percent.keys() - {line["name"] for line in (*rests, *estimates)}:
        raise InputError(f"config, key within_percent: {', '.join(sorted(unknown))} is no line of the tables")
    for line in (*rests, *estimates):
        if not low <= line["inside_90"] <= high:
            missed.append(f"{worded(line['name'])}: 90 % intervals cover {line['inside_90']:.0f} %, target {low:g} to "
                          f"{high:g}")  # fmt: skip
        most = within_percent.get(line["name"])
        if most is not None and (line["median_error_percent"] or 0.0) > most:
            missed.append(
                f"{worded(line['name'])}: {line['median_error_percent']:.2g} % in the median, target {most:g}"
            )
    for line in alarms:
        late = line["batch_logs"] - line["within_twice"]
        if late:
            missed.append(f"{worded(line['name'])}: no alarm within twice the rows in {late} of the "
                          f"{line['batch_logs']} logs in which a diagnosis finds it")  # fmt: skip
    false = sum(round(a["false_percent"] * a["n"] / 100.0) for a in quiet)
    lap, before, after = (each[len(shares) // 2] for each in rest.values())
    named, soon = (sum(a[k] for a in alarms) for k in ("batch_logs", "within_twice"))
    found = [
        f"After {lap['driven_so_far_percent']:.0f} % of a trip of laps on one track (as in table 1 of paper 1), the "
        f"forecast of the remaining energy has a median error of {lap['median_error_percent']:.2g} % ({lap['n']} "
        f"trips; 90 % intervals cover {lap['inside_90']:.0f} %)",
        f"At the same point of a route it is {before['median_error_percent']:.2g} % with the declared sheet and "
        f"{after['median_error_percent']:.2g} % with the sheet that a diagnosis of "
        f"{forecasts[0][0]['routes_before']} earlier routes writes ({after['n']} trips; coverage "
        f"{before['inside_90']:.0f} and {after['inside_90']:.0f} %)",
        f"Alarms in logs with nothing planted: {false} of {sum(a['n'] for a in quiet)}",
        f"A diagnosis of the whole log, made for some of the logs, finds the planted effect in {named}; in {soon} of "
        "them the alarm comes within twice the rows that the diagnosis needs",
    ]
    return found, missed, [*rests, *estimates, *quiet, *alarms]


def _rest(results: Results, kind: str, sheet: str, share: float) -> Line:
    every = _errors(results, kind, sheet, share)
    return {
        "name": f"{TRIPS[kind]}, {sheet} sheet, {100 * share:.0f} % driven", "driven_so_far_percent": 100.0 * share,
        "n": len(every),
        "median_error_percent": float(np.median(np.abs(every[:, 0]))),
        "error_90_percent": float(np.quantile(np.abs(every[:, 0]), 0.9)),
        "half_interval_percent": float(np.median(every[:, 1])),
        "inside_90": 100.0 * float(np.mean(np.abs(every[:, 0]) <= every[:, 1])),
    }  # fmt: skip


def _errors(results: Results, kind: str, sheet: str, share: float) -> np.ndarray:
    return np.array([x for t, r in results if t["kind"] == kind for x in r[sheet][str(share)]])


def _of_noise(results: Results, noise: str) -> list[Line]:
    mine = [r for t, r in results if t["noise"] == noise]
    within, z = stats.norm.ppf(0.95), np.array([r["z"] for r in mine])
    mass_z, percent = (np.concatenate([r[k] for r in mine]) for k in ("mass_z", "mass_percent"))
    over = {"c_rr": z[:, 0], "C_d·A": z[:, 1], "mass": mass_z}
    out = []
    for name, each in over.items():
        inside = np.abs(each) < within
        low, high = wilson(int(np.sum(inside)), len(each))
        error = float(np.median(np.abs(percent))) if name == "mass" else None
        out.append({"name": f"{name}, {noise}", "n": len(each), "median_error_percent": error,
                    "inside_90": 100.0 * float(np.mean(inside)),
                    "interval_95": f"{100 * low:.0f} to {100 * high:.0f} %"})  # fmt: skip
    return out


def _of_alarms(results: Results, *, planted: str | None, noise: str) -> Line:
    mine = [r for t, r in results if (t["planted"], t["noise"]) == (planted, noise)]
    named = [r for r in mine if r["named"] is not None]
    right = [r for r in named if _right(r, planted)]
    return {
        "name": f"{planted or 'nothing'} planted, {noise}", "n": len(mine),
        "right_percent": 100.0 * (len(right) if planted else len(mine) - len(named)) / len(mine),
        "false_percent": 100.0 * (len(named) - len(right)) / len(mine),
        "median_row": float(np.median([r["certain_row"] for r in right])) if right else None,
    }  # fmt: skip


def _right(stream: Line, planted: str | None) -> bool:
    return stream["named"] is not None and planted in (stream["named"], *stream["instead"])


def _beside(streams: Results, batch: Results, planted: str) -> Line:
    """The rows that a diagnosis needs, in the logs that both read, and in how many the alarm is there by twice that."""
    rows = {t["seed"]: r["rows"] for t, r in batch if t["planted"] == planted and r["rows"] is not None}
    soon = [
        r for t, r in streams
        if t["planted"] == planted and t["seed"] in rows and _right(r, planted)
        and r["certain_row"] <= TWICE * rows[t["seed"]]
    ]  # fmt: skip
    median = float(np.median(list(rows.values()))) if rows else None
    return {"batch_logs": len(rows), "batch_median_row": median, "within_twice": len(soon)}


@styled
def _figure(run: Run, forecasts: Results, shares: Sequence[float], alarms: Sequence[Line]) -> None:
    fig = figure(9.0, 4.0)
    ax = fig.add_subplot(1, 2, 1)
    at = 100.0 * np.array(shares)
    kinds = [(kind, sheet) for kind, sheets in SHEETS.items() for sheet in sheets]
    for (kind, sheet), colour in zip(kinds, (GREY, BEFORE, AFTER), strict=True):
        spread = [_errors(forecasts, kind, sheet, s) for s in shares]
        ax.plot(at, [np.median(np.abs(x[:, 0])) for x in spread], color=colour, marker="o",
                label=f"median error: {TRIPS[kind]}, {sheet} sheet")  # fmt: skip
        ax.plot(at, [np.median(x[:, 1]) for x in spread], "--", color=colour)
    ax.plot([], [], "--", color="0.5", label="dashed: half of the 90 % interval")
    ax.set(xlabel="share of the trip driven so far [%]", ylabel="energy of the rest [%]", ylim=(0, None))
    ax.set_title("Forecast of the rest, synthetic fleet")
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=2)
    tidy(ax)
    ax = fig.add_subplot(1, 2, 2)
    place = np.arange(len(alarms))
    ax.barh(place, [a["right_percent"] for a in alarms], color=AFTER, label="right, or in its class")
    if any(a["false_percent"] for a in alarms):
        ax.barh(place, [a["false_percent"] for a in alarms], left=[a["right_percent"] for a in alarms], color=GREY,
                label="another name")  # fmt: skip
    ax.set_yticks(place, [a["name"].split(" planted")[0].replace("_", " ") for a in alarms])
    ax.set(xlabel="logs with an alarm [%]", xlim=(0, 100))
    ax.set_title("Alarms, an effect planted, synthetic")
    if alarms:
        ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=2)
    tidy(ax, grid="x")
    save_figure(run, fig, "while_driving")
