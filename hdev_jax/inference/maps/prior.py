"""What is known of an efficiency map before any log: what its losses are, and how smoothly they go on.

Nodes are in the order [gear, speed, torque], flattened. See `map_fit` for the prior as a whole.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from hdev_jax.physics import EfficiencyMap

__all__ = ["FARTHEST", "Losses", "roughness", "ties"]

FARTHEST = 12.0  # of a log loss from its prior mean: beyond any machine
NOTHING = 1e-6  # of an axis's end: an axis may miss 0 by rounding
Nodes = Float[np.ndarray, " node"]
Precision = Float[np.ndarray, "node node"]


@dataclass(frozen=True)
class Losses:
    """Log losses of nodes and what efficiency they are: `power_w` at each node's shaft, `mean` of the log losses."""

    power_w: Float[np.ndarray, " node"]
    mean: float

    @staticmethod
    def of(m: EfficiencyMap, efficiency: float) -> "Losses":
        """Of a grid. Where speed or torque is 0 no power flows: a node there counts as half of the way to the next."""
        speeds, torques = (_from_zero(x) for x in (m.speeds_radps, m.torques_nm))
        power = speeds[:, None] * torques[None, :]
        mean = np.log(0.5 * np.max(power) * (1.0 / efficiency - 1.0))
        return Losses(np.tile(power.ravel(), len(m.gears)), float(mean))

    def efficiency(self, u: np.ndarray) -> np.ndarray:
        return self.power_w / (self.power_w + np.exp(u))

    def logarithm(self, efficiency: np.ndarray) -> np.ndarray:
        lost = self.power_w * (1.0 / np.clip(efficiency, 1e-3, 0.999) - 1.0)
        return self.within(np.log(lost))

    def within(self, u: np.ndarray) -> np.ndarray:
        return np.clip(u, self.mean - FARTHEST, self.mean + FARTHEST)

    def slope(self, u: np.ndarray) -> np.ndarray:
        """∂η/∂u."""
        eta = self.efficiency(u)
        return -eta * (1.0 - eta)


def _from_zero(axis: Any) -> np.ndarray:
    size = np.abs(np.asarray(axis, dtype=float))
    return np.maximum(size, 0.5 * np.min(size[size > NOTHING * np.max(size)]))


def roughness(m: EfficiencyMap, order: int) -> Precision:
    """D'D of differences of an order, by node whatever its distance: along speed, along torque, and of each mixed kind.

    Nodes of no torque are left out: the efficiency that a table has there is a convention, which says nothing of its
    neighbours' losses. What lies on either side of them are neighbours then.
    """
    torque = np.abs(np.asarray(m.torques_nm, dtype=float))
    of_speed, of_torque = np.eye(m.values.shape[1]), np.eye(len(torque))[torque > NOTHING * np.max(torque)]
    square = lambda nodes, k: _square(np.diff(nodes, k, axis=0))  # noqa: E731
    part = sum(np.kron(square(of_speed, k), square(of_torque, order - k)) for k in range(order + 1))
    return np.kron(np.eye(m.values.shape[0]), part)


def ties(m: EfficiencyMap) -> Precision:
    """D'D of differences between neighbouring gears, and between torques of either sign where the grid has both."""
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
