"""A load that wanders: its course by a Gauss-Markov process of first order, smoothed, and its energy in each trip.

x is stationary with a standard deviation and e^(−Δt/memory) of it is kept over Δt; a row measures y = g·x + e. Kalman's
filter and the smoother of Rauch, Tung and Striebel (AIAA Journal 3, 1965) as scans over rows, trips as separate
sequences; the sum of a·x over a trip is filtered along with x, so that its variance has all covariances in it.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from hdev_jax.inference.states.lanes import Lanes

__all__ = ["Course", "course"]


class Course(NamedTuple):
    """Mean and standard deviation of x in each row given all rows of its trip, and of the sum of a·x over each trip, in
    the order of the rows."""

    mean: Float[np.ndarray, " row"]
    sd: Float[np.ndarray, " row"]
    total: Float[np.ndarray, " trip"]
    total_sd: Float[np.ndarray, " trip"]


def _filtered(carry: Any, row: Any) -> tuple[Any, Any]:
    """One row: x and the sum so far, predicted, corrected by the measurement, and the row added to the sum."""
    mean, variance, total, cross, total_variance = carry
    keep, y, g, noise, a, stationary = row
    inside = keep > 0
    ahead, open_ = keep * mean, keep**2 * variance + (1.0 - keep**2) * stationary
    total, cross, total_variance = (jnp.where(inside, x, 0.0) for x in (total, keep * cross, total_variance))
    scale = 1.0 / (g**2 * open_ + noise)
    off = y - g * ahead
    mean, variance = ahead + open_ * g * scale * off, open_ - (open_ * g) ** 2 * scale
    total, total_variance = total + cross * g * scale * off, total_variance - (cross * g) ** 2 * scale
    cross = cross - open_ * cross * g**2 * scale
    total, total_variance = total + a * mean, total_variance + a**2 * variance + 2.0 * a * cross
    carry = (mean, variance, total, cross + a * variance, total_variance)
    return carry, (mean, variance, ahead, open_, total, total_variance)


def _smoothed(later: Any, row: Any) -> tuple[Any, Any]:
    mean_later, variance_later, ahead, open_, keep = later
    mean, variance, own_ahead, own_open, own_keep = row
    back = variance * keep / open_
    mean = mean + back * (mean_later - ahead)
    variance = variance + back**2 * (variance_later - open_)
    return (mean, variance, own_ahead, own_open, own_keep), (mean, variance)


@jax.jit
def _course(
    keep: Float[Array, "row lane"], y: Float[Array, "row lane"], g: Float[Array, "row lane"],
    noise: Float[Array, "row lane"], a: Float[Array, "row lane"], stationary: Float[Array, ""],
) -> tuple[Float[Array, "row lane"], ...]:  # fmt: skip
    zero = jnp.zeros(keep.shape[1])
    stationary = jnp.broadcast_to(stationary, keep.shape)
    _, found = jax.lax.scan(_filtered, (zero,) * 5, (keep, y, g, noise, a, stationary))
    mean, variance, ahead, open_, total, total_variance = found
    end = (zero, zero, zero, zero + 1.0, zero)
    _, smooth = jax.lax.scan(_smoothed, end, (mean, variance, ahead, open_, keep), reverse=True)
    return (*smooth, total, total_variance)


def course(
    y: Float[np.ndarray, " row"], g: Float[np.ndarray, " row"], noise_sd: Float[np.ndarray, " row"],
    amount: Float[np.ndarray, " row"], duration_s: Float[np.ndarray, " row"], trip: Int[np.ndarray, " row"],
    *, sd: float, memory_s: float,
) -> Course:  # fmt: skip
    """The course of x in rows of whole trips, as `Course`.

    **Arguments:** `y`, measured g·x with independent errors of `noise_sd`; `amount`, a in the sum over a trip; `sd` and
    `memory_s` [s] of x, which is 0 on average.
    """
    lanes = Lanes.of(trip)
    between = 0.5 * (duration_s + np.r_[0.0, duration_s[:-1]])
    keep = np.exp(-between / memory_s)
    keep[lanes.starts] = 0.0
    columns = [lanes.spread(x, fill) for x, fill in ((keep, 0), (y, 0), (g, 0), (noise_sd**2, 1), (amount, 0))]
    mean, variance, total, total_variance = (
        np.asarray(x)[lanes.place, lanes.lane] for x in _course(*columns, np.asarray(sd**2))
    )
    ends = np.r_[lanes.starts[1:], len(trip)] - 1
    return Course(mean, np.sqrt(np.maximum(variance, 0)), total[ends], np.sqrt(np.maximum(total_variance[ends], 0)))
