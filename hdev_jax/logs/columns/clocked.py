"""Channels with rates of their own on one clock: powers are averaged, states keep their last value, what varies
smoothly is linear. Whatever a value becomes is counted in the ledger."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from hdev_jax.errors import InputError, MissingColumnError
from hdev_jax.logs.adapter import Adapter, Rule, near
from hdev_jax.logs.columns.headers import Header, parse_header
from hdev_jax.logs.ledger import Ledger
from hdev_jax.logs.limits import GAP_SAMPLES
from hdev_jax.logs.readers.raw import Channel, Raw
from hdev_jax.logs.repair import CIRCULAR
from hdev_jax.units import unit_of

__all__ = ["clocked", "named", "resampling"]

_MEASURED = ("battery_power_w", "energy_wh")
_SPEEDS = ("speed_mps", "speed_start_mps", "speed_end_mps")
# What a row's interval has is its mean: power times duration is then the energy that passed.
_MEANS = ("watt", "newton*meter", "newton", "ampere", "volt", "meter/second**2")
_STATES = ("kilogram", "dimensionless")  # held until the next value: a payload, a gear, a door
_SMOOTH = ("soc",)
SAME_RATE = 1.5  # steps closer than that are of one rate: messages are sent every 10, 20, 50, 100 ms
FASTER = 2.0  # at twice the clock's rate a row has two values or more, and their mean; below, a line has less delay

_Loader = Callable[[str], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class _Clock:
    """Times of the rows, their usual step, and the channel that they are the times of (None: an even clock)."""

    at: np.ndarray
    step: float
    name: str | None = None

    @property
    def shown(self) -> str:
        return f"a clock of {self.step:g} s" if self.name is None else f"'{self.name}'"


def clocked(raw: Raw, adapter: Adapter) -> Raw:
    """The channels of `raw` as a table at the times of the adapter's `clock`; without one, at those of the slower one
    of speed and measurement.

    A power is the mean over a row's interval, an energy the sum, a state the last value until the next, all else linear
    between its own values, of which none is known over more than ten of its own steps. What is measured at the battery
    is never made up between measurements: a row without one has none. Raises `InputError` where no channel is the
    clock, or a sum would have to be shared out.
    """
    file, ledger = raw.file, raw.ledger
    values: dict[str, tuple[np.ndarray, np.ndarray]] = {}

    def loaded(name: str) -> tuple[np.ndarray, np.ndarray]:
        nonlocal ledger
        if name not in values:
            t, x = raw.channels[name].load()
            t, x, ledger = _tidy(t, x, _valid(name, adapter), ledger, file, name)
            values[name] = t, x
        return values[name]

    measured = _measured(raw.channels, adapter)
    speeds = [h for c in _SPEEDS for h in _feeding(c, raw.channels, adapter)]
    needed = [n for n in dict.fromkeys((*measured, *speeds)) if len(loaded(n)[0])]
    clock, ledger = _clock(raw, adapter, needed, loaded, ledger)
    table: dict[str, np.ndarray] = {"time_s": clock.at}
    for name, channel in raw.channels.items():
        t, x = loaded(name)
        if name not in needed:
            del values[name]  # of a large file one channel is in memory at a time
        if not len(t):
            ledger = ledger.add("noted", "no number in it, left out", file=file, column=name)
        else:
            kind = resampling(name, channel.unit, adapter)
            if kind == "sum" and _step(t) > SAME_RATE * clock.step:
                what = f"'{name}' is a sum over each {_step(t):g} s, slower than the clock of {clock.step:g} s"
                raise InputError(f"{file}: {what}: make it the clock, or say counter = true if it counts on")
            table[name], how = _resampled(t, x, clock, kind, name in measured)
            known = int(np.isfinite(table[name]).sum())
            if how and name != clock.name:
                why = f"{len(t)} values at the times of {clock.shown}: {how}"
                ledger = ledger.add("derived", why, count=known, file=file, column=name)
    units = {"time_s": "s", **{n: c.unit for n, c in raw.channels.items() if c.unit is not None}}
    return replace(raw, table=pd.DataFrame(table), channels={}, lines=None, units=units, ledger=ledger)


def named(raw: Raw, adapter: Adapter) -> Raw:
    """Of the channels those that a rule names or whose names are the contract's; the others counted. Raises
    `MissingColumnError` where that leaves no speed."""
    if adapter.others == "keep":
        return raw
    fed = {h for c in adapter.columns for h in _feeding(c, raw.channels, adapter)}
    kept = {n: c for n, c in raw.channels.items() if n in fed or _contract(n, c.unit) is not None}
    if not any(_feeding(c, kept, adapter) for c in _SPEEDS):
        shown = ", ".join(list(raw.channels)[:8]) + (", …" if len(raw.channels) > 8 else "")
        wanted = next((s for c in _SPEEDS if c in adapter.columns for s in adapter.columns[c].sources), None)
        same = " and ".join(f"'{n}'" for n in raw.channels if n.endswith(f".{wanted}"))
        hint = f", but {same}" if same else near(wanted or "", list(raw.channels))
        what = f"no signal '{wanted}'{hint}" if wanted else "no signal has a speed's name"
        raise MissingColumnError(f"{raw.file}: {what}; it has {shown}; write an adapter (hdev check --skeleton)")
    ledger = raw.ledger
    if len(kept) < len(raw.channels):
        left = len(raw.channels) - len(kept)
        why = f"signals that no rule names, left out: {left} (others = 'keep' in an adapter reads them)"
        ledger = ledger.add("noted", why, file=raw.file)
    return replace(raw, channels=kept, ledger=ledger)


def resampling(name: str, unit: str | None, adapter: Adapter) -> str:
    """How a channel is put on a clock: as a rule says, else by its quantity; one that is not known is linear where it
    has a unit, else a state."""
    rules = {c: r for c, r in adapter.columns.items() if name in (*r.sources, *r.alternatives)}
    if (asked := next((r.resample for r in rules.values() if r.resample), None)) is not None:
        return asked
    column = next(iter(rules), _contract(name, unit))
    if column is None or (unit_of(column) is None):
        return "linear" if unit else "last"
    if column in ("energy_wh", "distance_m") and not rules.get(column, Rule("")).counter:
        return "sum"
    if column in CIRCULAR or (unit_of(column) in _STATES and column not in _SMOOTH):
        return "last"
    return "mean" if unit_of(column) in _MEANS else "linear"


def _contract(name: str, unit: str | None) -> str | None:
    try:
        parsed = parse_header(Header.of(name, unit))
    except InputError:  # told where columns are translated
        return None
    return parsed.name if parsed.known else None


def _feeding(column: str, channels: Mapping[str, Channel], adapter: Adapter, above: Sequence[str] = ()) -> list[str]:
    """The channels that a column of the contract is made from."""
    rule = adapter.columns.get(column)
    if rule is None:
        return [n for n, c in channels.items() if _contract(n, c.unit) == column]
    found: list[str] = []
    for source in rule.sources:
        if source in channels:
            found.append(source)
        elif source in adapter.columns and source not in above:
            found += _feeding(source, channels, adapter, (*above, column))
    return found or [a for a in rule.alternatives if a in channels][:1]


def _measured(channels: Mapping[str, Channel], adapter: Adapter) -> list[str]:
    """The channels that are the measurement: of a power from voltage and current, the current."""
    volts = _feeding("voltage_v", channels, adapter)
    for columns in (_MEASURED, ("current_a",)):
        found = [h for c in columns for h in _feeding(c, channels, adapter)]
        if found:
            amps = [h for h in found if h not in volts and (channels[h].unit or "").strip() not in ("V", "v", "volt")]
            return list(dict.fromkeys(amps or found))
    return []


def _valid(name: str, adapter: Adapter) -> tuple[float, float] | None:
    rules = [r for r in adapter.columns.values() if r.expr is None and name in (*r.sources, *r.alternatives)]
    return next((r.valid for r in rules if r.valid is not None), None)


def _tidy(
    t: np.ndarray, x: np.ndarray, valid: tuple[float, float] | None, ledger: Ledger, file: str, name: str
) -> tuple[np.ndarray, np.ndarray, Ledger]:
    """In order of time, without what is no value: each kind counted."""
    good = np.isfinite(t) & np.isfinite(x)
    if lost := int((~good).sum()):
        why = "no number, or one that stands for 'not available' or an error"
        ledger = ledger.add("dropped", why, count=lost, file=file, column=name)
    if valid is not None:
        with np.errstate(invalid="ignore"):
            inside = (x >= valid[0]) & (x <= valid[1])
        if lost := int((good & ~inside).sum()):
            ledger = ledger.add("clipped", f"outside {list(valid)}, taken as missing", count=lost, column=name)
        good &= inside
    if not good.all():
        t, x = t[good], x[good]
    if (np.diff(t) < 0).any():
        order = np.argsort(t, kind="stable")
        t, x = t[order], x[order]
    last = np.r_[t[1:] != t[:-1], True] if len(t) else np.zeros(0, bool)
    if again := int((~last).sum()):
        ledger = ledger.add("dropped", "at the time of another value", count=again, file=file, column=name)
        t, x = t[last], x[last]
    return t, x, ledger


def _clock(raw: Raw, adapter: Adapter, needed: list[str], loaded: _Loader, ledger: Ledger) -> tuple[_Clock, Ledger]:
    """The clock, cut to the time in which all that is needed is known."""
    asked = adapter.long.clock if adapter.long is not None and adapter.long.clock else adapter.clock
    begin = max((float(loaded(n)[0][0]) for n in needed), default=-np.inf)
    end = min((float(loaded(n)[0][-1]) for n in needed), default=np.inf)
    if needed and begin > end:
        raise InputError(f"{raw.file}: {' and '.join(needed)} have no time in common")
    if isinstance(asked, int | float):
        if not needed:
            raise InputError(f"{raw.file}: no speed and no measurement to put on a clock of {asked:g} s")
        at = begin + asked * np.arange(int((end - begin) / asked + 1e-9) + 1)
        return _Clock(at, asked), ledger
    name = _named_clock(raw, adapter, asked) or _slowest(needed, loaded)
    if name is None:
        filled = {n: len(loaded(n)[0]) for n in raw.channels}
        name = max(filled, key=lambda n: filled[n], default="")
        if not filled.get(name):
            raise InputError(f"{raw.file}: no channel with numbers")
    t = loaded(name)[0]
    inside = (t >= begin) & (t <= end)
    if out := int((~inside).sum()):
        why = f"before the first or after the last value of {' or '.join(n for n in needed if n != name)}"
        ledger = ledger.add("dropped", why, count=out, file=raw.file, column=name)
    return _Clock(t[inside], _step(t), name), ledger


def _named_clock(raw: Raw, adapter: Adapter, asked: str | tuple[str, ...] | None) -> str | None:
    if asked is None:
        return None
    wanted = (asked,) if isinstance(asked, str) else asked
    found = next((c for c in wanted if c in raw.channels), None)
    if found is None and adapter.preset is None:
        shown = ", ".join(list(raw.channels)[:8])
        hint = near(wanted[0], list(raw.channels))
        raise InputError(f"{raw.file}: no channel '{wanted[0]}' (clock of {adapter.where}){hint}; it has {shown}")
    return found


def _slowest(needed: list[str], loaded: _Loader) -> str | None:
    """The slowest of the needed channels; of those with one rate the first, which is the measurement."""
    steps = {n: _step(loaded(n)[0]) for n in needed}
    if not steps:
        return None
    most = max(steps.values())
    return next(n for n, s in steps.items() if s * SAME_RATE >= most)


def _step(t: np.ndarray) -> float:
    return float(np.median(np.diff(t))) if len(t) > 1 else 0.0


def _resampled(t: np.ndarray, x: np.ndarray, clock: _Clock, kind: str, measured: bool) -> tuple[np.ndarray, str]:
    """A channel at the clock's times, and how it came there in words; nothing to say where it is as it was."""
    if len(t) == len(clock.at) and np.array_equal(t, clock.at):
        return x, ""
    faster = _step(t) * FASTER <= clock.step * (1.0 + 1e-6)
    if measured or kind == "sum" or (kind == "mean" and faster):
        means, far = _around(t, x, clock, kind == "sum", faster)
        where = f"{'the sum' if kind == 'sum' else 'the mean'} of those around a row"
        where += f", {far} of them in no row" if far else ""
        if measured or kind == "sum":
            return means, where
        return np.where(np.isfinite(means), means, _between(t, x, clock.at)), where
    if kind != "last":
        return _between(t, x, clock.at), "linear between two"
    held, long = _held(t, x, clock.at)
    return held, "the last one before" + (f", held for more than ten of its steps in {long} rows" if long else "")


