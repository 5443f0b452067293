"""Which column is the clock, where no adapter says so."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd

from hdev_jax.errors import InputError
from hdev_jax.logs.columns.clocks import unix_scale
from hdev_jax.logs.columns.headers import Header, parse_header
from hdev_jax.logs.readers.raw import Raw

__all__ = ["CLOCKS", "Found", "find_clock"]

CLOCKS = ("time_iso", "timestamp", "datetime", "time", "time_unix", "date")
_TIME_OF_DAY = r"\d{1,2}:\d\d(:\d\d([.,]\d+)?)?\s*([AaPp][Mm])?"


@dataclass(frozen=True)
class Found:
    """The columns of a clock, how many seconds one of its numbers is, its unit for the report, and what was assumed."""

    headers: tuple[str, ...]
    scale: float = 1.0
    unit: str = "date and time"
    reason: str = ""


def find_clock(raw: Raw, headers: Mapping[str, Header]) -> Found | None:
    """The column `time_s` or one with another unit of time, else times by their usual names; None without one.

    A number without a unit counts where its size says that it is a time since 1970.
    """
    for header, parsed in headers.items():
        try:
            read = parse_header(parsed)
        except InputError:  # told where columns are translated
            continue
        if read.name == "time_s":
            if not _numeric(raw, header):
                return Found((header,))
            return Found((header,), float(read.conversion.call(np.asarray(1.0))), read.conversion.unit or "s")
    names = {h.strip().lower(): h for h in reversed(list(headers))}
    for wanted in CLOCKS:
        if wanted not in names:
            continue
        header = names[wanted]
        if {"date", "time"} <= names.keys() and wanted in ("date", "time") and _of_day(raw, names["time"]):
            return Found((names["date"], names["time"]))
        if not _numeric(raw, header):
            return Found((header,))
        if wanted == "time_unix":
            return Found((header,), unit="s")
        scale = unix_scale(raw.table[header].to_numpy(dtype=np.float64, na_value=np.nan))
        if scale is not None:
            return Found((header,), *scale, "read as times since 1970, by the size of the numbers")
    return None


def _numeric(raw: Raw, header: str) -> bool:
    return pd.api.types.is_numeric_dtype(raw.table[header].dtype)


def _of_day(raw: Raw, header: str) -> bool:
    clock = raw.table[header].dropna().astype("str").str.strip()
    return bool(clock.iloc[:1].str.fullmatch(_TIME_OF_DAY).any())
