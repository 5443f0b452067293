"""Does a slope that is mostly error do harm? The declared model, calibrated and cross-validated with it and without."""

from dataclasses import replace

import numpy as np

from hdev_jax.inference import calibrate, cluster_rows, padded
from hdev_jax.problem.problem import Problem, prepare
from hdev_jax.problem.split import Split
from hdev_jax.segments import GRADE_SD, Segments

__all__ = ["without_harmful_slope"]

_SLOPE = ("grade_rad", GRADE_SD)


def without_harmful_slope(problem: Problem, split: Split) -> Problem:
    """The problem without the log's slope, where that has an error which matters and predicts worse than a flat road.

    Every second cluster of the training rows is held out in turn. The slope is left out where the squared error with it
    is larger by more than one standard error over clusters (Breiman et al., Classification and Regression Trees, 1984,
    section 3.4.3). What it came to is among the notes and in the ledger.
    """
    if problem.vehicle.entry != "road" or not problem.segments.has(*_SLOPE) or not problem.table.free:
        return problem
    rows = problem.rows(split.train)
    segments, measured = problem.segments.take(rows), problem.measured[rows]
    clusters = cluster_rows(segments)
    if clusters.count < 4:
        return problem
    flat = segments.with_channels(**{name: np.zeros(len(segments)) for name in _SLOPE})
    with_it, without = (_squares(problem, s, measured, clusters.ids) for s in (segments, flat))
    worse = with_it - without
    error = float(np.std(worse, ddof=1) * np.sqrt(len(worse)))
    if not float(np.sum(worse)) > error:
        return problem
    rms = [f"{np.sqrt(np.sum(x) / len(segments)):.3g}" for x in (with_it, without)]
    told = f"the slope makes it worse: error {rms[0]} {problem.unit} with it, {rms[1]} without; it was left out"
    log = problem.log
    ledger = log.ledger.add("noted", told, count=len(log), column="grade_rad")
    left = replace(log, segments=log.segments.without(*_SLOPE), ledger=ledger)
    again = prepare(left, problem.sheet, problem.target)
    return replace(again, notes=(told, *again.notes))


def _squares(problem: Problem, segments: Segments, measured: np.ndarray, ids: np.ndarray) -> np.ndarray:
    """Squared errors `[cluster]` of predictions from the other half of the clusters."""
    fit, squares = padded(segments, measured), np.zeros(len(measured))
    for half in (0, 1):
        out = ids % 2 == half
        weights = np.where(out, 0.0, 1.0)
        found = calibrate(
            problem.vehicle, problem.table, fit, problem.target, cluster_rows(segments), weights=weights
        )  # fmt: skip
        squares[out] = (measured - found.predicted)[out] ** 2
    return np.bincount(ids, squares)
