"""A noisy altimeter and speeds in steps: do they pose as physics?

One task is one log: made by the generator, its slope replaced by an altitude with white noise, its speeds by whole
steps, read as a customer's would be, calibrated and diagnosed. Either nothing is planted, or a payload that is larger
than the logged one.
"""

import tempfile
from collections.abc import Iterator, Sequence
from typing import Any, Literal

import numpy as np
import pandas as pd
from pydantic import Field

from experiments.runner.config import Strict
from experiments.runner.figures import save_figure, styled
from experiments.runner.tables import readable, wilson, write_tables
from hdev_jax import calibrate, diagnose
from hdev_jax.fleet import SyntheticLog, synthetic_log
from hdev_jax.inference.sheet import read_sheet
from hdev_jax.report.canvas import AFTER, BEFORE, figure, tidy
from hdev_jax.rundir import Run

__all__ = ["SOURCES", "Config", "collect", "run", "tasks"]

SOURCES = ()
KMH = 3.6
PAYLOAD = "mass_scale"


class Config(Strict):
    """Altimeters by the standard deviation of their noise, each with logs without and with a payload error."""

    experiment: Literal["planted.instruments"]
    artefact: str
    caption: str
    seed: int = Field(0, ge=0)
    trips: int = Field(18, ge=3)
    rows_per_trip: dict[Literal["samples", "segments"], int]
    altitude_sd_m: list[float]
    speed_step_kmh: float = Field(1.0, ge=0.0)
    payload: float = 0.1
    null_logs: int = Field(10, ge=1)  # of each mode and altimeter
    payload_logs: int = Field(10, ge=1)
    wanted: dict[Literal["false_percent", "found_percent", "inside_90", "c_rr_bias_percent"], float]


def tasks(config: Config) -> Iterator[dict[str, Any]]:
    """The first log of every line, then the second of every line."""
    for k in range(max(config.null_logs, config.payload_logs)):
        for mode, rows in config.rows_per_trip.items():
            for at, sd in enumerate(config.altitude_sd_m):
                for payload, logs in ((0.0, config.null_logs), (config.payload, config.payload_logs)):
                    if k < logs:
                        yield {"mode": mode, "trips": config.trips, "rows_per_trip": rows, "altitude_sd_m": sd,
                               "speed_step_kmh": config.speed_step_kmh, "payload": payload,
                               "seed": config.seed + 1000 * at + k}  # fmt: skip


def run(task: dict[str, Any]) -> dict[str, Any]:
    """The calibrated c_rr over the true one [%], what is named, and the payload error with its interval."""
    planted = {PAYLOAD: {"scale": task["payload"]}} if task["payload"] else {}
    made = synthetic_log(
        seed=task["seed"], trips=task["trips"], rows_per_trip=task["rows_per_trip"], mode=task["mode"], effects=planted
    )
    frame = _as_measured(made, task)
    with tempfile.TemporaryDirectory() as folder:
        sheet = read_sheet(made.write(folder, truth=False)["sheet"])
    out: dict[str, Any] = {}
    if not planted:
        c_rr = calibrate(frame, sheet).summary["baseline"]["parameters"]["road.c_rr"]["value"]
        out["c_rr_percent"] = 100.0 * (c_rr / made.vehicle.c_rr - 1.0)
    found = diagnose(frame, sheet, seed=task["seed"]).effects
    out["named"] = [
        [e, *filter(None, other.split(", "))]
        for e, other in found.drop_duplicates("effect")[["effect", "indistinguishable_from"]].itertuples(index=False)
    ]
    for size in found.loc[found["effect"] == PAYLOAD, ["value", "low", "high"]].to_numpy(float):
        out["payload"] = size.tolist()
    return out


def _as_measured(made: SyntheticLog, task: dict[str, Any]) -> pd.DataFrame:
    frame, rng = made.frame, np.random.default_rng([task["seed"], 11])
    noisy = frame["altitude_m"] + rng.normal(0.0, task["altitude_sd_m"], len(frame))
    frame = frame.drop(columns="grade_rad").assign(altitude_m=noisy)
    step = task["speed_step_kmh"]
    for column in ("speed_mps", "speed_start_mps", "speed_end_mps"):
        if step and column in frame:
            frame[column] = np.round(frame[column] * KMH / step) * step / KMH
    return frame


