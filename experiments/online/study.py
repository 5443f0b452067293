"""Are estimates, forecasts and alarms right while a vehicle drives?

Three kinds of stream, all synthetic. Routes of the fleet's models: at a quarter, half and three quarters of each trip,
the energy of the rest is forecast from the rows so far, the first paper's table 1 at every point of a trip. Logs whose
sheet gives c_rr, C_dA and the mass by trip an sd: the estimates at the end against the truth. Logs in which an effect
is planted, or none: which alarm comes, and after how many rows.
"""

import tempfile
from collections.abc import Iterator, Sequence
from typing import Any, Literal

import numpy as np
import pandas as pd
from pydantic import Field
from scipy import stats

from experiments.runner.config import Strict
from experiments.runner.figures import save_figure, styled
from experiments.runner.tables import wilson, write_tables
from hdev_jax.fleet import SyntheticLog, simulate, synthetic_log
from hdev_jax.inference.sheet import Sheet, read_sheet
from hdev_jax.online import State, Watch, forecast, scan, start
from hdev_jax.online.running import Running, running_channels
from hdev_jax.report.canvas import AFTER, BEFORE, GREY, figure, tidy
from hdev_jax.rundir import Run

__all__ = ["SOURCES", "Config", "collect", "run", "tasks"]

SOURCES = ()
PADDED = 128  # rows are padded to a multiple, so that few lengths are compiled; a row of NaN counts for nothing
FAR_M = 10_000.0  # after which a trip's mass has to be known
ROAD = {"c_rr": (0.006, 0.0008), "cda_m2": (5.6, 0.5)}
CHANNELS = (
    "mass_kg", "grade_rad", "ambient_temp_c", "wind_speed_mps", "wind_from_rad", "heading_rad", "curvature_1pm",
    "wet_road", "soc", "voltage_v", "battery_temp_c", "brake_pressure_pa",
)  # fmt: skip

Noise = Literal["white", "ar1", "ar1_white", "trip_levels", "student_t", "trip_variance"]


class Config(Strict):
    """Models and routes of the forecasts, noises and logs of the estimates, effects of the alarms."""

    experiment: Literal["online.study"]
    artefact: str
    caption: str
    seed: int = Field(0, ge=0)
    models: list[str]
    routes: int = Field(15, ge=3)
    worlds: int = Field(4, ge=1)
    shares: list[float]  # of a trip, after which the rest is forecast
    noises: list[Noise]
    logs: int = Field(25, ge=1)  # of each noise
    trips: int = Field(12, ge=3)
    rows_per_trip: int = Field(150, ge=50)
    ar_coefficient: float = 0.85
    planted: list[str]
    planted_logs: int = Field(10, ge=1)
    ratio: float = 0.5  # of an effect to the noise
    range_percent: tuple[float, float] = (85.0, 95.0)
    within_percent: dict[str, float]


def tasks(config: Config) -> Iterator[dict[str, Any]]:
    """A model in a world, a log of a noise, a log with an effect: each with its own seed."""
    for model in config.models:
        for world in range(config.worlds):
            yield {"kind": "forecast", "model": model, "routes": config.routes, "shares": config.shares,
                   "seed": 1000 * config.seed + world}  # fmt: skip
    seed = 100_000 + config.seed
    made = {"trips": config.trips, "rows_per_trip": config.rows_per_trip, "ar_coefficient": config.ar_coefficient}
    for noise in config.noises:
        for k in range(config.logs):
            yield {"kind": "estimates", "noise": noise, "seed": seed + k, **made}
            yield {"kind": "alarms", "noise": noise, "planted": None, "ratio": None, "seed": seed + k, **made}
    for effect in config.planted:
        for k in range(config.planted_logs):
            yield {"kind": "alarms", "noise": "ar1", "planted": effect, "ratio": config.ratio, "seed": seed + k, **made}


def run(task: dict[str, Any]) -> dict[str, Any]:
    """One stream."""
    return {"forecast": _forecasts, "estimates": _estimates, "alarms": _alarms}[task["kind"]](task)


