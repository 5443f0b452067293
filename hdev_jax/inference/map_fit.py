"""An efficiency map learned from a log: penalised least squares on the kernel, the penalty a smooth random field.

The unknowns are the losses at the nodes of a given grid, as logarithms: η = P/(P + exp(u)) with P = |τ|·ω the power at
the shaft, for driving and for braking. Losses go on smoothly where the torque changes its sign and the efficiency falls
off a cliff, so that what is known of them at larger torques tells of those at small ones. A priori u is Gaussian of
precision

    P = smooth·(D_ss'D_ss + D_tt'D_tt + D_st'D_st) + alike·(D_g'D_g + D_±'D_±) + I/wide²,

second differences along speed and torque (steps of one node), first differences from gear to gear and between torques
of either sign, since copper and iron do not know which way the power flows: a Gaussian Markov random field (Rue and
Held, Gaussian Markov Random Fields, section 3.4). `smooth` is chosen by the marginal likelihood of the log (Laplace),
and so is the noise. Each step is Gauss and Newton's, damped where it leads uphill (Levenberg-Marquardt), with the
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
from scipy.linalg import cho_factor, cho_solve

from hdev_jax.errors import InputError
from hdev_jax.physics import EfficiencyMap, Vehicle
from hdev_jax.segments import Segments

__all__ = ["LearnedMap", "cells_of", "learn_map", "operating_points"]

FARTHEST = 12.0  # of a log loss from its prior mean: beyond any machine
SETTLED, NEARLY = 0.01, 3.0  # log-likelihood that the last step gained, and that one more would by its own reckoning
MOST_DAMPED = 8
REACH = 4  # nodes along each axis that a row's efficiency depends on: its cell's two, and one more on either side
# Tried, the smoothest first, from which the rougher ones begin: 1e2 is a bend of the losses of 10 % from node to node,
# 1 one of a factor of e. Losses of a machine bend no more than that; an efficiency that is cut off somewhere does.
SMOOTH = tuple(float(s) for s in np.geomspace(1e3, 1e0, 4))


@dataclass(frozen=True)
class LearnedMap:
    """The map; `sd` of its nodes [gear, speed, torque]; `rows`, how many of the log each cell has [gear, cell, cell].

    `noise_wh` is the estimated noise of a row's energy, `smooth` the chosen strength, `evidence` the log marginal
    likelihood by strength tried. `converged`: one more step would gain next to nothing.
    """

    map: EfficiencyMap
    sd: Float[np.ndarray, "gear speed torque"]
    rows: np.ndarray
    noise_wh: float
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
    wide: float = 3.0,
    alike: float = 1e2,
    smooth: tuple[float, ...] = SMOOTH,
    max_steps: int = 40,
) -> LearnedMap:
    """Learn the driveline's map on the grid of `start`, all else of the vehicle being known.

    **Arguments:** `energy_wh`, measured [row]; `start`, the grid, and the values where the search begins; `mean`, the
    efficiency at half of the grid's highest power that the prior's losses stand for, `wide`, the sd of a log loss about
    them; `alike`, precision of the difference of log losses between neighbouring gears, and between torques of either
    sign where the grid has both.

    **Raises:** `InputError` where the log has no gear, or one that the grid lacks, or too few rows that move; for
    energies that are no numbers or of another length, and a grid of less than two speeds and two torques.
    """
    log, energy_wh = segments, np.asarray(energy_wh, dtype=float)
    if len(energy_wh) != len(log) or not np.all(np.isfinite(energy_wh)):
        raise InputError(
            f"learning an efficiency map: a finite energy for each of {len(log)} rows is expected, found "
            f"{int(np.sum(np.isfinite(energy_wh)))}"
        )
    if min(start.values.shape[1:]) < 2 or not np.all(np.isfinite(np.asarray(start.values))):
        raise InputError("learning an efficiency map: a grid of two speeds and two torques or more, with finite values")
    if not log.has("gear"):
        raise InputError("learning an efficiency map: the log has no column 'gear'")
    moving = np.asarray(log.distance_m) > 0
    gear = np.asarray(log.channels["gear"])
    if odd := sorted(set(gear[moving].tolist()) - set(np.asarray(start.gears).tolist())):
        raise InputError(f"learning an efficiency map: the log drives in gear {odd[0]:g}, which the grid does not have")
    if moving.sum() < 50:
        raise InputError(f"learning an efficiency map: {moving.sum()} rows that move; at least 50 are expected")
    problem = _Problem(vehicle, jax.tree.map(jnp.asarray, log), energy_wh, start)
    bends, ties = _bends(start), _ties(start)
    losses = _Losses.of(start, mean)
    theta = losses.logarithm(np.asarray(start.values, dtype=float).ravel())
    evidence: dict[float, float] = {}
    best: tuple[float, Any] | None = None
    for strength in smooth:
        prior = strength * bends + alike * ties + np.eye(theta.size) / wide**2
        fit = _fit(problem, losses, prior, theta, max_steps)
        theta = fit[0]  # the next strength begins where this one ended
        evidence[strength] = fit[-1]
        if best is None or fit[-1] > best[1][-1]:
            best = strength, fit
    assert best is not None
    chosen, (theta, covariance, noise, done, _) = best
    shape = start.values.shape
    eta = losses.efficiency(theta)
    learned = EfficiencyMap(start.gears, start.speeds_radps, start.torques_nm, jnp.asarray(eta.reshape(shape)))
    sd = (eta * (1.0 - eta) * np.sqrt(np.diag(covariance))).reshape(shape)
    return LearnedMap(learned, sd, problem.rows_by_cell(), noise, chosen, evidence, done)


@dataclass(frozen=True)
class _Losses:
    """Log losses of nodes and what efficiency they are: `power_w` at each node's shaft, `mean` of the log losses."""

    power_w: Float[np.ndarray, " node"]
    mean: float

    @staticmethod
    def of(m: EfficiencyMap, efficiency: float) -> "_Losses":
        """Of a grid. Where speed or torque is 0 no power flows: a node there counts as half of the way to the next."""
        speeds, torques = (_from_zero(x) for x in (m.speeds_radps, m.torques_nm))
        power = speeds[:, None] * torques[None, :]
        mean = np.log(0.5 * np.max(power) * (1.0 / efficiency - 1.0))
        return _Losses(np.tile(power.ravel(), len(m.gears)), float(mean))

    def efficiency(self, u: np.ndarray) -> np.ndarray:
        return self.power_w / (self.power_w + np.exp(u))

    def logarithm(self, efficiency: np.ndarray) -> np.ndarray:
        lost = self.power_w * (1.0 / np.clip(efficiency, 1e-3, 0.999) - 1.0)
        return np.clip(np.log(lost), self.mean - FARTHEST, self.mean + FARTHEST)

    def slope(self, u: np.ndarray) -> np.ndarray:
        """∂η/∂u."""
        eta = self.efficiency(u)
        return -eta * (1.0 - eta)


