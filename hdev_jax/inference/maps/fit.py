"""An efficiency map learned from a log: penalised least squares on the kernel, the penalty a smooth random field.

The unknowns are the losses at the nodes of a given grid, as logarithms: η = P/(P + exp(u)) with P = |τ|·ω the power at
the shaft, for driving and for braking. Losses go on smoothly where the torque changes its sign and the efficiency falls
off a cliff, so that what is known of them at larger torques tells of those at small ones. A priori u is Gaussian of
precision

    P = smooth·D₃'D₃ + straight·D₂'D₂ + alike·(D_g'D_g + D_±'D_±) + I/wide²,

third and second differences along speed, torque and both (steps of one node), first differences from gear to gear and
between torques of either sign, since copper and iron do not know which way the power flows: a Gaussian Markov random
field (Rue and Held, Gaussian Markov Random Fields, section 3.4), all but improper, so that nothing draws losses to a
mean where the log has not been. `smooth` is chosen by the marginal likelihood of the log (Laplace), and so is the
noise, which is not alike in all rows (`row_noise`). Slopes and speeds were read with the errors that this noise tells
of, and energies are not linear in them where the torque changes its sign: each row's is its mean over what they may
have been (`believed`). Each step is Gauss and Newton's, damped where it leads uphill (Levenberg-Marquardt), with the
kernel's own Jacobian.
"""

from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy import sparse
from scipy.linalg import cho_factor, cho_solve, get_lapack_funcs

from hdev_jax.errors import InputError
from hdev_jax.inference.maps.prior import Losses, roughness, ties
from hdev_jax.inference.row_noise import INSTRUMENTS, believed, row_noise, shapes
from hdev_jax.inference.rows import padded
from hdev_jax.physics import EfficiencyMap, Vehicle
from hdev_jax.segments import Segments

__all__ = ["LearnedMap", "cells_of", "learn_map", "operating_points"]

SETTLED, NEARLY = 0.01, 3.0  # log-likelihood that the last step gained, and that one more would by its own reckoning
MOST_DAMPED = 8
STEADY = 0.01  # of any row's noise, from step to step
REACH = 4  # nodes along each axis that a row's efficiency depends on: its cell's two, and one more on either side
# Tried, the smoothest first, from which the rougher ones begin, until the log has been less likely twice: 1e2 is bends
# of the log losses that change by 0.1 from node to node.
SMOOTH = tuple(float(s) for s in np.geomspace(1e3, 1e-2, 11))
WORSE = 2


@dataclass(frozen=True)
class LearnedMap:
    """The map; `sd` of its nodes' efficiencies [gear, speed, torque]; `rows`, how many of those that move are in each
    cell [gear, speed cell, torque cell].

    `noise_wh` is the estimated noise of a moving row's energy [Wh], in the quadratic mean, `instruments` the sds that
    it comes from (`row_noise.INSTRUMENTS`, with their units), `smooth` the chosen strength, `evidence` the log marginal
    likelihood by strength tried. `converged`: one more step would gain next to nothing. `sd` and `evidence` have the
    kernel's derivatives at what was read, which makes `sd` some per cent too small where slopes are read badly.
    """

    map: EfficiencyMap
    sd: Float[np.ndarray, "gear speed torque"]
    rows: np.ndarray
    noise_wh: float
    instruments: dict[str, float]
    smooth: float
    evidence: dict[float, float]
    converged: bool


