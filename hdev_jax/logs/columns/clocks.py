"""Clocks: seconds, dates and times of day as loggers write them, to seconds from a file's first row."""

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from hdev_jax.logs.columns.numbers import MISSING, numbers
from hdev_jax.logs.columns.stamps import DAY_S, HOUR_S, seconds_of, stamps
from hdev_jax.logs.readers.raw import Raw

__all__ = ["FIRST_DATE_S", "LAST_DATE_S", "Clock", "Note", "read_clock", "unix_scale"]

Note = Callable[[str, int], None]

# Seconds since 1970 that a vehicle's log can have: September 2001 to 2039; as ms, µs and ns no other clock comes near.
_UNIX = ((1e9, 1.0, "s"), (1e12, 1e-3, "ms"), (1e15, 1e-6, "µs"), (1e18, 1e-9, "ns"))
_UNIX_SPAN = 2.2
FIRST_DATE_S, LAST_DATE_S = _UNIX[0][0], _UNIX_SPAN * _UNIX[0][0]
_SLOWEST_S = 60.0  # of samples; a counter of ms that is read as s has steps of a hundred and more


@dataclass(frozen=True)
class Clock:
    """How an adapter says that a clock is to be read: strptime's `format`, the place of local times, and whether rows
    of one stamp are to be spread over the time to the next."""

    format: str | None = None
    time_zone: str | None = None
    spread: bool = False


def unix_scale(x: np.ndarray) -> tuple[float, str] | None:
    """`(seconds in one, unit)` of numbers that are times since 1970 by their size; None where they are not."""
    x = x[np.isfinite(x)]
    for least, scale, unit in _UNIX:
        if len(x) and x.min() >= least and x.max() <= _UNIX_SPAN * least:
            step = np.diff(x)
            if not (step > 0).any() or np.median(step[step > 0]) * scale <= _SLOWEST_S:
                return scale, unit
    return None


def read_clock(raw: Raw, headers: tuple[str, ...], trip: np.ndarray, how: Clock, note: Note) -> np.ndarray:
    """Times `[row]` in seconds: numbers as they are, dates since 1970, times of day since midnight.

    **Arguments:** `headers`, of one column, or of a date and a time; `trip`, codes by row, in which time runs forward;
    `note(reason, count)` gets what was assumed. **Raises:** `InputError` naming row and column.
    """
    series = _joined(raw, headers)
    where = " ".join(f"'{h}'" for h in headers)
    if getattr(series.dtype, "kind", "O") == "M" or isinstance(series.dtype, pd.DatetimeTZDtype):
        stamp, naive = pd.to_datetime(series), getattr(series.dt, "tz", None) is None
        x = seconds_of(stamp if not naive else stamp.dt.tz_localize("UTC"))
    elif len(headers) == 1 and how.format is None and _numeric(series):
        x, naive = numbers(raw, headers[0], True, note), False
        assert x is not None
        x = _past_midnight(x, trip, note)
    else:
        text = series.astype("str").str.strip()
        text = text.where(series.notna() & ~text.str.lower().isin(MISSING))
        x, naive = stamps(raw, text, where, how.format, note)
    if naive:
        x = _local(x, trip, how, note)
    return _spread(x, trip, note) if how.spread else x


def _joined(raw: Raw, headers: tuple[str, ...]) -> Any:
    """One column, or the texts of several side by side; a date that comes as a time stamp loses its midnight."""
    if len(headers) == 1:
        return raw.table[headers[0]]
    parts = []
    for h in headers:
        series = raw.table[h]
        is_date = getattr(series.dtype, "kind", "O") == "M"
        parts.append(series.dt.strftime("%Y-%m-%d") if is_date else series.astype("str").str.strip())
    missing = np.any([raw.table[h].isna() for h in headers], axis=0)
    return parts[0].str.cat(parts[1:], sep=" ").where(~missing)


def _numeric(series: Any) -> bool:
    if pd.api.types.is_numeric_dtype(series.dtype):
        return True
    sample = series.dropna()
    try:
        return sample.empty or float(str(sample.iloc[0])) is not None
    except ValueError:
        return (
            re.fullmatch(r"\s*[-+]?\d[\d.,'  ]*\s*", str(sample.iloc[0])) is not None
            and ":" not in str(sample.iloc[0])
            and str(sample.iloc[0]).count(".") < 2
        )


