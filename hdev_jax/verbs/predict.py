"""The verb `predict`: what a sheet predicts of a log, with intervals for rows and trips outside the fit."""

import hashlib
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from hdev_jax.diagnosis.candidates.own import Effects, known_effects, tried
from hdev_jax.errors import InputError
from hdev_jax.inference import Calibration, Spread, covariance_root, jacobian, left_out, padded, spread_of, sums_of
from hdev_jax.problem import Problem, Split, derivable, prepare
from hdev_jax.rundir import atomic_file
from hdev_jax.targets import TARGETS
from hdev_jax.verbs.beside import beside_sheet, covariance_of
from hdev_jax.verbs.opening import Logs, Vehicles, log_of, sheet_of
from hdev_jax.verbs.result import PREDICTIVE, Prediction, Result
from hdev_jax.verbs.states import one_step_ahead

__all__ = ["correlated_pairs", "predict", "predictive_of", "sheet_digest", "strongly_correlated"]

Noise = Literal["normal", "student_t"]
STRONG = 0.95  # correlation of two coefficients, above which neither is read by itself
LIKE = 1.5  # times as long: rows of another log with about the same noise


def predictive_of(
    problem: Problem, split: Split, fit: Calibration, noise: Noise, sheet_sha256: str
) -> tuple[dict[str, Any], list[str]]:
    """What intervals need beside a fitted sheet: the coefficients' covariance and the noise; and notes for the user."""
    train = problem.rows(split.train)
    rows = padded(problem.segments.take(train), problem.measured[train])
    spread, clusters = left_out(fit, rows, problem.target, problem.weight()[train], noise)
    known = {
        "schema": "hdev-predictive/1",
        "sheet_sha256": sheet_sha256,
        "target": problem.target,
        "covariance": {"names": [c.name for c in fit.table.free], "matrix": np.asarray(fit.covariance).tolist()},
        "spread": asdict(spread),
    }
    notes = strongly_correlated([c.name for c in fit.table.free], np.asarray(fit.covariance))
    if clusters.kind == "block":
        notes.append(
            "there is one training trip: the intervals of hdev predict do not include differences between trips"
        )
    return known, notes


def sheet_digest(text: str) -> str:
    """SHA-256 of a sheet as it is written to a file."""
    return hashlib.sha256(text.encode()).hexdigest()


def strongly_correlated(names: Sequence[str], covariance: Float[np.ndarray, "k k"]) -> list[str]:
    """A sentence for each pair of coefficients whose estimates are strongly correlated."""
    return [
        f"{one} and {other} are strongly correlated ({r:+.2f}): the log determines only their combination"
        for one, other, r in correlated_pairs(names, covariance)
    ]


def correlated_pairs(names: Sequence[str], covariance: Float[np.ndarray, "k k"]) -> list[tuple[str, str, float]]:
    """Pairs of coefficients whose estimates are strongly correlated, and their correlation."""
    sd = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    correlation = covariance / np.outer(sd, sd)
    pairs = zip(*np.nonzero(np.triu(np.abs(correlation) > STRONG, 1)), strict=True)
    return [(names[int(i)], names[int(k)], float(correlation[i, k])) for i, k in pairs]


def predict(
    logs: Logs,
    vehicle: Vehicles,
    adapter: str | Path | None = None,
    target: str | None = None,
    effects: Effects = None,
    level: float = 0.9,
    online: bool = False,
    *,
    out: str | Path | None = None,
) -> Prediction:
    """One row for each row of the logs: `trip_id, time_s, predicted, lower, upper, level` in the target's unit.

    An interval adds two uncertainties. The coefficients' comes from the covariance in the `predictive.json` beside a
    fitted sheet, else from the sds in the sheet. The noise of a row comes from cross-validation over the trips of that
    fit, else from this log where it measures the target.

    The interval of a trip's total comes from the errors of whole trips, by a Student t with as many degrees of freedom
    as there were trips; with a single trip, from the autocorrelation of its errors.

    **Arguments:** `vehicle`: a sheet's path, a `Sheet`, or what `diagnose` or `calibrate` returned. `level`:
    probability inside the intervals. `online`: predict each row from the rows before it, by filtering the state of
    loads that switch; the log must measure the target and the sheet have such loads. `out`: a file to write (.csv,
    .csv.gz or .parquet).

    **Returns:** a `Prediction`: its `rows`, and as text the total of each trip with its interval. **Raises:**
    `InputError`.
    """
    import pandas as pd
    from scipy import stats

    if not 0 < level < 1:
        raise InputError(f"--level {level}: a probability between 0 and 1 is expected")
    if out is not None and Path(out).suffix not in ("", ".csv", ".gz", ".parquet"):
        raise InputError(f"--out {out}: a file that ends in .csv, .csv.gz or .parquet is expected")
    library = known_effects(effects)
    log = log_of(logs, adapter)
    sheet = sheet_of(vehicle, library)
    beside = vehicle.predictive if isinstance(vehicle, Result) else {}
    if isinstance(vehicle, str | Path):
        beside = beside_sheet(Path(vehicle))
    if target is not None and target not in TARGETS:
        raise InputError(f"unknown target '{target}'; accepted: {', '.join(TARGETS)}")
    measures = target in log.targets if target else bool(log.targets)
    name = target or (log.default_target if measures else beside.get("target", "energy_wh"))
    measures = measures or derivable(log, name)
    problem, reach = prepare(log, sheet, name, need_measured=measures), float(stats.norm.ppf(0.5 + level / 2))
    tried(problem, library, effects)
    predicted = problem.predict(problem.vehicle)
    rows = padded(problem.segments, problem.measured)
    jac = jacobian(problem.vehicle, problem.table, rows.segments, problem.target)[: len(log)]
    known = beside if beside.get("target") == problem.target and not beside.get("stale") else {}
    x = jac @ covariance_root(covariance_of(problem, known))
    spread = _spread(problem, predicted, x, known, measures)
    half = np.linalg.norm(x, axis=1)
    half = reach * half if spread is None else spread.rows(level, half, predicted)
    lines = [_whence(level, spread, bool(known)), *_totals(problem, predicted, x, spread, level)]
    if online:
        free = predicted
        predicted, half = one_step_ahead(problem, known, measures, level)
        errors = [float(np.sqrt(np.mean((problem.measured - p) ** 2))) for p in (predicted, free)]
        lines.append(
            f"rows one step ahead, from the rows before: RMSE {errors[0]:.4g} {problem.unit} ({errors[1]:.4g} in the "
            "free run, from which the totals above come)"
        )
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
    lines += _warnings(problem, spread, beside, known)
    if out is None:
        return Prediction(frame, "\n".join([*lines, f"{len(frame)} rows of {name}"]))
    with atomic_file(out) as temporary:
        if str(out).endswith(".parquet"):
            frame.to_parquet(temporary, index=False)
        else:
            compression: Any = "gzip" if str(out).endswith(".gz") else None
            frame.to_csv(temporary, index=False, float_format="%.8g", compression=compression)
    return Prediction(frame, "\n".join([*lines, f"{len(frame)} rows of {name} -> {out}"]))


