"""Pages of runs in one file that opens offline: what was found first, a figure, a table; the rest folded away."""

import base64
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from experiments.runner.compare import comparison, findings, missed, notes
from experiments.runner.tables import cells, read_markdown
from hdev_jax.rundir import Run, atomic_file

__all__ = ["MOST_COLUMNS", "MOST_ROWS", "Folded", "Section", "Table", "of_run", "write_html", "write_page"]

Table = tuple[str, list[list[str]]]  # its caption; its lines, the head first

MOST_COLUMNS = 8  # of the table that a page shows
MOST_ROWS = 20  # of a table that is open; a longer one is folded
_NUMBER = re.compile(r"[-−+±<]?\s?[\d.,]+( ?(%|±|to|of|x|×).*)?|–|yes|no|")

_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>{{ title }}</title>
<style>
:root { color-scheme: light dark; --ink: #1b1f24; --paper: #fff; --line: #d9dee3; --quiet: #57606a; --tag: #fff3cd; }
@media (prefers-color-scheme: dark) {
:root { --ink: #e3e8ee; --paper: #16191d; --line: #3a4149; --quiet: #9aa4ae; --tag: #5c4a12; } a { color: #7cb7ff; } }
body { font: 15px/1.5 system-ui, sans-serif; color: var(--ink); background: var(--paper); max-width: 62rem;
  margin: 2rem auto; padding: 0 1rem; }
table { border-collapse: collapse; font-size: 13px; margin-bottom: 1.2rem; }
td, th { padding: .25rem .7rem; border-bottom: 1px solid var(--line); text-align: right; vertical-align: top; }
th { vertical-align: bottom; } .l { text-align: left; }
td:first-child { min-width: 8rem; }
caption { text-align: left; font-weight: 600; padding: .3rem 0; }
.scroll { overflow-x: auto; } img { max-width: 100%; margin: 1rem 0; background: #fff; }
.tag { background: var(--tag); padding: 0 .4rem; } .quiet { color: var(--quiet); }
h2 { margin-top: 3rem; border-top: 1px solid var(--line); padding-top: 1rem; } details { margin: .6rem 0; }
summary { cursor: pointer; color: var(--quiet); } nav p { margin: .2rem 0; }
@media print { details:not([open]) { display: none; } }
</style></head><body>
{% macro table(caption, lines) %}<div class="scroll"><table><caption>{{ caption }}</caption><thead><tr>
{% set left = lines | lefts %}{% for h in lines[0] %}<th{% if left[loop.index0] %} class="l"{% endif %}>{{ h }}</th>
{% endfor %}</tr></thead><tbody>
{% for line in lines[1:] %}<tr>{% for c in line %}<td{% if left[loop.index0] %} class="l"{% endif %}>{{ c }}</td>
{% endfor %}</tr>
{% endfor %}</tbody></table></div>{% endmacro %}
<h1>{{ title }}</h1>
{% for s in sections %}
{% if sections | length > 1 and s.title %}<h2 id="{{ s.anchor }}">{{ s.title }}</h2>{% endif %}
<p>{% if s.synthetic %}<span class="tag">synthetic</span> {% endif %}{{ s.said | join(" ") }}</p>
{% for name, data in s.figures %}<img alt="{{ name }}" src="data:image/png;base64,{{ data }}">
{% endfor %}
{% for caption, lines in s.tables %}{{ table(caption, lines) }}{% endfor %}
{% for f in s.folded %}<details><summary>{{ f.title }}</summary>
{% if f.said %}<ul>{% for line in f.said %}<li>{{ line }}</li>{% endfor %}</ul>{% endif %}
{% for caption, lines in f.tables %}{{ table(caption, lines) }}{% endfor %}</details>{% endfor %}
{% if s.contents %}<nav>{% for group, links in s.contents %}<p>{{ group }}{% if group %}: {% endif %}
{% for name, to in links %}<a href="{{ to }}">{{ name }}</a>{% if not loop.last %}, {% endif %}{% endfor %}</p>
{% endfor %}</nav>{% endif %}
{% if s.made %}<p class="quiet">{% for line in s.made %}{{ line }}<br>{% endfor %}
{% for name, to in s.files %}<a href="{{ to }}">{{ name }}</a> {% endfor %}</p>{% endif %}
{% endfor %}
</body></html>
"""


@dataclass(frozen=True)
class Folded:
    """What opens on a click."""

    title: str
    said: Sequence[str] = ()
    tables: Sequence[Table] = ()


@dataclass(frozen=True)
class Section:
    """A part of a page: what is `said`, figures (name, PNG), tables, what is `folded`, `contents` (links by group), and
    how it was `made`, with links to its `files`."""

    title: str
    synthetic: bool = False
    said: Sequence[str] = ()
    figures: Sequence[tuple[str, str]] = ()
    tables: Sequence[Table] = field(default_factory=list)
    folded: Sequence[Folded] = ()
    contents: Sequence[tuple[str, Sequence[tuple[str, str]]]] = ()
    made: Sequence[str] = ()
    files: Sequence[tuple[str, str]] = ()

    @property
    def anchor(self) -> str:
        """Where links within the page lead."""
        return re.sub(r"[^\w.]+", "-", self.title).strip("-")


def of_run(
    folder: Path, metrics: Mapping[str, Any], *, made: Sequence[str] = (), changed: Sequence[str] = (),
    home: Path | None = None,
) -> Section:  # fmt: skip
    """The part of a page for the run in `folder`: what it found, its figures and the first columns of its first table;
    targets missed, notes, its other tables and the paper's numbers folded.

    **Arguments:** `made`, lines on what made it; `changed`, what its config changes in the one that it extends; `home`,
    the folder of the page, for links to the run's files.
    """
    files = sorted((folder / "tables").glob("*.md"), key=lambda path: (path.stem != "table", path.stem))
    tables = [read_markdown(path) for path in files]
    against = comparison(metrics)
    more = [*tables[1:], *([("Paper against ours", cells(against, 4))] if against else [])]
    first = tables[:1]
    folded = [Folded("Targets missed", missed(metrics)), Folded("Notes", notes(metrics))]
    if first and len(first[0][1]) > MOST_ROWS + 1:
        folded.insert(0, Folded(f"Table of {len(first[0][1]) - 1} rows", tables=first))
        first = []
    elif first and len(first[0][1][0]) > MOST_COLUMNS:
        folded.insert(0, Folded("All columns", tables=first))
        first = [(first[0][0], [row[:MOST_COLUMNS] for row in first[0][1]])]
    folded += [Folded("More tables", tables=more), Folded("Changes in the config that it extends", changed)]
    images = sorted((folder / "figures").glob("*.png"))
    names = ("report.html", "config.toml", "metrics.json", "log.txt")
    return Section(
        title=metrics["artefact"],
        synthetic=metrics["synthetic"],
        said=findings(metrics),
        figures=[(p.stem.replace("_", " "), base64.b64encode(p.read_bytes()).decode("ascii")) for p in images],
        tables=first,
        folded=[f for f in folded if f.said or f.tables],
        made=[*made, f"Took {metrics['seconds']} s."],
        files=[(n, (folder / n).relative_to(home).as_posix()) for n in names] if home is not None else [],
    )


def write_html(path: Path, title: str, sections: Sequence[Section]) -> None:
    """A page of these parts. **Raises:** `InputError` where the file cannot be written."""
    from jinja2 import Environment, StrictUndefined

    environment = Environment(autoescape=True, undefined=StrictUndefined)
    environment.filters["lefts"] = _lefts
    page = environment.from_string(_PAGE)
    with atomic_file(path) as temporary:
        temporary.write_text(page.render(title=title, sections=sections), encoding="utf-8")


def write_page(run: Run, metrics: dict[str, Any]) -> None:
    """`report.html` of a run, from its metrics, Markdown tables and PNG figures."""
    write_html(run.path("report.html"), metrics["artefact"], [of_run(run.work, metrics)])


def _lefts(lines: Sequence[Sequence[str]]) -> list[bool]:
    """Whether a column holds words, which begin at its left; the first is taken to."""
    body = lines[1:]
    return [k == 0 or any(not _NUMBER.fullmatch(line[k]) for line in body) for k in range(len(lines[0]))]
