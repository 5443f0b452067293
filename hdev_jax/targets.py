"""What a log is compared with: each target's unit, how its rows sum, where the chain to it begins and ends."""

from dataclasses import dataclass
from typing import Any, Literal

__all__ = ["TARGETS", "Target", "TargetName", "as_watts", "target_of"]

TargetName = Literal["energy_wh", "battery_power_kw", "motor_torque_nm", "traction_force_n"]


@dataclass(frozen=True)
class Target:
    """A measured column that the chain predicts.

    **Fields:**

    - `label`: what it is called. `axis`: what it is called as a quantity by row.
    - `weight`: of a row in a sum. Power is weighted by duration, force and torque by distance (a torque turns with the
      wheels, so in one gear its sum is work); energy is summed as it is.
    - `total`: what the sum is called. `per_kwh`: how much of it is a kWh; None where it is no energy.
    - `entries`: the entries of the chain before it, from the road on. `last_stage`: the last stage before it.
    - `columns`: columns of a log that measure it, the nearest first.
    - `follows`: channels that follow from it and must not be inputs (the current is measured power over voltage).
    - `derived_from`: a channel from which it can be computed with the sheet's ratios.
    """

    name: TargetName
    unit: str
    label: str
    axis: str
    weight: Literal["row", "duration", "distance"]
    per_kwh: float | None
    total: str
    entries: tuple[Literal["road", "wheel", "shaft"], ...]
    last_stage: Literal["road", "driveline", "battery"]
    columns: tuple[str, ...]
    follows: tuple[str, ...]
    derived_from: str = ""

    @property
    def of_battery(self) -> bool:
        """Whether it is measured at the battery, with loads and losses before it."""
        return self.last_stage == "battery"

    def __str__(self) -> str:
        return self.name


# nearest the battery first
_ALL = (
    Target(
        "energy_wh", "Wh", "battery energy", "energy per row", "row", 1e3, "energy",
        ("road", "wheel", "shaft"), "battery", columns=("energy_wh", "battery_power_w"), follows=("current_a",),
    ),
    Target(
        "battery_power_kw", "kW", "battery power", "battery power", "duration", 3600.0, "energy",
        ("road", "wheel", "shaft"), "battery", columns=("battery_power_w", "energy_wh"), follows=("current_a",),
    ),
    Target(
        "motor_torque_nm", "Nm", "motor torque", "motor torque", "distance", None, "mean torque", ("road", "wheel"),
        "driveline", columns=("motor_torque_nm",), follows=("motor_torque_nm", "current_a"),
    ),
    Target(
        "traction_force_n", "N", "traction force", "traction force", "distance", 3.6e6, "work", ("road",), "road",
        columns=("traction_force_n",), follows=("traction_force_n", "motor_torque_nm", "current_a"),
        derived_from="motor_torque_nm",
    ),
)  # fmt: skip
TARGETS: dict[str, Target] = {t.name: t for t in _ALL}


def target_of(target: str | Target) -> Target:
    """The record of a target, by its name or itself. Raises `ValueError` for a name that is none."""
    if isinstance(target, Target):
        return target
    if target not in TARGETS:
        raise ValueError(f"unknown target {target!r}; one of {', '.join(TARGETS)} is expected")
    return TARGETS[target]


def as_watts(target: str | Target, values: Any, duration_s: Any) -> Any:
    """Values of a battery's target, by row, as powers [W]; `duration_s` of each row [s]."""
    return values * 1e3 if target_of(target).weight != "row" else values * 3600.0 / duration_s
