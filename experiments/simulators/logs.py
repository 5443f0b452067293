"""What a simulator did, as a log and a sheet that a customer would send: rows, measured channels, noise."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import pandas as pd

from experiments.simulators.vehicles import Simulated, Vehicle

__all__ = ["EFFICIENCY", "Measured", "Rows", "SimulatedLog", "sheet", "simulated_log"]

Rows = Literal["intervals", "samples", "segments"]
Measured = Literal["none", "force", "torque"]

# What the sheet declares: a value and its sd.
EFFICIENCY = (0.85, 0.03)  # one for both directions, of the way from wheel to battery
SHAFT_EFFICIENCY = (0.90, 0.03)  # from the machine's shaft to the battery
ROLLING_SD, DRAG_SD = 0.12, 0.09  # shares: those of the contract's example
STANDS_MPS = 0.05
SEGMENT_M = 100.0


@dataclass(frozen=True)
class SimulatedLog:
    """A log by the contract and what only the simulator knows of each of its rows.

    `noise` and `free`, what the battery gave without it, are in the target's unit: kW, of segments Wh; `recovered` is
    the share of the braking power, where it is measured, that came into the battery.
    """

    frame: pd.DataFrame
    sheet: str
    free: np.ndarray
    noise: np.ndarray
    density_kgpm3: float
    recovered: float


def simulated_log(
    vehicle: Vehicle, trips: Sequence[Simulated], rng: np.random.Generator, *, rows: Rows, measured: Measured,
    noise: float, ar_coefficient: float,
) -> SimulatedLog:  # fmt: skip
    """The log of a vehicle that the sheet declares as `vehicle`, whatever drove the trips.

    **Arguments:** `rows`: the simulator's seconds as intervals with two end speeds; as samples, which are the mean of
    the second that ends there, as data loggers write them; or gathered to segments of about 100 m, standstill apart.
    `measured`: traction force, or torque and speed of the machine's shaft, besides the battery's power. `noise`: its
    RMS over that of the power, second by second, each second `ar_coefficient` of the one before.
    """
    rms = np.sqrt(np.mean(np.concatenate([t.battery_w for t in trips]) ** 2))
    frames = []
    for k, trip in enumerate(trips):
        ar = _autoregressive(rng, len(trip.battery_w), ar_coefficient) * noise * rms
        frames.append(_segments(trip, ar) if rows == "segments" else _seconds(trip, ar, rows))
        frames[-1].insert(0, "trip_id", f"T{k + 1:02d}")
    table = pd.concat(frames, ignore_index=True)
    free, ar = table.pop("free").to_numpy(), table.pop("noise").to_numpy()
    table["energy_wh" if rows == "segments" else "battery_power_kw"] = free + ar
    wheel, shaft, ratio = table.pop("wheel_n"), table.pop("shaft_n"), vehicle.ratio / vehicle.wheel_radius_m
    if measured == "force":
        table["traction_force_n"] = wheel
    elif measured == "torque":
        table["motor_torque_nm"] = shaft / ratio
        table["motor_speed_radps"] = table.pop("mean_mps") * ratio
    table = table.drop(columns="mean_mps", errors="ignore")
    recovered = _recovered(trips, vehicle.auxiliary_w, measured)
    return SimulatedLog(table, sheet(vehicle, measured), free, ar, trips[0].density_kgpm3, recovered)


def _recovered(trips: Sequence[Simulated], auxiliary_w: float, measured: Measured) -> float:
    """Battery's power without auxiliaries over the wheels' (the shaft's where that is measured), in braking."""
    battery = np.concatenate([t.battery_w for t in trips]) - auxiliary_w
    power = np.concatenate([t.shaft_w if measured == "torque" else t.wheel_w for t in trips])
    braking = power < 0
    return float(np.sum(battery[braking]) / np.sum(power[braking]))


def _autoregressive(rng: np.random.Generator, rows: int, coefficient: float) -> np.ndarray:
    """Noise of unit variance, each row `coefficient` of the one before."""
    from scipy.signal import lfilter

    new = rng.normal(size=rows) * np.sqrt(1 - coefficient**2)
    start = [coefficient * float(rng.normal())]
    return np.asarray(lfilter([1.0], [1.0, -coefficient], new, zi=start)[0])


def _per_metre(power_w: np.ndarray, seconds: Any, way_m: np.ndarray) -> np.ndarray:
    """Force [N] whose work over the way is the power's; 0 at standstill."""
    return np.divide(power_w * seconds, way_m, out=np.zeros_like(power_w), where=way_m > STANDS_MPS)


def _seconds(trip: Simulated, noise_w: np.ndarray, rows: Rows) -> pd.DataFrame:
    count = len(trip.battery_w)
    if rows == "samples":
        kinematics: dict[str, Any] = {"time_s": np.arange(1.0, count + 1), "speed_mps": trip.speed_end_mps}
    else:
        kinematics = {
            "time_s": np.arange(float(count)), "duration_s": np.ones(count), "distance_m": trip.distance_m,
            "speed_start_mps": trip.speed_start_mps, "speed_end_mps": trip.speed_end_mps,
        }  # fmt: skip
    return pd.DataFrame({
        **kinematics, "grade_rad": trip.grade_rad, "mean_mps": trip.distance_m,
        "wheel_n": _per_metre(trip.wheel_w, 1.0, trip.distance_m),
        "shaft_n": _per_metre(trip.shaft_w, 1.0, trip.distance_m),
        "free": trip.battery_w / 1e3, "noise": noise_w / 1e3,
    })  # fmt: skip


def _segments(trip: Simulated, noise_w: np.ndarray) -> pd.DataFrame:
    """Whole seconds gathered until they reach 100 m; a standstill is a row of its own, and so is what is left."""
    stands = np.maximum(trip.speed_start_mps, trip.speed_end_mps) < STANDS_MPS
    label, way, at = np.zeros(len(stands), dtype=int), 0.0, 0
    for k in range(len(stands)):
        if k and (stands[k] != stands[k - 1] or way >= SEGMENT_M):
            at, way = at + 1, 0.0
        label[k] = at
        way += trip.distance_m[k]
    first = np.r_[0, np.flatnonzero(np.diff(label)) + 1]
    last = np.r_[first[1:] - 1, len(label) - 1]

    def total(x: np.ndarray) -> np.ndarray:
        return np.add.reduceat(x, first)

    seconds, metres = total(np.ones(len(label))), total(trip.distance_m)
    rise = total(trip.distance_m * np.sin(trip.grade_rad))
    return pd.DataFrame({
        "time_s": first.astype(float), "duration_s": seconds, "distance_m": metres,
        "speed_start_mps": trip.speed_start_mps[first], "speed_end_mps": trip.speed_end_mps[last],
        "grade_rad": np.arcsin(np.divide(rise, metres, out=np.zeros_like(rise), where=metres > STANDS_MPS)),
        "mean_mps": metres / seconds,
        "wheel_n": _per_metre(total(trip.wheel_w), 1.0, metres),
        "shaft_n": _per_metre(total(trip.shaft_w), 1.0, metres),
        "free": total(trip.battery_w) / 3600.0, "noise": total(noise_w) / 3600.0,
    })  # fmt: skip


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