def _fed(state: State, rows: np.ndarray, watch: Watch | None = None) -> tuple[State, Any]:
    """The state after the rows and what was known after each."""
    padded = np.full((-(-len(rows) // PADDED) * PADDED, rows.shape[1]), np.nan)
    padded[: len(rows)] = rows
    return scan(state, padded, None if watch is None else watch.columns(padded))


def _rows(state: State, made: SyntheticLog) -> np.ndarray:
    frame = made.frame
    named = {"measured": frame["energy_wh"], "trip": frame["trip_id"].astype("category").cat.codes + 1.0}
    each = pd.DataFrame(Running.over(zip(frame["trip_id"], frame.to_dict("records"), strict=True)), index=frame.index)
    named |= {c: each[c] for c in each}
    missing = np.full(len(frame), np.nan)
    return np.stack([np.asarray(named.get(c, frame.get(c, missing)), float) for c in state.form.columns], axis=1)


def _forecasts(task: dict[str, Any]) -> dict[str, Any]:
    """By share of the trip: error over the true energy of the rest [%], half the interval over it [%]."""
    vehicle = simulate({"seed": task["seed"] + 1, "routes": task["routes"], "variants": [task["model"]]})
    with tempfile.TemporaryDirectory() as folder:
        sheets = vehicle.write_sheets(folder)
        v = vehicle.vehicles[0]
        state, _ = start(read_sheet(sheets[v.id]), v.segments.channels.keys(), "energy_wh")
    columns = {"measured": v.energy_wh, **v.segments.channels}
    every = [np.asarray(columns.get(c, getattr(v.segments, c, None)), float) for c in state.form.columns]
    rows, trip = np.stack(every, axis=1), np.asarray(v.segments.trip)
    measured, out = state.form.columns.index("measured"), {str(s): [] for s in task["shares"]}
    for k in np.unique(trip):
        own, at = rows[trip == k], 0
        for share in sorted(task["shares"]):
            until = int(share * len(own))
            state, _ = _fed(state, own[at:until])
            at, true = until, float(own[until:, measured].sum())
            told = forecast(state, own[until:])
            low, high = told.interval_wh
            out[str(share)].append([100.0 * (told.energy_wh / true - 1.0), 50.0 * (high - low) / abs(true)])
        state, _ = _fed(state, own[at:])
    return out


def _estimates(task: dict[str, Any]) -> dict[str, Any]:
    """(estimate − truth)/sd of c_rr and C_dA at the end; of the mass after 10 km of each trip, with its error [%]."""
    made = _log(task)
    known, _ = start(Sheet(mass_kg=29e3, road=ROAD, driveline={"efficiency": 0.91}), ("mass_kg", "grade_rad"))
    end, _ = _fed(known, _rows(known, made))
    truth, names = {"road.c_rr": made.vehicle.c_rr, "road.cda_m2": made.vehicle.cda_m2}, list(end.form.names)
    where = [next(i for i, n in enumerate(names) if n.endswith(path.split(".")[1])) for path in truth]
    z = [(float(np.asarray(end.values)[i]) - t) / float(np.asarray(end.sd)[i])
         for i, t in zip(where, truth.values(), strict=True)]  # fmt: skip
    open_, _ = start(Sheet(mass_kg=(29e3, 8e3), road=ROAD, driveline={"efficiency": 0.91}), ("grade_rad",))
    _, now = _fed(open_, _rows(open_, made))
    k = list(open_.form.names).index("mass_kg")
    mass, sd, true = np.asarray(now.values)[:, k], np.asarray(now.sd)[:, k], made.frame["mass_kg"].to_numpy()
    error, over = [], []
    for _, part in made.frame.reset_index(drop=True).groupby("trip_id"):
        far = np.flatnonzero(part["distance_m"].cumsum().to_numpy() >= FAR_M)
        at = part.index.to_numpy()
        if len(far) and np.ptp(true[at[: far[0] + 1]]) == 0:
            i = int(at[far[0]])
            error.append(100.0 * float(mass[i] / true[i] - 1.0))
            over.append(float((mass[i] - true[i]) / sd[i]))
    return {"z": z, "mass_percent": error, "mass_z": over}


def _log(task: dict[str, Any]) -> SyntheticLog:
    planted = task.get("planted")
    return synthetic_log(
        seed=task["seed"], trips=task["trips"], rows_per_trip=task["rows_per_trip"], noise=task["noise"],
        ar_coefficient=task["ar_coefficient"], effects={planted: {}} if planted else {},
        ratio=task.get("ratio"),
    )  # fmt: skip


def _alarms(task: dict[str, Any]) -> dict[str, Any]:
    """The effect that is named, those that are as likely, and the row from which on it is certain; None for none."""
    made = _log(task)
    sheet = Sheet(mass_kg=29e3, road=ROAD, driveline={"efficiency": 0.91})
    here = [c for c in CHANNELS if c in made.frame]
    here += running_channels(here)
    watch = Watch.of(start(sheet, here)[0])
    state, _ = start(sheet, here, candidates=watch.candidates)
    rows = _rows(state, made)
    end, _ = _fed(state, rows, watch)
    alarm = watch.alarm(end)
    if alarm is None:
        return {"named": None, "rows": len(rows)}
    return {"named": alarm.effect, "instead": list(alarm.instead), "certain_row": alarm.certain_row, "rows": len(rows)}


def collect(config: Config, results: Sequence[tuple[dict[str, Any], dict[str, Any]]], run: Run) -> dict[str, Any]:
    """Three tables and a figure."""
    missed: list[str] = []
    low, high = config.range_percent
    of = {kind: [(t, r) for t, r in results if t["kind"] == kind] for kind in ("forecast", "estimates", "alarms")}
    rests = [_rest(config, of["forecast"], share) for share in config.shares]
    estimates = [line for noise in config.noises for line in _of_noise(of["estimates"], noise)]
    alarms = [_of_alarms(of["alarms"], planted=None, noise=noise) for noise in config.noises]
    alarms += [_of_alarms(of["alarms"], planted=e, noise="ar1") for e in config.planted]
    for line in (*rests, *estimates):
        if not low <= line["inside_90"] <= high:
            missed.append(f"{line['name']}: 90 % intervals hold {line['inside_90']:.0f} %, target {low:g} to {high:g}")
        most = config.within_percent.get(line["name"])
        if most is not None and (line["median_error_percent"] or 0.0) > most:
            missed.append(f"{line['name']}: {line['median_error_percent']:.2g} % in the median, target {most:g}")
    false = sum(round(a["false_percent"] * a["n"] / 100.0) for a in alarms[: len(config.noises)])
    quiet = sum(a["n"] for a in alarms[: len(config.noises)])
    write_tables(run, "ahead", rests, config.caption)
    write_tables(run, "estimates", estimates, "Estimates at the end of a log, mass after 10 km of each trip; synthetic")
    write_tables(run, "alarms", alarms, "Alarms; synthetic")
    _figure(run, of["forecast"], config.shares, alarms)
    rows = [{"name": x["name"], "paper": None, "ours": x} for x in (*rests, *estimates, *alarms)]
    at = rests[len(rests) // 2]
    found = [f"After {at['share_percent']:.0f} % of a trip, the forecast of its remaining energy has a median error of "
             f"{at['median_error_percent']:.1f} % ({at['n']} trips); 90 % intervals contain {at['inside_90']:.0f} %",
             f"Nothing planted: {false} of {quiet} streams have an alarm"]  # fmt: skip
    return {"artefact": config.artefact, "data": "synthetic fleet and logs", "synthetic": True, "rows": rows,
            "better_than_paper": 0, "of": 0, "missed": missed, "findings": found}  # fmt: skip


def _rest(config: Config, results: Sequence[Any], share: float) -> dict[str, Any]:
    every = np.array([x for _, r in results for x in r[str(share)]])
    return {
        "name": f"rest after {100 * share:.0f} %", "share_percent": 100.0 * share, "n": len(every),
        "median_error_percent": float(np.median(np.abs(every[:, 0]))),
        "error_90_percent": float(np.quantile(np.abs(every[:, 0]), 0.9)),
        "half_interval_percent": float(np.median(every[:, 1])),
        "inside_90": 100.0 * float(np.mean(np.abs(every[:, 0]) <= every[:, 1])),
    }  # fmt: skip


def _of_noise(results: Sequence[Any], noise: str) -> list[dict[str, Any]]:
    mine = [r for t, r in results if t["noise"] == noise]
    within, z = stats.norm.ppf(0.95), np.array([r["z"] for r in mine])
    mass_z, percent = (np.concatenate([r[k] for r in mine]) for k in ("mass_z", "mass_percent"))
    over = {"c_rr": z[:, 0], "C_dA": z[:, 1], "mass": mass_z}
    out = []
    for name, each in over.items():
        inside = np.abs(each) < within
        low, high = wilson(int(np.sum(inside)), len(each))
        error = float(np.median(np.abs(percent))) if name == "mass" else None
        out.append({"name": f"{name}, {noise}", "n": len(each), "median_error_percent": error,
                    "inside_90": 100.0 * float(np.mean(inside)),
                    "interval_95": f"{100 * low:.0f}–{100 * high:.0f}"})  # fmt: skip
    return out


def _of_alarms(results: Sequence[Any], *, planted: str | None, noise: str) -> dict[str, Any]:
    mine = [r for t, r in results if (t["planted"], t["noise"]) == (planted, noise)]
    named = [r for r in mine if r["named"] is not None]
    right = [r for r in named if planted in (r["named"], *r["instead"])]
    return {
        "name": f"{planted or 'nothing'} planted, {noise}", "n": len(mine),
        "right_percent": 100.0 * (len(right) if planted else len(mine) - len(named)) / len(mine),
        "false_percent": 100.0 * (len(named) - len(right)) / len(mine),
        "median_row": float(np.median([r["certain_row"] for r in right])) if right else None,
    }  # fmt: skip


@styled
def _figure(run: Run, forecasts: Sequence[Any], shares: Sequence[float], alarms: Sequence[dict[str, Any]]) -> None:
    fig = figure(9.0, 3.6)
    ax = fig.add_subplot(1, 2, 1)
    spread = [np.array([x for _, r in forecasts for x in r[str(s)]]) for s in shares]
    at = 100.0 * np.array(shares)
    for level, style in ((0.5, "-"), (0.9, "--")):
        ax.plot(at, [np.quantile(np.abs(x[:, 0]), level) for x in spread], style, color=AFTER, marker="o",
                label=f"error, {100 * level:.0f} % of trips below")  # fmt: skip
    ax.plot(at, [np.median(x[:, 1]) for x in spread], color=BEFORE, marker="s", label="half the 90 % interval, median")
    ax.set(xlabel="share of the trip behind [%]", ylabel="energy of the rest [%]", ylim=(0, None))
    ax.set_title("Forecast of the rest, synthetic fleet")
    ax.legend()
    tidy(ax)
    ax = fig.add_subplot(1, 2, 2)
    shown = [a for a in alarms if not a["name"].startswith("nothing")]
    place = np.arange(len(shown))
    ax.barh(place, [a["right_percent"] for a in shown], color=AFTER, label="right, or in its class")
    ax.barh(place, [a["false_percent"] for a in shown], left=[a["right_percent"] for a in shown], color=GREY,
            label="another name")  # fmt: skip
    ax.set_yticks(place, [a["name"].split(" planted")[0].replace("_", " ") for a in shown])
    ax.set(xlabel="streams with an alarm [%]", xlim=(0, 100))
    ax.set_title("Alarms, an effect planted, synthetic")
    if shown:
        ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=2)
    tidy(ax, grid="x")
    save_figure(run, fig, "while_driving")
