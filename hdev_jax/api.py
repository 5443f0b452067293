"""The verbs: what `hdev VERB` does, as functions of the same names and arguments."""

import json
import shlex
import time
from collections.abc import Sequence
from pathlib import Path

import jax
import numpy as np

from hdev_jax import progress
from hdev_jax.diagnosis.diagnose import Diagnosis
from hdev_jax.diagnosis.diagnose import diagnose as run_loop
from hdev_jax.diagnosis.problem import prepare
from hdev_jax.diagnosis.stages import add_stages
from hdev_jax.inference.sheet import Sheet, read_sheet
from hdev_jax.inference.sheet_text import augmented_sheet
from hdev_jax.logs import read_log, write_adapter_skeleton
from hdev_jax.opening import Paths, chosen_effects, command_line, known_effects, opened
from hdev_jax.physics import LIBRARY, Parameter
from hdev_jax.posterior import calibrate
from hdev_jax.prediction import predict, write_predictive
from hdev_jax.report.build import answer_text, of_diagnosis
from hdev_jax.report.page import write_report
from hdev_jax.rundir import open_run

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
    known = known_effects(effects)
    candidates = chosen_effects(known, only, exclude)
    start = opened(
        "diagnose", logs, vehicle, adapter, target, train_trips, test_trips, effects, seed, known, *candidates
    )
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
        why = {k: "--exclude" if k in (exclude or ()) else "not in --only" for k in known if k not in candidates}
        result.summary["excluded"] += [{"id": k, "why": w} for k, w in why.items() if not problem.vehicle.has(k)]
        sheet = run.path("augmented_vehicle.toml")
        sheet.write_text(_augmented(result, start.sheet))
        result.summary["notes"] += write_predictive(run, sheet, problem, split, result.fit, "normal")
        data = of_diagnosis(result, command_line("diagnose", run), started)
        run.path("diagnosis.json").write_text(json.dumps(result.summary, indent=1, allow_nan=False) + "\n")
        write_report(data, run.work)
        answer = answer_text(data, Path(out))
        run.path("answer.txt").write_text(answer)
    return answer


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
        fleet = write_fleet(wanted, run, progress.step)
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
            "parameters": ", ".join(f"{p.name} [{p.unit}]{_by(p)}" for p in c.parameters),
            "needs": ", ".join(n.replace("|", " or ") for n in c.needs) or "-",
            "source": c.source,
        }
        for c in LIBRARY.values()
    ]


def _by(p: Parameter) -> str:
    return f" by {p.by.replace('_', ' ')}" if p.by else ""


def _augmented(result: Diagnosis, sheet: Sheet) -> str:
    fit = result.fit
    values = {
        c.name: (float(v), float(s))
        for c, v, s in zip(fit.table.free, fit.values, fit.sd, strict=True)
        if c.path.rpartition(".")[0].removeprefix("effects.") not in result.found
    }
    return augmented_sheet(sheet, values, result.found)
