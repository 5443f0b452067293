"""What a vehicle's effects come to as the two coefficients of paper 1: c_rr and C_d·A as they hold in a row."""

from typing import Any

import jax.numpy as jnp

from hdev_jax.physics.effect import Real, resolve
from hdev_jax.physics.road import mean_square_speed, weight_on_road
from hdev_jax.physics.vehicle import Vehicle
from hdev_jax.segments import Segments
from hdev_jax.units import AIR_DENSITY_KGPM3

__all__ = ["WITH_AIR", "WITH_WEIGHT", "coefficients_that_hold"]

# Effects that together are a rolling resistance coefficient, and those that together are a drag area; `wet_road` has a
# part of each.
WITH_WEIGHT = ("rolling", "rolling_temperature", "rolling_speed", "tyre_warmup", "road_surface", "cornering")
WITH_AIR = ("aero", "headwind", "constant_headwind", "crosswind", "air_density", "drafting")
_SLOW_MPS = 0.1  # below, the drag area would be a ratio of next to nothing


def coefficients_that_hold(car: Vehicle, row: Segments) -> tuple[Real, Real]:
    """c_rr and C_d·A [m²] with which rolling resistance and drag alone are the force of all effects that go with the
    weight or with the air, in one row; the channels that these derive by trip must be there.

    Where the vehicle does not move (for C_d·A: is slower than 0.1 m/s) it is the declared coefficient. **Raises:**
    `KeyError` for a vehicle without rolling resistance or drag.
    """
    car = resolve(car, row)
    weight: Any = sum(e.force(row, car) for e in car.effects if e.id in WITH_WEIGHT)
    air: Any = sum(e.force(row, car) for e in car.effects if e.id in WITH_AIR)
    if car.has("wet_road"):
        # Spray is a share of the drag area at the square of the speed, whatever the vehicle weighs: the source has the
        # resistance of displaced water go with the tyres' width and the speed, not with their load.
        wet = car.effect("wet_road")
        weight, air = weight + wet.rolling(row, car), air + wet.spraying(row, car)
    square = mean_square_speed(row)
    moves = row.distance_m > 0
    fast = moves & (square > _SLOW_MPS**2)
    pressure = 0.5 * AIR_DENSITY_KGPM3 * jnp.where(fast, square, 1.0)
    return (
        jnp.where(moves, weight / weight_on_road(row, car), car.effect("rolling").c_rr),
        jnp.where(fast, air / pressure, car.effect("aero").cda_m2),
    )
