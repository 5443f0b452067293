"""The figures about errors and energy: before and after, trips, effects, coefficients, measured and predicted."""

import textwrap
from typing import Any

import numpy as np

from hdev_jax.report import names
from hdev_jax.report.canvas import AFTER, BEFORE, GREY, INK, MEASURED, axis_label, figure, tidy
from hdev_jax.report.data import ReportData, TripLine, same_model, test_rows, total_name, trip_lines
from hdev_jax.report.statistics import stretch, thin

__all__ = [
    "WIDTH",
    "before_after",
    "coefficients",
    "energy_by_effect",
    "legend",
    "measured_predicted",
    "models",
    "residual_by_trip",
    "short",
    "trip_errors",
]

WIDTH = 10.0
NAMED_EFFECTS = 3  # in a title
TITLE_LETTERS = 100  # of a line as wide as a figure
NAMED_TRIPS = 16  # more trips than this are drawn by rank, without names
MOST_TRIPS = 60  # that a box each has room for


def short(name: str, most: int = 24) -> str:
    """A long name with its middle left out."""
    return name if len(name) <= most else f"{name[: most // 2 - 1]}…{name[-(most // 2) :]}"


def models(data: ReportData) -> list[tuple[str, str, str]]:
    """(`before` or `after`, what to call it, colour): one model where nothing was added."""
    if same_model(data):
        return [("after", "calibrated model", AFTER)]
    return [("before", "before: declared model", BEFORE), ("after", "after: with the effects found", AFTER)]


def _dumbbells(ax: Any, lines: list[TripLine], key: str, data: ReportData) -> None:
    """One line a trip from before to after; the test trips full, the others hollow."""
    y = np.arange(len(lines))[::-1].astype(float)
    values = {w: np.array([_number(getattr(t, w).get(key)) for t in lines]) for w in ("before", "after")}
    drawn = models(data)
    if len(drawn) == 2:
        ax.hlines(y, values["before"], values["after"], color="#c4ccd3", linewidth=2, zorder=1)
    full = np.array([t.role == "test" for t in lines])
    size = 34 if len(lines) <= NAMED_TRIPS else 14
    for when, _, colour in drawn:
        x = values[when]
        ax.scatter(x[full], y[full], s=size, color=colour, zorder=3, linewidth=1.1)
        ax.scatter(x[~full], y[~full], s=size, facecolor="white", edgecolor=colour, zorder=3, linewidth=1.3)
    if len(lines) <= NAMED_TRIPS:
        ax.set_yticks(y, [short(t.name) for t in lines])
    else:
        ax.set_yticks([])
        ax.set_ylabel(f"{len(lines)} trips in the order of the log")
    ax.set_ylim(-0.7, len(lines) - 0.3)
    tidy(ax, grid="x")


def _number(x: Any) -> float:
    return float("nan") if x is None else float(x)


def _title(data: ReportData, words: str) -> str:
    """A title that says so where the data are synthetic, for figures without a legend."""
    return f"{words} – synthetic data" if data.synthetic else words


def legend(
    fig: Any, data: ReportData, *, measured: bool = False, dots: bool = False, side: str = "upper"
) -> None:  # fmt: skip
    """One legend above the panels, or below them, where it covers nothing."""
    from matplotlib.lines import Line2D

    line: dict[str, Any] = {"linestyle": "none", "marker": "o", "markersize": 5} if dots else {"linewidth": 1.8}
    handles = [Line2D([], [], color=MEASURED, label="measured", **line)] if measured else []
    if data.synthetic:
        handles.insert(0, Line2D([], [], linestyle="none", label="synthetic data:"))
    handles += [Line2D([], [], color=colour, label=words, **line) for _, words, colour in models(data)]
    fig.legend(handles=handles, loc=f"outside {side} right", ncols=len(handles), handlelength=1.6, columnspacing=1.6)


def _of_class(e: dict[str, Any]) -> str:
    """An effect, with those that the log cannot tell from it in brackets."""
    others = [names.effect(x) for x in e.get("indistinguishable_from") or []]
    return names.effect(e["id"]) + (f" (or {names.verbose_join(others, 'or')})" if others else "")


