"""Road load from battery power alone, beside that from the force: logs in which the force is measured, and withheld.

The same sheet, trips and split twice: once the traction force is the target, once it (or the torque that it comes from)
is taken out of the log, and rolling resistance and drag area come through the efficiency from the battery's power.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from experiments.measured.compared import MOVED
from experiments.measured.tables import found_ids, named, table

__all__ = ["PAIRS", "Pair", "load_rows", "road_load"]

Result = Mapping[str, Any]
COEFFICIENTS = ("road.c_rr", "road.cda_m2")


@dataclass(frozen=True)
class Pair:
    """Two runs on one log: `force`, whose target is the force, and `power`, which has none, with its sheet, the adapter
    that it is made from, and the columns that are withheld."""

    words: str
    force: str
    power: str
    sheet: str
    adapter: Path
    columns: tuple[str, ...]


PAIRS = (
    Pair(
        "Kia Niro, trip 1", "niro_road", "niro_power", "configs/vehicles/kia_niro_energy.toml",
        Path("configs/adapters/kia_niro.toml"), ("motor_torque_nm", "motor_speed_radps"),
    ),
    Pair(
        "ZTBus, fold 1", "ztbus_road", "ztbus_power", "configs/vehicles/ztbus_road.toml",
        Path("configs/adapters/ztbus.toml"), ("traction_force_n",),
    ),
)  # fmt: skip


def road_load(results: Mapping[str, Result]) -> list[str]:
    """The section of the page, of the pairs that were run."""
    there = [p for p in PAIRS if p.force in results and p.power in results]
    if not there:
        return []
    lines = [
        "## Road load without the force", "",
        "The traction force (of the Niro, the torque) is taken out of the log: rolling resistance and drag area come",
        "from battery power and one efficiency. Beside it what the same sheet gives where the force is the target.",
        f"*Agree*: within {MOVED:g} standard deviations of their difference.", "",
        *table(["log", "coefficient", "from the force", "from battery power", "difference [sd]", "agree"],
               [row for p in there for row in load_rows(p, results)]),
        "",
    ]  # fmt: skip
    for p in there:
        r = results[p.power]
        before, after = (r[k]["test"]["rmse"] for k in ("before", "after"))
        found = named(found_ids(r)) if r["effects"] else "nothing"
        lines.append(
            f"- **{p.words}**, without the force: test RMSE {before:.2f} → {after:.2f} kW; found: {found}. "
            f"With it: {named(found_ids(results[p.force])) if results[p.force]['effects'] else 'nothing'}."
        )
    return lines


def load_rows(pair: Pair, results: Mapping[str, Result]) -> list[list[str]]:
    """A row for each coefficient that both runs fitted: both values with their standard deviations, and whether they
    agree."""
    a, b = (results[name]["coefficients"] for name in (pair.force, pair.power))
    rows = []
    for name in COEFFICIENTS:
        if name in a and name in b:
            (x, sd_x), (y, sd_y) = a[name], b[name]
            away = (y - x) / math.hypot(sd_x, sd_y)
            rows.append([
                pair.words, f"`{name}`", f"{x:.4g} ± {sd_x:.2g}", f"{y:.4g} ± {sd_y:.2g}", f"{away:+.1f}",
                "yes" if abs(away) <= MOVED else "no",
            ])  # fmt: skip
    return rows
