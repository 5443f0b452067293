"""Missing values filled inside a trip; nothing here loops over rows."""

import numpy as np

from hdev_jax.logs.ledger import Ledger

__all__ = ["fill_forward", "fill_linear", "fill_nearest", "increments", "repair"]

CIRCULAR = ("heading_rad", "wind_from_rad")  # a mean of 1° and 359° is 180°: no interpolation
COUNTED = ("gear", "road_surface")  # ids, each of which may have a coefficient of its own
MOST_IDS = 64  # beyond, an id is an instrument's word for "unknown" (65535), not a gear
# A trip without any value takes the log's median only while such trips are few; beyond this share of the rows the
# channel is left out, because then the median, not the measurement, would be what the analysis sees.
MEDIAN_SHARE = 0.1


def _last_valid(ok: np.ndarray, trip: np.ndarray) -> np.ndarray:
    """Index of the last row of the same trip, this one or before, where `ok`; −1 without one."""
    n = len(ok)
    last = np.maximum.accumulate(np.where(ok, np.arange(n), -1))
    return np.where((last >= 0) & (trip[last] == trip), last, -1)


def _next_valid(ok: np.ndarray, trip: np.ndarray) -> np.ndarray:
    n = len(ok)
    back = _last_valid(ok[::-1], trip[::-1])[::-1]
    return np.where(back >= 0, n - 1 - back, -1)


def fill_forward(x: np.ndarray, trip: np.ndarray) -> np.ndarray:
    """The last value before, inside the trip; NaN before the first."""
    last = _last_valid(~np.isnan(x), trip)
    return np.where(last >= 0, x[last], np.nan)


def fill_nearest(x: np.ndarray, trip: np.ndarray) -> np.ndarray:
    """The nearest value by rows, inside the trip; NaN only where the trip has none."""
    ok, rows = ~np.isnan(x), np.arange(len(x))
    last, following = _last_valid(ok, trip), _next_valid(ok, trip)
    take_next = (following >= 0) & ((last < 0) | (following - rows < rows - last))
    index = np.where(take_next, following, last)
    return np.where(index >= 0, x[index], np.nan)


def fill_linear(x: np.ndarray, trip: np.ndarray, clock: np.ndarray | None = None) -> np.ndarray:
    """Linear between neighbours of the trip (over `clock`, else over rows), the nearest value at its ends."""
    ok = ~np.isnan(x)
    t = np.arange(len(x), dtype=np.float64) if clock is None else clock
    last, following = _last_valid(ok, trip), _next_valid(ok, trip)
    both = (last >= 0) & (following >= 0)
    gap = np.where(both, t[following] - t[last], 0.0)
    share = np.divide(t - t[last], gap, out=np.zeros_like(t), where=gap > 0)
    inside = np.where(ok, x, (1.0 - share) * x[last] + share * x[following])
    return np.where(both, inside, np.where(last >= 0, x[last], np.where(following >= 0, x[following], np.nan)))


def increments(x: np.ndarray, trip: np.ndarray) -> np.ndarray:
    """What a counter added around each sample: half of what lies between its neighbours, at the ends of a trip all of
    what lies to the one neighbour, as far as a sample reaches there. Values missing in between are linear."""
    x = np.where(np.isfinite(x), x, fill_linear(x, trip))
    same = trip[1:] == trip[:-1]
    step = np.where(same, np.diff(x), np.nan)
    before, after = np.r_[np.nan, step], np.r_[step, np.nan]
    before, after = np.where(np.isnan(before), after, before), np.where(np.isnan(after), before, after)
    return 0.5 * (before + after)


def repair(
    channels: dict[str, np.ndarray], trip: np.ndarray, clock: np.ndarray, ledger: Ledger
) -> tuple[dict[str, np.ndarray], Ledger]:
    """Channels without NaN, each repair counted; a channel that is empty, or mostly a median, is left out.

    Ids that no gear and no kind of surface has count as missing. Between neighbours of a trip: linear for what varies,
    the value before for counts and flags (whole numbers), the nearest for angles on a circle. A whole trip without
    values takes the median of the log.
    """
    out: dict[str, np.ndarray] = {}
    for name, x in channels.items():
        missing = ~np.isfinite(x)
        if name in COUNTED and (beyond := ~missing & (x > MOST_IDS)).any():
            reason = f"beyond {MOST_IDS}, such as {x[beyond][0]:g}: no such id, taken as missing"
            ledger = ledger.add("noted", reason, count=int(beyond.sum()), column=name)
            missing |= beyond
        count = int(missing.sum())
        if count == 0:
            out[name] = x
            continue
        if count == len(x):
            ledger = ledger.add("noted", "no value in any row, taken as absent", column=name)
            continue
        x = np.where(missing, np.nan, x)
        values = x[~missing]
        median = float(np.median(values))
        if name in CIRCULAR:
            how, filled = "the nearest value", fill_nearest(x, trip)
        elif np.all(values == np.round(values)):
            filled = fill_nearest(fill_forward(x, trip), trip)  # nearest: only rows before the first value are left
            how, median = "the value before", float(np.round(median))
        else:
            how, filled = "linear between its neighbours", fill_linear(x, trip, clock)
        lost = np.isnan(filled)
        if lost.mean() > MEDIAN_SHARE:
            ledger = ledger.add(
                "noted", f"no value in trips that make {lost.mean():.0%} of the rows, left out of the log", column=name
            )
            continue
        if count > int(lost.sum()):
            ledger = ledger.add("filled", f"missing, {how}", count=count - int(lost.sum()), column=name)
        if lost.any():
            ledger = ledger.add(
                "filled", f"missing in a whole trip, the log's median {median:g}", count=int(lost.sum()), column=name
            )
        out[name] = np.where(lost, median, filled)
    return out, ledger