def _from_zero(axis: Any) -> np.ndarray:
    size = np.abs(np.asarray(axis, dtype=float))
    return np.maximum(size, 0.5 * np.min(size[size > 0]))


class _Problem:
    """Energies and their Jacobian by the nodes, as functions of the nodes' efficiencies."""

    def __init__(self, vehicle: Vehicle, log: Segments, measured: np.ndarray, start: EfficiencyMap):
        self.log, self.measured, self.shape = log, measured, start.values.shape
        self.start, self.vehicle = start, vehicle
        speed, torque = eqx.filter_jit(operating_points)(vehicle, log)
        self.place = cells_of(start, np.asarray(log.channels["gear"]), np.asarray(speed), np.asarray(torque))
        self._energy = eqx.filter_jit(self._with)
        self._slope = eqx.filter_jit(lambda z, along: jax.jvp(self._with, (z,), (along,))[1])

    def _with(self, values: Any) -> Any:
        found = eqx.tree_at(lambda m: m.values, self.start, values.reshape(self.shape))
        return eqx.tree_at(lambda v: v.driveline.efficiency, self.vehicle, found).energy(self.log)

    def residual(self, eta: np.ndarray) -> np.ndarray:
        return self.measured - np.asarray(self._energy(jnp.asarray(eta)))

    def jacobian(self, eta: np.ndarray) -> sparse.csr_matrix:
        """∂E/∂η [row, node]. A row reads the 4×4 nodes around its cell, so that nodes which are four apart along speed
        or torque share a derivative: sixteen of the kernel's make them all (Curtis, Powell and Reid, 1974)."""
        g, i, j = self.place
        rows, entries = np.arange(len(g)), []
        of_speed, of_torque = (np.arange(n) % REACH for n in self.shape[1:])
        for a in range(REACH):
            for b in range(REACH):
                along = np.broadcast_to(np.outer(of_speed == a, of_torque == b), self.shape).astype(float)
                slope = np.asarray(self._slope(jnp.asarray(eta), jnp.asarray(along.ravel())))
                # the one node of these within reach of the row
                m, n = (k - 1 + (c - k + 1) % REACH for k, c in ((i, a), (j, b)))
                there = (m >= 0) & (m < self.shape[1]) & (n >= 0) & (n < self.shape[2]) & (slope != 0)
                node = np.ravel_multi_index((g[there], m[there], n[there]), self.shape)
                entries.append((slope[there], rows[there], node))
        slope, row, node = (np.concatenate(x) for x in zip(*entries, strict=True))
        return sparse.csr_matrix((slope, (row, node)), shape=(len(g), int(np.prod(self.shape))))

    def rows_by_cell(self) -> np.ndarray:
        """Rows that move in each cell; those beyond the grid count in the cell at its edge."""
        out = np.zeros((self.shape[0], self.shape[1] - 1, self.shape[2] - 1), dtype=int)
        use = np.asarray(self.log.distance_m) > 0
        np.add.at(out, tuple(k[use] for k in self.place), 1)
        return out


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


