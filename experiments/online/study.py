"""Are estimates, forecasts and alarms right while a vehicle drives?

Three kinds of stream, all synthetic. Trips of the fleet's models: at a quarter, half and three quarters of each, the
energy of the rest is forecast from the rows so far. Trips are laps of one track, as in the first paper's table 1, or
routes; these with the sheet as declared, and with the sheet that a diagnosis of earlier routes of the same vehicle
writes. Logs whose sheet
gives c_rr, C_dA and the mass by trip an sd: the estimates at the end against the truth. Logs in which an effect is
planted, or none: which alarm comes, and after how many rows; and how many rows a diagnosis of the log needs.
"""

import tempfile
from collections.abc import Iterator, Sequence
from typing import Any, Literal

import numpy as np
import pandas as pd
from pydantic import Field

from experiments.online.tables import tabulate
from experiments.runner.config import Strict
from hdev_jax import diagnose
from hdev_jax.fleet import FleetVehicle, SyntheticLog, simulate, synthetic_log
from hdev_jax.inference.sheet import Sheet, read_sheet
from hdev_jax.online import State, Watch, forecast, scan, start
from hdev_jax.online.running import Running, running_channels
from hdev_jax.rundir import Run

__all__ = ["SOURCES", "Config", "Noise", "collect", "rows_of", "run", "tasks", "watching"]

SOURCES = ()
PADDED = 128  # rows are padded to a multiple, so that few lengths are compiled; a row of NaN counts for nothing
NOISE_WH, NOISE_SHARE = 3.0, 0.01  # of a row's energy, as in configs/paper1/table1.toml
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
    routes_before: int = Field(12, ge=3)  # which the diagnosis has
    worlds: int = Field(4, ge=1)
    tracks: int = Field(50, ge=1)
    laps: int = Field(4, ge=1)  # of each track
    shares: list[float]  # of a trip, after which the rest is forecast
    noises: list[Noise]
    logs: int = Field(25, ge=1)  # of each noise
    trips: int = Field(12, ge=3)
    rows_per_trip: int = Field(150, ge=50)
    ar_coefficient: float = 0.85
    planted: list[str]
    planted_logs: int = Field(10, ge=1)
    batch_logs: int = Field(4, ge=0)  # of these, which a diagnosis reads too
    ratio: float = 0.5  # of an effect to the noise
    range_percent: tuple[float, float] = (85.0, 95.0)
    within_percent: dict[str, float]


def tasks(config: Config) -> Iterator[dict[str, Any]]:
    """A model in a world, a log of a noise, a log with an effect: each with its own seed."""
    for model in config.models:
        yield {"kind": "laps", "model": model, "routes": config.tracks, "laps": config.laps, "shares": config.shares,
               "seed": config.seed}  # fmt: skip
        for world in range(config.worlds):
            yield {"kind": "forecast", "model": model, "routes": config.routes,
                   "routes_before": config.routes_before, "shares": config.shares,
                   "seed": 1000 * config.seed + world}  # fmt: skip
    seed = 100_000 + config.seed
    made = {"trips": config.trips, "rows_per_trip": config.rows_per_trip, "ar_coefficient": config.ar_coefficient}
    for noise in config.noises:
        for k in range(config.logs):
            yield {"kind": "estimates", "noise": noise, "seed": seed + k, **made}
            yield {"kind": "alarms", "noise": noise, "planted": None, "ratio": None, "seed": seed + k, **made}
    for effect in config.planted:
        for k in range(config.planted_logs):
            log = {"noise": "ar1", "planted": effect, "ratio": config.ratio, "seed": seed + k, **made}
            yield {"kind": "alarms", **log}
            if k < config.batch_logs:
                yield {"kind": "batch", **log}


def run(task: dict[str, Any]) -> dict[str, Any]:
    """One stream."""
    kinds = {"forecast": _forecasts, "laps": _laps, "estimates": _estimates, "alarms": _alarms, "batch": _batch}
    return kinds[task["kind"]](task)