def _around(t: np.ndarray, x: np.ndarray, clock: _Clock, total: bool, faster: bool) -> tuple[np.ndarray, int]:
    """Mean (or sum) of the values nearer to a row's time than to any other's, NaN where there is none; and how many
    values belong to no row: outside, or in a gap, where a row reaches half a step.

    Half-way between two rows a value of a `faster` channel counts half in each, for else the mean would be of a time
    half a step of the channel before the row's.
    """
    at, n = clock.at, len(clock.at)
    step = np.diff(at)
    reach = np.where(step > GAP_SAMPLES * clock.step * (1.0 + 1e-9), 0.5 * clock.step, 0.5 * step)
    ends = 0.5 * clock.step
    low, high = at - np.r_[ends, reach], at + np.r_[reach, ends]
    tie = 1e-6 * clock.step if faster else 0.0
    weights, sums, used = np.zeros(n), np.zeros(n), np.zeros(len(t), bool)
    for shifted in (t - tie, t + tie):
        row = np.searchsorted(low, shifted, "right") - 1
        inside = (row >= 0) & (shifted <= high[np.clip(row, 0, n - 1)])
        weights += 0.5 * np.bincount(row[inside], minlength=n)
        sums += 0.5 * np.bincount(row[inside], x[inside], minlength=n)
        used |= inside
    out = np.where(weights > 0, sums if total else sums / np.where(weights > 0, weights, 1.0), np.nan)
    return out, int((~used).sum())


def _between(t: np.ndarray, x: np.ndarray, at: np.ndarray) -> np.ndarray:
    """A channel at other times; NaN before its first value, after its last, and in its gaps."""
    following = np.searchsorted(t, at, "left")
    before = np.searchsorted(t, at, "right") - 1
    outside = (before < 0) | (following >= len(t))
    low, high = np.clip(before, 0, len(t) - 1), np.clip(following, 0, len(t) - 1)
    gap = t[high] - t[low] > GAP_SAMPLES * _step(t) * (1.0 + 1e-9)
    return np.where(outside | gap, np.nan, np.interp(at, t, x))


def _held(t: np.ndarray, x: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, int]:
    """A state at other times, NaN before its first value: many are sent only when they change, a payload perhaps once.
    And in how many rows it is older than ten of its steps."""
    before = np.searchsorted(t, at, "right") - 1
    low = np.clip(before, 0, len(t) - 1)
    old = (before >= 0) & (at - t[low] > GAP_SAMPLES * _step(t) * (1.0 + 1e-9)) & (len(t) > 1)
    return np.where(before < 0, np.nan, x[low]), int(old.sum())
