"""Files in: bytes to raw tables, every way in which a file is not what it claims reported in one line."""

import csv
import gzip
import io
import re
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from hdev_jax.errors import InputError
from hdev_jax.logs.adapter import Adapter, near
from hdev_jax.logs.matlab import read_mat
from hdev_jax.logs.names import ENDINGS, stem, trip_of

__all__ = ["Raw", "find_files", "read_bytes", "read_raw"]

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


def _format(path: Path, adapter: Adapter) -> str:
    by_ending = next((f for e, f in ENDINGS.items() if path.name.lower().endswith(e)), None)
    if by_ending is None and adapter.format is None:
        raise InputError(f"{path}: unknown ending; a log ends in {', '.join(ENDINGS)}")
    if by_ending and adapter.format and by_ending != adapter.format:
        raise InputError(f"{path}: the adapter {adapter.where} is for {adapter.format} files")
    return adapter.format or by_ending or "csv"


def find_files(paths: list[Path], adapter: Adapter) -> tuple[list[Path], dict[str, str]]:
    """Log files in the order given (a folder stands for the logs in it), and by name why others were left out."""
    files: list[Path] = []
    left: dict[str, str] = {}
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
        joined = "companion, joined to its log and no log itself"
        left |= {p.name: joined for p in inside if adapter.is_companion(p.name)}
        inside = [p for p in inside if not adapter.is_companion(p.name)]
        named = [p for p in inside if _names_a_trip(p, adapter)] if path.is_dir() else inside
        if named:  # where no name does, reading the first says so
            other = "in the folder, but its name is not that of a trip (trip_id): left out"
            left |= {p.name: other for p in inside if p not in named}
        files += named or inside
    if not files:
        raise InputError(f"no log among {len(paths)} path(s): {len(left)} companion file(s) only")
    seen: set[Path] = set()
    for path in files:
        if (real := path.resolve()) in seen:
            raise InputError(f"{path}: given twice")
        seen.add(real)
    return files, left


def _names_a_trip(path: Path, adapter: Adapter) -> bool:
    """Whether the file's name has what the adapter takes its trip from; variables name the trips of `time_value`."""
    by_name = adapter.trip_id is not None and adapter.layout == "table"
    return not by_name or adapter.match(adapter.trip_id or "", path.name) is not None


def read_raw(path: Path, adapter: Adapter) -> list[Raw]:
    """The tables of a file (a MATLAB file of layout `time_value` may hold several trips), companion joined."""
    kind = _format(path, adapter)
    data = read_bytes(path, kind)
    if kind == "mat":
        raws = [Raw(path.name, table, trip) for trip, table in read_mat(path, data, adapter).items()]
    else:
        table, first_line = _read_table(path, data, kind)
        raws = [Raw(path.name, table, trip_of(path, adapter), first_line=first_line)]
    if any(r.table.empty for r in raws):
        raise InputError(f"{path}: no rows")
    vehicle = None
    if adapter.vehicle_id is not None:
        vehicle = adapter.match(adapter.vehicle_id, path.name)
        if vehicle is None:
            raise InputError(f"{path}: vehicle_id = {adapter.vehicle_id!r} of {adapter.where} does not match its name")
    raws = [Raw(r.file, r.table, r.trip, vehicle, r.first_line) for r in raws]
    return [_with_companion(r, path, adapter) for r in raws] if adapter.companion else raws


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


def _fields(text: str, separator: str) -> Iterator[tuple[int, int, bool]]:
    """Number of each line that is not blank, how many fields it has, and whether the last is empty."""
    if '"' in text:  # a quoted field may hold separators and line breaks
        reader = csv.reader(io.StringIO(text, newline=""), delimiter=separator)
        for row in reader:
            if row:
                yield reader.line_num, len(row), not row[-1]
        return
    for k, line in enumerate(text.split("\n"), 1):
        if line := line.rstrip("\r "):
            yield k, line.count(separator) + 1, line.endswith(separator)


def _check_fields(path: Path, text: str, separator: str, fields: int, header: int) -> None:
    """Refuse lines with more fields than the header, since what follows the surplus would be read as another column,
    and a first or last line with fewer: a file that was cut off."""
    try:
        counts = [found for found in _fields(text, separator) if found[0] > header]
    except csv.Error as e:
        raise InputError(f"{path}: not a regular table: {e}") from None
    # a separator at the end of every line is harmless and common
    odd = [(k, n) for k, n, empty in counts if n > fields + empty]
    if odd:
        more = f" ({len(odd):,} such lines)" if len(odd) > 1 else ""
        raise InputError(
            f"{path}: line {odd[0][0]} has {odd[0][1]} fields, the header {fields}{more}; a {separator!r} in a number "
            "or a text? Put quotes around it, or write the file without"
        )
    (first, n, _), last = counts[0], counts[-1][1]
    if n < fields:
        raise InputError(f"{path}: line {first} has {n} fields, the header {fields}")
    if last < fields:
        raise InputError(f"{path}: the last line has {last} fields, the header {fields}; the file is truncated")


def _check_thousands(path: Path, text: str, separator: str, names: list[str]) -> None:
    """Refuse `14.288` in a file with decimal commas: fourteen thousand there, fourteen to a reader of points."""
    start, end = rf"(?m)(?:^|(?<={separator}))", rf"(?=[{separator}\r\n]|$)"
    for found in re.finditer(start + r"[-+]?\d{1,3}(?:\.\d{3})+" + end, text):
        line = text.count("\n", 0, found.start())
        column = text[text.rfind("\n", 0, found.start()) + 1 : found.start()].count(separator)
        raise InputError(
            f"{path}: line {line + 1}, column '{names[min(column, len(names) - 1)]}': {found.group()} in a file with "
            "decimal commas: a thousands separator? Write the file without"
        )


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
    _check_fields(path, text, separator, len(names), first + 1)
    cells = [c for line in rows for c in _split(line, separator)]
    comma = separator != "," and sum(bool(re.fullmatch(r"[-+]?\d+,\d+", c)) for c in cells) > 0
    if comma:
        _check_thousands(path, text, separator, names)
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
