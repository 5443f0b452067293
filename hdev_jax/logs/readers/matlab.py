"""MATLAB files: version 5 checked element by element, then read by scipy; 7.3 by h5py; then laid out as tables."""

import io
import math
import re
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd

from hdev_jax.errors import InputError
from hdev_jax.logs.adapter import Adapter
from hdev_jax.logs.ledger import Ledger
from hdev_jax.logs.readers.libraries import library
from hdev_jax.logs.readers.names import stem, trip_of
from hdev_jax.logs.readers.raw import Channel, Raw

__all__ = ["numeric_variables", "read_mat"]

_HDF5 = (b"MATLAB 7.3", b"\x89HDF")
# What to do in MATLAB with what holds no plain numbers, by its class
_EXPORTS = {
    "timeseries": "t = {0}.Time; x = {0}.Data; save('log.mat', 't', 'x')",
    "timetable": "writetimetable({0}, 'log.csv')",
    "table": "writetable({0}, 'log.csv')",
    "struct": "writetable(struct2table({0}), 'log.csv')",
}

# MAT-File Format, The MathWorks, tables 1-1 and 1-3: element types with their size in bytes; classes of arrays
_SIZES = {1: 1, 2: 1, 3: 2, 4: 2, 5: 4, 6: 4, 7: 4, 9: 8, 12: 8, 13: 8}
_MATRIX, _COMPRESSED = 14, 15
_NUMERIC = range(6, 16)
_CLASSES = {1: "cell", 2: "struct", 3: "object", 4: "char", 5: "sparse", 16: "function"}
_OPAQUE = 17  # an object of a class of MATLAB's own, whose name stands behind the variable's
_HEADER_BYTES = 128


class _DamagedError(Exception):
    """The bytes are not what the format says."""


def _elements(data: bytes, start: int, order: str) -> Iterator[tuple[int, bytes]]:
    """`(type, content)` of the elements that follow each other from `start`."""
    while start < len(data):
        if len(data) - start < 8:
            raise _DamagedError(f"ends inside an element at byte {start}")
        kind, size = struct.unpack_from(order + "II", data, start)
        if kind >> 16:  # small element: both halves in the first word, up to four bytes in the second
            kind, size, body, step = kind & 0xFFFF, kind >> 16, start + 4, 8
        else:
            body, step = start + 8, 8 + size + (-size % 8 if kind != _COMPRESSED else 0)
        if body + size > len(data):
            raise _DamagedError(f"element at byte {start} has {size} bytes, {len(data) - body} are there")
        yield kind, data[body : body + size]
        start += step


def _name_and_class(matrix: bytes, order: str) -> tuple[str, str]:
    """Name and class of a variable, an empty class for a numeric array whose dimensions and bytes agree."""
    parts = _elements(matrix, 0, order)
    try:
        (kind, flags), (kind_d, dims), (kind_n, name) = next(parts), next(parts), next(parts)
        if kind != 6 or len(flags) != 8:
            raise _DamagedError("an array without flags")
        word = struct.unpack_from(order + "I", flags)[0]
        if (kind := word & 0xFF) == _OPAQUE:
            return dims.decode("latin-1"), next(parts)[1].decode("latin-1")
        if kind not in _NUMERIC:
            return name.decode("latin-1"), _CLASSES.get(kind, "object")
        if kind_d != 5 or len(dims) < 8 or len(dims) % 4 or kind_n not in (1, 16):
            raise _DamagedError("an array without dimensions or name")
        sides = struct.unpack(order + f"{len(dims) // 4}i", dims)
        if min(sides) < 0:
            raise _DamagedError(f"an array of {sides}")
        for _ in range(2 if word & 0x800 else 1):  # real, and imaginary
            kind, values = next(parts)
            if kind not in _SIZES or len(values) != math.prod(sides) * _SIZES[kind]:
                raise _DamagedError(f"an array of {sides} in {len(values)} bytes")
    except StopIteration:
        raise _DamagedError("an array that ends early") from None
    return name.decode("latin-1"), ""


def numeric_variables(path: Path, data: bytes) -> dict[str, np.ndarray]:
    """Real numeric arrays of a file by name. Raises `InputError` where it is truncated or damaged."""
    return _variables(path, data)[0]


def _variables(path: Path, data: bytes) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Real numeric arrays by name, and the classes of the other variables."""
    return _of_hdf5(path, data) if data.startswith(_HDF5) else _of_version_5(path, data)


def _of_hdf5(path: Path, data: bytes) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Version 7.3: a data set of HDF5 for each variable, its dimensions turned round."""
    h5py = library("h5py", path, "formats", "save it in MATLAB with -v7")
    arrays: dict[str, np.ndarray] = {}
    others: dict[str, str] = {}
    try:
        with h5py.File(io.BytesIO(data), "r") as file:
            for name, found in file.items():
                if name.startswith("#"):  # what objects and cells refer to
                    continue
                told = found.attrs.get("MATLAB_class", b"")
                kind = told.decode() if isinstance(told, bytes) else str(told)
                plain = isinstance(found, h5py.Dataset) and found.dtype.kind in "fiub"
                if plain and kind not in ("char", "cell") and "MATLAB_object_decode" not in found.attrs:
                    empty = "MATLAB_empty" in found.attrs
                    arrays[name] = np.zeros((0, 0)) if empty else np.atleast_2d(np.asarray(found[()])).T
                else:
                    others[name] = kind or ("struct" if isinstance(found, h5py.Group) else "object")
    except (OSError, RuntimeError, KeyError, ValueError) as e:  # h5py's, by where the damage is
        raise InputError(f"{path}: truncated or damaged MATLAB 7.3 file ({str(e)[:120]})") from None
    return arrays, others


