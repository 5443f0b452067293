"""Efficiency maps by gear, wheel to battery, from a loss model with published terms.

η = P_out/(P_out + losses) at the motor shaft, with, as Larminie and Lowry, Electric Vehicle Technology Explained,
equation 7.23, losses = k_c·τ² (copper) + k_i·ω (iron) + k_w·ω³ (windage) + C (electronics), and for the gears a share
of the power for each mesh in use (Naunheimer, Fahrzeuggetriebe: 0.5 to 1 % a mesh of a helical gear; a direct gear
has none in the gearbox, the final drive is always there). The shape that follows is the published one: low at little
torque, a broad optimum of about 0.92 around the base speed at half the torque, falling towards the corners."""

import numpy as np

from hdev_jax.fleet.variants import Variant

__all__ = ["LOWEST_EFFICIENCY", "MAX_GEARS", "efficiency_map", "padded_map"]

MAX_GEARS = 12
LOWEST_EFFICIENCY = 0.40  # what the map says where no power flows: a ratio of two small numbers there
_SPEED_SHARE = np.array([0.02, 0.08, 0.15, 0.25, 0.35, 0.45, 0.55, 0.65, 0.75, 0.87, 1.0])
_TORQUE_SHARE = np.array([0.02, 0.05, 0.10, 0.18, 0.30, 0.45, 0.60, 0.80, 1.0])
# Losses as shares of rated power: at rated torque, at base speed, at three times the base speed, always.
_COPPER, _IRON, _WINDAGE, _CONSTANT = 0.035, 0.016, 0.020, 0.003
_MESH_LOSS = 0.008


def efficiency_map(v: Variant) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Gears, motor speeds [rad/s], torques [Nm] and η [gear, speed, torque] of a variant; torque of both signs."""
    speeds = _SPEED_SHARE * v.max_speed_radps
    positive = _TORQUE_SHARE * v.torque_nm
    torques = np.concatenate([-positive[::-1], positive])
    base, rated = v.base_speed_radps, v.power_kw * 1e3
    w, t = np.meshgrid(speeds, np.abs(torques), indexing="ij")
    lost = rated * (
        _COPPER * (t / v.torque_nm) ** 2 + _IRON * (w / base) + _WINDAGE * (w / (3 * base)) ** 3 + _CONSTANT
    )
    electric = t * w / (t * w + lost)
    # the last gear of a box with several is direct; low gears of a box with range gear turn more wheels
    meshes = [1.0 if g == v.gears - 1 else 3.0 if v.gears > 6 and g < v.gears // 2 else 2.0 for g in range(v.gears)]
    values = np.stack([electric * (1.0 - _MESH_LOSS * m) for m in meshes])
    return np.arange(1.0, v.gears + 1), speeds, torques, np.maximum(values, LOWEST_EFFICIENCY).round(5)


def padded_map(v: Variant) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The same with `MAX_GEARS` gears, the last one repeated, so that all variants share one compiled program."""
    _, speeds, torques, values = efficiency_map(v)
    more = MAX_GEARS - v.gears
    return (
        np.arange(1.0, MAX_GEARS + 1),
        speeds,
        torques,
        np.concatenate([values, np.repeat(values[-1:], more, axis=0)]),
    )