def learn_map(
    vehicle: Vehicle,
    segments: Segments,
    energy_wh: Float[np.ndarray, " row"],
    start: EfficiencyMap,
    *,
    mean: float = 0.85,
    wide: float = 10.0,
    alike: float = 1e2,
    straight: float = 3.0,
    smooth: tuple[float, ...] = SMOOTH,
    max_steps: int = 40,
) -> LearnedMap:
    """Learn the driveline's map on the grid of `start`, all else of the vehicle being known.

    **Arguments:** `energy_wh`, measured [row]; `start`, the grid, and the values where the search begins; `mean`, the
    efficiency at half of the grid's highest power that the prior's losses stand for, `wide`, the sd of a log loss about
    them; `alike`, precision of the difference of log losses between neighbouring gears, and between torques of either
    sign where the grid has both; `straight`, precision of a bend from node to node, which is what tells where the log
    has not been; `smooth`, those of a bend's change that are tried.

    **Raises:** `InputError` where the log has no gear, or one that the grid lacks, or too few rows that move; for
    energies that are no numbers or of another length, and a grid of less than two speeds and two torques.
    """
    energy_wh = np.asarray(energy_wh, dtype=float)
    if not smooth or min(smooth) <= 0.0 or not 0.0 < mean < 1.0 or min(wide, alike, straight) <= 0.0:
        raise ValueError("strengths of the prior are above 0, its mean is an efficiency between 0 and 1")
    _check(segments, energy_wh, start)
    rows = padded(segments, energy_wh)  # with rows that stand
    problem = _Problem(vehicle, rows.segments, np.asarray(rows.measured), start)
    losses = Losses.of(start, mean)
    theta, instruments = losses.logarithm(np.asarray(start.values, dtype=float).ravel()), np.zeros(len(INSTRUMENTS))
    fixed = alike * ties(start) + straight * roughness(start, 2) + np.eye(theta.size) / wide**2
    rough = roughness(start, 3)
    fits: list[_Fit] = []
    best = None
    for strength in smooth:
        fit = _fit(_Posterior(problem, losses, strength * rough + fixed), strength, theta, instruments, max_steps)
        fits.append(fit)
        if fit.converged:
            theta, instruments = fit.theta, fit.instruments  # the next strength begins where this one ended
        best = max(fits, key=lambda f: (f.converged, f.evidence))
        if len(fits) - fits.index(best) > WORSE:
            break
    assert best is not None
    eta = losses.efficiency(best.theta)
    away = np.sqrt(np.diag(_inverse(best.factor)))
    # half of what lies within one sd of the log loss to either side: where the log has not been that is far
    sd = 0.5 * (losses.efficiency(best.theta - away) - losses.efficiency(best.theta + away))
    values = jnp.asarray(eta.reshape(start.values.shape))
    return LearnedMap(
        map=eqx.tree_at(lambda m: m.values, start, values),
        sd=sd.reshape(values.shape),
        rows=problem.rows_by_cell(),
        noise_wh=float(np.sqrt(np.mean(best.noise**2))),
        instruments=dict(zip(INSTRUMENTS, best.instruments.tolist(), strict=True)),
        smooth=best.strength,
        evidence={f.strength: f.evidence for f in fits},
        converged=best.converged,
    )


def _check(log: Segments, energy_wh: np.ndarray, start: EfficiencyMap) -> None:
    what = "learning an efficiency map"
    if energy_wh.shape != (len(log),) or not np.all(np.isfinite(energy_wh)):
        found = int(np.sum(np.isfinite(energy_wh)))
        raise InputError(f"{what}: a finite energy for each of {len(log)} rows is expected, found {found}")
    if min(start.values.shape[1:]) < 2 or not np.all(np.isfinite(np.asarray(start.values))):
        raise InputError(f"{what}: a grid of two speeds and two torques or more, with finite values, is expected")
    if not log.has("gear"):
        raise InputError(f"{what}: the log has no column 'gear'")
    for name in ("grade_rad", "mass_kg"):
        if len(odd := np.flatnonzero(~np.isfinite(np.asarray(log.get(name, np.zeros(len(log))))))):
            raise InputError(
                f"{what}: row {odd[0] + 1}, column '{name}': a number is expected; fill it or leave the row out"
            )
    moving = np.asarray(log.distance_m) > 0
    gear = np.asarray(log.channels["gear"])
    if odd := sorted(set(gear[moving].tolist()) - set(np.asarray(start.gears).tolist())):
        raise InputError(f"{what}: the log drives in gear {odd[0]:g}, which the grid does not have")
    if moving.sum() < 50:
        raise InputError(f"{what}: {moving.sum()} rows that move; at least 50 are expected")


