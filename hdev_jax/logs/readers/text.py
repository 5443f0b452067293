"""Text tables: every line counted and accounted for, decimal commas found wherever they begin."""

import csv
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from hdev_jax.errors import InputError
from hdev_jax.logs.adapter import Adapter
from hdev_jax.logs.ledger import Ledger
from hdev_jax.logs.limits import BAD_SHARE
from hdev_jax.logs.readers.layout import COMMENT, Layout, layout_of, split

__all__ = ["Text", "check_header", "read_text"]

_TEXT_IDS = ("trip_id", "vehicle_id")
_ENOUGH, _ASKED = 10, 2000  # decimals without trailing zeros: one in ten has fewer than three digits


@dataclass(frozen=True)
class Text:
    """A table read from text, the line of each row, what its row of units says, and what was left out."""

    table: pd.DataFrame
    lines: Sequence[int]
    units: dict[str, str]
    ledger: Ledger


@dataclass(frozen=True)
class _Records:
    """What stands under the header, one entry a record: its first and last line from 1, how many fields it has, whether
    the last is empty, and what it is: 0 values, 1 a comment, 2 the header once more, 3 the row of units once more."""

    start: np.ndarray
    end: np.ndarray
    fields: np.ndarray
    empty: np.ndarray
    odd: np.ndarray


def check_header(path: Path, names: Sequence[str]) -> None:
    """Refuse two columns of one name."""
    twice = sorted({n for n in names if n and list(names).count(n) > 1})
    if twice:
        raise InputError(f"{path}: column '{twice[0]}' appears twice; rename or remove one")


def read_text(path: Path, data: bytes, adapter: Adapter) -> Text:
    """The table of a text file. Raises `InputError` naming file, line, what was found and what to do."""
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = data.decode("cp1252", errors="replace")  # what spreadsheets write where it is not UTF-8
    if "\r" in text and "\n" not in text:
        text = text.replace("\r", "\n")
    lines = text.split("\n")
    try:
        layout = layout_of(path, text, adapter.header_line)
        check_header(path, layout.names)
        records = _records(text, lines, layout)
    except csv.Error as e:
        if line := next((i for i, x in enumerate(lines, 1) if "\r" in x.rstrip("\r")), 0):
            what = "a carriage return within the line, where other lines end in a line feed"
            raise InputError(f"{path}, line {line}: {what}; write the file with one kind of line end") from None
        raise InputError(f"{path}: not a regular table: {e}") from None
    records, ledger = _kept(path, lines, records, layout)
    body = _body(text, lines, records, layout)
    comma = adapter.decimal == "," if adapter.decimal else _has_decimal_commas(body, layout.separator)
    if comma and adapter.thousands is None:
        _check_thousands(path, body, layout, records.start)
    table = _frame(path, body, layout, comma, as_text=adapter.thousands is not None)
    if len(table) != len(records.start):  # pandas and csv disagree about quotes: no line could be named rightly
        raise InputError(f"{path}: not a regular table: quotes that do not close, or a quote inside a field")
    if adapter.decimal is None and not comma:
        _ask_about_groups(path, table, lines, layout, records.start)
    named = [n or f"unnamed column {i + 1}" for i, n in enumerate(layout.names)]
    table.columns = pd.Index(named)
    units = {n: u for n, u in zip(named, layout.units or (), strict=False) if u not in ("", "-")}
    contiguous = len(records.start) == records.start[-1] - records.start[0] + 1
    at = range(int(records.start[0]), int(records.start[-1]) + 1) if contiguous else records.start.tolist()
    return Text(table, at, units, ledger)


def _records(text: str, lines: list[str], layout: Layout) -> _Records:
    """Every record under the header that is not blank."""
    separator = layout.separator
    if '"' in text:  # a quoted field may hold separators and line breaks
        start, end, fields, empty, last = [], [], [], [], 0
        reader = csv.reader((line + "\n" for line in lines[layout.first :]), delimiter=separator)
        for row in reader:
            if row and (len(row) > 1 or row[0].strip()):
                start.append(layout.first + last + 1)
                end.append(layout.first + reader.line_num)
                fields.append(len(row))
                empty.append(not row[-1].strip())
            last = reader.line_num
        starts, ends = np.array(start, np.int64), np.array(end, np.int64)
        counts, blank = np.array(fields, np.int64), np.array(empty, bool)
    else:
        starts, counts, blank = _plain_records(text, separator, layout.first)
        ends = starts
    return _Records(starts, ends, counts, blank, _odd(text, lines, starts, ends, layout))


