"""What is changed in a simulator and not in the sheet: its words, its size, and what counts as its right name."""

from collections.abc import Mapping
from dataclasses import dataclass

from hdev_jax.physics import LIBRARY

__all__ = ["FORMS", "INSTRUMENTS", "PAYLOAD", "PLANTS", "Plant"]

PAYLOAD = "mass_scale"
# effects that say that a channel is measured wrongly
INSTRUMENTS = frozenset(k for k, c in LIBRARY.items() if c.instrument)
# The form of the efficiency, which both simulators have and a sheet of one number lacks; never false.
# FASTSim: driving efficiency by load, regenerating efficiency constant. SUMO: one efficiency for each direction.
FORMS: Mapping[str, frozenset[str]] = {
    "fastsim": frozenset({
        "battery_resistance", "copper_loss", "efficiency_scale", "inverter_loss", "iron_loss", "part_load",
        "regen_efficiency",
    }),
    "sumo": frozenset({"efficiency_scale", "regen_efficiency"}),
}  # fmt: skip


@dataclass(frozen=True)
class Plant:
    """One change.

    **Arguments:** `words`, for tables; `size`, how large, in `unit`; `names`, the library's effects that are right;
    `parameter`, whose value is `size` where such an effect is found; `coefficients`, declared ones that may take the
    change instead, and `sign`, the way they then move; `share`, whether a coefficient moves by this share of itself;
    `seen_by`, what may be measured besides battery power so that it still acts on the residual; `missing`, the
    channel that is left out of the log.
    """

    words: str
    size: float = 0.0
    unit: str = ""
    names: frozenset[str] = frozenset()
    parameter: str = ""
    coefficients: tuple[str, ...] = ()
    sign: int = 0
    share: bool = False
    seen_by: tuple[str, ...] = ("none",)
    missing: str = ""


EVERYWHERE = ("none", "force", "torque")
EFFICIENCIES = ("driveline.efficiency", "machine.motoring_efficiency", "machine.regenerating_efficiency")
PLANTS: Mapping[str, Plant] = {
    "nothing": Plant("nothing", seen_by=EVERYWHERE),
    "payload": Plant("mass +10 %", 0.10, "1", frozenset({PAYLOAD}), "scale"),
    "rolling": Plant("c_rr +20 %", 0.20, "1", coefficients=("road.c_rr",), sign=1, share=True),
    "drag": Plant("drag area +15 %", 0.15, "1", coefficients=("road.cda_m2",), sign=1, share=True),
    "auxiliaries": Plant(
        "auxiliaries +1.5 kW", 1500.0, "W", frozenset({"auxiliary_power"}), "power_w", seen_by=EVERYWHERE
    ),
    "regeneration": Plant(
        "regenerated power halved", 0.5, "1", frozenset({"regen_efficiency"}), "share",
        ("machine.regenerating_efficiency", "driveline.regenerating_efficiency"), -1, seen_by=EVERYWHERE,
    ),
    "cutoff": Plant(
        "no regeneration below 4 m/s", 4.0, "m/s", frozenset({"regen_cutoff"}), "speed_mps", seen_by=EVERYWHERE
    ),
    "efficiency": Plant(
        "efficiency -10 %", 0.10, "1", frozenset({"efficiency_scale"}), "", EFFICIENCIES, -1, seen_by=EVERYWHERE
    ),
    "slope": Plant("slope not in the log", missing="grade_rad"),
    "headwind": Plant("headwind of 4 m/s", 4.0, "m/s", frozenset({"constant_headwind"}), "speed_mps"),
}  # fmt: skip
