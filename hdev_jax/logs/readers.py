"""Files in: bytes to raw tables, every way in which a file is not what it claims told in one line."""

import csv
import gzip
import io
import re
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from hdev_jax.errors import InputError
from hdev_jax.logs.adapter import Adapter, near

__all__ = ["ENDINGS", "Raw", "find_files", "read_bytes", "read_raw", "stem"]

ENDINGS = {".csv": "csv", ".csv.gz": "csv", ".parquet": "parquet", ".pq": "parquet", ".mat": "mat"}
_MAGIC = {b"\x1f\x8b": "gzip", b"PAR1": "Parquet", b"MATLAB": "MATLAB", b"\x89HDF": "HDF5", b"PK": "zip (or xlsx)"}
_TEXT_IDS = ("trip_id", "vehicle_id")


@dataclass(frozen=True)
class Raw:
    """One table as it stands in a file: columns of equal length, text where the file has text.

    `trip` is the name the file or the variables give it; a `trip_id` column goes before it. `first_line` is the line
    of the first row in a text file, 0 elsewhere.
    """

    file: str
    table: pd.DataFrame
    trip: str
    vehicle: str | None = None
    first_line: int = 0


def stem(name: str) -> str:
    """A file's name without its ending (`a.csv.gz` → `a`)."""
    for ending in sorted(ENDINGS, key=len, reverse=True):
        if name.lower().endswith(ending):
            return name[: -len(ending)]
    return Path(name).stem


def _format(path: Path, adapter: Adapter) -> str:
    by_ending = next((f for e, f in ENDINGS.items() if path.name.lower().endswith(e)), None)
    if by_ending is None and adapter.format is None:
        raise InputError(f"{path}: unknown ending; a log ends in {', '.join(ENDINGS)}")
    if by_ending and adapter.format and by_ending != adapter.format:
        raise InputError(f"{path}: the adapter {adapter.where} is for {adapter.format} files")
    return adapter.format or by_ending or "csv"


def find_files(paths: list[Path], adapter: Adapter) -> tuple[list[Path], list[str]]:
    """Log files in the order given (a folder stands for the logs in it), and names of the companions left out."""
    files: list[Path] = []
    companions: list[str] = []
    for path in paths:
        if path.is_dir():
            endings = tuple(e for e, f in ENDINGS.items() if adapter.format in (None, f))
            inside = sorted(p for p in path.iterdir() if p.is_file() and p.name.lower().endswith(endings))
            if not inside:
                raise InputError(f"{path}: no log in this folder; a log ends in {', '.join(endings)}")
        elif path.is_file():
            inside = [path]
        else:
            beside = [p.name for p in path.parent.iterdir()] if path.parent.is_dir() else []
            raise InputError(f"{path}: no such file{near(path.name, beside)}")
        companions += [p.name for p in inside if adapter.is_companion(p.name)]
        files += [p for p in inside if not adapter.is_companion(p.name)]
    if not files:
        raise InputError(f"no log among {len(paths)} path(s): {len(companions)} companion file(s) only")
    seen: set[Path] = set()
    for path in files:
        if (real := path.resolve()) in seen:
            raise InputError(f"{path}: given twice")
        seen.add(real)
    return files, companions


def read_raw(path: Path, adapter: Adapter) -> list[Raw]:
    """The tables of a file (a MATLAB file of layout `time_value` may hold several trips), companion joined."""
    kind = _format(path, adapter)
    data = read_bytes(path, kind)
    if kind == "mat":
        raws = _read_mat(path, data, adapter)
    else:
        table, first_line = _read_table(path, data, kind)
        raws = [Raw(path.name, table, _trip_of(path, adapter), first_line=first_line)]
    if any(r.table.empty for r in raws):
        raise InputError(f"{path}: no rows")
    vehicle = None
    if adapter.vehicle_id is not None:
        vehicle = adapter.match(adapter.vehicle_id, path.name)
        if vehicle is None:
            raise InputError(f"{path}: vehicle_id = {adapter.vehicle_id!r} of {adapter.where} does not match its name")
    raws = [Raw(r.file, r.table, r.trip, vehicle, r.first_line) for r in raws]
    return [_with_companion(r, path, adapter) for r in raws] if adapter.companion else raws


def _trip_of(path: Path, adapter: Adapter) -> str:
    if adapter.trip_id is None:
        return stem(path.name)
    trip = adapter.match(adapter.trip_id, path.name)
    if trip is None:
        raise InputError(f"{path}: trip_id = {adapter.trip_id!r} of {adapter.where} does not match the file's name")
    return trip


