"""Rows of a log from a drive: halts put in, padded to a fixed length for the kernel, and measured."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from hdev_jax.fleet.config import FleetConfig
from hdev_jax.fleet.driver import STEP_M
from hdev_jax.fleet.roads import SEGMENT_M, STEPS, RouteBatch
from hdev_jax.physics.across import DISTANCE_SINCE_START, FIRST, LAST
from hdev_jax.segments import Segments

__all__ = ["ROW_FIELDS", "TRUTH_ONLY", "log_rows", "measured", "padded"]

ROW_FIELDS = ("time_s", "duration_s", "distance_m", "speed_start_mps", "speed_end_mps")

TRUTH_ONLY = ("road_kind", "limit_mps", "shifts", "gear_middle", "wheel_energy_fine_wh")


def log_rows(r: RouteBatch, d: Any, used: int) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Columns of the rows in order, halts in between, and the route that each belongs to; `d` a `Driven` of NumPy."""
    routes, width = r.mass_kg.shape
    shape = (routes, width, STEPS)
    seconds = d.step_s.T.reshape(shape)
    speed = d.speed_mps.T[:, ::STEPS]
    gear = d.gear.T.reshape(shape)
    work = d.force_n.T.reshape(shape).sum(axis=2) * (STEP_M / 3600.0)
    changed = np.diff(gear.reshape(routes, -1), axis=1, prepend=1) != 0
    inside = (np.arange(width) < r.length[:, None]) & (np.arange(routes) < used)[:, None]
    use = np.stack([inside & (r.halt_s > 0), inside], axis=2)

    def both(halted: np.ndarray | float | int, moving: np.ndarray) -> np.ndarray:
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


_CHANNELS = ("mass_kg", "grade_rad", "altitude_m", "heading_rad", "curvature_1pm", "road_surface", "ambient_temp_c",
             "wind_speed_mps", "wind_from_rad", "wet_road", "gear")  # fmt: skip


def padded(rows: dict[str, np.ndarray], trip: np.ndarray, capacity: int) -> Segments:
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
    ends = {k: column(rows[k], 1.0 if k == "duration_s" else 0.0) for k in ROW_FIELDS}
    segments = Segments(trip=jnp.asarray(ids), vehicle=jnp.zeros(capacity, int), channels=channels, **ends)
    # what effects derive by trip is worked out here: compiling it takes longer than all the rest
    bounds = {FIRST: jnp.asarray(first), LAST: jnp.asarray(last)}
    return eqx.tree_at(lambda s: s.channels, segments, {**channels, **bounds})


def measured(
    config: FleetConfig, rows: dict[str, np.ndarray], trip: np.ndarray, truth: dict[str, np.ndarray],
    payload: np.ndarray, rng: np.random.Generator,
) -> dict[str, np.ndarray]:  # fmt: skip
    """What the instruments wrote: the columns of the log."""
    n, c = len(trip), config.log
    log = {k: x.copy() for k, x in rows.items() if k not in TRUTH_ONLY}
    log["mass_kg"] = np.round(rows["mass_kg"] / (1.0 + payload[trip]))
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
