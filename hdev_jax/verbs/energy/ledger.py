"""The verb `ledger`: where a vehicle's energy goes, by trip, week and vehicle."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from hdev_jax.energy.fitted import Fitted
from hdev_jax.energy.ledger import TOTAL, UNEXPLAINED, Ledger, ledger_of
from hdev_jax.energy.saved import conditions
from hdev_jax.errors import InputError
from hdev_jax.report import words
from hdev_jax.report.energy.figures import by_week, consumption, label, waterfall
from hdev_jax.report.energy.page import Page, Section, Table, span, table_of
from hdev_jax.verbs.energy.opening import Asked, answered, battery_target, fitted_for, synthetic
from hdev_jax.verbs.energy.result import EnergyResult, records
from hdev_jax.verbs.opening import Effects, Logs, Vehicles

__all__ = ["ledger"]


def ledger(
    logs: Logs,
    vehicle: Vehicles,
    adapter: str | Path | None = None,
    target: str | None = None,
    effects: Effects = None,
    price: float | None = None,
    *,
    out: str | Path | None = None,
    seed: int = 0,
) -> EnergyResult:
    """kWh, kWh/100 km, share and cost by cause, for the whole log, each vehicle, week and trip, with 90 % intervals.

    A sheet in the folder where `calibrate` or `diagnose` wrote it is taken as fitted; another is calibrated on this
    log. Each block adds up to the measured energy: what the causes leave is the row *unexplained*. How losses that
    multiply are shared out: `hdev_jax.energy.causes`.

    **Arguments:** `price` of a kWh, in any currency; `out`, a folder for `report.html`, `ledger.csv`, `.parquet`,
    `.xlsx` and `.json`. **Returns:** an `EnergyResult` with the tables `ledger` (long: level, name, cause, kwh, lower,
    upper, kwh_per_100km, share_percent, cost) and `about` (km, hours, regenerated and auxiliary share, energy while
    standing and parked, by level and name). **Raises:** `InputError`.
    """
    if price is not None and not (np.isfinite(price) and price >= 0):
        raise InputError(f"--price {price}: the price of a kWh, a number of 0 or more, is expected")
    asked = Asked.of("ledger", logs, adapter, effects, seed, {"target": target, "price": price})
    name = battery_target(asked.log, target)
    fitted = fitted_for(asked, vehicle, name)
    return answered(asked, out, lambda command: _answer(fitted, price, asked, command))


def _answer(fitted: Fitted, price: float | None, asked: Asked, command: str) -> EnergyResult:
    found = ledger_of(fitted, price=price, seed=asked.seed)
    whole, about = found.rows[found.rows["level"] == "all"], found.about.iloc[0]
    notes = list(fitted.notes)
    if found.undated:
        notes.append(f"{found.undated} trips have no date in the log: they are in no week")
    if fitted.problem.vehicle.entry != "road":
        notes.append("the log measures the drive's torque or force: road forces are one cause, traction")
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


def _blocks(found: Ledger) -> list[dict[str, Any]]:
    causes = {key: records(block.drop(columns=["level", "name"]))
              for key, block in found.rows.groupby(["level", "name"], sort=False)}  # fmt: skip
    return [{**block, "causes": causes[(block["level"], block["name"])]} for block in records(found.about)]


def _pieces(whole: pd.DataFrame, about: pd.Series) -> list[tuple[str, bool]]:
    """The answer: how much, and the causes that take most of it."""
    total = float(about["measured_kwh"])
    per = words.number(about["kwh_per_100km"], 3, "kWh/100 km")
    pieces = [(f"{words.number(total, 4)} kWh over {words.number(about['km'], 4)} km, ", False), (per, True)]
    parts = whole[~whole["cause"].isin([TOTAL, UNEXPLAINED])].sort_values("kwh", ascending=False)
    parts = parts[parts["share_percent"] > 0].head(4)
    left = whole[whole["cause"] == UNEXPLAINED].iloc[0]
    if len(parts):
        pieces.append((": ", False))
        for k, (cause, share) in enumerate(zip(parts["cause"], parts["share_percent"], strict=True)):
            pieces.append(
                (f"{', ' if k else ''}{label(cause)} {words.percent(share, signed=False, decimals=0)}", False)
            )
    share = words.percent(left["share_percent"])
    noise = left["lower"] <= 0 <= left["upper"]
    pieces.append((f"; {share} unexplained, {'no more than noise' if noise else 'more than noise'}.", False))
    return pieces


def _sentence(whole: pd.DataFrame, about: pd.Series) -> str:
    return "".join(text for text, _ in _pieces(whole, about))


def _text(whole: pd.DataFrame, price: float | None) -> list[str]:
    head = f"{'cause':34s} {'kWh':>9s} {'90 % interval':>23s} {'kWh/100 km':>11s} {'share':>8s}"
    lines = [head + (f" {'cost':>9s}" if price is not None else "")]
    for r in whole.itertuples():
        between = f"{r.lower:.4g} to {r.upper:.4g}" if r.lower < r.upper else "-"
        share = f"{r.share_percent:.1f} %" if r.share_percent == r.share_percent else "-"
        cost = f" {r.cost:9.2f}" if price is not None else ""
        lines.append(f"{label(str(r.cause)):34s} {r.kwh:9.4g} {between:>23s} {r.kwh_per_100km:11.4g} {share:>8s}{cost}")
    return lines


def _besides(about: pd.Series) -> list[str]:
    return [
        f"regenerated {about['regenerated_percent']:.1f} % of the energy that left the battery, row by row; auxiliary "
        f"loads {about['auxiliary_percent']:.1f} % of it",
        f"standing {about['standing_kwh']:.4g} kWh, of which parked (5 minutes or more) {about['parked_kwh']:.4g} kWh "
        f"in {about['parked_hours']:.3g} h",
    ]


def _page(fitted: Fitted, found: Ledger, price: float | None, asked: Asked, notes: list[str], command: str) -> Page:
    problem, whole, about = fitted.problem, found.rows[found.rows["level"] == "all"], found.about.iloc[0]
    log = problem.log
    weeks = found.rows[found.rows["level"] == "week"]
    trips = found.about[found.about["level"] == "trip"].copy()
    left = found.rows[(found.rows["level"] == "trip") & (found.rows["cause"] == UNEXPLAINED)]
    trips["model_per_100km"] = trips["kwh_per_100km"].to_numpy() - left["kwh_per_100km"].to_numpy()
    place = [log.trip_names.index(name) for name in trips["name"]]
    against = {k: (u, x[place]) for k, (u, x) in conditions(problem).items()
               if k in ("speed in motion", "outside temperature", "mass")}  # fmt: skip
    sections = [
        Section(
            "Where the energy goes",
            "Forces count at the wheel; the driveline's loss is what its efficiency makes of their sum. What the causes "
            "leave of the measured energy is unexplained; its interval has the noise of the trips besides.",
            {"waterfall": (lambda: waterfall(whole), "Bars of energy by cause that add up to the measured energy.",
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
        part = found.about[found.about["level"] == level]
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
