"""The verbs `calibrate` and `predict`: a sheet's coefficients with their posterior, and what it predicts of a log."""

import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from hdev_jax import progress
from hdev_jax.diagnosis.metrics import metrics
from hdev_jax.diagnosis.problem import Problem, prepare
from hdev_jax.diagnosis.split import Split
from hdev_jax.diagnosis.summary import baseline_block
from hdev_jax.errors import InputError
from hdev_jax.inference import Clusters, cluster_rows, clusters_of, jacobian, padded, sum_inflation
from hdev_jax.inference.methods import METHODS, Outcome, calibrated
from hdev_jax.inference.sheet import read_sheet
from hdev_jax.inference.sheet_text import augmented_sheet
from hdev_jax.logs import read_log
from hdev_jax.opening import Paths, command_line, digest, known_effects, opened
from hdev_jax.report.build import report_data
from hdev_jax.report.page import write_calibration_report
from hdev_jax.rundir import atomic_file, open_run

__all__ = ["calibrate", "predict"]

BESIDE = "calibration.json"  # what a calibrated sheet has beside it


def calibrate(
    logs: Paths,
    vehicle: str | Path,
    adapter: str | Path | None = None,
    target: str | None = None,
    train_trips: Sequence[str] | None = None,
    test_trips: Sequence[str] | None = None,
    effects: str | Path | None = None,
    method: str = "map",
    noise: str = "normal",
    *,
    out: str | Path,
    seed: int = 0,
) -> str:
    """Coefficients of the sheet with uncertainty, from their tabular priors and the training trips of the logs.

    `method` "map": Levenberg-Marquardt to the most probable values, standard errors clustered by trip. "linear":
    Bayesian linear regression in closed form. "nuts": draws, from sufficient statistics where they are enough and by
    NUTS through the kernel otherwise; `posterior.nc` holds them for ArviZ. `noise` "student_t" weighs outliers down.
    **Returns:** a table as text; `calibration.json`, a report and `calibrated_vehicle.toml` are in `out`. Raises
    `InputError`.
    """
    if method not in METHODS:
        raise InputError(f"--method {method!r}: accepted are {', '.join(METHODS)}")
    if noise not in ("normal", "student_t"):
        raise InputError(f"--noise {noise!r}: accepted are normal, student_t")
    started = time.time()
    start = opened("calibrate", logs, vehicle, adapter, target, train_trips, test_trips, effects, seed)
    problem, split = start.problem, start.split
    if not problem.table.free:
        raise InputError(f"sheet {vehicle}: nothing to calibrate; give a coefficient in use a value with an sd")
    config = {**start.config, "method": method, "noise": noise}
    with open_run(out, config, seed=seed) as run:
        if run.done:
            return (run.work / "answer.txt").read_text()
        progress.step(f"{start.read}; calibrating")
        train = problem.rows(split.train)
        segments = problem.segments.take(train)
        clusters = cluster_rows(segments)
        outcome = calibrated(
            problem.vehicle, problem.table, padded(segments, problem.measured[train]), problem.target, clusters, method,
            noise=noise, vehicles=len(problem.log.vehicle_names), seed=seed,
        )  # fmt: skip
        fit = outcome.fit
        predicted = problem.predict(fit.vehicle)
        summary = _summary(problem, split, outcome, predicted, clusters, method, noise)
        values = {c.name: (float(v), float(s)) for c, v, s in zip(fit.table.free, fit.values, fit.sd, strict=True)}
        sheet = run.path("calibrated_vehicle.toml")
        sheet.write_text(augmented_sheet(start.sheet, values, {}))
        summary["sheet_sha256"] = digest(sheet)
        run.path(BESIDE).write_text(json.dumps(summary, indent=1, allow_nan=False) + "\n")
        if outcome.draws is not None:
            outcome.draws.write(run.path("posterior.nc"))
        data = report_data(problem, split, summary, predicted, predicted, command_line("calibrate", run), started)
        write_calibration_report(data, run.work)
        lines = [f"{name:32s} {v:12.6g} ± {s:.3g}" for name, (v, s) in values.items()]
        lines += [] if outcome.good else [f"NOT A GOOD FIT: {fit.message}"]
        lines += [f"note: {note}" for note in outcome.notes]
        test_rmse = summary["before"]["test"]["rmse"]
        answer = "\n".join([*lines, f"test RMSE {test_rmse:.4g} {problem.unit}; {fit.message}; {out}/report.html"])
        run.path("answer.txt").write_text(answer)
    return answer


