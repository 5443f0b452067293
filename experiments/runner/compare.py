"""A run's metrics: what they must hold, and the paper's numbers beside ours."""

import re
from collections.abc import Iterable, Mapping, Sequence
from numbers import Real
from typing import Any

from experiments.runner.tables import readable

__all__ = [
    "as_good",
    "check",
    "comparison",
    "decides",
    "findings",
    "headlines",
    "merged",
    "missed",
    "notes",
    "numbers",
    "tally",
]

DECIDES = "Main error of each model"
OVER_STARTS = "; median and range are over the random starts of its fit"
KEYS = ("artefact", "data", "synthetic", "rows", "better_than_paper", "of", "seconds", "tasks_left_out")


def check(metrics: Mapping[str, Any]) -> None:
    """**Raises:** `ValueError` where an experiment's metrics are not what every reader of `metrics.json` relies on."""
    if missing := [k for k in KEYS if k not in metrics]:
        raise ValueError(f"metrics lack {', '.join(missing)}")
    for i, row in enumerate(metrics["rows"]):
        if missing := [k for k in ("name", "paper", "ours") if k not in row]:
            raise ValueError(f"rows[{i}] of the metrics lacks {', '.join(missing)}")
        if row["ours"] is None and not row.get("reason"):
            raise ValueError(f"rows[{i}] of the metrics, {row['name']}: ours is null without a reason")


def comparison(metrics: Mapping[str, Any]) -> list[dict[str, Any]]:
    """A line for each number that the paper has: `name, quantity, paper, ours, ratio, why_not`.

    `ratio` is ours over the paper's, of errors with a sign their sizes; None where either is none, the paper's is 0, or
    ours is of synthetic data, which are not the paper's. `why_not`, the reason where we have no number.
    """
    lines = []
    for row in metrics["rows"]:
        ours = row["ours"] or {}
        for quantity, paper in (row["paper"] or {}).items():
            if _number(paper) is not None:
                own = _number(ours.get(quantity))
                ratio = _ratio(metrics, own, paper)
                reason = None if own is not None else row.get("reason", "not computed")
                lines.append(
                    {
                        "name": readable(row["name"]),
                        "quantity": readable(quantity),
                        "paper": paper,
                        "ours": own,
                        "ratio": ratio,
                        "why_not": reason,
                    }
                )
    return lines


def headlines(metrics: Mapping[str, Any]) -> list[dict[str, Any]]:
    """A line for each row of a run that says which quantity decides (`metrics["headline"]`), whether the paper has it.

    `ratio` as in `comparison`, of errors only; with the spread over starts, where the row has one (`spread`: least,
    median, most).
    """
    quantity, lines = metrics.get("headline"), []
    if quantity is None:
        return lines
    for row in metrics["rows"]:
        paper, own = _number((row["paper"] or {}).get(quantity)), _number((row["ours"] or {}).get(quantity))
        spread = (row["ours"] or {}).get("spread", {})
        lines.append(
            {
                "name": readable(row["name"]), "quantity": readable(quantity), "paper": paper, "ours": own,
                "ratio": None if metrics.get("more_is_better") else _ratio(metrics, own, paper),
                "median": spread.get("median"),
                "range over starts": [spread["least"], spread["most"]] if spread else None,
                "why_not": row.get("reason"),
            }
        )  # fmt: skip
    return lines


def tally(rows: Sequence[Mapping[str, Any]], quantity: str, *, more_is_better: bool = False) -> dict[str, Any]:
    """What metrics hold of the quantity that decides: its key, and in how many rows ours is at least as good."""
    judged = _judged(rows, quantity, more_is_better)
    return {
        "headline": quantity, "more_is_better": more_is_better, "better_than_paper": sum(judged.values()),
        "of": len(judged),
    }  # fmt: skip


def as_good(every: Iterable[Mapping[str, Any]]) -> list[str]:
    """In how many comparisons of several runs on measured data ours is at least as good as the paper: a number that
    stands in several tables counts once."""
    compared: dict[tuple[Any, ...], bool] = {}
    for m in every:
        if not m["synthetic"] and "headline" in m:
            compared |= _judged(m["rows"], m["headline"], m.get("more_is_better", False))
    if not compared:
        return []
    return [f"At least as good as the paper in {sum(compared.values())} of {len(compared)} comparisons."]


