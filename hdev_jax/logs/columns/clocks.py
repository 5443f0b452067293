"""Clocks: seconds, dates and times of day as loggers write them, to seconds from a file's first row."""

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from hdev_jax.errors import InputError
from hdev_jax.logs.columns.numbers import MISSING, numbers
from hdev_jax.logs.readers.raw import Raw

__all__ = ["Clock", "Note", "read_clock", "unix_scale"]

Note = Callable[[str, int], None]

DAY_S, HOUR_S = 86_400.0, 3600.0
# Seconds since 1970 that a vehicle's log can have: September 2001 to 2039; as ms, µs and ns no other clock comes near.
_UNIX = ((1e9, 1.0, "s"), (1e12, 1e-3, "ms"), (1e15, 1e-6, "µs"), (1e18, 1e-9, "ns"))
_UNIX_SPAN = 2.2
_SLOWEST_S = 60.0  # of samples; a counter of ms that is read as s has steps of a hundred and more

_MONTHS = {
    m: i + 1 for i, m in enumerate(["jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec"])
}
_TIME = r"(?P<hour>\d{1,2}):(?P<minute>\d\d)(?::(?P<second>\d\d(?:[.,]\d+)?))?\s*(?P<half>[AaPp]\.?[Mm]\.?)?"
_ZONE = r"\s*(?:Z|UTC|GMT)?\s*(?P<zone>[+-]\d\d:?\d\d)?"
_DATES = (
    r"(?P<year>\d{4})[-/.](?P<month>\d{1,2})[-/.](?P<day>\d{1,2})",
    r"(?P<a>\d{1,2})(?P<mark>[-/.])(?P<b>\d{1,2})[-/.](?P<year>\d{4}|\d{2})",
    r"(?:[A-Za-z]{3},?\s+)?(?P<day>\d{1,2})[- ](?P<name>[A-Za-z]{3})[a-z]*[- ](?P<year>\d{4})",
)
_WRITTEN = (
    *(rf"{date}(?:[T,]|\s)\s*{_TIME}{_ZONE}" for date in _DATES),
    # java.util.Date.toString: Sun Aug 02 11:34:41 GMT+02:00 2026
    rf"[A-Za-z]{{3}}\s+(?P<name>[A-Za-z]{{3}})\s+(?P<day>\d{{1,2}})\s+{_TIME}{_ZONE}\s*(?:[A-Z]{{3,5}})?\s*(?P<year>\d{{4}})",
    *_DATES,
    _TIME,
)


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
    """Times `[row]` in seconds: numbers as they are, dates and times of day counted from the first.

    **Arguments:** `headers`, of one column, or of a date and a time; `trip`, codes by row, in which time runs forward;
    `note(reason, count)` is told what was assumed. **Raises:** `InputError` naming row and column.
    """
    series = _joined(raw, headers)
    where = " ".join(f"'{h}'" for h in headers)
    if getattr(series.dtype, "kind", "O") == "M" or isinstance(series.dtype, pd.DatetimeTZDtype):
        stamp, naive = pd.to_datetime(series), getattr(series.dt, "tz", None) is None
        x = _since_first(stamp if not naive else stamp.dt.tz_localize("UTC"))
    elif len(headers) == 1 and how.format is None and _numeric(series):
        x, naive = numbers(raw, headers[0], True, note), False
        assert x is not None
        x = _past_midnight(x, trip, note)
    else:
        text = series.astype("str").str.strip()
        text = text.where(series.notna() & ~text.str.lower().isin(MISSING))
        x, naive = _of_text(raw, text, where, how, note)
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


def _since_first(stamp: Any) -> np.ndarray:
    return np.asarray((stamp - stamp.min()).dt.total_seconds().to_numpy(), dtype=np.float64)


def _stray(raw: Raw, text: Any, bad: np.ndarray, where: str) -> InputError:
    i = int(np.argmax(bad))
    return InputError(
        f"{raw.file}: {raw.where(i)}, column {where}: seconds or ISO 8601 are expected, found '{text.iloc[i]}'; "
        'say what it is in an adapter: time_s = { source = …, format = "%d.%m.%Y %H:%M:%S" }'
    )


