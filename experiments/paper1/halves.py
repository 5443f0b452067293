"""Paper 1, table 1: c_rr and drag area from the first half of a trip, the energy of its second half from them.

A trip is laps of one track. *Tabular* keeps the tables' values, *Bayesian* is the paper's regression (c_rr and C_d·A,
normal noise, rows independent), *ours* has besides what every vehicle has and the paper's model leaves out: the
auxiliary load, an error of the mass that is logged, and errors that are correlated in time. No tails are weighed down:
a total is a sum, and what is weighed down is missing in it. Models A-D are those of the synthetic fleet; a lap is the
same drive again, with noise of its own.
"""

import numpy as np

from hdev_jax.inference import Coefficient, LinearFit, ParameterTable, Rows, clusters_of, linear_fit, padded, predict
from hdev_jax.physics import Vehicle, at_null
from hdev_jax.physics.sensors import MassScale
from hdev_jax.problem import metrics, sum_weight
from hdev_jax.segments import Segments
from hdev_jax.targets import TargetName

__all__ = ["coefficient", "errors", "fitted", "halves", "laps", "ours", "paper_table"]

AUXILIARY_SD_W = 1500.0  # what a truck's steering, air and cooling take besides what its sheet declares, give or take
MASS_SD = 0.05  # of the logged mass: axle-load sensors and way bills


def coefficient(path: str, unit: str, value: float, sd: float, *, positive: bool = True) -> Coefficient:
    """A free coefficient with its table."""
    return Coefficient(path, unit, value, sd, sd, 0.0 if positive else -np.inf, np.inf)


def paper_table(c_rr: tuple[float, float], cda_m2: tuple[float, float]) -> ParameterTable:
    """The paper's two coefficients with their tables (value, sd)."""
    return ParameterTable((coefficient("road.c_rr", "1", *c_rr), coefficient("road.cda_m2", "m²", *cda_m2)))


def ours(vehicle: Vehicle, table: ParameterTable) -> tuple[Vehicle, ParameterTable]:
    """The vehicle with an error of its mass, and the table with that and the auxiliary load free besides."""
    load = float(vehicle.effect("auxiliary").auxiliary_w)
    more = (
        coefficient("battery.auxiliary_w", "W", load, AUXILIARY_SD_W, positive=False),
        coefficient("effects.mass_scale.scale", "1", 0.0, MASS_SD, positive=False),
    )
    return vehicle.plus(at_null(MassScale)), table.plus(*more)


def laps(segments: Segments, count: int) -> Segments:
    """The same rows so many times as one trip; time goes on."""
    n = len(segments)
    once = float(np.asarray(segments.time_s)[-1] + np.asarray(segments.duration_s)[-1])
    again = segments.take(np.tile(np.arange(n), count))
    time_s = np.asarray(again.time_s) + once * np.repeat(np.arange(count), n)
    return Segments(
        np.zeros(n * count, dtype=np.int32), np.zeros(n * count, dtype=np.int32), time_s, again.duration_s,
        again.distance_m, again.speed_start_mps, again.speed_end_mps, again.channels,
    )  # fmt: skip


def halves(segments: Segments) -> tuple[np.ndarray, np.ndarray]:
    """Rows of a trip's first and of its second half, by distance."""
    way = np.cumsum(np.asarray(segments.distance_m))
    first = way <= 0.5 * way[-1]
    return first, ~first


def fitted(
    vehicle: Vehicle, table: ParameterTable, segments: Segments, measured: np.ndarray, target: TargetName, *,
    paper: bool, size: int | None = None,
) -> LinearFit:  # fmt: skip
    """The closed form on these rows: the paper's (independent normal rows), or ours. `size`: as in `padded`."""
    rows = padded(segments, measured, size)
    clusters = clusters_of(np.asarray(segments.trip), np.asarray(segments.duration_s))
    return linear_fit(
        vehicle, table, lambda: [Rows(rows, clusters.ids)], target, clusters=0 if paper else clusters.count
    )


def errors(
    vehicle: Vehicle, segments: Segments, measured: np.ndarray, target: TargetName
) -> tuple[float, float | None]:
    """`(rmse, pe)`: by row in the target's unit, and of the total in per cent; None where that is near 0."""
    rows = padded(segments, measured)
    predicted = np.asarray(predict(vehicle, rows.segments, target))[: rows.rows]
    weight = sum_weight(target, np.asarray(segments.duration_s), np.asarray(segments.distance_m))
    found = metrics(measured, predicted, weight)
    return found["rmse"], found["pe_percent"]
