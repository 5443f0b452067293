"""Tables of the page of measured logs, from diagnosis.json alone: what each training set finds, and how large."""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import stats

from hdev_jax.diagnosis.gates.rejection import Kind
from hdev_jax.diagnosis.settings import SETTINGS
from hdev_jax.physics import LIBRARY
from hdev_jax.report import names, words

__all__ = [
    "SizeRow",
    "all_found",
    "by_chance",
    "found_ids",
    "found_table",
    "left_table",
    "named",
    "nearest",
    "pooled_interval",
    "pooled_rmse",
    "signature",
    "size_rows",
    "size_table",
    "table",
    "together",
]

Runs = Mapping[str, Mapping[str, Any]]  # diagnosis.json by the name of its training set
IMPOSSIBLE = {Kind.IMPLAUSIBLE, Kind.ABSORBED, Kind.NO_EFFECT}


@dataclass(frozen=True)
class SizeRow:
    """One size in one unit over the training sets: `cells[run]` is (path, value, sd), absent where not found, and
    `intervals[run]` its `interval_90`."""

    paths: tuple[str, ...]  # more than one where the log cannot tell the effects apart
    unit: str
    cells: dict[str, tuple[str, float, float]]
    intervals: dict[str, tuple[float, float]]

    @property
    def label(self) -> str:
        """In words: `copper loss of the motor: power per torque squared`."""
        said = [f"{names.effect(p.partition('.')[0])}: {names.parameter(p.partition('.')[2])}" for p in self.paths]
        return said[0] if len(said) == 1 else names.verbose_join(said, "or")

    @property
    def at_bound(self) -> set[str]:
        """The training sets in which the size ends where its plausible range does: what it says there is the range."""
        return {run for run, (path, value, _) in self.cells.items() if _bounded(path, value)}

    def furthest(self) -> float:
        """The largest difference between two training sets, in standard deviations of that difference."""
        pairs = itertools.combinations(self.cells.values(), 2)
        return max((abs(a[1] - b[1]) / math.hypot(a[2], b[2]) for a, b in pairs), default=math.nan)

    def agrees(self) -> bool:
        """Whether the training sets are no further apart than `by_chance`."""
        return self.furthest() <= by_chance(len(self.cells))


def by_chance(sets: int) -> float:
    """How far the furthest two of so many equal sizes, known equally well, are apart at most in 95 % of cases, in
    standard deviations of a difference: Tukey's studentized range, which is in those of one size, over √2."""
    return float(stats.studentized_range.ppf(0.95, sets, math.inf)) / math.sqrt(2)


