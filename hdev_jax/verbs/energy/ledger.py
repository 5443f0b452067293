"""The verb `ledger`: where a vehicle's energy goes, by trip, week and vehicle."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from hdev_jax.diagnosis.candidates.own import Effects
from hdev_jax.energy.fitted import Fitted, calibrated_on
from hdev_jax.energy.ledger import TOTAL, UNEXPLAINED, Ledger, ledger_of
from hdev_jax.energy.saved import conditions
from hdev_jax.errors import InputError
from hdev_jax.logs import Log
from hdev_jax.problem import prepare
from hdev_jax.report import words
from hdev_jax.report.energy.figures import by_week, consumption, label, waterfall
from hdev_jax.report.energy.flow import CAPTION as FLOW
from hdev_jax.report.energy.flow import energy_flow
from hdev_jax.report.energy.page import Page, Section, Table, span, table_of
from hdev_jax.targets import TARGETS
from hdev_jax.verbs.energy.opening import Asked, answered, battery_target, fitted_for, problem_for, synthetic, trusted
from hdev_jax.verbs.energy.result import EnergyResult, records
from hdev_jax.verbs.opening import Logs, Vehicles

__all__ = ["ledger"]


def ledger(
    logs: Logs,
    vehicle: Vehicles,
    adapter: str | Path | None = None,
    target: str | None = None,
    effects: Effects = None,
    price: float | None = None,
    trust: bool = False,
    *,
    out: str | Path | None = None,
    seed: int = 0,
) -> EnergyResult:
    """kWh, kWh/100 km, share and cost by cause, for the whole log, each vehicle, week and trip, with 90 % intervals.

    A sheet in the folder where `calibrate` or `diagnose` wrote it counts as fitted; any other is calibrated on this
    log. Each block adds up to the measured energy: the row *unexplained* is the rest. The docstring of
    `hdev_jax.energy.causes` says how losses that multiply are shared out.

    **Arguments:** `price` of a kWh, in any currency. `out`: a folder for `report.html`, `ledger.csv`, `.parquet`,
    `.xlsx` and `.json`.

    **Returns:** an `EnergyResult` with two tables. `ledger` has a row for each level, name and cause: `kwh`, `lower`,
    `upper`, `kwh_per_100km`, `share_percent`, `cost`. `about` has a row for each level and name: km, hours, regenerated
    and auxiliary share, energy while standing and while parked. **Raises:** `InputError`.
    """
    if price is not None and not (np.isfinite(price) and price >= 0):
        raise InputError(f"--price {price}: the price of a kWh, a number of 0 or more, is expected")
    asked = Asked.of("ledger", logs, adapter, effects, seed, {"target": target, "price": price, "trust": trust})
    name = battery_target(asked.log, target)
    problem = problem_for(asked, vehicle, name)
    trusted(problem, trust)
    fitted = fitted_for(problem, vehicle)
    return answered(asked, out, lambda command: _answer(fitted, price, asked, command))


def _road_of(fitted: Fitted, log: Log) -> tuple[Fitted | None, list[str]]:
    """The vehicle fitted to what the drive gave, where the chain is entered there; why it cannot be, for the notes."""
    problem = fitted.problem
    if problem.vehicle.entry == "road":
        return None, []
    target = {"wheel": "traction_force_n", "shaft": "motor_torque_nm"}[problem.vehicle.entry]
    try:
        road = prepare(log, problem.sheet, target)
    except InputError as e:
        return None, [f"road forces are one cause, traction: {e}"]
    if road.vehicle.entry != "road":
        return None, ["road forces are one cause, traction: both torque and force are measured"]
    return calibrated_on(road), [f"road forces are fitted to {TARGETS[target].label}"]


def _answer(fitted: Fitted, price: float | None, asked: Asked, command: str) -> EnergyResult:
    road, said = _road_of(fitted, asked.log)
    found = ledger_of(fitted, price=price, road=road, seed=asked.seed)
    whole, about = _level(found.rows, "all"), records(found.about)[0]
    told = [n for n in fitted.notes if road is None or not n.startswith("[road] is not used")]
    notes = [*told, *said]
    if found.undated:
        notes.append(f"{found.undated} trips have no date in the log: no weekly table has them")
    summary = {
        "schema": "hdev-ledger/1",
        "target": fitted.problem.target,
        "how": fitted.how,
        "notes": notes,
        "price": price,
        "blocks": _blocks(found),
    }
    lines = [_sentence(whole, about), "", *_text(whole, price), "", *_besides(about), f"vehicle: {fitted.how}"]
    lines += [f"note: {note}" for note in notes]
    page = _page(fitted, found, price, asked, notes, command)
    return EnergyResult("ledger", "\n".join(lines), summary, {"ledger": found.rows, "about": found.about}, page)


def _level(frame: pd.DataFrame, level: str) -> pd.DataFrame:
    return pd.DataFrame(frame[frame["level"] == level])


def _blocks(found: Ledger) -> list[dict[str, Any]]:
    causes = {key: records(block.drop(columns=["level", "name"]))
              for key, block in found.rows.groupby(["level", "name"], sort=False)}  # fmt: skip
    return [{**block, "causes": causes[(block["level"], block["name"])]} for block in records(found.about)]


def _pieces(whole: pd.DataFrame, about: Mapping[str, Any]) -> list[tuple[str, bool]]:
    """The answer: how much, and the causes that take most of it."""
    total = float(about["measured_kwh"])
    per = words.number(about["kwh_per_100km"], 3, "kWh/100 km")
    pieces = [(f"{words.number(total, 4)} kWh over {words.number(about['km'], 4)} km, ", False), (per, True)]
    lines = {r["cause"]: r for r in records(whole)}
    left = lines.pop(UNEXPLAINED)
    lines.pop(TOTAL)
    first = [r for r in lines.values() if (r["share_percent"] or 0.0) >= 1.0]
    first = sorted(first, key=lambda r: -r["kwh"])[:4]
    causes = [f"{label(r['cause'])} {words.percent(r['share_percent'], signed=False, decimals=0)}" for r in first]
    if causes:
        pieces.append((f": {', '.join(causes)}", False))
    share = words.percent(left["share_percent"])
    noise = left["lower"] <= 0 <= left["upper"]
    pieces.append((f"; {share} unexplained, {'no more than noise' if noise else 'more than noise'}.", False))
    return pieces


def _sentence(whole: pd.DataFrame, about: Mapping[str, Any]) -> str:
    return "".join(text for text, _ in _pieces(whole, about))


def _text(whole: pd.DataFrame, price: float | None) -> list[str]:
    head = f"{'cause':34s} {'kWh':>9s} {'90 % interval':>23s} {'kWh/100 km':>11s} {'share':>8s}"
    lines = [head + (f" {'cost':>9s}" if price is not None else "")]
    for r in records(whole):
        between = f"{r['lower']:.4g} to {r['upper']:.4g}" if r["lower"] < r["upper"] else "-"
        share = "-" if r["share_percent"] is None else f"{r['share_percent']:.1f} %"
        per = "-" if r["kwh_per_100km"] is None else f"{r['kwh_per_100km']:.4g}"
        cost = "" if price is None else f" {r['cost']:9.2f}"
        lines.append(f"{label(r['cause']):34s} {r['kwh']:9.4g} {between:>23s} {per:>11s} {share:>8s}{cost}")
    return lines


def _besides(about: Mapping[str, Any]) -> list[str]:
    return [
        f"regenerated {words.percent(about['regenerated_percent'], signed=False)} of the energy that left the battery, "
        f"row by row; auxiliary loads {words.percent(about['auxiliary_percent'], signed=False)} of it",
        f"standing {about['standing_kwh']:.4g} kWh, of which parked (5 minutes or more) {about['parked_kwh']:.4g} kWh "
        f"in {about['parked_hours']:.3g} h",
    ]


def _page(fitted: Fitted, found: Ledger, price: float | None, asked: Asked, notes: list[str], command: str) -> Page:
    problem, whole, about = fitted.problem, _level(found.rows, "all"), records(found.about)[0]
    log = problem.log
    weeks = _level(found.rows, "week")
    trips = _level(found.about, "trip")
    left = _level(found.rows, "trip").query("cause == @UNEXPLAINED")
    trips["model_per_100km"] = trips["kwh_per_100km"].to_numpy() - left["kwh_per_100km"].to_numpy()
    place = [log.trip_names.index(name) for name in trips["name"]]
    against = {k: (u, x[place]) for k, (u, x) in conditions(problem).items()
               if k in ("speed in motion", "outside temperature", "mass")}  # fmt: skip
    per = ("kwh_per_100km", "kWh/100 km") if about["km"] > 0 else ("kwh", "kWh")
    sections = [
        Section(
            "Where the energy goes",
            "Forces count at the wheel; the driveline's loss follows from its efficiency and their sum. The difference "
            "to the measured energy is unexplained; its interval includes the noise of the trips.",
            {"flow": (lambda: energy_flow(whole, about["regenerated_kwh"], about["km"]),
                      "Bands of energy from the battery through loads and losses to the wheels, and back.", FLOW),
             "waterfall": (lambda: waterfall(whole, *per), "Bars of energy by cause that add up to what was measured.",
                           "Energy by cause over the whole log.")},
            (_causes(whole, price),),
        ),
        Section(
            "Consumption by trip", "",
            {"consumption": (lambda: consumption(trips, against), "Consumption of each trip against conditions.",
                             "Measured, and what the fitted vehicle predicts of the same trips.")},
            (table_of(trips, "Trips", {"name": "Trip", "km": "km", "hours": "h", "measured_kwh": "kWh",
                                       "kwh_per_100km": "kWh/100 km", "model_per_100km": "by the model",
                                       "regenerated_percent": "regenerated [%]", "auxiliary_percent": "auxiliary [%]",
                                       "parked_kwh": "parked [kWh]"}, file="about.csv"),),
        ),
    ]  # fmt: skip
    for level, words_ in (("week", "Weeks"), ("vehicle", "Vehicles")):
        part = _level(found.about, level)
        if len(part):
            drawn = {"weeks": (lambda: by_week(weeks), "Stacked bars of energy by cause for each week.",
                               "Energy by cause, week by week (ISO 8601).")} if level == "week" else {}  # fmt: skip
            table = table_of(part, words_, {"name": words_[:-1], "trips": "trips", "km": "km", "measured_kwh": "kWh",
                                            "kwh_per_100km": "kWh/100 km", "regenerated_percent": "regenerated [%]"},
                             file="about.csv")  # fmt: skip
            sections.insert(1, Section(words_, "", drawn, (table,)))
    tiles = [
        ("Consumption", words.number(about["kwh_per_100km"], 3, "kWh/100 km"), f"over {about['km']:,.0f} km"),
        ("Regenerated", words.percent(about["regenerated_percent"], signed=False),
         "of the energy out of the battery, row by row"),
        ("Auxiliary loads", span(about["auxiliary_percent"], about["auxiliary_percent_lower"],
                                 about["auxiliary_percent_upper"]) + " %", "of the energy out of the battery"),
        ("While parked", words.number(about["parked_kwh"], 3, "kWh"), "stops of 5 minutes or more"),
    ]  # fmt: skip
    if price is not None:
        tiles.append(("Cost", words.number(price * float(about["measured_kwh"]), 4), f"at {price:g} a kWh"))
    return Page(
        "ledger", problem.sheet.name, "where its energy goes", synthetic(log, [problem.sheet.name]),
        _pieces(whole, about), tiles, sections, notes, command, fitted.how,
    )  # fmt: skip


def _causes(whole: pd.DataFrame, price: float | None) -> Table:
    shown = whole.assign(
        cause=[label(c) for c in whole["cause"]],
        kwh_=[span(a, b, c) for a, b, c in zip(whole["kwh"], whole["lower"], whole["upper"], strict=True)],
    )
    columns = {
        "cause": "Cause",
        "kwh_": "kWh (90 % interval)",
        "kwh_per_100km": "kWh/100 km",
        "share_percent": "share [%]",
    }
    if price is not None:
        columns["cost"] = "cost"
    return table_of(shown, "Energy by cause", columns, file="ledger.csv")
