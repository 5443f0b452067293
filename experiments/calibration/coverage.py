"""Do the intervals of `hdev predict` hold what they say, on new trips?

Each world is calibrated on its training trips as `hdev calibrate` does; then every other trip has an interval for each
row and for its total. Synthetic logs whose noise is known, the declared model complete; the second half of a drive from
its first; and the fleet, whose declared sheets lack what its trucks have. Beside them, the interval that takes rows as
independent and normal.
"""

import tempfile
from collections.abc import Iterator, Sequence
from typing import Any, Literal

import numpy as np
from pydantic import Field
from scipy import stats

from experiments.paper1.halves import coefficient, paper_table
from experiments.runner.config import Strict
from experiments.runner.figures import save_figure, styled
from experiments.runner.tables import wilson, worded, write_tables
from hdev_jax.fleet import simulate, synthetic_log
from hdev_jax.inference import cluster_rows, covariance_root, jacobian, left_out, padded, predict
from hdev_jax.inference.parameters import ParameterTable
from hdev_jax.inference.posterior.methods import calibrated
from hdev_jax.inference.sheet import read_sheet
from hdev_jax.logs import read_log
from hdev_jax.physics import Vehicle
from hdev_jax.problem import prepare
from hdev_jax.report.canvas import AFTER, BEFORE, GREY, figure, tidy
from hdev_jax.rundir import Run
from hdev_jax.segments import Segments

__all__ = ["SOURCES", "Config", "collect", "run", "tasks"]

SOURCES = ("../paper1/halves.py",)
NEW = 4  # test trips of a log
LEVELS = (0.5, 0.8, 0.9, 0.95)

Noise = Literal["white", "ar1", "ar1_white", "trip_levels", "student_t", "trip_variance"]


class Config(Strict):
    """Logs of each noise and number of training trips; halves of drives; routes of the fleet's models."""

    experiment: Literal["calibration.coverage"]
    artefact: str
    caption: str
    noises: list[Noise]
    trips: list[int]  # that a log is calibrated on
    of_lengths: list[Noise]  # whose new trips are `longer` times as long as those of the fit, too
    longer: list[float]
    of_halves: list[Noise]  # of which the second half of a drive is predicted from its first
    totals: int = Field(500, ge=4)  # new trips of each setting
    block: int = Field(25, ge=1)  # logs of a task
    models: list[str]
    routes: int = Field(12, ge=4)  # of a model's world, half of them to learn on
    worlds: int = Field(10, ge=1)  # of each model
    ar_coefficient: float = 0.97
    range_percent: list[float]  # that the 90 % intervals of totals have to lie in
    seed: int = Field(0, ge=0)


