"""What the service is given: rows of a request, and the sheets of its vehicles."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from hdev_jax.errors import InputError
from hdev_jax.inference.sheet import Sheet, read_sheet
from hdev_jax.physics import LIBRARY, Effect

__all__ = ["RefusedError", "checked", "sheets_in"]

LONGEST_NAME = 200
MOST_FIELDS = 64
HUGE = 1e300  # NaN, infinity and integers that no float holds are no numbers
TEXTS = ("vehicle_id", "trip_id")


class RefusedError(Exception):
    """A batch of which nothing was kept: `where`, the row and its field; `why`, what was expected."""

    def __init__(self, where: list[str | int], why: str):
        super().__init__(f"{'.'.join(map(str, where))}: {why}")
        self.where: list[str | int] = where
        self.why: str = why


def checked(rows: Any) -> list[tuple[str, str, float, dict[str, Any]]]:
    """Rows of a request as the journal takes them. Raises `RefusedError` at the first field that is something else."""
    if not isinstance(rows, list):
        raise RefusedError(["rows"], "a list of rows is expected")
    out = []
    for i, row in enumerate(rows):
        if not isinstance(row, dict):
            raise RefusedError(["rows", i], "an object with vehicle_id, trip_id, time_s and channels is expected")
        for name in TEXTS:
            value = row.get(name, "" if name == "trip_id" else None)
            if isinstance(value, bool) or not isinstance(value, str | int):
                raise RefusedError(["rows", i, name], "a text is expected")
            text = str(value)
            if (name == "vehicle_id" and not text.strip()) or len(text) > LONGEST_NAME or not text.isprintable():
                raise RefusedError(["rows", i, name], f"1 to {LONGEST_NAME} printable characters are expected")
            if name == "vehicle_id" and "/" in text:
                raise RefusedError(["rows", i, name], "a name without / is expected: it is part of an address")
        if len(row) > MOST_FIELDS:
            raise RefusedError(["rows", i], f"at most {MOST_FIELDS} fields are expected")
        for name, value in row.items():
            if name in TEXTS or value is None:
                continue
            if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < HUGE:
                raise RefusedError(["rows", i, name], "a finite number is expected, or null")
        if row.get("time_s") is None:
            raise RefusedError(["rows", i, "time_s"], "the time of the row in seconds is expected")
        body = {k: v for k, v in row.items() if k not in TEXTS}
        out.append((str(row["vehicle_id"]), str(row.get("trip_id", "")), float(row["time_s"]), body))
    return out


def sheets_in(folder: str | Path, library: Mapping[str, type[Effect]] = LIBRARY) -> Callable[[str, str], Sheet]:
    """The sheet of a vehicle: FOLDER/FLEET/VEHICLE.toml, FOLDER/VEHICLE.toml, or `default.toml` in place of it;
    `library`: the effects that sheets may declare and that are watched."""
    root = Path(folder).resolve()
    if not root.is_dir():
        raise InputError(f"--sheets {folder}: no such folder")
    there = {p.relative_to(root).as_posix(): read_sheet(p, library=library) for p in sorted(root.rglob("*.toml"))}
    if not there:
        raise InputError(f"--sheets {folder}: holds no .toml; a sheet for each vehicle, or default.toml, is expected")

    def sheet_for(fleet: str, vehicle: str) -> Sheet:
        for name in (f"{fleet}/{vehicle}.toml", f"{vehicle}.toml", f"{fleet}/default.toml", "default.toml"):
            if (sheet := there.get(name)) is not None:
                return sheet
        raise InputError(f"no sheet for vehicle {vehicle!r}: {vehicle}.toml or default.toml is expected in --sheets")

    return sheet_for
