"""Vehicle files of simulators: FASTSim 3.1 and SUMO's electric device. What neither can hold is named with its cost."""

import json
import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from hdev_jax.errors import InputError
from hdev_jax.export.exported import Exported, LeftOut
from hdev_jax.export.kernel import Kernel, check_drive
from hdev_jax.physics import EfficiencyMap, Vehicle
from hdev_jax.physics.library import DECLARED
from hdev_jax.units import AIR_DENSITY_KGPM3, J_PER_WH

__all__ = ["FASTSIM_DENSITY_KGPM3", "SUMO_DENSITY_KGPM3", "fastsim", "sumo"]

# The air of each program's drag, which no vehicle file can change; the drag area is scaled so that the force is ours.
FASTSIM_DENSITY_KGPM3 = 1.1728  # worked out from the drag powers of FASTSim 3.1, whatever its record of it says
SUMO_DENSITY_KGPM3 = 1.2041  # dry air at 20 °C, of SUMO's energy model
_CAPACITY_WH = 500e3  # where the sheet has none: never the limit
_NEVER_W = 1e7  # a limit of power that no vehicle reaches: a sheet knows none
_WHEELS = 4  # FASTSim asks how many share the rotating inertia


@dataclass(frozen=True)
class _Plain:
    """What both programs know of a vehicle, as numbers. `rotating_kg`: mass that rotating parts add."""

    mass_kg: float
    c_rr: float
    cda_m2: float
    rotating_kg: float
    driving: float
    braking: float
    auxiliary_w: float
    capacity_wh: float


def fastsim(kernel: Kernel) -> Exported:
    """A battery-electric vehicle of FASTSim 3.1, as JSON, which is YAML too: `fastsim.Vehicle.from_file` reads it.

    One efficiency holds from the wheel to the battery and back; powers are not limited. **Raises:** `InputError` for a
    sheet without a mass.
    """
    plain, left = _plain(kernel)
    eta = plain.driving
    if plain.braking != plain.driving:
        left.append(
            LeftOut("regenerating efficiency", f"{plain.braking:g}: FASTSim has one for both directions, {eta:g}")
        )
    shares = [0.0, 0.5, 1.0]
    grid = lambda x: [{"v": 1, "dim": [len(x)], "data": x}]  # noqa: E731

    def table(x: list[float], strategy: Any) -> dict[str, Any]:
        values = {"v": 1, "dim": [len(x)], "data": [eta] * len(x)}
        return {"data": {"grid": grid(x), "values": values}, "strategy": strategy, "extrapolate": "Error"}

    radius = float(np.asarray(kernel.vehicle.driveline.wheel_radius_m))
    vehicle = {
        "name": kernel.sheet.name, "min_fastsim_version": "3.1.0", "year": 0,
        "pt_type": {"BEV": {
            "res": {
                "thrml": "None", "pwr_out_max_watts": 10 * _NEVER_W, "eff_interp": {"Constant": 1.0},
                "energy_capacity_joules": plain.capacity_wh * J_PER_WH, "min_soc": 0.0, "max_soc": 1.0,
                "state": {"soc": 0.9}, "save_interval": 1,
            },
            "em": {
                "eff_interp_achieved": table(shares, "Linear"),
                "eff_interp_at_max_input": table(
                    [x / eta for x in shares], {"values_transform": "Reciprocal", "inner": "Linear"}
                ),
                "pwr_out_max_watts": _NEVER_W, "save_interval": 1,
            },
            "transmission": {"eff_interp": 1.0, "save_interval": 1},
        }},
        "chassis": {
            "drag_coef": 1.0, "frontal_area_square_meters": plain.cda_m2 * AIR_DENSITY_KGPM3 / FASTSIM_DENSITY_KGPM3,
            "wheel_rr_coef": plain.c_rr, "num_wheels": _WHEELS, "wheel_radius_meters": radius,
            "wheel_inertia_kilogram_square_meters": plain.rotating_kg * radius**2 / _WHEELS,
            "wheel_fric_coef": 0.8, "drive_type": "AWD", "drive_axle_weight_frac": 0.5,
            "cg_height_meters": 1.0, "wheel_base_meters": 4.0,
        },
        "cabin": "None", "hvac": "None", "mass_kilograms": plain.mass_kg, "pwr_aux_base_watts": plain.auxiliary_w,
        "save_interval": 1,
    }  # fmt: skip
    about = {"program": "FASTSim 3.1", "air_density_kgpm3": FASTSIM_DENSITY_KGPM3, "drag_area_m2": plain.cda_m2}
    return Exported((json.dumps(vehicle, indent=1) + "\n").encode(), about, tuple(left))


