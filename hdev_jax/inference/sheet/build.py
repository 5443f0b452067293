"""From a sheet to a vehicle: which coefficients an entry and a target use, and what is left aside, with the reason."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np

from hdev_jax.inference.maps.range import read_against_map
from hdev_jax.inference.parameters import Coefficient, ParameterTable
from hdev_jax.inference.sheet.schema import KEYS, SECTIONS, Declared, Key, effect_key
from hdev_jax.inference.sheet.sheet import Sheet
from hdev_jax.physics import (
    Driveline,
    Effect,
    EfficiencyMap,
    Grouped,
    Machine,
    Vehicle,
    at_null,
    most_group,
    unavailable,
)
from hdev_jax.physics.driveline import WHEEL_RADIUS_M
from hdev_jax.physics.effect import STAGES
from hdev_jax.physics.loads import Auxiliary
from hdev_jax.physics.road import Aero, Grade, Inertia, Rolling
from hdev_jax.physics.tyres import RollingLinear
from hdev_jax.physics.vehicle import Entry
from hdev_jax.segments import Segments
from hdev_jax.targets import TARGETS, TargetName

__all__ = ["Built", "build"]

_MEASURED = {
    "road": "neither traction force nor motor torque with motor speed is measured",
    "wheel": "the chain is entered at the measured traction force",
    "shaft": "the chain is entered at the measured motor torque",
}


@dataclass(frozen=True)
class Built:
    """What a sheet comes to for one log and target: the vehicle, its coefficients, and what was left out and why."""

    vehicle: Vehicle
    table: ParameterTable
    notes: list[str]


def build(
    sheet: Sheet, segments: Segments, entry: Entry, target: TargetName, *, vehicle_names: Sequence[str] = ()
) -> Built:
    """The vehicle for this log, entry (see `choose_entry`) and target. Only the sections in use are needed.

    **Arguments:** `segments`, for the channels and gears they have; `vehicle_names`, of the log's vehicle ids, for
    coefficients that are declared per vehicle.

    **Raises:** `InputError` for a key that is needed and missing, and a gear of the log that the sheet has no ratio
    for; `ValueError` for an entry behind the target.
    """
    if entry not in (able := TARGETS[target].entries):
        raise ValueError(f"{target} cannot be computed from entry {entry!r}; use one of {able}")
    return _Builder(sheet, segments, entry, target, tuple(vehicle_names)).build()


class _Builder:
    """One `build`: what is used becomes a leaf and rows of the table, the rest a note."""

    def __init__(self, sheet: Sheet, segments: Segments, entry: Entry, target: TargetName, names: tuple[str, ...]):
        self.sheet, self.segments, self.target = sheet, segments, TARGETS[target]
        self.entry: Entry = entry
        count = max(len(names), int(np.max(np.asarray(segments.vehicle), initial=0)) + 1)
        self.names = (*names, *(str(k) for k in range(len(names), count)))
        self.rows: list[Coefficient] = []
        self.notes: list[str] = []

    def build(self) -> Built:
        """The chain from its entry to the target, then the sheet's effects."""
        self.sheet.check_gears(self.segments)
        driveline, machine = self._efficiencies()
        effects: list[Effect] = self._road() if self.entry == "road" else []
        mass = self._mass()
        if self.target.of_battery:
            effects.append(Auxiliary(self._take("battery.auxiliary_w", default=0.0)))
        effects += self._effects()
        self._unused()
        self._measured()
        vehicle = Vehicle(
            effects, mass_kg=mass, driveline=driveline, machine=machine, entry=self.entry,
            nominal_voltage_v=self.sheet.nominal_voltage_v,
        )  # fmt: skip
        if self.entry == "road" and isinstance(driveline.efficiency, EfficiencyMap):
            self.notes += read_against_map(self.sheet.map_path, vehicle, self.segments)
        return Built(vehicle, ParameterTable(tuple(self.rows)), self.notes)

    # --- one coefficient -----------------------------------------------------------------------------------------

    def _take(self, path: str, why: str = "", *, default: float | None = None) -> Any:
        """The leaf of a declared coefficient, with its rows in the table; the default without any."""
        if path not in self.sheet.declared:
            if default is None:
                raise self.sheet.fail(path, why)
            return np.asarray(default)
        return self._leaf(path, KEYS[path], self.sheet.declared[path])

    def _leaf(self, path: str, key: Key, d: Declared) -> Any:
        if not d.per_vehicle:
            self._row(path, key, d.value, d.sd)
            return np.asarray(d.value)
        priors = [d.groups.get(name, (d.value, d.sd)) for name in self.names]
        for k, (name, (value, sd)) in enumerate(zip(self.names, priors, strict=True)):
            self._row(path, key, value, sd, group=k, label=name)
        return Grouped(jnp.asarray([value for value, _ in priors], dtype=float), "vehicle")

    def _row(self, path: str, key: Key, value: float, sd: float | None, **group: Any) -> None:
        scale = sd if sd is not None else max(abs(value), 1.0)  # a held row's scale is never used
        lower, upper = key.support
        self.rows.append(Coefficient(path, key.unit, value, sd, scale, lower, upper, free=sd is not None, **group))

    # --- sections ------------------------------------------------------------------------------------------------

    def _road(self) -> list[Effect]:
        why = f"{_MEASURED['road']}, so the road forces are computed"
        if self.target.last_stage == "road":
            why = f"the target {self.target} is the sum of the road forces"
        road: list[Effect] = [
            Inertia(self._take("road.rotating_mass_factor", default=1.0)),
            Grade(),
            Rolling(self._take("road.c_rr", why)),
            Aero(self._take("road.cda_m2", why)),
        ]
        if "road.b_n_per_mps" in self.sheet.declared:
            road.append(RollingLinear(self._take("road.b_n_per_mps")))
        return road

    def _mass(self) -> Any:
        declared = self.sheet.declared.get("mass_kg")
        if self.segments.has("mass_kg"):
            if declared is not None and self.entry == "road":
                self.notes.append("mass_kg of the sheet is not used: the log has its own")
            return np.asarray(declared.value if declared else 0.0)
        if self.entry == "road":
            return self._take("mass_kg", "the road forces are computed and the log has no column 'mass_kg'")
        return np.asarray(declared.value if declared else 0.0)

    def _efficiencies(self) -> tuple[Driveline, Machine]:
        """Driveline and machine: which of them covers what, by entry and target."""
        sheet, one = self.sheet, Machine(np.asarray(1.0), np.asarray(1.0))
        lossless = sheet.driveline(np.asarray(1.0))
        if self.target.last_stage == "road":
            return lossless, one
        if self.target.last_stage == "driveline":
            why = f"the target {self.target} lies behind the driveline"
            sheet.need_ratios(self.segments, why)
            return (lossless if self.entry == "wheel" else self._driveline(why)), one
        has_driveline = sheet.efficiency_map is not None or "driveline.efficiency" in sheet.declared
        has_machine = any(path.startswith("machine.") for path in sheet.declared)
        if self.entry == "road" and (has_driveline or not has_machine):
            why = f"{_MEASURED['road']}: it covers wheel to battery"
            return self._driveline(why, covers_machine=True), one
        why = f"{_MEASURED[self.entry]}, and the machine takes it to the battery"
        if self.entry == "road":
            self.notes.append("[machine] covers wheel to battery: the sheet has no driveline.efficiency")
            why = "it covers wheel to battery in a sheet without driveline.efficiency"
        elif self.entry == "wheel":
            self.notes.append("[machine] covers wheel to battery: the traction force is measured")
        parts = [self._take(f"machine.{k}", why) for k in SECTIONS["machine"]]
        return lossless, Machine(*parts)

    def _driveline(self, why: str, *, covers_machine: bool = False) -> Driveline:
        efficiency, path = self._driveline_efficiency(why), "driveline.regenerating_efficiency"
        back = self._take(path) if path in self.sheet.declared else None
        return self.sheet.driveline(efficiency, regenerating=back, covers_machine=covers_machine)

    def _driveline_efficiency(self, why: str) -> Any:
        sheet = self.sheet
        if sheet.efficiency_map is None:
            if "driveline.efficiency" not in sheet.declared:
                raise sheet.fail("driveline.efficiency (or map)", why)
            return self._take("driveline.efficiency")
        for key, value in (("gear_ratios", sheet.gear_ratios), ("wheel_radius_m", sheet.wheel_radius_m)):
            if value is None:
                what = "a ratio of 1" if key == "gear_ratios" else f"a wheel radius of {WHEEL_RADIUS_M:.3f} m"
                self.notes.append(f"driveline.{key} is not in the sheet: the efficiency map is read with {what}")
        if sheet.gear_ratios is not None and len(sheet.gear_ratios) > 1 and not self.segments.has("gear"):
            told = "; driveline.gear_model is used row by row alone (hdev follow)" if sheet.gear_model else ""
            self.notes.append(
                f"the log has no column 'gear': the efficiency map is read in the last gear's ratio{told}"
            )
        return sheet.efficiency_map

    # --- effects -------------------------------------------------------------------------------------------------

    def _effects(self) -> list[Effect]:
        sheet, out = self.sheet, []
        for effect_id in dict.fromkeys(p.split(".")[1] for p in sheet.declared if p.startswith("effects.")):
            cls = sheet.library[effect_id]
            stands_in = () if sheet.nominal_voltage_v is None else ("nominal_voltage_v",)
            reason = unavailable(cls, self.segments, self.entry, stands_in)
            if reason is None and STAGES.index(cls.stage) > STAGES.index(self.target.last_stage):
                reason = f"cannot act on the target {self.target}"
            grouped = [
                p
                for p in cls.parameters
                if p.by and (d := sheet.declared.get(f"effects.{cls.id}.{p.name}")) and d.groups
            ]
            if reason is None and (lost := [p for p in grouped if not self.segments.has(p.by)]):
                reason = f"{lost[0].name} is by {lost[0].by}, and the log has no column '{lost[0].by}'"
            if reason:
                self.notes.append(f"effect {effect_id} of the sheet is skipped: {reason}")
            else:
                out.append(self._effect(cls))
        return out

    def _effect(self, cls: type[Effect]) -> Effect:
        """The effect at its null with the declared values in place."""
        sheet, values = self.sheet, {}
        paths = {p.name: f"effects.{cls.id}.{p.name}" for p in cls.parameters}
        keys = [
            int(k) for p in paths.values() if p in sheet.declared for k in sheet.declared[p].groups if k.isdecimal()
        ]
        gears = max(most_group(self.segments), len(sheet.gear_ratios or ()), *keys)
        null = at_null(cls, gears=gears)
        for p in cls.parameters:
            d, key = sheet.declared.get(paths[p.name]), effect_key(cls, p)
            if d is None:
                values[p.name] = getattr(null, p.name)
            elif p.by and d.groups:
                by_gear = np.full(gears + 1, p.null)
                for gear, (value, sd) in d.groups.items():
                    by_gear[int(gear)] = value
                    self._row(paths[p.name], key, value, sd, group=int(gear), label=gear)
                values[p.name] = Grouped(jnp.asarray(by_gear), p.by)
            else:
                values[p.name] = self._leaf(paths[p.name], key, d)
        return cls(**values)

    # --- notes ---------------------------------------------------------------------------------------------------

    def _measured(self) -> None:
        """Notes on what of the log the declared model uses, and on what is taken from the sheet instead."""
        has, sheet = self.segments.has, self.sheet
        if self.entry == "road" and has("air_density_kgpm3"):
            self.notes.append("the declared drag uses the log's air_density_kgpm3 in place of the standard density")
        if self.entry == "shaft" and not has("motor_speed_radps"):
            sheet.need_ratios(self.segments, "the log measures motor torque without motor speed")
            self.notes.append("motor_speed_radps is not logged: it is speed · ratio / wheel radius")
        ignored = self.target.of_battery and self.entry != "shaft" and has("motor_torque_nm")
        if ignored and not (has("motor_speed_radps") or sheet.knows_ratio(self.segments)):
            self.notes.append(
                "motor_torque_nm is not used: the log has no motor_speed_radps, and the sheet no gear ratios (or "
                "final_drive) and wheel_radius_m to derive it from the speed"
            )
        if self.target.of_battery and (volts := sheet.nominal_voltage_v) is not None:
            self.notes.append(
                "battery.nominal_voltage_v is not used: the log has voltage_v" if has("voltage_v") else
                f"the log has no voltage_v: losses by current take the sheet's nominal {volts:g} V"
            )  # fmt: skip

    def _unused(self) -> None:
        """A note for each section with coefficients that this entry and target leave aside."""
        sheet, used = self.sheet, {c.path for c in self.rows}
        idle = {p.split(".")[0] for p in sheet.declared if "." in p and p not in used} - {"effects"}
        if self.entry == "wheel" and sheet.efficiency_map is not None:
            idle.add("driveline")
        if self.target.last_stage == "road" and not self.segments.has(self.target.name):
            idle.discard("driveline")  # the target itself is derived with it (`traction_force_from_torque`)
        before = f"the target {self.target} lies before it"
        reasons = {
            "road": _MEASURED[self.entry],
            "driveline": before if self.target.last_stage == "road" else _MEASURED[self.entry],
            "machine": "driveline.efficiency covers wheel to battery" if self.target.of_battery else before,
            "battery": before,
        }
        for section in (s for s in SECTIONS if s in idle):
            what = "driveline.efficiency" if section == "driveline" else f"[{section}]"
            self.notes.append(f"{what} is not used: {reasons[section]}")
