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
_LAST = {UNEXPLAINED: 1, TOTAL: 2}


def fleet_ledger(
    records: Sequence[Mapping[str, Any]], *, price: float | None = None
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Energy by cause at the levels fleet, type, vehicle and week, and what is no part of the sum.

    Each block adds up to the measured energy of its vehicles exactly: sums of vehicles' ledgers, each of which does.
    Intervals: the vehicles' errors are taken as independent, so that half-widths add in quadrature. Vehicles without a
    ledger (refused, or measured before the battery) are in no block; trips without a date in no week.

    **Returns:** `LEDGER_COLUMNS`, and km, hours, trips, kWh measured, regenerated, by auxiliary loads, while parked.
    """
    causes: dict[tuple[str, str], dict[str, np.ndarray]] = {}
    facts: dict[tuple[str, str], np.ndarray] = {}
    for r in (r for r in records if r.get("ledger")):
        for row in r["ledger"]["rows"]:
            error = (row["kwh"] - row["lower"]) ** 2, (row["upper"] - row["kwh"]) ** 2
            for block in _blocks(r, row):
                sums = causes.setdefault(block, {}).setdefault(row["cause"], np.zeros(3))
                sums += [row["kwh"], *error]
        for row in r["ledger"]["about"]:
            for block in _blocks(r, row):
                known = facts.setdefault(block, np.zeros(len(_ABOUT)))
                known += [row[k] for k in _ABOUT]
    order = sorted(causes, key=lambda b: (_LEVELS.index(b[0]), b[1]))
    rows = []
    for level, name in order:
        km, total = (float(facts[level, name][_ABOUT.index(k)]) for k in ("km", "measured_kwh"))
        # what was measured last, what is unexplained before it, as in the ledger of one vehicle
        for cause, (kwh, down, up) in sorted(causes[level, name].items(), key=lambda x: _LAST.get(x[0], 0)):
            rows.append((
                level, name, cause, kwh, kwh - np.sqrt(down), kwh + np.sqrt(up),
                100.0 * kwh / km if km > 0 else np.nan, 100.0 * kwh / total if total else np.nan,
                np.nan if price is None else price * kwh,
            ))  # fmt: skip
    about = [(level, name, *facts[level, name].tolist()) for level, name in order]
    return pd.DataFrame(rows, columns=list(LEDGER_COLUMNS)), pd.DataFrame(about, columns=["level", "name", *_ABOUT])


def _blocks(r: Mapping[str, Any], row: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The blocks that a line of a vehicle's ledger belongs to."""
    if row["level"] == "week":
        return [("week", row["name"])]
    return [("fleet", "fleet"), ("type", r["type"]), ("vehicle", r["name"])]