def tasks(config: Config) -> Iterator[dict[str, Any]]:
    """Blocks of logs, each with its own seed; a fleet's model in each of its worlds."""
    seed = 100_000 + config.seed
    settings = [(noise, trips, NEW, 1.0) for noise in config.noises for trips in config.trips]
    settings += [(noise, max(config.trips), NEW, longer) for noise in config.of_lengths for longer in config.longer]
    for noise, trips, new, longer in [*settings, *((noise, 1, 1, 1.0) for noise in config.of_halves)]:
        logs = -(-config.totals // new)
        for first in range(0, logs, config.block):
            count = min(config.block, logs - first)
            yield {"kind": "logs", "noise": noise, "trips": trips, "new": new, "count": count, "seed": seed,
                   "longer": longer, "ar_coefficient": config.ar_coefficient}  # fmt: skip
            seed += count
    for model in config.models:
        for world in range(config.worlds):
            yield {"kind": "fleet", "model": model, "routes": config.routes, "seed": 1000 * config.seed + world}


def run(task: dict[str, Any]) -> dict[str, Any]:
    """Of each new trip: error of its total over half its interval at each level, and that of the naive one; its rows'
    share inside 90 %; half the interval as a share of the total.
    """
    out: dict[str, list[float]] = {}
    worlds = _logs(task) if task["kind"] == "logs" else _fleet(task)
    for world in worlds:
        for k, values in _scored(*world).items():
            out.setdefault(k, []).extend(values)
    return out


def _logs(task: dict[str, Any]) -> Iterator[Any]:
    half = task["trips"] == 1
    for seed in range(task["seed"], task["seed"] + task["count"]):
        count = 1 if half else task["trips"] + task["new"]
        made = synthetic_log(seed=seed, trips=count, rows_per_trip=500 if half else 250, noise=task["noise"],
                             ar_coefficient=task["ar_coefficient"])  # fmt: skip
        with tempfile.TemporaryDirectory() as folder:
            files = made.write(folder, truth=False)
            problem = prepare(read_log([files["log"]]), read_sheet(files["sheet"]))
        trip = np.asarray(problem.segments.trip)
        learn = np.arange(len(trip)) < len(trip) // 2 if half else trip < task["trips"]
        keep = _begun(trip, min(1.0 / task["longer"], 1.0)) | ~learn
        keep &= _begun(trip, min(task["longer"], 1.0)) | learn
        s, y = problem.segments.take(keep), problem.measured[keep]
        yield problem.vehicle, problem.table, s, y, learn[keep]


def _begun(trip: np.ndarray, share: float) -> np.ndarray:
    """The first `share` of each trip's rows."""
    return np.concatenate([np.arange(n) < share * n for n in np.bincount(trip)])


def _fleet(task: dict[str, Any]) -> Iterator[Any]:
    made = simulate({"seed": task["seed"] + 1, "routes": task["routes"], "variants": [task["model"]]}).vehicles[0]
    v = made.variant
    table = paper_table(v.c_rr, v.cda_m2).plus(
        coefficient("battery.auxiliary_w", "W", v.auxiliary_w, 1500.0, positive=False)
    )
    routes = np.unique(np.asarray(made.segments.trip))
    learn = np.isin(np.asarray(made.segments.trip), routes[: len(routes) // 2])
    yield made.tabular, table, made.segments, made.energy_wh, learn


def _scored(
    vehicle: Vehicle, table: ParameterTable, s: Segments, y: np.ndarray, learn: np.ndarray
) -> dict[str, list[float]]:
    target = "energy_wh"
    rows = padded(s.take(learn), y[learn])
    fit = calibrated(vehicle, table, rows, target, cluster_rows(s.take(learn)), "map").fit
    weight = np.ones(len(y))
    spread, _ = left_out(fit, rows, target, weight[learn])
    new = padded(s.take(~learn), y[~learn])
    predicted = np.asarray(predict(fit.vehicle, new.segments, target))[: new.rows]
    x = jacobian(fit.vehicle, fit.table, new.segments, target)[: new.rows] @ covariance_root(fit.covariance)
    error, trip = y[~learn] - predicted, np.asarray(s.trip)[~learn]
    row = spread.rows(0.9, np.linalg.norm(x, axis=1), predicted)
    plain = np.sqrt(np.mean((y[learn] - fit.predicted) ** 2))
    out: dict[str, list[float]] = {f"off_{level:g}": [] for level in LEVELS}
    out |= {"naive": [], "rows": [], "width": []}
    for t in np.unique(trip):
        at = trip == t
        open_sd = float(np.linalg.norm(np.sum(x[at], axis=0)))
        halves = {level: spread.total(level, open_sd, weight[: at.sum()], predicted[at]) for level in LEVELS}
        off = abs(float(np.sum(error[at])))
        for level, half in halves.items():
            out[f"off_{level:g}"].append(off / half)
        out["naive"].append(off / float(stats.norm.ppf(0.95) * np.hypot(open_sd, plain * np.sqrt(at.sum()))))
        out["rows"].append(float(np.mean(np.abs(error[at]) <= row[at])))
        out["width"].append(halves[0.9] / abs(float(np.sum(y[~learn][at]))))
    return out


def _setting(task: dict[str, Any]) -> str:
    if task["kind"] == "fleet":
        return f"fleet, {task['routes'] // 2} routes"
    if task["trips"] == 1:
        return f"second half of a drive, {task['noise']}"
    longer = "" if task["longer"] == 1.0 else f", new trips {task['longer']:g} times as long"
    return f"{task['noise']}, {task['trips']} trips{longer}"


def collect(config: Config, results: Sequence[tuple[dict[str, Any], dict[str, Any]]], run: Run) -> dict[str, Any]:
    """Shares inside by setting. Trips of one log share their calibration: a share's interval is a little narrow."""
    found: dict[str, dict[str, list[float]]] = {}
    for task, result in results:
        for k, values in result.items():
            found.setdefault(_setting(task), {}).setdefault(k, []).extend(values)
    rows, lines, missed = [], [], []
    low, high = config.range_percent
    for name, r in found.items():
        inside = np.array(r["off_0.9"]) <= 1.0
        share = 100.0 * float(np.mean(inside))
        ours = {"trips": len(inside), "inside_90": share, "rows_inside_90": 100.0 * float(np.mean(r["rows"]))}
        rows.append({"name": name, "paper": None, "ours": ours})
        levels = {v: 100.0 * float(np.mean(np.array(r[f"off_{v:g}"]) <= 1.0)) for v in LEVELS}
        line = {"setting": name, "new trips": len(inside), "coverage of totals by 90 % interval [%]": levels.pop(0.9),
                "its 95 % interval": [100.0 * v for v in wilson(int(inside.sum()), len(inside))],
                "coverage of rows [%]": ours["rows_inside_90"],
                "coverage of totals if rows are taken as independent [%]":
                    100.0 * float(np.mean(np.array(r["naive"]) <= 1.0)),
                "half width [% of the total]": 100.0 * float(np.median(r["width"]))}  # fmt: skip
        lines.append(line | {f"coverage of totals by {100 * v:g} % interval [%]": share for v, share in levels.items()})
        if not low <= share <= high:
            missed.append(f"{worded(name)}: {share:.1f} % covered, target {low:g} to {high:g}")
    write_tables(run, "coverage", lines, config.caption)
    _figure(run, found, config)
    shares = {r["name"]: r["ours"]["inside_90"] for r in rows if not r["name"].startswith("fleet")}
    as_long, others = ([v for k, v in shares.items() if ("times as long" in k) == far] for far in (False, True))
    together = ""
    if as_long and others:
        together = (
            f"90 % intervals cover {min(as_long):.1f} to {max(as_long):.1f} % of the totals of new trips as long as "
            f"the training trips, and {min(others):.0f} to {max(others):.0f} % of longer or shorter ones"
        )
    return {
        "artefact": config.artefact, "data": "synthetic", "synthetic": True, "rows": rows, "better_than_paper": 0,
        "of": 0, "logs": sum(task.get("count", 1) for task, _ in results), "missed": missed,
        "findings": [together] if together else [],
    }  # fmt: skip


@styled
def _figure(run: Run, found: dict[str, dict[str, list[float]]], config: Config) -> None:
    """Shares of totals inside 90 % intervals, with what chance allows, beside those of independent rows."""
    fig = figure(7.0, 0.26 * len(found) + 1.2)
    ax = fig.add_subplot(1, 1, 1)
    for k, r in enumerate(found.values()):
        for key, colour, label in (("naive", BEFORE, "rows taken as independent"), ("off_0.9", AFTER, "hdev predict")):
            inside = np.array(r[key]) <= 1.0
            low, high = wilson(int(inside.sum()), len(inside))
            share = float(np.mean(inside))
            ax.errorbar(100 * share, -k, xerr=[[100 * (share - low)], [100 * (high - share)]], fmt="o", color=colour,
                        markersize=4, label=label if k == 0 else None)  # fmt: skip
    ax.axvspan(*config.range_percent, color=GREY, alpha=0.2, label="target")
    ax.set_yticks(-np.arange(len(found)), [worded(name) for name in found])
    ax.set_xlabel("totals of new trips inside the 90 % interval [%], with its 95 % interval")
    fig.legend(*ax.get_legend_handles_labels(), loc="outside upper center", ncols=3, title="Synthetic logs and fleet")
    tidy(ax, grid="x")
    save_figure(run, fig, "coverage")
