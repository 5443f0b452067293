"""What the verbs about energy return: the answer as text, tables as frames, a page; in memory, or from a folder."""

import json
import math
import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hdev_jax.report.energy import Page, write_energy_page
from hdev_jax.rundir import Run

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["EnergyResult", "records"]

ANSWER = "answer.txt"


class EnergyResult:
    """An answer about energy. `str()` is the answer as the command line prints it.

    - `summary`: what the JSON file of the command holds.
    - `tables`: by name, the data frames that the command writes as CSV, as Parquet and into a workbook.
    """

    def __init__(
        self,
        verb: str,
        answer: str,
        summary: Mapping[str, Any],
        tables: Mapping[str, "pd.DataFrame"],
        page: Page | Path,
    ):
        self.verb = verb
        self.summary: dict[str, Any] = _plain(dict(summary))
        self.tables: dict[str, pd.DataFrame] = dict(tables)
        self._answer, self._page = answer, page

    @classmethod
    def of_folder(cls, verb: str, folder: Path) -> "EnergyResult":
        """The result in a finished folder."""
        import pandas as pd

        summary = json.loads((folder / f"{verb}.json").read_text())
        tables = {p.stem: pd.read_parquet(p) for p in sorted(folder.glob("*.parquet"))}
        return cls(verb, (folder / ANSWER).read_text(), summary, tables, folder)

    def write(self, run: Run, out: str | Path) -> None:
        """Write all files of the result into the folder of `run`; `out` is the folder's name for the user."""
        run.path(f"{self.verb}.json").write_text(json.dumps(self.summary, indent=1, allow_nan=False) + "\n")
        for name, frame in self.tables.items():
            frame.to_csv(run.path(f"{name}.csv"), index=False, float_format="%.8g", lineterminator="\n")
            frame.to_parquet(run.path(f"{name}.parquet"), index=False)
        try:
            _write_book(run.path(f"{self.verb}.xlsx"), self.tables)
        except ImportError:
            self._answer += "\nnote: no workbook was written: pip install 'hdev_jax[formats]' for .xlsx"
        self.report(run.work)
        self._answer = f"{self._answer}\n{Path(out) / 'report.html'}"
        run.path(ANSWER).write_text(self._answer)

    def report(self, path: str | Path) -> Path:
        """Write the report: one page where `path` ends in .html, else a folder with `report.html` and `figures/`.

        **Returns:** the page's path.
        """
        path = Path(path)
        if path.suffix in (".html", ".htm"):
            with tempfile.TemporaryDirectory() as folder:
                page = self.report(folder)
                path.parent.mkdir(parents=True, exist_ok=True)
                shutil.move(page, path)
            return path
        if isinstance(self._page, Page):
            write_energy_page(self._page, path)
        else:
            shutil.copytree(self._page / "figures", path / "figures", dirs_exist_ok=True)
            shutil.copy2(self._page / "report.html", path / "report.html")
        return path / "report.html"

    def __str__(self) -> str:
        return self._answer

    def __repr__(self) -> str:
        return f"EnergyResult({self.verb}; tables: {', '.join(self.tables)})"

    def _repr_html_(self) -> str:
        from html import escape

        return f"<pre>{escape(self._answer)}</pre>"


def _write_book(path: Path, tables: Mapping[str, "pd.DataFrame"]) -> None:
    """A workbook with a sheet for each table. A name that begins with = stays text. Raises `ImportError`."""
    import pandas as pd

    with pd.ExcelWriter(path, engine="openpyxl") as book:
        for name, frame in tables.items():
            frame.to_excel(book, sheet_name=name[:31], index=False, freeze_panes=(1, 0))
            for cell in (c for row in book.sheets[name[:31]].iter_rows() for c in row):
                if cell.data_type == "f":
                    cell.data_type = "s"


def records(frame: "pd.DataFrame") -> list[dict[str, Any]]:
    """Rows of a frame as JSON has them: plain numbers, None for what is none."""
    return _plain(frame.to_dict("records"))


def _plain(x: Any) -> Any:
    if isinstance(x, Mapping):
        return {str(k): _plain(v) for k, v in x.items()}
    if isinstance(x, list | tuple):
        return [_plain(v) for v in x]
    x = x.item() if hasattr(x, "item") else x
    return None if isinstance(x, float) and not math.isfinite(x) else x