def _summary(
    problem: Problem, split: Split, outcome: Outcome, predicted: np.ndarray, clusters: Clusters, method: str, noise: str
) -> dict[str, Any]:
    """The plain values of calibration.json."""
    fit, (y, w) = outcome.fit, (problem.measured, problem.weight())
    train, test = problem.rows(split.train), problem.rows(split.test)
    stopped = [] if fit.converged or method == "nuts" else [f"the fit stopped early: {fit.message}"]
    summary: dict[str, Any] = {
        "schema": "hdev-calibration/1",
        "target": problem.target,
        "method": method,
        "noise": noise,
        "split": {
            "train_trips": split.names(split.train),
            "test_trips": split.names(split.test),
            "unused_trips": split.names(split.unused),
        },
        "baseline": {"parameters": baseline_block(fit, {})},
        "before": {
            "train": metrics(y[train], predicted[train], w[train]),
            "test": metrics(y[test], predicted[test], w[test]),
            "test_by_trip": {
                split.log.trip_names[i]: metrics(*(a[problem.rows([i])] for a in (y, predicted, w)))
                for i in split.test
            },
        },
        "converged": fit.converged,
        "solver": fit.message,
        "notes": [*problem.notes, *outcome.notes, *stopped],
        # what predicts a trip's total: coefficients together, a row's noise, and how a trip's errors add up
        "covariance": {"names": [c.name for c in fit.table.free], "matrix": np.asarray(fit.covariance).tolist()},
        "residual": {
            "rmse": float(np.sqrt(np.mean((y[train] - predicted[train]) ** 2))),
            "sum_inflation": sum_inflation((y - predicted)[train] * w[train], clusters),
        },
    }  # fmt: skip
    if outcome.draws is not None:
        summary["draws"] = {"how": outcome.draws.how, **outcome.draws.quality(), "faults": outcome.draws.faults()}
    return summary


def predict(
    logs: Paths,
    vehicle: str | Path,
    adapter: str | Path | None = None,
    target: str | None = None,
    effects: str | Path | None = None,
    level: float = 0.9,
    *,
    out: str | Path,
) -> str:
    """One line for each row of the logs: `trip_id, time_s, predicted, lower, upper, level` in the target's unit.

    The interval holds what the coefficients leave open (their covariance from the `calibration.json` beside a
    calibrated sheet, else their sds in the sheet) and the noise of a row: of that calibration, else of this log where
    it measures the target. **Returns:** the total of each trip with its interval, as text. Raises `InputError`.
    """
    import pandas as pd
    from scipy import stats

    if not 0 < level < 1:
        raise InputError(f"--level {level}: a probability between 0 and 1 is expected")
    log = read_log(list(logs), adapter)
    sheet = read_sheet(vehicle, library=known_effects(effects))
    measures = target in log.targets if target else bool(log.targets)
    name = target or (log.default_target if measures else "energy_wh")
    measures = measures or (name == "traction_force_n" and log.segments.has("motor_torque_nm"))
    problem = prepare(log, sheet, name, need_measured=measures)
    predicted = problem.predict(problem.vehicle)
    rows = padded(problem.segments, problem.measured)
    jac = jacobian(problem.vehicle, problem.table, rows.segments, problem.target)[: len(log)]
    known = _calibrated(Path(vehicle), problem)
    root = _root(problem, known)
    x = jac @ root
    noise, together = _noise(problem, predicted, known, measures)
    reach = float(stats.norm.ppf(0.5 + level / 2))
    half = reach * np.sqrt(np.sum(x**2, axis=1) + noise**2)
    frame = pd.DataFrame(
        {
            "trip_id": np.asarray(log.trip_names, dtype=object)[log.segments.trip],
            "time_s": log.segments.time_s,
            "predicted": predicted,
            "lower": predicted - half,
            "upper": predicted + half,
            "level": level,
        }
    )
    with atomic_file(out) as temporary:
        if str(out).endswith(".parquet"):
            frame.to_parquet(temporary, index=False)
        else:
            compression: Any = "gzip" if str(out).endswith(".gz") else None
            frame.to_csv(temporary, index=False, float_format="%.8g", compression=compression)
    lines = _totals(problem, predicted, x, noise, together, reach)
    what = f"trip totals, {100 * level:g} % intervals" + ("" if noise else ", without the noise of the rows: not known")
    return "\n".join([what, *lines, f"{len(frame)} rows of {problem.target} -> {out}"])


