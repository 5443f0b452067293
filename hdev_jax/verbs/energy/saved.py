"""The verb `saved`: what a change has saved, by the trips before it and after it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

from hdev_jax.diagnosis.candidates.own import Effects, known_effects, tried
from hdev_jax.energy.fitted import Fitted, calibrated_on, forgotten
from hdev_jax.energy.saved import LEAST_TRIPS, Saving, circumstances, saving, trips_of
from hdev_jax.errors import InputError
from hdev_jax.problem import prepare
from hdev_jax.report import words
from hdev_jax.report.energy.figures import trip_intervals
from hdev_jax.report.energy.page import Page, Section, span, table_of
from hdev_jax.verbs.energy.opening import Asked, answered, battery_target, synthetic, trusted
from hdev_jax.verbs.energy.result import EnergyResult, records
from hdev_jax.verbs.opening import Logs, Vehicles

__all__ = ["saved"]


def saved(
    logs: Logs,
    vehicle: Vehicles,
    before: str,
    after: str,
    adapter: str | Path | None = None,
    target: str | None = None,
    effects: Effects = None,
    trust: bool = False,
    *,
    out: str | Path | None = None,
    seed: int = 0,
) -> EnergyResult:
    """Energy that a change saved, with weather, load, route and speed taken out by the kernel.

    The vehicle is calibrated on the trips before the change. For the trips after it, the energy that the unchanged
    vehicle would have taken is compared with what was measured. `hdev_jax.energy.saved` has the equations.

    **Arguments:** `before` and `after`: a range of dates, `2024-03-01..2024-03-31` (one end may be open); a range of
    trips in the order of the log, `T01..T08`; or names, `T01,T02`.

    **Returns:** an `EnergyResult` with the share saved, its 90 % interval, how many more trips would make it
    significant, and the tables `trips` and `circumstances` (what else changed). **Raises:** `InputError`.
    """
    asked = Asked.of(
        "saved", logs, adapter, effects, seed, {"target": target, "before": before, "after": after, "trust": trust}
    )
    name, sheet = battery_target(asked.log, target), asked.sheet(vehicle)
    first, then = trips_of(asked.log, before, "--before"), trips_of(asked.log, after, "--after")
    if both := set(first) & set(then):
        raise InputError(f"--before and --after both have trip '{asked.log.trip_names[min(both)]}'; one is expected")
    for trips, option in ((first, "--before"), (then, "--after")):
        if len(trips) < LEAST_TRIPS:
            raise InputError(f"{option}: {len(trips)} trip; at least {LEAST_TRIPS} are expected")
    opened, notes = forgotten(sheet)
    problem = prepare(asked.log, opened, name)
    tried(problem, known_effects(effects), effects)
    trusted(problem, trust)

    def work(command: str) -> EnergyResult:
        fitted = calibrated_on(problem, first)
        fitted = replace(fitted, notes=(*notes, *fitted.notes))
        return _answer(fitted, saving(fitted, then), first, then, command)

    return answered(asked, out, work)


def _percent(x: float) -> str:
    return words.percent(100.0 * x, decimals=2)


def _verdict(found: Saving) -> str:
    """Whether the saving is significant, and how many trips would make it so."""
    if found.shown:
        return "significant: the interval does not contain 0"
    both = f"{found.more_both} more trips before and as many after"
    if found.more_after is None:
        return (
            f"not significant yet: more trips after the change are not enough, because these trips before it can only "
            f"show a saving of {100 * found.least_share:.2g} % or more; {both} would be"
        )
    return (
        f"not significant yet: {found.more_after} more trips after the change would make it so (80 % power, if the "
        f"saving is as large as estimated), or {both}"
    )


def _answer(
    fitted: Fitted, found: Saving, before: tuple[int, ...], after: tuple[int, ...], command: str
) -> EnergyResult:
    others = circumstances(fitted.problem, before, after)
    moved = [str(w) for w in others.loc[others["differs"], "what"]]
    notes = list(fitted.notes)
    if moved:
        notes.append(
            f"what else changed: {', '.join(moved)}; the kernel corrects for them if the sheet has their effects, "
            "but an effect that the sheet lacks would count as saved"
        )
    kwh = [found.expected_kwh * x for x in (found.share, found.lower, found.upper)]
    summary = {
        "schema": "hdev-saved/1", "how": fitted.how, "notes": notes,
        "share": found.share, "lower": found.lower, "upper": found.upper, "freedom": found.freedom,
        "saved_kwh": kwh[0], "saved_kwh_lower": kwh[1], "saved_kwh_upper": kwh[2], "expected_kwh": found.expected_kwh,
        "settled": found.shown, "more_trips_after": found.more_after, "more_trips_each_side": found.more_both,
        "least_share_after_alone": found.least_share, "trips_before": len(before), "trips_after": len(after),
        "trips": records(found.trips), "circumstances": records(others),
    }  # fmt: skip
    sentence = (
        f"saved {_percent(found.share)} ({_percent(found.lower)} to {_percent(found.upper)}) of the energy of "
        f"{len(after)} trips after, by {len(before)} trips before: {kwh[0]:.4g} kWh ({kwh[1]:.4g} to {kwh[2]:.4g})"
    )
    lines = [sentence, _verdict(found), "", f"{'what else changed':24s} {'before':>10s} {'after':>10s} {'sd':>7s}"]
    for r in records(others):
        size = "-" if r["difference_sd"] is None else f"{r['difference_sd']:+.2f}"
        what, differs = f"{r['what']} [{r['unit']}]", "  differs" if r["differs"] else ""
        lines.append(f"{what:24s} {r['before']:10.4g} {r['after']:10.4g} {size:>7s}{differs}")
    lines += [f"vehicle: {fitted.how}", *(f"note: {note}" for note in notes)]
    tables = {"trips": found.trips, "circumstances": others}
    page = _page(fitted, found, others, kwh, notes, command)
    return EnergyResult("saved", "\n".join(lines), summary, tables, page)


def _page(
    fitted: Fitted, found: Saving, others: pd.DataFrame, kwh: list[float], notes: list[str], command: str
) -> Page:
    sheet, log, trips = fitted.problem.sheet, fitted.problem.log, found.trips
    percents = (
        100 * trips[["saved_kwh", "lower", "upper"]].to_numpy(float) / trips[["expected_kwh"]].abs().to_numpy(float)
    )
    needed = "none" if found.shown else "–" if found.more_after is None else f"{found.more_after} trips"
    whole = (100 * found.share, 100 * found.lower, 100 * found.upper)
    shown = others.assign(difference_sd=[f"{x:+.2f}".replace("-", "−") for x in others["difference_sd"]],
                          differs=np.where(others["differs"], "differs", ""))  # fmt: skip
    return Page(
        "saved", sheet.name, "what a change saved", synthetic(log, [sheet.name]),
        [("Saved ", False), (_percent(found.share), True),
         (f" ({_percent(found.lower)} to {_percent(found.upper)}) of what the unchanged vehicle would have "
          f"taken; {_verdict(found)}.", False)],
        [("Energy saved", span(kwh[0], kwh[1], kwh[2]) + " kWh", "90 % interval, on the trips after"),
         ("Expected without the change", words.number(found.expected_kwh, 4, "kWh"), f"{len(trips)} trips after"),
         ("More trips needed", needed, "after the change, 80 % power")],
        [Section(
            "Trips after the change", "Expected: by the vehicle calibrated on the trips before, on the same speeds, "
            "slopes, loads and weather. A trip's interval includes its noise and the uncertainty of the coefficients.",
            {"trips": (lambda: trip_intervals(list(trips["trip_id"]), percents, "saved [% of expected]",
                                              "Saved on each trip", whole),
                       "Share saved on each trip with its interval.", "Saved on each trip after the change.")},
            (table_of(trips, "Trips after the change", {
                "trip_id": "Trip", "expected_kwh": "expected [kWh]", "measured_kwh": "measured [kWh]",
                "saved_kwh": "saved [kWh]", "lower": "from", "upper": "to"}, file="trips.csv"),)),
         Section(
            "What else changed", "Means of trips; the difference in standard deviations of trips. A large one is no "
            "fault by itself: the kernel corrects for what it has a term for.",
            {}, (table_of(shown, "Circumstances", {
                "what": "What", "unit": "unit", "before": "before", "after": "after",
                "difference_sd": "difference [sd]", "differs": ""}, text=2),))],
        notes, command, fitted.how,
    )  # fmt: skip
