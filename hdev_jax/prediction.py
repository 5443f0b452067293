"""The verb `predict`: what a sheet predicts of a log, with intervals for rows and trips that no fit has seen."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from hdev_jax.diagnosis.problem import Problem, prepare
from hdev_jax.diagnosis.split import Split
from hdev_jax.errors import InputError
from hdev_jax.inference import Calibration, Spread, covariance_root, jacobian, left_out, padded, spread_of, sums_of
from hdev_jax.inference.sheet import read_sheet
from hdev_jax.logs import read_log
from hdev_jax.opening import Paths, digest, known_effects
from hdev_jax.rundir import Run, atomic_file

__all__ = ["predict", "write_predictive"]

BESIDE = "predictive.json"  # what a fitted sheet has beside it
Noise = Literal["normal", "student_t"]
KWH = {"energy_wh": 1e3, "battery_power_kw": 3600.0, "traction_force_n": 3.6e6}


def write_predictive(
    run: Run, sheet: Path, problem: Problem, split: Split, fit: Calibration, noise: Noise
) -> list[str]:
    """Write beside a fitted sheet what intervals need: the coefficients' covariance and the spread of what is left.

    **Returns:** what a user should know of them.
    """
    train = problem.rows(split.train)
    rows = padded(problem.segments.take(train), problem.measured[train])
    spread, clusters = left_out(fit, rows, problem.target, problem.weight()[train], noise)
    known = {
        "schema": "hdev-predictive/1",
        "sheet_sha256": digest(sheet),
        "target": problem.target,
        "covariance": {"names": [c.name for c in fit.table.free], "matrix": np.asarray(fit.covariance).tolist()},
        "spread": asdict(spread),
    }
    run.path(BESIDE).write_text(json.dumps(known, indent=1, allow_nan=False) + "\n")
    if clusters.kind == "block":
        return ["one training trip: how trips differ from each other is not in the intervals of hdev predict"]
    return []


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

    The interval holds what the coefficients leave open (their covariance from the `predictive.json` beside a fitted
    sheet, else their sds in the sheet) and the noise of a row: as seen where that fit left trips out, else as in this
    log where it measures the target. A trip's total has the interval that errors of whole trips ask for, by a Student t
    of as many degrees of freedom as there were trips; of a single trip, its autocorrelation. **Returns:** the total of
    each trip with its interval, as text. Raises `InputError`.
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
    known = _known(Path(vehicle), problem)
    x = jac @ _root(problem, known)
    spread = _spread(problem, predicted, x, known, measures)
    half = float(stats.norm.ppf(0.5 + level / 2)) * np.sqrt(np.sum(x**2, axis=1))
    if spread is not None:
        half = np.hypot(half, spread.row(level, predicted))
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
    what = f"trip totals, {100 * level:g} % intervals"
    if spread is None:
        what += ", without the noise of the rows: not known"
    else:
        what += f", Student t of {spread.total_freedom:.3g} degrees of freedom"
    lines = _totals(problem, predicted, x, spread, level)
    return "\n".join([what, *lines, f"{len(frame)} rows of {problem.target} -> {out}"])


def _known(sheet: Path, problem: Problem) -> dict[str, Any]:
    """What lies beside a fitted sheet, if it is of that sheet as it is, and of this target."""
    try:
        found = json.loads((sheet.parent / BESIDE).read_text())
    except (OSError, ValueError):
        return {}
    same = isinstance(found, dict) and found.get("sheet_sha256") == digest(sheet)
    return found if same and found.get("target") == problem.target else {}


def _root(problem: Problem, known: dict[str, Any]) -> Float[np.ndarray, "free free"]:
    """A root of the coefficients' covariance, in the table's order; by their sds alone where no more is known."""
    free = problem.table.free
    names = known.get("covariance", {}).get("names", [])
    covariance = np.diag([(c.sd or 0.0) ** 2 for c in free]).reshape(len(free), len(free))
    there = [k for k, c in enumerate(free) if c.name in names]
    if there:
        at = [names.index(free[k].name) for k in there]
        matrix = np.atleast_2d(np.asarray(known["covariance"]["matrix"], dtype=float))
        covariance[np.ix_(there, there)] = matrix[np.ix_(at, at)]
    return covariance_root(covariance)


def _spread(
    problem: Problem, predicted: np.ndarray, x: np.ndarray, known: dict[str, Any], measures: bool
) -> Spread | None:
    """Of the fit that made the sheet; else of this log, which no fit has seen; None where it measures nothing."""
    if known:
        return Spread(**known["spread"])
    if not measures:
        return None
    weight, clusters = problem.weight(), sums_of(problem.segments)
    open_sd = np.linalg.norm(clusters.sums(weight[:, None] * x), axis=1)
    return spread_of(problem.measured - predicted, predicted, weight, clusters, open_sd)


def _totals(problem: Problem, predicted: np.ndarray, x: np.ndarray, spread: Spread | None, level: float) -> list[str]:
    """A line for each trip: its total with the interval, in kWh (energy, work) or the mean of a torque."""
    from scipy import stats

    weight = problem.weight()
    unit = "kWh" if problem.target in KWH else problem.unit
    lines = []
    for i, trip in enumerate(problem.log.trip_names):
        rows = problem.rows([i])
        per = KWH.get(problem.target, float(np.sum(weight[rows])))
        total = float(np.sum((weight * predicted)[rows])) / per
        open_sd = float(np.linalg.norm(weight[rows] @ x[rows]))
        if spread is None:
            half = float(stats.norm.ppf(0.5 + level / 2)) * open_sd / per
        else:
            half = spread.total(level, open_sd, weight[rows], predicted[rows]) / per
        lines.append(f"{trip:40s} {total:10.4g} {unit}  {total - half:.4g} to {total + half:.4g}")
    return lines
