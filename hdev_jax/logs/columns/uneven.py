"""Tables in which columns have rates of their own, and empty cells between: each trip's columns on one clock."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pandas as pd

from hdev_jax.errors import InputError
from hdev_jax.logs.adapter import Adapter
from hdev_jax.logs.columns.clocked import clocked
from hdev_jax.logs.columns.headers import Header
from hdev_jax.logs.columns.numbers import numbers
from hdev_jax.logs.ledger import Ledger
from hdev_jax.logs.readers.raw import Channel, Raw

__all__ = ["on_one_clock"]


def on_one_clock(raw: Raw, adapter: Adapter, time_s: np.ndarray, trip: np.ndarray, kept: Sequence[str]) -> Raw:
    """The table with rows at the times of the adapter's `clock`, trip by trip; of the columns `kept`, which name trips,
    each trip's own. **Arguments:** `time_s` and `trip`, codes, by row.

    Raises `InputError` where time runs backwards in a trip: its values would be mixed.
    """
    ledger = raw.ledger

    def note(reason: str, count: int, column: str = "") -> None:
        nonlocal ledger
        ledger = ledger.add("noted", reason, count=count, file=raw.file, column=column)

    headers = [str(c) for c in raw.table.columns if str(c) not in kept]
    values: dict[str, tuple[np.ndarray, str | None]] = {}
    for h in headers:
        x = numbers(raw, h, False, lambda why, count, h=h: note(why, count, h))
        if x is None:
            note("text, left out", 0, h)
        elif np.isfinite(x).any():
            values[h] = x, Header.of(h, raw.units.get(h)).unit
    tables: list[pd.DataFrame] = []
    units: dict[str, str] = {}
    for code in dict.fromkeys(trip[trip >= 0].tolist()):
        rows = np.flatnonzero((trip == code) & np.isfinite(time_s))
        t = time_s[rows]
        if (back := np.flatnonzero(np.diff(t) < 0)).size:
            i = int(rows[back[0] + 1])
            raise InputError(
                f"{raw.file}: {raw.where(i)}, column time_s: time runs backwards ({t[back[0]]:.10g} then "
                f"{t[back[0] + 1]:.10g} s); sort the rows, or give each trip its own trip_id"
            )
        channels: dict[str, Channel] = {}
        for h, (x, unit) in values.items():
            there = np.isfinite(x[rows])
            if there.any():
                channels[h] = Channel.of(t[there], x[rows][there], unit)
        made = clocked(replace(raw, channels=channels, ledger=Ledger()), adapter)
        tables.append(made.table.assign(**{k: raw.table[k].iloc[rows[0]] for k in kept}))
        units |= made.units
        ledger = ledger + made.ledger
    if not tables:
        raise InputError(f"{raw.file}: no row has both a trip and a time")
    return replace(raw, table=pd.concat(tables, ignore_index=True), lines=None, units=units, ledger=ledger)
