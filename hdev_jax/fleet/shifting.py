"""The shift program: speeds at which a gearbox shifts up and down, by load and grade, with hysteresis between them.

Shift lines over load as in VECTO's user manual ("Gear shift model": shift curves of speed by torque, a least time
between two shifts, torque reserve) and Naunheimer, Fahrzeuggetriebe (shift maps with hysteresis). Between gears g and
g+1 the program without hysteresis shifts where the motor's speeds before and after lie on either side of its best,

    c_g = ω_best(load)·(1 + 3·uphill) / √(R_g·R_{g+1}),    ω_best = ω_base·(0.6 + 0.4·load),   R = ratio·final/radius,

up at c_g·(1 + h/2) and down at c_g·(1 − h/2), h = `hysteresis` + `hysteresis_load`·load + |grade|/2. That there is such
a gap, and that it depends on the load, is from those two; its default width, 10 % of the speed without load and 15 % at
full load, is an engineering assumption: wide enough that a shift does not undo itself, and half of the step between the
gears of a box with twelve (28 %).

Then gear = clip(previous gear, lowest, highest), where `lowest` counts the up-lines below the speed and `highest` the
down-lines: where the two agree the row alone tells the gear, where they differ only the past does.
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
    """Of a row: gears that the program allows, and road speeds [m/s] at which it changes between them.

    `up_mps`, `center_mps` and `down_mps` are by gear: entry g−1 is the line between gear g and g+1, infinite where the
    box has no higher gear.
    """

    lowest: Int[Array, ""]
    highest: Int[Array, ""]
    static: Int[Array, ""]
    up_mps: Float[Array, " gear"]
    center_mps: Float[Array, " gear"]
    down_mps: Float[Array, " gear"]


def load_share(program: Program, force_n: Any, speed_mps: Any) -> Any:
    """Power at the wheels over the motor's rated power, 0 to 1; braking counts half."""
    power = force_n * speed_mps / program.rated_w
    return jnp.clip(jnp.maximum(power, -0.5 * power), 0.0, 1.0)


def shift_lines(program: Program, speed_mps: Array, load: Array, grade: Array) -> ShiftLines:
    """The lines of one row, and the gears that they allow at its speed, load and grade."""
    r = program.ratio_radpm
    best = program.base_speed_radps * (BEST_LOW + BEST_HIGH * load) * (1 + UPHILL * jnp.clip(grade, 0.0, STEEPEST))
    half = 0.5 * (program.hysteresis + program.hysteresis_load * load + 0.5 * jnp.abs(grade))
    redline = REDLINE * program.max_speed_radps / r[:-1]
    center = jnp.minimum(best / jnp.sqrt(r[:-1] * r[1:]), redline / (1 + half))
    center = jnp.where(jnp.arange(1, r.shape[0]) < program.gears, center, jnp.inf)
    up, down = center * (1 + half), center * (1 - half)

    def count(line: Array) -> Array:
        return 1 + jnp.sum(speed_mps > line)

    return ShiftLines(count(up), count(down), count(center), up, center, down)


def engaged(lowest: Array, highest: Array, starts: Array) -> Int[Array, " row"]:
    """The gear of each row: clip(previous, lowest, highest), from `lowest` where a trip starts."""
    return jax.lax.scan(_engage, jnp.ones((), lowest.dtype), (lowest, jnp.where(starts, lowest, highest)))[1]


def _engage(gear: Array, allowed: tuple[Array, Array]) -> tuple[Array, Array]:
    """One row further."""
    gear = jnp.clip(gear, *allowed)
    return gear, gear
