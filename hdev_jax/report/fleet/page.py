"""The page of a simulated fleet: figures, what the sheets declare and miss, and a table to compare with the papers."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hdev_jax.fleet.config import FleetConfig
from hdev_jax.fleet.tally import Tally
from hdev_jax.report.canvas import png, style
from hdev_jax.report.fleet import figures as fleet_figures
from hdev_jax.report.fleet.sources import CONSUMPTION, PAPER_FLEET_PE, PAPER_MODEL_PE
from hdev_jax.report.page import write_page

__all__ = ["fleet_summary", "fleet_text", "write_fleet_report"]

_KINDS = {
    "tractor": "tractors with trailers",
    "truck": "rigid trucks",
    "bus": "city buses",
    "articulated": "articulated buses",
}


def fleet_summary(fleet: Sequence[Tally], config: FleetConfig) -> dict[str, Any]:
    """`fleet.json`: sizes, consumption, errors of the sheets, gears, by vehicle and over all; everything synthetic."""
    vehicles = {t.variant.id: _vehicle(t) for t in fleet}
    total = {k: sum(t.sums[k] for t in fleet) for k in fleet[0].sums}
    rows = sum(t.rows for t in fleet)
    geared = [t for t in fleet if t.variant.gears > 1]
    return {
        "schema": "hdev-fleet/1",
        "synthetic": True,
        "seed": config.seed,
        "rows": rows,
        "segments": rows - sum(t.halts for t in fleet),
        "halts": sum(t.halts for t in fleet),
        "routes": sum(t.trips for t in fleet),
        "vehicles": len(fleet),
        "km": total["km"],
        "hours": total["hours"],
        "kwh_per_km": total["energy_wh"] / 1e3 / total["km"],
        "tabular": {
            "pe_percent": _error(total, "tabular_wh"),
            "rmse": float(np.sqrt(total["tabular_wh_squares"] / rows)),
        },
        "tabular_equation_4": {
            "pe_percent": _error(total, "tabular_wheel_wh"),
            "rmse": float(np.sqrt(total["tabular_wheel_wh_squares"] / rows)),
        },
        "paper": {"pe_percent": PAPER_FLEET_PE, "models": PAPER_MODEL_PE},
        "noise_rmse": float(np.sqrt(total["noise_squares"] / rows)),
        "ambiguous_gear_share": (
            sum(t.sums["ambiguous"] for t in geared) / sum(t.rows for t in geared) if geared else 0.0
        ),
        "by_vehicle": vehicles,
    }


def fleet_text(summary: dict[str, Any], out: Path) -> str:
    """What `hdev simulate` prints."""
    lines = [
        f"synthetic fleet: {summary['vehicles']} vehicles, {summary['routes']:,} routes, "
        f"{summary['segments']:,} segments and {summary['halts']:,} halts, {summary['km']:,.0f} km, "
        f"{summary['kwh_per_km']:.2f} kWh/km",
        f"energy by the sheets: {summary['tabular']['pe_percent']:+.1f} % over the fleet "
        f"(paper: {PAPER_FLEET_PE:+.1f} %), RMSE {summary['tabular']['rmse']:.1f} Wh a row",
    ]
    for v in summary["by_vehicle"].values():
        if v["model"]:
            lines.append(
                f"  model {v['model']}: {v['tabular']['pe_percent']:+.2f} % (paper: {v['paper_pe_percent']:+.2f} %), "
                f"RMSE {v['tabular']['rmse']:.1f} Wh"
            )
    return "\n".join([*lines, str(out / "report.html")])


def _error(sums: dict[str, float], name: str) -> float:
    return 100 * (sums[name] / sums["energy_wh"] - 1)


def _vehicle(t: Tally) -> dict[str, Any]:
    moving = t.rows - t.halts
    return {
        "name": t.variant.name,
        "model": t.variant.model or None,
        "usage": t.variant.usage,
        "gears": t.variant.gears,
        "rows": t.rows,
        "routes": t.trips,
        "km": t.sums["km"],
        "mean_speed_kmh": t.sums["km"] / t.sums["hours"],
        "kwh_per_km": t.kwh_km,
        "tabular": {"pe_percent": t.error_percent(), "rmse": t.rmse()},
        "tabular_equation_4": {"pe_percent": t.error_percent("tabular_wheel_wh"), "rmse": t.rmse("tabular_wheel_wh")},
        "paper_pe_percent": PAPER_MODEL_PE.get(t.variant.model),
        "gear_rows": [int(n) for n in t.gears],
        "ambiguous_gear_share": t.sums["ambiguous"] / t.rows,
        "gear_as_driven_share": t.sums["same_gear"] / max(moving, 1),
        "energy_kwh_by_effect": {k: x / 1e3 for k, x in t.parts.items()},
        "not_declared": t.effects,
    }


def write_fleet_report(
    fleet: Sequence[Tally], config: FleetConfig, command: str, seconds: float, directory: Path
) -> None:
    """Write `report.html` and `figures/*.png` into a directory."""
    with style():
        figures = {
            name: getattr(fleet_figures, name)(fleet)
            for name in ("routes", "cycles", "consumption", "gears", "energy", "errors")
        }
        images = {name: png(fig) for name, fig in figures.items() if fig is not None}
    summary = fleet_summary(fleet, config)
    context = {
        "synthetic": True,
        "vehicle": f"a fleet of {len(fleet)} vehicles",
        "what": "simulated, with its truth",
        "s": summary,
        "rows": [{**_vehicle(t), "id": t.variant.id, "kind": _KINDS[fleet_figures.kind(t)]} for t in fleet],
        "published": [
            {"kind": _KINDS[k], "items": CONSUMPTION[k]}
            for k in _KINDS
            if any(fleet_figures.kind(t) == k for t in fleet)
        ],
        "switches": [(k, x) for k, x in config.table()["truth"].items()],
        "instruments": list(config.table()["log"].items()),
        "gearing": config.table()["gears"],
        "command": command,
        "seconds": seconds,
    }
    write_page("fleet.html.j2", context, images, directory)
