"""The page of a fleet: vehicles that differ, effects by type, the ledger, bad logs."""

import datetime
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from hdev_jax.many import FleetResult
from hdev_jax.report import names, words
from hdev_jax.report.energy.figures import by_week, label
from hdev_jax.report.energy.flow import CAPTION as FLOW
from hdev_jax.report.energy.flow import energy_flow
from hdev_jax.report.energy.page import Page, Section, Table, span, table_of
from hdev_jax.report.many.figures import condition_curves, effects_map, time_line

__all__ = ["fleet_page", "fleet_pieces", "fleet_text"]

MOST_LINES = 10  # of a list in the answer
MOST_NAMED = 3  # effects that the answer gives with how many vehicles they were named in


def fleet_pieces(result: FleetResult) -> list[tuple[str, bool]]:
    """The answer: how many vehicles, which differ, what types show, how many could not be used."""
    s = result.summary
    counts, unlike = s["counts"], s["unlike"]
    pieces = [(f"{words.count(counts['done'], 'vehicle')} diagnosed", False)]
    for status, what in (
        ("suspect", "with a unit or sign in doubt"), ("refused", "refused"), ("failed", "failed")
    ):  # fmt: skip
        if counts[status]:
            pieces.append((f", {counts[status]} {what}", False))
    changed = sorted({e["vehicle"] for e in unlike if e["kind"] == "change"})
    differ = sorted({e["vehicle"] for e in unlike if e["kind"] == "level"})
    found = [e for e in s["effects"] if e["found"]]
    pieces.append(("; ", False))
    if changed:
        pieces.append((f"{words.count(len(changed), 'vehicle')} changed", True))
        pieces.append((f" ({_few(changed)})", False))
    if differ:
        pieces.append((", " if changed else "", False))
        pieces.append((f"{words.count(len(differ), 'vehicle')} differ{'s' if len(differ) == 1 else ''} from the "
                       "others of the type", True))  # fmt: skip
        pieces.append((f" ({_few(differ)})", False))
    if not changed and not differ:
        asked = {"for_a_change": "changed", "against_type": "differs from its type"}
        none = " or ".join(what for k, what in asked.items() if s["tested"][k])
        pieces.append((f"no vehicle {none}" if none else "", True))
        if not s["tested"]["for_a_change"]:
            pieces.append((", and changes were not looked for" if none else "changes were not looked for", not none))
    if found:
        shown = list(dict.fromkeys(f"{names.effect(e['id'])} ({e['type']})" for e in found))
        pieces += [("; shown by a type's vehicles together: ", False), (_few(shown), True)]
    if own := Counter(e["id"] for v in s["vehicles"] for e in v.get("effects", ()) if e["counts_in_fleet"]):
        often = ", ".join(f"{names.effect(k)} ({n})" for k, n in own.most_common(MOST_NAMED))
        pieces += [("; named most often from the vehicles' own logs: ", False), (often, True)]
    pieces.append((".", False))
    return pieces


def _few(items: Sequence[str]) -> str:
    return ", ".join(items[:6]) + (f" and {len(items) - 6} more" if len(items) > 6 else "")


def fleet_text(result: FleetResult) -> str:
    """The answer as the command prints it."""
    s = result.summary
    lines = ["".join(text for text, _ in fleet_pieces(result))]
    if s["unlike"]:
        lines += ["", "vehicles that differ, by cost"]
        for e in s["unlike"][:MOST_LINES]:
            cost = "" if e["kwh_per_day"] is None else f", {e['kwh_per_day']:+.3g} kWh a day"
            since = f" since {_since(e)}" if e["kind"] == "change" else " than its like"
            lines.append(f"  {e['vehicle']}: {e['coefficient']} {_change(e)}{since}{cost} (q {e['q']:.2g})")
    if found := [e for e in s["effects"] if e["found"]]:
        lines += ["", "effects shown by a type's vehicles together"]
        for e in found[:MOST_LINES]:
            size = words.plus_minus(e["value"], e["sd"], e["unit"])
            own = f"named by {e['named_in']} of them alone"
            lines.append(
                f"  {e['type']}: {e['id']}, {e['size']} {size}; {e['vehicles']} vehicles, {own} (q {e['q']:.2g})"
            )
    bad = [v for v in s["vehicles"] if v["status"] != "done"]
    if bad:
        lines += ["", "not diagnosed"] + [f"  {v['name']}: {v['message']}" for v in bad[:MOST_LINES]]
        if len(bad) > MOST_LINES:
            lines.append(f"  and {len(bad) - MOST_LINES} more, in fleet.csv")
    return "\n".join([*lines, *(f"note: {n}" for n in s["notes"])])