def read_bytes(path: Path, kind: str = "csv") -> bytes:
    """A file's content, unzipped; refuses what its ending (without a known one, `kind`) does not promise."""
    try:
        data = path.read_bytes()
    except OSError as e:
        raise InputError(f"{path}: cannot be read ({e.strerror or e})") from None
    if not data:
        raise InputError(f"{path}: empty file")
    ending = next((e for e in (".csv.gz", *ENDINGS) if path.name.lower().endswith(e)), "")
    found = next((n for m, n in _MAGIC.items() if data.startswith(m)), "text" if b"\0" not in data[:4096] else "binary")
    expected = {"csv": "text", "parquet": "Parquet", "mat": "MATLAB"}[ENDINGS.get(ending, kind)]
    expected = "gzip" if ending == ".csv.gz" else expected
    if expected == "MATLAB" and (found == "HDF5" or data.startswith(b"MATLAB 7.3")):
        raise InputError(f"{path}: MATLAB 7.3 (HDF5) is not read; save it in MATLAB with -v7")
    if expected == "text" and found == "gzip" and not ending:
        return _gunzip(path, data)
    if expected == "text" and data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        raise InputError(f"{path}: UTF-16 text; save it as UTF-8")
    if expected != found:
        raise InputError(f"{path}: its ending says {ending or 'text'} ({expected}), its content is {found}")
    return _gunzip(path, data) if expected == "gzip" else data


def _gunzip(path: Path, data: bytes) -> bytes:
    try:
        data = gzip.decompress(data)
    except (EOFError, zlib.error, OSError) as e:
        raise InputError(f"{path}: truncated or damaged gzip file ({e}); fetch it again") from None
    if not data:
        raise InputError(f"{path}: empty file")
    if b"\0" in data[:4096]:
        raise InputError(f"{path}: its ending says text in gzip, its content is binary")
    return data


def _read_table(path: Path, data: bytes, kind: str) -> tuple[pd.DataFrame, int]:
    return _read_csv(path, data) if kind == "csv" else (_read_parquet(path, data), 0)


def _read_parquet(path: Path, data: bytes) -> pd.DataFrame:
    import pyarrow
    import pyarrow.parquet

    try:
        table = pyarrow.parquet.read_table(io.BytesIO(data))
        _check_header(path, list(table.column_names))
        frame = table.to_pandas(ignore_metadata=True)
    except (pyarrow.ArrowException, OSError, ValueError) as e:
        raise InputError(f"{path}: truncated or damaged Parquet file ({str(e)[:120]})") from None
    return frame


def _check_header(path: Path, names: list[str]) -> None:
    twice = sorted({n for n in names if n and names.count(n) > 1})
    if twice:
        raise InputError(f"{path}: column '{twice[0]}' appears twice; rename or remove one")


def _split(line: str, separator: str) -> list[str]:
    return [c.strip() for c in next(csv.reader([line], delimiter=separator), [])]


def _is_number(text: str) -> bool:
    return re.fullmatch(r"[-+]?(\d+([.,]\d*)?|[.,]\d+)([eE][-+]?\d+)?", text) is not None


def _read_csv(path: Path, data: bytes) -> tuple[pd.DataFrame, int]:
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = data.decode("cp1252", errors="replace")  # what spreadsheets write where it is not UTF-8
    head = text[:65536].splitlines()
    first = next((i for i, line in enumerate(head) if line.strip()), None)
    if first is None:
        raise InputError(f"{path}: empty file")
    header = head[first]
    separator = max(",;\t", key=lambda s: len(_split(header, s)))
    names = _split(header, separator)
    if all(_is_number(n) for n in names):
        raise InputError(f"{path}: line {first + 1} has numbers: the first line must name the columns")
    _check_header(path, names)
    rows = [line for line in head[first + 1 : first + 51] if line.strip()]
    if not rows:
        raise InputError(f"{path}: no rows under the header")
    last = text[-65536:].rstrip("\r\n").splitlines()[-1]
    for line, which in ((rows[0], f"line {first + 2}"), (last, "the last line")):
        if '"' not in line and len(found := _split(line, separator)) != len(names):
            # a separator at the end of every line is harmless and common
            if len(found) == len(names) + 1 and not found[-1]:
                continue
            cut = "; the file is truncated" if which == "the last line" and len(found) < len(names) else ""
            raise InputError(f"{path}: {which} has {len(found)} fields, the header {len(names)}{cut}")
    cells = [c for line in rows for c in _split(line, separator)]
    comma = separator != "," and sum(bool(re.fullmatch(r"[-+]?\d+,\d+", c)) for c in cells) > 0
    text_ids: dict[Any, Any] = {i: str for i, n in enumerate(names) if n in _TEXT_IDS}
    try:
        table = pd.read_csv(
            io.StringIO(text),
            sep=separator,
            header=None,
            skiprows=first + 1,
            names=range(len(names)),
            index_col=False,
            usecols=range(len(names)),
            decimal="," if comma else ".",
            dtype=text_ids or None,
            low_memory=False,
            skipinitialspace=True,
        )
    except pd.errors.EmptyDataError:
        raise InputError(f"{path}: no rows under the header") from None
    except (pd.errors.ParserError, ValueError) as e:
        why = str(e).replace("Error tokenizing data. C error: ", "")
        raise InputError(f"{path}: not a regular table: {why}") from None
    table.columns = pd.Index([n or f"unnamed column {i + 1}" for i, n in enumerate(names)])
    return table, first + 2


