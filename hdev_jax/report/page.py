"""The HTML page: what the tables hold, put into the templates with the figures inside the file."""

import base64
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from hdev_jax.diagnosis.gates.rejection import Kind
from hdev_jax.diagnosis.settings import SETTINGS
from hdev_jax.report import names, words
from hdev_jax.report.canvas import png, style, svg
from hdev_jax.report.data import ReportData, metrics, same_model, test_rows, total_name, trip_lines
from hdev_jax.report.figures import (
    before_after,
    coefficients,
    energy_by_effect,
    measured_predicted,
    residual_by_trip,
    trip_errors,
)
from hdev_jax.report.posterior import prior_likelihood_posterior
from hdev_jax.report.residuals import drift_course, panels, residual_by_channel, residual_in_time
from hdev_jax.report.statistics import blocks, row_seconds
from hdev_jax.report.switching import loads, switching_loads

__all__ = ["write_calibration_report", "write_page", "write_report"]

_TEMPLATES = Path(__file__).parent / "templates"
CANDIDATES_SHOWN = 8
_SERIES = ("before_after", "switching_loads", "drift_course")  # what one looks at closely
_NO_UNEXPLAINED = {
    "significant": False,
    "share_of_test_variance": None,
    "noise_floor_rmse": None,
    "depends_on": [],
    "signature": "",
}


def write_report(data: ReportData, directory: Path) -> None:
    """Write `report.html` and `figures/*.png` of a diagnosis into a directory; it is made where it is not there.

    The page is one file: figures are inside it, nothing is loaded from anywhere. The same data give the same bytes.
    """
    with style():
        shown, channels = panels(data)
        figures = {
            "before_after": before_after(data),
            "coefficients": coefficients(data),
            "residual_channels": residual_by_channel(data, shown),
            "residual_time": residual_in_time(data),
            "switching_loads": switching_loads(data),
            "drift_course": drift_course(data),
            "energy_by_effect": energy_by_effect(data),
            "trips": trip_errors(data),
        }
        drawn = {name: fig for name, fig in figures.items() if fig is not None}
        images = {name: png(fig) for name, fig in drawn.items()}
        lines = {name: svg(drawn[name]) for name in _SERIES if name in drawn}
    rows = test_rows(data)
    summary = data.summary
    context = {
        **_common(data),
        "what": f"what the model of its {names.target(summary['target'])[0]} lacks",
        "answer": words.answer_parts(data),
        "tiles": _tiles(data),
        "found": [_found(data, e) for e in summary.get("effects", [])],
        "candidates": _candidates(summary),
        "excluded": [{**e, "name": names.effect(e["id"])} for e in summary.get("excluded", [])],
        "unexplained": {**_NO_UNEXPLAINED, **summary.get("unexplained", {})},
        "loads": [_load(e, summary) for e in loads(data)],
        "drift_kwh": _drift_kwh(summary),
        "depends_on": [(c, names.channel(c).label) for c in summary.get("unexplained", {}).get("depends_on") or []],
        "nothing_added": same_model(data),
        "dependence": [p for p in shown if p.name[0] != "\x00"],
        "channels_shown": len(shown),
        "channels": channels,
        "clustered_by": {"trip": "trip", "block": "block of 5 minutes or more"}[blocks(data, rows).kind],
        "row_seconds": row_seconds(data, rows),
        "n_test": int(rows.sum()),
        "stages": _blocks(summary.get("stages", {})),
        "subsets": _blocks(summary.get("subsets", {})),
    }
    write_page("diagnosis.html.j2", context, images, directory, lines)


def write_calibration_report(data: ReportData, directory: Path) -> None:
    """Write `report.html` and `figures/*.png` of a calibration: coefficients, measured against predicted, trips.

    `data.rows["before"]` is the calibrated prediction; `data.summary` needs `target` and `baseline`, and may hold
    `method`, `notes`, `clusters` and `split`. Channels and breakdown may be empty.
    """
    # one model: what a diagnosis would add, and its split, are no part of this page
    rows = {k: v for k, v in data.rows.items() if k not in ("after", "test")}
    data = replace(data, rows=rows, breakdown={"after": data.breakdown.get("before", {})})
    with style():
        figures = {
            "coefficients": coefficients(data),
            "posterior": prior_likelihood_posterior(data),
            "measured_predicted": measured_predicted(data),
            "residual_by_trip": residual_by_trip(data),
            "energy_by_effect": energy_by_effect(data),
        }
        images = {name: png(fig) for name, fig in figures.items() if fig is not None}
    context = {**_common(data), "method": data.summary.get("method", ""), "n_shown": int(test_rows(data).sum())}
    context["what"] = f"calibrated on its {context['target']}"
    context["answer"] = _calibrated(data, context["coefficients"])
    write_page("calibration.html.j2", context, images, directory)