def _calibrated(sheet: Path, problem: Problem) -> dict[str, Any]:
    """What lies beside a sheet of `hdev calibrate`, if it is of that sheet as it is, and of this target."""
    try:
        found = json.loads((sheet.parent / BESIDE).read_text())
    except (OSError, ValueError):
        return {}
    same = isinstance(found, dict) and found.get("sheet_sha256") == digest(sheet)
    return found if same and found.get("target") == problem.target else {}


def _root(problem: Problem, known: dict[str, Any]) -> Float[np.ndarray, "free free"]:
    """A root of the coefficients' covariance, in the table's order; by their sds alone where no more is known."""
    free = problem.table.free
    names = known.get("covariance", {}).get("names")
    if names is not None and [c.name for c in free] == names:
        values, vectors = np.linalg.eigh(np.atleast_2d(np.asarray(known["covariance"]["matrix"], dtype=float)))
        return vectors * np.sqrt(np.maximum(values, 0.0))
    return np.diag([c.sd or 0.0 for c in free]).reshape(len(free), len(free))


def _noise(problem: Problem, predicted: np.ndarray, known: dict[str, Any], measures: bool) -> tuple[float, float]:
    """Noise of a row, and how much wider a trip's sum is for errors that go together."""
    if "residual" in known:
        return float(known["residual"]["rmse"]), float(known["residual"]["sum_inflation"])
    if not measures:
        return 0.0, 1.0
    left = problem.measured - predicted
    trip = np.asarray(problem.segments.trip)
    clusters = clusters_of(trip, np.asarray(problem.segments.duration_s))
    return float(np.sqrt(np.mean(left**2))), sum_inflation(left * problem.weight(), clusters)


def _totals(
    problem: Problem, predicted: np.ndarray, x: np.ndarray, noise: float, together: float, reach: float
) -> list[str]:
    """A line for each trip: its total with the interval, in kWh (energy, work) or the mean of a torque."""
    weight = problem.weight()
    kwh = {"energy_wh": 1e3, "battery_power_kw": 3600.0, "traction_force_n": 3.6e6}
    unit = "kWh" if problem.target in kwh else problem.unit
    lines = []
    for i, trip in enumerate(problem.log.trip_names):
        rows = problem.rows([i])
        per = kwh.get(problem.target, float(np.sum(weight[rows])))
        total = float(np.sum((weight * predicted)[rows])) / per
        open_sd = float(np.sqrt(np.sum((weight[rows] @ x[rows]) ** 2))) / per
        row_sd = noise * float(np.sqrt(together * np.sum(weight[rows] ** 2))) / per
        half = reach * float(np.hypot(open_sd, row_sd))
        lines.append(f"{trip:40s} {total:10.4g} {unit}  {total - half:.4g} to {total + half:.4g}")
    return lines
