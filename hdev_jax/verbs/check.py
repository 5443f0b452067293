"""The verb `check`: what is read from a log, before anything is fitted."""

from pathlib import Path

import numpy as np

from hdev_jax.diagnosis.candidates.own import Effects, known_effects
from hdev_jax.logs import write_adapter_skeleton
from hdev_jax.logs.checks import suspicions
from hdev_jax.logs.read import adapter_of
from hdev_jax.problem import implausible, prepare
from hdev_jax.targets import TARGETS
from hdev_jax.verbs.opening import Logs, Vehicles, log_of, sheet_of

__all__ = ["check"]


def check(
    logs: Logs,
    vehicle: Vehicles | None = None,
    adapter: str | Path | None = None,
    effects: Effects = None,
    skeleton: bool = False,
) -> str:
    """What was read: columns, units, trips, kWh/km by trip, what was dropped, filled or clipped. Nothing is fitted.

    **Arguments:** `logs`: a path or several, a `Log`, or a table in memory. `vehicle`: a sheet, to check the log
    against it. `skeleton`: return an adapter to fill in instead. **Returns:** text. **Raises:** `InputError`.
    """
    if skeleton:
        first = Path(logs if isinstance(logs, str | Path) else next(iter(logs)))
        return write_adapter_skeleton(first, None if adapter is None else adapter_of(adapter))
    log = log_of(logs, adapter)
    s = log.segments
    lines = [f"{len(log)} rows, {len(log.trip_names)} trips, {len(log.vehicle_names)} vehicles"]
    wide = max((len(c.source) for c in log.columns), default=0)
    lines += ["", "columns"] + [f"  {c.source:{wide}s}  {c.unit or '-':6s} -> {c.name}" for c in log.columns]
    has_energy = any(TARGETS[t].of_battery for t in log.targets)
    energy = log.target("energy_wh") if has_energy else None
    wide = max(4, *(len(name) for name in log.trip_names))
    lines += ["", f"{'trip':{wide}s} {'rows':>7s} {'min':>7s} {'km':>8s} {'kWh':>9s} {'kWh/km':>8s}"]
    rows, km, minutes, kwh = (
        np.bincount(s.trip, x, minlength=len(log.trip_names))
        for x in (None, s.distance_m / 1e3, s.duration_s / 60, None if energy is None else energy / 1e3)
    )
    for i, name in enumerate(log.trip_names):
        per = f"{kwh[i] / km[i]:8.3f}" if km[i] > 0.05 and has_energy else f"{'-':>8s}"
        total = f"{kwh[i]:9.3f}" if has_energy else f"{'-':>9s}"
        lines.append(f"{name:{wide}s} {rows[i]:7d} {minutes[i]:7.1f} {km[i]:8.2f} {total} {per}")
    if log.instruments:
        lines += ["", "instruments", *(f"  {i.line()}" for i in log.instruments)]
    lines += ["", "targets: " + (", ".join(log.targets) or "none is measured"), "", "ledger: changes to the log"]
    lines += [f"  {line}" for line in log.ledger.lines()] or ["  nothing was dropped, filled or clipped"]
    found = suspicions(log)
    if vehicle is not None:
        sheet = sheet_of(vehicle, known_effects(effects))
        problem = prepare(log, sheet, None, need_measured=bool(log.targets))
        free = ", ".join(c.name for c in problem.table.free) or "none"
        lines += ["", f"vehicle: {sheet.name}; chain entered at the {problem.vehicle.entry}; estimated: {free}"]
        lines += [f"  {note}" for note in problem.notes]
        found = implausible(problem)
    if found:
        lines += ["", "suspected", *(f"  {s.line()}" for s in found)]
    return "\n".join(lines)
