"""What acts across rows, by trip: positions in a trip, shifts by a fraction of a row, filters, running sums."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from hdev_jax.segments import Segments

__all__ = [
    "at_times",
    "distance_since_start",
    "low_pass",
    "neighbours",
    "shifted",
    "time_since_braking",
    "trip_bounds",
    "with_bounds",
]


# Channels that are worked out once; the colon keeps them apart from any column that a log may bring.
FIRST, LAST = "derived:first_row_of_trip", "derived:last_row_of_trip"
DISTANCE_SINCE_START = "derived:distance_since_start_m"
TIME_SINCE_BRAKING = "derived:time_since_braking_s"


def trip_bounds(segments: Segments) -> tuple[Int[Array, " row"], Int[Array, " row"]]:
    """First and last row of each row's trip (rows of a trip are contiguous)."""
    if segments.has(FIRST, LAST):
        return jnp.asarray(segments.channels[FIRST]), jnp.asarray(segments.channels[LAST])
    trip = jnp.asarray(segments.trip)
    index = jnp.arange(trip.shape[0])
    change = trip[1:] != trip[:-1]
    starts = jnp.concatenate([jnp.array([True]), change])
    ends = jnp.concatenate([change, jnp.array([True])])
    first = jax.lax.cummax(jnp.where(starts, index, 0))
    last = jax.lax.cummin(jnp.where(ends, index, trip.shape[0] - 1), reverse=True)
    return first, last


def with_bounds(segments: Segments) -> Segments:
    """The same rows with their trips' bounds worked out once, for those who evaluate many times."""
    first, last = trip_bounds(segments)
    # not by with_channels: columns of a log are real, these are indices
    return eqx.tree_at(lambda s: s.channels, segments, {**segments.channels, FIRST: first, LAST: last})


def shifted(column: Any, segments: Segments, seconds: Any, cubic: Any = 0.0) -> Float[Array, " row"]:
    """The column `seconds` earlier, by a fraction of a row: x(t − s). The trip's edges hold their value.

    `cubic` blends linear interpolation (0) into the four-point cubic (1), whose slope at s = 0 is the central
    difference. Rows of unequal duration are shifted by their own.
    """
    x = jnp.asarray(column)
    first, last = trip_bounds(segments)
    rows = seconds / jnp.asarray(segments.duration_s)
    whole = jnp.floor(rows)
    a = rows - whole
    at = jnp.arange(x.shape[0]) - whole.astype(int)

    def pick(offset: int) -> Array:
        return x[jnp.clip(at + offset, first, last)]

    # Lagrange's four points at +1, 0, −1, −2 rows for the place −a
    ahead, here, behind, far = pick(1), pick(0), pick(-1), pick(-2)
    linear = (1 - a) * here + a * behind
    four = (
        -a * (1 - a) * (2 - a) / 6 * ahead
        + (1 + a) * (1 - a) * (2 - a) / 2 * here
        + (1 + a) * a * (2 - a) / 2 * behind
        - (1 + a) * a * (1 - a) / 6 * far
    )
    return linear + cubic * (four - linear)


def neighbours(column: Any, segments: Segments, rows: int) -> Float[Array, " row"]:
    """x(k−j) + x(k+j) − 2x(k) with j = `rows`; the trip's edges hold their value."""
    x = jnp.asarray(column)
    first, last = trip_bounds(segments)
    index = jnp.arange(x.shape[0])
    return x[jnp.clip(index - rows, first, last)] + x[jnp.clip(index + rows, first, last)] - 2 * x


def low_pass(column: Any, segments: Segments, tau_s: Any) -> Float[Array, " row"]:
    """First-order lag with time constant `tau_s` [s], started at each trip's first value; the column itself at 0."""
    x = jnp.asarray(column)
    first, _ = trip_bounds(segments)
    keep = jnp.exp(-jnp.asarray(segments.duration_s) / jnp.maximum(tau_s, 1e-9))
    keep = jnp.where(first == jnp.arange(x.shape[0]), 0.0, keep)

    return jax.lax.scan(_lagged, jnp.zeros_like(x[0]), (keep, x), unroll=8)[1]


def _lagged(carry: Array, row: tuple[Array, Array]) -> tuple[Array, Array]:
    """One row of a first-order lag."""
    keep, x = row
    y = keep * carry + (1 - keep) * x
    return y, y


def at_times(column: Any, segments: Segments, ahead_s: Any) -> Float[Array, " row"]:
    """The column `ahead_s` seconds later inside its trip, linear in time, held at the trip's edges.

    Exactly the column itself at 0, where the slope is that towards the next row.
    """
    x = jnp.asarray(column)
    clock = jnp.asarray(segments.time_s) + 0.5 * jnp.asarray(segments.duration_s)
    first, last = trip_bounds(segments)
    wanted = jnp.clip(clock + ahead_s, clock[first], clock[last])
    sought = jax.lax.stop_gradient(wanted)

    def halve(_: Any, span: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = span
        middle = (low + high + 1) // 2
        before = clock[middle] <= sought
        return jnp.where(before, middle, low), jnp.where(before, high, middle - 1)

    # bisection in each row's own trip: the trips may come in any order
    here, _ = jax.lax.fori_loop(0, x.shape[0].bit_length(), halve, (first, last))
    here = jnp.clip(here, first, jnp.maximum(last - 1, first))
    after = jnp.minimum(here + 1, last)
    gap = clock[after] - clock[here]
    part = jnp.where(gap > 0, (wanted - clock[here]) / jnp.where(gap > 0, gap, 1.0), 0.0)
    return (1 - part) * x[here] + part * x[after]


def distance_since_start(segments: Segments) -> Float[Array, " row"]:
    """Distance from the start of the trip to the middle of the row [m]."""
    d = jnp.asarray(segments.distance_m)
    first, _ = trip_bounds(segments)
    before = jnp.cumsum(d) - d
    return before - before[first] + 0.5 * d


def time_since_braking(segments: Segments, threshold_pa: float = 2e3) -> Float[Array, " row"]:
    """Seconds from the end of the trip's last braked row to the middle of this one; 0 while braking and before."""
    first, _ = trip_bounds(segments)
    start, duration = jnp.asarray(segments.time_s), jnp.asarray(segments.duration_s)
    braking = jnp.asarray(segments.channels["brake_pressure_pa"]) > threshold_pa
    last = jax.lax.cummax(jnp.where(braking, jnp.arange(start.shape[0]), -1))
    held = jnp.maximum(last, 0)
    since = start + 0.5 * duration - (start + duration)[held]
    return jnp.where((last >= first) & ~braking, since, 0.0)