class _Problem:
    """Energies and their Jacobian by the nodes, as functions of the nodes' efficiencies."""

    def __init__(self, vehicle: Vehicle, log: Segments, measured: np.ndarray, start: EfficiencyMap):
        self.log, self.measured, self.shape = log, measured, start.values.shape
        self.start, self.vehicle = start, vehicle
        self.moving = np.asarray(log.distance_m) > 0  # what stands says nothing of a map
        known = eqx.tree_at(lambda v: v.driveline.efficiency, vehicle, start)
        self.shapes = shapes(known, log, measured)[self.moving]
        speed, torque = eqx.filter_jit(operating_points)(vehicle, log)
        self.place = cells_of(start, np.asarray(log.channels["gear"]), np.asarray(speed), np.asarray(torque))

    def residual(self, eta: np.ndarray, logs: list[Segments]) -> np.ndarray:
        """Of the rows that move, a row's energy being its mean over the logs."""
        energies = [np.asarray(_energy(self.vehicle, self.start, log, jnp.asarray(eta))) for log in logs]
        return (self.measured - np.mean(energies, axis=0))[self.moving]

    def back(self, eta: np.ndarray, weighted: np.ndarray, logs: list[Segments]) -> np.ndarray:
        """J'·weighted, J = ∂E/∂η of the rows that move, as exact where an effect acts across rows."""
        every = np.zeros(len(self.moving))
        every[self.moving] = weighted / len(logs)
        each = (_back(self.vehicle, self.start, log, jnp.asarray(eta), jnp.asarray(every)) for log in logs)
        return np.sum([np.asarray(x) for x in each], axis=0)

    def jacobian(self, eta: np.ndarray) -> sparse.csr_matrix:
        """∂E/∂η [row that moves, node] at what was read, without what neighbouring rows lend each other.

        A row reads the 4×4 nodes around its cell, so that nodes which are four apart along speed or torque share a
        derivative: sixteen of the kernel's make them all (Curtis, Powell and Reid, 1974).
        """
        g, i, j = self.place
        rows, entries = np.arange(len(g)), []
        of_speed, of_torque = (np.arange(n) % REACH for n in self.shape[1:])
        for a in range(REACH):
            for b in range(REACH):
                along = np.broadcast_to(np.outer(of_speed == a, of_torque == b), self.shape).astype(float)
                direction = jnp.asarray(eta), jnp.asarray(along.ravel())
                slope = np.asarray(_slope(self.vehicle, self.start, self.log, *direction))
                # the one node of these within reach of the row
                m, n = (k - 1 + (c - k + 1) % REACH for k, c in ((i, a), (j, b)))
                there = (m >= 0) & (m < self.shape[1]) & (n >= 0) & (n < self.shape[2]) & (slope != 0)
                node = np.ravel_multi_index((g[there], m[there], n[there]), self.shape)
                entries.append((slope[there], rows[there], node))
        slope, row, node = (np.concatenate(x) for x in zip(*entries, strict=True))
        return sparse.csr_matrix((slope, (row, node)), shape=(len(g), int(np.prod(self.shape))))[self.moving]

    def rows_by_cell(self) -> np.ndarray:
        """Rows that move in each cell; those beyond the grid count in the cell at its edge."""
        out = np.zeros((self.shape[0], self.shape[1] - 1, self.shape[2] - 1), dtype=int)
        np.add.at(out, tuple(k[self.moving] for k in self.place), 1)
        return out


@eqx.filter_jit
def _energy(vehicle: Vehicle, start: EfficiencyMap, log: Segments, values: Any) -> Any:
    found = eqx.tree_at(lambda m: m.values, start, values.reshape(start.values.shape))
    return eqx.tree_at(lambda v: v.driveline.efficiency, vehicle, found).energy(log)


@eqx.filter_jit
def _slope(vehicle: Vehicle, start: EfficiencyMap, log: Segments, values: Any, along: Any) -> Any:
    return jax.jvp(lambda x: _energy(vehicle, start, log, x), (values,), (along,))[1]


@eqx.filter_jit
def _back(vehicle: Vehicle, start: EfficiencyMap, log: Segments, values: Any, weighted: Any) -> Any:
    return jax.vjp(lambda x: _energy(vehicle, start, log, x), values)[1](weighted)[0]


def operating_points(vehicle: Vehicle, log: Segments) -> Any:
    """Motor speed [rad/s] and torque [Nm] of each row, as the map sees them."""
    ratio = jax.vmap(vehicle.driveline.ratio_radpm)(log)
    return log.get("motor_speed_radps", log.speed_mps * ratio), vehicle.force(log) / ratio


def cells_of(m: EfficiencyMap, gear: np.ndarray, speed: np.ndarray, torque: np.ndarray) -> tuple[np.ndarray, ...]:
    """Places of each row's gear and of its cell along speed and torque; the cell at the edge for what is beyond it."""
    g = np.argmin(np.abs(np.asarray(m.gears)[None, :] - gear[:, None]), axis=1)
    cells = []
    for axis, x in ((np.asarray(m.speeds_radps), speed), (np.asarray(m.torques_nm), torque)):
        cells.append(np.clip(np.searchsorted(axis, x, side="right") - 1, 0, len(axis) - 2))
    return (g, *cells)