def _read_mat(path: Path, data: bytes, adapter: Adapter) -> list[Raw]:
    import scipy.io

    try:
        content = scipy.io.loadmat(io.BytesIO(data))
    except Exception as e:  # scipy lets any error of its parser through
        raise InputError(f"{path}: truncated or damaged MATLAB file ({str(e)[:120]})") from None
    arrays: dict[str, np.ndarray] = {}
    for name, value in content.items():
        if not name.startswith("__") and isinstance(value, np.ndarray) and value.dtype.kind in "fiub":
            arrays[name] = value
    if not arrays:
        raise InputError(f"{path}: no numeric variable; save one vector a column (structs and tables are not read)")
    if adapter.layout == "time_value":
        return _time_value(path, arrays, adapter)
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
    return [Raw(path.name, pd.DataFrame({n: v for n, v in vectors.items() if len(v) == size}), _trip_of(path, adapter))]


def _time_value(path: Path, arrays: dict[str, np.ndarray], adapter: Adapter) -> list[Raw]:
    """Each variable is [time, value]; variables of a trip are put on the clock of the longest one."""
    trips: dict[str, dict[str, np.ndarray]] = {}
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
        trips[trip][channel] = array.astype(np.float64)
    if not trips:
        raise InputError(f"{path}: no variable of two columns [time, value] that the adapter {adapter.where} names")
    raws = []
    for trip, channels in trips.items():
        longest = max(channels, key=lambda c: len(channels[c]))
        clock = channels[longest][:, 0]
        table: dict[str, np.ndarray] = {"time_s": clock}
        for channel, a in channels.items():
            same = len(a) == len(clock) and np.array_equal(a[:, 0], clock, equal_nan=True)
            if not same and (len(a) < 2 or not np.all(np.diff(a[:, 0]) > 0)):
                raise InputError(f"{path}: the time of '{channel}' in trip {trip} does not run forward")
            table[channel] = a[:, 1] if same else np.interp(clock, a[:, 0], a[:, 1], left=np.nan, right=np.nan)
        raws.append(Raw(path.name, pd.DataFrame(table), trip))
    return raws


def _with_companion(raw: Raw, path: Path, adapter: Adapter) -> Raw:
    companion = adapter.companion
    assert companion is not None
    beside = path.with_name(stem(path.name) + companion.suffix)
    if not beside.is_file():
        if companion.optional:
            return raw
        raise InputError(
            f"{path}: its companion {beside.name} is not beside it; put it there, "
            f"or say optional = true in {adapter.where}"
        )
    kind = next((f for e, f in ENDINGS.items() if beside.name.lower().endswith(e)), "csv")
    if kind == "mat":
        raise InputError(f"{beside}: a companion is a CSV or Parquet file")
    table, _ = _read_table(beside, read_bytes(beside), kind)
    for where, frame in ((path, raw.table), (beside, table)):
        if companion.on not in frame.columns:
            hint = near(companion.on, [str(c) for c in frame.columns])
            raise InputError(f"{where}: no column '{companion.on}' to join the companion by{hint}")
    if table[companion.on].duplicated().any():
        value = table.loc[table[companion.on].duplicated(), companion.on].iloc[0]
        raise InputError(f"{beside}: the key {companion.on} = {value} appears twice")
    extra = [c for c in table.columns if c == companion.on or c not in raw.table.columns]
    try:
        joined = raw.table.merge(table[extra], on=companion.on, how="left", validate="many_to_one")
    except ValueError as e:
        raise InputError(f"{beside}: cannot be joined by {companion.on} ({str(e)[:120]})") from None
    return Raw(raw.file, joined, raw.trip, raw.vehicle, raw.first_line)
