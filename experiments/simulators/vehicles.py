"""A simulator's vehicle as its parameters say, how it differs from draw to draw, and what it did second by second."""

from dataclasses import dataclass, replace

import numpy as np

from hdev_jax.units import GRAVITY_MPS2

__all__ = ["Simulated", "Vehicle", "drawn", "headwind_force_n", "slope_with_force"]


@dataclass(frozen=True)
class Vehicle:
    """The numbers of a vehicle that a simulator needs.

    `rotating_kg`: mass that the rotating parts add; `driving`, `regenerating`: constant efficiencies (of FASTSim, a
    factor on its transmission's, for both); `ratio`: motor revolutions to the wheel's; `recovered`: share of the
    braking power at the machine that is recovered; `cutoff_mps`: below it nothing is recovered; `headwind_mps`.
    """

    name: str
    simulator: str
    mass_kg: float
    c_rr: float
    cda_m2: float
    rotating_kg: float
    auxiliary_w: float
    wheel_radius_m: float
    driving: float
    regenerating: float
    power_w: float = 100e3
    stretch: float = 1.0
    top_mps: float = 60.0
    base: str = ""
    ratio: float = 9.0
    recovered: float = 1.0
    cutoff_mps: float = 0.0
    headwind_mps: float = 0.0

    def planted(self, plant: str, size: float) -> "Vehicle":
        """The vehicle with one change (`plants.PLANTS`)."""
        match plant:
            case "payload":
                return replace(self, mass_kg=self.mass_kg * (1 + size))
            case "rolling":
                return replace(self, c_rr=self.c_rr * (1 + size))
            case "drag":
                return replace(self, cda_m2=self.cda_m2 * (1 + size))
            case "auxiliaries":
                return replace(self, auxiliary_w=self.auxiliary_w + size)
            case "regeneration":
                return replace(self, recovered=size)
            case "cutoff":
                return replace(self, cutoff_mps=size)
            case "efficiency":
                return replace(self, driving=self.driving * (1 - size), regenerating=self.regenerating * (1 - size))
            case "headwind":
                return replace(self, headwind_mps=size)
        return self


@dataclass(frozen=True)
class Simulated:
    """One trip as simulated, a row each second: speeds at both ends, way, slope, mean powers of the second.

    `wheel_w` is the power at the wheels, `shaft_w` the machine's (NaN where the simulator has none), `battery_w` what
    the battery gives; `density_kgpm3`, the air that the drag was computed with.
    """

    speed_start_mps: np.ndarray
    speed_end_mps: np.ndarray
    distance_m: np.ndarray
    grade_rad: np.ndarray
    wheel_w: np.ndarray
    shaft_w: np.ndarray
    battery_w: np.ndarray
    density_kgpm3: float


def drawn(rng: np.random.Generator, vehicle: Vehicle) -> Vehicle:
    """Another vehicle of the same kind: mass, rolling resistance, drag area within 10 %, auxiliaries within 30 %."""
    m, c, d, a = rng.uniform(-1.0, 1.0, 4).tolist()
    return replace(
        vehicle, mass_kg=vehicle.mass_kg * (1 + 0.1 * m), c_rr=vehicle.c_rr * (1 + 0.1 * c),
        cda_m2=vehicle.cda_m2 * (1 + 0.1 * d), auxiliary_w=vehicle.auxiliary_w * (1 + 0.3 * a),
    )  # fmt: skip


def headwind_force_n(vehicle: Vehicle, speed_mps: np.ndarray, density_kgpm3: float) -> np.ndarray:
    """½ρ·C_dA·((v+w)² − v²): what a headwind adds to the drag, for simulators that know no wind; 0 at standstill."""
    w = vehicle.headwind_mps
    extra = 0.5 * density_kgpm3 * vehicle.cda_m2 * ((speed_mps + w) * np.abs(speed_mps + w) - speed_mps**2)
    return np.where(speed_mps > 0, extra, 0.0)


def slope_with_force(grade_rad: np.ndarray, force_n: np.ndarray, mass_kg: float) -> np.ndarray:
    """The slope [rad] on which gravity brakes by `force_n` more."""
    return np.arcsin(np.sin(grade_rad) + force_n / (mass_kg * GRAVITY_MPS2))