def _fed(state: State, rows: np.ndarray, watch: Watch | None = None) -> tuple[State, Any]:
    """The state after the rows and what was known after each."""
    padded = np.full((-(-len(rows) // PADDED) * PADDED, rows.shape[1]), np.nan)
    padded[: len(rows)] = rows
    return scan(state, padded, None if watch is None else watch.columns(padded))


def rows_of(state: State, frame: pd.DataFrame) -> np.ndarray:
    """The rows of a log as `update` reads them."""
    named = {"measured": frame["energy_wh"], "trip": frame["trip_id"].astype("category").cat.codes + 1.0}
    each = pd.DataFrame(Running.over(zip(frame["trip_id"], frame.to_dict("records"), strict=True)), index=frame.index)
    named |= {c: each[c] for c in each}
    missing = np.full(len(frame), np.nan)
    return np.stack([np.asarray(named.get(c, frame.get(c, missing)), float) for c in state.form.columns], axis=1)


def _forecasts(task: dict[str, Any]) -> dict[str, Any]:
    """By sheet and share of the trip: error over the true energy of the rest [%], half the interval over it [%]."""
    before = task["routes_before"]
    fleet = simulate({"seed": task["seed"] + 1, "routes": before + task["routes"], "variants": [task["model"]]})
    v = fleet.vehicles[0]
    with tempfile.TemporaryDirectory() as folder:
        declared = fleet.write_sheets(folder)[v.id]
        seen = v.frame["trip_id"].isin(v.trip_names[:before])
        found = diagnose(v.frame[seen], declared)
        diagnosed = declared.with_name("diagnosed.toml")
        diagnosed.write_text(found.sheet)
        sheets = {"declared": read_sheet(declared), "diagnosed": read_sheet(diagnosed)}
    trips = [pd.DataFrame(part) for _, part in v.frame[~seen].groupby("trip_id", sort=False)]
    rests = {name: _rests(_before(sheet, v), trips, task["shares"]) for name, sheet in sheets.items()}
    return {**rests, "effects": list(found.effects["effect"])}


def _laps(task: dict[str, Any]) -> dict[str, Any]:
    """The first paper's table 1 (`experiments.paper1.table1`): each trip is laps of one track, known by none before."""
    fleet = simulate({"seed": task["seed"] + 1, "routes": task["routes"], "variants": [task["model"]]})
    v = fleet.vehicles[0]
    with tempfile.TemporaryDirectory() as folder:
        state = _before(read_sheet(fleet.write_sheets(folder)[v.id]), v)
    out: dict[str, list[Any]] = {str(s): [] for s in task["shares"]}
    rng = np.random.default_rng([task["seed"], 3])
    for name, lap in v.frame.groupby("trip_id", sort=False):
        shown = np.asarray(v.truth["energy_shown_wh"])[(v.frame["trip_id"] == name).to_numpy()]
        once = float((lap["time_s"] + lap["duration_s"]).iloc[-1])
        sd = np.hypot(NOISE_WH, NOISE_SHARE * shown)
        laps = [
            lap.assign(time_s=lap["time_s"] + k * once, energy_wh=shown + sd * rng.standard_normal(len(lap)))
            for k in range(task["laps"])
        ]
        for share, each in _rests(state, [pd.concat(laps, ignore_index=True)], task["shares"]).items():
            out[share] += each
    return {"declared": out}


def _before(sheet: Sheet, v: FleetVehicle) -> State:
    """A vehicle of the fleet before its first row."""
    here = list(v.segments.channels)
    return start(sheet, [*here, *running_channels(here)], "energy_wh")[0]


def _rests(state: State, trips: Sequence[pd.DataFrame], shares: Sequence[float]) -> dict[str, Any]:
    """By share, of each trip: error of the rest's energy and half its interval [%]."""
    measured, out = state.form.columns.index("measured"), {str(s): [] for s in shares}
    for k, trip in enumerate(trips):
        own, at = rows_of(state, trip), 0
        own[:, state.form.columns.index("trip")] = k + 1.0
        for share in sorted(shares):
            until = int(share * len(own))
            state, _ = _fed(state, own[at:until])
            at, true = until, float(own[until:, measured].sum())
            rest = forecast(state, own[until:])
            low, high = rest.interval_wh
            out[str(share)].append([100.0 * (rest.energy_wh / true - 1.0), 50.0 * (high - low) / abs(true)])
        state, _ = _fed(state, own[at:])
    return out


def _estimates(task: dict[str, Any]) -> dict[str, Any]:
    """(estimate − truth)/sd of c_rr and C_dA at the end; of the mass after 10 km of each trip, with its error [%]."""
    made = _log(task)
    known, _ = start(Sheet(mass_kg=29e3, road=ROAD, driveline={"efficiency": 0.91}), ("mass_kg", "grade_rad"))
    end, _ = _fed(known, rows_of(known, made.frame))
    truth, names = {"road.c_rr": made.vehicle.c_rr, "road.cda_m2": made.vehicle.cda_m2}, list(end.form.names)
    where = [next(i for i, n in enumerate(names) if n.endswith(path.split(".")[1])) for path in truth]
    z = [(float(np.asarray(end.values)[i]) - t) / float(np.asarray(end.sd)[i])
         for i, t in zip(where, truth.values(), strict=True)]  # fmt: skip
    open_, _ = start(Sheet(mass_kg=(29e3, 8e3), road=ROAD, driveline={"efficiency": 0.91}), ("grade_rad",))
    _, now = _fed(open_, rows_of(open_, made.frame))
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
    state, watch = watching(made)
    rows = rows_of(state, made.frame)
    end, _ = _fed(state, rows, watch)
    alarm = watch.alarm(end)
    if alarm is None:
        return {"named": None, "rows": len(rows)}
    return {"named": alarm.effect, "instead": list(alarm.instead), "certain_row": alarm.certain_row, "rows": len(rows)}


def watching(made: SyntheticLog) -> tuple[State, Watch]:
    """A vehicle of the log before its first row, and what is watched: every effect that its channels allow."""
    sheet = Sheet(mass_kg=29e3, road=ROAD, driveline={"efficiency": 0.91})
    here = [c for c in CHANNELS if c in made.frame]
    here += running_channels(here)
    watch = Watch.of(start(sheet, here)[0])
    return start(sheet, here, candidates=watch.candidates)[0], watch


def _batch(task: dict[str, Any]) -> dict[str, Any]:
    """The rows of the fewest trips, from the first on, in which a diagnosis names the planted effect; None for none."""
    frame = _log(task).frame
    trips = list(dict.fromkeys(frame["trip_id"]))
    sheet = Sheet(mass_kg=29e3, road=ROAD, driveline={"efficiency": 0.91})

    def names(n: int) -> bool:
        found = diagnose(frame[frame["trip_id"].isin(trips[:n])], sheet).effects
        return any(task["planted"] in (e, *other.split(", ")) for e, other in
                   zip(found["effect"], found["indistinguishable_from"], strict=True))  # fmt: skip

    few, enough = 2, len(trips)  # a diagnosis needs three trips
    if not names(enough):
        return {"rows": None}
    while enough - few > 1:
        half = (few + enough) // 2
        few, enough = (few, half) if names(half) else (half, enough)
    return {"rows": int(np.isin(frame["trip_id"], trips[:enough]).sum())}


def collect(config: Config, results: Sequence[tuple[dict[str, Any], dict[str, Any]]], run: Run) -> dict[str, Any]:
    """Tables and a figure; what is missed."""
    found, missed, lines = tabulate(results, run, config.caption, config.range_percent, config.within_percent)
    rows = [{"name": x["name"], "paper": None, "ours": x} for x in lines]
    return {"artefact": config.artefact, "data": "synthetic fleet and logs", "synthetic": True, "rows": rows,
            "better_than_paper": 0, "of": 0, "missed": missed, "findings": found}  # fmt: skip
