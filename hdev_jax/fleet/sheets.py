"""The sheets of a simulated fleet: what a maker declares of each vehicle, as a TOML file with its efficiency map."""

from pathlib import Path

import numpy as np

from hdev_jax.fleet.config import FleetConfig
from hdev_jax.fleet.efficiency import efficiency_map
from hdev_jax.fleet.hidden import ROTATING_MASS_FACTOR
from hdev_jax.fleet.variants import Variant

__all__ = ["map_text", "sheet_text", "write_sheet"]


def sheet_text(v: Variant, config: FleetConfig) -> str:
    """The sheet (contract, section 2) of this variant; its map is `<id>_map.csv` beside it."""
    c_rr, cda = (v.c_rr[0], v.cda_m2[0]) if config.truth.tabular_error else (v.true_c_rr, v.true_cda_m2)
    ratios = ", ".join(f"{r:g}" for r in v.gear_ratios)
    motor = f"{v.power_kw:g} kW, {v.torque_nm:g} Nm, {v.max_speed_radps:g} rad/s at most"
    letter = f", model {v.model}" if v.model else ""
    return f"""\
name = "synthetic {v.name}{letter}"
notes = "invented; empty {v.mass_kg[0]:g} kg, full {v.mass_kg[1]:g} kg; {motor}"
mass_kg = {v.mass_kg[1]:.1f}

[road]
c_rr = {{ value = {c_rr:g}, sd = {v.c_rr[1]:g} }}
cda_m2 = {{ value = {cda:g}, sd = {v.cda_m2[1]:g} }}
rotating_mass_factor = {ROTATING_MASS_FACTOR:g}

[driveline]
map = "{v.id}_map.csv"
gear_ratios = [{ratios}]
final_drive = {v.final_drive:g}
wheel_radius_m = {v.wheel_radius_m:g}

[battery]
auxiliary_w = {v.auxiliary_w:.1f}
"""


def map_text(v: Variant) -> str:
    """The efficiency map as CSV: gear, motor_speed_radps, motor_torque_nm, efficiency."""
    gears, speeds, torques, values = efficiency_map(v)
    grid = np.meshgrid(gears, speeds, torques, indexing="ij")
    lines = [
        f"{g:.0f},{w:.8g},{t:.8g},{e:.5f}" for g, w, t, e in zip(*(x.ravel() for x in (*grid, values)), strict=True)
    ]
    return "\n".join(["gear,motor_speed_radps,motor_torque_nm,efficiency", *lines]) + "\n"


def write_sheet(v: Variant, config: FleetConfig, folder: Path) -> None:
    """Write `<id>.toml` and `<id>_map.csv` into a folder that is there."""
    (folder / f"{v.id}.toml").write_text(sheet_text(v, config), encoding="utf-8")
    (folder / f"{v.id}_map.csv").write_text(map_text(v), encoding="utf-8")
