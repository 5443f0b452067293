"""Dates and times of day as text, in the ways that loggers write them, to seconds."""

import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pandas as pd

from hdev_jax.errors import InputError
from hdev_jax.logs.readers.raw import Raw

__all__ = ["DAY_S", "HOUR_S", "seconds_of", "stamps"]

DAY_S, HOUR_S = 86_400.0, 3600.0
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


def _stray(raw: Raw, text: Any, bad: np.ndarray, where: str) -> InputError:
    i = int(np.argmax(bad))
    return InputError(
        f"{raw.file}: {raw.where(i)}, column {where}: seconds or ISO 8601 are expected, found '{text.iloc[i]}'; "
        'say what it is in an adapter: time_s = { source = …, format = "%d.%m.%Y %H:%M:%S" }'
    )


def stamps(
    raw: Raw, text: Any, where: str, form: str | None, note: Callable[[str, int], None]
) -> tuple[np.ndarray, bool]:
    """Seconds `[row]` of texts, and whether they are local times.

    **Arguments:** `where`, the column for messages; `form`, the adapter's strptime format; `note(reason, count)` is
    told what was assumed. **Raises:** `InputError` for the first text that is no time, or where day and month cannot be
    distinguished.
    """
    told = text[text.notna()]
    if form is not None:
        stamp = pd.to_datetime(text, format=form, errors="coerce", utc="%z" in form)
        if (bad := (stamp.isna() & text.notna()).to_numpy()).any():
            i = int(np.argmax(bad))
            what = f"'{text.iloc[i]}' is not of the adapter's format '{form}'"
            raise InputError(f"{raw.file}: {raw.where(i)}, column {where}: {what}")
        return seconds_of(stamp), "%z" not in form
    if told.empty:
        return np.full(len(text), np.nan), False
    first = str(told.iloc[0])
    if re.match(r"\d{4}-\d\d-\d\d([T ]|$)", first):
        stamp = pd.to_datetime(text, format="ISO8601", utc=True, errors="coerce")
        if (bad := (stamp.isna() & text.notna()).to_numpy()).any():
            raise _stray(raw, text, bad, where)
        return seconds_of(stamp), re.search(r"(Z|[+-]\d\d(:?\d\d)?)$", first[10:]) is None
    pattern = next((p for p in _WRITTEN if re.fullmatch(p, first)), None)
    if pattern is None:
        raise _stray(raw, text, np.asarray(text.notna()), where)
    quick = _by_format(text, pattern, first)
    if quick is not None:
        return quick, True
    parts = text.str.extract(f"^{pattern}$")
    if (bad := (parts.isna().all(axis=1) & text.notna()).to_numpy()).any():
        raise _stray(raw, text, bad, where)
    return _of_parts(raw, text, parts, where, note)


_LETTERS = {"year": "%Y", "month": "%m", "day": "%d", "hour": "%H", "minute": "%M", "name": "%b"}


def _by_format(text: Any, pattern: str, first: str) -> np.ndarray | None:
    """Seconds by one format of strptime, ten times as fast as part by part; None where parts have to be looked at."""
    found = re.fullmatch(pattern, first)
    groups = {k: v for k, v in found.groupdict().items() if v is not None} if found is not None else {}
    if found is None or {"half", "zone"} & groups.keys() or not {"year", "hour"} <= groups.keys():
        return None
    letters = dict(_LETTERS)
    if "a" in groups:  # only with points is the day surely first
        if groups.pop("mark") != "." or len(groups["year"]) != 4:
            return None
        letters |= {"a": "%d", "b": "%m"}
    form, end = "", 0
    for name in sorted(groups, key=found.start):
        letter = letters.get(name, "%S.%f" if "." in groups[name] else "%S")
        form, end = form + first[end : found.start(name)].replace("%", "%%") + letter, found.end(name)
    stamp: Any = pd.to_datetime(text, format=form + first[end:].replace("%", "%%"), errors="coerce")
    return None if (stamp.isna() & text.notna()).any() else seconds_of(stamp)


def seconds_of(stamp: Any) -> np.ndarray:
    whole = pd.Timestamp(0, tz=stamp.dt.tz)
    return np.asarray((stamp - whole).dt.total_seconds().to_numpy(), dtype=np.float64)


def _of_parts(raw: Raw, text: Any, parts: Any, where: str, note: Callable[[str, int], None]) -> tuple[np.ndarray, bool]:
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
    x = seconds_of(dates) + clock
    if zone.notna().any():
        digits: Any = zone.str.replace(":", "", regex=False)
        east = digits.str[1:3].astype(float) * HOUR_S + digits.str[3:5].astype(float) * 60.0
        x = x - np.where(zone.str[0] == "-", -east, east.fillna(0.0))
    return x, not zone.notna().any()


def _month_and_day(
    raw: Raw, text: Any, a: np.ndarray, b: np.ndarray, mark: str, where: str, note: Callable[[str, int], None]
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
