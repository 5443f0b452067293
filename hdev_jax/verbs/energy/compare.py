"""The verb `compare`: where the difference between two trips, vehicles or sheets comes from."""

from pathlib import Path

import numpy as np
import pandas as pd

from hdev_jax.diagnosis.candidates.own import Effects
from hdev_jax.energy.compare import compare_sheets, compare_trips
from hdev_jax.energy.fitted import Fitted
from hdev_jax.energy.ledger import TOTAL, UNEXPLAINED
from hdev_jax.energy.saved import circumstances
from hdev_jax.errors import InputError
from hdev_jax.logs import Log
from hdev_jax.logs.adapter import near
from hdev_jax.report.energy.figures import differences, label
from hdev_jax.report.energy.page import Page, Section, Table, span, table_of
from hdev_jax.report.words import number
from hdev_jax.verbs.energy.opening import Asked, answered, battery_target, fitted_for, problem_for, synthetic, trusted
from hdev_jax.verbs.energy.result import EnergyResult, records
from hdev_jax.verbs.opening import Logs, Vehicles

__all__ = ["compare"]


def compare(
    a: Vehicles,
    b: Vehicles,
    logs: Logs,
    vehicle: Vehicles | None = None,
    adapter: str | Path | None = None,
    target: str | None = None,
    effects: Effects = None,
    trust: bool = False,
    *,
    out: str | Path | None = None,
    seed: int = 0,
) -> EnergyResult:
    """Why two trips, vehicles or sheets differ: the difference of each cause [kWh/100 km]. They add up exactly.

    **Arguments:** `a` and `b`: two sheets for the same log (.toml files, `Sheet`s or results); or two trips by name;
    or two vehicles by `vehicle_id`. `vehicle`: the sheet for trips or vehicles.

    **Returns:** an `EnergyResult` with the table `causes`, and for trips `circumstances`. **Raises:** `InputError`.
    """
    sheets = [not isinstance(x, str | Path) or str(x).endswith(".toml") for x in (a, b)]
    if any(sheets) and not all(sheets):
        raise InputError(
            "compare: one is a sheet (.toml) and the other is not; two sheets, trips or vehicles are expected"
        )
    named = tuple(str(x) if isinstance(x, str | Path) else f"sheet {k}" for k, x in (("A", a), ("B", b)))
    asked = Asked.of("compare", logs, adapter, effects, seed, {"target": target, "trust": trust}, named)
    if all(sheets):
        measured = bool(asked.log.measured)
        name = battery_target(asked.log, target) if measured else target or "energy_wh"
        problems = [problem_for(asked, x, name, name=k, measured=measured) for k, x in (("a", a), ("b", b))]
        one, two = (fitted_for(p, x, calibrate=False) for p, x in zip(problems, (a, b), strict=True))
        titles = (one.problem.sheet.name, two.problem.sheet.name)
        titles = titles if titles[0] != titles[1] else named
        return answered(asked, out, lambda command: _answer(
            compare_sheets(one, two, seed=asked.seed), None, titles, one, f"A {one.how}; B {two.how}", command
        ))  # fmt: skip
    if vehicle is None:
        raise InputError("compare: --vehicle is missing; two trips are compared by the sheet of their vehicle")
    trips = [_trips(asked.log, str(x)) for x in (a, b)]
    problem = problem_for(asked, vehicle, battery_target(asked.log, target))
    trusted(problem, trust)
    fitted = fitted_for(problem, vehicle)

    def work(command: str) -> EnergyResult:
        table = compare_trips(fitted, *trips, seed=asked.seed)
        return _answer(table, circumstances(fitted.problem, *trips), named, fitted, fitted.how, command)

    return answered(asked, out, work)


def _trips(log: Log, name: str) -> tuple[int, ...]:
    """The trip of that name, or all trips of the vehicle."""
    if name in log.trip_names:
        return (log.trip_id(name),)
    if name in log.vehicle_names and len(log.vehicle_names) > 1:
        rows = np.asarray(log.segments.vehicle) == log.vehicle_names.index(name)
        return tuple(int(i) for i in np.unique(log.trip[rows]))
    choices = (*log.trip_names, *(log.vehicle_names if len(log.vehicle_names) > 1 else ()))
    shown = ", ".join(choices[:8]) + (", …" if len(choices) > 8 else "")
    raise InputError(f"no trip or vehicle '{name}' in the log{near(name, choices)}; it has {shown}")


def _answer(
    table: pd.DataFrame, others: pd.DataFrame | None, names: tuple[str, ...], fitted: Fitted, how: str, command: str
) -> EnergyResult:
    by = {r["cause"]: r["difference"] for r in records(table)}
    total = by.pop(TOTAL, 0.0)
    largest = sorted(by, key=lambda c: -abs(by[c]))[:3]
    most = ", ".join(f"{label(c)} {by[c]:+.3g}".replace("-", "−") for c in largest)
    moved = total if others is not None else sum(x for c, x in by.items() if c != UNEXPLAINED)
    takes = "takes" if others is not None else "predicts"
    head = f"{names[1]} {takes} {number(abs(moved))} kWh/100 km {'more' if moved >= 0 else 'less'} than {names[0]}"
    summary = {
        "schema": "hdev-compare/1", "a": names[0], "b": names[1], "how": how, "notes": list(fitted.notes),
        "causes": records(table), "circumstances": [] if others is None else records(others.drop(columns=["differs"])),
    }  # fmt: skip
    lines = [
        f"{head}: {most}",
        "",
        f"{'cause [kWh/100 km]':34s} {'A':>9s} {'B':>9s} {'B - A':>9s} {'90 % interval':>23s}",
    ]
    for r in records(table):
        between = f"{r['lower']:+.3g} to {r['upper']:+.3g}"
        lines.append(f"{label(r['cause']):34s} {r['a']:9.4g} {r['b']:9.4g} {r['difference']:+9.3g} {between:>23s}")
    if others is not None:
        lines += ["", f"{'circumstances':30s} {'A':>10s} {'B':>10s}"]
        for r in records(others):
            what = f"{r['what']} [{r['unit']}]"
            lines.append(f"{what:30s} {r['before']:10.4g} {r['after']:10.4g}")
    lines += [f"vehicle: {how}", *(f"note: {note}" for note in fitted.notes)]
    rows = [(label(r["cause"]), number(r["a"]), number(r["b"]), span(r["difference"], r["lower"], r["upper"]))
            for r in records(table)]  # fmt: skip
    sections = [Section(
        "Where the difference comes from", f"A: {names[0]}. B: {names[1]}. The differences add up to the last one.",
        {"causes": (lambda: differences(table, "kWh/100 km", "B less A by cause; line: 90 % interval"),
                    "Bars of the difference by cause.", "Difference of the energy by cause.")},
        (Table("Energy by cause [kWh/100 km]", ("Cause", "A", "B", "B − A (90 % interval)"), rows),),
    )]  # fmt: skip
    if others is not None:
        sections.append(Section("Circumstances", "", {}, (table_of(others, "Circumstances", {
            "what": "What", "unit": "unit", "before": "A", "after": "B"}, text=2),)))  # fmt: skip
    tables = {"causes": table} if others is None else {"causes": table, "circumstances": others}
    page = Page(
        "compare", fitted.problem.sheet.name, f"{names[0]} beside {names[1]}",
        synthetic(fitted.problem.log, [fitted.problem.sheet.name]), [(head, True), (f": {most}.", False)], [], sections,
        fitted.notes, command, how,
    )  # fmt: skip
    return EnergyResult("compare", "\n".join(lines), summary, tables, page)
