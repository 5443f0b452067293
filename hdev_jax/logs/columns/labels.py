"""Names of trips and vehicles: of columns, or of the file."""

from typing import Any

import numpy as np
import pandas as pd

from hdev_jax.errors import InputError
from hdev_jax.logs.adapter import Adapter, near
from hdev_jax.logs.readers.raw import Raw

__all__ = ["id_columns", "labels", "within_vehicles"]


def id_columns(raw: Raw, adapter: Adapter, name: str, headers: list[str]) -> tuple[str, ...]:
    """The columns that name a row's trip or vehicle; raises `InputError` with the near name."""
    rule = adapter.columns.get(name)
    if rule is None:
        return (name,) if name in headers else ()
    for source in rule.sources:
        if source not in headers and adapter.preset is not None:
            return ()
        if source not in headers:
            raise InputError(f"{raw.file}: no column '{source}' for {name}{near(source, headers)}")
    return rule.sources


def labels(raw: Raw, headers: tuple[str, ...], default: str) -> tuple[np.ndarray, tuple[str, ...]]:
    """Codes and names of the ids `[row]` (−1 where one is missing), or one name for all rows."""
    if not headers or not bool(np.asarray(raw.table[headers[0]].notna()).any()):
        return np.zeros(len(raw.table), np.int64), (default,)
    codes, names = _one(raw.table[headers[0]])
    for h in headers[1:]:
        more, other = _one(raw.table[h])
        codes, names = _pairs(codes, names, more, other)
    return codes, names


def _one(series: Any) -> tuple[np.ndarray, tuple[str, ...]]:
    codes, names = pd.factorize(series)
    plain = [str(int(n)) if isinstance(n, float) and n.is_integer() else str(n).strip() for n in names]
    if len(set(plain)) < len(plain):  # 'a ' and 'a' are one trip
        unique = list(dict.fromkeys(plain))
        codes = np.where(codes >= 0, np.array([unique.index(p) for p in plain])[codes], -1)
        plain = unique
    return np.asarray(codes, np.int64), tuple(plain)


def _pairs(
    first: np.ndarray, first_names: tuple[str, ...], second: np.ndarray, second_names: tuple[str, ...]
) -> tuple[np.ndarray, tuple[str, ...]]:
    both = np.where((first >= 0) & (second >= 0), first * max(len(second_names), 1) + second, -1)
    codes, kinds = pd.factorize(np.where(both >= 0, both, np.nan))
    n = len(second_names)
    names = tuple(f"{first_names[int(k) // n]}-{second_names[int(k) % n]}" for k in kinds)
    if len(set(names)) < len(names):
        raise InputError(f"trip ids of several columns: two of them are '{max(names, key=names.count)}'; rename one")
    return np.asarray(codes, np.int64), names


def within_vehicles(
    trip: np.ndarray, names: tuple[str, ...], vehicle: np.ndarray, vehicles: tuple[str, ...]
) -> tuple[np.ndarray, tuple[str, ...], bool]:
    """Trips named by vehicle and trip where one name belongs to several vehicles, and whether that was so.

    A name that changes its vehicle once is a fault of the log and stays, to be refused: here each vehicle counts its
    trips anew, so that most names belong to several vehicles.
    """
    good = (trip >= 0) & (vehicle >= 0)
    pairs = pd.unique(trip[good] * len(vehicles) + vehicle[good])  # hashed: a log has millions of rows, few pairs
    shared = np.bincount(pairs // max(len(vehicles), 1), minlength=len(names)) > 1
    if len(names) < 2 or shared.mean() <= 0.5:
        return trip, names, False
    codes, both = _pairs(vehicle, vehicles, trip, names)
    return codes, both, True
