"""The verbs: what `hdev VERB` does, as functions of the same names and arguments."""

import json
import shlex
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from hdev_jax import progress
from hdev_jax.diagnosis.diagnose import Diagnosis
from hdev_jax.diagnosis.diagnose import diagnose as run_loop
from hdev_jax.diagnosis.metrics import metrics
from hdev_jax.diagnosis.problem import prepare
from hdev_jax.diagnosis.stages import add_stages
from hdev_jax.diagnosis.summary import baseline_block
from hdev_jax.errors import InputError
from hdev_jax.inference import calibrate as fit_map
from hdev_jax.inference import cluster_rows, padded
from hdev_jax.inference.sheet import Sheet, read_sheet
from hdev_jax.inference.sheet_text import augmented_sheet
from hdev_jax.logs import read_log, write_adapter_skeleton
from hdev_jax.opening import Paths, chosen_effects, command_line, known_effects, opened
from hdev_jax.physics import LIBRARY
from hdev_jax.report.build import answer_text, of_diagnosis, report_data
from hdev_jax.report.page import write_calibration_report, write_report
from hdev_jax.rundir import atomic_file, open_run

__all__ = ["calibrate", "check", "diagnose", "effects", "predict", "simulate"]


def diagnose(
    logs: Paths,
    vehicle: str | Path,
    adapter: str | Path | None = None,
    target: str | None = None,
    train_trips: Sequence[str] | None = None,
    test_trips: Sequence[str] | None = None,
    effects: str | Path | None = None,
    only: Sequence[str] | None = None,
    exclude: Sequence[str] | None = None,
    fdr: float = 0.05,
    *,
    out: str | Path,
    seed: int = 0,
) -> str:
    """Find what the vehicle's model misses in these logs: the loop, into the folder `out`.

    **Arguments:** as the options of `hdev diagnose`. **Returns:** the answer as text; everything else is in `out`:
    `diagnosis.json`, `report.html`, `augmented_vehicle.toml`, figures. Raises `InputError` for what the user can mend.
    """
    started = time.time()
    candidates = chosen_effects(effects, only, exclude)
    start = opened("diagnose", logs, vehicle, adapter, target, train_trips, test_trips, effects, seed)
    problem, split = start.problem, start.split
    config = {
        **start.config,
        "only": None if only is None else list(only),
        "exclude": None if exclude is None else list(exclude),
        "fdr": fdr,
    }
    with open_run(out, config, seed=seed) as run:
        if run.done:
            return (run.work / "answer.txt").read_text()
        progress.step(start.read)
        result = run_loop(problem, split, candidates, fdr=fdr, seed=seed, tell=progress.step, checkpoint=run.checkpoint)
        add_stages(result, candidates, fdr=fdr, seed=seed, tell=progress.step, checkpoint=run.checkpoint)
        progress.step("writing the report")
        data = of_diagnosis(result, command_line("diagnose", run), started)
        text = _augmented(result, start.sheet)
        run.path("diagnosis.json").write_text(json.dumps(result.summary, indent=1, allow_nan=False) + "\n")
        run.path("augmented_vehicle.toml").write_text(text)
        write_report(data, run.work)
        answer = answer_text(data, Path(out))
        run.path("answer.txt").write_text(answer)
    return answer


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

    `method` "map": Levenberg-Marquardt to the most probable values, standard errors clustered by trip. `noise`
    "student_t" weighs outliers down. **Returns:** a table as text; `calibration.json`, a report and
    `calibrated_vehicle.toml` are in `out`. Raises `InputError`.
    """
    if method != "map":
        raise InputError(f"--method {method!r}: accepted is map")
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
        train, test = problem.rows(split.train), problem.rows(split.test)
        rows = padded(problem.segments.take(train), problem.measured[train])
        fit = fit_map(
            problem.vehicle, problem.table, rows, problem.target, cluster_rows(problem.segments.take(train)),
            noise=noise,  # pyright: ignore[reportArgumentType]
        )  # fmt: skip
        predicted = problem.predict(fit.vehicle)
        y, w = problem.measured, problem.weight()
        summary = {
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
            "notes": list(problem.notes) + ([] if fit.converged else [f"the fit stopped early: {fit.message}"]),
        }
        values = {c.name: (float(v), float(s)) for c, v, s in zip(fit.table.free, fit.values, fit.sd, strict=True)}
        run.path("calibration.json").write_text(json.dumps(summary, indent=1, allow_nan=False) + "\n")
        run.path("calibrated_vehicle.toml").write_text(augmented_sheet(start.sheet, values, {}))
        data = report_data(problem, split, summary, predicted, predicted, command_line("calibrate", run), started)
        write_calibration_report(data, run.work)
        lines = [f"{name:32s} {v:12.6g} ± {s:.3g}" for name, (v, s) in values.items()]
        test_rmse = summary["before"]["test"]["rmse"]
        answer = "\n".join([*lines, f"test RMSE {test_rmse:.4g} {problem.unit}; {fit.message}; {out}/report.html"])
        run.path("answer.txt").write_text(answer)
    return answer


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

    The interval holds what the coefficients leave open (their sds in the sheet, through the kernel's Jacobian) and,
    where the log measures the target, the spread of its residual. Raises `InputError`.
    """
    import pandas as pd
    from scipy import stats

    from hdev_jax.inference import jacobian

    if not 0 < level < 1:
        raise InputError(f"--level {level}: a probability between 0 and 1 is expected")
    log = read_log(list(logs), adapter)
    sheet = read_sheet(vehicle, library=known_effects(effects))
    measures = target in log.targets if target else bool(log.targets)
    name = target or (log.default_target if measures else "energy_wh")
    derived = name == "traction_force_n" and log.segments.has("motor_torque_nm")
    problem = prepare(log, sheet, name, need_measured=measures or derived)
    predicted = problem.predict(problem.vehicle)
    sd = np.array([c.sd or 0.0 for c in problem.table.free])
    rows = padded(problem.segments, problem.measured)
    jac = jacobian(problem.vehicle, problem.table, rows.segments, problem.target)[: len(log)]
    variance = np.sum((jac * sd) ** 2, axis=1) if len(sd) else np.zeros(len(log))
    if measures or derived:
        variance = variance + float(np.mean((problem.measured - predicted) ** 2))
    half = stats.norm.ppf(0.5 + level / 2) * np.sqrt(variance)
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
    return f"{len(frame)} rows of {problem.target} -> {out}"


