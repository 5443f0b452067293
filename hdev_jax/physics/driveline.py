"""Gears and their losses: the ratio between motor and road, and an efficiency or a map of it."""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from hdev_jax.physics.parameter import as_array
from hdev_jax.segments import Segments

__all__ = ["GEAR_PROBABILITY", "WHEEL_RADIUS_M", "Driveline", "EfficiencyMap"]

# A channel [row, gear] in the place of `gear`: how likely each gear is, from the first; a gear surrogate adds it.
GEAR_PROBABILITY = "gear_probability"

WHEEL_RADIUS_M = (22.5 * 0.0254 / 2) + 0.70 * 0.275  # 275/70 R22.5, the common size on heavy trucks and city buses


class EfficiencyMap(eqx.Module):
    """Efficiency over gear, motor speed and torque: monotone cubic inside a gear's grid, clamped at its edges.

    Each cell is a bicubic Hermite patch. Its slopes at the nodes are those of the monotone cubic along each axis
    (Fritsch and Butland, SIAM J. Sci. Stat. Comput. 5, 1984). Unlike a bilinear patch it has a continuous gradient
    inside the grid. Unlike a spline it does not overshoot: along the lines of the grid it stays between its nodes, also
    beside the steep fall at small torque. On evenly spaced axes it reproduces a plane.

    **Arguments:** `gears` [g], `speeds_radps` [s] and `torques_nm` [t], increasing; `values` [g, s, t] in (0, 1].
    A gear that the map lacks takes the nearest one.
    """

    gears: Float[Array, " gear"] = eqx.field(converter=as_array)
    speeds_radps: Float[Array, " speed"] = eqx.field(converter=as_array)
    torques_nm: Float[Array, " torque"] = eqx.field(converter=as_array)
    values: Float[Array, "gear speed torque"] = eqx.field(converter=as_array)

    def __check_init__(self) -> None:
        axes = (self.gears, self.speeds_radps, self.torques_nm)
        for name, axis in zip(("gears", "speeds_radps", "torques_nm"), axes, strict=True):
            if not isinstance(axis, Tracer) and not np.all(np.diff(np.asarray(axis)) > 0):
                raise ValueError(f"efficiency map: {name} must increase from one to the next, found {np.asarray(axis)}")

    @jax.jit
    def __call__(self, gear: Any, speed_radps: Any, torque_nm: Any) -> Any:
        """Efficiency at one operating point. Beyond the edges it is that of the edge, and its slope across it is 0."""
        g = jnp.argmin(jnp.abs(self.gears - gear))
        i, a, h = _cell(self.speeds_radps, speed_radps)
        j, b, k = _cell(self.torques_nm, torque_nm)
        # under the kernel's vmap the slopes are worked out once, not by row
        values = jnp.asarray(self.values)
        by_speed = _slopes(self.speeds_radps, values, 1)
        by_torque = _slopes(self.torques_nm, values, 2)
        steps, turns = _steps(a), _turns(a)
        across, bends = _steps(b), _turns(b)
        eta: Any = 0.0
        for m in (0, 1):
            for n in (0, 1):
                at = g, i + m, j + n
                eta += values[at] * steps[m] * across[n]
                eta += by_speed[at] * h * turns[m] * across[n] + by_torque[at] * k * steps[m] * bends[n]
        return eta

    def outside(self, speed_radps: Any, torque_nm: Any) -> Any:
        """Whether the point lies beyond the map, so that the value at its edge is used."""
        s, t = self.speeds_radps, self.torques_nm
        return (speed_radps < s[0]) | (speed_radps > s[-1]) | (torque_nm < t[0]) | (torque_nm > t[-1])


def _cell(axis: Any, x: Any) -> tuple[Any, Any, Any]:
    """The cell of `axis` that holds x, the place inside it, 0 to 1, and its length."""
    # counted, not searched: a grid is short, and every format that a vehicle is exported to can count
    i = jnp.clip(jnp.sum(axis <= x) - 1, 0, axis.shape[0] - 2)
    length = axis[i + 1] - axis[i]
    # clamped before it is divided: a clip of the place to 0..1 would halve the slope at every node
    return i, (jnp.clip(x, axis[0], axis[-1]) - axis[i]) / length, length


def _steps(a: Any) -> tuple[Any, Any]:
    """Hermite's cubics of the values at 0 and at 1."""
    one = a * a * (3 - 2 * a)
    return 1 - one, one


def _turns(a: Any) -> tuple[Any, Any]:
    """Hermite's cubics of the slopes at 0 and at 1."""
    return a * (1 - a) * (1 - a), -a * a * (1 - a)


