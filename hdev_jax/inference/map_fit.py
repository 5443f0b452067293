"""An efficiency map learned from a log: penalised least squares on the kernel, the penalty a smooth random field.

The unknowns are the losses at the nodes of a given grid, as logarithms: η = P/(P + exp(u)) with P = |τ|·ω the power at
the shaft, for driving and for braking. Losses go on smoothly where the torque changes its sign and the efficiency falls
off a cliff, so that what is known of them at larger torques tells of those at small ones. A priori u is Gaussian of
precision

    P = smooth·(D_ss'D_ss + D_tt'D_tt + D_st'D_st) + gears·D_g'D_g + I/wide²,

second differences along speed and torque (steps of one node) and first differences from gear to gear: a Gaussian
Markov random field (Rue and Held, Gaussian Markov Random Fields, section 3.4). `smooth` is chosen by the marginal
likelihood of the log (Laplace), and so is the noise. Each step solves the normal equations with the kernel's own
gradient; the bilinear weights of the nodes stand for the map's own in the curvature alone, which decides the pace and
the uncertainty and not where the fit ends.
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

__all__ = ["LearnedMap", "learn_map", "operating_points"]

FARTHEST = 12.0  # of a log loss from its prior mean: beyond any machine
# Tried, the smoothest first, from which the rougher ones begin: 1e2 is a bend of the losses of 10 % from node to node.
SMOOTH = tuple(float(s) for s in np.geomspace(1e3, 1e-2, 6))


@dataclass(frozen=True)
class LearnedMap:
    """The map; `sd` of its nodes [gear, speed, torque]; `rows`, how many of the log each cell has [gear, cell, cell].

    `noise_wh` is the estimated noise of a row's energy, `smooth` the chosen strength, `evidence` the log marginal
    likelihood by strength tried. `converged`: the last step moved no node by more than 1e-4.
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
    gears: float = 1e2,
    smooth: tuple[float, ...] = SMOOTH,
    max_steps: int = 40,
) -> LearnedMap:
    """Learn the driveline's map on the grid of `start`, all else of the vehicle being known.

    **Arguments:** `energy_wh`, measured [row]; `start`, the grid, and the values where the search begins; `mean`, the
    efficiency at half of the grid's highest power that the prior's losses stand for, `wide`, the sd of a log loss about
    them; `gears`, precision of the difference of log losses between neighbouring gears.

    **Raises:** `InputError` where the log has no gear, or one that the grid lacks, or too few rows that move.
    """
    log = segments
    if not log.has("gear"):
        raise InputError("learning an efficiency map: the log has no column 'gear'")
    moving = np.asarray(log.distance_m) > 0
    gear = np.asarray(log.channels["gear"])
    if odd := sorted(set(gear[moving].tolist()) - set(np.asarray(start.gears).tolist())):
        raise InputError(f"learning an efficiency map: the log drives in gear {odd[0]:g}, which the grid does not have")
    if moving.sum() < 50:
        raise InputError(f"learning an efficiency map: {moving.sum()} rows that move; at least 50 are expected")
    problem = _Problem(vehicle, jax.tree.map(jnp.asarray, log), np.asarray(energy_wh, dtype=float), start)
    bends, ties = _bends(start), _ties(start)
    losses = _Losses.of(start, mean)
    theta, noise = losses.logarithm(np.asarray(start.values, dtype=float).ravel()), 0.0
    evidence: dict[float, float] = {}
    best: tuple[float, Any] | None = None
    for strength in smooth:
        prior = strength * bends + gears * ties + np.eye(theta.size) / wide**2
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
    return LearnedMap(learned, sd, problem.rows_by_cell(learned), noise, chosen, evidence, done)


@dataclass(frozen=True)
class _Losses:
    """Log losses of nodes and what efficiency they are: `power_w` at each node's shaft, `mean` of the log losses."""

    power_w: Float[np.ndarray, " node"]
    mean: float

    @staticmethod
    def of(m: EfficiencyMap, efficiency: float) -> "_Losses":
        """Of a grid. At speed 0 no power flows: a node there counts as half of the way to the next."""
        speeds = np.asarray(m.speeds_radps, dtype=float)
        slow = 0.5 * float(np.min(speeds[speeds > 0]))
        power = np.maximum(speeds, slow)[:, None] * np.maximum(np.abs(np.asarray(m.torques_nm)), 1e-3)[None, :]
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


class _Problem:
    """Energies, their slopes by each row's own efficiency, and the gradient by the nodes, as functions of the nodes."""

    def __init__(self, vehicle: Vehicle, log: Segments, measured: np.ndarray, start: EfficiencyMap):
        self.log, self.measured, self.shape = log, measured, start.values.shape
        self.start, self.vehicle = start, vehicle
        speed, torque = eqx.filter_jit(operating_points)(vehicle, log)
        self.place = _places(start, np.asarray(log.channels["gear"]), np.asarray(speed), np.asarray(torque))
        self.weights = _weights(start, *self.place)
        self._energy = eqx.filter_jit(self._with)
        self._slope = eqx.filter_jit(lambda z: jax.jvp(self._with, (z,), (jnp.ones_like(z),))[1])
        self._pull = eqx.filter_jit(lambda z, r: jax.vjp(self._with, z)[1](r)[0])

    def _with(self, values: Any) -> Any:
        found = eqx.tree_at(lambda m: m.values, self.start, values.reshape(self.shape))
        return eqx.tree_at(lambda v: v.driveline.efficiency, self.vehicle, found).energy(self.log)

    def residual(self, eta: np.ndarray) -> np.ndarray:
        return self.measured - np.asarray(self._energy(jnp.asarray(eta)))

    def gradient(self, eta: np.ndarray, residual: np.ndarray) -> np.ndarray:
        """J'r, by the kernel."""
        return np.asarray(self._pull(jnp.asarray(eta), jnp.asarray(residual)))

    def curvature(self, eta: np.ndarray) -> np.ndarray:
        """J'J. A shift of all nodes shifts each row's efficiency by as much: that is ∂E/∂η, the weights do the rest."""
        j = self.weights.multiply(np.asarray(self._slope(jnp.asarray(eta)))[:, None]).tocsr()
        return (j.T @ j).toarray()

    def rows_by_cell(self, found: EfficiencyMap) -> np.ndarray:
        g, i, _, j, _ = self.place
        out = np.zeros((self.shape[0], self.shape[1] - 1, self.shape[2] - 1), dtype=int)
        use = np.asarray(self.log.distance_m) > 0
        np.add.at(out, (g[use], i[use], j[use]), 1)
        return out


