"""Choices made on the training trip alone: blocks of time left out, and what lies at the edge left out too."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import jax
import numpy as np
from jaxtyping import Array, Float

from hdev_jax.learn.narx.model import Structure, fit_prediction, prepared, starts, with_theta
from hdev_jax.learn.sequences import Trip, blocks, mean_squared

__all__ = ["Score", "by_blocks", "edge", "folds", "validated"]


@runtime_checkable
class Predicts(Protocol):
    """A fitted model: one step ahead, and what that is to be compared with."""

    def predict(self, trip: Trip) -> Float[np.ndarray, " row"]: ...

    def measured(self, trip: Trip) -> Float[np.ndarray, " row"]: ...


@dataclass(frozen=True)
class Score:
    """MSE of rows left out, in the squared unit of the target: of blocks of time, of the edge, and of both together.

    `mse`, of both, counts a row of the edge twice: once as time, once as the edge. These three are means over starts;
    `least` is of both for the start of least training loss in each fold, `ensemble` for the mean of all predictions.
    Where the edge was not left out, `edge` is None and the others are of blocks alone.
    """

    mse: float
    blocks: float
    edge: float | None
    least: float
    ensemble: float
    by_start: tuple[float, ...]


def edge(target: Any, share: float = 0.01) -> np.ndarray:
    """The rows of the smallest and the largest `share` of the target.

    Other trips brake and accelerate harder than the training trip: a choice by blocks of time never sees that.
    """
    low, high = np.quantile(target, [share, 1 - share])
    return (np.asarray(target) < low) | (np.asarray(target) > high)


def folds(target: Any, count: int) -> list[np.ndarray]:
    """Rows left out of each fold: `count` contiguous blocks, and the edge."""
    number = blocks(len(target), count)
    return [*(number == k for k in range(count)), edge(target)]


def validated(
    structure: Structure,
    trip: Trip,
    *,
    key: Array,
    count: int,
    blocks: int = 3,
    huber: float,
    ridge: Any,
    steps: int = 80,
) -> Score:
    """One step ahead on rows left out, from `count` starts in each fold, all fits in one program.

    A structure without units has one solution, whatever the start.
    """
    model = prepared(structure, trip)
    left_out = folds(model.measured(trip), blocks)
    count = count if structure.units else 1
    weights = np.repeat(np.stack([1.0 - f for f in left_out]), count, axis=0)
    keys = jax.random.split(key, len(weights))
    if structure.units:
        begin = starts(model, trip, keys=keys, huber=huber, ridge=ridge, weights=weights)
    else:
        begin = np.zeros((len(weights), structure.shape.size))
    fit = fit_prediction(model, trip, begin, huber=huber, ridge=ridge, weights=weights, max_steps=steps, rtol=1e-5)
    # in each fold the start of least loss first
    order = np.argsort(np.nan_to_num(np.asarray(fit.loss), nan=np.inf).reshape(len(left_out), count), axis=1)
    thetas = np.take_along_axis(np.asarray(fit.theta).reshape(len(left_out), count, -1), order[:, :, None], axis=1)
    return _score(trip, left_out, [[with_theta(model, t) for t in fold] for fold in thetas], edge=True)


def by_blocks(fit: Callable[[np.ndarray], Sequence[Predicts]], trip: Trip, *, count: int) -> Score:
    """As `validated`, of models that read every row of a trip in turn: `count` blocks of time are left out, no edge.

    **Arguments:** `fit`, models from each start, the best first, fitted without the rows `[row]` that it is given.
    """
    number = blocks(len(trip), count)
    left_out = [number == k for k in range(count)]
    return _score(trip, left_out, [fit(rows) for rows in left_out], edge=False)


def _score(trip: Trip, left_out: list[np.ndarray], fitted: Sequence[Sequence[Predicts]], *, edge: bool) -> Score:
    """Of what each fold's models say of the rows left out; the last fold is the edge where there is one."""
    measured = fitted[0][0].measured(trip)
    errors = [
        np.stack([m.predict(trip)[rows] - measured[rows] for m in models])
        for rows, models in zip(left_out, fitted, strict=True)
    ]
    both: Float[np.ndarray, "start row"] = np.concatenate(errors, axis=1)
    return Score(
        mse=mean_squared(both), blocks=mean_squared(np.concatenate(errors[:-1] if edge else errors, axis=1)),
        edge=mean_squared(errors[-1]) if edge else None, least=mean_squared(both[0]),
        ensemble=mean_squared(both.mean(axis=0)), by_start=tuple(np.mean(both**2, axis=1)),
    )  # fmt: skip
