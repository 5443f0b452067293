"""One vehicle of a fleet: read, calibrated and diagnosed, with its energy by cause, as plain values."""

import math
import time
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from hdev_jax.diagnosis.candidates.own import known_effects, tried
from hdev_jax.diagnosis.diagnose import Outcome, diagnose
from hdev_jax.diagnosis.settings import Settings
from hdev_jax.energy.fitted import Fitted
from hdev_jax.energy.ledger import ledger_of
from hdev_jax.errors import InputError
from hdev_jax.inference import cluster_rows, left_out, padded
from hdev_jax.inference.sheet import Sheet, augmented_sheet, read_sheet
from hdev_jax.logs import Log, log_from_frame, read_log
from hdev_jax.many.course import course_of
from hdev_jax.many.scan import scan_beside, scan_of
from hdev_jax.physics import LIBRARY, Effect
from hdev_jax.problem import Problem, Split, implausible, prepare, split_trips, without_harmful_slope
from hdev_jax.targets import TARGETS
from hdev_jax.textfiles import digest

__all__ = ["plain", "scanned_again", "vehicle_record"]

LEAST_KNOWN = 1e-3  # of a table's precision: with less, the log says nothing of a coefficient


def vehicle_record(task: Mapping[str, Any]) -> dict[str, Any]:
    """The diagnosis of one vehicle's log, as plain values for JSON. It raises nothing: a bad log gives a message.

    **Arguments:** `task`, plain values: `name`, `files`, `whole`, `sheet`, `kind` and `missing` of its `Source`;
    `adapter`, `target`, `fdr`, `seed`, `trust`; if given, `effects`, a file of a user's own,
    and its `effects_sha256`.

    **Returns:** `name`, `type`, `status`, `message`, `seconds`. The status is "done", "suspect" (a unit or a sign is in
    doubt, and no effect was searched), "refused" (the input is at fault) or "failed" (a fault of this program). A
    vehicle that is done also has `before` and `after` (errors on held-out trips), `effects`, `coefficients`, `scan`
    (`hdev_jax.many.scan`), `course` (`hdev_jax.many.course`) and `ledger`.
    """
    started = time.perf_counter()
    head = {"name": task["name"], "type": task["kind"] or "", "sheet": task["sheet"], "message": ""}
    try:
        if task["missing"]:
            raise InputError(task["missing"])
        record = {**head, **_analysed(task)}
    except InputError as e:
        record = {**head, "status": "refused", "message": str(e)}
    except Exception as e:  # one vehicle must not stop a fleet; it is counted and shown
        line = " ".join(f"{type(e).__name__}: {e}".split())
        record = {**head, "status": "failed", "message": f"internal error: {line[:300]}"}
    return plain({**record, "seconds": time.perf_counter() - started})


def _log(task: Mapping[str, Any]) -> Log:
    """The vehicle's log; parts of a partitioned table are put together first."""
    files, adapter = [Path(f) for f in task["files"]], task["adapter"]
    if not task["whole"] or any(f.suffix != ".parquet" for f in files):
        return read_log(files, adapter)
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        parts = [pq.ParquetFile(f).read() for f in files]
        table = pa.concat_tables(parts, promote_options="permissive")
    except (OSError, pa.ArrowException) as e:
        raise InputError(f"{files[0].parent}: cannot be read as Parquet ({e})") from None
    if "vehicle_id" not in table.column_names:
        table = table.append_column("vehicle_id", pa.array([task["name"]] * len(table), type=pa.string()))
    return log_from_frame(table, name=str(files[0].parent), adapter=adapter)


def scanned_again(task: Mapping[str, Any]) -> dict[str, Any]:
    """The scan of a vehicle with its own effects and those of its type in its model.

    **Arguments:** `task` as for `vehicle_record`, with `beside`: values and sds (0: known) by effect and parameter.
    **Returns:** `name`, `scan` and `message`: why the scan is empty, where the vehicle cannot be fitted with them.
    """
    try:
        return plain({"name": task["name"], "scan": _beside(task), "message": ""})
    except Exception as e:  # as in `vehicle_record`
        return {"name": task["name"], "scan": {}, "message": " ".join(f"{type(e).__name__}: {e}".split())[:300]}


def _library(task: Mapping[str, Any]) -> Mapping[str, type[Effect]]:
    """The library, with the user's own effects."""
    own = task.get("effects")
    return LIBRARY if own is None else _with_own(own, task["effects_sha256"])


@cache  # the same classes for all vehicles, which share what was compiled with them
def _with_own(file: str, sha256: str) -> Mapping[str, type[Effect]]:
    if not (there := digest(Path(file))):
        raise InputError(f"--effects {file}: not on this machine; every worker needs the file at this path")
    if there != sha256:
        raise InputError(f"--effects {file}: not the file that the command started with; every worker needs that one")
    return known_effects(file)


def _beside(task: Mapping[str, Any]) -> dict[str, Any]:
    library = _library(task)
    sheet = read_sheet(task["sheet"], library=library)
    more = {e: {n: (v, sd, "") for n, (v, sd) in ps.items()} for e, ps in task["beside"].items()}
    text = tomllib.loads(augmented_sheet(sheet, {}, more))
    problem, split = _opened(task, Sheet(library=library, path=task["sheet"], **text))
    return scan_beside(problem, split, library, Settings(fdr=task["fdr"]))


