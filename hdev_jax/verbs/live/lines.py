"""Rows of a stream as they come: CSV with a header, or JSON lines."""

import contextlib
import csv
import json
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

from hdev_jax.errors import InputError

__all__ = ["Batch", "Records", "Waiting", "batches", "opened", "rows_of_json"]

Records = Iterable[Mapping[str, Any]]
Batch = list[Mapping[str, Any] | None]  # rows by header; None for one that does not read
Waiting = Callable[[], contextlib.AbstractContextManager[None]]  # around what waits for rows: there it may be stopped


@contextlib.contextmanager
def opened(rows: str | Path | Records | BinaryIO | None) -> Iterator[Records | BinaryIO]:
    """Where rows come from. Raises `InputError` for a file that cannot be read."""
    if rows is None:
        yield sys.stdin.buffer
    elif isinstance(rows, str | Path):
        try:
            file = open(rows, "rb")  # noqa: SIM115
        except OSError as e:
            raise InputError(f"{rows}: cannot be read ({e.strerror or e})") from e
        with file:
            yield file
    else:
        yield rows


def batches(rows: Records | BinaryIO, *, again: bool, waiting: Waiting = contextlib.nullcontext) -> Iterator[Batch]:
    """Rows by header as they come, all that are there at a time. What is sent `again` need not be read half."""
    if not hasattr(rows, "read1"):
        yield [*rows]  # type: ignore[misc]
        return
    header: list[str] | None = None
    mark = ","
    for lines, whole in _lines(rows, waiting):  # type: ignore[arg-type]
        found: Batch = []
        for line in lines:
            text = line.decode("utf-8", errors="replace").strip("\ufeff\r\n \0")
            if not text:
                continue
            if text.startswith("{"):
                found += rows_of_json(text.encode())
            elif header is None:
                mark = ";" if text.count(";") > text.count(",") else ","
                header = _cells(text, mark)
                if header is None:
                    raise InputError("standard input, line 1: not a header of CSV; text with a header is expected")
            elif (cells := _cells(text, mark)) != header:  # a source that began again sends its header again
                good = cells is not None and len(cells) == len(header) and (whole or not again)
                found.append(dict(zip(header, cells, strict=True)) if good and cells else None)
        if found:
            yield found


def _cells(text: str, mark: str) -> list[str] | None:
    """The cells of a line of CSV; None for one that does not read."""
    try:
        return next(csv.reader([text], delimiter=mark))
    except csv.Error:
        return None


def rows_of_json(text: bytes) -> Batch:
    """The rows of a message: one, or a list of them; none of an empty one."""
    if not text.strip():
        return []
    try:
        found = json.loads(text)
    except (ValueError, RecursionError):
        return [None]
    return [row if isinstance(row, dict) else None for row in (found if isinstance(found, list) else [found])]


def _lines(stream: BinaryIO, waiting: Waiting) -> Iterator[tuple[list[bytes], bool]]:
    """Lines, all that have come since the last ones, and whether they are whole: the last one may end half-way.

    **Raises:** `InputError` for what is compressed.
    """
    rest, first = b"", True
    while True:
        with waiting():
            piece = stream.read1(1 << 16)  # type: ignore[attr-defined]
        if not piece:
            break
        if first and piece.startswith(b"\x1f\x8b"):
            raise InputError("standard input: compressed by gzip; text is expected: zcat FILE | hdev follow …")
        first = False
        *lines, rest = (rest + piece).replace(b"\r", b"\n").split(b"\n")
        yield lines, True
    if rest:
        yield [rest], False
