"""From a configuration to logs: draw routes, drive them, put the vehicles' energy on every row, add the instruments.

A batch is some routes of one vehicle; batches are drawn from seeds of their own, so that a fleet is as large as it is
asked for and memory is that of one batch. The energy of a row is the kernel's, for the vehicle as it is."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from hdev_jax.fleet.config import FleetConfig
from hdev_jax.fleet.driver import Car, Driven, Roads, drive
from hdev_jax.fleet.hidden import ROTATING_MASS_FACTOR, hidden_effects, shift_program, tabular_vehicle, true_vehicle
from hdev_jax.fleet.roads import STEPS, RouteBatch, draw_routes
from hdev_jax.fleet.rows import TRUTH_ONLY, log_rows, measured, padded
from hdev_jax.fleet.shifting import Program, engaged, load_share, shift_lines
from hdev_jax.fleet.variants import AXLE_LOAD_SHARE, Variant
from hdev_jax.physics import Driveline, Machine, Vehicle, coefficients_that_hold
from hdev_jax.segments import Segments
from hdev_jax.units import AIR_DENSITY_KGPM3

__all__ = ["ROUTES_PER_BATCH", "Batch", "VehiclePart", "batches", "shares"]

ROUTES_PER_BATCH = 192
_ROWS_STEP = 2048


@dataclass(frozen=True)
class VehiclePart:
    """One vehicle of the fleet: its variant and what it hides. `index` is its place in the fleet."""

    index: int
    variant: Variant
    effects: dict[str, dict[str, Any]]
    true: Vehicle
    tabular: Vehicle
    program: Program
    routes: int


@dataclass(frozen=True)
class Batch:
    """Rows of some routes of one vehicle: the log's columns, and the truth's, row by row.

    `log` is as measured (with `trip` counted in the vehicle), `truth` as it was. `fine` is the drive by step of the
    batch's routes, for figures.
    """

    vehicle: VehiclePart
    log: dict[str, np.ndarray]
    truth: dict[str, np.ndarray]
    fine: Driven
    routes: RouteBatch


def shares(config: FleetConfig) -> list[VehiclePart]:
    """The vehicles with their numbers of routes, which differ by one at most."""
    chosen = config.chosen
    out = []
    for i, v in enumerate(chosen):
        rng = np.random.default_rng([config.seed, 1, _number_of(v)])
        effects = hidden_effects(v, config, rng)
        count = config.routes // len(chosen) + (i < config.routes % len(chosen))
        out.append(
            VehiclePart(
                i, v, effects, true_vehicle(v, effects), tabular_vehicle(v, config), shift_program(v, config), count
            )
        )
    return out


def _number_of(v: Variant) -> int:
    """The variant's place in the table: its random numbers do not depend on which others are simulated."""
    from hdev_jax.fleet.variants import VARIANTS

    return VARIANTS.index(v)


