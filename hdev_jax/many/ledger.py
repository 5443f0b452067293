"""The ledger of a fleet: kWh by cause of the fleet, each type, vehicle and week, from the ledgers of the vehicles."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from hdev_jax.energy.ledger import TOTAL, UNEXPLAINED

__all__ = ["LEDGER_COLUMNS", "fleet_ledger"]

LEDGER_COLUMNS = ("level", "name", "cause", "kwh", "lower", "upper", "kwh_per_100km", "share_percent", "cost")
_ABOUT = ("km", "hours", "trips", "measured_kwh", "regenerated_kwh", "auxiliary_kwh", "parked_kwh")
_LEVELS = ("fleet", "type", "vehicle", "week")


def fleet_ledger(
    records: Sequence[Mapping[str, Any]], *, price: float | None = None
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Energy by cause at the levels fleet, type, vehicle and week, and what is no part of the sum.

    Each block adds up to the measured energy of its vehicles exactly: sums of vehicles' ledgers, each of which does.
    Intervals: the vehicles' errors are taken as independent, so that half-widths add in quadrature. Vehicles without a
    ledger (refused, or measured before the battery) are in no block; trips without a date in no week.

    **Returns:** `LEDGER_COLUMNS`, and km, hours, trips, kWh measured, regenerated, by auxiliary loads, while parked.
    """
    there = [r for r in records if r.get("ledger")]
    each = [{**row, "vehicle": r["name"], "type": r["type"]} for r in there for row in r["ledger"]["rows"]]
    abouts = [{**row, "vehicle": r["name"], "type": r["type"]} for r in there for row in r["ledger"]["about"]]
    if not each:
        return pd.DataFrame(columns=list(LEDGER_COLUMNS)), pd.DataFrame(columns=["level", "name", *_ABOUT])
    causes, facts = pd.DataFrame(each), pd.DataFrame(abouts)
    causes["down"], causes["up"] = (causes["kwh"] - causes["lower"]) ** 2, (causes["upper"] - causes["kwh"]) ** 2
    blocks, about = [], []
    for level in _LEVELS:
        part, fact = (pd.DataFrame(f[f["level"] == ("week" if level == "week" else "all")]) for f in (causes, facts))
        if part.empty:
            continue
        key = {"fleet": lambda f: "fleet", "week": lambda f: f["name"]}.get(level, lambda f, k=level: f[k])
        sums = part.assign(name=key(part)).groupby(["name", "cause"], sort=False)[["kwh", "down", "up"]].sum()
        block = sums.reset_index().assign(level=level)
        block["lower"] = block["kwh"] - np.sqrt(block["down"])
        block["upper"] = block["kwh"] + np.sqrt(block["up"])
        known = fact.assign(name=key(fact)).groupby("name", sort=True)[list(_ABOUT)].sum().reset_index()
        about.append(known.assign(level=level))
        km, total = (known.set_index("name")[c] for c in ("km", "measured_kwh"))
        block["kwh_per_100km"] = 100.0 * block["kwh"] / block["name"].map(km).replace(0.0, np.nan)
        block["share_percent"] = 100.0 * block["kwh"] / block["name"].map(total).replace(0.0, np.nan)
        block["cost"] = np.nan if price is None else price * block["kwh"]
        # what was measured last, what is unexplained before it, as in the ledger of one vehicle
        last = block["cause"].map({UNEXPLAINED: 1, TOTAL: 2}).fillna(0)
        blocks.append(block.assign(last=last).sort_values(["name", "last"], kind="stable"))
    rows = pd.concat(blocks, ignore_index=True)[list(LEDGER_COLUMNS)]
    return rows, pd.concat(about, ignore_index=True)[["level", "name", *_ABOUT]]