def _of_version_5(path: Path, data: bytes) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Version 5, also 7: as it was before 7.3.

    scipy's reader trusts sizes and types in the file and takes the process down where they are wrong, so they are
    checked first, and only what has been checked is given to it.
    """
    import scipy.io

    try:
        if len(data) <= _HEADER_BYTES or data[126:128] not in (b"IM", b"MI"):
            raise _DamagedError("no MATLAB 5 header with data after it")
        order = "<" if data[126:128] == b"IM" else ">"
        names: list[str] = []
        others: dict[str, str] = {}
        for kind, body in _elements(data, _HEADER_BYTES, order):
            inner = list(_elements(zlib.decompress(body), 0, order)) if kind == _COMPRESSED else [(kind, body)]
            for inner_kind, matrix in inner:
                if inner_kind != _MATRIX:
                    raise _DamagedError(f"an element of type {inner_kind} where an array is expected")
                name, other = _name_and_class(matrix, order)
                if other and name:  # without a name: what objects refer to
                    others[name] = other
                elif name:
                    names.append(name)
        content = scipy.io.loadmat(io.BytesIO(data), variable_names=names) if names else {}
    except _DamagedError as e:
        raise InputError(f"{path}: truncated or damaged MATLAB file ({e})") from None
    except Exception as e:  # zlib's and scipy's, which lets any error of its parser through
        raise InputError(f"{path}: truncated or damaged MATLAB file ({str(e)[:120]})") from None
    arrays = {n: content[n] for n in names if n in content}
    return {n: a for n, a in arrays.items() if isinstance(a, np.ndarray) and a.dtype.kind in "fiub"}, others


def read_mat(path: Path, data: bytes, adapter: Adapter) -> list[Raw]:
    """A table, or each trip's channels. Raises `InputError` for a damaged file, and for one without vectors or [time,
    value] pairs."""
    arrays, others = _variables(path, data)
    if not arrays:
        raise InputError(f"{path}: no numeric variable; {_export(others)}")
    ledger = Ledger()
    if others:
        shown = ", ".join(f"{name} ({kind})" for name, kind in others.items())
        ledger = ledger.add("noted", f"variables that are no numbers, left out: {shown}", file=path.name)
    if adapter.layout == "time_value":
        trips = _time_value(path, arrays, adapter)
        return [Raw(path.name, pd.DataFrame(), t, ledger=ledger, channels=c) for t, c in trips.items()]
    return [Raw(path.name, _table(path, arrays), trip_of(path, adapter), ledger=ledger)]


def _export(others: dict[str, str]) -> str:
    """What to do about variables that hold no plain numbers."""
    name, kind = next(((n, k) for n, k in others.items() if k in _EXPORTS), ("", ""))
    if not name:
        return "save one vector a column"
    return f"'{name}' is a {kind}, which only MATLAB reads: there, {_EXPORTS[kind].format(name)}"


def _table(path: Path, arrays: dict[str, np.ndarray]) -> pd.DataFrame:
    """Each variable that is a vector is a column."""
    vectors = {n: a.ravel() for n, a in arrays.items() if a.ndim == 2 and min(a.shape) == 1}
    if not vectors:
        n, a = next(iter(arrays.items()))
        raise InputError(
            f"{path}: variable '{n}' is {a.shape[0]}×{a.shape[-1]}; layout 'table' has one vector a column; "
            "for variables that are [time, value] the adapter says layout = 'time_value'"
        )
    sizes = {n: len(v) for n, v in vectors.items() if len(v) > 1}
    if len(set(sizes.values())) > 1:
        (n0, s0), (n1, s1) = next((a, b) for a in sizes.items() for b in sizes.items() if a[1] != b[1])
        raise InputError(f"{path}: variables of different length: '{n0}' has {s0} values, '{n1}' {s1}")
    size = next(iter(sizes.values()), 1)
    return pd.DataFrame({n: v for n, v in vectors.items() if len(v) == size})


def _time_value(path: Path, arrays: dict[str, np.ndarray], adapter: Adapter) -> dict[str, dict[str, Channel]]:
    """Each variable is [time, value], a channel of its trip."""
    trips: dict[str, dict[str, Channel]] = {}
    for name, array in arrays.items():
        if array.ndim != 2 or array.shape[1] != 2:
            continue
        trip, channel = stem(path.name), name
        if adapter.trip_id is not None:
            found = re.search(adapter.trip_id, name)
            if found is None:
                trip = adapter.match(adapter.trip_id, path.name) or ""
                if not trip:
                    raise InputError(f"{path}: trip_id = {adapter.trip_id!r} does not match the variable '{name}'")
            else:
                trip = next((g for g in found.groups() if g is not None), found.group(0))
                channel = (name[: found.start()] + name[found.end() :]).strip("_")
        if adapter.variable is not None:
            channel = adapter.match(adapter.variable, name) or ""
            if not channel:
                continue
        if channel in trips.setdefault(trip, {}):
            raise InputError(f"{path}: two variables of trip {trip} are the channel '{channel}', one of them '{name}'")
        time, values = array.astype(np.float64).T
        if (np.diff(time[np.isfinite(time)]) < 0).any():
            raise InputError(f"{path}: the time of '{channel}' in trip {trip} does not run forward")
        trips[trip][channel] = Channel.of(time, values)
    if not trips:
        raise InputError(f"{path}: no variable of two columns [time, value] that the adapter {adapter.where} names")
    return trips
