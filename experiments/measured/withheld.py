"""A known channel taken out of a log by its adapter alone, and the check that nothing else changed."""

import tomllib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from hdev_jax.errors import InputError
from hdev_jax.logs import Log, read_log

__all__ = ["WITHHELD", "compare_logs", "without_columns", "write_adapter"]

# What is withheld, by the name of the run: the words for it, and the columns that say it.
WITHHELD: dict[str, tuple[str, tuple[str, ...]]] = {
    "temperature": ("outside temperature", ("ambient_temp_c",)),
    "passengers": ("number of passengers", ("passengers",)),
    "steering": ("steering", ("steering_angle_rad", "articulation_angle_rad")),
}


def without_columns(adapter: Mapping[str, Any], names: Iterable[str]) -> dict[str, Any]:
    """An adapter's table without these columns and without every other column made from the same source.

    A mass that is computed from the passengers would give them away, so it goes with them. Raises `InputError` for a
    name that the adapter does not make, and where columns that no rule names are kept: the source would come through.
    """
    rules = {k: {"source": r} if isinstance(r, str) else r for k, r in adapter.get("columns", {}).items()}
    if adapter.get("others", "keep") != "drop":
        raise InputError('a column can be withheld only where the adapter says others = "drop"')
    if missing := [n for n in names if n not in rules]:
        raise InputError(f"the adapter makes no column {', '.join(missing)}; it makes {', '.join(rules)}")

    def raw(name: str) -> str:
        source = rules[name]["source"]
        return raw(source) if source in rules and source != name else source

    gone = {raw(n) for n in names}
    return {**adapter, "columns": {k: r for k, r in adapter["columns"].items() if raw(k) not in gone}}


def write_adapter(base: Path, names: Sequence[str], out: Path, *, drop_others: bool = False) -> Path:
    """The base adapter without these columns, as a file. Written only where it differs, so that a run can resume.

    `drop_others`: columns that no rule names go too, where the base adapter keeps them.
    """
    adapter = tomllib.loads(base.read_text(encoding="utf-8"))
    table = without_columns({**adapter, "others": "drop"} if drop_others else adapter, names)
    text = f"# {base.name} without {', '.join(names)} and what is made from the same source.\n" + tomli_w.dumps(table)
    if not out.exists() or out.read_text(encoding="utf-8") != text:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(text, encoding="utf-8")
    return out


def compare_logs(files: Sequence[Path], full: Path, partial: Path) -> dict[str, Any]:
    """Read every file with both adapters, one file at a time. Raises `InputError` unless only columns are missing.

    **Returns:** plain values: `rows`, `trips`, the `gone` columns, the `same` columns (equal in every row), and how
    many `ledger` entries, of columns that stayed or of none, are the same in both.
    """
    rows, trips, ledger = 0, 0, 0
    gone: set[str] = set()
    same: set[str] = set()
    for file in files:
        a, b = read_log(file, full), read_log(file, partial)
        left, right = _columns(a), _columns(b)
        gone |= set(left) - set(right)
        same |= set(right)
        entries = [e for e in a.ledger.entries if e.column not in set(left) - set(right)]
        equal = all(k in left and np.array_equal(v, left[k], equal_nan=True) for k, v in right.items())
        if a.trip_names != b.trip_names or not equal or entries != list(b.ledger.entries):
            raise InputError(f"{file.name}: withholding changed more than the columns withheld")
        rows, trips, ledger = rows + len(b), trips + len(b.trip_names), ledger + len(entries)
    return {"rows": rows, "trips": trips, "gone": sorted(gone), "same": sorted(same), "ledger": ledger}


def _columns(log: Log) -> dict[str, np.ndarray]:
    """Everything that a log holds by row: motion, channels and what was measured at the battery."""
    s = log.segments
    motion = ("trip", "time_s", "duration_s", "distance_m", "speed_start_mps", "speed_end_mps")
    columns = {**{k: getattr(s, k) for k in motion}, **s.channels, **log.measured}
    return {k: np.asarray(v) for k, v in columns.items()}
