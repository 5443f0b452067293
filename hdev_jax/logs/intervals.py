"""Rows to intervals: gaps, samples that stand for tᵢ ± dt/2. By trip, without a loop over rows."""

import numpy as np

from hdev_jax.logs.limits import GAP_SAMPLES

__all__ = ["gaps", "sample_intervals", "starts", "trip_median"]

END_SAMPLES = 5  # the noise of a slope at the end of a parabola through 3 is 2.6 σ/dt, through 5 it is 1.1 σ/dt


def starts(trip: np.ndarray) -> np.ndarray:
    """True at the first row of each trip."""
    first = np.ones(len(trip), bool)
    first[1:] = trip[1:] != trip[:-1]
    return first


def trip_median(x: np.ndarray, trip: np.ndarray) -> np.ndarray:
    """For each row the median of `x` over its trip, NaN left out; `trip` holds runs of equal ids."""
    edges = np.flatnonzero(starts(trip))
    sizes = np.diff(np.r_[edges, len(trip)])
    run = np.repeat(np.arange(len(edges)), sizes)
    order = np.lexsort((x, run))  # NaN sorts last inside each run
    values = x[order]
    good = np.add.reduceat((~np.isnan(x)).astype(np.int64), edges)
    low, high = edges + np.maximum((good - 1) // 2, 0), edges + good // 2
    high = np.where(good > 0, high, low)
    return np.repeat(np.where(good > 0, 0.5 * (values[low] + values[np.minimum(high, len(x) - 1)]), np.nan), sizes)


def gaps(trip: np.ndarray, time_s: np.ndarray, duration_s: np.ndarray | None) -> np.ndarray:
    """True where a row opens a new trip because the step before it is longer than ten of the trip's samples.

    Where the rows bring their durations, an interval that is long by itself is no gap: only time that no row covers.
    """
    first = starts(trip)
    step = np.full(len(trip), np.nan)
    step[1:] = np.where(first[1:], np.nan, np.diff(time_s))
    typical = trip_median(step, trip)
    own = np.r_[np.nan, duration_s[:-1]] if duration_s is not None else typical
    with np.errstate(invalid="ignore"):
        return (step - own) > (GAP_SAMPLES - 1.0) * typical * (1.0 + 1e-9)


def sample_intervals(
    trip: np.ndarray, time_s: np.ndarray, speed_mps: np.ndarray, duration_s: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """`(start time, duration, start speed, end speed)` of samples.

    A sample reaches half-way to each neighbour, at the ends of a trip as far out as in; its end speeds are the means
    with the neighbours. At the ends of a trip the speed outside is that which gives the acceleration there, by the
    samples beside it, and never below standstill. The start of a trip's first
    interval keeps the sample's time.
    """
    first = starts(trip)
    last = np.r_[first[1:], True]
    step = np.diff(time_s, append=np.nan) if duration_s is None else duration_s
    back, ahead = np.where(first, np.nan, np.r_[np.nan, step[:-1]]), np.where(last, np.nan, step)
    back, ahead = np.where(first, ahead, back) / 2.0, np.where(last, back, ahead) / 2.0
    if duration_s is None:
        duration = back + ahead
    else:
        duration, back = duration_s, duration_s / 2.0
    inwards = 0.5 * (speed_mps + np.r_[speed_mps[1:], speed_mps[-1:]])
    outwards = 0.5 * (np.r_[speed_mps[:1], speed_mps[:-1]] + speed_mps)
    at_start = _one_sided(np.flatnonzero(first), 1, trip, step, speed_mps)
    at_end = _one_sided(np.flatnonzero(last), -1, trip, step, speed_mps)
    v_start, v_end = outwards.copy(), inwards.copy()
    v_start[first] = np.maximum(np.where(last, speed_mps, inwards)[first] - at_start * duration[first], 0.0)
    v_end[last] = np.maximum(np.where(first, speed_mps, outwards)[last] + at_end * duration[last], 0.0)
    edges = np.flatnonzero(first)
    shift = np.repeat(back[edges], np.diff(np.r_[edges, len(trip)]))
    return time_s - back + shift, duration, v_start, v_end


def _one_sided(at: np.ndarray, to: int, trip: np.ndarray, step: np.ndarray, speed: np.ndarray) -> np.ndarray:
    """Acceleration at the first rows of trips (`to` = 1) or the last ones (−1): the slope there of the parabola of
    least squares through up to five samples, with less noise than the difference of two."""
    n = len(trip)
    out = np.zeros(len(at))
    for k, i in enumerate(at):  # over trips
        rows = i + to * np.arange(END_SAMPLES)
        rows = rows[(rows >= 0) & (rows < n)]
        rows = np.sort(rows[trip[rows] == trip[i]])
        if len(rows) < 2:
            continue
        t = np.r_[0.0, np.cumsum(step[rows[:-1]])]
        t -= t[0 if to > 0 else -1]
        if np.isfinite(t).all() and (np.diff(t) > 0).all():
            powers = np.vander(t, min(len(rows), 3), increasing=True)
            out[k] = np.linalg.lstsq(powers, speed[rows], rcond=None)[0][1]
    return out