def _opened(task: Mapping[str, Any], sheet: Sheet) -> tuple[Problem, Split]:
    split = split_trips(_log(task))
    return without_harmful_slope(prepare(split.log, sheet, task["target"]), split), split


def _analysed(task: Mapping[str, Any]) -> dict[str, Any]:
    library = _library(task)
    sheet = read_sheet(task["sheet"], library=library)
    problem, split = _opened(task, sheet)
    tried(problem, library, task.get("effects"), *library)
    log = problem.log
    doubts = () if task["trust"] else implausible(problem, split.train)
    settings = Settings(fdr=task["fdr"])
    outcome = diagnose(problem, split, {} if doubts else library, settings=settings, seed=task["seed"],
                       next_drives=False)  # fmt: skip
    summary = outcome.summary
    notes, energy = list(summary.get("notes", ())), None
    if TARGETS[problem.target].of_battery:
        energy = _energy(outcome, task["seed"])
    else:
        notes.append(f"no ledger: {problem.target} is measured before the battery")
    seconds, meters = np.asarray(problem.segments.duration_s), np.asarray(problem.segments.distance_m)
    return {
        "type": task["kind"] or sheet.name,
        "status": "suspect" if doubts else "done",
        "message": "; ".join(s.line() for s in doubts),
        "target": problem.target, "unit": problem.unit,
        "rows": len(log), "trips": len(log.trip_names), "km": float(np.sum(meters)) / 1e3,
        "hours": float(np.sum(seconds)) / 3600.0,
        "changed": log.ledger.lines(),
        "before": summary["before"]["test"], "after": summary["after"]["test"],
        "verdict": "suspect_log" if doubts else summary["verdict"],
        "effects": [{k: e[k] for k in ("id", "verdict", "parameters", "q_value", "indistinguishable_from")}
                    for e in summary["effects"]],
        "fitted": {e: {n: [v, sd] for n, (v, sd, _) in ps.items()} for e, ps in outcome.found.items()},
        "coefficients": _coefficients(outcome, problem),
        "scan": {} if doubts else scan_of(outcome),
        "course": course_of(outcome),
        "ledger": energy,
        "notes": notes,
    }  # fmt: skip


def _coefficients(outcome: Outcome, problem: Problem) -> dict[str, dict[str, Any]]:
    """Each declared coefficient as fitted, and as the log alone tells it: value and sd without its table, the other
    coefficients with theirs."""
    fit, out = outcome.fit, {}
    declared = {c.name for c in problem.table.free}
    for k, c in enumerate(fit.table.free):
        if c.name not in declared:
            continue
        value, variance = float(fit.values[k]), float(fit.covariance[k, k])
        alone, alone_sd = value, math.sqrt(variance)
        if c.sd is not None:
            # the marginal of a normal with one prior taken away: exact, whatever the others are
            table = 1.0 / c.sd**2
            own = 1.0 / variance - table
            known = own > LEAST_KNOWN * table
            alone = (value / variance - c.value * table) / own if known else math.nan
            alone_sd = math.sqrt(1.0 / own) if known else math.nan
        out[c.name] = {
            "value": value, "sd": float(fit.sd[k]), "unit": c.unit, "prior_value": c.value, "prior_sd": c.sd,
            "alone": alone, "alone_sd": alone_sd,
        }  # fmt: skip
    return out


def _energy(outcome: Outcome, seed: int) -> dict[str, Any]:
    """Rows of the vehicle's ledger for the whole log and each week [kWh]."""
    problem, fit, kernel = outcome.problem, outcome.fit, outcome.training.kernel
    segments = outcome.given.segments if outcome.given else problem.segments
    problem = replace(problem, segments=segments, vehicle=fit.vehicle, table=fit.table)
    used = problem.rows(outcome.split.train)
    rows = padded(problem.segments.take(used), problem.measured[used])
    spread, _ = left_out(fit, rows, problem.target, problem.weight()[used], linearise=kernel.linearised)
    freedom = max(cluster_rows(problem.segments.take(used)).count - 1.0, 2.0)
    fitted = Fitted(problem, fit.vehicle, fit.covariance, freedom, spread, "diagnosed", compute=kernel.predict)
    found = ledger_of(fitted, seed=seed)
    return {
        "rows": _lines(found.rows, ("level", "name", "cause", "kwh", "lower", "upper")),
        "about": _lines(found.about, ("level", "name", "km", "hours", "trips", "measured_kwh", "regenerated_kwh",
                                      "auxiliary_kwh", "parked_kwh")),
        "undated": found.undated,
    }  # fmt: skip


def _lines(frame: pd.DataFrame, columns: Sequence[str]) -> list[dict[str, Any]]:
    """The blocks of the whole log and of each week."""
    return [{k: r[k] for k in columns} for r in frame.to_dict("records") if r["level"] in ("all", "week")]


def plain(x: Any) -> Any:
    """Nested values as JSON has them: NaN and infinity become None."""
    if isinstance(x, Mapping):
        return {str(k): plain(v) for k, v in x.items()}
    if isinstance(x, np.ndarray):
        return plain(x.tolist())
    if isinstance(x, Sequence) and not isinstance(x, str):
        return [plain(v) for v in x]
    x = x.item() if isinstance(x, np.generic) else x
    return None if isinstance(x, float) and not math.isfinite(x) else x
