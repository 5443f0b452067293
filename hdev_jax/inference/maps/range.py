"""How a log lies to the efficiency map of its sheet: which rows are beyond the table, and gears that it lacks."""

from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from hdev_jax.errors import InputError
from hdev_jax.physics import EfficiencyMap, Vehicle
from hdev_jax.segments import Segments

__all__ = ["read_against_map"]


def read_against_map(path: Path | None, vehicle: Vehicle, segments: Segments) -> list[str]:
    """A note with the share of the moving rows that lie beyond the map, where there are any.

    `path` is the map's file. Torques are those of the vehicle as declared. A map of one gear holds for all.

    **Raises:** `InputError` where the vehicle moves in a gear that the map does not have.
    """
    found = vehicle.driveline.efficiency
    assert isinstance(found, EfficiencyMap)
    moving = np.asarray(segments.distance_m) > 0
    _check_gears(path, found, segments, moving)
    speed, torque = _points(vehicle, segments)
    beyond = {
        "faster": speed > found.speeds_radps[-1], "slower": speed < found.speeds_radps[0],
        "more torque": torque > found.torques_nm[-1], "more torque in braking": torque < found.torques_nm[0],
    }  # fmt: skip
    every = np.asarray(found.outside(speed, torque)) & moving
    if not every.any():
        return []
    most = max(beyond, key=lambda k: np.sum(np.asarray(beyond[k]) & moving))
    s, t = (f"{float(a[0]):.4g} to {float(a[-1]):.4g}" for a in (found.speeds_radps, found.torques_nm))
    return [
        f"the efficiency map is read beyond its edge in {100 * every.sum() / moving.sum():.2g} % of the moving rows, "
        f"most often for {most}: there the value at its edge is used (the map covers {s} rad/s and {t} Nm)"
    ]


def _check_gears(path: Path | None, found: EfficiencyMap, segments: Segments, moving: np.ndarray) -> None:
    if len(found.gears) < 2 or not segments.has("gear"):
        return
    gear, known = np.asarray(segments.channels["gear"]), np.asarray(found.gears)
    odd = np.flatnonzero(moving & ~np.isin(gear, known))
    if len(odd):
        has = ", ".join(f"{g:g}" for g in known)
        raise InputError(
            f"efficiency map {path}: the log's row {odd[0] + 1} drives in gear {gear[odd[0]]:g}, and "
            f"{len(odd) - 1} more rows are in a gear that the map lacks; it has gears {has}: add the gear to the map"
        )


def _points(vehicle: Vehicle, segments: Segments) -> tuple[np.ndarray, np.ndarray]:
    """Motor speed [rad/s] and torque [Nm] of each row, as the map is read."""
    rows = jax.tree.map(jnp.asarray, segments)
    ratio = jax.vmap(vehicle.driveline.ratio_radpm)(rows) if len(segments) else jnp.zeros(0)
    speed = rows.get("motor_speed_radps", rows.speed_mps * ratio)
    force = eqx.filter_jit(Vehicle.force)(vehicle, rows)
    return np.asarray(speed), np.asarray(force / ratio)
