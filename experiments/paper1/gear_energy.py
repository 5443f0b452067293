"""What the surrogate's gear costs in energy: the true vehicle with its true gear and with the predicted one."""

from functools import cache
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from experiments.paper1.gears import Rows, the_fleet
from hdev_jax.physics import GEAR_PROBABILITY

__all__ = ["energy_cost"]


@eqx.filter_jit
def _energy(vehicle: Any, segments: Any) -> Any:
    return vehicle.energy(segments)


@cache
def _capacity(fleet: tuple[int, int, tuple[str, ...]]) -> int:
    return max(len(v) for v in the_fleet(*fleet).vehicles) + 1


def _filled(segments: Any, capacity: int) -> Any:
    """Rows to one length for all vehicles, which then share a compiled program: the last row again, as another trip."""
    more = capacity - len(segments)
    filled = jax.tree.map(lambda a: np.concatenate([a, np.repeat(np.asarray(a)[-1:], more, axis=0)]), segments)
    trip = np.asarray(filled.trip).copy()
    trip[capacity - more :] += 1
    return jax.tree.map(jnp.asarray, eqx.tree_at(lambda s: s.trip, filled, trip))


def energy_cost(rows: Rows, probability: np.ndarray, of: tuple[int, int, tuple[str, ...]]) -> dict[str, dict[str, Any]]:
    """By vehicle and way to take the gear: energy against that with the true gear, and against the measured.

    **Arguments:** `probability` [row, gear] of `Rows`' rows; `of`, the arguments of `the_fleet`. Only rows that were
    not trained on count.

    **Returns** by vehicle: `added_percent` for `hard`, `soft` and `none` (always the highest gear); `rmse_wh` and
    `trip_percent` (mean over routes of the absolute error of the route's energy) of these and of the `true` gear.
    """
    out: dict[str, dict[str, Any]] = {}
    fleet, capacity = the_fleet(*of), _capacity(of)
    test = ~rows.train
    for k, v in enumerate(fleet.vehicles):
        at = np.flatnonzero(rows.vehicle == k)
        if not len(at) or not test[at].any():
            continue
        n, use = len(at), test[at]
        told, gears = probability[at], int(rows.gears[at[0]])
        ratios = v.true.driveline.gear_ratios
        width = gears if ratios is None else ratios.shape[0]
        soft = np.pad(told[:, :gears], ((0, 0), (0, width - gears)))
        soft = soft / soft.sum(axis=1, keepdims=True)
        segments = v.segments.with_channels(gear=rows.gear[at].astype(float))
        ways = {
            "true": segments,
            "hard": segments.with_channels(gear=1.0 + np.argmax(soft, axis=1)),
            "soft": segments.without("gear").with_channels(**{GEAR_PROBABILITY: soft}),
            "none": segments.with_channels(gear=np.full(n, float(gears))),
        }
        energy = {w: np.asarray(_energy(v.true, _filled(s, capacity)))[:n][use] for w, s in ways.items()}
        measured, trip = v.energy_wh[use], np.asarray(v.segments.trip)[use]
        total = energy["true"].sum()
        out[v.id] = {
            "added_percent": {w: 100 * float((e.sum() - total) / total) for w, e in energy.items() if w != "true"},
            "rmse_wh": {w: float(np.sqrt(np.mean((e - measured) ** 2))) for w, e in energy.items()},
            "trip_percent": {w: _by_trip(e, measured, trip) for w, e in energy.items()},
        }
    return out


def _by_trip(energy: np.ndarray, measured: np.ndarray, trip: np.ndarray) -> float:
    _, at = np.unique(trip, return_inverse=True)
    e, m = np.bincount(at, energy), np.bincount(at, measured)
    large = np.abs(m) > 0.05 * np.bincount(at, np.abs(measured))
    return 100 * float(np.mean(np.abs(e - m)[large] / np.abs(m[large])))