def simulate(config: str | Path, *, out: str | Path) -> str:
    """A synthetic fleet with known truth, from its configuration (a TOML file), into the folder `out`.

    `log.parquet`, `truth.parquet` and `sheets` hold a file for each vehicle; `fleet.json`, a report and figures say
    what is in them. **Returns:** a summary as text. Raises `InputError`. In memory: `hdev_jax.fleet.simulate`.
    """
    from hdev_jax.fleet.config import load_config
    from hdev_jax.fleet.files import write_fleet
    from hdev_jax.report.fleet_page import fleet_summary, fleet_text, write_fleet_report

    started = time.time()
    wanted = load_config(config)
    resolved = {"verb": "simulate", **wanted.table(), "x64": bool(jax.config.read("jax_enable_x64"))}
    with open_run(out, resolved, seed=wanted.seed) as run:
        if run.done:
            return (run.work / "answer.txt").read_text()
        progress.step(f"{wanted.routes} routes of {len(wanted.chosen)} vehicles")
        fleet = write_fleet(wanted, run.work, progress.step)
        progress.step("writing the report")
        summary = fleet_summary(fleet, wanted)
        run.path("fleet.json").write_text(json.dumps(summary, indent=1, allow_nan=False) + "\n")
        command = shlex.join(["hdev", "simulate", str(config), "--out", str(run.out)])
        write_fleet_report(fleet, wanted, command, time.time() - started, run.work)
        answer = fleet_text(summary, Path(out))
        run.path("answer.txt").write_text(answer)
    return answer


def check(
    logs: Paths,
    vehicle: str | Path | None = None,
    adapter: str | Path | None = None,
    effects: str | Path | None = None,
    skeleton: bool = False,
) -> str:
    """What was read: columns, units, trips, kWh/km by trip, what was dropped, filled or clipped. Nothing is fitted.

    With `skeleton`, an adapter to fill in instead. Raises `InputError`.
    """
    if skeleton:
        return write_adapter_skeleton(Path(next(iter(logs))))
    log = read_log(list(logs), adapter)
    s = log.segments
    lines = [f"{len(log)} rows, {len(log.trip_names)} trips, {len(log.vehicle_names)} vehicles"]
    lines += ["", "columns"] + [f"  {c.source:34s} {c.unit or '-':10s} -> {c.name}" for c in log.columns]
    has_energy = any(t in log.targets for t in ("energy_wh", "battery_power_kw"))
    energy = log.target("energy_wh") if has_energy else None
    lines += ["", f"{'trip':40s} {'rows':>7s} {'min':>7s} {'km':>8s} {'kWh':>9s} {'kWh/km':>8s}"]
    for i, name in enumerate(log.trip_names):
        m = s.trip == i
        km, minutes = float(np.sum(s.distance_m[m])) / 1e3, float(np.sum(s.duration_s[m])) / 60
        kwh = float(np.sum(energy[m])) / 1e3 if energy is not None else float("nan")
        per = f"{kwh / km:8.3f}" if km > 0.05 and energy is not None else f"{'-':>8s}"
        total = f"{kwh:9.3f}" if energy is not None else f"{'-':>9s}"
        lines.append(f"{name:40s} {int(m.sum()):7d} {minutes:7.1f} {km:8.2f} {total} {per}")
    lines += ["", "targets: " + (", ".join(log.targets) or "none is measured"), "", "ledger"]
    lines += [f"  {line}" for line in log.ledger.lines()] or ["  nothing was dropped, filled or clipped"]
    if vehicle is not None:
        sheet = read_sheet(vehicle, library=known_effects(effects))
        problem = prepare(log, sheet, None, need_measured=bool(log.targets))
        free = ", ".join(c.name for c in problem.table.free) or "none"
        lines += ["", f"vehicle: {sheet.name}; chain entered at the {problem.vehicle.entry}; estimated: {free}"]
        lines += [f"  {note}" for note in problem.notes]
    return "\n".join(lines)


def effects() -> list[dict[str, str]]:
    """The library of effects: id, stage, equation, parameters with units, channels needed, where from."""
    return [
        {
            "id": c.id,
            "stage": c.stage,
            "equation": c.equation,
            "parameters": ", ".join(f"{p.name} [{p.unit}]" for p in c.parameters),
            "needs": ", ".join(n.replace("|", " or ") for n in c.needs) or "-",
            "source": c.source,
        }
        for c in LIBRARY.values()
    ]


def _augmented(result: Diagnosis, sheet: Sheet) -> str:
    fit = result.fit
    values = {
        c.name: (float(v), float(s))
        for c, v, s in zip(fit.table.free, fit.values, fit.sd, strict=True)
        if c.path.rpartition(".")[0].removeprefix("effects.") not in result.found
    }
    return augmented_sheet(sheet, values, result.found)
