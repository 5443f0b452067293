"""A log on which the model is linear in its coefficients, its vehicle and table, and the same in plain NumPy."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from hdev_jax.inference import Coefficient, ParameterTable
from hdev_jax.physics import Driveline, Grouped, Machine, Vehicle
from hdev_jax.physics.loads import Auxiliary
from hdev_jax.physics.road import Aero, Grade, Inertia, Rolling
from hdev_jax.segments import Segments

EFFICIENCY = 0.91
C_RR, C_RR_SD, CDA, CDA_SD = 0.0060, 0.0008, 5.6, 0.5  # the contract's tabular values of a truck
PRIOR, PRIOR_SD = np.array([C_RR, CDA]), np.array([C_RR_SD, CDA_SD])


def driving(*lengths: int, seed: int = 0, dt: float = 5.0) -> Segments:
    """Trips of so many rows, always uphill and never braking: the efficiency's switch is not crossed."""
    rng = np.random.default_rng(seed)
    n = sum(lengths)
    trip = np.repeat(np.arange(len(lengths)), lengths)
    start, end = rng.uniform(4.0, 25.0, (2, n))
    end = start + 0.02 * (end - start)
    within = np.concatenate([np.arange(k) for k in lengths])
    return Segments(
        trip=trip,
        vehicle=trip % 2,
        time_s=dt * within,
        duration_s=np.full(n, dt),
        distance_m=0.5 * (start + end) * dt,
        speed_start_mps=start,
        speed_end_mps=end,
        channels={
            "mass_kg": rng.uniform(18e3, 34e3, len(lengths))[trip],
            "grade_rad": rng.uniform(0.012, 0.03, n),
        },
    )


def truck(c_rr: Any = C_RR, cda_m2: Any = CDA) -> Vehicle:
    """The papers' four forces behind a constant efficiency. Coefficients may be `Grouped`."""
    leaves = [x if isinstance(x, Grouped) else np.asarray(x) for x in (c_rr, cda_m2)]
    return Vehicle(
        (Inertia(np.asarray(1.0)), Grade(), Rolling(leaves[0]), Aero(leaves[1]), Auxiliary(np.asarray(0.0))),
        mass_kg=np.asarray(24e3),
        driveline=Driveline(np.asarray(EFFICIENCY), jnp.asarray([9.0, 4.0]), np.asarray(4.5), np.asarray(0.5), True),
        machine=Machine(np.asarray(1.0), np.asarray(1.0)),
    )


def tabular(scale: float = 1.0, **support: float) -> ParameterTable:
    """Both road coefficients free, their tabular sds times `scale`."""
    rows = (("road.c_rr", "1", C_RR, C_RR_SD), ("road.cda_m2", "m²", CDA, CDA_SD))
    return ParameterTable(tuple(Coefficient(p, u, v, scale * sd, sd, **support) for p, u, v, sd in rows))


def by_hand(s: Segments) -> tuple[np.ndarray, np.ndarray]:
    """Columns of c_rr and C_dA, and what needs neither: battery power [kW] of equations 3-5, without the kernel."""
    mass, slope = s.channels["mass_kg"], s.channels["grade_rad"]
    kw_per_n = s.distance_m / s.duration_s / EFFICIENCY / 1000.0
    columns = np.stack(
        [mass * 9.80665 * np.cos(slope), 0.5 * 1.225 * 0.5 * (s.speed_start_mps**2 + s.speed_end_mps**2)], axis=1
    )
    force = mass * (s.speed_end_mps - s.speed_start_mps) / s.duration_s + mass * 9.80665 * np.sin(slope)
    return columns * kw_per_n[:, None], force * kw_per_n


def power_kw(s: Segments, truth: np.ndarray) -> np.ndarray:
    """Battery power without noise."""
    columns, rest = by_hand(s)
    return columns @ truth + rest


def closed_form(
    columns: np.ndarray, y: np.ndarray, prior: np.ndarray, sd: np.ndarray, ids: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Bayesian linear regression with errors clustered: values, their sds, σ and the inflation.

    A second derivation: the jackknife refits without each cluster in turn, and the values that σ and the inflation
    lead to are iterated until they stay.
    """
    values, inflation, robust = prior.copy(), 1.0, np.eye(len(prior))
    for _ in range(60):
        sigma = np.sqrt(np.mean((y - columns @ values) ** 2))
        least = np.linalg.lstsq(columns, y, rcond=None)[0]
        groups = np.unique(ids)
        without = np.stack([np.linalg.lstsq(columns[ids != g], y[ids != g], rcond=None)[0] for g in groups])
        spread = without - least
        robust = (len(groups) - 1) / len(groups) * spread.T @ spread
        naive = sigma**2 * np.linalg.inv(columns.T @ columns)
        inflation = max(1.0, float(np.mean(np.diag(robust) / np.diag(naive))))
        precision = columns.T @ columns / (sigma**2 * inflation) + np.diag(1 / sd**2)
        values = prior + np.linalg.solve(precision, columns.T @ (y - columns @ prior) / (sigma**2 * inflation))
    posterior = np.linalg.inv(np.linalg.inv(robust) + np.diag(1 / sd**2))
    return values, np.sqrt(np.diag(posterior)), float(sigma), inflation