def _calibrated(data: ReportData, rows: list[dict[str, Any]]) -> list[tuple[str, bool]]:
    """The calibration's answer, as (text, bold) pieces."""
    everything = np.flatnonzero(data.row("used"))
    m = metrics(data, everything, "before")
    text = f" at {words.number(m['rmse'])}{words.NBSP}{data.unit} RMSE per row"
    if m["pe_percent"] is not None:
        text += f", {total_name(data)[0]} error {words.percent(m['pe_percent'])}"
    pieces = [("The log fits", True), (f"{text}, over {words.count(m['n'], 'row')}.", False)]
    if moved := [c["name"] for c in rows if c["flag"]]:
        verb = "lies" if len(moved) == 1 else "lie"
        pieces += [(f" {names.verbose_join(moved).capitalize()}", True), (f" {verb} far from the table: ", False)]
        pieces += [("hdev diagnose searches for what may be missing.", False)]
    return pieces


def _common(data: ReportData) -> dict[str, Any]:
    """What both pages show."""
    lines = trip_lines(data)
    return {
        "vehicle": data.vehicle,
        "synthetic": data.synthetic,
        "unit": data.unit,
        "target": names.target(data.summary["target"])[0],
        "summary": data.summary,
        "notes": data.summary.get("notes", []),
        "next_drives": words.next_drives(data.summary),
        "clusters": data.summary.get("clusters", {}),
        "total": total_name(data),
        "trips": lines,
        "trip_count": {r: sum(t.role == r for t in lines) for r in ("train", "test", "unused")},
        "n": {r: sum(t.n for t in lines if t.role == r) for r in ("train", "test", "unused")},
        "coefficients": [_coefficient(k, p) for k, p in data.summary.get("baseline", {}).get("parameters", {}).items()],
        "ledger": [_ledger(e) for e in data.ledger],
        "command": data.command,
        "seconds": data.seconds,
    }


