"""Tables of a run: Markdown and LaTeX from the same rows; intervals of shares."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from hdev_jax.rundir import Run

__all__ = ["cells", "markdown", "read_markdown", "readable", "tex", "wilson", "worded", "write_tables"]

_TEX = {
    "\\": r"\textbackslash{}", "_": r"\_", "%": r"\%", "&": r"\&", "#": r"\#", "$": r"\$", "{": r"\{", "}": r"\}",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "–": "--", "−": "$-$", "±": r"$\pm$", "µ": r"$\mu$",
    "²": "$^2$", "³": "$^3$", "·": r"$\cdot$", "×": r"$\times$", "°": r"$^\circ$", "η": r"$\eta$", "λ": r"$\lambda$",
    "χ": r"$\chi$",
    "₁": "$_1$", "₂": "$_2$", "₃": "$_3$",
}  # fmt: skip


# What readers see of a key, a column's, a quantity's or a model's, where the key's own words and unit do not say it.
_WORDS = {
    "inside_90": "coverage of 90 % interval [%]", "size_covered_90": "share of coefficients in 90 % intervals",
    "size_within_3_sd": "coefficient within 3 sd",
    "nodes_in_90": "share of nodes in 90 % intervals", "interval_95": "95 % interval", "false_95": "95 % interval",
    "false_percent": "false names [%]", "c_rr": "c_rr", "c_rr_bias_percent": "bias of c_rr [%]",
    "null_logs": "logs without payload error", "payload_logs": "logs with payload error",
    "error_90_percent": "error, 90th percentile [%]",
    "median_half_interval_percent": "half width of 90 % interval [%]",
    "half_interval_percent": "half width of 90 % interval [%]",
    "median_row": "row of the alarm, median", "batch_logs": "logs in which a diagnosis finds it",
    "batch_median_row": "rows that the diagnosis needs, median", "within_twice": "alarm within twice those rows",
    "after_over_noise": "test RMSE over noise",
    "within_5_percent_of_oracle": "within 5 % of a fit that knows the cause",
    "test_over_oracle": "test RMSE over that of a fit that knows the cause",
    "error_over_refit": "test RMSE over that of a fit that knows the cause",
    "named_exactly": "named, or its class", "named_exactly_no_class": "named alone", "mean_class": "names in a class",
    "no_class_of_separable": "named alone, of the separable ones", "no_class_interval_95": "named alone, 95 % interval",
    "no_class_wanted": "named alone, target", "wanted": "target", "met": "target met", "named_first": "top-ranked",
    "blamed": "instrument or payload falsely named", "impossible": "impossible size",
    "blamed_when_nothing": "instrument or payload falsely named, nothing changed", "wanted_range": "target range",
    "redrawn": "drawn anew", "worst_percent": "largest error [%]",
    "test_mean": "test MSE, mean [kW²]", "step_test_mean": "test MSE, one step ahead, mean [kW²]",
    "free_test_mean": "test MSE, free run, mean [kW²]",
    "free_worst_energy_percent": "energy error in free run, worst trip [%]", "physics_tabular": "physics, tables",
    "physics_predicted": "physics, predicted coefficients", "training_mse": "training MSE [kW²]",
    "step_worst_energy_percent": "energy error one step ahead, worst trip [%]",
    "network without physics": "network, physics as input only", "LightGBM, no kernel": "LightGBM, log columns only",
    "network, no kernel": "network, log columns only",
    "duration_min": "duration [min]", "part": "part of the paper or study", "why_not": "why no value",
}  # fmt: skip
NOISES = {  # of the generator, in words
    "white": "white", "ar1": "AR(1)", "ar1_white": "AR(1) + white", "trip_levels": "random intercepts of trips",
    "student_t": "Student's t", "trip_variance": "variance by trip", "random_walk": "random walk",
}  # fmt: skip
_NOISE = re.compile(rf"\b({'|'.join(sorted(NOISES, key=len, reverse=True))})\b")
_UNITS = {
    "percent": "%", "wh": "Wh", "kw": "kW", "kwh": "kWh", "kg": "kg", "mrad": "mrad", "seconds": "s", "mph": "mph",
    "miles": "miles", "mps2": "m/s²", "mps3": "m/s³", "ms": "ms", "c": "°C",
}  # fmt: skip
_SHORT = {"mse": "MSE", "pe": "PE", "rmse": "RMSE", "narx": "NARX", "arx": "ARX", "lightgbm": "LightGBM"}


def readable(key: str) -> str:
    """What a reader sees of a key: `median_error_percent` is `median error [%]`; what is in words already stays."""
    if key in _WORDS or not re.fullmatch("[a-z0-9_]+", key):
        return _WORDS.get(key, key)
    *words, last = key.split("_")
    unit = f" [{_UNITS[last]}]" if words and last in _UNITS else ""
    said = " ".join(_SHORT.get(w, w) for w in (words if unit else [*words, last])) + unit
    return re.sub(r"\btrip(\d+)$", r"trip \1", said)


def worded(text: str) -> str:
    """A name that holds the generator's name of a noise, in words."""
    return _NOISE.sub(lambda m: NOISES[m.group()], text)


