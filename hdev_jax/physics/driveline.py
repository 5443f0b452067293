"""Gears and their losses: the ratio between motor and road, and an efficiency or a map of it."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from hdev_jax.segments import Segments

__all__ = ["WHEEL_RADIUS_M", "Driveline", "EfficiencyMap"]

WHEEL_RADIUS_M = (22.5 * 0.0254 / 2) + 0.70 * 0.275  # 275/70 R22.5, the common size on heavy trucks and city buses


class EfficiencyMap(eqx.Module):
    """Efficiency over gear, motor speed and torque: bilinear inside a gear's grid, clamped at its edges.

    **Arguments:** `gears` [g], `speeds_radps` [s] and `torques_nm` [t], increasing; `values` [g, s, t] in (0, 1].
    A gear between two of the map takes the nearest.
    """

    gears: Float[Array, " gear"]
    speeds_radps: Float[Array, " speed"]
    torques_nm: Float[Array, " torque"]
    values: Float[Array, "gear speed torque"]

    def __call__(self, gear: Any, speed_radps: Any, torque_nm: Any) -> Any:
        """Efficiency at one operating point. Slopes are the cell's (at a node of the one above), 0 past the edges."""
        g = jnp.argmin(jnp.abs(self.gears - gear))
        i, a = _cell(self.speeds_radps, speed_radps)
        j, b = _cell(self.torques_nm, torque_nm)
        z = self.values
        low = z[g, i, j] * (1 - b) + z[g, i, j + 1] * b
        high = z[g, i + 1, j] * (1 - b) + z[g, i + 1, j + 1] * b
        return low * (1 - a) + high * a


def _cell(axis: Array, x: Any) -> tuple[Any, Any]:
    """The cell of `axis` that holds x and the place inside it, 0 to 1."""
    i = jnp.clip(jnp.searchsorted(axis, x, side="right") - 1, 0, axis.shape[0] - 2)
    # clamped before it is divided: a clip of the place to 0..1 would halve the slope at every node
    return i, (jnp.clip(x, axis[0], axis[-1]) - axis[i]) / (axis[i + 1] - axis[i])


class Driveline(eqx.Module):
    """Between wheel and motor shaft.

    **Arguments:** `efficiency`, a number in (0, 1] or an `EfficiencyMap`; `gear_ratios` by gear from the first,
    `final_drive` and `wheel_radius_m` where known: without them torques and speeds are those of a wheel of
    `WHEEL_RADIUS_M`. `covers_machine`: the efficiency reaches from the wheel to the battery, as η in paper 1.
    """

    efficiency: Any
    gear_ratios: Float[Array, " gear"] | None = None
    final_drive: Any = 1.0
    wheel_radius_m: Any = WHEEL_RADIUS_M
    covers_machine: bool = eqx.field(static=True, default=True)

    def ratio_radpm(self, row: Segments) -> Any:
        """Motor speed over vehicle speed [rad/m], by the row's gear."""
        if self.gear_ratios is None:
            gear_ratio: Any = 1.0
        elif self.gear_ratios.shape[0] == 1 or not row.has("gear"):
            gear_ratio = self.gear_ratios[-1]
        else:
            gear = jnp.asarray(row.channels["gear"]).astype(int)
            gear_ratio = self.gear_ratios[jnp.clip(gear - 1, 0, self.gear_ratios.shape[0] - 1)]
        return gear_ratio * self.final_drive / self.wheel_radius_m

    def efficiency_at(self, row: Segments, speed_radps: Any, torque_nm: Any) -> Any:
        """Efficiency of this row: the number, or the map at gear, motor speed and torque."""
        if isinstance(self.efficiency, EfficiencyMap):
            return self.efficiency(row.get("gear", 1.0), speed_radps, torque_nm)
        return self.efficiency