def sumo(kernel: Kernel) -> Exported:
    """A `vType` with SUMO's electric device (emission class Energy, device battery), in an additional file.

    **Raises:** `InputError` for a sheet without a mass.
    """
    plain, left = _plain(kernel)
    keys = {
        "has.battery.device": "true", "device.battery.capacity": plain.capacity_wh,
        "device.battery.chargeLevel": 0.9 * plain.capacity_wh, "airDragCoefficient": 1.0,
        "frontSurfaceArea": plain.cda_m2 * AIR_DENSITY_KGPM3 / SUMO_DENSITY_KGPM3, "rollDragCoefficient": plain.c_rr,
        "radialDragCoefficient": 0.0, "constantPowerIntake": plain.auxiliary_w, "rotatingMass": plain.rotating_kg,
        "propulsionEfficiency": plain.driving, "recuperationEfficiency": plain.braking, "maximumPower": _NEVER_W,
    }  # fmt: skip
    root = ET.Element("additional")
    name = re.sub(r"\W+", "_", kernel.sheet.name).strip("_") or "vehicle"
    heavy = plain.mass_kg > 3500.0  # kg, EU class N2 and above
    kind = ET.SubElement(
        root, "vType", id=name, vClass="truck" if heavy else "passenger", emissionClass="Energy/unknown",
        mass=repr(plain.mass_kg),
    )  # fmt: skip
    for k, v in keys.items():
        ET.SubElement(kind, "param", key=k, value=v if isinstance(v, str) else repr(float(v)))
    ET.indent(root)
    about = {
        "program": "SUMO 1.28",
        "vtype": name,
        "air_density_kgpm3": SUMO_DENSITY_KGPM3,
        "drag_area_m2": plain.cda_m2,
    }
    return Exported(ET.tostring(root, encoding="utf-8", xml_declaration=True), about, tuple(left))


def _plain(kernel: Kernel) -> tuple[_Plain, list[LeftOut]]:
    """The numbers that both programs know, and what of the vehicle these leave out, with its share of the energy."""
    sheet, car = kernel.sheet, kernel.vehicle
    if "mass_kg" not in sheet.declared:
        raise InputError(f"sheet {sheet.path}: mass_kg is missing; a simulator's vehicle file needs it")
    drive = check_drive(kernel)
    parts = {k: float(np.sum(x)) for k, x in car.breakdown(drive).items()}
    total = float(np.sum(car.energy(drive)))
    known = {c.id for c in DECLARED} | {"auxiliary_power", "rotating_mass"}  # these add to a number that is there
    left = [x for x in kernel.left_out if x.what != "mass_kg"]
    left += [
        LeftOut(
            f"effects.{e.id}" if e.id != "rolling_linear" else "road.b_n_per_mps", "no such term", parts[e.id] / total
        )
        for e in car.effects
        if e.id not in known
    ]
    line, machine = car.driveline, car.machine
    driving, back = line.efficiency, line.regenerating_efficiency
    if isinstance(driving, EfficiencyMap):
        force, speed = np.asarray(car.force(drive)), np.asarray(drive.speed_mps)
        driven = float(np.sum(np.maximum(force * speed, 0.0) * drive.duration_s) / J_PER_WH)
        braked = float(np.sum(np.minimum(force * speed, 0.0) * drive.duration_s) / J_PER_WH)
        driving = _one_efficiency(driven, braked, driven + braked + parts["driveline"])
        left.append(LeftOut("driveline.map", f"one efficiency in its place, {driving:.4f}: the check drive's mean"))
    if sheet.capacity_wh is None:
        left.append(LeftOut("battery.capacity_wh", f"not in the sheet: {_CAPACITY_WH / 1e3:g} kWh are written"))
    back, mass = driving if back is None else back, sheet.declared["mass_kg"].value
    return _Plain(
        mass, _sum(car, {"rolling": "c_rr"}), _sum(car, {"aero": "cda_m2"}),
        (_sum(car, {"inertia": "rotating_mass_factor", "rotating_mass": "factor"}) - 1.0) * mass,
        _first(driving) * _first(machine.motoring_efficiency), _first(back) * _first(machine.regenerating_efficiency),
        _sum(car, {"auxiliary": "auxiliary_w", "auxiliary_power": "power_w"}), sheet.capacity_wh or _CAPACITY_WH,
    ), left  # fmt: skip


def _first(x: Any) -> float:
    """The number, or that of the first vehicle."""
    return float(np.atleast_1d(np.asarray(getattr(x, "values", x)))[0])


def _sum(car: Vehicle, fields: Mapping[str, str]) -> float:
    """The sum of one coefficient each of those of the effects that the vehicle has."""
    return sum(_first(getattr(car.effect(e), field)) for e, field in fields.items() if car.has(e))


def _one_efficiency(driven_wh: float, braked_wh: float, at_battery_wh: float) -> float:
    """η with driven/η + braked·η = what came out of the battery; the root in (0, 1]."""
    if braked_wh == 0.0:
        return min(driven_wh / at_battery_wh, 1.0)
    root = np.sqrt(at_battery_wh**2 - 4.0 * braked_wh * driven_wh)
    return float(np.clip((at_battery_wh - root) / (2.0 * braked_wh), 0.05, 1.0))
