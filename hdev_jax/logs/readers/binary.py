"""Tables that libraries read: Parquet, Feather, JSON lines, Excel."""

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pandas as pd

from hdev_jax.errors import InputError
from hdev_jax.logs.readers.libraries import library
from hdev_jax.logs.readers.text import check_header

__all__ = ["read_binary"]


def read_binary(path: Path, data: bytes, kind: str) -> pd.DataFrame:
    """The table of a file of a kind. Raises `InputError` where it is damaged, or its library is not installed."""
    return {"parquet": _parquet, "feather": _feather, "jsonl": _json_lines, "xlsx": _excel}[kind](path, data)


def _parquet(path: Path, data: bytes) -> pd.DataFrame:
    import pyarrow.parquet

    return _arrow(path, "Parquet", lambda: pyarrow.parquet.read_table(io.BytesIO(data)))


def _feather(path: Path, data: bytes) -> pd.DataFrame:
    import pyarrow.feather

    return _arrow(path, "Feather", lambda: pyarrow.feather.read_table(io.BytesIO(data)))


def _arrow(path: Path, kind: str, read: Callable[[], Any]) -> pd.DataFrame:
    """The frame of a table of Arrow. Raises `InputError` where it is damaged or has a column twice."""
    import pyarrow

    try:
        table = read()
        check_header(path, list(table.column_names))
        return table.to_pandas(ignore_metadata=True)
    except (pyarrow.ArrowException, OSError, ValueError) as e:
        raise InputError(f"{path}: truncated or damaged {kind} file ({str(e)[:120]})") from None


def _json_lines(path: Path, data: bytes) -> pd.DataFrame:
    import pyarrow
    import pyarrow.json

    try:
        table = pyarrow.json.read_json(io.BytesIO(data))
    except (pyarrow.ArrowException, OSError, ValueError) as e:
        raise InputError(f"{path}: not one JSON object a line ({str(e)[:120]})") from None
    nested = [f.name for f in table.schema if pyarrow.types.is_nested(f.type)]
    if nested:
        raise InputError(f"{path}: '{nested[0]}' holds objects or lists; one number or text a key is expected")
    return table.to_pandas(ignore_metadata=True)


def _excel(path: Path, data: bytes) -> pd.DataFrame:
    openpyxl = library("openpyxl", path, "formats", "save the sheet as CSV")
    try:
        book = openpyxl.load_workbook(io.BytesIO(data), read_only=True, data_only=True)
        sheets = [[list(row) for row in sheet.iter_rows(values_only=True)] for sheet in book.worksheets]
    except Exception as e:  # a damaged workbook fails in zipfile, in the XML parser or in openpyxl itself
        raise InputError(f"{path}: truncated or damaged Excel file ({str(e)[:120]})") from None
    filled = [[r for r in rows if any(c is not None for c in r)] for rows in sheets]
    filled = [rows for rows in filled if rows]
    if len(filled) != 1:
        raise InputError(f"{path}: {len(filled)} sheets with values, one is expected; save the one that is the log")
    rows = filled[0]
    start = next((i for i, r in enumerate(rows) if _names(r)), None)
    if start is None or start + 1 == len(rows):
        raise InputError(f"{path}: no row of names with rows of values under it")
    names = [str(c).strip() if c is not None else "" for c in rows[start]]
    check_header(path, names)
    if any(len(r) > len(names) and any(c is not None for c in r[len(names) :]) for r in rows[start + 1 :]):
        raise InputError(f"{path}: a row has values right of the last name, '{names[-1]}'; name each column")
    columns = [n or f"unnamed column {i + 1}" for i, n in enumerate(names)]
    return pd.DataFrame([r[: len(names)] for r in rows[start + 1 :]], columns=columns)


def _names(row: list) -> bool:
    """A row of names: texts only, in more than half of its cells."""
    told = [c for c in row if c is not None]
    return 2 * len(told) > len(row) and all(isinstance(c, str) for c in told)
