"""The verb `whatif`: what a change of the vehicle, its load or the weather would cost on the trips as driven."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from hdev_jax.diagnosis.candidates.own import Effects
from hdev_jax.energy.change import Changed, Step, changed, idle, parse_changes
from hdev_jax.energy.fitted import Fitted, interval
from hdev_jax.energy.ledger import SUM
from hdev_jax.errors import InputError
from hdev_jax.report import words
from hdev_jax.report.energy.figures import differences, label, trip_intervals
from hdev_jax.report.energy.page import Page, Section, Table, span, table_of
from hdev_jax.verbs.energy.opening import Asked, answered, battery_target, fitted_for, problem_for, synthetic, trusted
from hdev_jax.verbs.energy.result import EnergyResult, records
from hdev_jax.verbs.opening import Logs, Vehicles

__all__ = ["whatif"]

NOTHING = 1e-9  # kWh/100 km: a cause that the change leaves alone


def whatif(
    vehicle: Vehicles,
    logs: Logs,
    changes: Sequence[str] | str,
    adapter: str | Path | None = None,
    target: str | None = None,
    effects: Effects = None,
    trust: bool = False,
    *,
    out: str | Path | None = None,
    seed: int = 0,
) -> EnergyResult:
    """Energy of the trips as driven with a change, by trip and by cause, with 90 % intervals.

    Speeds, slopes and stops stay as driven; the vehicle, its mass or the weather changes. Both vehicles use the same
    draws of the coefficients, so errors that they share cancel in the difference. The log need not measure energy.

    **Arguments:** `changes`: `KEY=VALUE` each. KEY is a coefficient of the sheet (`road.c_rr=-10%`, `mass_kg=+500`,
    `battery.auxiliary_w=2000`) or a channel of the log (`ambient_temp_c=-10`). A value with a sign is a change, so that
    example is 10 °C colder; a value without a sign is the new value.

    **Returns:** an `EnergyResult` with the tables `trips` and `causes`. **Raises:** `InputError`; for an unknown key,
    with the nearest name.
    """
    wanted = [changes] if isinstance(changes, str) else list(changes)
    options = {"target": target, "set": wanted, "trust": trust}
    place = (str(vehicle),) if isinstance(vehicle, str | Path) else ()
    asked = Asked.of("whatif", logs, adapter, effects, seed, options, place)
    measured = bool(asked.log.measured)
    name = battery_target(asked.log, target) if measured else target or "energy_wh"
    problem = problem_for(asked, vehicle, name, measured=measured)
    steps = parse_changes(problem, wanted)
    if not np.any(np.asarray(asked.log.segments.distance_m)):
        raise InputError("the log never moves; a log of driving is expected")
    if measured:
        trusted(problem, trust)
    fitted = fitted_for(problem, vehicle, calibrate=measured)
    return answered(asked, out, lambda command: _answer(fitted, steps, asked, command))


def _answer(fitted: Fitted, steps: list[Step], asked: Asked, command: str) -> EnergyResult:
    found = changed(fitted, steps, seed=asked.seed)
    said = [f"{s.text} changes nothing on these trips: no effect of the sheet uses {s.key} (see hdev effects)"
            for s in idle(fitted, steps)]  # fmt: skip
    fitted = replace(fitted, notes=(*fitted.notes, *said))
    log = fitted.problem.log
    there = [i for i in range(len(log.trip_names)) if np.any(log.trip == i)]
    km = np.bincount(log.trip, weights=np.asarray(log.segments.distance_m) / 1e3, minlength=len(log.trip_names))
    trips = _trips(found, [log.trip_names[i] for i in there], there, km)
    whole = _row(found, np.ones(len(log.trip_names)))
    causes = _causes(found, float(km.sum()))
    text = ", ".join(s.text for s in steps)
    percent = [100.0 * whole[k] for k in ("relative", "relative_lower", "relative_upper")]
    summary = {
        "schema": "hdev-whatif/1", "changes": [s.text for s in steps], "how": fitted.how, "notes": list(fitted.notes),
        "total": {k: float(v) for k, v in whole.items()}, "km": float(km.sum()),
        "causes": records(causes), "trips": records(trips),
    }  # fmt: skip
    sentence = (
        f"{text}: {whole['before_kwh']:.4g} kWh become {whole['after_kwh']:.4g} kWh over {km.sum():.4g} km, "
        f"{percent[0]:+.2f} % ({percent[1]:+.2f} to {percent[2]:+.2f} %)"
    )
    lines = [sentence, "", f"{'cause':34s} {'kWh/100 km':>11s} {'90 % interval':>23s}"]
    for r in (r for r in records(causes) if abs(r["difference"]) > NOTHING or r["cause"] == SUM):
        lines.append(f"{label(r['cause']):34s} {r['difference']:+11.4g} {_between(r):>23s}")
    lines += ["", f"{'trip':40s} {'kWh':>9s} {'change':>9s} {'90 % interval':>23s}"]
    for r in records(trips):
        lines.append(f"{r['trip_id']:40s} {r['before_kwh']:9.4g} {r['change_kwh']:+9.4g} {_between(r):>23s}")
    lines += [f"vehicle: {fitted.how}", *(f"note: {note}" for note in fitted.notes)]
    tables = {"trips": trips, "causes": causes}
    return EnergyResult("whatif", "\n".join(lines), summary, tables, _page(fitted, text, whole, trips, causes, command))


def _between(r: Mapping[str, Any]) -> str:
    return f"{r['lower']:+.3g} to {r['upper']:+.3g}"


def _row(found: Changed, member: np.ndarray) -> dict[str, float]:
    """One row of a table: energy before and after over these trips, and the change with its interval [kWh]."""
    before, by = member @ found.before.value.sum(axis=1), member @ found.by.value.sum(axis=1)
    drawn, base = found.by.drawn.sum(axis=2) @ member, found.before.drawn.sum(axis=2) @ member
    low, high = interval(drawn)
    part = np.divide(drawn, base, out=np.full(len(drawn), np.nan), where=base != 0)
    share = by / before if before else np.nan
    ends = interval(part) if np.all(np.isfinite(part)) else (np.nan, np.nan)
    return {
        "before_kwh": float(before), "after_kwh": float(before + by), "change_kwh": float(by), "lower": float(low),
        "upper": float(high), "relative": float(share), "relative_lower": float(ends[0]),
        "relative_upper": float(ends[1]),
    }  # fmt: skip


def _trips(found: Changed, names: Sequence[str], there: Sequence[int], km: np.ndarray) -> pd.DataFrame:
    rows = []
    for name, i in zip(names, there, strict=True):
        member = np.zeros(len(km))
        member[i] = 1.0
        rows.append({"trip_id": name, "km": float(km[i]), **_row(found, member)})
    return pd.DataFrame(rows)


def _causes(found: Changed, km: float) -> pd.DataFrame:
    """Where the change comes from, over all trips [kWh/100 km]; adds up exactly."""
    per = 100.0 / km if km > 0 else np.nan
    value, drawn = per * found.by.value.sum(axis=0), per * found.by.drawn.sum(axis=1)
    value, drawn = np.append(value, value.sum()), np.column_stack([drawn, drawn.sum(axis=1)])
    low, high = interval(drawn)
    return pd.DataFrame({"cause": [*found.by.causes, SUM], "difference": value, "lower": low, "upper": high})


def _page(
    fitted: Fitted, text: str, whole: dict[str, float], trips: pd.DataFrame, causes: pd.DataFrame, command: str
) -> Page:
    sheet, log = fitted.problem.sheet, fitted.problem.log
    share = words.percent(100 * whole["relative"], decimals=2)
    answer = [(f"{text}: ", False), (share, True),
              (f" energy on the trips as driven ({words.percent(100 * whole['relative_lower'], decimals=2)} to "
               f"{words.percent(100 * whole['relative_upper'], decimals=2)}).", False)]  # fmt: skip
    shown = pd.DataFrame(causes[(causes["difference"].abs() > NOTHING) | (causes["cause"] == SUM)])
    rows = [(label(r["cause"]), span(r["difference"], r["lower"], r["upper"])) for r in records(shown)]
    percents = trips[["relative", "relative_lower", "relative_upper"]].to_numpy(float) * 100
    return Page(
        "whatif", sheet.name, f"with {text}", synthetic(log, [sheet.name]), answer,
        [("Before", words.number(whole["before_kwh"], 4, "kWh"), "by the model"),
         ("After", words.number(whole["after_kwh"], 4, "kWh"), "by the model, the same trips"),
         ("Change", span(whole["change_kwh"], whole["lower"], whole["upper"]) + " kWh", "90 % interval")],
        [Section(
            "Where the change comes from", "The bars add up to the whole.",
            {"causes": (lambda: differences(shown, "kWh/100 km", "Change by cause; line: 90 % interval"),
                        "Bars of the change by cause.", "Change of the energy by cause over all trips.")},
            (Table("Change by cause [kWh/100 km]", ("Cause", "change (90 % interval)"), rows),)),
         Section(
            "Trips", "Both vehicles on the same trips, speeds and stops.",
            {"trips": (lambda: trip_intervals(
                list(trips["trip_id"]), percents, "change of the trip's energy [%]", "Change of each trip",
                (100 * whole["relative"], 100 * whole["relative_lower"], 100 * whole["relative_upper"])),
                "Change of each trip with its interval.", "Change of each trip's energy.")},
            (table_of(trips, "Trips", {"trip_id": "Trip", "km": "km", "before_kwh": "before [kWh]",
                                       "after_kwh": "after [kWh]", "change_kwh": "change [kWh]", "lower": "from",
                                       "upper": "to"}, file="trips.csv"),))],
        fitted.notes, command, fitted.how,
    )  # fmt: skip
