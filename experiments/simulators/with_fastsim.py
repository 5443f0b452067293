"""FASTSim's electric vehicles driven through micro-trips of its own cycles (package `fastsim`, extra `truth`).

Its rows are mean powers of the past second. It has neither wind nor a share of friction braking: a headwind is driven
as the slope of the same force, which the log does not have, and what is not recovered is taken off its machine's
electric power, whose efficiency in braking is constant. The drag uses an air density of its own, which is worked out
from its powers.
"""

import warnings
from functools import cache
from importlib import import_module
from typing import Any

import numpy as np

from experiments.simulators.drives import Drive, random_drive
from experiments.simulators.vehicles import Simulated, Vehicle, headwind_force_n, slope_with_force

__all__ = ["VEHICLES", "drives", "simulate"]

_ZOE = "2022_Renault_Zoe_ZE50_R135.yaml"
_TRUCK_WHEELS, _TRUCK_INERTIA = 10, 12.0  # kg·m² each: twin tyres of 22.5 inch with rim and hub
_DENSITY = 1.1728  # kg/m³: of its drag, whatever its record of the density says


def _fastsim() -> Any:
    return import_module("fastsim")  # by name: it is in an extra of its own


def _bundled(file: str) -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return _fastsim().Vehicle.from_resource(file).to_dict()


def _vehicle(name: str, file: str) -> Vehicle:
    """One of the bundled vehicles, by its own numbers."""
    data = _bundled(file)
    chassis = data["chassis"]
    radius = chassis["wheel_radius_meters"]
    return Vehicle(
        name, "fastsim", data["mass_kilograms"], chassis["wheel_rr_coef"],
        chassis["drag_coef"] * chassis["frontal_area_square_meters"],
        chassis["num_wheels"] * chassis["wheel_inertia_kilogram_square_meters"] / radius**2,
        data["pwr_aux_base_watts"], radius, 1.0, 1.0, data["pt_type"]["BEV"]["em"]["pwr_out_max_watts"], base=file,
    )  # fmt: skip


def _truck(name: str) -> Vehicle:
    """The Zoe's drivetrain scaled to 26 t."""
    radius = 0.5
    return Vehicle(
        name, "fastsim", 26000.0, 0.006, 5.4, _TRUCK_WHEELS * _TRUCK_INERTIA / radius**2, 2000.0, radius, 1.0, 1.0,
        450e3, stretch=1.6, top_mps=23.0, base=_ZOE, ratio=20.0,
    )  # fmt: skip


VEHICLES = {
    "zoe": lambda: _vehicle("zoe", _ZOE),
    "leaf": lambda: _vehicle("leaf", "2016 Nissan Leaf 30 kWh thrml.yaml"),
    "model 3": lambda: _vehicle("model 3", "2022 Tesla Model 3 RWD thrml.yaml"),
    "bolt": lambda: _vehicle("bolt", "2020 Chevrolet Bolt EV thrml.yaml"),
    "truck 26 t": lambda: _truck("truck 26 t"),
}


@cache
def _cycle(file: str) -> np.ndarray:
    return np.asarray(_fastsim().Cycle.from_resource(file).to_dict()["speed_meters_per_second"])


def drives(vehicle: Vehicle, rng: np.random.Generator, trips: int, seconds: float) -> list[Drive]:
    """Micro-trips of UDDS and HWFET with hills, `seconds` ± 20 % each."""
    cycles = [_cycle("udds.csv"), _cycle("hwfet.csv")]
    return [
        random_drive(
            rng, cycles, seconds * rng.uniform(0.8, 1.2), stretch=vehicle.stretch, top_mps=vehicle.top_mps,
            steepest=0.03 if vehicle.mass_kg > 10e3 else 0.05,
        )
        for _ in range(trips)
    ]  # fmt: skip


def simulate(vehicle: Vehicle, drives: list[Drive]) -> list[Simulated]:
    """Each trip as FASTSim drives it. Raises `ValueError` where it cannot follow the speeds."""
    return [_trip(vehicle, d) for d in drives]


def _own(vehicle: Vehicle) -> Any:
    data, base = _bundled(_ZOE), _bundled(vehicle.base)
    data["mass_kilograms"] = vehicle.mass_kg
    data["pwr_aux_base_watts"] = vehicle.auxiliary_w
    chassis, drivetrain, own = data["chassis"], data["pt_type"]["BEV"], base["pt_type"]["BEV"]
    chassis["wheel_rr_coef"], chassis["drag_coef"] = vehicle.c_rr, vehicle.cda_m2
    chassis["frontal_area_square_meters"] = 1.0
    chassis["num_wheels"], chassis["wheel_radius_meters"] = 4, vehicle.wheel_radius_m
    chassis["wheel_inertia_kilogram_square_meters"] = vehicle.rotating_kg * vehicle.wheel_radius_m**2 / 4
    drivetrain["em"], drivetrain["transmission"] = own["em"], own["transmission"]
    drivetrain["em"]["pwr_out_max_watts"] = vehicle.power_w
    drivetrain["transmission"]["eff_interp"] = float(own["transmission"]["eff_interp"]) * vehicle.driving
    drivetrain["res"]["pwr_out_max_watts"] = 10 * vehicle.power_w
    drivetrain["res"]["energy_capacity_joules"] *= max(1.0, vehicle.mass_kg / 1600.0)
    drivetrain["res"]["state"]["soc"] = 0.6
    return _fastsim().Vehicle.from_dict(data)


def _trip(vehicle: Vehicle, drive: Drive) -> Simulated:
    fastsim = _fastsim()
    v0, v1 = np.r_[0.0, drive.speed_mps[:-1]], drive.speed_mps
    mean = 0.5 * (v0 + v1)
    grade_rad = np.arctan(drive.grade)
    driven = slope_with_force(grade_rad, headwind_force_n(vehicle, mean, _DENSITY), vehicle.mass_kg)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        cycle = fastsim.Cycle.from_dict({
            "time_seconds": np.arange(float(len(v1))).tolist(), "speed_meters_per_second": v1.tolist(),
            "grade": np.tan(driven).tolist(),
        })  # fmt: skip
        simulation = fastsim.SimDrive(_own(vehicle), cycle)
        simulation.run_once()  # from the state of charge that it is given; `run` would begin with a full battery
        h = simulation.to_dataframe()
    column = {k: h[k].to_numpy(dtype=float)[1:] for k in h.columns}
    if np.max(np.abs(column["veh.history.speed_ach_meters_per_second"] - v1[1:])) > 1e-6:
        raise ValueError(f"{vehicle.name}: its machine of {vehicle.power_w / 1e3:.0f} kW cannot follow the speeds")
    v0, v1, mean, grade_rad = v0[1:], v1[1:], mean[1:], grade_rad[1:]
    drivetrain = "veh.pt_type.BEV"
    electric = column[f"{drivetrain}.em.history.pwr_elec_prop_in_watts"]
    share = np.where(mean < vehicle.cutoff_mps, 0.0, vehicle.recovered)
    drag = 0.5 * vehicle.cda_m2 * mean**3
    return Simulated(
        v0, v1, mean, grade_rad, column[f"{drivetrain}.transmission.history.pwr_out_watts"],
        column[f"{drivetrain}.em.history.pwr_mech_prop_out_watts"],
        np.where(electric < 0, share * electric, electric) + column["veh.history.pwr_aux_watts"],
        float(np.sum(column["veh.history.pwr_drag_watts"]) / np.sum(drag)),
    )  # fmt: skip