def _local(x: np.ndarray, trip: np.ndarray, how: Clock, note: Note) -> np.ndarray:
    """Local times in one run of seconds: over midnight where there is no date, over a change of the clocks."""
    if how.time_zone is not None:
        return _in_zone(x, how.time_zone, note)
    order = np.flatnonzero(np.isfinite(x))
    step = np.diff(x[order])
    inside = trip[order][1:] == trip[order][:-1]
    forward = step[inside & (step > 0)]
    usual = float(np.median(forward)) if len(forward) else 1.0
    only_time = np.nanmax(x, initial=0.0) < 2 * DAY_S
    midnight = inside & (step < -DAY_S / 2) & only_time
    # summer time ends: at a full hour the clock goes back by one
    after = x[order][1:] % HOUR_S
    back = inside & (step < 0) & (np.abs(step + HOUR_S) <= 10.0 * usual) & (after <= 10.0 * usual) & ~midnight
    for what, happens, length in (("midnight", midnight, DAY_S), ("the end of summer time", back, HOUR_S)):
        if not happens.any():
            continue
        shift = np.zeros(len(x))
        for k in np.flatnonzero(happens):  # a trip has one, if any
            rows = order[k + 1 :]
            shift[rows[trip[rows] == trip[order[k + 1]]]] += length
        if what == "midnight":
            note("passes midnight: a day later from there", int((shift > 0).sum()))
        else:
            note("goes back by one hour at a full hour, read as the end of summer time", int((shift > 0).sum()))
        x = x + shift
    return x


def _past_midnight(x: np.ndarray, trip: np.ndarray, note: Note) -> np.ndarray:
    """Seconds of the day, counted on over midnight: from the last minute of a day to the first of the next."""
    with np.errstate(invalid="ignore"):
        passes = (x[:-1] >= DAY_S - 60.0) & (x[1:] <= 60.0) & (trip[1:] == trip[:-1])
    if not passes.any() or np.nanmax(x) >= DAY_S or np.nanmin(x) < 0.0:
        return x
    days = np.r_[0.0, np.cumsum(passes)]
    days -= days[np.unique(trip, return_index=True)[1]][np.unique(trip, return_inverse=True)[1]]
    note("passes midnight: a day later from there", int((days > 0).sum()))
    return x + DAY_S * days


def _in_zone(x: np.ndarray, zone: str, note: Note) -> np.ndarray:
    stamp = pd.Series(pd.to_datetime(x, unit="s"))
    try:
        there = stamp.dt.tz_localize(zone, ambiguous="infer", nonexistent="shift_forward")
    except ValueError:  # the repeated hour is there once only: nothing tells which of the two it is
        note("an hour that the zone has twice, read as summer time", 0)
        there = stamp.dt.tz_localize(zone, ambiguous=np.ones(len(x), bool), nonexistent="shift_forward")
    return seconds_of(there.dt.tz_convert("UTC"))


def _spread(x: np.ndarray, trip: np.ndarray, note: Note) -> np.ndarray:
    """Rows of one stamp spread over the time to the next; at the ends of a trip at the rate beside them."""
    opens = np.r_[True, (x[1:] != x[:-1]) | (trip[1:] != trip[:-1])]
    group = np.cumsum(opens) - 1
    first = np.flatnonzero(opens)
    size = np.diff(np.r_[first, len(x)])
    stamp, of_trip = x[first], trip[first]
    step = np.r_[np.where(of_trip[1:] == of_trip[:-1], np.diff(stamp), np.nan), np.nan]
    if not np.isfinite(step).any():
        return x
    width = np.minimum(step, np.nanmedian(step)) / size
    filled = pd.Series(width).groupby(of_trip, sort=False)
    before, behind = filled.ffill().to_numpy(), filled.bfill().to_numpy()
    opening = np.r_[True, of_trip[1:] != of_trip[:-1]]
    nextwidth = np.where(np.isfinite(np.r_[width[1:], np.nan]), np.r_[width[1:], np.nan], behind)
    width = np.where(np.isfinite(width), width, before)
    index = np.arange(len(x)) - first[group]
    out = stamp[group] + index * width[group]
    # a trip's first stamp began before the log did: its rows end where the next stamp begins
    ending = np.r_[stamp[1:], np.nan][group] - (size[group] - index) * nextwidth[group]
    out = np.where(opening[group] & np.isfinite(ending), ending, out)
    note("rows of one time stamp spread over the time to the next", int((~opens).sum()))
    return out