def write_page(
    template: str,
    context: dict[str, Any],
    images: dict[str, bytes],
    directory: Path,
    lines: Mapping[str, bytes] | None = None,
) -> None:
    """`report.html` from a template with the images inside it, and `figures/*.png` beside it; in the page, those of
    `lines` as SVG."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    env = Environment(
        loader=FileSystemLoader(_TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    env.globals.update(
        number=words.number,
        doubt=words.doubt,
        percent=words.percent,
        pair=words.pair,
        plus_minus=words.plus_minus,
        q_value=words.q_value,
        count=words.count,
        join=names.verbose_join,
    )
    kinds = [("png", images), ("svg+xml", lines or {})]
    sources = {
        k: f"data:image/{x};base64,{base64.b64encode(v).decode('ascii')}" for x, all_ in kinds for k, v in all_.items()
    }
    page = env.get_template(template).render(**context, figures=sources)
    folder = directory / "figures"
    folder.mkdir(parents=True, exist_ok=True)
    for name, image in images.items():
        (folder / f"{name}.png").write_bytes(image)
    (directory / "report.html").write_text(page, encoding="utf-8")


def _tiles(data: ReportData) -> list[dict[str, str]]:
    """The numbers that go with the answer: `label`, `value`, `note`."""
    s = data.summary
    before, after, u = s["before"]["test"], s["after"]["test"], s.get("unexplained", {})
    b, a = words.pair(before.get("rmse"), after.get("rmse"))
    same = same_model(data)
    name = total_name(data)[0]
    fit = after.get("fit_percent")
    share = u.get("share_of_test_variance")
    tiles = [
        {
            "label": "Error per row (RMSE)",
            "value": f"{a} {data.unit}" if same else f"{b} → {a} {data.unit}",
            "note": f"test rows, n = {after.get('n', 0):,}",
        },
        {
            "label": f"{name.capitalize()} error",
            "value": words.percent(after.get("pe_percent"))
            if same
            else f"{words.percent(before.get('pe_percent'))} → {words.percent(after.get('pe_percent'))}",
            "note": "all test trips together",
        },
        {
            "label": "Noise floor",
            "value": words.number(u.get("noise_floor_rmse"), 2, data.unit),
            "note": "estimated: the error that nothing in the log predicts",
        },
        {
            "label": "Still predictable",
            "value": words.percent(None if share is None else 100 * share, signed=False, decimals=0),
            "note": "of the variance of the remaining error" + words.doubt(u),
        },
    ]
    if fit is not None:
        start = before.get("fit_percent")
        value = words.percent(fit, signed=False)
        if not same and start is not None:
            value = f"{words.percent(start, signed=False)} → {value}"
        tiles.insert(
            2, {"label": "Fit (NRMSE)", "value": value, "note": "100 % is perfect, 0 % no better than the mean"}
        )
    return tiles


def _found(data: ReportData, e: dict[str, Any]) -> dict[str, Any]:
    """A row of "what was found"."""
    said = names.explained(e["id"])
    stability = e.get("stability")
    return {
        **e,
        "name": names.effect(e["id"]),
        "words": e.get("words") or said.get("words", ""),
        "equation": e.get("equation") or said.get("equation", ""),
        "separated_by": e.get("separated_by") or said.get("separated_by", ""),
        "sizes": [(names.parameter(k, e["id"]), words.known(p)) for k, p in e.get("parameters", {}).items()],
        "stability": words.percent(None if stability is None else 100 * stability, signed=False, decimals=0),
        "twins": [names.effect(t) for t in e.get("indistinguishable_from") or []],
        "rmse": words.pair(e.get("test_rmse_before"), e.get("test_rmse_after")),
    }


def _load(e: dict[str, Any], summary: dict[str, Any]) -> dict[str, Any]:
    """A load that switches: its sentence, its dwell times and its energy in each test trip."""
    state, test = e["state"], summary["split"]["test_trips"]
    return {
        "name": names.effect(e["id"]),
        "said": words.switching(e),
        "on_s": words.number(state["dwell_on_s"], 2, "s"),
        "off_s": words.number(state["dwell_off_s"], 2, "s"),
        "kwh": [(t, *(words.number(x) for x in state["kwh_by_trip"][t])) for t in test if t in state["kwh_by_trip"]],
    }


def _drift_kwh(summary: dict[str, Any]) -> list[tuple[str, ...]]:
    """Energy of what drifts in each test trip, with its interval."""
    kwh = (summary.get("unexplained", {}).get("course") or {}).get("kwh_by_trip", {})
    return [(t, *(words.number(x) for x in kwh[t])) for t in summary["split"]["test_trips"] if t in kwh]


def _candidates(summary: dict[str, Any]) -> dict[str, list[dict[str, Any]]]:
    """Candidates by gain, the leaders apart; those that this log cannot show at the end."""
    rows = [
        {**c, "name": names.effect(c["id"])}
        for c in summary.get("candidates", [])
        if c.get("kind") not in (Kind.FOUND, Kind.DECLARED)  # in the model: shown with effects and coefficients
    ]
    tried = sorted((c for c in rows if c.get("score") is not None), key=lambda c: -c["score"])
    tried += [c for c in rows if c.get("score") is None]
    most = CANDIDATES_SHOWN if len(tried) > CANDIDATES_SHOWN + 2 else len(tried)
    return {"first": tried[:most], "rest": tried[most:]}


def _coefficient(path: str, p: dict[str, Any]) -> dict[str, Any]:
    """A row of the table of coefficients, flagged where it moved far from its own table."""
    name, unit = names.coefficient(path)
    unit = p.get("unit") or unit
    z, prior = p.get("prior_z"), p.get("prior_value")
    if z is None and prior is not None and p.get("prior_sd"):
        z = (p["value"] - prior) / p["prior_sd"]
    return {
        "path": path,
        "name": name,
        "value": words.plus_minus(p.get("value"), p.get("sd"), unit),
        "prior": words.plus_minus(prior, p.get("prior_sd"), unit) if p.get("prior_sd") else "none",
        "z": "–" if z is None else f"{z:+.1f}".replace("-", "−"),
        "flag": z is not None and abs(z) > SETTINGS.far,
        "absorbs": [names.effect(a) for a in p.get("absorbs") or []],
    }


def _ledger(e: dict[str, Any]) -> dict[str, Any]:
    """A row of the ledger; where it happened from `where`, or from the file and the trip."""
    where = e.get("where")
    if where is None:
        where = ", ".join(str(e[k]) for k in ("trip", "file") if e.get(k))
    return {
        "kind": e.get("kind", ""),
        "where": where,
        "column": e.get("column") or "",
        "count": e.get("count") or 0,
        "reason": e.get("reason", ""),
    }


def _blocks(blocks: dict[str, Any]) -> list[dict[str, Any]]:
    """Named before/after metrics (stages, subsets) as rows."""
    rows = []
    for name, block in blocks.items():
        before, after = block.get("before") or {}, block.get("after") or {}
        rows.append(
            {
                "name": name,
                "n": after.get("n") or before.get("n") or 0,
                "rmse": words.pair(before.get("rmse"), after.get("rmse")),
                "pe": (words.percent(before.get("pe_percent")), words.percent(after.get("pe_percent"))),
                "unit": block.get("unit", ""),
            }
        )
    return rows
