"""Rows to intervals: gaps, samples that stand for tᵢ ± dt/2, slope from altitude. By trip, without a loop over rows."""

import numpy as np

from hdev_jax.logs.limits import GAP_SAMPLES

__all__ = ["SLOPE_WINDOW_M", "gaps", "grade_from_altitude", "sample_intervals", "starts", "trip_median"]

END_SAMPLES = 5  # the noise of a slope at the end of a parabola through 3 is 2.6 σ/dt, through 5 it is 1.1 σ/dt
SLOPE_WINDOW_M = 100.0  # barometers and GNSS resolve a metre or so: over 100 m that is 1 % of slope


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


def grade_from_altitude(
    trip: np.ndarray, distance_m: np.ndarray, altitude_m: np.ndarray, window_m: float = SLOPE_WINDOW_M
) -> np.ndarray:
    """Slope [rad]: at each row the line of least squares through the altitudes within half a window along the way.

    A row weighs what it covers of the way, so that standing still says nothing. Rows longer than the window look at
    their neighbours. Altitude belongs to the middle of a row.
    """
    n = len(trip)
    edges = np.flatnonzero(starts(trip))
    sizes = np.diff(np.r_[edges, n])
    run = np.repeat(np.arange(len(edges)), sizes)
    end = np.cumsum(distance_m)
    middle = end - 0.5 * distance_m
    origin = np.repeat((end - distance_m)[edges], sizes)
    s = middle - origin
    z = altitude_m - np.repeat(np.add.reduceat(altitude_m, edges) / sizes, sizes)
    w = np.maximum(distance_m, 0.0)
    moving = w[w > 0]
    half = max(window_m / 2.0, 1.5 * float(np.median(moving)) if len(moving) else 0.0)
    # one increasing coordinate over all trips, far enough apart that no window reaches into the next
    span = float(s.max(initial=0.0)) + 4.0 * half
    place = s + run * span
    low = np.searchsorted(place, place - half, "left")
    high = np.searchsorted(place, place + half, "right")
    centre = s - np.repeat(s[edges + sizes // 2], sizes)

    def window(values: np.ndarray) -> np.ndarray:
        total = np.r_[0.0, np.cumsum(values)]
        return total[high] - total[low]

    w0, ws, wz = window(w), window(w * centre), window(w * z)
    wss, wsz = window(w * centre**2), window(w * centre * z)
    safe = np.where(w0 > 0, w0, 1.0)
    spread = wss - ws**2 / safe
    cross = wsz - ws * wz / safe
    # less spread than a tenth of the window's own says nothing about a slope: standing at the end of a trip
    enough = spread > 0.01 * w0 * half**2 / 3.0
    tangent = np.where(enough, cross / np.where(enough, spread, 1.0), np.nan)
    from hdev_jax.logs.repair import fill_nearest

    return np.arctan(np.nan_to_num(fill_nearest(tangent, run), nan=0.0))
