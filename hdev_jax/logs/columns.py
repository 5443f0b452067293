"""One raw table to the contract's columns in SI: headers parsed, an adapter's rules applied, text or numbers."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from hdev_jax.errors import InputError
from hdev_jax.logs.adapter import Adapter, Rule, near
from hdev_jax.logs.ledger import Ledger
from hdev_jax.logs.readers import Raw
from hdev_jax.logs.repair import fill_forward, fill_linear, fill_nearest
from hdev_jax.units import COLUMNS, NEEDED_STEMS, conversion, parse_column, unit_of

__all__ = ["ColumnInfo", "Piece", "translate"]

_MISSING = {"", "nan", "na", "n/a", "null", "none", "-", "--", "inf", "-inf", "+inf", "infinity", "-infinity", "<na>"}
_BOOLEANS = {"true": 1.0, "false": 0.0, "yes": 1.0, "no": 0.0, "on": 1.0, "off": 0.0}
_CLOCKS = ("time_iso", "timestamp", "datetime", "time", "time_unix")
_NEEDED = tuple(c for c, s in COLUMNS.items() if s in NEEDED_STEMS)


@dataclass(frozen=True)
class ColumnInfo:
    """A row of `hdev check`: the file's column, the unit it came in, the column it became."""

    source: str
    unit: str
    name: str


@dataclass(frozen=True)
class Piece:
    """One table in the contract's columns: float64 arrays, trips as codes into `trip_names`."""

    file: str
    data: dict[str, np.ndarray]
    trip: np.ndarray
    trip_names: tuple[str, ...]
    vehicle: np.ndarray
    vehicle_names: tuple[str, ...]
    row: np.ndarray
    first_line: int
    columns: tuple[ColumnInfo, ...]
    headers: tuple[str, ...]
    ledger: Ledger

    def where(self, i: int) -> str:
        """`row 3 (line 4)` of the i-th row, counted from 1."""
        return _where(int(self.row[i]), self.first_line)


def _where(row: int, first_line: int) -> str:
    return f"row {row + 1}" + (f" (line {row + first_line})" if first_line else "")


def _numbers(raw: Raw, header: str, known: bool) -> np.ndarray | None:
    """The column as float64; None where it is text and the contract does not know it. Raises for stray text."""
    series = raw.table[header]
    if isinstance(series.dtype, pd.CategoricalDtype):
        series = series.astype(series.cat.categories.dtype)
    kind: Any = getattr(series.dtype, "kind", "O")
    if kind in "fiub" and not isinstance(series.dtype, pd.StringDtype):
        return series.to_numpy(dtype=np.float64, na_value=np.nan)
    if kind in "mMc":
        if known:
            raise InputError(f"{raw.file}: column '{header}': numbers are expected, found {series.dtype}")
        return None
    text = series.astype("str").str.strip()
    lower = text.str.lower()
    missing = series.isna() | lower.isin(_MISSING)
    number: Any = pd.to_numeric(text.where(~missing), errors="coerce")
    number = number.astype(np.float64)
    boolean = lower.isin(list(_BOOLEANS))
    if boolean.any() and bool((boolean | missing).all()):
        return lower.map(_BOOLEANS).to_numpy(dtype=np.float64, na_value=np.nan)
    stray = (~missing & number.isna()).to_numpy()
    # infinities written as text are missing values like any other, so they need not come through
    if stray.any():
        if not known and stray.sum() > 0.5 * (~missing).sum():
            return None
        i = int(np.argmax(stray))
        hint = "; a thousands separator or a decimal comma?" if "," in str(text.iloc[i]) else ""
        raise InputError(
            f"{raw.file}: {_where(i, raw.first_line)}, column '{header}': "
            f"a number is expected, found '{text.iloc[i][:40]}'{hint}"
        )
    return number.to_numpy(dtype=np.float64, na_value=np.nan)