def _change(e: Mapping[str, Any]) -> str:
    return words.number(e["difference"]) if e["percent"] is None else words.percent(e["percent"])


def _date(seconds: float | None) -> str:
    return "" if seconds is None else datetime.datetime.fromtimestamp(seconds, datetime.UTC).strftime("%Y-%m-%d")


def _since(e: Mapping[str, Any]) -> str:
    return _date(e["since"]) or f"trip {e['since_trip']}"


def fleet_page(result: FleetResult, command: str, *, price: float | None = None, synthetic: bool = False) -> Page:
    """The page of a fleet's result."""
    s, records = result.summary, result.records
    done = [r for r in records if r["status"] == "done"]
    rows, about = result.tables["ledger"], result.tables["about"]
    whole = pd.DataFrame(rows[rows["level"] == "fleet"])
    weeks = pd.DataFrame(rows[rows["level"] == "week"])
    of_fleet = pd.DataFrame(about[about["level"] == "fleet"])
    km, kwh, back = (float(np.sum(of_fleet[k].to_numpy(float))) for k in ("km", "measured_kwh", "regenerated_kwh"))
    sections = [
        Section(
            "Vehicles that differ from their type, or changed",
            "Each coefficient of a vehicle is compared with the prediction from the others of its type, and with its "
            "own earlier value. What all of a type do alike in a week (a season) is removed first. Ranked by cost."
            + _none(s),
            {"time_line": (lambda: time_line(done, s["unlike"]), "Coefficients of each vehicle week by week.",
                           "Estimates of each week alone; thick where a change was found.")},
            (_unlike(s["unlike"]),) if s["unlike"] else (),
        ),
        Section(
            "Effects, vehicle by vehicle",
            _bound(s["highest_q_in_vehicle"]),
            {"effects_map": (lambda: effects_map(done, s["effects"]), "A map of effects by vehicle.",
                             "First-order size of each effect that the sheet does not declare, in standard errors. "
                             "Grey: not estimated; the log lacks what it needs, or the model has loads that switch.")},
            (_effects(s["effects"]),) if s["effects"] else (),
        ),
        Section(
            "Where the energy goes",
            "Sums of the vehicles' ledgers; each of these adds up to the vehicle's measured energy.",
            {"energy_flow": (lambda: energy_flow(whole, back, km, title="Where the fleet's energy goes"),
                             "Bands of energy from the battery through loads and losses to the wheels, and back.",
                             FLOW),
             "weeks": (lambda: by_week(weeks) if len(weeks) else None, "Stacked bars of energy by cause for each week.",
                       "Energy by cause, week by week (ISO 8601).")},
            (_ledger(whole, price),) if len(whole) else (),
        ),
        Section(
            "Consumption", "",
            {"conditions": (lambda: condition_curves(done), "Consumption against speed, temperature and mass.",
                            "Each dot is a trip; lines are means of as many trips each.")},
            (),
        ),
        Section("Every vehicle", "", {}, (_vehicles(result.tables["fleet"]),)),
    ]  # fmt: skip
    if s["coefficients"]:
        how = "Each vehicle counts as one estimate, made without the sheet's prior."
        sections.insert(4, Section("Coefficients by type", how, {}, (_pooled(s["coefficients"]),)))
    bad = [v for v in s["vehicles"] if v["status"] != "done"]
    if bad:
        cells = [(v["name"], v["status"], v["message"]) for v in bad]
        table = Table("Not diagnosed", ("Vehicle", "Status", "Why"), cells, 3, "fleet.csv")
        sections.insert(4, Section("Logs that could not be used", "", {}, (table,)))
    cost = sum(e["kwh_per_day"] or 0.0 for e in s["unlike"])
    tiles = [
        ("Vehicles", str(s["counts"]["done"]), f"of {len(records)} logs"),
        ("Distance", words.number(km, 4, "km"), words.number(kwh, 4, "kWh") + " measured"),
        ("Consumption", words.number(100 * kwh / km if km else None, 3, "kWh/100 km"), "of the whole fleet"),
        ("Cost of the differences", words.number(cost, 3, "kWh a day"), words.count(len(s["unlike"]), "difference")),
    ]  # fmt: skip
    if price is not None:
        tiles.append(("Cost", words.number(price * kwh, 4), f"at {price:g} a kWh"))
    return Page("fleet", words.count(len(records), "vehicle"), "a fleet", synthetic, fleet_pieces(result), tiles,
                sections, s["notes"], command, "each calibrated and diagnosed on its own log")  # fmt: skip


