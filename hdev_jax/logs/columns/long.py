"""Tables with a row for each value: to channels, each with its own times."""

from dataclasses import replace

import numpy as np

from hdev_jax.errors import InputError
from hdev_jax.logs.adapter import Adapter, near
from hdev_jax.logs.columns.clocks import Clock, read_clock
from hdev_jax.logs.columns.numbers import numbers
from hdev_jax.logs.readers.raw import Channel, Raw

__all__ = ["channels_of_long"]


def channels_of_long(raw: Raw, adapter: Adapter) -> Raw:
    """The channels of a table with a row for each value. Raises `InputError` for a column that is not there, a channel
    of two units."""
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
    channels: dict[str, Channel] = {}
    for channel, rows in name.groupby(name, sort=False).indices.items():
        part = replace(raw, table=table.iloc[rows].reset_index(drop=True), lines=_lines(raw, rows))
        values = numbers(part, long.value, False, note)
        if values is None:
            ledger = ledger.add("noted", "text, left out", count=len(rows), file=raw.file, column=str(channel))
            continue
        unit = None
        if long.unit:
            told = list(dict.fromkeys(part.table[long.unit].dropna().astype("str").str.strip()))
            if len(told := [u for u in told if u]) > 1:
                raise InputError(f"{raw.file}: channel '{channel}' has values in {told[0]} and in {told[1]}")
            unit = told[0] if told else None
        if np.isfinite(values).any():
            channels[str(channel)] = Channel.of(time[rows], values, unit)
    why = f"{len(table)} values of {len(channels)} channels"
    return replace(raw, channels=channels, ledger=ledger.add("noted", why, file=raw.file))


def _lines(raw: Raw, rows: np.ndarray) -> list[int] | None:
    return None if raw.lines is None else [raw.lines[int(i)] for i in rows]
