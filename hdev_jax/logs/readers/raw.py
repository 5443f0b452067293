"""`Raw`: one table as it stands in a file, with what the file says about units and lines; or channels with clocks of
their own."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import pandas as pd

from hdev_jax.logs.ledger import Ledger

__all__ = ["Channel", "Raw", "place"]


def place(row: int, lines: Sequence[int] | None) -> str:
    """`row 3 (line 4)` of a row counted from 0."""
    return f"row {row + 1}" + (f" (line {lines[row]})" if lines is not None else "")


@dataclass(frozen=True)
class Channel:
    """One quantity at times of its own: `load()` gives times [s] and values, NaN where the file has a value that is
    none; `unit` is the file's, None where it says nothing. What nobody asks for is never loaded."""

    load: Callable[[], tuple[np.ndarray, np.ndarray]]
    unit: str | None = None

    @staticmethod
    def of(time: np.ndarray, values: np.ndarray, unit: str | None = None) -> "Channel":
        """A channel that is in memory."""
        return Channel(lambda: (time, values), unit)


@dataclass(frozen=True)
class Raw:
    """One table as it stands in a file: columns of equal length, text where the file has text. Where the file has
    `channels` instead, the table is made from them, at the times of one clock.

    `trip` is the name the file or the variables give it; a `trip_id` column goes before it. `lines` has the line of
    each row in a text file, None elsewhere; `units` what a row of units or a column of them says of a column;
    `thousands` the separator that the adapter names; `ledger` what reading changed; `asked_only` whether channels that
    nothing names are left out.
    """

    file: str
    table: pd.DataFrame
    trip: str
    vehicle: str | None = None
    lines: Sequence[int] | None = None
    units: Mapping[str, str] = field(default_factory=dict)
    thousands: str | None = None
    ledger: Ledger = field(default_factory=Ledger)
    channels: Mapping[str, Channel] = field(default_factory=dict)
    asked_only: bool = False

    def where(self, row: int) -> str:
        """`row 3 (line 4)` of a row counted from 0."""
        return place(row, self.lines)
