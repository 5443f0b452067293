"""Sequences for learning: a log's channels as plain arrays by trip, their scales, their lags."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from hdev_jax.errors import InputError
from hdev_jax.segments import Segments, trip_slices

__all__ = ["Scale", "Trip", "blocks", "energy_kwh", "lagged", "mean_squared", "trips_of"]

KW_S_PER_KWH = 3600.0


@dataclass(frozen=True)
class Trip:
    """One trip: inputs by name and the target, all `[row]`, `dt_s` [s] apart; `segments`, its rows for the kernel."""

    name: str
    dt_s: float
    inputs: dict[str, Float[np.ndarray, " row"]]
    target: Float[np.ndarray, " row"]
    segments: Segments

    def __len__(self) -> int:
        return len(self.target)

    def part(self, first: int, last: int) -> "Trip":
        """Rows `first` to `last`, the last not among them."""
        rows = slice(first, last)
        return Trip(
            self.name, self.dt_s, {k: x[rows] for k, x in self.inputs.items()}, self.target[rows],
            self.segments.take(np.arange(len(self))[rows]),
        )  # fmt: skip

    def columns(self, names: Sequence[str]) -> Float[np.ndarray, "row column"]:
        """The inputs side by side. Raises `InputError` for one that the trip lacks."""
        if lacking := [n for n in names if n not in self.inputs]:
            raise InputError(f"trip {self.name}: no input {lacking[0]!r}; it has {', '.join(sorted(self.inputs))}")
        return np.stack([self.inputs[n] for n in names], axis=1)


def trips_of(segments: Segments, target: Any, names: Sequence[str]) -> list[Trip]:
    """The trips of a log: every channel, speed and acceleration as inputs.

    **Arguments:** `target` `[row]` in its own unit; `names`, what the trips are called, by id.

    Raises `InputError` where a trip's rows are not equally long in time: a recursion over rows has one step.
    """
    found = []
    for k, rows in trip_slices(np.asarray(segments.trip)):
        own = segments.take(np.arange(rows.start, rows.stop))
        duration = np.asarray(own.duration_s)
        if np.ptp(duration) > 1e-3 * duration[0]:
            raise InputError(
                f"trip {names[k]}: rows of {duration.min():.3g} to {duration.max():.3g} s; resample the log"
            )
        inputs = {"speed_mps": own.speed_mps, "accel_from_speed_mps2": own.accel_mps2, **own.channels}
        arrays = {n: np.asarray(x, dtype=float) for n, x in inputs.items()}
        found.append(Trip(names[k], float(duration[0]), arrays, np.asarray(target, dtype=float)[rows], own))
    return found


@dataclass(frozen=True)
class Scale:
    """Mean and standard deviation of columns: what a network sees is (x − mean)/sd (paper 2, figure 10)."""

    mean: Float[np.ndarray, "*column"]
    sd: Float[np.ndarray, "*column"]

    @staticmethod
    def of(x: Any) -> "Scale":
        """The scale of the rows of `x`; a constant column keeps its unit."""
        x = np.asarray(x, dtype=float)
        sd = x.std(axis=0)
        return Scale(np.asarray(x.mean(axis=0)), np.where(sd > 0, sd, 1.0))

    def apply(self, x: Any) -> np.ndarray:
        return (np.asarray(x, dtype=float) - self.mean) / self.sd

    def undo(self, z: Any) -> np.ndarray:
        return np.asarray(z, dtype=float) * self.sd + self.mean


def lagged(columns: Any, lags: Sequence[int]) -> Float[np.ndarray, "row lagged"]:
    """x(k − lag) for every column and lag: the lags of the first column, then of the second, …; edges hold their value.

    A negative lag looks ahead.
    """
    x = np.asarray(columns, dtype=float)
    index = np.arange(len(x))
    if not len(lags):
        return np.zeros((len(x), 0))
    parts = [x[np.clip(index - lag, 0, len(x) - 1)] for lag in lags]
    return np.stack(parts, axis=2).reshape(len(x), -1)


def blocks(rows: int, count: int) -> np.ndarray:
    """The number of the contiguous block that each row is in: folds of a validation that respects time."""
    if not 2 <= count <= rows:
        raise InputError(f"{count} blocks of {rows} rows: from 2 to as many as there are rows")
    return np.arange(rows) * count // rows


def mean_squared(error: Any) -> float:
    """MSE (paper 2, equation 22)."""
    return float(np.mean(np.square(error)))


def energy_kwh(power_kw: Any, dt_s: float) -> tuple[float, float, float]:
    """Total, positive and negative energy of a trip [kWh] (paper 2, equation 13 and table V)."""
    p = np.asarray(power_kw)
    return tuple(float(x.sum() * dt_s / KW_S_PER_KWH) for x in (p, np.maximum(p, 0.0), np.minimum(p, 0.0)))  # type: ignore[return-value]