def before_after(data: ReportData) -> Any:
    """RMSE of each test trip before and after, and the error along a typical stretch of one, below what was measured:
    predictions would hide each other and the measurement."""
    lines = [t for t in trip_lines(data) if t.role == "test"] or trip_lines(data)
    fig = figure(WIDTH, 4.8)
    if effects := data.summary.get("effects", []):
        said = [_of_class(e) for e in effects[:NAMED_EFFECTS]]
        more = [f"{len(effects) - len(said)} more"] if len(effects) > len(said) else []
        title = textwrap.fill(f"Missing in the model: {'; '.join([*said, *more])}", TITLE_LETTERS)
        fig.suptitle(title, x=0.01, ha="left", fontsize=12)
    grid = fig.add_gridspec(2, 2, width_ratios=[1, 1.9], height_ratios=[1, 1.6])
    left = fig.add_subplot(grid[:, 0])
    _dumbbells(left, lines, "rmse", data)
    worst = [_number(t.before.get("rmse")) for t in lines] + [_number(t.after.get("rmse")) for t in lines]
    left.set_xlim(0, 1.07 * max((w for w in worst if np.isfinite(w)), default=1.0) or 1.0)
    left.set_xlabel(f"RMSE per row [{data.unit}]")
    left.set_title("Error of each test trip")
    top = fig.add_subplot(grid[0, 1])
    bottom = fig.add_subplot(grid[1, 1], sharex=top)
    here = stretch(data)
    if here is not None:
        start = data.row("time_s")[here] + 0.5 * data.row("duration_s")[here]
        minutes = float(start[-1] - start[0]) > 600
        t = start / 60 if minutes else start
        top.plot(t, data.row("measured")[here], color=MEASURED, linewidth=1.1, zorder=2)
        for when, _, colour in models(data):
            bottom.plot(t, data.residual(when)[here], color=colour, linewidth=1.1, zorder=3)
        trip = int(data.row("trip")[here.start])
        name = data.trip_names[trip] if trip < len(data.trip_names) else f"trip {trip + 1}"
        top.set_title(f"A typical stretch of {short(name, 30)}")
        bottom.set_xlabel(axis_label("time since start of the trip", "min" if minutes else "s"))
        top.margins(x=0.01)
    top.set_ylabel(axis_label(names.target(data.summary["target"])[1], data.unit))
    top.tick_params(labelbottom=False)
    bottom.set_ylabel(f"error: measured −\npredicted [{data.unit}]")
    tidy(top)
    tidy(bottom, zero=True)
    fig.align_ylabels([top, bottom])
    legend(fig, data, measured=True, side="lower")
    return fig


def trip_errors(data: ReportData) -> Any | None:
    """Error of each trip's total, before and after. None where no trip has one."""
    lines = [t for t in trip_lines(data) if t.role != "unused"]
    if not any(np.isfinite(_number(t.after.get("pe_percent"))) for t in lines):
        return None
    n = len(lines)
    fig = figure(WIDTH, 1.3 + (0.24 * n if n <= NAMED_TRIPS else min(0.07 * n, 4.0)))
    ax = fig.add_subplot()
    _dumbbells(ax, lines, "pe_percent", data)
    ax.axvline(0, color=GREY, linewidth=0.8, zorder=1)
    ax.set_xlabel(f"{total_name(data)[0]} error, predicted − measured [% of measured]")
    ax.set_title("Error of each trip's total (full: test, hollow: training)")
    legend(fig, data, dots=True)
    return fig


def energy_by_effect(data: ReportData) -> Any | None:
    """Horizontal bars of the energy that each effect takes over the test trips, before and after. None without any."""
    before, after = data.breakdown.get("before", {}), data.breakdown.get("after", {})
    ids = sorted({*before, *after}, key=lambda i: -max(abs(before.get(i, 0.0)), abs(after.get(i, 0.0))))
    if not ids:
        return None
    parts = [(k, v, c) for (k, _, c) in models(data) if (v := {"before": before, "after": after}[k])]
    parts = parts or [("before", before, AFTER)]
    fig = figure(WIDTH, 1.2 + 0.38 * len(ids))
    ax = fig.add_subplot()
    y = np.arange(len(ids))[::-1].astype(float)
    height = 0.8 / len(parts)
    widest = max(abs(v.get(i, 0.0)) for _, v, _ in parts for i in ids) or 1.0
    decimals = 0 if widest >= 1000 else 1 if widest >= 10 else 2 if widest >= 1 else 3
    for k, (_, values, colour) in enumerate(parts):
        x = np.array([values.get(i, np.nan) for i in ids])
        place = y + height * (0.5 * (len(parts) - 1) - k)
        ax.barh(place, x, height=0.92 * height, color=colour)
        for v, p in zip(x, place, strict=True):
            if np.isfinite(v):
                gap = 0.006 * widest * (1 if v >= 0 else -1)
                ha = "left" if v >= 0 else "right"
                ax.text(v + gap, p, f"{v:.{decimals}f}".replace("-", "−"), va="center", ha=ha, fontsize=7.5, color=INK)
    ax.axvline(0, color=GREY, linewidth=0.8)
    ax.set_yticks(y, [short(names.effect(i), 44) for i in ids])
    ax.margins(x=0.09)
    ax.set_xlabel(f"energy over the {'test trips' if data.row('test').any() else 'log'} [kWh]")
    ax.set_title("Where the energy goes")
    tidy(ax, grid="x")
    legend(fig, data)
    return fig


