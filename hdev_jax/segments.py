"""`Segments`: the only record. One row is one interval of driving, 100 m of road or 0.22 s of CAN samples."""

from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float, Int

__all__ = [
    "ACCEL_OF_WAY", "ACCEL_SD", "GRADE_SD", "NO_CAUSE", "READING_ERRORS", "SPREAD", "SQUARE_SPEED", "WITHIN_ROWS",
    "Column", "Ids", "Segments", "starts_of_runs", "trip_slices",
]  # fmt: skip

Column = Float[Array, "*row"] | Float[np.ndarray, "*row"]
Ids = Int[Array, "*row"] | Int[np.ndarray, "*row"]
GRADE_SD, ACCEL_SD = "grade_sd_rad", "accel_sd_mps2"
READING_ERRORS = (GRADE_SD, ACCEL_SD)
"""Channels with the standard deviations of the slope and of the acceleration by speeds, where they matter."""
ACCEL_OF_WAY, SQUARE_SPEED, SPREAD = "accel_over_distance_mps2", "square_speed_m2ps2", "accel_spread_mps2"
WITHIN_ROWS = (ACCEL_OF_WAY, SQUARE_SPEED, SPREAD)
"""Channels of rows that were put together from samples: means over distance of the acceleration and of v², and the
standard deviation over distance of the acceleration, which the speeds at a row's ends do not tell."""
NO_CAUSE = (*READING_ERRORS, *WITHIN_ROWS)
"""Channels that are no cause of anything, and offered as none."""


