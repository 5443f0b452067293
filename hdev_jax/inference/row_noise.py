"""Noise of a row's energy from several instruments: its variance is a sum of parts, each with a known shape over rows.

    Var e_i = a² + (b·E_i)² + (c·m_i·g·d_i)² + (s·m_i·v_i)²

a the energy's own noise [Wh], b one in proportion to it, c that of the slope [rad], s that of the change of speed
[m/s]. The four variances are fitted to squared residuals, none below 0, by reweighted least squares: the likelihood of
a gamma model with identity link (McCullagh and Nelder, Generalized Linear Models, section 8.3).
"""

from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.optimize import nnls

from hdev_jax.physics.vehicle import GRAVITY_MPS2, JOULES_PER_WH
from hdev_jax.segments import Segments

__all__ = ["INSTRUMENTS", "row_noise", "shapes"]

INSTRUMENTS = ("energy_wh", "energy_share", "grade_rad", "speed_mps")
ROUNDS = 20


def shapes(log: Segments, mass_kg: Any, energy_wh: Float[np.ndarray, " row"]) -> Float[np.ndarray, "row instrument"]:
    """Energy [Wh] that one unit of each instrument's noise is, in each row; `energy_wh`, the measured: a model that
    strays would be let stray by a noise in proportion to what it says."""
    mass = np.broadcast_to(np.asarray(mass_kg, dtype=float), energy_wh.shape)
    climb = mass * GRAVITY_MPS2 * np.asarray(log.distance_m) / JOULES_PER_WH
    kick = mass * np.asarray(log.speed_mps) / JOULES_PER_WH
    return np.stack([np.ones_like(energy_wh), np.abs(energy_wh), climb, kick], axis=1)


def row_noise(
    residual: Float[np.ndarray, " row"], shape: Float[np.ndarray, "row instrument"], used: float, least: float
) -> tuple[Float[np.ndarray, " row"], Float[np.ndarray, " instrument"]]:
    """Standard deviation [Wh] of each row, at least `least`, and of each instrument in its own unit.

    `used`: how many parameters the residuals were fitted with, which made them smaller.
    """
    squares = residual**2 * (len(residual) / max(len(residual) - used, 1.0))
    parts = shape**2
    scale = np.maximum(parts.mean(axis=0), np.finfo(float).tiny)
    parts, variance = parts / scale, np.full(len(squares), max(float(np.mean(squares)), least**2))
    found = np.zeros(parts.shape[1])
    for _ in range(ROUNDS):
        found, _ = nnls(parts / variance[:, None], squares / variance)
        variance = np.maximum(parts @ found, least**2)
    return np.sqrt(variance), np.sqrt(found / scale)