def coefficients(data: ReportData) -> Any | None:
    """Each coefficient's posterior against its table, in tabular standard deviations. None where none has a table."""
    found = {
        k: p
        for k, p in data.summary.get("baseline", {}).get("parameters", {}).items()
        if p.get("prior_sd") and p.get("prior_value") is not None
    }
    if not found:
        return None
    fig = figure(WIDTH, 1.15 + 0.34 * len(found))
    ax = fig.add_subplot()
    y = np.arange(len(found))[::-1].astype(float)
    z = np.array([(p["value"] - p["prior_value"]) / p["prior_sd"] for p in found.values()])
    sd = np.array([_number(p.get("sd")) / p["prior_sd"] for p in found.values()])
    ax.axvspan(-2, 2, color="#eef2f5", zorder=0)
    ax.hlines(y, -1, 1, color="#b3bdc6", linewidth=5, zorder=1)
    ax.errorbar(z, y, xerr=np.nan_to_num(sd), fmt="o", color=AFTER, markersize=5, capsize=2.5, zorder=3)
    ax.set_yticks(y, [short(names.coefficient(k)[0], 44) for k in found])
    reach = max(3.0, 1.15 * float(np.max(np.abs(z) + np.nan_to_num(sd))))
    ax.set_xlim(-reach, reach)
    ax.set_ylim(-0.6, len(found) - 0.4)
    ax.set_xlabel("distance from the table [standard deviations of the table]")
    ax.set_title(_title(data, "How far each coefficient moved (dot), its table (thick line ±1, band ±2)"))
    tidy(ax, grid="x")
    return fig


def measured_predicted(data: ReportData) -> Any:
    """Predicted against measured, row by row, and their difference."""
    rows = np.flatnonzero(test_rows(data))
    rows = rows[thin(len(rows), 6000)]
    fig = figure(WIDTH, 4.2)
    left, right = fig.subplots(1, 2)
    x, p = data.row("measured")[rows], data.row("after")[rows]
    alpha = float(np.clip(600 / max(len(rows), 1), 0.12, 0.8))
    words = names.target(data.summary["target"])[1]
    left.scatter(x, p, s=7, color=AFTER, alpha=alpha, linewidth=0, rasterized=True)
    if len(rows):
        ends = np.array([min(x.min(), p.min()), max(x.max(), p.max())])
        left.plot(ends, ends, color=GREY, linewidth=0.9, zorder=3)
    left.set_xlabel(axis_label(f"measured {words}", data.unit))
    left.set_ylabel(axis_label("predicted", data.unit))
    left.set_title(_title(data, "Predicted against measured (line: equal)"))
    right.scatter(p, x - p, s=7, color=AFTER, alpha=alpha, linewidth=0, rasterized=True)
    right.set_xlabel(axis_label(f"predicted {words}", data.unit))
    right.set_ylabel(axis_label("measured − predicted", data.unit))
    right.set_title("What is left")
    tidy(left)
    tidy(right, zero=True)
    return fig


def residual_by_trip(data: ReportData) -> Any:
    """Mean, middle half and 90 % range of each trip's residual."""
    good = test_rows(data)
    trip, residual = data.row("trip")[good], data.residual("after")[good]
    every = list(dict.fromkeys(trip.tolist()))
    ids = every[:MOST_TRIPS]
    fig = figure(WIDTH, 3.0)
    ax = fig.add_subplot()
    q = np.array([np.quantile(residual[trip == i], [0.05, 0.25, 0.75, 0.95]) for i in ids])
    mean = np.array([residual[trip == i].mean() for i in ids])
    x = np.arange(len(ids)).astype(float)
    if len(ids):
        ax.vlines(x, q[:, 0], q[:, 3], color=AFTER, linewidth=1)
        ax.vlines(x, q[:, 1], q[:, 2], color=AFTER, linewidth=6, alpha=0.5)
        ax.plot(x, mean, "o", color=MEASURED, markersize=4)
    if len(ids) <= NAMED_TRIPS:
        known = [data.trip_names[i] if i < len(data.trip_names) else f"trip {i + 1}" for i in ids]
        slant = {"rotation": 25, "ha": "right"} if sum(map(len, known)) > 80 else {}
        ax.set_xticks(x, [short(n, 18) for n in known], **slant)
    else:
        ax.set_xticks([])
        first = f"the first {len(ids)} of " if len(ids) < len(every) else ""
        ax.set_xlabel(f"{first}{len(every)} trips in the order of the log")
    ax.set_xlim(-0.7, max(len(ids), 1) - 0.3)
    ax.set_ylabel(f"measured −\npredicted [{data.unit}]")
    ax.set_title(_title(data, "Error by trip (dot: mean, bar: middle half, line: 90 % of the rows)"))
    tidy(ax, zero=True)
    return fig
