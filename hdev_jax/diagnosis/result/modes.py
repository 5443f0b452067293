"""The modes of a vehicle in time: in which trips it is in the second one, and from which trip on."""

from datetime import UTC, datetime
from itertools import pairwise
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from hdev_jax.diagnosis.noise.noise import estimate_noise, log_likelihood_of_trip, whiten
from hdev_jax.inference import Calibration
from hdev_jax.inference.states import probability_of_modes
from hdev_jax.physics.battery import ModeChange
from hdev_jax.physics.effect import Grouped
from hdev_jax.problem import Problem
from hdev_jax.segments import trip_slices

__all__ = ["mode_block"]


def mode_block(problem: Problem, fit: Calibration) -> dict[str, Any]:
    """The probability that each trip of the log is in the second mode, given its measured power, that of the trips
    beside it and the noise of all; and between which trips of a vehicle it changes, with the time where the log has
    one."""
    segments, names = problem.segments, problem.log.trip_names
    trip, seconds = np.asarray(segments.trip), np.asarray(segments.duration_s)
    slices = [s for _, s in trip_slices(trip)]
    effect = fit.vehicle.effect(ModeChange.id)
    left = []
    for z in (0.0, 1.0):
        there = eqx.tree_at(lambda e: e.in_mode, effect, jnp.asarray(z), is_leaf=lambda x: isinstance(x, Grouped))
        left.append(problem.measured - problem.predict(fit.vehicle.minus(effect.id).plus(there)))
    residual = np.stack(left, axis=1)
    # the noise is of what is left in the mode that each trip is nearer to
    nearer = [int(np.argmin(np.sum(residual[s] ** 2, axis=0))) for s in slices]
    best = np.concatenate([residual[s, k] for s, k in zip(slices, nearer, strict=True)])
    noise = estimate_noise(best, trip, seconds, levels=True)
    white = whiten(residual, noise, trip, seconds)
    fits = np.stack([log_likelihood_of_trip(white[s], noise.level_sd) for s in slices])
    starts = np.array([problem.log.started_s.get(names[int(trip[s.start])], np.nan) for s in slices])
    vehicle = np.array([int(np.asarray(segments.vehicle)[s.start]) for s in slices])
    order = np.lexsort((starts, vehicle)) if np.all(np.isfinite(starts)) else np.argsort(vehicle, kind="stable")
    p = probability_of_modes(fits[order], vehicle[order])
    each = [
        (names[int(trip[slices[k].start])], float(x), float(starts[k]), int(vehicle[k]))
        for k, x in zip(order, p, strict=True)
    ]
    changes = [
        {"trip": name, "to": "second" if x > 0.5 else "first", "start": _iso(start), "after": before}
        for (before, y, _, car), (name, x, start, same) in pairwise(each)
        if car == same and (x > 0.5) != (y > 0.5)
    ]
    return {"probability": {name: x for name, x, *_ in each}, "changes": changes}


def _iso(start: float) -> str | None:
    """A time in seconds since 1970 as the log's own clock has it."""
    return datetime.fromtimestamp(start, UTC).strftime("%Y-%m-%dT%H:%M:%S") if np.isfinite(start) else None