def batches(config: FleetConfig, vehicle: VehiclePart) -> Iterator[Batch]:
    """The vehicle's rows, a batch of routes at a time."""
    width = round(1.5 * config.segments_per_route)
    size = min(ROUTES_PER_BATCH, -(-max(p for p in (vehicle.routes, 1)) // 8) * 8)
    for number, first in enumerate(range(0, vehicle.routes, size)):
        rng = np.random.default_rng([config.seed, 2, _number_of(vehicle.variant), number])
        routes = draw_routes(vehicle.variant, config, size, width, rng)
        used = min(size, vehicle.routes - first)
        yield _batch(config, vehicle, routes, used, first, rng)


def _batch(
    config: FleetConfig, vehicle: VehiclePart, routes: RouteBatch, used: int, first: int, rng: np.random.Generator
) -> Batch:
    driven = _drive(_car(vehicle, config), _roads(routes))
    rows, trip = log_rows(routes, jax.tree.map(np.asarray, driven), used)
    payload = config.truth.payload_bias + config.truth.payload_sd * rng.standard_normal(len(routes.length))
    n = len(trip)
    capacity = -(-(len(routes.length) * routes.mass_kg.shape[1] * 5 // 4) // _ROWS_STEP) * _ROWS_STEP
    capacity = max(capacity, -(-n // _ROWS_STEP) * _ROWS_STEP)
    segments = padded(rows, trip, capacity)
    lines, out = _energy(vehicle.true, vehicle.program, segments)
    truth = {k: np.asarray(x)[:n] for k, x in out.items()}
    truth |= {k: rows[k] for k in TRUTH_ONLY}
    truth["payload_error"] = payload[trip]
    log = measured(config, rows, trip, truth, payload, rng)
    gear = truth["gear"]
    log_segments = padded({**log, "gear": gear}, trip, capacity)
    tabular = _predict(vehicle.tabular, log_segments)
    truth |= {k: np.asarray(x)[:n] for k, x in tabular.items()}
    at = np.arange(n)
    up = np.concatenate([np.asarray(lines.up_mps)[:n], np.full((n, 1), np.inf)], axis=1)
    truth["shift_up_mps"] = up[at, gear - 1]
    truth["shift_down_mps"] = np.where(gear > 1, np.asarray(lines.down_mps)[at, np.maximum(gear - 2, 0)], 0.0)
    kept = rng.uniform(size=n) >= config.log.dropout_share
    kept |= np.r_[True, trip[1:] != trip[:-1]]  # no trip is lost
    log["gear"], log["trip"] = gear.astype(float), trip + first
    return Batch(
        vehicle,
        {k: x[kept] for k, x in log.items()},
        {k: x[kept] for k, x in truth.items()},
        driven,
        routes,
    )


# --- driving ---------------------------------------------------------------------------------------------------------


_drive = eqx.filter_jit(drive)


def _car(vehicle: VehiclePart, config: FleetConfig) -> Car:
    v = vehicle.variant

    def number(x: float | int) -> Any:
        return jnp.asarray(x, dtype=float)

    return Car(
        number(1.15 * v.true_c_rr),  # what the season, the surface and the warming tyres add on average
        number(0.5 * AIR_DENSITY_KGPM3 * v.true_cda_m2),
        number(ROTATING_MASS_FACTOR),
        number(v.torque_nm),
        number(AXLE_LOAD_SHARE[v.axles]),
        number(config.gears.shift_time_s),
        number(config.gears.hold_s),
        vehicle.program,
    )


def _roads(r: RouteBatch) -> Roads:
    def by_step(x: np.ndarray) -> Any:
        return jnp.asarray(np.ascontiguousarray(x.T), dtype=float)

    return Roads(
        by_step(r.cap_mps),
        by_step(r.grade_step),
        by_step(np.repeat(r.mass_kg, STEPS, axis=1)),
        jnp.asarray(r.accel_mps2, dtype=float),
        by_step(r.brake_mps2),
        jnp.asarray(r.friction, dtype=float),
        jnp.asarray(r.drag_factor, dtype=float),
    )


# --- energy ---------------------------------------------------------------------------------------------------------


@eqx.filter_jit
def _predict(vehicle: Vehicle, segments: Segments) -> dict[str, Any]:
    """What the sheet says: battery energy (paper 1, equation 5) and energy at the wheels alone (equation 4)."""
    wheel = vehicle.force(segments) * segments.distance_m / 3600.0
    return {"tabular_wh": vehicle.energy(segments), "tabular_wheel_wh": wheel}


@eqx.filter_jit
def _energy(vehicle: Vehicle, program: Program, segments: Segments) -> tuple[Any, dict[str, Any]]:
    """Gear, energy and what it is made of, for every row, by the kernel."""
    plain = vehicle.minus("time_skew") if vehicle.has("time_skew") else vehicle
    speed, grade = jnp.asarray(segments.speed_mps), jnp.asarray(segments.channels["grade_rad"])
    force = jnp.where(segments.distance_m > 0, _at_the_wheels(plain).force(segments), 0.0)  # brakes hold it at rest
    load = load_share(program, force, speed)
    lines = jax.vmap(partial(shift_lines, program))(speed, load, grade)
    starts = jnp.concatenate([jnp.array([True]), segments.trip[1:] != segments.trip[:-1]])
    gear = engaged(lines.lowest, lines.highest, starts)
    segments = segments.with_channels(gear=gear.astype(speed.dtype))
    parts = plain.breakdown(segments)
    energy = sum(parts.values())
    shown = energy
    if vehicle.has("time_skew"):
        hours = segments.duration_s / 3600.0
        shown = vehicle.effect("time_skew").observe(energy / hours, segments) * hours
    for e in plain.effects:
        segments = e.derive(segments)
    c_rr, cda = jax.vmap(partial(coefficients_that_hold, plain))(jax.tree.map(jnp.asarray, segments))
    ratio = program.ratio_radpm[gear - 1]
    motor_speed, torque = speed * ratio, force / ratio
    out = {
        "gear": gear,
        "gear_previous": jnp.where(starts, gear, jnp.roll(gear, 1)),
        "gear_lowest": lines.lowest,
        "gear_highest": lines.highest,
        "gear_static": lines.static,
        "load_share": load,
        "requested_torque_nm": force * vehicle.driveline.wheel_radius_m,
        "motor_speed_radps": motor_speed,
        "motor_torque_nm": torque,
        "efficiency": jax.vmap(vehicle.driveline.efficiency)(gear, motor_speed, torque),
        "energy_true_wh": energy,
        "energy_shown_wh": shown,
        "mass_kg": segments.channels["mass_kg"],
        "grade_rad": grade,
        "c_rr": c_rr,
        "cda_m2": cda,
        **{f"energy_wh:{k}": x for k, x in parts.items()},
    }
    return lines, out


def _at_the_wheels(vehicle: Vehicle) -> Vehicle:
    """The same vehicle up to its wheels: the same forces, and less to compile."""
    road = tuple(e for e in vehicle.effects if e.stage == "road")
    one = jnp.ones_like(vehicle.mass_kg)
    return Vehicle(road, mass_kg=vehicle.mass_kg, driveline=Driveline(one), machine=Machine(one, one))
