"""The verb `calibrate`: a sheet's coefficients with their posterior."""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from hdev_jax import progress
from hdev_jax.diagnosis.candidates.own import Effects, known_effects
from hdev_jax.diagnosis.result.coefficients import baseline_block
from hdev_jax.errors import InputError
from hdev_jax.inference import cluster_rows, padded
from hdev_jax.inference.posterior.methods import METHODS, Method, Outcome, calibrated
from hdev_jax.inference.sheet import augmented_sheet
from hdev_jax.logs.checks import COASTING
from hdev_jax.problem import Problem, Split, implausible, metrics
from hdev_jax.report.build import report_data
from hdev_jax.rundir import Run, open_run
from hdev_jax.verbs.opening import Logs, Opening, Vehicles, command_line, opened
from hdev_jax.verbs.predict import predictive_of, sheet_digest
from hdev_jax.verbs.result import CalibrationResult

__all__ = ["calibrate"]


def calibrate(
    logs: Logs,
    vehicle: Vehicles,
    adapter: str | Path | None = None,
    target: str | None = None,
    train_trips: Sequence[str] | None = None,
    test_trips: Sequence[str] | None = None,
    effects: Effects = None,
    method: Method = "map",
    noise: Literal["normal", "student_t"] = "normal",
    *,
    out: str | Path | None = None,
    seed: int = 0,
) -> CalibrationResult:
    """Coefficients of the sheet with uncertainty, from their tabular priors and the training trips of the logs.

    **Arguments:**

    - `logs`: a path or several, a `Log`, or a table in memory. `vehicle`: a sheet's path or a `Sheet`.
    - `method`: `"map"` finds the most probable values by Levenberg-Marquardt, with standard errors clustered by trip.
      `"linear"` is Bayesian linear regression in closed form. `"nuts"` draws from the posterior: from sufficient
      statistics where the model is linear enough, else by NUTS through the kernel. `posterior.nc` holds the draws for
      ArviZ.
    - `noise`: `"student_t"` gives outliers less weight.
    - `out`: a folder for `calibration.json`, a report and `calibrated_vehicle.toml`.

    **Returns:** a `CalibrationResult`; `str()` is a table. **Raises:** `InputError`.
    """
    if method not in METHODS:
        raise InputError(f"--method {method!r}: accepted are {', '.join(METHODS)}")
    if noise not in ("normal", "student_t"):
        raise InputError(f"--noise {noise!r}: accepted are normal, student_t")
    started = time.time()
    start = opened(
        "calibrate",
        logs,
        vehicle,
        adapter,
        target,
        train_trips,
        test_trips,
        effects,
        seed,
        known_effects(effects),
        kept=out is not None,
    )
    if not start.problem.table.free:
        raise InputError(f"sheet {vehicle}: nothing to calibrate; give a coefficient in use a value with an sd")
    if out is None:
        return _calibrated(start, method, noise, seed, started)
    config = {**start.config, "method": method, "noise": noise}
    with open_run(out, config, seed=seed) as run:
        if run.done:
            return CalibrationResult.of_folder(run.work)
        result = _calibrated(start, method, noise, seed, started, run)
        result.write(run, out)
    return result


def _calibrated(
    start: Opening,
    method: Method, noise: Literal["normal", "student_t"], seed: int, started: float,
    run: Run | None = None,
) -> CalibrationResult:  # fmt: skip
    """The calibration in memory."""
    problem, split = start.problem, start.split
    progress.step(f"{start.read}; calibrating")
    train = problem.rows(split.train)
    segments = problem.segments.take(train)
    outcome = calibrated(
        problem.vehicle, problem.table, padded(segments, problem.measured[train]), problem.target,
        cluster_rows(segments), method, noise=noise, vehicles=len(problem.log.vehicle_names), seed=seed,
    )  # fmt: skip
    fit = outcome.fit
    predicted = problem.predict(fit.vehicle)
    summary = _summary(problem, split, outcome, predicted, method, noise)
    values = {c.name: (float(v), float(s)) for c, v, s in zip(fit.table.free, fit.values, fit.sd, strict=True)}
    sheet = augmented_sheet(start.sheet, values, {})
    predictive, notes = predictive_of(problem, split, fit, noise, sheet_digest(sheet))
    summary["notes"] += notes
    suspected = [s for s in implausible(problem, split.train) if s.what != COASTING]
    summary["notes"] += [f"suspected: {s.line()}" for s in suspected]
    data = report_data(problem, split, summary, predicted, predicted, command_line("calibrate", run), started)
    lines = [f"{name:32s} {v:12.6g} ± {s:.3g}" for name, (v, s) in values.items()]
    lines += [] if outcome.good else [f"NOT A GOOD FIT: {fit.message}"]
    lines += [f"note: {note}" for note in summary["notes"]]
    lines.append(f"test RMSE {summary['before']['test']['rmse']:.4g} {problem.unit}; {fit.message}")
    return CalibrationResult("\n".join(lines), summary, sheet, predictive, data, outcome.draws)


def _summary(
    problem: Problem, split: Split, outcome: Outcome, predicted: np.ndarray, method: str, noise: str
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
        "covariance": {"names": [c.name for c in fit.table.free], "matrix": np.asarray(fit.covariance).tolist()},
    }  # fmt: skip
    if outcome.draws is not None:
        summary["draws"] = {"how": outcome.draws.how, **outcome.draws.quality(), "faults": outcome.draws.faults()}
    return summary