def _bounded(path: str, value: float) -> bool:
    id_, _, name = path.partition(".")
    parameters = {p.name: p for p in LIBRARY[id_].parameters} if id_ in LIBRARY else {}
    p = parameters.get(name.partition("[")[0])
    return p is not None and any(math.isclose(value, end, rel_tol=1e-3) for end in (p.lower, p.upper) if end)


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a Markdown table."""
    safe = [[cell.replace("|", "\\|") for cell in row] for row in (head, *rows)]
    lines = [f"| {' | '.join(row)} |" for row in safe]
    return [lines[0], "|" + "---|" * len(head), *lines[1:]]


def named(ids: Sequence[str]) -> str:
    """`copper loss of the motor (`copper_loss`) and …`; `nothing` for none."""
    return names.verbose_join([f"{names.effect(i)} (`{i}`)" for i in ids]) or "nothing"


def found_ids(result: Mapping[str, Any]) -> list[str]:
    """What a run found, in its order."""
    return [e["id"] for e in result["effects"]]


def all_found(runs: Runs) -> list[str]:
    """Every effect that some run found: first what most runs find, then in the order found."""
    order = list(dict.fromkeys(i for r in runs.values() for i in found_ids(r)))
    return sorted(order, key=lambda i: -sum(i in found_ids(r) for r in runs.values()))


def _verdict(id_: str, result: Mapping[str, Any]) -> str:
    """What one run says of one effect: found with its stability, one of a class, or why not."""
    for e in result["effects"]:
        if e["id"] == id_:
            share = f"{e['stability']:.2f}"
            if e["verdict"] == "one_of_class":
                alike = names.verbose_join([f"`{t}`" for t in e["indistinguishable_from"]], "or")
                return f"**one of a class** with {alike}, {share}"
            return f"**found**, {share}"
    for e in result["effects"]:
        if id_ in e["indistinguishable_from"]:
            return f"the same class as `{e['id']}`"
    why = next((c["why_not"] for c in result["candidates"] if c["id"] == id_), "not considered")
    return f"no: {why}"


def found_table(runs: Runs, head: str) -> list[str]:
    """Effect by training set: found or not, and in which share of resampled training sets it comes first."""
    rows = []
    for i in all_found(runs):
        said = [_verdict(i, r) for r in runs.values()]
        alike = sum(s.startswith("the same class") for s in said)
        count = f"{sum(s.startswith('**') for s in said)} of {len(runs)}"
        rows.append([f"{names.effect(i)} (`{i}`)", *said, f"{count}, in class {alike} more" if alike else count])
    return table(["effect", *(f"{head} {k}" for k in runs), "found in"], rows)


def size_rows(runs: Runs) -> list[SizeRow]:
    """Every fitted size of the effects found. Sizes of effects that a run calls one class share a row if their unit
    is the same and no run has two of them; what was chosen among a few (sd 0) is no size."""
    cells: dict[str, dict[str, tuple[str, float, float]]] = {}
    intervals: dict[str, dict[str, tuple[float, float]]] = {}
    units: dict[str, str] = {}
    for run, result in runs.items():
        for e in result["effects"]:
            for name, p in e["parameters"].items():
                if p["sd"] > 0:
                    path = f"{e['id']}.{name}"
                    cells.setdefault(path, {})[run] = (path, p["value"], p["sd"])
                    intervals.setdefault(path, {})[run] = tuple(p["interval_90"])
                    units[path] = p["unit"]
    groups: list[list[str]] = []
    for path in sorted(cells, key=lambda p: -len(cells[p])):
        home = next((g for g in groups if _one_class(path, g, runs, cells, units)), None)
        groups.append([path]) if home is None else home.append(path)
    order = all_found(runs)
    rows = []
    for g in groups:
        there = {k: c for k in runs for p in g if (c := cells[p].get(k)) is not None}
        rows.append(SizeRow(tuple(g), units[g[0]], there, {k: intervals[c[0]][k] for k, c in there.items()}))
    return sorted(rows, key=lambda row: order.index(row.paths[0].partition(".")[0]))


def _one_class(path: str, group: Sequence[str], runs: Runs, cells: Mapping[str, Any], units: Mapping[str, str]) -> bool:
    if units[path] != units[group[0]] or units[path] == "1":  # pure numbers of two effects mean two things
        return False
    ids = {p.partition(".")[0] for p in group}
    alike = {
        frozenset((e["id"], t)) for r in runs.values() for e in r["effects"] for t in e["indistinguishable_from"]
    }  # fmt: skip
    linked = any(frozenset((path.partition(".")[0], i)) in alike for i in ids)
    return linked and not any(set(cells[path]) & set(cells[p]) for p in group)


def size_table(runs: Runs, head: str) -> list[str]:
    """Size ± standard deviation by training set, one unit a row."""
    rows = []
    for row in size_rows(runs):
        paths = " or ".join(f"`{p}`" for p in row.paths)
        size = []
        for run in runs:
            path, value, sd = row.cells.get(run, ("", math.nan, math.nan))
            text = words.plus_minus(value, sd)
            text += ", at its bound" if run in row.at_bound else ""
            size.append(text if len(row.paths) == 1 or not path else f"{text} (`{path.partition('.')[0]}`)")
        apart = row.furthest()
        unit = "–" if row.unit == "1" else row.unit
        rows.append([paths, unit, *size, f"{apart:.1f} sd" if math.isfinite(apart) else "–"])
    return table(["size", "unit", *(f"{head} {k}" for k in runs), "largest difference"], rows)


def nearest(result: Mapping[str, Any]) -> str:
    """The rejected candidate that comes nearest, with its gain and the reason; a dash for none.

    One whose best size is impossible, or that the log cannot tell from a fitted coefficient, is near to nothing.
    """
    found = set(found_ids(result))
    able = [
        c for c in result["candidates"]
        if c["id"] not in found and (c["score"] or 0.0) > SETTINGS.suspicious and c["kind"] not in IMPOSSIBLE
    ]  # fmt: skip
    best = max(able, key=lambda c: c["score"], default=None)
    return "–" if best is None else f"`{best['id']}` (gain {words.number(best['score'])}): {best['why_not']}"


def left_table(runs: Runs, head: str, unit: str) -> list[str]:
    """What each run leaves: error, noise floor, and what the diagnosis says of the rest."""
    rows = []
    for run, r in runs.items():
        u = r["unexplained"]
        on = ", ".join(f"`{c}`" for c in u["depends_on"]) or "–"
        share = words.percent(100 * u["share_of_test_variance"], signed=False) + words.doubt(u)
        rows.append(
            [str(run), r["verdict"].replace("_", " "), words.number(r["after"]["test"]["rmse"]),
             words.number(u["noise_floor_rmse"]), share, on, signature(u), nearest(r)]
        )  # fmt: skip
    return table(
        [head, "verdict", f"test RMSE after [{unit}]", f"noise floor [{unit}]",
         "share of the remaining test variance that LightGBM predicts", "depends on", "what is left",
         "best rejected candidate"],
        rows,
    )  # fmt: skip


def together(runs: Runs) -> list[tuple[str, list[tuple[str, float]]]]:
    """Pairs of strongly correlated coefficients, in words, and their correlation in each training set that has them."""
    found: dict[frozenset[str], list[tuple[str, float]]] = {}
    for run, r in runs.items():
        for *pair, correlation in r["together"]:
            both = frozenset(name.removeprefix("effects.") for name in pair)
            found.setdefault(both, []).append((run, correlation))
    return [(names.verbose_join([f"`{n}`" for n in sorted(pair)]), each) for pair, each in found.items()]


def signature(unexplained: Mapping[str, Any]) -> str:
    """The sentence about what is left, and its formula where it has one."""
    text = str(unexplained["signature"]).removeprefix("What is left: ").removeprefix("What is left ").rstrip(".")
    formula = unexplained.get("expression")
    return f"{text}; formula: `{formula}`" if formula else text


def pooled_interval(by_trip: Mapping[str, Sequence[Mapping[str, Any]]]) -> tuple[float, float]:
    """90 % interval of `pooled_rmse`: trips, with all METRICS blocks of each, are left out in turn (jackknife of the
    logarithm; Student's t of one degree of freedom less than there are trips). Raises `ValueError` for fewer than two.
    """
    if len(by_trip) < 2:
        raise ValueError("one trip says nothing of how trips differ; at least two are expected")
    whole = pooled_rmse([m for blocks in by_trip.values() for m in blocks])
    without = [pooled_rmse([m for k, b in by_trip.items() if k != left for m in b]) for left in by_trip]
    n, off = len(without), np.log(without) - np.mean(np.log(without))  # an error is above 0, and so is its interval
    factor = float(np.exp(stats.t.ppf(0.95, n - 1) * np.sqrt((n - 1) / n * np.sum(off**2))))
    return whole / factor, whole * factor


def pooled_rmse(blocks: Sequence[Mapping[str, Any]]) -> float:
    """RMSE over all rows of several METRICS blocks."""
    return float(np.sqrt(sum(m["mse"] * m["n"] for m in blocks) / sum(m["n"] for m in blocks)))
