"""A run's page: its table and its figures in one file that opens offline."""

import base64
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hdev_jax.rundir import Run

__all__ = ["write_docs", "write_page"]

_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>{{ title }}</title>
<style>
body { font: 15px/1.5 system-ui, sans-serif; color: #1b1f24; max-width: 76rem; margin: 2rem auto; padding: 0 1rem; }
table { border-collapse: collapse; font-size: 13px; } td, th { padding: .3rem .6rem; border-bottom: 1px solid #d9dee3; }
td { text-align: right; } td:first-child, th:first-child { text-align: left; } th { vertical-align: bottom; }
.scroll { overflow-x: auto; } img { max-width: 100%; margin: 1rem 0; } .tag { background: #fff3cd; padding: 0 .4rem; }
</style></head><body>
<h1>{{ title }}{% if synthetic %} <span class="tag">synthetic</span>{% endif %}</h1>
<p>{{ metrics.logs }} logs, {{ metrics.seconds }} s.{% if metrics.tasks_left_out %}
{{ metrics.tasks_left_out }} more were asked for and are not done.{% endif %}{% if metrics.missed %}
Short of what is wanted: {{ metrics.missed | join("; ") }}.{% endif %}</p>
{% for name, lines in tables %}<div class="scroll"><table><thead><tr>{% for h in lines[0] %}<th>{{ h }}</th>{% endfor
%}</tr></thead><tbody>{% for line in lines[1:] %}<tr>{% for c in line %}<td>{{ c }}</td>{% endfor %}</tr>{% endfor
%}</tbody></table></div>{% endfor %}
{% for name, data in figures %}<img alt="{{ name }}" src="data:image/png;base64,{{ data }}">{% endfor %}
</body></html>
"""


def write_page(run: Run, metrics: dict[str, Any]) -> None:
    """`report.html` from the run's Markdown tables and PNG figures."""
    from jinja2 import Environment, StrictUndefined

    tables = []
    for path in sorted(run.path("tables").glob("*.md")):
        rows = [line for line in path.read_text().splitlines() if line.startswith("|") and not line.startswith("|---")]
        tables.append((path.stem, [[c.strip() for c in line.strip("|").split("|")] for line in rows]))
    images = sorted(run.path("figures").glob("*.png"))
    figures = [(p.stem, base64.b64encode(p.read_bytes()).decode("ascii")) for p in images]
    page = Environment(autoescape=True, undefined=StrictUndefined).from_string(_PAGE)
    text = page.render(
        title=metrics["artefact"], synthetic=metrics["synthetic"], metrics=metrics, tables=tables, figures=figures
    )
    run.path("report.html").write_text(text, encoding="utf-8")


def write_docs(docs: Path, name: str, folders: Sequence[Path]) -> None:
    """`docs/NAME.md`, its tables and figures, from complete runs; figures go to `docs/figures/NAME/`."""
    command = f"python -m experiments configs/studies/{name}.toml --tasks DIR --out OUT --docs docs"
    lines = [f"# Study: {name}", "", f"Made by `{command}`.", ""]
    for k, folder in enumerate(folders):
        metrics = json.loads((folder / "metrics.json").read_text())
        lines.append(f"{metrics['logs']} logs{', all synthetic' if metrics['synthetic'] else ''}.")
        if metrics["tasks_left_out"]:
            lines.append(f"{metrics['tasks_left_out']} more are in the config and were not run.")
        if metrics["skipped"]:
            lines.append(f"{len(metrics['skipped'])} could not be made as asked for.")
        if metrics["missed"]:
            lines.append(f"Short of what is wanted: {'; '.join(metrics['missed'])}.")
        for table in sorted((folder / "tables").glob("*.md")):
            lines += ["", table.read_text().rstrip()]
        home = docs / "figures" / name
        home.mkdir(parents=True, exist_ok=True)
        for figure in sorted((folder / "figures").glob("*.png")):
            to = home / (figure.name if len(folders) == 1 else f"{k}_{figure.name}")
            to.write_bytes(figure.read_bytes())
            lines += ["", f"![{figure.stem.replace('_', ' ')}](figures/{name}/{to.name})"]
    (docs / f"{name}.md").write_text("\n".join(lines) + "\n")
