"""The result of a fleet: the records of its vehicles, and what they show together."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import pandas as pd

from hdev_jax.diagnosis.settings import FLEET_SETTINGS
from hdev_jax.many.evidence import Again, by_type, effects_of_types, families
from hdev_jax.many.ledger import fleet_ledger
from hdev_jax.many.unlike import changes, levels, pooled_coefficients
from hdev_jax.many.vehicle import plain
from hdev_jax.physics import LIBRARY, Effect

__all__ = ["FleetResult", "fleet_result"]

_SHOWN = ("name", "type", "sheet", "status", "message", "target", "unit", "rows", "trips", "km", "hours", "verdict",
          "before", "after", "effects", "coefficients", "notes", "seconds")  # fmt: skip


@dataclass(frozen=True)
class FleetResult:
    """The result of a fleet. `summary`: what fleet.json holds; `tables`: by name; `records`: all of each vehicle."""

    summary: dict[str, Any]
    tables: dict[str, pd.DataFrame]
    records: list[dict[str, Any]]


def fleet_result(
    records: Sequence[Mapping[str, Any]], *, fdr: float, seed: int, price: float | None = None,
    notes: Sequence[str] = (), again: Again | None = None, library: Mapping[str, type[Effect]] = LIBRARY,
) -> FleetResult:  # fmt: skip
    """The result of a fleet from the records of its vehicles, in the order of the vehicles' names.

    **Arguments:** `records`: a `vehicle_record` of each vehicle. `fdr`: the highest adjusted p-value. `price`: of a
    kWh. `notes`: what was left out. `again`, `library`: as in `effects_of_types`.

    **Returns:** a `FleetResult`. Its summary has `vehicles` (a short record of each), `counts` by status, `effects` by
    type, `coefficients` pooled by type, `unlike` (vehicles that differ from the others of their type, or changed, by
    cost) and the `ledger` of the whole fleet.
    """
    settings = replace(FLEET_SETTINGS, fdr=fdr)
    each = [dict(r) for r in sorted(records, key=lambda r: r["name"])]
    bound = families(each, fdr)
    for r in each:
        for e in r.get("effects", ()):
            e["counts_in_fleet"] = e["q_value"] <= bound
    effects = effects_of_types(each, settings, again, library)
    pooled = pooled_coefficients(each, settings)
    apart, changed = levels(each, settings), changes(each, settings, seed)
    unlike = [*apart, *changed]
    named = [e for e in unlike if e["found"]]
    named.sort(key=lambda e: (-abs(e["kwh_per_day"] or 0.0), e["q"], e["vehicle"]))
    rows, about = fleet_ledger(each, price=price)
    groups = by_type(each)
    few = [k for k, v in groups.items() if len(v) < settings.least_vehicles]
    said = list(notes)
    if few:
        said.append(
            f"{len(few)} of {len(groups)} types have fewer than {settings.least_vehicles} vehicles: their vehicles are "
            "not compared with each other"
        )
    undated = sum((r.get("ledger") or {}).get("undated", 0) for r in each)
    if undated:
        said.append(f"{undated} trips have no date in their logs: no weekly table has them, and changes have no date")
    summary = {
        "schema": "hdev-vehicles/1",
        "counts": {k: Counter(r["status"] for r in each).get(k, 0) for k in ("done", "suspect", "refused", "failed")},
        "fdr": fdr, "highest_q_in_vehicle": bound,
        "vehicles": [{k: r[k] for k in _SHOWN if k in r} for r in each],
        "effects": effects,
        "coefficients": pooled,
        "unlike": named,
        "tested": {"types_times_effects": len(effects), "vehicles_times_coefficients": len(unlike),
                   "against_type": len(apart), "for_a_change": len(changed)},
        "ledger": [r for r in rows.to_dict("records") if r["level"] in ("fleet", "type")],
        "notes": said,
    }  # fmt: skip
    tables = {
        "fleet": _vehicles(each), "effects": pd.DataFrame(effects), "unlike": pd.DataFrame(unlike),
        "coefficients": _coefficients(pooled), "ledger": rows, "about": about,
    }  # fmt: skip
    return FleetResult(plain(summary), tables, each)


def _vehicles(each: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """A line for each vehicle, bad logs included."""
    out = []
    for r in each:
        line = {k: r.get(k) for k in ("name", "type", "status", "message", "rows", "trips", "km", "hours", "verdict")}
        for when in ("before", "after"):
            line[f"rmse_{when}"] = (r.get(when) or {}).get("rmse")
            line[f"pe_percent_{when}"] = (r.get(when) or {}).get("pe_percent")
        line["effects"] = " ".join(e["id"] for e in r.get("effects", ()))
        line["effects_that_count"] = " ".join(e["id"] for e in r.get("effects", ()) if e["counts_in_fleet"])
        for name, c in (r.get("coefficients") or {}).items():
            line[name], line[f"{name}_sd"] = c["value"], c["sd"]
        out.append({**line, "seconds": r["seconds"]})
    return pd.DataFrame(out)


def _coefficients(pooled: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """A line for each vehicle and coefficient: its own estimate, and drawn towards its type's."""
    return pd.DataFrame(
        [
            {"type": p["type"], "name": p["name"], "unit": p["unit"], "vehicle": v, **own,
             "type_mean": p["mean"], "type_sd": p["sd"], "between": p["between"]}
            for p in pooled for v, own in p["by_vehicle"].items()
        ]
    )  # fmt: skip
