"""A sweep as a table over its runs: `sweep.json`, `sweep.md`, `sweep.tex`, and a page that shows it."""

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from experiments.runner.compare import numbers
from experiments.runner.config import shown, shown_point
from experiments.runner.pages.html import Section, write_html
from experiments.runner.tables import cells, markdown, tex
from hdev_jax.rundir import atomic_file

__all__ = ["over_seeds", "sweep_rows", "write_sweep"]


def write_sweep(out: Path, config: str | Path, found: Sequence[Mapping[str, Any]]) -> None:
    """The table over the runs of a sweep, in the folder that holds them, and `report.html`.

    **Arguments:** `found`, for each run its metrics, with `sweep` (its point of the grid) and `folder`.

    **Raises:** `InputError` where a file cannot be written.
    """
    rows = sweep_rows(found)
    keys = list(found[0]["sweep"])
    caption = f"{shown(config)}: {len(found)} runs over {', '.join(keys)}"
    tables = [(caption, cells(rows, 4))]
    if "seed" in keys and (spread := over_seeds(rows, found)):
        tables.append(("Mean ± standard deviation over the seeds", cells(spread)))
    files = {
        "sweep.json": json.dumps(list(found), indent=1, allow_nan=False) + "\n",
        "sweep.md": "\n".join(markdown(lines, title) for title, lines in tables),
        "sweep.tex": "\n".join(tex(lines, title) for title, lines in tables),
    }
    for name, text in files.items():
        with atomic_file(out / name) as temporary:
            temporary.write_text(text, encoding="utf-8")
    links = [(shown_point(r["sweep"]), f"{Path(r['folder']).name}/report.html") for r in found]
    synthetic = all(r["synthetic"] for r in found)
    write_html(
        out / "report.html",
        f"Sweep of {shown(config)}",
        [Section("", synthetic, tables=tables, contents=[("Runs", links)])],
    )


def sweep_rows(found: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """A line for each row of each run: where on the grid, the row's name, our numbers."""
    quantities = numbers([row for r in found for row in r["rows"]])
    return [
        {**_flat(r["sweep"]), "name": row["name"], **{q: (row["ours"] or {}).get(q) for q in quantities}}
        for r in found
        for row in r["rows"]
    ]


def _flat(delta: Mapping[str, Any]) -> dict[str, Any]:
    """The point, lists and tables as text: a column each, and equal points are equal."""
    return {k: json.dumps(v) if isinstance(v, list | dict) else v for k, v in delta.items()}


def over_seeds(rows: Sequence[Mapping[str, Any]], found: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """The same lines with all seeds of a point in one: mean ± standard deviation, and the number of seeds."""
    keys = [k for k in found[0]["sweep"] if k != "seed"]
    groups: dict[tuple, list[Mapping[str, Any]]] = {}
    for row in rows:
        groups.setdefault((*(row[k] for k in keys), row["name"]), []).append(row)
    quantities = [q for q in rows[0] if q not in (*keys, "seed", "name")] if rows else []
    out = []
    for at, group in groups.items():
        line: dict[str, Any] = {**dict(zip(keys, at, strict=False)), "name": at[-1], "seeds": len(group)}
        for q in quantities:
            values = [float(r[q]) for r in group if isinstance(r[q], int | float)]
            line[q] = _spread(values) if values else None
        out.append(line)
    return out


def _spread(values: Sequence[float]) -> str:
    mean = math.fsum(values) / len(values)
    sd = math.sqrt(math.fsum((v - mean) ** 2 for v in values) / max(1, len(values) - 1))
    return f"{mean:.4g} ± {sd:.2g}"