def _none(s: Mapping[str, Any]) -> str:
    """What is said where no vehicle is in the table."""
    if s["unlike"]:
        return ""
    return " None was found." if s["tested"]["vehicles_times_coefficients"] else " No log was long enough for a test."


def _bound(q: float) -> str:
    own = f"those with q up to {q:.2g} count in the fleet" if q > 0 else "none counts in the fleet"
    return f"Adjusted for all types and effects together. Of the vehicles' own finds {own}."


def _unlike(unlike: Sequence[Mapping[str, Any]]) -> Table:
    rows = [
        (e["vehicle"], names.coefficient(e["coefficient"])[0], "changed" if e["kind"] == "change" else "differs",
         _since(e) if e["kind"] == "change" else "–",
         f"{_date(e['since_low'])} … {_date(e['since_high'])}" if e["since"] else "–",
         _change(e), words.number(e["kwh_per_day"]), f"{e['q']:.2g}")
        for e in unlike
    ]  # fmt: skip
    head = ("Vehicle", "Coefficient", "How", "Since", "as likely", "by", "kWh a day", "q")
    return Table("Vehicles that differ", head, rows, 5, "unlike.csv")


def _effects(effects: Sequence[Mapping[str, Any]]) -> Table:
    rows = [
        (e["type"], names.effect(e["id"]), words.plus_minus(e["value"], e["sd"], e["unit"]), str(e["vehicles"]),
         str(e["named_in"]), f"{e['q']:.2g}", "yes" if e["found"] else "no")
        for k, e in enumerate(effects) if e["found"] or k < MOST_LINES
    ]  # fmt: skip
    head = ("Type", "Effect", "Size", "Vehicles", "named alone", "q", "shown")
    caption = f"Effects added up over the vehicles of a type: the clearest of {len(effects)}, all in effects.csv"
    return Table(caption, head, rows, 2, "effects.csv")


def _pooled(pooled: Sequence[Mapping[str, Any]]) -> Table:
    rows = [
        (p["type"], names.coefficient(p["name"])[0], words.plus_minus(p["mean"], p["sd"], p["unit"]),
         words.number(p["between"]), words.plus_minus(p["prior_value"], p["prior_sd"]), str(p["vehicles"]))
        for p in pooled
    ]  # fmt: skip
    head = ("Type", "Coefficient", "Mean", "sd over vehicles", "Sheet", "Vehicles")
    return Table("Coefficients", head, rows, 2, "coefficients.csv")


def _vehicles(frame: pd.DataFrame) -> Table:
    columns = {"name": "Vehicle", "type": "Type", "status": "Status", "effects": "Effects", "trips": "Trips",
               "km": "km", "rmse_before": "RMSE before", "rmse_after": "after"}  # fmt: skip
    effects = [", ".join(map(names.effect, ids.split())) for ids in frame["effects"].fillna("")]
    shown = frame.assign(type=frame["type"].fillna(""), effects=effects)
    return table_of(shown, "Vehicles", columns, text=4, file="fleet.csv")


def _ledger(whole: pd.DataFrame, price: float | None) -> Table:
    shown = whole.assign(
        cause=[label(c) for c in whole["cause"]],
        kwh_=[span(a, b, c) for a, b, c in zip(whole["kwh"], whole["lower"], whole["upper"], strict=True)],
    )
    columns = {"cause": "Cause", "kwh_": "kWh (90 % interval)", "kwh_per_100km": "kWh/100 km",
               "share_percent": "share [%]"}  # fmt: skip
    columns |= {} if price is None else {"cost": "cost"}
    return table_of(shown, "Energy of the fleet by cause", columns, file="ledger.csv")
