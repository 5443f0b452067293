"""The layout of a text table: what stands before its header, the separator, the names, a row of units."""

import csv
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from hdev_jax.errors import InputError
from hdev_jax.units import is_unit

__all__ = ["COMMENT", "Layout", "layout_of", "split"]

COMMENT = "#"
_SEPARATORS = ",;\t|"
_LOOKED_AT = 200  # lines: enough to see what is usual, also under a long preamble


@dataclass(frozen=True)
class Layout:
    """`header` is the index of the header's line, counted from 0; `units` the row under it, where it is one of units;
    `first` the index of the first line that may hold values; `before` how many lines stand before the header."""

    separator: str
    header: int
    names: tuple[str, ...]
    units: tuple[str, ...] | None
    first: int
    before: int


def split(line: str, separator: str) -> list[str]:
    """The fields of one line, stripped."""
    return [c.strip() for c in next(csv.reader([line], delimiter=separator), [])]


def _is_number(text: str) -> bool:
    return re.fullmatch(r"[-+]?(\d+([.,]\d*)?|[.,]\d+)([eE][-+]?\d+)?", text) is not None


def _names_columns(cells: Sequence[str]) -> bool:
    """Whether a line could be a header: no number in it, and more names than blanks."""
    return not any(map(_is_number, cells)) and 2 * sum(map(bool, cells)) > len(cells)


def layout_of(path: Path, text: str, header_line: int | None = None) -> Layout:
    """Look at the first lines. `header_line`, counted from 1, is where the adapter says that the header is.

    The header is the first line that names columns and has as many fields as most lines have; what stands before it is
    a preamble. Raises `InputError` where there is none.
    """
    head = text[:262144].split("\n")
    head = [line.rstrip("\r") for line in (head[:-1] if len(text) > 262144 else head)]
    seen = [(i, line) for i, line in enumerate(head) if line.strip()]
    if not seen:
        raise InputError(f"{path}: empty file")
    plain = [(i, line) for i, line in seen if not line.lstrip().startswith(COMMENT)]
    plain = plain if not re.match(r"sep=.\s*$", head[plain[0][0]] if plain else "", re.I) else plain[1:]
    if header_line is not None:
        if not 1 <= header_line <= len(head) or not head[header_line - 1].strip():
            raise InputError(f"{path}: header_line = {header_line} of the adapter: no such line with text")
        return _layout(path, head, header_line - 1)
    found: list[tuple[int, int, str]] = []
    for separator in _SEPARATORS:
        lines = [(i, split(line, separator)) for i, line in plain[:_LOOKED_AT]]
        usual = Counter(len(cells) for _, cells in lines).most_common(1)[0][0] if lines else 0
        if usual < 2:
            continue
        trailing = sum(len(c) == usual and not c[-1] for _, c in lines) > 0.5 * len(lines)
        for i, cells in lines[:-1]:
            if len(cells) in (usual, usual - trailing) and _names_columns(cells):
                found.append((i, -usual, separator))
                break
    if found:
        header, _, separator = min(found)
        return _layout(path, head, header, separator)
    last_comment = max((i for i, line in seen if plain and i < plain[0][0] and line not in plain), default=None)
    if last_comment is not None and all(map(_is_number, _fields(plain[0][1]))):
        named = head[last_comment].lstrip().lstrip(COMMENT)  # `# time_s,speed_mps`, as numpy.savetxt writes it
        if len(_fields(named)) == len(_fields(plain[0][1])) > 1 and _names_columns(_fields(named)):
            return _layout(path, [*head[:last_comment], named, *head[last_comment + 1 :]], last_comment)
    return _layout(path, head, (plain or seen)[0][0])


def _separator(line: str) -> str:
    return max(_SEPARATORS, key=lambda s: len(split(line, s)))


def _fields(line: str) -> list[str]:
    return split(line, _separator(line))


def _layout(path: Path, head: list[str], header: int, separator: str | None = None) -> Layout:
    separator = separator or _separator(head[header])
    names = split(head[header], separator)
    if all(map(_is_number, names)):
        raise InputError(f"{path}: line {header + 1} has numbers: the first line must name the columns")
    if names[-1] == "" and len(names) > 2:  # a separator at the end of every line
        below = [line for line in head[header + 1 :] if line.strip()][:_LOOKED_AT]
        if all(not split(line, separator)[-1] for line in below):
            names = names[:-1]
    before = sum(bool(line.strip()) for line in head[:header])
    following = next((i for i in range(header + 1, len(head)) if head[i].strip()), None)
    units = None
    if following is not None and not head[following].lstrip().startswith(COMMENT):
        cells = split(head[following], separator)[: len(names)]
        told = [c for c in cells if c not in ("", "-")]
        if len(cells) == len(names) and told and not any(map(_is_number, cells)) and all(map(is_unit, told)):
            units = tuple(cells)
    first = (following if units is not None and following is not None else header) + 1
    return Layout(separator, header, tuple(names), units, first, before)
