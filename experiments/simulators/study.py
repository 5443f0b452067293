"""What does the diagnosis say of vehicles that other simulators drive? Truth from FASTSim and SUMO, rivals beside.

One task is one log: a vehicle of a simulator, one of its parameters changed and the sheet as before, driven, written
and read as a customer's log, diagnosed, and given to the rivals. Its result keeps what was said; `scores` scores it.

Its error is compared with that of a refit that knows the cause (`refit`).
"""

import itertools
import tempfile
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pandas as pd

from experiments.planted.rivals import run_rivals
from experiments.simulators.config import Config
from experiments.simulators.logs import SimulatedLog
from experiments.simulators.plants import PLANTS
from experiments.simulators.refit import known_sheet, refit_rmse
from experiments.simulators.tables import collect
from experiments.simulators.truth import make
from experiments.simulators.vehicles import Vehicle
from hdev_jax.diagnosis.diagnose import Outcome, diagnose
from hdev_jax.diagnosis.settings import Settings
from hdev_jax.inference.sheet import read_sheet
from hdev_jax.logs import by_distance, read_log
from hdev_jax.physics import LIBRARY
from hdev_jax.problem import Problem, Split, prepare, split_trips
from hdev_jax.units import AIR_DENSITY_KGPM3

__all__ = ["SOURCES", "Config", "collect", "run", "tasks", "together"]

SOURCES = (
    "config.py", "drives.py", "logs.py", "plants.py", "refit.py", "truth.py", "vehicles.py",
    "with_fastsim.py", "with_sumo.py", "../planted/rivals.py",
)  # fmt: skip


def tasks(config: Config) -> Iterator[dict[str, Any]]:
    """One for each log: the first of every vehicle and change, then the second, so that a part has all of them. Each
    has a vehicle, trips and noise of its own: what happens by chance counts once."""
    seeds = itertools.count(config.seed)
    for k in range(max(line.logs for line in config.lines.values())):
        for key, line in config.lines.items():
            for vehicle in line.vehicles:
                for plant in line.plants if k < line.logs else ():
                    yield {
                        "line": key, "simulator": line.simulator, "vehicle": vehicle, "plant": plant,
                        "rows": line.rows, "measured": line.measured, "seed": next(seeds),
                        "trips": config.trips, "seconds": config.seconds, "noise": config.noise,
                        "ar_coefficient": config.ar_coefficient, "fdr": config.fdr, "rivals": config.rivals,
                    }  # fmt: skip


def together(task: Mapping[str, Any]) -> str:
    """Logs of one line and change, whose programs are much the same."""
    return f"{task['line']}+{task['plant']}"


def run(task: dict[str, Any]) -> dict[str, Any]:
    """One log through the whole loop."""
    made, _, true = make(task)
    known = make({**task, "rows": "intervals"})[0].frame if task["rows"] == "samples" else made.frame
    missing = PLANTS[task["plant"]].missing
    problem, split = _read(task["rows"], made.frame.drop(columns=missing or []), made.sheet)
    started = time.perf_counter()
    outcome = diagnose(problem, split, LIBRARY, settings=Settings(fdr=task["fdr"]), seed=0, next_drives=False)
    seconds = time.perf_counter() - started
    summary = outcome.summary
    return {
        "named": [
            {"id": e["id"], "class": [e["id"], *e["indistinguishable_from"]], "class_size": e["class_size"],
             "parameters": e["parameters"]}
            for e in summary["effects"]
        ],
        "verdict": summary["verdict"],
        "unexplained": bool(summary["unexplained"]["significant"]),
        "signature": summary["unexplained"]["signature"],
        "missing": _missing(summary),
        "coefficients": _coefficients(outcome),
        "reasons": _reasons(summary),
        "two_efficiencies": task["measured"] != "none",
        **_truths(task, made, true, outcome),
        "test_rmse": {k: summary[k]["test"]["rmse"] for k in ("before", "after")},
        "refit_rmse": refit_rmse(*_read(task["rows"], known, known_sheet(task, true))),
        "rows": len(problem.measured),
        "seconds": seconds,
        "rivals": run_rivals(task["rivals"], problem, split),
    }  # fmt: skip


def _read(rows: str, frame: pd.DataFrame, sheet: str) -> tuple[Problem, Split]:
    """The log and the sheet as files, read as a customer's would be; segments of 100 m put together."""
    with tempfile.TemporaryDirectory() as folder:
        log, vehicle = Path(folder) / "log.parquet", Path(folder) / "vehicle.toml"
        frame.to_parquet(log)
        vehicle.write_text(sheet, encoding="utf-8")
        read = read_log([log])
        split = split_trips(by_distance(read) if rows == "segments" else read)
        return prepare(split.log, read_sheet(vehicle)), split


def _missing(summary: Mapping[str, Any]) -> list[str]:
    """Channels that the diagnosis says the log lacks."""
    return [str(k) for k in summary.get("missing_channels", ())]


def _reasons(summary: Mapping[str, Any]) -> list[str]:
    """Effects that the report gives as reasons of declared coefficients that end far above the sheet's values."""
    ends = summary["coefficients"].values()
    return sorted({k for p in ends if p.get("prior_z", 0.0) > 0.0 for k in p["absorbs"]})


def _coefficients(outcome: Outcome) -> dict[str, dict[str, float]]:
    """Declared coefficients as they are at the end, effects added, beside the sheet's."""
    fit = outcome.fit
    rows = zip(fit.table.free, fit.values, fit.errors, strict=True)
    return {
        c.name: {"value": float(v), "sd": float(sd), "prior_value": float(c.value), "prior_sd": float(c.sd)}
        for c, v, sd in rows if c.sd is not None and not c.name.startswith("effects.")
    }  # fmt: skip


def _truths(task: Mapping[str, Any], made: SimulatedLog, true: Vehicle, outcome: Outcome) -> dict[str, Any]:
    """What the fitted sizes are compared with: coefficients in the kernel's air, regeneration as shares of what the
    way from wheel (or shaft) to battery would give with no loss."""
    fitted = {c.name: float(v) for c, v in zip(outcome.fit.table.free, outcome.fit.values, strict=True)}
    names = ("machine.regenerating_efficiency", "driveline.regenerating_efficiency", "driveline.efficiency")
    recovers = next((fitted[k] for k in names if k in fitted), float("nan"))
    return {
        "truth": {"road.c_rr": true.c_rr, "road.cda_m2": true.cda_m2 * made.density_kgpm3 / AIR_DENSITY_KGPM3},
        "recovers": recovers,
        "recovered": made.recovered,
    }