@dataclass(frozen=True)
class _Fit:
    """Log losses of the nodes with the Cholesky factor of their precision; noise by row and by instrument; whether it
    converged; the log marginal likelihood."""

    strength: float
    theta: np.ndarray
    factor: Any
    noise: np.ndarray
    instruments: np.ndarray
    converged: bool
    evidence: float


@dataclass(frozen=True)
class _Posterior:
    """Of log losses, given the noise."""

    problem: _Problem
    losses: Losses
    prior: np.ndarray

    def cost(self, residual: np.ndarray, noise: np.ndarray, theta: np.ndarray) -> float:
        away = theta - self.losses.mean
        return 0.5 * float(np.sum((residual / noise) ** 2) + away @ self.prior @ away)

    def quadratic(
        self, residual: np.ndarray, noise: np.ndarray, theta: np.ndarray, logs: list[Segments]
    ) -> tuple[Any, np.ndarray]:
        """Hessian (Gauss-Newton, at what was read) and downhill gradient."""
        eta, slope = self.losses.efficiency(theta), self.losses.slope(theta)
        jac = self.problem.jacobian(eta).multiply(slope[None, :]).multiply(1.0 / noise[:, None]).tocsr()
        pull = slope * self.problem.back(eta, residual / noise**2, logs) - self.prior @ (theta - self.losses.mean)
        return (jac.T @ jac).toarray() + self.prior, pull


def _fit(posterior: _Posterior, strength: float, theta: np.ndarray, instruments: np.ndarray, max_steps: int) -> _Fit:
    problem, losses = posterior.problem, posterior.losses
    logs = believed(problem.log, instruments, problem.moving)
    residual = problem.residual(losses.efficiency(theta), logs)
    if len(odd := np.flatnonzero(~np.isfinite(residual))):
        row = int(np.flatnonzero(problem.moving)[odd[0]]) + 1
        raise InputError(
            f"learning an efficiency map: the vehicle's energy in row {row} is not finite; correct its channels"
        )
    least = 1e-6 * float(np.sqrt(np.mean(problem.measured**2))) + 1e-6  # [Wh], for energies without any noise
    noise, instruments = row_noise(residual, problem.shapes, 0.0, least)
    done, damping = False, 0.0
    for _ in range(max_steps):
        hessian, pull = posterior.quadratic(residual, noise, theta, logs)
        factor = cho_factor(hessian)
        # what a whole step would gain if costs were quadratic, in log-likelihood; they have kinks where the map's own
        # slopes turn to 0, at the bottom of which it is never quite nothing
        done = 0.5 * float(pull @ cho_solve(factor, pull)) < NEARLY
        before = posterior.cost(residual, noise, theta)
        for _ in range(MOST_DAMPED):
            damped = cho_factor(hessian + damping * np.diag(np.diag(hessian))) if damping else factor
            step = cho_solve(damped, pull)
            tried = losses.within(theta + step)
            left = problem.residual(losses.efficiency(tried), logs)
            after = posterior.cost(left, noise, tried)
            if after < before:
                damping = damping / 10.0 if damping > 1e-3 else 0.0
                break
            damping = max(10.0 * damping, 1e-2)
        else:
            break  # nowhere downhill
        theta = tried
        # effective number of nodes (MacKay, Neural Computation 4, 1992): the noise that explains the residual
        used = theta.size - float(np.sum(_inverse(factor) * posterior.prior))
        last = noise
        noise, instruments = row_noise(left, problem.shapes, used, least)
        logs = believed(problem.log, instruments, problem.moving)
        residual = problem.residual(losses.efficiency(theta), logs)
        still = float(np.max(np.abs(np.log(noise / last)))) < STEADY
        if done and still and before - after < SETTLED:
            break
        done = False
    factor = cho_factor(posterior.quadratic(residual, noise, theta, logs)[0])
    sizes = np.linalg.slogdet(posterior.prior)[1], 2 * float(np.sum(np.log(np.diag(factor[0]))))
    evidence = -posterior.cost(residual, noise, theta) - float(np.sum(np.log(noise))) + 0.5 * (sizes[0] - sizes[1])
    return _Fit(strength, theta, factor, noise, instruments, done, float(evidence))


def _inverse(factor: tuple[np.ndarray, bool]) -> np.ndarray:
    """Of the symmetric matrix whose Cholesky factor this is."""
    (potri,) = get_lapack_funcs(("potri",), (factor[0],))
    inverse, _ = potri(factor[0], lower=factor[1])
    half = np.tril(inverse) if factor[1] else np.triu(inverse)
    return half + half.T - np.diag(np.diag(half))
