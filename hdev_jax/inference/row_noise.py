"""Noise of a row's energy from several instruments: its variance is a sum of parts, each with a known shape over rows.

    Var e_i = a² + (b·E_i)² + (c·∂E_i/∂slope)² + (s·∂E_i/∂(change of speed))²

a the energy's own noise [Wh], b one in proportion to it, c that of the slope [rad], s that of the change of speed
[m/s], both about what their readings tell (`believed`). The four variances are fitted to squared residuals, none below
0, by reweighted least squares: the likelihood of a gamma model with identity link (McCullagh and Nelder, Generalized
Linear Models, section 8.3), in which no residual counts as more than five standard deviations.
"""

from itertools import product

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Bool, Float
from scipy.optimize import nnls

from hdev_jax.physics import Vehicle
from hdev_jax.segments import ACCEL_OF_WAY, ACCEL_SD, GRADE_SD, Segments

__all__ = ["INSTRUMENTS", "believed", "row_noise", "shapes"]

INSTRUMENTS = ("energy_wh", "energy_share", "grade_rad", "speed_mps")
ROUNDS, STEADY = 100, 1e-4
FARTHEST = 5.0  # standard deviations that a residual counts at most


def shapes(
    vehicle: Vehicle, log: Segments, energy_wh: Float[np.ndarray, " row"]
) -> Float[np.ndarray, "row instrument"]:
    """Energy [Wh] that one unit of each instrument's noise is, in each row, by the kernel's derivatives.

    `energy_wh` is the measured: a model that strays would be let stray by a noise in proportion to what it says.
    """
    climb, kick = (np.abs(np.asarray(x)) for x in _slopes(vehicle, log))
    return np.stack([np.ones_like(energy_wh), np.abs(energy_wh), climb, kick], axis=1)


def believed(
    log: Segments, instruments: Float[np.ndarray, " instrument"], moves: Bool[np.ndarray, " row"]
) -> list[Segments]:
    """Logs of equal weight that stand for what slopes and changes of speed may have been, given their readings.

    A truth that is uncertain by c about what its reading x tells lies at x + ρ·(x̄ − x) ± c, where ρ(1 − ρ)·Var x = c²:
    the best linear guess of it from the reading and that guess's variance (regression calibration: Carroll et al.,
    Measurement Error in Nonlinear Models, chapter 4). The reading's own error is c/√(1 − ρ), ρ at most one half; where
    every reading is the same, as where the log has none, ρ is 0. Rows that stand are as they were read.
    """
    log, sides = jax.tree.map(np.asarray, log), []
    slope = np.asarray(log.get("grade_rad", np.zeros(len(log))))
    for name, read in (("grade_rad", slope), ("speed_mps", log.speed_end_mps - log.speed_start_mps)):
        sd = float(instruments[INSTRUMENTS.index(name)])
        known = {"grade_rad": GRADE_SD, "speed_mps": ACCEL_SD}[name]
        if sd == 0.0 or log.has(known):  # the kernel takes the expectation over that error itself
            sides.append([0.0])
            continue
        moving = read[moves]
        spread = float(np.var(moving))
        share = 0.5 * (1.0 - np.sqrt(max(1.0 - 4.0 * sd**2 / spread, 0.0))) if spread > 0 else 0.0
        nearer = share * (float(np.mean(moving)) - read)
        sides.append([np.where(moves, nearer + side, 0.0) for side in (sd, -sd)])
    return [shifted(log, *errors) for errors in product(*sides)]


def shifted(log: Segments, slope_rad: ArrayLike, change_mps: ArrayLike) -> Segments:
    """The log with slopes and changes of speed higher by so much, a number or one for each row."""
    ends = log.speed_start_mps - 0.5 * change_mps, log.speed_end_mps + 0.5 * change_mps
    moved = eqx.tree_at(lambda s: (s.speed_start_mps, s.speed_end_mps), log, ends)
    if log.has(ACCEL_OF_WAY):
        moved = moved.with_channels(**{ACCEL_OF_WAY: log.channels[ACCEL_OF_WAY] + change_mps / log.duration_s})
    return moved.with_channels(grade_rad=log.get("grade_rad", np.zeros(len(log))) + slope_rad)


@eqx.filter_jit
def _slopes(vehicle: Vehicle, log: Segments) -> tuple[jax.Array, jax.Array]:
    """∂E/∂slope, ∂E/∂(change of speed) of each row."""

    def energy(slope: jax.Array, change: jax.Array) -> jax.Array:
        return vehicle.energy(shifted(log, slope, change))

    zero, one = jnp.zeros(len(log)), jnp.ones(len(log))
    return jax.jvp(energy, (zero, zero), (one, zero))[1], jax.jvp(energy, (zero, zero), (zero, one))[1]


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
        within = np.minimum(squares, FARTHEST**2 * variance)
        found, _ = nnls(parts / variance[:, None], within / variance)
        new = np.sqrt(variance * np.maximum(parts @ found, least**2))  # half of the way, or two answers may take turns
        settled = np.max(np.abs(np.log(new / variance))) < STEADY
        variance = new
        if settled:
            break
    return np.sqrt(variance), np.sqrt(found / scale)