def operating_points(vehicle: Vehicle, log: Segments) -> Any:
    """Motor speed [rad/s] and torque [Nm] of each row, as the map sees them."""
    ratio = jax.vmap(vehicle.driveline.ratio_radpm)(log)
    return log.get("motor_speed_radps", log.speed_mps * ratio), vehicle.force(log) / ratio


def _places(m: EfficiencyMap, gear: np.ndarray, speed: np.ndarray, torque: np.ndarray) -> tuple[np.ndarray, ...]:
    g = np.argmin(np.abs(np.asarray(m.gears)[None, :] - gear[:, None]), axis=1)
    out: list[np.ndarray] = [g]
    for axis, x in ((np.asarray(m.speeds_radps), speed), (np.asarray(m.torques_nm), torque)):
        i = np.clip(np.searchsorted(axis, x, side="right") - 1, 0, len(axis) - 2)
        out += [i, (np.clip(x, axis[0], axis[-1]) - axis[i]) / (axis[i + 1] - axis[i])]
    return tuple(out)


def _weights(m: EfficiencyMap, g: np.ndarray, i: np.ndarray, a: np.ndarray, j: np.ndarray, b: np.ndarray) -> Any:
    """Bilinear weights of the nodes [row, node]."""
    shape, rows = m.values.shape, np.arange(len(g))
    parts = [
        (np.ravel_multi_index((g, i + p, j + q), shape), (a if p else 1 - a) * (b if q else 1 - b))
        for p in (0, 1) for q in (0, 1)
    ]  # fmt: skip
    node, weight = (np.concatenate(x) for x in zip(*parts, strict=True))
    return sparse.csr_matrix((weight, (np.tile(rows, 4), node)), shape=(len(g), int(np.prod(shape))))


def _bends(m: EfficiencyMap) -> np.ndarray:
    """D'D of second differences along speed and torque and across both."""
    gears, speeds, torques = m.values.shape
    first, second = (lambda n, k=k: _square(np.diff(np.eye(n), k, axis=0)) for k in (1, 2))
    part = np.kron(second(speeds), np.eye(torques)) + np.kron(np.eye(speeds), second(torques))
    return np.kron(np.eye(gears), part + np.kron(first(speeds), first(torques)))


def _ties(m: EfficiencyMap) -> np.ndarray:
    gears, speeds, torques = m.values.shape
    return np.kron(_square(np.diff(np.eye(gears), axis=0)), np.eye(speeds * torques))


def _square(d: np.ndarray) -> np.ndarray:
    return d.T @ d


def _fit(problem: _Problem, losses: _Losses, prior: np.ndarray, theta: np.ndarray, max_steps: int) -> Any:
    """Log losses of the nodes, covariance, noise, whether it converged, and the log marginal likelihood."""
    count = len(problem.measured)
    residual = problem.residual(losses.efficiency(theta))
    noise = float(np.std(residual))
    done = False

    def curvature(theta: np.ndarray) -> np.ndarray:
        slope = losses.slope(theta)
        return problem.curvature(losses.efficiency(theta)) * np.outer(slope, slope) / noise**2 + prior

    def cost(residual: np.ndarray, theta: np.ndarray) -> float:
        away = theta - losses.mean
        return 0.5 * float(residual @ residual / noise**2 + away @ prior @ away)

    for _ in range(max_steps):
        factor = cho_factor(curvature(theta))
        pull = losses.slope(theta) * problem.gradient(losses.efficiency(theta), residual)
        step = cho_solve(factor, pull / noise**2 - prior @ (theta - losses.mean))
        before = cost(residual, theta)
        for _ in range(8):
            tried = np.clip(theta + step, losses.mean - FARTHEST, losses.mean + FARTHEST)
            after = problem.residual(losses.efficiency(tried))
            if cost(after, tried) <= before:
                break
            step = 0.5 * step
        moved = float(np.max(np.abs(losses.efficiency(tried) - losses.efficiency(theta))))
        theta, residual = tried, after
        # effective number of nodes (MacKay, Neural Computation 4, 1992): the noise that explains the residual
        used = theta.size - float(np.sum(cho_solve(factor, np.eye(theta.size)) * prior))
        noise = float(np.sqrt(residual @ residual / max(count - used, 1.0)))
        if moved < 1e-4:
            done = True
            break
    factor = cho_factor(curvature(theta))
    _, size_prior = np.linalg.slogdet(prior)
    size_post = 2 * float(np.sum(np.log(np.diag(factor[0]))))
    evidence = -cost(residual, theta) - count * np.log(noise) + 0.5 * (size_prior - size_post)
    return theta, cho_solve(factor, np.eye(theta.size)), noise, done, float(evidence)