def _plain_records(text: str, separator: str, first: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Line, number of fields and whether the last is empty, of each line after `first` that is not blank: counted in
    bytes, all lines at once, since each is one record where nothing is quoted."""
    data = np.frombuffer(text.encode() + b"\n", np.uint8)
    ends = np.flatnonzero((data == ord("\n")) | (data == ord(separator)))  # of fields
    last = np.flatnonzero(data[ends] == ord("\n"))
    counts = np.diff(last, prepend=-1)
    end = ends[last]
    begin = np.r_[0, end[:-1] + 1]
    more = np.arange(len(end))
    while (more := more[(end[more] > begin[more]) & np.isin(data[end[more] - 1], [ord("\r"), ord(" ")])]).size:
        end[more] -= 1
    keep = np.flatnonzero(end > begin)
    keep = keep[keep >= first]
    return keep + 1, counts[keep], data[end[keep] - 1] == ord(separator)


def _odd(text: str, lines: list[str], start: np.ndarray, end: np.ndarray, layout: Layout) -> np.ndarray:
    """1 for a comment, 2 for the header once more, 3 for the row of units once more, 0 for values."""
    odd = np.zeros(len(start), np.int8)
    heads = {lines[layout.header].strip(): 2}
    if layout.units is not None:
        heads[lines[layout.first - 1].strip()] = 3
    if f"\n{COMMENT}" not in text and all(text.count(h) < 2 for h in heads):
        return odd
    for i in np.flatnonzero(start == end):
        line = lines[start[i] - 1].strip()
        odd[i] = 1 if line.startswith(COMMENT) else heads.get(line, 0)
    return odd


def _kept(path: Path, lines: list[str], records: _Records, layout: Layout) -> tuple[_Records, Ledger]:
    """Records that hold values; comments, repeated headers and a few cut lines are left out and counted.

    A line with more fields than the header ends the reading, since what follows the surplus would be read as another
    column; so do many with fewer, and a last one with fewer: a file that was cut off.
    """
    ledger = Ledger()
    if layout.before:
        ledger = ledger.add("noted", f"the header is line {layout.header + 1}", count=layout.before, file=path.name)
    if layout.units is not None:
        ledger = ledger.add("noted", "a row of units under the header, used as such", file=path.name)
    for code, what in ((1, f"a line that begins with {COMMENT}"), (2, "the header once more"), (3, "the units again")):
        if count := int((records.odd == code).sum()):
            ledger = ledger.add("noted", f"{what}: no values", count=count, file=path.name)
    records = _take(records, records.odd == 0)
    n, fields, sep = len(layout.names), records.fields, layout.separator
    if not len(fields):
        raise InputError(f"{path}: no rows under the header")
    # a separator at the end of every line is harmless and common
    many = np.flatnonzero(fields > n + records.empty)
    if len(many):
        more = f" ({len(many):,} such lines)" if len(many) > 1 else ""
        raise InputError(
            f"{path}: line {records.start[many[0]]} has {fields[many[0]]} fields, the header {n}{more}; a {sep!r} in a "
            "number or a text? Put quotes around it, or write the file without"
        )
    few = fields < n
    first = int(np.argmax(few))
    if few[0] or few.sum() > BAD_SHARE * len(few):
        more = f" ({int(few.sum()):,} such lines)" if few.sum() > 1 else ""
        raise InputError(
            f"{path}: line {records.start[first]} has {fields[first]} fields, the header {n}{more}; write empty fields "
            "too, so that no value moves to another column"
        )
    if few[-1]:
        raise InputError(f"{path}: the last line has {fields[-1]} fields, the header {n}; the file is truncated")
    if few.any():
        why = f"fewer fields than the header's {n}; the first is line {records.start[first]}"
        ledger = ledger.add("dropped", why, count=int(few.sum()), file=path.name)
        records = _take(records, ~few)
    return records, ledger


def _take(records: _Records, keep: np.ndarray) -> _Records:
    if keep.all():
        return records
    parts = (records.start, records.end, records.fields, records.empty, records.odd)
    return _Records(*(x[keep] for x in parts))


def _body(text: str, lines: list[str], records: _Records, layout: Layout) -> str:
    """The lines of the records, as one text."""
    between = np.ones(len(lines) - layout.first, bool)
    for a, b in zip(records.start, records.end, strict=True) if (records.end > records.start).any() else ():
        between[a - 1 - layout.first : b - layout.first] = False
    if (records.end == records.start).all():
        between[records.start - 1 - layout.first] = False
    if not any(lines[layout.first + k].rstrip("\r") for k in np.flatnonzero(between)):
        place = -1
        for _ in range(layout.first):
            place = text.index("\n", place + 1)
        return text[place + 1 :]
    return "\n".join("\n".join(lines[a - 1 : b]) for a, b in zip(records.start, records.end, strict=True)) + "\n"


def _has_decimal_commas(body: str, separator: str) -> bool:
    """Whether any field is a number with a comma; among fields separated by commas one that is no group of three."""
    if separator == ",":
        certain = r'"\s*[-+]?(?:\d+,(?:\d{1,2}|\d{4,})|0\d*,\d+|\d{4,},\d+)\s*"'
        return '"' in body and re.search(certain, body) is not None
    edge = re.escape(separator)
    return re.search(rf'(?m)(?:^|(?<={edge}))\s*"?[-+]?\d+,\d+"?\s*(?=[{edge}\r\n]|$)', body) is not None


def _check_thousands(path: Path, body: str, layout: Layout, at: np.ndarray) -> None:
    """Refuse `14.288` in a file with decimal commas: fourteen thousand there, fourteen to a reader of points."""
    edge = re.escape(layout.separator)
    pattern = rf'(?m)(?:^|(?<={edge}))\s*"?([-+]?\d{{1,3}}(?:\.\d{{3}})+)"?\s*(?=[{edge}\r\n]|$)'
    found = re.search(pattern, body)
    if found is None:
        return
    before = body[: found.start(1)]
    row = sum(bool(line.strip()) for line in before.split("\n")[:-1])
    column = min(before[before.rfind("\n") + 1 :].count(layout.separator), len(layout.names) - 1)
    raise InputError(
        f"{path}: line {at[min(row, len(at) - 1)]}, column '{layout.names[column]}': {found.group(1)} in a file with "
        'decimal commas: a thousands separator? Say thousands = "." (or decimal = ".") in an adapter, or write the '
        "file without"
    )


def _ask_about_groups(path: Path, table: pd.DataFrame, lines: list[str], layout: Layout, at: np.ndarray) -> None:
    """Refuse a column of `600` and `14.288` whose every point stands before three digits: points between thousands?

    A column of decimals has one of other length, or a 0 before the point, among a few.
    """
    for k in table.columns:
        if table[k].dtype.kind != "f":
            continue
        x = table[k].to_numpy()
        broken = np.flatnonzero(np.isfinite(x) & (x != np.round(x)))
        large = np.flatnonzero((np.abs(x) >= 100) & (x == np.round(x)))
        if len(broken) < _ENOUGH or not len(large) or np.nanmax(np.abs(x)) >= 1000.0:
            continue

        def fit(rows: np.ndarray, pattern: str, k: int = k) -> bool:
            cells = (split(lines[at[i] - 1], layout.separator)[k] for i in rows[:_ASKED])
            return all(re.fullmatch(pattern, c) for c in cells)

        if fit(large, r"[-+]?\d{3}") and fit(broken, r"[-+]?[1-9]\d{0,2}\.\d{3}"):
            i = int(broken[0])
            raise InputError(
                f"{path}: line {at[i]}, column '{layout.names[k]}': {x[i]:.3f} beside whole numbers, and each point "
                'before three digits: is it between thousands? Say thousands = "." or decimal = "." in an adapter'
            )


def _frame(path: Path, body: str, layout: Layout, comma: bool, *, as_text: bool) -> pd.DataFrame:
    names = layout.names
    text_ids: dict[Any, Any] = {i: str for i, n in enumerate(names) if n in _TEXT_IDS}
    try:
        return pd.read_csv(
            io.StringIO(body),
            sep=layout.separator,
            header=None,
            names=range(len(names)),
            index_col=False,
            usecols=range(len(names)),
            decimal="," if comma else ".",
            dtype=str if as_text else text_ids or None,
            low_memory=False,
            skipinitialspace=True,
        )
    except pd.errors.EmptyDataError:
        raise InputError(f"{path}: no rows under the header") from None
    except (pd.errors.ParserError, ValueError) as e:
        why = str(e).replace("Error tokenizing data. C error: ", "")
        raise InputError(f"{path}: not a regular table: {why}") from None