class Segments(eqx.Module):
    """The rows of a log as columns `[row]`. Trips of any length stand one after another; `trip` tells them apart.

    Columns that a log may lack (`grade_rad`, `mass_kg`, `motor_torque_nm`, `ambient_temp_c`, …) are in `channels`,
    named as in a log's header and in SI. Which channels there are is known before tracing. The kernel sees the same
    class with one number per column, so an effect is written for one row.

    **Arguments:** `trip` and `vehicle` are 0-based ids; rows of a trip are contiguous and in time order. `time_s` is
    the start of the interval, counted from the start of the trip; `duration_s` > 0, `distance_m` ≥ 0, speeds in m/s.
    """

    trip: Ids
    vehicle: Ids
    time_s: Column
    duration_s: Column
    distance_m: Column
    speed_start_mps: Column
    speed_end_mps: Column
    channels: dict[str, Column]

    @classmethod
    def from_arrays(
        cls,
        *,
        duration_s: Any,
        speed_start_mps: Any,
        speed_end_mps: Any,
        distance_m: Any = None,
        time_s: Any = None,
        trip: Any = None,
        vehicle: Any = None,
        **channels: Any,
    ) -> "Segments":
        """Rows from arrays of one length, in SI; a number stands for a constant column.

        **Arguments:** `distance_m`: by default the mean of the two speeds times the duration. `time_s`: by default the
        sum of the durations before the row in its trip. `trip`, `vehicle`: 0-based ids, by default one trip and one
        vehicle. `channels`: as in a log (`grade_rad`, `mass_kg`, …). **Raises:** `ValueError` for arrays that do not
        go together.
        """
        ends = [np.atleast_1d(np.asarray(x, dtype=float)) for x in (duration_s, speed_start_mps, speed_end_mps)]
        every = {k: np.atleast_1d(np.asarray(v, dtype=float)) for k, v in channels.items()}
        try:
            (n,) = np.broadcast_shapes(*(x.shape for x in (*ends, *every.values())))
        except ValueError as e:
            lengths = {"duration_s": ends[0].shape, "speed_start_mps": ends[1].shape, "speed_end_mps": ends[2].shape}
            lengths |= {k: v.shape for k, v in every.items()}
            raise ValueError(f"arrays of one length are expected, found {lengths}") from e
        duration, start, end = (np.broadcast_to(x, n).copy() for x in ends)
        if not np.all(duration > 0):
            raise ValueError("duration_s: every row lasts longer than 0 s; found a row that does not")
        trip = np.zeros(n, dtype=np.int32) if trip is None else np.asarray(trip, dtype=np.int32)
        vehicle = np.zeros(n, dtype=np.int32) if vehicle is None else np.asarray(vehicle, dtype=np.int32)
        if time_s is None:
            time_s = np.concatenate([np.cumsum(duration[s]) - duration[s] for _, s in trip_slices(trip)])
        distance = 0.5 * (start + end) * duration if distance_m is None else np.asarray(distance_m, dtype=float)
        if not len(trip) == len(vehicle) == len(time_s) == len(distance) == n:
            raise ValueError(f"trip, vehicle, time_s and distance_m have {n} values, one a row")
        return cls(
            trip=trip, vehicle=vehicle, time_s=np.asarray(time_s, dtype=float), duration_s=duration,
            distance_m=distance, speed_start_mps=start, speed_end_mps=end,
            channels={k: np.broadcast_to(v, n).copy() for k, v in every.items()},
        )  # fmt: skip

    @property
    def speed_mps(self) -> Column:
        """Mean speed of the interval, distance over duration [m/s]; zero at standstill."""
        return self.distance_m / self.duration_s

    @property
    def accel_mps2(self) -> Column:
        """(v_end − v_start) / duration [m/s²]; an accelerometer's reading is `channels["accel_mps2"]`."""
        return (self.speed_end_mps - self.speed_start_mps) / self.duration_s

    @property
    def accel_of_way_mps2(self) -> Column:
        """Mean over the row's way [m/s²], so that m·a·Δs is Δ(½mv²); `accel_mps2` where only end speeds are known."""
        return self.channels.get(ACCEL_OF_WAY, self.accel_mps2)

    @property
    def square_speed_m2ps2(self) -> Column:
        """Mean of v² over the row's way [m²/s²]; (v_i² + v_f²)/2 (paper 1, equation 4) where only those are known."""
        return self.channels.get(SQUARE_SPEED, 0.5 * (self.speed_start_mps**2 + self.speed_end_mps**2))

    def faster(self, factor: Any) -> "Segments":
        """The same rows with all speeds and distances so many times as large."""
        lengths = ("distance_m", "speed_start_mps", "speed_end_mps")
        within = {ACCEL_OF_WAY: factor, SQUARE_SPEED: factor**2, SPREAD: factor}
        moved = eqx.tree_at(
            lambda s: [getattr(s, k) for k in lengths], self, [getattr(self, k) * factor for k in lengths]
        )
        return moved.with_channels(**{k: self.channels[k] * f for k, f in within.items() if k in self.channels})

    def __len__(self) -> int:
        return self.trip.shape[0]

    def has(self, *names: str) -> bool:
        """Whether every one of these channels is there."""
        return all(n in self.channels for n in names)

    def get(self, name: str, default: float | Column) -> float | Column:
        """The channel, or `default` where the log lacks it."""
        return self.channels.get(name, default)

    def with_channels(self, **columns: Column) -> "Segments":
        """The same rows with channels added or replaced."""
        return eqx.tree_at(lambda s: s.channels, self, {**self.channels, **columns})

    def without(self, *names: str) -> "Segments":
        """The same rows with these channels taken away."""
        kept = {k: v for k, v in self.channels.items() if k not in names}
        return eqx.tree_at(lambda s: s.channels, self, kept)

    def take(self, rows: np.ndarray) -> "Segments":
        """Some of the rows, by a boolean mask or indices `[row]`, as NumPy arrays; ids stay as they are."""
        return jax.tree.map(lambda x: np.asarray(x)[rows], self)


def trip_slices(trip: np.ndarray) -> Iterator[tuple[int, slice]]:
    """`(id, slice of its rows)` for each run of equal ids, in the order of the rows."""
    trip = np.asarray(trip)
    if not len(trip):
        return
    edges = np.flatnonzero(np.diff(trip)) + 1
    for start, stop in zip(np.r_[0, edges], np.r_[edges, len(trip)], strict=True):
        yield int(trip[start]), slice(int(start), int(stop))


def starts_of_runs(trip: np.ndarray, duration_s: np.ndarray, seconds: float) -> np.ndarray:
    """First rows of runs of at least so many seconds inside a trip; every row's own where rows are as long."""
    starts = []
    for _, s in trip_slices(trip):
        clock = np.floor(np.cumsum(duration_s[s]) / seconds - 1e-9)
        starts.append(np.flatnonzero(np.r_[True, np.diff(clock) > 0]) + s.start)
    return np.concatenate(starts)