def _readable(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _seconds(raw: Raw, header: str) -> np.ndarray:
    """Times as seconds: numbers as they are, ISO 8601 counted from the file's first one."""
    series = raw.table[header]
    if getattr(series.dtype, "kind", "O") == "M" or isinstance(series.dtype, pd.DatetimeTZDtype):
        stamp = pd.to_datetime(series, utc=True)
    else:
        numeric = pd.api.types.is_numeric_dtype(series.dtype)
        sample = series.dropna()
        if numeric or sample.empty or _readable(str(sample.iloc[0])):
            values = _numbers(raw, header, known=True)
            assert values is not None
            return values
        stamp = pd.to_datetime(series, format="ISO8601", utc=True, errors="coerce")
        stray = (stamp.isna() & series.notna()).to_numpy()
        if stray.any():
            i = int(np.argmax(stray))
            raise InputError(
                f"{raw.file}: {_where(i, raw.first_line)}, column '{header}': "
                f"seconds or ISO 8601 are expected, found '{series.iloc[i]}'"
            )
    return np.asarray((stamp - stamp.min()).dt.total_seconds().to_numpy(), dtype=np.float64)


def _labels(raw: Raw, header: str | None, default: str) -> tuple[np.ndarray, tuple[str, ...]]:
    """Codes and names of an id column (−1 where it is missing), or one name for all rows."""
    if header is None or not bool(np.asarray(raw.table[header].notna()).any()):
        return np.zeros(len(raw.table), np.int64), (default,)
    series = raw.table[header]
    codes, names = pd.factorize(series)
    plain = [str(int(n)) if isinstance(n, float) and n.is_integer() else str(n).strip() for n in names]
    if len(set(plain)) < len(plain):  # 'a ' and 'a' are one trip
        unique = list(dict.fromkeys(plain))
        codes = np.where(codes >= 0, np.array([unique.index(p) for p in plain])[codes], -1)
        plain = unique
    return np.asarray(codes, np.int64), tuple(plain)


def translate(raw: Raw, adapter: Adapter) -> Piece:
    """Columns of a raw table under the contract's names in SI. Raises `InputError` (file, row, column, what to do)."""
    headers = [str(c) for c in raw.table.columns]
    raw = Raw(raw.file, raw.table.set_axis(headers, axis=1), raw.trip, raw.vehicle, raw.first_line)
    ids = {}
    for name in ("trip_id", "vehicle_id"):
        rule = adapter.columns.get(name)
        if rule is not None and rule.source not in headers:
            raise InputError(f"{raw.file}: no column '{rule.source}' for {name}{near(rule.source, headers)}")
        ids[name] = rule.source if rule else (name if name in headers else None)
    trip, trip_names = _labels(raw, ids["trip_id"], raw.trip)
    vehicle, vehicle_names = _labels(raw, ids["vehicle_id"], raw.vehicle or "vehicle")
    work = _Work(raw, adapter, headers, trip)
    for name in adapter.columns:
        work.derive(name, ())
    if adapter.others == "keep":
        work.keep_others({c for c in ids.values() if c})
    work.clock()
    return Piece(
        file=raw.file,
        data=work.data,
        trip=trip,
        trip_names=trip_names,
        vehicle=vehicle,
        vehicle_names=vehicle_names,
        row=np.arange(len(trip)),
        first_line=raw.first_line,
        columns=tuple(work.columns),
        headers=tuple(headers),
        ledger=work.ledger,
    )


class _Work:
    """The table under way: what has been translated so far."""

    def __init__(self, raw: Raw, adapter: Adapter, headers: list[str], trip: np.ndarray):
        self.raw, self.adapter, self.headers, self.trip = raw, adapter, headers, trip
        self.data: dict[str, np.ndarray] = {}
        self.columns: list[ColumnInfo] = []
        self.ledger = Ledger()
        self.absent: set[str] = set()

    def note(self, column: str, reason: str, count: int = 0, kind: str = "noted") -> None:
        self.ledger = self.ledger.add(kind, reason, file=self.raw.file, column=column, count=count)

    def derive(self, name: str, above: tuple[str, ...]) -> np.ndarray | None:
        """A rule's column, after the rules it draws on. None where the file lacks the source of an optional column."""
        if name in ("trip_id", "vehicle_id") or name in self.absent:
            return None
        if name in self.data:
            return self.data[name]
        rule = self.adapter.columns[name]
        chained = rule.source in self.adapter.columns and rule.source != name and rule.source not in above
        x = self.derive(rule.source, (*above, name)) if chained else self._source(name, rule)
        if x is None:
            if chained:
                self.note(name, f"made from {rule.source}, which is absent")
            self.absent.add(name)
            return None
        x = self._apply(name, rule, np.array(x, dtype=np.float64))
        self.data[name] = x
        shown = rule.unit or ("" if rule.affine or chained else _own_unit(name))
        self.columns.append(ColumnInfo(rule.source, shown, name))
        return x

    def _source(self, name: str, rule: Rule) -> np.ndarray | None:
        if rule.source in self.headers:
            if name == "time_s":
                return _seconds(self.raw, rule.source)
            return _numbers(self.raw, rule.source, known=True)
        claimed = {r.source for r in self.adapter.columns.values()}
        free = [h for h in self.headers if h not in claimed]
        hint = near(rule.source, free, 0.75)
        if hint or name in _NEEDED:
            hint = hint or near(rule.source, self.headers) or f"; it has {_some(self.headers)}"
            raise InputError(f"{self.raw.file}: no column '{rule.source}' ({name} of {self.adapter.where}){hint}")
        self.note(name, f"the file has no '{rule.source}'")
        return None

    def _apply(self, name: str, rule: Rule, x: np.ndarray) -> np.ndarray:
        x[np.isinf(x)] = np.nan
        if rule.valid is not None:
            with np.errstate(invalid="ignore"):
                out = (x < rule.valid[0]) | (x > rule.valid[1])
            if out.any():
                x[out] = np.nan
                self.note(name, f"outside {list(rule.valid)}, taken as missing", int(out.sum()), "clipped")
        if rule.fill is not None and np.isnan(x).any():
            missing = np.isnan(x)
            fill = {"forward": fill_forward, "nearest": fill_nearest, "linear": fill_linear}[rule.fill]
            x = fill(x, self.trip)
            self.note(name, f"missing, filled ({rule.fill})", int((missing & ~np.isnan(x)).sum()), "filled")
            if rule.initial is not None and np.isnan(x).any():
                self.note(name, f"before the first value, {rule.initial:g} assumed", int(np.isnan(x).sum()), "filled")
                x = np.where(np.isnan(x), rule.initial, x)
        if rule.affine is not None:
            x = rule.affine[0] + rule.affine[1] * x
        if rule.unit is not None:
            x = np.asarray(conversion(name, rule.unit, where=f"{self.adapter.where}: columns.{name}.unit").call(x))
        return x

    def keep_others(self, taken: set[str]) -> None:
        """Columns that no rule names: the contract's are converted, unknown numbers kept, unknown text left out."""
        claimed = taken | {r.source for r in self.adapter.columns.values()}
        claimed |= {self.adapter.companion.on} if self.adapter.companion else set()
        by_rule = set(self.adapter.columns)
        came_from: dict[str, str] = {}
        for header in self.headers:
            if header in claimed or header in ("trip_id", "vehicle_id"):
                continue
            try:
                parsed = parse_column(header)
            except InputError as e:
                raise InputError(f"{self.raw.file}: {e}") from None
            if parsed.name in by_rule:
                self.note(header, f"left out: the adapter makes {parsed.name} itself")
                continue
            if parsed.name in came_from:
                both = f"columns '{came_from[parsed.name]}' and '{header}' are both {parsed.name}"
                raise InputError(f"{self.raw.file}: {both}; remove one")
            if header in _CLOCKS or header.startswith("unnamed column ") or header == "__index_level_0__":
                continue
            if parsed.name == "time_s":
                x: np.ndarray | None = _seconds(self.raw, header)
            else:
                x = _numbers(self.raw, header, parsed.known)
            if x is None:
                self.note(header, "text, left out")
                continue
            came_from[parsed.name] = header
            x = np.asarray(parsed.conversion.call(np.where(np.isinf(x), np.nan, x)), dtype=np.float64)
            self.data[parsed.name] = x
            self.columns.append(ColumnInfo(header, parsed.conversion.unit, parsed.name))
            if not parsed.known:
                hint = near(header, [c for c in COLUMNS if c not in self.headers], 0.85)
                if header in COLUMNS.values():
                    hint = "; its name says no unit, so it is not read as a column of the contract"
                self.note(header, f"unknown column, kept under its own name{hint}")

    def clock(self) -> None:
        """Where no rule made `time_s`: the column of that name, else absolute times by their usual names."""
        if "time_s" in self.data:
            return
        for header in ("time_s", *_CLOCKS):
            if header not in self.headers:
                continue
            numeric = pd.api.types.is_numeric_dtype(self.raw.table[header].dtype)
            if numeric and header not in ("time_s", "time_unix"):
                continue  # a number without a unit
            x = _seconds(self.raw, header)
            self.data["time_s"] = np.where(np.isinf(x), np.nan, x)
            self.columns.append(ColumnInfo(header, "s" if numeric else "ISO 8601", "time_s"))
            return


def _own_unit(name: str) -> str:
    """The suffix of a name that ends in a unit."""
    return name.rpartition("_")[2] if unit_of(name) not in (None, "dimensionless") else ""


def _some(names: list[str]) -> str:
    return ", ".join(names[:8]) + (", …" if len(names) > 8 else "")
