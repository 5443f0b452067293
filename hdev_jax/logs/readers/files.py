"""Which files are logs, what they hold, and every way in which a file is not what it claims told in one line."""

import gzip
import zlib
from dataclasses import replace
from pathlib import Path

from hdev_jax.errors import InputError
from hdev_jax.logs.adapter import Adapter, near
from hdev_jax.logs.readers.binary import read_binary
from hdev_jax.logs.readers.matlab import read_mat
from hdev_jax.logs.readers.names import ENDINGS, SIGNALS, ending_of, stem, trip_of
from hdev_jax.logs.readers.raw import Raw
from hdev_jax.logs.readers.signals import read_signals
from hdev_jax.logs.readers.steps import read_steps
from hdev_jax.logs.readers.text import read_text

__all__ = ["find_files", "format_of", "read_bytes", "read_raw"]

_MAGIC = {
    b"\x1f\x8b": "gzip",
    b"PAR1": "Parquet",
    b"ARROW1": "Feather",
    b"MATLAB": "MATLAB",
    b"\x89HDF": "HDF5",
    b"PK": "zip (or xlsx)",
}
_CONTENT = {
    "csv": "text",
    "jsonl": "text",
    "xml": "text",
    "parquet": "Parquet",
    "feather": "Feather",
    "xlsx": "zip (or xlsx)",
    "mat": "MATLAB",
}
_NOT_ALWAYS_LOGS = (".txt", ".txt.gz", ".xlsx", ".xml")  # in a folder of logs these are notes, tables, set-ups


def format_of(path: Path, adapter: Adapter) -> str:
    """The format by the ending, or as the adapter says. Raises `InputError` where they disagree."""
    by_ending = ENDINGS.get(ending_of(path.name))
    if by_ending is None and adapter.format is None:
        raise InputError(f"{path}: unknown ending; a log ends in {', '.join(e for e in ENDINGS if '.gz' not in e)}")
    if by_ending and adapter.format and by_ending != adapter.format:
        raise InputError(f"{path}: the adapter {adapter.where} is for {adapter.format} files")
    return adapter.format or by_ending or "csv"


def find_files(paths: list[Path], adapter: Adapter) -> tuple[list[Path], dict[str, str]]:
    """Log files in the order given (a folder stands for the logs in it), and by name why others were left out."""
    files: list[Path] = []
    left: dict[str, str] = {}
    for path in paths:
        if path.is_dir():
            inside = _in_folder(path, adapter, left)
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


def _in_folder(folder: Path, adapter: Adapter, left: dict[str, str]) -> list[Path]:
    endings = tuple(e for e, f in ENDINGS.items() if adapter.format in (None, f))
    inside = sorted(p for p in folder.iterdir() if p.is_file() and p.name.lower().endswith(endings))
    if not inside:
        shown = ", ".join(e for e in endings if ".gz" not in e)
        raise InputError(f"{folder}: no log in this folder; a log ends in {shown}")
    sure = [p for p in inside if not p.name.lower().endswith(_NOT_ALWAYS_LOGS)]
    if sure and len(sure) < len(inside) and adapter.format is None:
        why = "in a folder of logs of other kinds: left out; name it to read it"
        left |= {p.name: why for p in inside if p not in sure}
        return sure
    return inside


def _names_a_trip(path: Path, adapter: Adapter) -> bool:
    """Whether the file's name has what the adapter takes its trip from; variables name the trips of `time_value`."""
    by_name = adapter.trip_id is not None and adapter.layout != "time_value"
    return not by_name or adapter.match(adapter.trip_id or "", path.name) is not None


def read_raw(path: Path, adapter: Adapter) -> list[Raw]:
    """The tables of a file (a MATLAB file of layout `time_value` may hold several trips), companion joined."""
    kind = format_of(path, adapter)
    if kind == "mat":
        raws = read_mat(path, read_bytes(path, kind), adapter)
    elif kind in SIGNALS:
        raws = [read_signals(path, kind, adapter)]
    else:
        raws = [_table(path, kind, adapter, trip_of(path, adapter))]
    if any(r.table.empty and not r.channels for r in raws):
        raise InputError(f"{path}: no rows")
    vehicle = None
    if adapter.vehicle_id is not None:
        vehicle = adapter.match(adapter.vehicle_id, path.name)
        if vehicle is None:
            raise InputError(f"{path}: vehicle_id = {adapter.vehicle_id!r} of {adapter.where} does not match its name")
    raws = [replace(r, vehicle=vehicle) for r in raws]
    return [_with_companion(r, path, adapter) for r in raws] if adapter.companion else raws


def _table(path: Path, kind: str, adapter: Adapter, trip: str) -> Raw:
    data = read_bytes(path, kind)
    if kind == "xml":
        table, ledger = read_steps(path, data)
        return Raw(path.name, table, trip, ledger=ledger)
    if kind != "csv":
        return Raw(path.name, read_binary(path, data, kind), trip)
    text = read_text(path, data, adapter)
    return Raw(
        path.name, text.table, trip, lines=text.lines, units=text.units, thousands=adapter.thousands, ledger=text.ledger
    )


def read_bytes(path: Path, kind: str = "csv") -> bytes:
    """A file's content, unzipped; refuses what its ending (without a known one, `kind`) does not promise."""
    try:
        data = path.read_bytes()
    except OSError as e:
        raise InputError(f"{path}: cannot be read ({e.strerror or e})") from None
    if not data:
        raise InputError(f"{path}: empty file")
    ending = ending_of(path.name)
    expected = _CONTENT[ENDINGS.get(ending, kind)]
    if ending.endswith(".gz"):
        if (found := _content(data)) != "gzip":
            raise InputError(f"{path}: its ending says {ending} (gzip), its content is {found}")
        data = _gunzip(path, data)
    elif _content(data) == "gzip" and not ending:
        data = _gunzip(path, data)
    found = _content(data)
    if expected == "MATLAB" and found == "HDF5":
        return data
    if expected == "text" and data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        raise InputError(f"{path}: UTF-16 text; save it as UTF-8")
    if expected != found:
        raise InputError(f"{path}: its ending says {ending or kind} ({expected}), its content is {found}")
    return data


def _content(data: bytes) -> str:
    return next((n for m, n in _MAGIC.items() if data.startswith(m)), "text" if b"\0" not in data[:4096] else "binary")


def _gunzip(path: Path, data: bytes) -> bytes:
    try:
        data = gzip.decompress(data)
    except (EOFError, zlib.error, OSError) as e:
        raise InputError(f"{path}: truncated or damaged gzip file ({e}); fetch it again") from None
    if not data:
        raise InputError(f"{path}: empty file")
    return data


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
    kind = ENDINGS.get(ending_of(beside.name), "csv")
    if kind in ("mat", *SIGNALS):
        raise InputError(f"{beside}: a companion is a table of text, Parquet, Feather or xlsx")
    table = _table(beside, kind, replace(adapter, header_line=None), raw.trip).table
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
    return replace(raw, table=joined)