def _of_text(raw: Raw, text: Any, where: str, how: Clock, note: Note) -> tuple[np.ndarray, bool]:
    """Seconds, not counted from the first where they are local times, and whether they are."""
    told = text[text.notna()]
    if how.format is not None:
        stamp = pd.to_datetime(text, format=how.format, errors="coerce", utc="%z" in how.format)
        if (bad := (stamp.isna() & text.notna()).to_numpy()).any():
            i = int(np.argmax(bad))
            what = f"'{text.iloc[i]}' is not of the adapter's format '{how.format}'"
            raise InputError(f"{raw.file}: {raw.where(i)}, column {where}: {what}")
        return _seconds_of(stamp), "%z" not in how.format
    if told.empty:
        return np.full(len(text), np.nan), False
    first = str(told.iloc[0])
    if re.match(r"\d{4}-\d\d-\d\d([T ]|$)", first):
        stamp = pd.to_datetime(text, format="ISO8601", utc=True, errors="coerce")
        if (bad := (stamp.isna() & text.notna()).to_numpy()).any():
            raise _stray(raw, text, bad, where)
        return _seconds_of(stamp), re.search(r"(Z|[+-]\d\d(:?\d\d)?)$", first[10:]) is None
    pattern = next((p for p in _WRITTEN if re.fullmatch(p, first)), None)
    if pattern is None:
        raise _stray(raw, text, np.asarray(text.notna()), where)
    parts = text.str.extract(f"^{pattern}$")
    if (bad := (parts.isna().all(axis=1) & text.notna()).to_numpy()).any():
        raise _stray(raw, text, bad, where)
    return _of_parts(raw, text, parts, where, note)


def _seconds_of(stamp: Any) -> np.ndarray:
    whole = pd.Timestamp(0, tz=stamp.dt.tz)
    return np.asarray((stamp - whole).dt.total_seconds().to_numpy(), dtype=np.float64)


def _of_parts(raw: Raw, text: Any, parts: Any, where: str, note: Note) -> tuple[np.ndarray, bool]:
    """Seconds of the parts that an expression found, and whether they are local times."""

    def number(name: str) -> np.ndarray:
        if name not in parts:
            return np.zeros(len(parts))
        found: Any = pd.to_numeric(parts[name].str.replace(",", ".", regex=False))
        return found.fillna(0.0).to_numpy(dtype=np.float64)

    hour = number("hour")
    if "half" in parts and (half := parts["half"].str.lower().str[0]).notna().any():
        hour = np.where(half == "p", hour % 12 + 12, np.where(half == "a", hour % 12, hour))
    clock = hour * HOUR_S + number("minute") * 60.0 + number("second")
    clock[text.isna().to_numpy()] = np.nan
    if "year" not in parts:
        return clock, True
    year = number("year")
    year = np.where(year < 100, year + 2000, year)
    if "name" in parts:
        month, day = parts["name"].str.lower().map(_MONTHS).fillna(0).to_numpy(dtype=np.float64), number("day")
    elif "month" in parts:
        month, day = number("month"), number("day")
    else:
        month, day = _month_and_day(
            raw, text, number("a"), number("b"), str(parts["mark"].dropna().iloc[0]), where, note
        )
    dates = pd.to_datetime(pd.DataFrame({"year": year, "month": month, "day": day}), errors="coerce")
    if (bad := (dates.isna() & text.notna()).to_numpy()).any():
        raise _stray(raw, text, bad, where)
    zone: Any = parts["zone"] if "zone" in parts else pd.Series(None, index=parts.index, dtype=object)
    x = _seconds_of(dates) + clock
    if zone.notna().any():
        digits: Any = zone.str.replace(":", "", regex=False)
        east = digits.str[1:3].astype(float) * HOUR_S + digits.str[3:5].astype(float) * 60.0
        x = x - np.where(zone.str[0] == "-", -east, east.fillna(0.0))
    return x, not zone.notna().any()


def _month_and_day(
    raw: Raw, text: Any, a: np.ndarray, b: np.ndarray, mark: str, where: str, note: Note
) -> tuple[np.ndarray, np.ndarray]:
    """Month and day of `a/b/year`: with points the day is first; else as the numbers tell, or one day alone."""
    if mark == "." or a.max(initial=0) > 12:
        note("dates with the day first", 0)
        return b, a
    if b.max(initial=0) > 12:
        note("dates with the month first", 0)
        return a, b
    if len(np.unique(np.c_[a, b][text.notna().to_numpy()], axis=0)) > 1:
        raise InputError(
            f"{raw.file}: {raw.where(0)}, column {where}: '{text.dropna().iloc[0]}' may have the day or the month "
            "first; "
            'say which in an adapter: time_s = { source = …, format = "%d/%m/%Y %H:%M:%S" }'
        )
    return a, b  # one date: seconds from the first row are the same


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
    return _seconds_of(there.dt.tz_convert("UTC"))


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