@partial(jax.jit, static_argnums=2)  # traced once for a grid, not in every program
def _slopes(x: Any, values: Array, axis: int) -> Array:
    """Slopes at the nodes along an axis that keep the cubic monotone where the nodes are."""
    z = jnp.moveaxis(values, axis, -1)
    h = jnp.diff(x).reshape((1,) * (z.ndim - 1) + (-1,))
    d = jnp.diff(z, axis=-1) / h
    if d.shape[-1] == 1:
        return jnp.moveaxis(jnp.concatenate([d, d], axis=-1), -1, axis)
    h0, h1, d0, d1 = h[..., :-1], h[..., 1:], d[..., :-1], d[..., 1:]
    same = d0 * d1 > 0
    safe0, safe1 = jnp.where(same, d0, 1.0), jnp.where(same, d1, 1.0)
    inner = jnp.where(same, 3 * (h0 + h1) / ((2 * h1 + h0) / safe0 + (2 * h0 + h1) / safe1), 0.0)
    first = _end(h[..., :1], h[..., 1:2], d[..., :1], d[..., 1:2])
    last = _end(h[..., -1:], h[..., -2:-1], d[..., -1:], d[..., -2:-1])
    return jnp.moveaxis(jnp.concatenate([first, inner, last], axis=-1), -1, axis)


def _end(h0: Array, h1: Array, d0: Array, d1: Array) -> Array:
    """The slope at an end: of the parabola through three nodes, cut to what stays monotone."""
    slope = ((2 * h0 + h1) * d0 - h0 * d1) / (h0 + h1)
    slope = jnp.where(slope * d0 <= 0, 0.0, slope)
    return jnp.where((d0 * d1 < 0) & (jnp.abs(slope) > 3 * jnp.abs(d0)), 3 * d0, slope)


class Driveline(eqx.Module):
    """The chain between the wheel and the motor shaft.

    **Arguments:**

    - `efficiency`: a number in (0, 1], or an `EfficiencyMap`.
    - `gear_ratios` (from the first gear up), `final_drive`, `wheel_radius_m`: without them, torques and speeds are
      those of a wheel of radius `WHEEL_RADIUS_M`.
    - `covers_machine`: the efficiency covers the chain from the wheel to the battery, as η in paper 1.
    - `regenerating_efficiency`: while braking, where it differs. Driving power is divided by the efficiency, braking
      power multiplied by it.

    A row with the channel `GEAR_PROBABILITY` has a probability p for each gear instead of one gear. Its ratio is Σ p·i
    and its efficiency Σ p·η, with each η at the motor speed and torque of its own gear (paper 1, section 3.1, with the
    classifier's probabilities in place of its choice). With p = 1 the result is exactly that of the gear.
    """

    efficiency: Any = eqx.field(converter=as_array, default=1.0)
    gear_ratios: Float[Array, " gear"] | None = eqx.field(converter=as_array, default=None)
    final_drive: Any = eqx.field(converter=as_array, default=1.0)
    wheel_radius_m: Any = eqx.field(converter=as_array, default=WHEEL_RADIUS_M)
    covers_machine: bool = eqx.field(static=True, default=True)
    regenerating_efficiency: Any = eqx.field(converter=as_array, default=None)

    def ratio_radpm(self, row: Segments) -> Any:
        """Motor speed over vehicle speed [rad/m], by the row's gear."""
        if self.gear_ratios is None:
            gear_ratio: Any = 1.0
        elif row.has(GEAR_PROBABILITY):
            gear_ratio = self._shares(row) @ self.gear_ratios
        elif self.gear_ratios.shape[0] == 1 or not row.has("gear"):
            gear_ratio = self.gear_ratios[-1]
        else:
            gear = jnp.asarray(row.channels["gear"]).astype(int)
            gear_ratio = self.gear_ratios[jnp.clip(gear - 1, 0, self.gear_ratios.shape[0] - 1)]
        return gear_ratio * self.final_drive / self.wheel_radius_m

    def efficiency_at(self, row: Segments, speed_radps: Any, torque_nm: Any) -> Any:
        """Efficiency of this row: the number, or the map at gear, motor speed and torque."""
        if not isinstance(self.efficiency, EfficiencyMap):
            return self.efficiency
        if self.gear_ratios is None or not row.has(GEAR_PROBABILITY):
            return self.efficiency(row.get("gear", 1.0), speed_radps, torque_nm)
        shares, ratios = self._shares(row), self.gear_ratios
        mean = shares @ ratios
        gears = jnp.arange(1, ratios.shape[0] + 1).astype(ratios.dtype)
        # a motor speed that was measured is what it is, whatever the gear
        speeds = jnp.broadcast_to(
            speed_radps if row.has("motor_speed_radps") else speed_radps * (ratios / mean), ratios.shape
        )
        return shares @ jax.vmap(self.efficiency)(gears, speeds, torque_nm * (mean / ratios))

    def _shares(self, row: Segments) -> Array:
        """Probability of each gear. Raises `ValueError` where there are not as many as ratios."""
        shares = jnp.asarray(row.channels[GEAR_PROBABILITY])
        if self.gear_ratios is None or shares.shape != self.gear_ratios.shape:
            found = 0 if self.gear_ratios is None else self.gear_ratios.shape[0]
            raise ValueError(
                f"{GEAR_PROBABILITY} has shape {shares.shape} for {found} gear ratios; one each is expected"
            )
        return shares
