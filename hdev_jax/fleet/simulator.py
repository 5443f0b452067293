"""From a configuration to logs: draw routes, drive them, put the vehicles' energy on every row, add the instruments.

A batch is some routes of one vehicle; batches are drawn from seeds of their own, so that a fleet is as large as it is asked
for and memory is that of one batch. The energy of a row is the kernel's, for the vehicle as it is.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from hdev_jax.fleet.config import FleetConfig
from hdev_jax.fleet.driver import STEP_M, Car, Driven, Roads, drive
from hdev_jax.fleet.hidden import ROTATING_MASS_FACTOR, hidden_effects, shift_program, tabular_vehicle, true_vehicle
from hdev_jax.fleet.roads import SEGMENT_M, STEPS, RouteBatch, draw_routes
from hdev_jax.fleet.shifting import Program, engaged, load_share, shift_lines
from hdev_jax.fleet.variants import AXLE_LOAD_SHARE, Variant
from hdev_jax.physics import AIR_DENSITY_KGPM3, GRAVITY_MPS2, Driveline, Machine, Vehicle
from hdev_jax.physics.across import DISTANCE_SINCE_START, FIRST, LAST
from hdev_jax.physics.road import mean_square_speed
from hdev_jax.segments import Segments

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
    rows, trip = _rows(routes, jax.tree.map(np.asarray, driven), used)
    payload = config.truth.payload_bias + config.truth.payload_sd * rng.standard_normal(len(routes.length))
    n = len(trip)
    capacity = -(-(len(routes.length) * routes.mass_kg.shape[1] * 5 // 4) // _ROWS_STEP) * _ROWS_STEP
    capacity = max(capacity, -(-n // _ROWS_STEP) * _ROWS_STEP)
    segments = _padded(rows, trip, capacity)
    lines, out = _energy(vehicle.true, vehicle.program, segments)
    truth = {k: np.asarray(x)[:n] for k, x in out.items()}
    truth |= {k: rows[k] for k in _TRUTH_ONLY}
    truth["payload_error"] = payload[trip]
    log = _measured(config, rows, trip, truth, payload, rng)
    gear = truth["gear"]
    log_segments = _padded({**log, "gear": gear}, trip, capacity)
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

    def number(x: float) -> Any:
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


# --- rows ------------------------------------------------------------------------------------------------------------


def _rows(r: RouteBatch, d: Driven, used: int) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Columns of the rows in order, halts in between, and the route that each belongs to."""
    routes, width = r.mass_kg.shape
    shape = (routes, width, STEPS)
    seconds = d.step_s.T.reshape(shape)
    speed = d.speed_mps.T[:, ::STEPS]
    gear = d.gear.T.reshape(shape)
    work = d.force_n.T.reshape(shape).sum(axis=2) * (STEP_M / 3600.0)
    changed = np.diff(gear.reshape(routes, -1), axis=1, prepend=1) != 0
    inside = (np.arange(width) < r.length[:, None]) & (np.arange(routes) < used)[:, None]
    use = np.stack([inside & (r.halt_s > 0), inside], axis=2)

    def both(halted: np.ndarray | float, moving: np.ndarray) -> np.ndarray:
        x = np.stack([np.broadcast_to(halted, moving.shape), moving], axis=2)
        return x[use]

    def same(x: np.ndarray) -> np.ndarray:
        return both(x, x)

    duration = np.stack([r.halt_s, seconds.sum(axis=2)], axis=2)
    flat = np.where(use, duration, 0.0).reshape(routes, -1)
    start = (np.cumsum(flat, axis=1) - flat).reshape(duration.shape)
    columns = {
        "time_s": start[use],
        "duration_s": duration[use],
        "distance_m": both(0.0, np.full((routes, width), SEGMENT_M)),
        "speed_start_mps": both(0.0, speed[:, :-1]),
        "speed_end_mps": both(0.0, speed[:, 1:]),
        "curvature_1pm": both(0.0, r.curvature_1pm),
        "shifts": both(0, changed.reshape(shape).sum(axis=2)),
        "gear_middle": both(1, gear[:, :, STEPS // 2]),
        "wheel_energy_fine_wh": both(0.0, work),
    }
    for name in ("mass_kg", "grade_rad", "altitude_m", "heading_rad", "road_kind", "road_surface", "limit_mps",
                 "ambient_temp_c", "wind_speed_mps", "wind_from_rad", "wet_road"):  # fmt: skip
        columns[name] = same(getattr(r, name))
    return columns, np.broadcast_to(np.arange(routes)[:, None, None], use.shape)[use]


_TRUTH_ONLY = ("road_kind", "limit_mps", "shifts", "gear_middle", "wheel_energy_fine_wh")
_CHANNELS = ("mass_kg", "grade_rad", "altitude_m", "heading_rad", "curvature_1pm", "road_surface", "ambient_temp_c",
             "wind_speed_mps", "wind_from_rad", "wet_road", "gear")  # fmt: skip


def _padded(rows: dict[str, np.ndarray], trip: np.ndarray, capacity: int) -> Segments:
    """Rows as `Segments` of a fixed length; what fills them up is a trip of its own."""

    def column(x: np.ndarray, fill: float) -> Any:
        return jnp.asarray(np.concatenate([x, np.full(capacity - len(x), fill, dtype=x.dtype)]), dtype=float)

    ids = np.concatenate([trip, np.full(capacity - len(trip), -1)])
    start = np.r_[True, ids[1:] != ids[:-1]]
    first = np.maximum.accumulate(np.where(start, np.arange(capacity), 0))
    last = np.r_[np.flatnonzero(start)[1:], capacity][np.cumsum(start) - 1] - 1
    metres = np.concatenate([rows["distance_m"], np.zeros(capacity - len(trip))])
    before = np.cumsum(metres) - metres
    channels = {k: column(rows[k], 1.0) for k in _CHANNELS if k in rows}
    channels[DISTANCE_SINCE_START] = column(before - before[first] + 0.5 * metres, 0.0)
    segments = Segments(
        jnp.asarray(ids),
        jnp.zeros(capacity, int),
        *(column(rows[k], 1.0 if k == "duration_s" else 0.0)
          for k in ("time_s", "duration_s", "distance_m", "speed_start_mps", "speed_end_mps")),
        channels,
    )  # fmt: skip
    # what effects derive by trip is worked out here: compiling it takes longer than all the rest
    bounds = {FIRST: jnp.asarray(first), LAST: jnp.asarray(last)}
    return eqx.tree_at(lambda s: s.channels, segments, {**channels, **bounds})


@eqx.filter_jit
def _predict(vehicle: Vehicle, segments: Segments) -> dict[str, Any]:
    """What the sheet says: battery energy (paper 1, equation 5) and energy at the wheels alone (equation 4)."""
    wheel = vehicle.force(segments) * segments.distance_m / 3600.0
    return {"tabular_wh": vehicle.energy(segments), "tabular_wheel_wh": wheel}


@eqx.filter_jit
def _energy(vehicle: Vehicle, program: Program, segments: Segments) -> tuple[Any, dict[str, Any]]:
    """Gear, energy and what it is made of, for every row, by the kernel."""
    plain = vehicle.minus("time_skew") if vehicle.has("time_skew") else vehicle
    speed, grade = segments.speed_mps, segments.channels["grade_rad"]
    force = jnp.where(segments.distance_m > 0, _at_the_wheels(plain).force(segments), 0.0)  # brakes hold it at rest
    load = load_share(program, force, speed)
    lines = shift_lines(program, speed, load, grade)
    starts = jnp.concatenate([jnp.array([True]), segments.trip[1:] != segments.trip[:-1]])
    gear = engaged(lines.lowest, lines.highest, starts)
    segments = segments.with_channels(gear=gear.astype(speed.dtype))
    parts = plain.breakdown(segments)
    energy = sum(parts.values())
    shown = energy
    if vehicle.has("time_skew"):
        hours = segments.duration_s / 3600.0
        shown = vehicle.effect("time_skew").observe(energy / hours, segments) * hours
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
        **_coefficients(plain, segments, parts),
        **{f"energy_wh:{k}": x for k, x in parts.items()},
    }
    return lines, out


def _at_the_wheels(vehicle: Vehicle) -> Vehicle:
    """The same vehicle up to its wheels: the same forces, and less to compile."""
    road = tuple(e for e in vehicle.effects if e.stage == "road")
    one = jnp.ones_like(vehicle.mass_kg)
    return Vehicle(road, mass_kg=vehicle.mass_kg, driveline=Driveline(one), machine=Machine(one, one))


def _coefficients(vehicle: Vehicle, segments: Segments, parts: dict[str, Any]) -> dict[str, Any]:
    """c_rr and C_d·A that hold in each row: all effects that go with the weight, and all that go with the air."""
    weight = vehicle.mass(segments) * GRAVITY_MPS2 * jnp.cos(segments.channels["grade_rad"])
    square = mean_square_speed(segments)
    metres = jnp.where(segments.distance_m > 0, segments.distance_m, 1.0)
    spray: Any = 0.0
    if vehicle.has("wet_road"):  # half of that effect is rolling, half is air
        wet = vehicle.effect("wet_road")
        air = eqx.tree_at(lambda e: e.excess, wet, jnp.zeros_like(wet.excess))
        spray = jax.vmap(lambda row: air.force(row, vehicle))(segments)

    def force(ids: tuple[str, ...]) -> Any:
        return sum(parts[k] for k in ids if k in parts) * (3600.0 / metres)

    moves = segments.distance_m > 0
    c_rr = (force(_ROLLING) - spray) / weight
    cda = (force(_AIR) + spray) / (0.5 * AIR_DENSITY_KGPM3 * jnp.where(square > 0, square, 1.0))
    return {
        "c_rr": jnp.where(moves, c_rr, vehicle.effect("rolling").c_rr),
        "cda_m2": jnp.where(moves & (square > 0), cda, vehicle.effect("aero").cda_m2),
    }


_ROLLING = ("rolling", "rolling_temperature", "rolling_speed", "tyre_warmup", "road_surface", "wet_road", "cornering")
_AIR = ("aero", "headwind", "crosswind", "air_density")


def _measured(
    config: FleetConfig, rows: dict[str, np.ndarray], trip: np.ndarray, truth: dict[str, np.ndarray],
    payload: np.ndarray, rng: np.random.Generator,
) -> dict[str, np.ndarray]:  # fmt: skip
    """What the instruments wrote: the columns of the log."""
    n, c = len(trip), config.log
    log = {k: x.copy() for k, x in rows.items() if k not in _TRUTH_ONLY}
    log["mass_kg"] = np.round(rows["mass_kg"] / (1.0 + payload[trip]), -1)
    log["grade_rad"] = rows["grade_rad"] + c.grade_noise_rad * rng.standard_normal(n)
    # one reading where two rows meet; none where the vehicle stands
    start, end = rows["speed_start_mps"], rows["speed_end_mps"]
    error = c.speed_noise_mps * rng.standard_normal(n + 1)
    fresh = np.r_[True, trip[1:] != trip[:-1]]
    log["speed_start_mps"] = np.where(start > 0, np.maximum(start + np.where(fresh, 0.0, error[:-1]), 0.0), 0.0)
    log["speed_end_mps"] = np.where(end > 0, np.maximum(end + error[1:], 0.0), 0.0)
    shown = truth["energy_shown_wh"]
    sd = c.energy_noise_wh + c.energy_noise_share * np.abs(shown)
    log["energy_wh"] = shown + sd * rng.standard_normal(n)
    log["requested_torque_nm"] = truth["requested_torque_nm"].copy()
    return log
