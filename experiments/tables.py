"""Tables of a run: Markdown and LaTeX from the same rows; intervals of shares."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy import stats

from hdev_jax.rundir import Run

__all__ = ["wilson", "write_tables"]


def wilson(hits: int, n: int, level: float = 0.95) -> tuple[float, float]:
    """Interval of a share (Wilson 1927): where the truth may be after `hits` of `n`."""
    if n == 0:
        return 0.0, 1.0
    z = float(stats.norm.ppf(0.5 + level / 2))
    p = hits / n
    centre, half = p + z**2 / (2 * n), z * np.sqrt(p * (1 - p) / n + z**2 / (4 * n**2))
    return float((centre - half) / (1 + z**2 / n)), float((centre + half) / (1 + z**2 / n))


def write_tables(run: Run, name: str, rows: Sequence[Mapping[str, Any]], caption: str) -> None:
    """`tables/NAME.md` and `tables/NAME.tex`; columns as in the first row, empty ones left out."""
    keys = [k for k in rows[0] if any(r[k] is not None for r in rows)] if rows else []
    head, body = [k.replace("_", " ") for k in keys], [[_cell(r[k]) for k in keys] for r in rows]
    lines = [f"{caption}.", "", f"| {' | '.join(head)} |", "|" + "---|" * len(head)]
    lines += [f"| {' | '.join(line)} |" for line in body]
    run.path("tables", f"{name}.md").write_text("\n".join(lines) + "\n")
    tex = [
        r"\begin{tabular}{l" + "r" * (len(head) - 1) + "}",
        r"\hline",
        " & ".join(map(_tex, head)) + r" \\",
        r"\hline",
    ]
    tex += [" & ".join(map(_tex, line)) + r" \\" for line in body]
    tex += [r"\hline", r"\end{tabular}", f"% {caption}"]
    run.path("tables", f"{name}.tex").write_text("\n".join(tex) + "\n")


def _cell(x: Any) -> str:
    if x is None:
        return "–"
    if isinstance(x, bool):
        return "yes" if x else "no"
    if isinstance(x, float):
        return f"{x:.3g}"
    if isinstance(x, list | tuple):
        return "–".join(_cell(v) for v in x)
    return str(x)


def _tex(text: str) -> str:
    for a, b in (("\\", r"\textbackslash "), ("_", r"\_"), ("%", r"\%"), ("&", r"\&"), ("#", r"\#")):
        text = text.replace(a, b)
    return text
