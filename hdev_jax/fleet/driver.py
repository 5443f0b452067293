"""Driving a road: a forward simulation in steps of distance, batched over routes, in one `lax.scan`.

The driver looks ahead: an envelope runs back from every stop and slower stretch at the deceleration that the driver
likes. Below it the driver accelerates by the free-road term of the intelligent driver model, a·(1 − (v/v₀)⁴)
(Treiber, Hennecke and Helbing, Physical Review E 62 (2000)), with a bounded jerk, and gets no more than the motor
gives in the gear that is engaged, nothing while it shifts, and no more than the driven wheels carry to the road."""

from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hdev_jax.fleet.shifting import Program, load_share, shift_lines
from hdev_jax.units import GRAVITY_MPS2

__all__ = ["STEP_M", "Car", "Driven", "Roads", "drive"]

STEP_M = 5.0
_JERK = 0.6  # m/s³, a comfortable start of a standing passenger's bus (Hoberock, J. Dyn. Sys. Meas. Control 99, 1977)
_CRAWL_MPS = 1.0
_ROLLING_IN, _ROLLING_FROM_MPS = 0.45, 8.0  # share of the deceleration that is used from speed, and what speed is
_ETA = 0.9  # of the drive, for what reaches the wheels at full load


class Roads(eqx.Module):
    """Routes by step: `cap_mps` at the nodes (0 is a stop), slope, mass, and what the drivers are like."""

    cap_mps: Float[Array, "node route"]
    grade: Float[Array, "step route"]
    mass_kg: Float[Array, "step route"]
    accel_mps2: Float[Array, " route"]
    brake_mps2: Float[Array, "step route"]
    friction: Float[Array, " route"]
    drag_factor: Float[Array, " route"]


class Car(eqx.Module):
    """What the driver feels of the vehicle."""

    c_rr: Any
    drag: Any  # ½ρC_dA
    rotating: Any
    torque_nm: Any
    axle_share: Any
    shift_s: Any
    hold_s: Any
    program: Program


class Driven(NamedTuple):
    """By step and route: speed at the nodes, time of a step, gear, force at the wheels."""

    speed_mps: Float[Array, "node route"]
    step_s: Float[Array, "step route"]
    gear: Any
    force_n: Float[Array, "step route"]


class _State(NamedTuple):
    speed: Array
    accel: Array
    gear: Array
    since_shift: Array


def _envelope(ahead: Array, here: tuple[Array, Array]) -> tuple[Array, Array]:
    """One node further back: v² ≤ v²(ahead) + 2·b·ds, and the cap; from speed the driver first lets it roll."""
    cap, brake = here
    share = _ROLLING_IN + (1 - _ROLLING_IN) * jnp.exp(-ahead / _ROLLING_FROM_MPS**2)
    square = jnp.minimum(cap**2, ahead + 2 * share * brake * STEP_M)
    return square, square


def drive(car: Car, roads: Roads) -> Driven:
    """Speed over distance of every route, from standstill at its start."""
    end = roads.cap_mps[-1] ** 2
    _, squares = jax.lax.scan(_envelope, end, (roads.cap_mps[:-1], roads.brake_mps2), reverse=True)
    ahead = jnp.concatenate([squares[1:], end[None]])

    def step(state: _State, x: tuple[Array, Array, Array]) -> tuple[_State, tuple[Array, ...]]:
        return _step(car, roads, state, x)

    zero = jnp.zeros_like(end)
    start = _State(zero, zero, jnp.ones(end.shape, int), zero + 10.0)
    _, (speed, seconds, gear, force) = jax.lax.scan(step, start, (ahead, roads.grade, roads.mass_kg))
    return Driven(jnp.concatenate([zero[None], speed]), seconds, gear, force)


def _step(car: Car, roads: Roads, s: _State, x: tuple[Array, Array, Array]) -> tuple[_State, tuple[Array, ...]]:
    """One step of `STEP_M` for every route."""
    ahead2, grade, mass = x
    v, v2 = s.speed, s.speed**2
    wanted = roads.accel_mps2 * jnp.maximum(1 - (v2 / jnp.maximum(ahead2, 0.25)) ** 2, 0.0)
    wanted = jnp.minimum(wanted, s.accel + _JERK * STEP_M / jnp.maximum(v, _CRAWL_MPS))
    wanted = jnp.minimum(wanted, (ahead2 - v2) / (2 * STEP_M))
    inertia = car.rotating * mass
    resist = mass * GRAVITY_MPS2 * (jnp.sin(grade) + car.c_rr) + roads.drag_factor * car.drag * v2
    load = load_share(car.program, inertia * wanted + resist, v)
    lines = jax.vmap(partial(shift_lines, car.program))(v, load, grade)
    gear = jnp.clip(s.gear, lines.lowest, lines.highest)
    gear = jnp.where((s.since_shift > car.hold_s) | (v <= 0), gear, s.gear)
    shifted = (gear != s.gear) & (v > 0)
    most = _ETA * jnp.minimum(
        car.torque_nm * car.program.ratio_radpm[gear - 1], car.program.rated_w / jnp.maximum(v, _CRAWL_MPS)
    )
    without = jnp.where(shifted, jnp.clip(car.shift_s * jnp.maximum(v, _CRAWL_MPS) / STEP_M, 0.0, 1.0), 0.0)
    most = jnp.minimum(most * (1 - without), roads.friction * car.axle_share * mass * GRAVITY_MPS2)
    accel = jnp.minimum(wanted, (most - resist) / inertia)
    after2 = jnp.maximum(v2 + 2 * accel * STEP_M, jnp.minimum(_CRAWL_MPS**2, ahead2))
    after2 = jnp.where(ahead2 > 0, after2, 0.0)  # a halt is one, to the last bit
    after = jnp.sqrt(after2)
    seconds = 2 * STEP_M / jnp.maximum(v + after, 0.5 * _CRAWL_MPS)
    accel = (after2 - v2) / (2 * STEP_M)
    force = inertia * accel + resist
    since = jnp.where(shifted, 0.0, s.since_shift) + seconds
    return _State(after, accel, gear, since), (after, seconds, gear, force)
