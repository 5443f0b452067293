"""Where in its time the stamp of a row is: samples at an instant, or means over the time before or after it."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from hdev_jax.logs.intervals import starts
from hdev_jax.logs.rows.gathered import Rows

__all__ = ["STAMPS", "as_means", "noted_stamps"]

STAMPS = ("middle", "end", "start")
LEAST_ROWS = 200  # of a trip that moves, to say anything of it
LEAST_TRIPS = 2
AGREE = 0.8  # share of trips that have to say the same
LESS = 0.9  # of the variance that samples leave, at most: a lag of a tenth of a row changes it by less


def as_means(rows: Rows, stamp: str) -> Rows:
    """Rows of means: from each time stamp to the next, or to the one before, with the speeds at both. At `end` a
    trip's first row has no beginning, at `start` its last no end: it is dropped, and counted."""
    first = starts(rows.trip)
    last = np.r_[first[1:], True]
    if stamp == "end":
        before, after, keep = np.arange(len(first)) - 1, np.arange(len(first)), ~first
    else:
        before, after, keep = np.arange(len(first)), np.arange(len(first)) + 1, ~last
    before, after = before[keep], after[keep]
    time, speed = rows.data["time_s"], rows.data["speed_mps"]
    made = {
        "time_s": time[before], "duration_s": time[after] - time[before],
        "speed_start_mps": speed[before], "speed_end_mps": speed[after],
    }  # fmt: skip
    what = "first" if stamp == "end" else "last"
    ledger = rows.ledger.add(
        "dropped", f'the {what} row of a trip, a mean over a time that has no other end (stamp = "{stamp}")',
        count=int(np.sum(~keep)),
    )  # fmt: skip
    kept = replace(rows, ledger=ledger).take(keep)
    return replace(kept, data={k: v for k, v in kept.data.items() if k != "speed_mps"} | made)


def noted_stamps(rows: Rows) -> Rows:
    """The rows with a note where the measured power of samples is that of the time before their stamps, or after."""
    found = _stamp_of(rows) if {"time_s", "speed_mps", "battery_power_w"} <= rows.data.keys() else None
    if found is None:
        return rows
    stamp, agree, trips = found
    time = "before" if stamp == "end" else "after"
    why = (
        f"fits the speeds better as a mean over the time {time} each time stamp (in {agree} of {trips} trips) than as "
        f'a sample: stamp = "{stamp}" in an adapter reads it so'
    )
    return replace(rows, ledger=rows.ledger.add("noted", why, column="battery_power_w"))


def _stamp_of(rows: Rows) -> tuple[str, int, int] | None:
    """The stamp that most trips show, in how many of how many; None where that is the middle, or where they differ."""
    edges = np.flatnonzero(starts(rows.trip))
    left = []
    for a, b in zip(edges, np.r_[edges[1:], len(rows.trip)], strict=True):
        columns = (rows.data[c][a:b] for c in ("time_s", "speed_mps", "battery_power_w"))
        if (one := _left(*columns)) is not None:
            left.append(one)
    if len(left) < LEAST_TRIPS:
        return None
    each = np.array(left)
    best = int(np.argmin(each.sum(axis=0)))
    agree = int(np.sum(np.argmin(each, axis=1) == best))
    total = each.sum(axis=0)
    if best == 0 or agree < AGREE * len(each) or total[best] > LESS * total[0]:
        return None
    return STAMPS[best], agree, len(each)


def _left(
    time: Float[np.ndarray, " row"], speed: Float[np.ndarray, " row"], power: Float[np.ndarray, " row"]
) -> Float[np.ndarray, " stamp"] | None:
    """What least squares on speed and acceleration leave of the power of a trip, the rows taken as samples, and as
    means over the time before and after their stamps."""
    step = np.diff(time)
    inner = slice(1, -1)  # rows that have both neighbours
    good = np.isfinite(speed[:-2] + speed[inner] + speed[2:] + power[inner]) & (step[:-1] > 0) & (step[1:] > 0)
    good &= np.abs(step[1:] / np.maximum(step[:-1], 1e-9) - 1.0) < 0.2
    if np.sum(good & (speed[inner] > 1.0)) < LEAST_ROWS:
        return None
    middle = 0.5 * (speed[:-1] + speed[1:])
    pairs = (
        (middle[:-1], middle[1:], 0.5 * (step[:-1] + step[1:])),
        (speed[:-2], speed[inner], step[:-1]),
        (speed[inner], speed[2:], step[1:]),
    )
    y, out = power[inner][good], np.empty(3)
    for k, (begin, end, seconds) in enumerate(pairs):
        mean, gain = 0.5 * (begin + end)[good], (0.5 * (end**2 - begin**2) / seconds)[good]
        columns = (np.ones(len(y)), mean, mean * mean * mean, np.maximum(gain, 0.0), np.minimum(gain, 0.0))
        x = np.column_stack([c / max(float(np.linalg.norm(c)), 1e-300) for c in columns])
        # by the normal equations of columns of length one: five by five, and no decomposition of every row
        out[k] = np.sum((y - x @ np.linalg.lstsq(x.T @ x, x.T @ y, rcond=None)[0]) ** 2)
    return out / max(float(np.sum((y - y.mean()) ** 2)), 1e-300)
