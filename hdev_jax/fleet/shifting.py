"""The shift program: speeds at which a gearbox shifts up and down, by load and grade, with hysteresis between them.

Shift lines over load as in VECTO's user manual ("Gear shift model": shift curves of speed by torque, a least time between
two shifts, torque reserve) and Naunheimer, Fahrzeuggetriebe (shift maps with hysteresis). Between gears g and g+1 the
program without hysteresis shifts where the motor's speeds before and after lie on either side of its best,

    c_g = ω_best(load)·(1 + 3·uphill) / √(R_g·R_{g+1}),    ω_best = ω_base·(0.6 + 0.4·load),   R = ratio·final/radius,

up at c_g·(1 + h/2) and down at c_g·(1 − h/2), h = `hysteresis` + `hysteresis_load`·load + |grade|/2. The default h of 0.10 to
0.20 is of the size of the gap between the curves of VECTO's generic shift polygons for 12-speed gearboxes (100 to 150 of about
1200 rpm). Then gear = clip(previous gear, lowest, highest), where `lowest` counts the up-lines below the speed and
`highest` the down-lines: where the two agree the row alone tells the gear, where they differ only the past does.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

__all__ = ["Program", "ShiftLines", "engaged", "load_share", "shift_lines"]

BEST_LOW, BEST_HIGH, UPHILL, STEEPEST = 0.6, 0.4, 3.0, 0.10
REDLINE = 0.92  # share of the highest motor speed at which it shifts up whatever the load


class Program(eqx.Module):
    """What the shift program knows of the vehicle; `ratio_radpm` [gear] is motor speed over road speed, padded."""

    ratio_radpm: Float[Array, " gear"]
    gears: Any
    base_speed_radps: Any
    max_speed_radps: Any
    rated_w: Any
    hysteresis: Any
    hysteresis_load: Any


class ShiftLines(NamedTuple):
    """Of some rows: gears that the program allows, and road speeds [m/s] by gear at which it leaves it upwards.

    `up_mps`, `center_mps` and `down_mps` are `[row, gear]`: entry g−1 is the line between gear g and g+1, infinite where
    the box has no higher gear.
    """

    lowest: Int[Array, " row"]
    highest: Int[Array, " row"]
    static: Int[Array, " row"]
    up_mps: Float[Array, "row gear"]
    center_mps: Float[Array, "row gear"]
    down_mps: Float[Array, "row gear"]


def load_share(program: Program, force_n: Any, speed_mps: Any) -> Any:
    """Power at the wheels over the motor's rated power, 0 to 1; braking counts half."""
    power = force_n * speed_mps / program.rated_w
    return jnp.clip(jnp.maximum(power, -0.5 * power), 0.0, 1.0)


def shift_lines(program: Program, speed_mps: Array, load: Array, grade: Array) -> ShiftLines:
    """The lines and the gears that they allow, for rows of speed, load and grade (all of one shape)."""
    r = program.ratio_radpm
    step = jnp.sqrt(r[:-1] * r[1:])
    best = program.base_speed_radps * (BEST_LOW + BEST_HIGH * load) * (1 + UPHILL * jnp.clip(grade, 0.0, STEEPEST))
    width = program.hysteresis + program.hysteresis_load * load + 0.5 * jnp.abs(grade)
    exists = jnp.arange(1, r.shape[0]) < program.gears
    shape = (1,) * speed_mps.ndim + step.shape
    limit = REDLINE * program.max_speed_radps / r[:-1]
    center = jnp.minimum(best[..., None] / step.reshape(shape), (limit / (1 + 0.5 * width[..., None])))
    center = jnp.where(exists.reshape(shape), center, jnp.inf)
    up, down = center * (1 + 0.5 * width[..., None]), center * (1 - 0.5 * width[..., None])

    def count(line: Array) -> Array:
        return 1 + jnp.sum(speed_mps[..., None] > line, axis=-1)

    return ShiftLines(count(up), count(down), count(center), up, center, down)


def engaged(lowest: Array, highest: Array, starts: Array) -> Int[Array, " row"]:
    """The gear of each row: clip(previous, lowest, highest), from `lowest` where a trip starts."""
    return jax.lax.scan(_engage, jnp.ones((), lowest.dtype), (lowest, jnp.where(starts, lowest, highest)))[1]


def _engage(gear: Array, allowed: tuple[Array, Array]) -> tuple[Array, Array]:
    """One row further."""
    gear = jnp.clip(gear, *allowed)
    return gear, gear
