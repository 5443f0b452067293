"""What acts across rows, by trip: positions in a trip, shifts by a fraction of a row, filters, running sums."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from hdev_jax.segments import Segments

__all__ = [
    "distance_since_start",
    "later_slope",
    "less_noise",
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
BRAKING_PA = 2e3  # pressure from which on a brake is on
ALIKE = 1e-5  # of their size: values that differ by less differ by their rounding in single precision
STANDS = 0.05  # m: a way that says nothing of a slope


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


def less_noise(column: Any, segments: Segments, sd: Any) -> Float[Array, " row"]:
    """What a column is in truth where its readings have independent errors of standard deviation `sd`: the best linear
    guess from a row and the mean of its two neighbours, by the moments of its trip; where the vehicle stands, as read.

    With r what of a reading the neighbours do not say (the residual of its regression on them), the error is expected
    to be sd²·r/Var r: cov(error, r) is sd², as the neighbours have errors of their own. At most all of r.
    Of few rows the moments are hardly known, and little is taken away.
    """
    x, (first, last) = jnp.asarray(column), trip_bounds(segments)
    index = jnp.arange(x.shape[0])
    before, after = jnp.where(index > first, index - 1, index + 1), jnp.where(index < last, index + 1, index - 1)
    near = 0.5 * (x[jnp.clip(before, first, last)] + x[jnp.clip(after, first, last)])
    moves = jnp.where(jnp.asarray(segments.distance_m) > 0, 1.0, 0.0)

    def total(y: Array) -> Array:
        return jnp.zeros_like(x).at[first].add(moves * y)[first]

    rows = jnp.maximum(total(jnp.ones_like(moves)), 1.0)
    own, others = x - total(x) / rows, near - total(near) / rows
    square, rounding = total(others**2), ALIKE**2 * total(x**2)
    differ = square > rounding
    told = jnp.where(differ, total(own * others) / jnp.where(differ, square, 1.0), 0.0)
    rest = own - told * others
    left = total(rest**2)
    there = (left > rounding) & (rows > 2)
    variance = jnp.where(there, left, 1.0) / jnp.maximum(rows - 2.0, 1.0)  # two numbers of the line are fitted
    return x - moves * jnp.where(there, jnp.minimum(sd**2 / variance, 1.0), 0.0) * rest


def later_slope(segments: Segments, ahead_s: Any) -> Float[Array, " row"]:
    """The slope of each row as it is read `ahead_s` seconds later in its trip, from the channel `grade_rad`.

    Slopes of rows are climbs over distances: between the rows' ends the height is a cubic in distance (Hermite's,
    with slopes at the ends weighted by the rows' lengths), so that a row that reads parts of two others reads what they
    climb there. Within a row the acceleration is constant. Held at the trip's edges; where the vehicle stands `ahead_s`
    later, the slope there. The channel itself at 0.
    """
    slope = jnp.asarray(segments.channels["grade_rad"])
    d, span = jnp.asarray(segments.distance_m), jnp.asarray(segments.duration_s)
    start, bounds = jnp.asarray(segments.time_s), trip_bounds(segments)
    first, last = bounds
    index = jnp.arange(slope.shape[0])
    before, after = jnp.maximum(index - 1, first), jnp.minimum(index + 1, last)
    # slopes at a row's two ends, by the parabola through its neighbours; the row's own at the edges of the trip
    own = jnp.maximum(d, 1e-9)
    at_start = (slope[before] * own + slope * own[before]) / (own + own[before])
    at_end = (slope[after] * own + slope * own[after]) / (own + own[after])
    u, v = jnp.asarray(segments.speed_start_mps), jnp.asarray(segments.speed_end_mps)
    ways, climbs = _sums_before(d, first), _sums_before(slope * d, first)

    def place(time: Array) -> tuple[Array, Array]:
        """How far it has come at a time, and how high."""
        k = _row_at(jax.lax.stop_gradient(time), start, bounds)
        share = jnp.clip((time - start[k]) / span[k], 0.0, 1.0)
        both = u[k] + v[k]
        x = jnp.where(both > 0, (2 * u[k] + (v[k] - u[k]) * share) / jnp.where(both > 0, both, 1.0), 1.0) * share
        # the cubic from 0 to the row's mean slope with these slopes at its ends
        bend = 3 * slope[k] - 2 * at_start[k] - at_end[k] + x * (at_start[k] + at_end[k] - 2 * slope[k])
        return ways[k] + d[k] * x, climbs[k] + d[k] * x * (at_start[k] + x * bend)

    begin, end = start[first], (start + span)[last]
    from_, to = (jnp.clip(t + ahead_s, begin, end) for t in (start, start + span))
    (way_from, height_from), (way_to, height_to) = place(from_), place(to)
    way = way_to - way_from
    here = slope[_row_at(jax.lax.stop_gradient(0.5 * (from_ + to)), start, bounds)]
    read = jnp.where(way > STANDS, (height_to - height_from) / jnp.where(way > STANDS, way, 1.0), here)
    # at 0 the channel to the last bit, with the derivative of what is read
    return jnp.where(
        jnp.asarray(ahead_s) == 0, jax.lax.stop_gradient(slope) + (read - jax.lax.stop_gradient(read)), read
    )


def _sums_before(x: Float[Array, " row"], first: Int[Array, " row"]) -> Float[Array, " row"]:
    """Sums over the rows of the trip before each: none runs on over the trips, so single precision is enough."""

    def add(total: Array, row: tuple[Array, Array]) -> tuple[Array, Array]:
        starts, value = row
        total = jnp.where(starts, jnp.zeros_like(total), total)
        return total + value, total

    return jax.lax.scan(add, jnp.zeros_like(x[0]), (first == jnp.arange(x.shape[0]), x), unroll=8)[1]


def _row_at(time: Array, start: Array, bounds: tuple[Array, Array]) -> Int[Array, " row"]:
    """The last row of each row's own trip that starts by a time, by bisection: the trips may come in any order."""

    def halve(_: Any, span: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = span
        middle = (low + high + 1) // 2
        starts = start[middle] <= time
        return jnp.where(starts, middle, low), jnp.where(starts, high, middle - 1)

    return jax.lax.fori_loop(0, start.shape[0].bit_length(), halve, bounds)[0]


def distance_since_start(segments: Segments) -> Float[Array, " row"]:
    """Distance from the start of the trip to the middle of the row [m]."""
    d = jnp.asarray(segments.distance_m)
    first, _ = trip_bounds(segments)
    before = jnp.cumsum(d) - d
    return before - before[first] + 0.5 * d


def time_since_braking(segments: Segments, threshold_pa: float = BRAKING_PA) -> Float[Array, " row"]:
    """Seconds from the end of the trip's last braked row to the middle of this one; 0 while braking and before."""
    first, _ = trip_bounds(segments)
    start, duration = jnp.asarray(segments.time_s), jnp.asarray(segments.duration_s)
    braking = jnp.asarray(segments.channels["brake_pressure_pa"]) > threshold_pa
    last = jax.lax.cummax(jnp.where(braking, jnp.arange(start.shape[0]), -1))
    held = jnp.maximum(last, 0)
    since = start + 0.5 * duration - (start + duration)[held]
    return jnp.where((last >= first) & ~braking, since, 0.0)
