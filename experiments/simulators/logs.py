"""What a simulator did, as a log and a sheet that a customer would send: rows, measured channels, noise."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import pandas as pd
from scipy.signal import lfilter

from experiments.simulators.vehicles import Simulated, Vehicle
from hdev_jax.units import J_PER_WH

__all__ = ["EFFICIENCY", "Measured", "Rows", "SimulatedLog", "sheet", "simulated_log"]

Rows = Literal["intervals", "samples", "segments"]
Measured = Literal["none", "force", "torque"]

# What the sheet declares: a value and its sd.
EFFICIENCY = (0.85, 0.03)  # one for both directions, of the way from wheel to battery
SHAFT_EFFICIENCY = (0.90, 0.03)  # from the machine's shaft to the battery
ROLLING_SD, DRAG_SD = 0.12, 0.09  # shares: those of the contract's example
STANDS_M = 0.05


@dataclass(frozen=True)
class SimulatedLog:
    """A log by the contract, its sheet, and what only the simulator knows: the density of its air, and which share of
    the braking power, where it is measured, came into the battery."""

    frame: pd.DataFrame
    sheet: str
    density_kgpm3: float
    recovered: float


def simulated_log(
    vehicle: Vehicle, trips: Sequence[Simulated], rng: np.random.Generator, *, rows: Rows, measured: Measured,
    noise: float, ar_coefficient: float,
) -> SimulatedLog:  # fmt: skip
    """The log of a vehicle that the sheet declares as `vehicle`, whatever drove the trips.

    **Arguments:** `rows`: the simulator's seconds as intervals with two end speeds and the mean power between; the same
    with energy, to be put together to segments; or samples, which are the mean of the second that ends there, as data
    loggers write them. `measured`: traction force, or torque and speed of the machine's shaft, besides the battery's
    power. `noise`: its RMS over that of the power, second by second, each second `ar_coefficient` of the one before.
    """
    rms = np.sqrt(np.mean(np.concatenate([t.battery_w for t in trips]) ** 2))
    frames = []
    for k, trip in enumerate(trips):
        ar = _autoregressive(rng, len(trip.battery_w), ar_coefficient) * noise * rms
        frames.append(_seconds(vehicle, trip, ar, rows, measured))
        frames[-1].insert(0, "trip_id", f"T{k + 1:02d}")
    table = pd.concat(frames, ignore_index=True)
    recovered = _recovered(trips, vehicle.auxiliary_w, measured)
    return SimulatedLog(table, sheet(vehicle, measured), trips[0].density_kgpm3, recovered)


def _seconds(vehicle: Vehicle, trip: Simulated, noise_w: np.ndarray, rows: Rows, measured: Measured) -> pd.DataFrame:
    count, power_w = len(trip.battery_w), trip.battery_w + noise_w
    if rows == "samples":
        columns: dict[str, Any] = {"time_s": np.arange(1.0, count + 1), "speed_mps": trip.speed_end_mps}
    else:
        columns = {
            "time_s": np.arange(float(count)), "duration_s": np.ones(count), "distance_m": trip.distance_m,
            "speed_start_mps": trip.speed_start_mps, "speed_end_mps": trip.speed_end_mps,
        }  # fmt: skip
    columns["grade_rad"] = trip.grade_rad
    if measured == "force":
        columns["traction_force_n"] = _force(trip.wheel_w, trip.distance_m)
    elif measured == "torque":
        ratio = vehicle.ratio / vehicle.wheel_radius_m
        columns["motor_torque_nm"] = _force(trip.shaft_w, trip.distance_m) / ratio
        columns["motor_speed_radps"] = trip.distance_m * ratio
    columns |= {"energy_wh": power_w / J_PER_WH} if rows == "segments" else {"battery_power_kw": power_w / 1e3}
    return pd.DataFrame(columns)


def _autoregressive(rng: np.random.Generator, rows: int, coefficient: float) -> np.ndarray:
    """Noise of unit variance, each row `coefficient` of the one before."""
    new = rng.normal(size=rows) * np.sqrt(1 - coefficient**2)
    start = [coefficient * float(rng.normal())]
    return np.asarray(lfilter([1.0], [1.0, -coefficient], new, zi=start)[0])


def _force(power_w: np.ndarray, way_m: np.ndarray) -> np.ndarray:
    """Force [N] whose work over the way of a second is the power's; 0 at standstill."""
    return np.divide(power_w, way_m, out=np.zeros_like(power_w), where=way_m > STANDS_M)


def _recovered(trips: Sequence[Simulated], auxiliary_w: float, measured: Measured) -> float:
    """Battery's power without auxiliaries over the wheels' (the shaft's where that is measured), in braking."""
    battery = np.concatenate([t.battery_w for t in trips]) - auxiliary_w
    power = np.concatenate([t.shaft_w if measured == "torque" else t.wheel_w for t in trips])
    braking = power < 0
    return float(np.sum(battery[braking]) / np.sum(power[braking]))


def sheet(vehicle: Vehicle, measured: Measured) -> str:
    """The vehicle sheet as the simulator's parameters say, with one efficiency for everything; nothing of what effects
    stand for: regeneration that is not recovered, wind."""
    head = f'name = "{vehicle.name} ({vehicle.simulator}, synthetic)"\nmass_kg = {vehicle.mass_kg!r}\n'
    tail = f"[battery]\nauxiliary_w = {vehicle.auxiliary_w!r}\n"
    if measured != "none":
        value, sd = EFFICIENCY if measured == "force" else SHAFT_EFFICIENCY
        return (
            f"{head}[machine]\nmotoring_efficiency = {{ value = {value}, sd = {sd} }}\n"
            f"regenerating_efficiency = {{ value = {value}, sd = {sd} }}\n{tail}"
        )
    value, sd = EFFICIENCY
    return (
        f"{head}[road]\nc_rr = {{ value = {vehicle.c_rr!r}, sd = {ROLLING_SD * vehicle.c_rr:.6g} }}\n"
        f"cda_m2 = {{ value = {vehicle.cda_m2!r}, sd = {DRAG_SD * vehicle.cda_m2:.6g} }}\n"
        f"rotating_mass_factor = {1 + vehicle.rotating_kg / vehicle.mass_kg!r}\n"
        f"[driveline]\nefficiency = {{ value = {value}, sd = {sd} }}\n{tail}"
    )