def _bends(m: EfficiencyMap) -> np.ndarray:
    """D'D of second differences along speed and torque and across both."""
    gears, speeds, torques = m.values.shape
    first, second = (lambda n, k=k: _square(np.diff(np.eye(n), k, axis=0)) for k in (1, 2))
    part = np.kron(second(speeds), np.eye(torques)) + np.kron(np.eye(speeds), second(torques))
    return np.kron(np.eye(gears), part + np.kron(first(speeds), first(torques)))


def _ties(m: EfficiencyMap) -> np.ndarray:
    gears, speeds, torques = m.values.shape
    axis = np.asarray(m.torques_nm, dtype=float)
    pairs = [(j, k) for k in range(torques) for j in range(k) if np.isclose(axis[j], -axis[k], rtol=1e-6) and axis[k]]
    mirror = np.zeros((len(pairs), torques))
    for n, (j, k) in enumerate(pairs):
        mirror[n, [j, k]] = 1.0, -1.0
    by_gear = np.kron(_square(np.diff(np.eye(gears), axis=0)), np.eye(speeds * torques))
    return by_gear + np.kron(np.eye(gears * speeds), _square(mirror))


def _square(d: np.ndarray) -> np.ndarray:
    return d.T @ d


def _fit(problem: _Problem, losses: _Losses, prior: np.ndarray, theta: np.ndarray, max_steps: int) -> Any:
    """Log losses of the nodes, covariance, noise, whether it converged, and the log marginal likelihood."""
    count = len(problem.measured)
    residual = problem.residual(losses.efficiency(theta))
    least = 1e-6 * float(np.std(problem.measured))  # energies without any noise
    noise = max(float(np.std(residual)), least)
    done = False

    def quadratic(theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Hessian (Gauss-Newton) and downhill gradient."""
        jac = problem.jacobian(losses.efficiency(theta)).multiply(losses.slope(theta)[None, :]).tocsr() / noise
        return (jac.T @ jac).toarray() + prior, jac.T @ (residual / noise) - prior @ (theta - losses.mean)

    def cost(residual: np.ndarray, theta: np.ndarray) -> float:
        away = theta - losses.mean
        return 0.5 * float(residual @ residual / noise**2 + away @ prior @ away)

    damping = 0.0
    for _ in range(max_steps):
        hessian, pull = quadratic(theta)
        factor = cho_factor(hessian)
        # what a whole step would gain if costs were quadratic, in log-likelihood; they have kinks where the map's own
        # slopes turn to 0, at the bottom of which it is never quite nothing
        done = 0.5 * float(pull @ cho_solve(factor, pull)) < NEARLY
        before = cost(residual, theta)
        for _ in range(MOST_DAMPED):
            step = cho_solve(cho_factor(hessian + damping * np.diag(np.diag(hessian))), pull)
            tried = np.clip(theta + step, losses.mean - FARTHEST, losses.mean + FARTHEST)
            after = problem.residual(losses.efficiency(tried))
            if cost(after, tried) < before:
                damping = damping / 10.0 if damping > 1e-3 else 0.0
                break
            damping = max(10.0 * damping, 1e-2)
        else:
            break  # nowhere downhill
        gained = before - cost(after, tried)
        theta, residual = tried, after
        # effective number of nodes (MacKay, Neural Computation 4, 1992): the noise that explains the residual
        used = theta.size - float(np.sum(cho_solve(factor, np.eye(theta.size)) * prior))
        noise = max(float(np.sqrt(residual @ residual / max(count - used, 1.0))), least)
        if done and gained < SETTLED:
            break
        done = False
    factor = cho_factor(quadratic(theta)[0])
    _, size_prior = np.linalg.slogdet(prior)
    size_post = 2 * float(np.sum(np.log(np.diag(factor[0]))))
    evidence = -cost(residual, theta) - count * np.log(noise) + 0.5 * (size_prior - size_post)
    return theta, cho_solve(factor, np.eye(theta.size)), noise, done, float(evidence)