def wilson(hits: int, n: int, level: float = 0.95) -> tuple[float, float]:
    """Interval of a share (Wilson 1927): where the truth may be after `hits` of `n`."""
    if n == 0:
        return 0.0, 1.0
    z = float(stats.norm.ppf(0.5 + level / 2))
    p = hits / n
    centre, half = p + z**2 / (2 * n), z * np.sqrt(p * (1 - p) / n + z**2 / (4 * n**2))
    return float((centre - half) / (1 + z**2 / n)), float((centre + half) / (1 + z**2 / n))


def write_tables(run: Run, name: str, rows: Sequence[Mapping[str, Any]], caption: str) -> None:
    """`tables/NAME.md` and `tables/NAME.tex`; columns as they first come in the rows, empty ones left out."""
    lines = cells(rows)
    run.path("tables", f"{name}.md").write_text(markdown(lines, caption), encoding="utf-8")
    run.path("tables", f"{name}.tex").write_text(tex(lines, caption), encoding="utf-8")


def cells(rows: Sequence[Mapping[str, Any]], digits: int = 3) -> list[list[str]]:
    """The head and the rows as text, numbers to so many digits; a row that lacks a column has nothing there. Raises
    `ValueError` where two keys have one head."""
    keys = [k for k in dict.fromkeys(k for r in rows for k in r) if any(r.get(k) is not None for r in rows)]
    if len(heads := [readable(k) for k in keys]) > len(set(heads)):
        raise ValueError(f"two columns of a table would have one head: {heads}")
    return [
        heads,
        *([_cell(readable(r[k]) if k == "model" and k in r else r.get(k), digits) for k in keys] for r in rows),
    ]


def markdown(lines: Sequence[Sequence[str]], caption: str) -> str:
    """A table whose first line is its head, after its caption."""
    head, *body = ([c.replace("|", r"\|") for c in line] for line in lines)
    out = [f"{caption}.", "", f"| {' | '.join(head)} |", "|" + "---|" * len(head)]
    return "\n".join([*out, *(f"| {' | '.join(line)} |" for line in body)]) + "\n"


def read_markdown(path: Path) -> tuple[str, list[list[str]]]:
    """The caption of a table that we wrote, and its lines, the head first."""
    every = path.read_text(encoding="utf-8").splitlines()
    rows = [line[1:-1] for line in every if line.startswith("|") and not line.startswith("|---")]
    caption = " ".join(line for line in every if line and not line.startswith("|"))
    return caption, [[c.strip().replace(r"\|", "|") for c in re.split(r"(?<!\\)\|", row)] for row in rows]


def tex(lines: Sequence[Sequence[str]], caption: str) -> str:
    """The same as a `tabular`, with the caption as a comment."""
    head, *body = (" & ".join("".join(_TEX.get(x, x) for x in c) for c in line) + r" \\" for line in lines)
    out = [r"\begin{tabular}{l" + "r" * (len(lines[0]) - 1) + "}", r"\hline", head, r"\hline", *body, r"\hline"]
    return "\n".join([*out, r"\end{tabular}", f"% {caption}"]) + "\n"


def _cell(x: Any, digits: int) -> str:
    if x is None:
        return "–"
    if isinstance(x, bool):
        return "yes" if x else "no"
    if isinstance(x, float):
        return _plain(x, digits)
    if isinstance(x, list | tuple):
        return " to ".join(_cell(v, digits) for v in x)
    return worded(str(x))


def _plain(x: float, digits: int) -> str:
    """Without an exponent up to a billion."""
    rounded = float(f"{x:.{digits}g}")
    return f"{rounded:,.0f}" if 10.0**digits <= abs(rounded) < 1e9 else f"{x:.{digits}g}"