def _judged(rows: Sequence[Mapping[str, Any]], quantity: str, more_is_better: bool) -> dict[tuple[Any, ...], bool]:
    """Whether ours is at least as good, by name, quantity and the two numbers; errors with a sign by their sizes."""
    out = {}
    for row in rows:
        paper, own = _number((row["paper"] or {}).get(quantity)), _number((row["ours"] or {}).get(quantity))
        if paper is not None and own is not None:
            out[row["name"], quantity, paper, own] = own >= paper if more_is_better else abs(own) <= abs(paper)
    return out


def merged(lines: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Lines of several runs (`part`, and what `headlines` has), one for each number: its parts are joined."""
    found: dict[tuple[Any, ...], dict[str, Any]] = {}
    parts: dict[tuple[Any, ...], list[str]] = {}
    for x in lines:
        key = (x["name"], x["quantity"], x["paper"], x["ours"])
        found.setdefault(key, dict(x))
        parts.setdefault(key, []).append(x["part"])
    return [{**x, "part": _joined(parts[key])} for key, x in found.items()]


def _joined(parts: Sequence[str]) -> str:
    """`Table 4` and `Table 8` are `Tables 4, 8`."""
    parts = list(dict.fromkeys(parts))
    split = [m for p in parts if (m := re.fullmatch(r"(.*(?:table|figure)) (\d+)", p, re.IGNORECASE))]
    if len(parts) == 1 or len(split) < len(parts) or len({m[1] for m in split}) > 1:
        return ", ".join(parts)
    return f"{split[0][1]}s {', '.join(m[2] for m in split)}"


def decides(lines: Sequence[Mapping[str, Any]]) -> str:
    """The caption of a table of headlines."""
    return DECIDES + (OVER_STARTS if any(x["range over starts"] for x in lines) else "")


def _ratio(metrics: Mapping[str, Any], ours: float | None, paper: float | None) -> float | None:
    return abs(ours / paper) if ours is not None and paper and not metrics["synthetic"] else None


def _number(x: Any) -> float | None:
    return float(x) if isinstance(x, Real) and not isinstance(x, bool) else None


def findings(metrics: Mapping[str, Any]) -> list[str]:
    """What leads a page: how much data there is, what is missing, how it compares, what the run found
    (`metrics["findings"]`), and how many targets it misses."""
    said = []
    if "logs" in metrics:
        n, kind = metrics["logs"], "synthetic" if metrics["synthetic"] else "measured"
        said.append(f"{n} {kind} {'log' if n == 1 else 'logs'}.")
    if metrics["tasks_left_out"]:
        n = metrics["tasks_left_out"]
        said.append(f"Not run: {n} more {'task' if n == 1 else 'tasks'} of the config.")
    if metrics.get("skipped"):
        n = len(metrics["skipped"])
        said.append(f"{n} {'log' if n == 1 else 'logs'} could not be simulated as configured.")
    if metrics["of"] and metrics["synthetic"]:
        better, of = metrics["better_than_paper"], metrics["of"]
        said.append(
            f"At least as good, on synthetic data, as the paper on its own data in {better} of {of} comparisons."
        )
    elif metrics["of"] == 1:
        good = "at least" if metrics["better_than_paper"] else "not"
        of = f" in its main error ({readable(metrics['headline'])})" if "headline" in metrics else ""
        said.append(f"Ours is {good} as good as the paper{of}.")
    elif metrics["of"]:
        said.append(f"At least as good as the paper in {metrics['better_than_paper']} of {metrics['of']} comparisons.")
    said += [line[0].upper() + line[1:] for line in _sentences(metrics.get("findings", []))]
    if short := metrics.get("missed"):
        said.append("One target is missed." if len(short) == 1 else f"{len(short)} targets are missed.")
    return said


def missed(metrics: Mapping[str, Any]) -> list[str]:
    """Targets that a run misses, a line each."""
    return _sentences(metrics.get("missed", []))


def notes(metrics: Mapping[str, Any]) -> list[str]:
    """What a reader needs for the tables and figures of a run."""
    return _sentences(metrics.get("notes", []))


def _sentences(lines: Sequence[str]) -> list[str]:
    """Each with a full stop."""
    return [f"{line.rstrip('.')}." for line in lines]


def numbers(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """The quantities that our side of the rows has, in the order in which they come."""
    return list(dict.fromkeys(k for r in rows for k, v in (r["ours"] or {}).items() if _number(v) is not None))
