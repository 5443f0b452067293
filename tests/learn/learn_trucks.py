"""Made-up trucks for the tests of physics-informed networks, and paper 1, equations 3 to 5, in plain NumPy."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from hdev_jax.learn.pinn.rows import Rows, rows_of
from hdev_jax.physics import Driveline, Machine, Vehicle
from hdev_jax.physics.loads import Auxiliary
from hdev_jax.physics.road import Aero, Grade, Inertia, Rolling
from hdev_jax.segments import Segments

FEATURES = ("acceleration", "slope", "froude", "kinetic", "mass_of_sheet", "c_rr_table", "temperature")
TABLE = {"c_rr": 0.006, "cda_m2": 6.0, "auxiliary_w": 2000.0, "factor": 1.05, "efficiency": 0.85}


def road(rows: int = 60, trips: int = 3, seed: int = 0) -> Segments:
    """Rows of 100 m, a halt in each trip."""
    rng = np.random.default_rng(seed)
    trip = np.arange(rows) * trips // rows
    ends = rng.uniform(6.0, 25.0, rows + 1)
    ends = np.convolve(np.r_[ends[0], ends, ends[-1]], [0.3, 0.4, 0.3], "valid")
    halts = np.arange(rows) % (rows // trips) == 3
    start, end = np.where(halts, 0.0, ends[:-1]), np.where(halts, 0.0, ends[1:])
    distance = np.where(halts, 0.0, 100.0)
    duration = np.where(halts, 20.0, 200.0 / np.maximum(start + end, 1e-9))
    channels: Any = {
        "grade_rad": rng.normal(0, 0.02, rows), "mass_kg": rng.uniform(12e3, 38e3, trips)[trip],
        "ambient_temp_c": rng.uniform(-5, 25, trips)[trip], "wind_speed_mps": rng.uniform(0, 6, rows),
        "wind_from_rad": rng.uniform(0, 6, rows), "heading_rad": rng.uniform(0, 6, rows),
        "wet_road": (rng.uniform(size=trips) < 0.5)[trip].astype(float), "curvature_1pm": rng.uniform(0, 0.005, rows),
        "road_surface": rng.integers(0, 4, rows).astype(float),
    }  # fmt: skip
    time = np.concatenate([np.r_[0.0, np.cumsum(duration[trip == k])[:-1]] for k in range(trips)])
    return Segments(trip, np.zeros(rows, int), time, duration, distance, start, end, channels)


def truck(table: dict[str, float] = TABLE, radius_m: float = 0.5) -> Vehicle:
    """With one efficiency from wheel to battery."""
    value = {k: jnp.asarray(x) for k, x in table.items()}
    effects = (
        Inertia(value["factor"]), Grade(), Rolling(value["c_rr"]), Aero(value["cda_m2"]),
        Auxiliary(value["auxiliary_w"]),
    )  # fmt: skip
    line = Driveline(value["efficiency"], jnp.array([1.0]), jnp.asarray(4.0), jnp.asarray(radius_m))
    return Vehicle(effects, mass_kg=jnp.asarray(30e3), driveline=line, machine=Machine(jnp.ones(()), jnp.ones(())))


def energy_by_hand(s: Segments, table: dict[str, Any] = TABLE, *, wheel: bool = False) -> np.ndarray:
    """Equations 3 to 5 of paper 1 and the auxiliary load [Wh]; `wheel`: equation 4. Coefficients may be by row."""
    m, theta, g, rho = s.channels["mass_kg"], s.channels["grade_rad"], 9.80665, 1.225
    square = (np.asarray(s.speed_start_mps) ** 2 + np.asarray(s.speed_end_mps) ** 2) / 2
    accel = (np.asarray(s.speed_end_mps) - np.asarray(s.speed_start_mps)) / np.asarray(s.duration_s)
    force = table["factor"] * m * accel + m * g * np.sin(theta) + m * g * table["c_rr"] * np.cos(theta)
    work = (force + 0.5 * rho * table["cda_m2"] * square) * np.asarray(s.distance_m)
    if wheel:
        return work / 3600
    eta = table["efficiency"]
    return (np.where(work > 0, work / eta, work * eta) + table["auxiliary_w"] * np.asarray(s.duration_s)) / 3600


def truck_rows(s: Segments, energy_wh: Any, *, number: int = 0, features: Any = FEATURES, **table: float) -> Rows:
    """Rows of a truck with the table of `TABLE`, but for what is named."""
    return rows_of(truck({**TABLE, **table}), s, np.asarray(energy_wh, float), number=number, features=features)
