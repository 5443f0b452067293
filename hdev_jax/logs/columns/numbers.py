"""Text to numbers: a column is read in one notation, or refused by row and column."""

import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pandas as pd

from hdev_jax.errors import InputError
from hdev_jax.logs.readers.raw import Raw

__all__ = ["MISSING", "numbers"]

MISSING = {
    "", "nan", "na", "n/a", "null", "none", "-", "--", "?", "inf", "-inf", "+inf", "infinity", "-infinity", "<na>", "∞",
    "-∞",
}  # fmt: skip
_BOOLEANS = {"true": 1.0, "false": 0.0, "yes": 1.0, "no": 0.0, "on": 1.0, "off": 0.0}
_NOTATIONS = ((".", ","), (",", "."), ("'", "."), ("’", "."), (" ", ","), ("\u00a0", ","), ("\u202f", ","))


def numbers(raw: Raw, header: str, known: bool, note: Callable[[str, int], None]) -> np.ndarray | None:
    """The column as float64 `[row]`; None where it is text and the contract does not know it.

    **Arguments:** `known`, whether the contract knows the column, so that text in it is a fault; `note(reason, count)`
    reports what was taken out of the numbers. **Raises:** `InputError` for stray text.
    """
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
    missing = series.isna() | lower.isin(MISSING)
    if raw.thousands is not None and (named := _named(raw, header, text, missing)) is not None:
        return named
    number: Any = pd.to_numeric(text.where(~missing), errors="coerce")
    number = number.astype(np.float64)
    boolean = lower.isin(list(_BOOLEANS))
    if boolean.any() and bool((boolean | missing).all()):
        return lower.map(_BOOLEANS).to_numpy(dtype=np.float64, na_value=np.nan)
    # infinities written as text are missing values like any other, so they need not come through
    stray = (~missing & number.isna()).to_numpy()
    if stray.any():
        grouped = _grouped(text[~missing], raw.thousands)
        if grouped is not None:
            plain, separator = grouped
            note(
                f"'{separator}' between thousands taken out",
                int(text[~missing].str.contains(separator, regex=False).sum()),
            )
            out = np.full(len(text), np.nan)
            out[(~missing).to_numpy()] = plain.astype(np.float64)
            return out
        if not known and stray.sum() > 0.5 * (~missing).sum():
            return None
        i = int(np.argmax(stray))
        hint = "; a thousands separator or a decimal comma?" if "," in str(text.iloc[i]) else ""
        if hint and (fault := _other_notation(text[~missing])) is not None:
            i = text.index.get_loc(fault)
        raise InputError(
            f"{raw.file}: {raw.where(i)}, column '{header}': a number is expected, found '{text.iloc[i][:40]}'{hint}"
        )
    return number.to_numpy(dtype=np.float64, na_value=np.nan)


def _named(raw: Raw, header: str, text: Any, missing: Any) -> np.ndarray | None:
    """The column where the adapter names the separator of thousands; None where the column is none of numbers.

    Raises `InputError` for numbers that are not grouped by it, since one of the two would be read wrongly.
    """
    told = text[~missing]
    grouped = _grouped(told, raw.thousands)
    if grouped is None:
        if (odd := told.str.contains(str(raw.thousands), regex=False)).any() and _all_numbers(told):
            i = int(text.index.get_loc(odd.idxmax()))
            raise InputError(
                f"{raw.file}: {raw.where(i)}, column '{header}': found '{text.iloc[i]}', but thousands = "
                f'"{raw.thousands}" in the adapter; write the file in one notation'
            )
        return None
    out = np.full(len(text), np.nan)
    out[(~missing).to_numpy()] = grouped[0].astype(np.float64)
    return out


def _all_numbers(text: Any) -> bool:
    found: Any = pd.to_numeric(text, errors="coerce")
    return bool(found.notna().all())


def _grouped(text: Any, separator: str | None) -> tuple[Any, str] | None:
    """The numbers without their separators of thousands, and the separator; None where the text leaves a doubt.

    Without a `separator` from the adapter every value has to fit the notation, and one has to prove it: by both marks,
    `14.288,0`, or by a mark that is never a decimal one, `14'288`.
    """
    for mark, decimal in _NOTATIONS:
        if separator not in (None, mark):
            continue
        m, d = re.escape(mark), re.escape(decimal)
        if not text.str.fullmatch(rf"[-+]?(?:\d{{1,3}}(?:{m}\d{{3}})+|\d+)(?:{d}\d+)?").all():
            continue
        grouped = text.str.contains(mark, regex=False)
        proof = grouped if mark not in ".," else grouped & text.str.contains(decimal, regex=False)
        if separator or proof.any():
            return text.str.replace(mark, "", regex=False).str.replace(decimal, ".", regex=False), mark
    return None


def _other_notation(text: Any) -> Any:
    """The first value that does not fit the notation of most values in the column."""
    comma = text.str.fullmatch(r"[-+]?\d+,\d+")
    if comma.mean() <= 0.5:
        return None
    odd = ~(comma | text.str.fullmatch(r"[-+]?\d+"))
    return odd.idxmax() if odd.any() else None