def collect(config: Config, results: Sequence[tuple[dict[str, Any], dict[str, Any]]], run: Run) -> dict[str, Any]:
    """A line for each mode and altimeter; a figure of the sizes found."""
    lines = [
        _line(mode, sd, [(t, r) for t, r in results if (t["mode"], t["altitude_sd_m"]) == (mode, sd)])
        for mode in config.rows_per_trip for sd in config.altitude_sd_m
    ]  # fmt: skip
    total = _line("all", None, results)
    write_tables(run, "instruments", [*lines, total], config.caption)
    _figure(run, results, config)
    missed = []
    for key, want in config.wanted.items():
        value = total[key]
        if value is not None and (abs(value) > want if key in ("false_percent", "c_rr_bias_percent") else value < want):
            missed.append(f"{readable(key)}: {value:.3g}, target {want:g}")
    bias = [x["c_rr_bias_percent"] for x in lines]
    findings = [
        f"Without a payload error, a cause is named in {total['false_percent']:.2g} % of {total['null_logs']} logs "
        f"(95 % interval {total['false_95']})",
        f"The mean bias of the calibrated c_rr is {total['c_rr_bias_percent']:+.1f} % ({min(bias):+.1f} to "
        f"{max(bias):+.1f} % by kind of log)",
        f"A payload error of {100 * config.payload:g} % is found, alone or in its class, in "
        f"{total['found_percent']:.0f} % of {total['payload_logs']} logs; where it has a size, 90 % intervals cover it "
        f"in {total['inside_90']:.0f} %",
    ]
    rows = [{"name": x["name"], "paper": None, "ours": x} for x in (*lines, total)]
    return {"artefact": config.artefact, "data": "synthetic logs", "synthetic": True, "rows": rows,
            "better_than_paper": 0, "of": 0, "missed": missed, "findings": findings}  # fmt: skip


def _line(mode: str, sd: float | None, results: Sequence[Any]) -> dict[str, Any]:
    null = [r for t, r in results if not t["payload"]]
    named = sum(bool(r["named"]) for r in null)
    planted = [(t["payload"], r) for t, r in results if t["payload"]]
    sizes = [(truth, *r["payload"]) for truth, r in planted if "payload" in r]
    inside = [low <= truth <= high for truth, _, low, high in sizes]
    bias = np.array([r["c_rr_percent"] for r in null])
    return {
        "name": mode if sd is None else f"{mode}, altitude ± {sd:g} m",
        "null_logs": len(null), "false_percent": 100.0 * named / len(null),
        "false_95": " to ".join(f"{100 * x:.0f}" for x in wilson(named, len(null))) + " %",
        "c_rr_bias_percent": float(np.mean(bias)),
        "payload_logs": len(planted),
        "found_percent": 100.0 * sum(any(PAYLOAD in c for c in r["named"]) for _, r in planted) / len(planted),
        "median_size": float(np.median([s[1] for s in sizes])) if sizes else None,
        "inside_90": 100.0 * float(np.mean(inside)) if sizes else None,
    }  # fmt: skip


@styled
def _figure(run: Run, results: Sequence[Any], config: Config) -> None:
    fig = figure(7.5, 3.4)
    for at, mode in enumerate(config.rows_per_trip):
        ax = fig.add_subplot(1, len(config.rows_per_trip), at + 1)
        for k, sd in enumerate(config.altitude_sd_m):
            mine = [r["payload"] for t, r in results if t["payload"] and "payload" in r and t["mode"] == mode
                    and t["altitude_sd_m"] == sd]  # fmt: skip
            place = k + np.linspace(-0.3, 0.3, max(len(mine), 2))[: len(mine)]
            for x, (value, low, high) in zip(place, mine, strict=True):
                ax.plot([x, x], [100 * low, 100 * high], color=BEFORE, lw=1)
                ax.plot(x, 100 * value, "o", color=AFTER, ms=3)
        ax.axhline(100 * config.payload, color="0.5", lw=0.8)
        ax.set_xticks(range(len(config.altitude_sd_m)), [f"{sd:g}" for sd in config.altitude_sd_m])
        ax.set(xlabel="noise of the altitude [m]", ylabel="payload error found [%]", title=mode)
        tidy(ax)
    fig.suptitle("Synthetic logs with a payload error: estimates with 90 % intervals; grey line: the true error")
    save_figure(run, fig, "instruments")
