"""Tables with a row for each value: to a column for each channel, at the times of one of them."""

from dataclasses import replace

import numpy as np
import pandas as pd

from hdev_jax.errors import InputError
from hdev_jax.logs.adapter import Adapter, near
from hdev_jax.logs.columns.clocks import Clock, read_clock
from hdev_jax.logs.columns.numbers import numbers
from hdev_jax.logs.limits import GAP_SAMPLES
from hdev_jax.logs.readers.raw import Raw

__all__ = ["pivoted"]


def pivoted(raw: Raw, adapter: Adapter, measured: tuple[str, ...]) -> Raw:
    """The table with a column for each channel, its unit told, at the times when the adapter's `clock` was measured
    (without one, at those of the channel with the most values).

    Between its own values a channel that has a unit is linear, one without keeps its last value; over more than ten of
    its own steps no value is known. Of the channels `measured` each value stays alone, at the time nearest to it: what
    lies between two measurements is none. Raises `InputError` for a column that is not there, a channel of two units.
    """
    long = adapter.long
    assert long is not None
    table = raw.table
    for column in (long.time, long.name, long.value, *([long.unit] if long.unit else [])):
        if column not in table.columns:
            hint = near(column, [str(c) for c in table.columns])
            raise InputError(f"{raw.file}: no column '{column}' ([long] of {adapter.where}){hint}")
    ledger = raw.ledger

    def note(reason: str, count: int) -> None:
        nonlocal ledger
        ledger = ledger.add("noted", reason, count=count, file=raw.file, column=long.time)

    time = read_clock(raw, (long.time,), np.zeros(len(table), np.int64), Clock(None, adapter.time_zone), note)
    name = table[long.name].astype("str").str.strip()
    channels: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    units: dict[str, str] = {}
    for channel, rows in name.groupby(name, sort=False).indices.items():
        part = replace(raw, table=table.iloc[rows].reset_index(drop=True), lines=_lines(raw, rows))
        values = numbers(part, long.value, False, note)
        if values is None:
            ledger = ledger.add("noted", "text, left out", count=len(rows), file=raw.file, column=str(channel))
            continue
        if long.unit:
            told = list(dict.fromkeys(part.table[long.unit].dropna().astype("str").str.strip()))
            if len(told := [u for u in told if u]) > 1:
                raise InputError(f"{raw.file}: channel '{channel}' has values in {told[0]} and in {told[1]}")
            units |= {str(channel): told[0]} if told else {}
        good = np.isfinite(values) & np.isfinite(time[rows])
        order = np.argsort(time[rows][good], kind="stable")
        t, x = time[rows][good][order], values[good][order]
        last = np.r_[t[1:] != t[:-1], True] if len(t) else np.zeros(0, bool)
        if (~last).any():
            again = int((~last).sum())
            ledger = ledger.add("dropped", "at the time of another value", count=again, column=str(channel))
        channels[str(channel)] = t[last], x[last]
    channels = {k: v for k, v in channels.items() if len(v[0])}
    clock = _clock(raw, adapter, channels)
    at = channels[clock][0]
    columns: dict[str, np.ndarray] = {"time_s": at}
    rules = [r for c, r in adapter.columns.items() if c in measured]
    targets = {name for r in rules for name in (*r.sources, *r.alternatives)}
    for channel, (t, x) in channels.items():
        if channel == clock:
            columns[channel] = x
        elif channel in targets:
            columns[channel] = _alone(t, x, at)
        else:
            columns[channel] = _at(t, x, at, channel in units)
    why = f"{len(table)} values of {len(channels)} channels, at the times of '{clock}'"
    ledger = ledger.add("derived", why, count=len(at), file=raw.file)
    return replace(raw, table=pd.DataFrame(columns), lines=None, units={"time_s": "s", **units}, ledger=ledger)


def _lines(raw: Raw, rows: np.ndarray) -> list[int] | None:
    return None if raw.lines is None else [raw.lines[int(i)] for i in rows]


def _clock(raw: Raw, adapter: Adapter, channels: dict[str, tuple[np.ndarray, np.ndarray]]) -> str:
    asked = adapter.long.clock if adapter.long else None
    if not channels:
        raise InputError(f"{raw.file}: no channel with numbers")
    if asked is None:
        return max(channels, key=lambda c: len(channels[c][0]))
    wanted = (asked,) if isinstance(asked, str) else asked
    found = next((c for c in wanted if c in channels), None)
    if found is None and adapter.preset is None:
        shown = ", ".join(list(channels)[:8])
        hint = near(wanted[0], list(channels))
        raise InputError(f"{raw.file}: no channel '{wanted[0]}' (clock of {adapter.where}){hint}; it has {shown}")
    return found or max(channels, key=lambda c: len(channels[c][0]))


def _at(t: np.ndarray, x: np.ndarray, at: np.ndarray, linear: bool) -> np.ndarray:
    """A channel at other times; NaN before its first value, after its last, and in its gaps."""
    following = np.searchsorted(t, at, "left")
    before = np.searchsorted(t, at, "right") - 1
    outside = (before < 0) | (following >= len(t))
    low, high = np.clip(before, 0, len(t) - 1), np.clip(following, 0, len(t) - 1)
    usual = float(np.median(np.diff(t))) if len(t) > 1 else 0.0
    gap = t[high] - t[low] > GAP_SAMPLES * usual * (1.0 + 1e-9)
    values = np.interp(at, t, x) if linear else x[low]
    return np.where(outside | gap, np.nan, values)


def _alone(t: np.ndarray, x: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Each value at the time nearest to it, no further than half a usual step away; NaN at all other times."""
    near_ = np.clip(np.searchsorted(at, t), 1, max(len(at) - 1, 1)) if len(at) > 1 else np.zeros(len(t), np.int64)
    if len(at) > 1:
        near_ = np.where(np.abs(at[near_ - 1] - t) <= np.abs(at[near_] - t), near_ - 1, near_)
    usual = float(np.median(np.diff(at))) if len(at) > 1 else 0.0
    close = np.abs(at[near_] - t) <= 0.5 * usual
    out = np.full(len(at), np.nan)
    out[near_[close]] = x[close]
    return out
