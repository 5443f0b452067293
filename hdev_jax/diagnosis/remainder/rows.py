"""Rows of one side of the split as the looks at the remainder take them."""

from collections.abc import Mapping
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from hdev_jax.inference import Clusters, cluster_rows
from hdev_jax.physics.across import distance_since_start
from hdev_jax.problem import Problem
from hdev_jax.segments import NO_CAUSE

__all__ = ["Rows", "features", "side"]

SECONDS_PER_WH_OF_A_KW = 3.6


@dataclass(frozen=True)
class Rows:
    """Features, residual (measured − predicted), trips and clock of one side of the split.

    `worth` is what a constant power (or force) of one `cycle_unit` is in each row's unit; `weight` what a row weighs in
    a sum; `amounts` what a sum may be in proportion to, on each row.
    """

    features: Float[np.ndarray, "row feature"]
    residual: Float[np.ndarray, " row"]
    clusters: Clusters
    trip: np.ndarray
    duration_s: np.ndarray
    worth: np.ndarray
    cycle_unit: str
    weight: np.ndarray
    amounts: Mapping[str, np.ndarray]


def features(problem: Problem, predicted: np.ndarray, declared: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """What a flexible learner may use: every channel, motion, time and place in the trip, and the models' own words."""
    s = problem.segments
    columns: dict[str, np.ndarray] = {
        "speed_mps": np.asarray(s.speed_mps),
        "acceleration": np.asarray(s.accel_mps2),
        "time_s": np.asarray(s.time_s),
        "distance_since_start_m": np.asarray(distance_since_start(jax.tree.map(jnp.asarray, s))),
        "duration_s": np.asarray(s.duration_s),
        "predicted": predicted,
        "declared": declared,
        **{k: np.asarray(v, dtype=float) for k, v in s.without(*NO_CAUSE).channels.items()},
    }
    names = [k for k, v in columns.items() if np.ptp(v) > 0]
    return np.stack([columns[k] for k in names], axis=1), names


def side(problem: Problem, at: np.ndarray, predicted: np.ndarray, columns: np.ndarray) -> Rows:
    """Rows of one side of the split with what a prediction leaves of them; predictions and columns are of all rows."""
    segments = problem.segments.take(at)
    residual, seconds = (problem.measured - predicted)[at], np.asarray(segments.duration_s)
    worth, unit = np.ones(len(seconds)), problem.unit
    if problem.target == "energy_wh":  # a load in kW, whatever the rows' lengths
        worth, unit = seconds / SECONDS_PER_WH_OF_A_KW, "kW"
    trip, weight = np.asarray(segments.trip), problem.weight()[at]
    meters, energy = np.asarray(segments.distance_m), weight * np.abs(problem.measured[at])
    amounts = {"time": seconds, "distance": meters, "energy": energy}
    return Rows(columns[at], residual, cluster_rows(segments), trip, seconds, worth, unit, weight, amounts)
