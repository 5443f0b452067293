"""Pages of the site: a run's tables and figures, or those of many runs, in Markdown."""

import json
import re
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from experiments.runner.compare import as_good, comparison, decides, findings, headlines, merged, missed, notes
from experiments.runner.config import shown
from experiments.runner.figures import against_paper
from experiments.runner.pages.html import MOST_COLUMNS, MOST_ROWS
from experiments.runner.store import HERE
from experiments.runner.tables import cells, markdown

__all__ = ["about", "folded", "heading", "kind_of", "part", "title_of", "wrapped", "write_docs", "write_list_docs"]

MOST_MISSED = 4  # targets that a page shows; more are folded
WIDTH = 120


def write_docs(
    docs: Path, config: str | Path, folders: Sequence[Path], sets: Sequence[str] = (), points: Sequence[str] = (),
    flags: Sequence[str] = (),
) -> None:  # fmt: skip
    """`docs/NAME.md`, NAME being the config's, its tables and figures, from complete runs of that config.

    **Arguments:** `folders` of the runs; `sets`, the overrides that they ran with; `points` of a sweep, one for each
    run, which head them; `flags` that change what is run. Figures go to `docs/figures/NAME/`.
    """
    name = Path(config).stem
    every = " ".join([shown(config), *(f"--set {s}" for s in sets)])
    lines = [f"# {_titled(Path(config))}", ""]
    for k, folder in enumerate(folders):
        lines += ["", f"## {points[k]}", ""] if k < len(points) and points[k] else []
        lines += _lines(folder, Path(config), docs, name, "" if len(folders) == 1 else f"{k}_")
    lines += ["", _by(f"{' '.join([every, *flags])} --tasks DIR --out OUT --docs docs")]
    docs.mkdir(parents=True, exist_ok=True)  # a page without figures has made no folder
    (docs / f"{name}.md").write_text(wrapped("\n".join(lines)) + "\n", encoding="utf-8")


def write_list_docs(
    docs: Path, configs: str | Path, made: Mapping[Path, Sequence[Path]], missing: Sequence[str] = (),
    flags: Sequence[str] = (),
) -> list[Path]:  # fmt: skip
    """`docs/FOLDER.md` for each folder of configs in a list: what decides, every table and figure, paper and ours.

    **Arguments:** `configs`, the list; `made`, the folders of each config's runs; `missing`, why others have none;
    `flags` that change what is run.
    Figures go to `docs/figures/FOLDER/`.
    """
    pages = []
    docs.mkdir(parents=True, exist_ok=True)
    for home in dict.fromkeys(path.parent for path in made):
        runs = {path: folders for path, folders in made.items() if path.parent == home}
        every = [(p.stem, json.loads((f / "metrics.json").read_text())) for p, folders in runs.items() for f in folders]
        kind = kind_of(next(iter(runs)))
        lines = [f"# {kind if kind != 'Study' else _titled(home)}", "", *about(Path(configs)), ""]
        lines += [line for why in missing for line in (f"Not made: {why}.", "")]
        lines += [line for said in as_good(m for _, m in every) for line in (said, "")]
        first = merged([{"part": heading(stem), **x} for stem, m in every for x in headlines(m)])
        with_paper = [x for x in first if x["paper"] is not None]
        alone = [x for x in first if x["paper"] is None]
        lines += _against(with_paper, docs, home.name)
        if with_paper:
            lines += [*_open(_decides(with_paper)), ""]
        if alone:
            title = "Models that the paper does not have" if with_paper else "Every model"
            lines += [*folded(title, _decides(alone)), ""]
        for path, folders in runs.items():
            lines += [f"## {heading(path.stem)}", ""]
            for k, folder in enumerate(folders):
                before = f"{path.stem}_{f'{k}_' if len(folders) > 1 else ''}"
                lines += [*_lines(folder, path, docs, home.name, before, most_rows=MOST_ROWS), ""]
        if against := [{"part": heading(stem), **x} for stem, m in every for x in comparison(m)]:
            every_number = markdown(cells(against, 4), "Every number of the paper").rstrip()
            lines += ["## Paper against ours", "", *folded("Every number of the paper", every_number), ""]
        lines += [_by(f"{' '.join([shown(configs), *flags])} --out OUT --docs docs")]
        pages.append(docs / f"{home.name}.md")
        pages[-1].write_text(wrapped("\n".join(lines).rstrip()) + "\n", encoding="utf-8")
    return pages


def heading(stem: str) -> str:
    """What a page calls a config: `table2` is Table 2, `pinn_data` is Data."""
    if m := re.fullmatch(r"(table|fig)(\d+)", stem):
        return f"{'Table' if m[1] == 'table' else 'Figure'} {m[2]}"
    kind, _, rest = stem.removeprefix("pinn_").partition("_")
    return f"{kind.capitalize()}: {rest.replace('_', ' ')}" if rest else kind.capitalize()


def _decides(rows: Sequence[Mapping[str, Any]]) -> str:
    """The table of what decides."""
    return _narrow(markdown(cells(rows, 4), decides(rows)))


def _against(rows: Sequence[Mapping[str, Any]], docs: Path, name: str) -> list[str]:
    """The figure that leads a page of many runs: the deciding errors beside the paper's; nothing where they are few."""
    if (image := against_paper(rows)) is None:
        return []
    to = docs / "figures" / name / "against_paper.png"
    to.parent.mkdir(parents=True, exist_ok=True)
    to.write_bytes(image)
    return [f"![The deciding error of each model over the paper's](figures/{name}/{to.name})", ""]


def _by(arguments: str) -> str:
    return f"Made by `python -m experiments {arguments}`."


