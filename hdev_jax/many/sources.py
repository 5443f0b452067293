"""Which vehicles there are: whose log each file is, and which sheet describes it."""

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from hdev_jax.errors import InputError
from hdev_jax.logs.readers.names import ending_of
from hdev_jax.textfiles import read_text

__all__ = ["Source", "sources"]

_TABLE = ("vehicle", "sheet")


@dataclass(frozen=True)
class Source:
    """One vehicle: the files of its log in the order of their names, its sheet, and the type that a table gives it.

    `missing`: why the vehicle cannot be analysed, where it has no sheet or no log. `whole`: the files are parts of one
    table, so that a trip may begin in one file and end in the next.
    """

    name: str
    files: tuple[str, ...]
    sheet: str | None
    kind: str | None = None
    missing: str | None = None
    whole: bool = False


def sources(logs: Sequence[str | Path] | str | Path, vehicles: str | Path) -> tuple[list[Source], list[str]]:
    """The vehicles of a fleet, by name, and notes on what was left out.

    **Arguments:** `logs`: files and folders. A file is one vehicle, named as the file without its ending. In a folder,
    each file is a vehicle, and so is each folder of files: `A/` or, as in a partitioned Parquet data set,
    `vehicle_id=A/`. `vehicles`: one sheet for all; a folder of sheets `A.toml`; or a CSV table with the columns
    `vehicle`, `sheet` (a path relative to the table) and, where the sheets' names do not give the type, `type`.

    **Raises:** `InputError` where there is no log or no sheet, or where two vehicles have the same name.
    """
    found: dict[str, tuple[tuple[str, ...], bool]] = {}
    notes: list[str] = []
    for path in map(Path, [logs] if isinstance(logs, str | Path) else logs):
        if path.is_dir():
            each, left = _in_folder(path)
            notes += left
        elif path.is_file():
            each = [(_stem(path), (str(path),), False)]
        else:
            raise InputError(f"{path}: no such file or folder")
        for name, files, whole in each:
            if name in found:
                raise InputError(f"{path}: vehicle {name} is there twice ({found[name][0][0]}); give one log for each")
            found[name] = files, whole
    if not found:
        raise InputError("no vehicle's log among the paths given; a folder with a file for each vehicle is expected")
    sheets, kinds = _sheets(Path(vehicles), list(found))
    out = []
    for name in sorted(found):
        files, whole = found[name]
        none = None if name in sheets else f"vehicle {name}: no sheet for it in {vehicles}"
        out.append(Source(name, files, sheets.get(name), kinds.get(name), none, whole))
    for name in sorted(set(sheets) - set(found)):
        out.append(Source(name, (), sheets[name], kinds.get(name), f"vehicle {name}: a sheet but no log"))
    return out, notes


def _stem(path: Path) -> str:
    return path.name[: len(path.name) - len(ending_of(path.name))] or path.name


def _in_folder(folder: Path) -> tuple[list[tuple[str, tuple[str, ...], bool]], list[str]]:
    """Vehicles in a folder, and a note on what is no log."""
    each: list[tuple[str, tuple[str, ...], bool]] = []
    left = []
    for path in sorted(folder.iterdir()):
        if path.name.startswith((".", "_")):
            continue
        if path.is_dir():
            files = sorted(p for p in path.rglob("*") if p.is_file() and ending_of(p.name))
            if files:
                key, equals, value = path.name.partition("=")
                each.append((value if equals else key, tuple(map(str, files)), bool(equals)))
            else:
                left.append(path.name)
        elif ending_of(path.name):
            each.append((_stem(path), (str(path),), False))
        else:
            left.append(path.name)
    few = ", ".join(left[:5]) + (", …" if len(left) > 5 else "")
    return each, [f"{folder}: {len(left)} of its entries are no logs and were left out: {few}"] if left else []


def _sheets(path: Path, names: Sequence[str]) -> tuple[dict[str, str], dict[str, str]]:
    """Sheets by vehicle, and the types that a table gives."""
    if path.is_dir():
        there = {p.stem: str(p) for p in sorted(path.glob("*.toml"))}
        if not there:
            raise InputError(f"--vehicles {path}: no sheet (.toml) in the folder")
        return there, {}
    if not path.is_file():
        raise InputError(
            f"--vehicles {path}: no such file or folder; a folder of sheets, a sheet or a table is expected"
        )
    if path.suffix.lower() != ".csv":
        return dict.fromkeys(names, str(path)), {}
    rows = list(csv.DictReader(io.StringIO(read_text(path, "table"))))
    columns = tuple(rows[0]) if rows else ()
    if lacks := [c for c in _TABLE if c not in columns]:
        has = ", ".join(map(str, columns)) or "nothing"
        raise InputError(f"table {path}: column {lacks[0]} is missing; it has {has}; vehicle,sheet[,type] is expected")
    sheets: dict[str, str] = {}
    kinds: dict[str, str] = {}
    for k, row in enumerate(rows, start=2):
        name, sheet = ((row[c] or "").strip() for c in _TABLE)
        if not name or not sheet:
            raise InputError(f"table {path}, row {k}: vehicle and sheet are expected, found {name!r}, {sheet!r}")
        if name in sheets:
            raise InputError(f"table {path}, row {k}: vehicle {name} is there twice")
        sheets[name] = str(path.parent / sheet)
        if kind := (row.get("type") or "").strip():
            kinds[name] = kind
    return sheets, kinds
