"""The page of an answer about energy: an answer, tiles, then sections of figures and tables."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd

from hdev_jax.report import words
from hdev_jax.report.canvas import png, style
from hdev_jax.report.page import write_page

__all__ = ["Page", "Section", "Table", "span", "write_energy_page"]

MOST_ROWS = 60  # of a table on the page; files beside it have all


@dataclass(frozen=True)
class Table:
    """A table as it is shown: `columns` with their words, cells as text; `numbers`, which columns are numbers."""

    caption: str
    columns: tuple[str, ...]
    rows: list[tuple[str, ...]]
    text: int = 1  # columns from the left that are words
    file: str = ""  # that has every row

    @property
    def shown(self) -> list[tuple[str, ...]]:
        """Rows on the page."""
        return self.rows[:MOST_ROWS]


@dataclass(frozen=True)
class Section:
    """A part of the page: `figures` by name, each a function that draws it (None: nothing to draw), its text for those
    who cannot see it and its caption."""

    title: str
    hint: str = ""
    figures: dict[str, tuple[Callable[[], Any], str, str]] = field(default_factory=dict)
    tables: tuple[Table, ...] = ()


@dataclass(frozen=True)
class Page:
    """What is shown. `answer`: pieces of a sentence, and whether each is bold; `tiles`: label, value, note."""

    verb: str
    vehicle: str
    what: str
    synthetic: bool
    answer: list[tuple[str, bool]]
    tiles: list[tuple[str, str, str]]
    sections: list[Section]
    notes: Sequence[str]
    command: str
    how: str

    def plain(self) -> str:
        """The answer as text."""
        return "".join(text for text, _ in self.answer)


def span(value: float | None, lower: float | None, upper: float | None, digits: int = 3) -> str:
    """`12.3 (11.8 to 12.9)`; the value alone where it is certain."""
    if lower is None or upper is None or not lower < upper:
        return words.number(value, digits)
    return f"{words.number(value, digits)} ({words.number(lower, digits)} to {words.number(upper, digits)})"


def table_of(frame: pd.DataFrame, caption: str, columns: dict[str, str], *, text: int = 1, file: str = "") -> Table:
    """Columns of a frame under other names, numbers to three digits."""

    def cell(x: Any) -> str:
        if isinstance(x, str | int):
            return str(x)
        return "–" if x is None or x != x else words.number(x)

    rows = [tuple(cell(x) for x in row) for row in frame[list(columns)].itertuples(index=False)]
    return Table(caption, tuple(columns.values()), rows, text, file)


def write_energy_page(page: Page, directory: Path) -> None:
    """Write `report.html` and `figures/*.png` into a directory."""
    images = {}
    with style():
        for section in page.sections:
            for name, (draw, _, _) in section.figures.items():
                if (figure := draw()) is not None:
                    images[name] = png(figure)
    context = {
        "page": page,
        "vehicle": page.vehicle,
        "what": page.what,
        "synthetic": page.synthetic,
    }
    write_page("energy.html.j2", context, images, directory)