def _whence(level: float, spread: Spread | None, known: bool) -> str:
    """How the intervals are made."""
    what = f"trip totals, {100 * level:g} % intervals"
    if spread is None:
        return f"{what} from the coefficients alone: the noise of the rows is not known"
    whose = "cross-validation over the fit's training trips" if known else "this log's own errors"
    return f"{what} from {whose}, Student t of {spread.total_freedom:.3g} degrees of freedom"


def _warnings(problem: Problem, spread: Spread | None, beside: dict[str, Any], known: dict[str, Any]) -> list[str]:
    """Notes where the intervals are for another sheet, another target or other rows."""
    out = []
    if beside and not known and not beside.get("stale"):
        out.append(f"note: {PREDICTIVE} beside the sheet is for the target {beside['target']} and is not used")
    if beside.get("stale"):
        out.append(f"note: {PREDICTIVE} is not used: the sheet was changed after it was written")
    row_s = float(np.median(np.asarray(problem.segments.duration_s)))
    if spread is not None and max(row_s, spread.row_s) > LIKE * min(row_s, spread.row_s):
        out.append(
            f"note: rows of this log last {row_s:.3g} s, but the noise is from rows of {spread.row_s:.3g} s: the "
            "intervals may be wrong"
        )
    return out


def _spread(
    problem: Problem, predicted: np.ndarray, x: np.ndarray, known: dict[str, Any], measures: bool
) -> Spread | None:
    """Noise of the fit that made the sheet, else of this log; None where it does not measure the target."""
    if known:
        return Spread(**known["spread"])
    if not measures:
        return None
    weight, clusters = problem.weight(), sums_of(problem.segments)
    open_sd = np.linalg.norm(clusters.sums(weight[:, None] * x), axis=1)
    row_s = float(np.median(np.asarray(problem.segments.duration_s)))
    error, open_row = problem.measured - predicted, np.linalg.norm(x, axis=1)
    return spread_of(error, predicted, weight, clusters, open_sd, open_row, row_s=row_s)


def _totals(problem: Problem, predicted: np.ndarray, x: np.ndarray, spread: Spread | None, level: float) -> list[str]:
    """A line for each trip: its total with the interval, in kWh (energy, work) or the mean of a torque."""
    from scipy import stats

    weight = problem.weight()
    per_kwh = TARGETS[problem.target].per_kwh
    unit = problem.unit if per_kwh is None else "kWh"
    lines = []
    for i, trip in enumerate(problem.log.trip_names):
        rows = problem.rows([i])
        per = float(np.sum(weight[rows])) if per_kwh is None else per_kwh
        if not per > 0:
            lines.append(f"{trip:40s} {'-':>10s} {unit}  never moves")
            continue
        total = float(np.sum((weight * predicted)[rows])) / per
        open_sd = float(np.linalg.norm(weight[rows] @ x[rows]))
        if spread is None:
            half = float(stats.norm.ppf(0.5 + level / 2)) * open_sd / per
        else:
            half = spread.total(level, open_sd, weight[rows], predicted[rows]) / per
        lines.append(f"{trip:40s} {total:10.4g} {unit}  {total - half:.4g} to {total + half:.4g}")
    return lines
