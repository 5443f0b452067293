"""Pages: a run's tables and figures, or those of many runs, in one file that opens offline."""

import base64
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from experiments.runner.compare import comparison, decides, findings, headlines, missed, notes
from experiments.runner.config import shown
from experiments.runner.figures import against_paper
from experiments.runner.store import HERE
from experiments.runner.tables import cells, markdown, read_markdown
from hdev_jax.rundir import Run, atomic_file

__all__ = ["Section", "folded", "of_run", "part", "write_docs", "write_html", "write_list_docs", "write_page"]

MOST_COLUMNS = 8  # of the table that a page shows
MOST_ROWS = 20  # of a table that a page of many runs shows; a longer one is folded
MOST_MISSED = 4  # targets that a page shows; more are folded

_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>{{ title }}</title>
<style>
body { font: 15px/1.5 system-ui, sans-serif; color: #1b1f24; max-width: 76rem; margin: 2rem auto; padding: 0 1rem; }
table { border-collapse: collapse; font-size: 13px; margin-bottom: 1.2rem; }
td, th { padding: .3rem .6rem; border-bottom: 1px solid #d9dee3; text-align: right; vertical-align: bottom; }
td:first-child, th:first-child { text-align: left; } caption { text-align: left; font-weight: 600; padding: .3rem 0; }
.scroll { overflow-x: auto; } img { max-width: 100%; margin: 1rem 0; } .tag { background: #fff3cd; padding: 0 .4rem; }
h2 { margin-top: 3rem; border-top: 1px solid #d9dee3; padding-top: 1rem; } .made { color: #57606a; }
</style></head><body>
<h1>{{ title }}</h1>
{% for s in sections %}
{% if sections | length > 1 and s.title %}<h2 id="{{ s.anchor }}">{{ s.title }}</h2>{% endif %}
{% if s.synthetic %}<p><span class="tag">synthetic</span></p>{% endif %}
{% for line in s.made %}<p class="made">{{ line }}</p>{% endfor %}
{% if s.said %}<ul>{% for line in s.said %}<li>{{ line }}</li>{% endfor %}</ul>{% endif %}
{% if s.links %}<p>{% for name, to in s.links %}<a href="{{ to }}">{{ name }}</a> {% endfor %}</p>{% endif %}
{% for caption, lines in s.tables %}<div class="scroll"><table><caption>{{ caption }}</caption><thead><tr>
{% for h in lines[0] %}<th>{{ h }}</th>{% endfor %}</tr></thead><tbody>
{% for line in lines[1:] %}<tr>{% for c in line %}<td>{{ c }}</td>{% endfor %}</tr>
{% endfor %}</tbody></table></div>{% endfor %}
{% for name, data in s.figures %}<img alt="{{ name }}" src="data:image/png;base64,{{ data }}">
{% endfor %}
{% endfor %}
</body></html>
"""


@dataclass(frozen=True)
class Section:
    """A part of a page: how it was `made`, what is `said` of it, tables (caption, lines), figures (name, PNG)."""

    title: str
    synthetic: bool = False
    made: Sequence[str] = ()
    said: Sequence[str] = ()
    links: Sequence[tuple[str, str]] = ()
    tables: Sequence[tuple[str, list[list[str]]]] = field(default_factory=list)
    figures: Sequence[tuple[str, str]] = field(default_factory=list)

    @property
    def anchor(self) -> str:
        """Where links within the page lead."""
        return re.sub(r"[^\w.]+", "-", self.title).strip("-")


def of_run(folder: Path, metrics: Mapping[str, Any], *, made: Sequence[str] = (), home: Path | None = None) -> Section:
    """The part of a page for the run in `folder`: paper against ours, its own tables, its figures.

    **Arguments:** `made`, lines on what made it; `home`, the folder of the page, for links to the run's files.
    """
    against = comparison(metrics)
    tables = [("Paper against ours", cells(against, 4))] if against else []
    tables += [read_markdown(path) for path in sorted((folder / "tables").glob("*.md"))]
    images = sorted((folder / "figures").glob("*.png"))
    names = ("report.html", "config.toml", "metrics.json", "log.txt")
    links = [(n, (folder / n).relative_to(home).as_posix()) for n in names] if home is not None else []
    return Section(
        title=metrics["artefact"],
        synthetic=metrics["synthetic"],
        made=made,
        said=[
            *findings(metrics),
            *(f"Missed: {line}" for line in missed(metrics)),
            *notes(metrics),
            f"{metrics['seconds']} s.",
        ],
        links=links,
        tables=tables,
        figures=[(p.stem.replace("_", " "), base64.b64encode(p.read_bytes()).decode("ascii")) for p in images],
    )


def write_html(path: Path, title: str, sections: Sequence[Section]) -> None:
    """A page of these parts. **Raises:** `InputError` where the file cannot be written."""
    from jinja2 import Environment, StrictUndefined

    page = Environment(autoescape=True, undefined=StrictUndefined).from_string(_PAGE)
    with atomic_file(path) as temporary:
        temporary.write_text(page.render(title=title, sections=sections), encoding="utf-8")


def write_page(run: Run, metrics: dict[str, Any]) -> None:
    """`report.html` of a run, from its metrics, Markdown tables and PNG figures."""
    write_html(run.path("report.html"), metrics["artefact"], [of_run(run.work, metrics)])


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
    (docs / f"{name}.md").write_text("\n".join(lines) + "\n", encoding="utf-8")


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
        kind = _kind(next(iter(runs)))
        lines = [f"# {kind if kind != 'Study' else _titled(home)}", "", *_about(Path(configs)), ""]
        lines += [line for why in missing for line in (f"Not made: {why}.", "")]
        compared, better = (sum(m[k] for _, m in every) for k in ("of", "better_than_paper"))
        lines += [f"At least as good as the paper in {better} of {compared} comparisons.", ""] if compared else []
        first = [{"part": _heading(stem), **x} for stem, m in every for x in headlines(m)]
        with_paper = [x for x in first if x["paper"] is not None]
        alone = [x for x in first if x["paper"] is None]
        measured = {_heading(stem) for stem, m in every if not m["synthetic"]}  # synthetic data is not the paper's
        lines += _against([x for x in with_paper if x["part"] in measured], docs, home.name)
        if with_paper:
            lines += [*_open(_decides(with_paper)), ""]
        if alone:
            title = "Models that the paper does not have" if with_paper else "Every model"
            lines += [*folded(title, _decides(alone)), ""]
        for path, folders in runs.items():
            lines += [f"## {_heading(path.stem)}", ""]
            for k, folder in enumerate(folders):
                before = f"{path.stem}_{f'{k}_' if len(folders) > 1 else ''}"
                lines += [*_lines(folder, path, docs, home.name, before, most_rows=MOST_ROWS), ""]
        if against := [{"part": _heading(stem), **x} for stem, m in every for x in comparison(m)]:
            every_number = markdown(cells(against, 4), "Every number of the paper").rstrip()
            lines += ["## Paper against ours", "", *folded("Every number of the paper", every_number), ""]
        lines += [_by(f"{' '.join([shown(configs), *flags])} --out OUT --docs docs")]
        pages.append(docs / f"{home.name}.md")
        pages[-1].write_text("\n".join(lines).rstrip() + "\n", encoding="utf-8")
    return pages


def _heading(stem: str) -> str:
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
    said = [*_about(config), *findings(metrics)]
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


def _about(config: Path) -> list[str]:
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


def _titled(config: Path) -> str:
    """The title of a config's page: as the site's navigation has it, else the config's name in words."""
    site = HERE.parent / "mkdocs.yml"
    nav = site.read_text(encoding="utf-8") if site.is_file() else ""
    if found := re.search(rf'- "?([^"\n]+?)"?: {re.escape(config.stem)}\.md', nav):
        return found[1].removesuffix(" (older code)")
    return config.stem.replace("_", " ").capitalize()


def _kind(config: Path) -> str:
    """What a page of a config in this folder is of: a study, paper 2, …"""
    folder = config.resolve().parent.name
    if folder.startswith("paper"):
        return f"Paper {folder.removeprefix('paper')}".strip()
    return "Study" if folder == "studies" else "Experiment"