def _lines(
    folder: Path, config: Path, docs: Path, name: str, before: str, *, most_rows: int | None = None
) -> list[str]:  # fmt: skip
    """What a page says of the run in `folder`; its figures are put under `docs/figures/NAME/`."""
    metrics = json.loads((folder / "metrics.json").read_text())
    figures, home = [], docs / "figures" / name
    for figure in sorted((folder / "figures").glob("*.png")):
        home.mkdir(parents=True, exist_ok=True)
        to = home / (figure.name if before == f"{figure.stem}_" else f"{before}{figure.name}")
        to.write_bytes(figure.read_bytes())
        figures.append(f"![{figure.stem.replace('_', ' ')}](figures/{name}/{to.name})")
    files = sorted((folder / "tables").glob("*.md"), key=lambda path: (path.stem != "table", path.stem))
    tables = [path.read_text(encoding="utf-8") for path in files]
    said = [*about(config), *findings(metrics)]
    return part(said, figures, tables, notes(metrics), missed(metrics), most_rows=most_rows)


def part(
    said: Sequence[str], figures: Sequence[str], tables: Sequence[str], notes: Sequence[str],
    missed: Sequence[str] = (), *, most_rows: int | None = None,
) -> list[str]:  # fmt: skip
    """A part of a page: what it shows and found, its figures, its first table, the targets that it misses; notes and
    other tables folded.

    **Arguments:** `most_rows`, of the first table: a longer one is folded too; None for any number.
    """
    lines = [" ".join(said)]
    for figure in figures:
        lines += ["", figure]
    first = _narrow(tables[0]) if tables else ""
    more = [t.rstrip() for t in tables if t.rstrip() != first]
    lines += ["", *_open(first, most_rows)] if first else []
    if missed:
        short = "\n".join(f"- {line}" for line in missed)
        many = len(missed) > MOST_MISSED
        lines += ["", *(folded("Targets missed", short) if many else ("Targets missed:", "", short))]
    if notes:
        lines += ["", *folded("Notes", "\n".join(f"- {line}" for line in notes))]
    if more:
        lines += ["", *folded("More tables", "\n\n".join(more))]
    return lines


def _open(table: str, most_rows: int | None = MOST_ROWS) -> list[str]:
    """A table as it is, or folded under its number of rows where it has more than `most_rows`."""
    rows = sum(line.startswith("|") for line in table.split("\n")) - 2
    return [table] if most_rows is None or rows <= most_rows else folded(f"Table of {rows} rows", table)


def about(config: Path) -> list[str]:
    """The first sentence of the comment that heads a config: what it is; none where it has no comment."""
    comment = re.match(r"(?:#.*\n)+", config.read_text(encoding="utf-8"))
    text = " ".join(line.lstrip("# ") for line in comment.group().splitlines()) if comment else ""
    return [re.split(r"(?<=[.]) (?=[A-Z0-9])", text)[0]] if text else []


def _narrow(table: str) -> str:
    """A table of Markdown with at most `MOST_COLUMNS` columns: of more, the first ones."""
    most = MOST_COLUMNS + 1  # the first part is what is before the first bar: nothing
    lines = table.rstrip().split("\n")
    return "\n".join("|".join([*_split(x)[:most], ""]) if x.startswith("|") else x for x in lines)


def _split(row: str) -> list[str]:
    return re.split(r"(?<!\\)\|", row.removesuffix("|"))


def folded(title: str, text: str) -> list[str]:
    """A part of a page that opens on a click, on the site and where Markdown is shown as it is."""
    return ['<details markdown="1">', f"<summary>{title}</summary>", "", text, "", "</details>"]


# What would be Markdown at the beginning of a line: a list, a heading, a quotation, HTML, a fence, an underline.
_NOT_FIRST = re.compile(r" (?=[-+*=]+(?: |$)|[#<>]|~~~|```|\d+[.)](?: |$))")


def wrapped(text: str) -> str:
    """Markdown whose sentences are in lines of at most `WIDTH`, so that what changes in them is seen in a diff."""
    out, code = [], False
    for line in text.split("\n"):
        fence = line.lstrip().startswith(("```", "~~~"))
        code ^= fence
        own = re.match(r" *(?:(?:-|\d+[.]) )?", line)
        begin = own.group() if own else ""
        kept = line.startswith(("|", "#", "!", "<")) or line.endswith("  ") or (line[:4].isspace() and begin.isspace())
        if code or fence or kept or len(line) <= WIDTH:
            out.append(line)
            continue
        said = _NOT_FIRST.sub("\0", line.removeprefix(begin))
        lines = textwrap.wrap(said, WIDTH - len(begin), break_long_words=False, break_on_hyphens=False)
        out += [(" " * len(begin) if k else begin) + x.replace("\0", " ") for k, x in enumerate(lines)]
    return "\n".join(out)


def _titled(config: Path) -> str:
    """The title of a config's page: as the site's navigation has it, else the config's name in words."""
    site = HERE.parent / "mkdocs.yml"
    nav = site.read_text(encoding="utf-8") if site.is_file() else ""
    if found := re.search(rf'- "?([^"\n]+?)"?: {re.escape(config.stem)}\.md', nav):
        return found[1].removesuffix(" (older code)")
    return config.stem.replace("_", " ").capitalize()


def title_of(config: Path) -> str:
    """What a page of several kinds calls a config: `Paper 2, table 5`, or a study by its title."""
    kind, name = kind_of(config), heading(config.stem)
    return f"{kind}, {name[0].lower()}{name[1:]}" if kind.startswith("Paper") else _titled(config)


def kind_of(config: Path) -> str:
    """What a page of a config in this folder is of: a study, paper 2, …"""
    folder = config.resolve().parent.name
    if folder.startswith("paper"):
        return f"Paper {folder.removeprefix('paper')}".strip()
    return "Study" if folder == "studies" else "Experiment"
