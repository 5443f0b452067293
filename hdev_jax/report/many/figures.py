"""Figures of a fleet: effects by vehicle, coefficients in time, energy by cause, consumption."""

import datetime
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from hdev_jax.many.evidence import heavier
from hdev_jax.many.unlike import equations
from hdev_jax.report import names
from hdev_jax.report.canvas import BEFORE, INK, MEASURED, axis_label, figure, tidy
from hdev_jax.report.energy.figures import COLOURS
from hdev_jax.report.figures import WIDTH, short

__all__ = ["condition_curves", "effects_map", "time_line"]

Record = Mapping[str, Any]
MOST_VEHICLES, MOST_EFFECTS, MOST_TRIPS = 60, 24, 4000
STRONGEST = 5.0  # standard errors at which a colour is full
WEEK_S = 604_800.0
LEAST_KWH = 1e-6  # of a flow that is drawn
_CONDITIONS = {
    "speed_kmh": ("speed in motion", "km/h"),
    "ambient_temp_c": ("outside temperature", "°C"),
    "mass": ("mass", "t"),
}


def effects_map(records: Sequence[Record], effects: Sequence[Mapping[str, Any]]) -> Any | None:
    """A cell for each vehicle and effect: its first-order size in standard errors; a dot where the vehicle's own
    diagnosis named it, a star above what its type shows. Vehicles by type; None where nothing was searched."""
    from matplotlib import colormaps

    forms: dict[str, str] = {}
    for e in effects:  # the form that is clearest over the type, else in the vehicle
        forms.setdefault(e["id"], f"{e['id']}.{e['size']} {e['shapes']}".strip())
    there = sorted((r for r in records if r.get("scan") or r.get("effects")), key=lambda r: (r["type"], r["name"]))
    strong: dict[str, float] = {}
    for r in there:
        for s in (r.get("scan") or {}).values():
            strong[s["id"]] = max(strong.get(s["id"], 0.0), abs(_z(s)))
        for e in r["effects"]:
            strong[e["id"]] = np.inf
    of_type = {e["id"] for e in effects if e["found"]}
    ids = sorted(strong, key=lambda k: (k not in of_type, -strong[k]))[:MOST_EFFECTS]
    if not there or not ids:
        return None
    left = len(there) - MOST_VEHICLES
    there = there[:MOST_VEHICLES]
    z = np.full((len(there), len(ids)), np.nan)
    for i, r in enumerate(there):
        for j, id_ in enumerate(ids):
            scan = r.get("scan") or {}
            own = [s for s in scan.values() if s["id"] == id_]
            s = scan.get(forms.get(id_, "")) or max(own, key=lambda s: abs(_z(s)), default=None)
            if s is not None:
                z[i, j] = _z(s)
    fig = figure(WIDTH, 2.0 + max(0.17 * len(there), 1.3))  # the label of the colours has to fit
    ax = fig.add_subplot()
    colours = colormaps["RdBu_r"].with_extremes(bad="0.8")
    image = ax.imshow(z, cmap=colours, vmin=-STRONGEST, vmax=STRONGEST, aspect="auto", interpolation="nearest")
    dots = [(j, i) for i, r in enumerate(there) for j, k in enumerate(ids) if any(e["id"] == k for e in r["effects"])]
    if dots:
        ax.plot(*np.array(dots).T, "o", markerfacecolor="white", markeredgecolor=INK, markersize=4,
                label="named by the vehicle's own diagnosis")  # fmt: skip
        fig.legend(loc="outside lower left")
    ax.set_xticks(np.arange(len(ids)), [short(names.effect(k), 26) + (" ★" if k in of_type else "") for k in ids],
                  rotation=60, ha="right", rotation_mode="anchor", fontsize=7)  # fmt: skip
    ax.set_yticks(np.arange(len(there)), [short(r["name"], 18) for r in there], fontsize=6.5)
    edges = [i for i in range(1, len(there)) if there[i]["type"] != there[i - 1]["type"]]
    for i in edges:
        ax.axhline(i - 0.5, color=INK, linewidth=0.8)
    fig.colorbar(image, ax=ax, label="size in standard errors", pad=0.01, fraction=0.03)
    more = f" (first {MOST_VEHICLES}; {left} more)" if left > 0 else ""
    ax.set_title(f"What each vehicle's log says of each effect{more}; ★: shown by a type")
    return fig


def _z(s: Mapping[str, Any]) -> float:
    return s["value"] / (s["sd"] * heavier(s["clusters"]))


def time_line(records: Sequence[Record], unlike: Sequence[Mapping[str, Any]]) -> Any | None:
    """Each coefficient week by week: a thin line for each vehicle, a thick one for those that changed, with the date.
    None where no trip has a date."""
    from matplotlib.dates import AutoDateLocator, ConciseDateFormatter

    changed = {(e["vehicle"], e["coefficient"]): e for e in unlike if e["kind"] == "change"}
    lines: dict[str, list[tuple[str, np.ndarray, np.ndarray]]] = {}
    units: dict[str, str] = {}
    for r in records:
        course = r.get("course") or {}
        told = course.get("coefficients")
        week = np.floor(np.array([np.nan if x is None else x for x in course.get("started_s", [])], float) / WEEK_S)
        if told is None or not np.isfinite(week).any():
            continue
        gram, score = equations(course)
        at = np.unique(week[np.isfinite(week)])
        # what a week tells of all coefficients at once, drawn a little towards the whole log
        little = 0.1 * gram.sum(axis=0) / len(at)
        moved = np.array(
            [np.linalg.lstsq(gram[week == w].sum(0) + little, score[week == w].sum(0), rcond=1e-10)[0] for w in at]
        )
        for k, name in enumerate(told["names"]):
            if told["declared"][k] and name in r["coefficients"]:
                mine = r["coefficients"][name]
                lines.setdefault(name, []).append((r["name"], (at + 0.5) * WEEK_S, mine["value"] + moved[:, k]))
                units[name] = mine["unit"]
    if not lines:
        return None
    chosen = sorted(lines, key=lambda n: -sum(k == n for _, k in changed))[:4]
    fig = figure(WIDTH, 0.6 + 2.2 * len(chosen))
    axes = fig.subplots(len(chosen), 1, sharex=True, squeeze=False)[:, 0]
    for ax, name in zip(axes, chosen, strict=True):
        colours = iter(COLOURS * 20)
        for vehicle, t, y in lines[name]:
            x = [datetime.datetime.fromtimestamp(s, datetime.UTC) for s in t]
            found = changed.get((vehicle, name))
            if found is None:
                ax.plot(x, y, color="#9fb0bd", linewidth=0.6, alpha=0.6, zorder=1)  # pyright: ignore[reportArgumentType]
                continue
            colour = next(colours)
            ax.plot(x, y, color=colour, linewidth=1.8, label=short(vehicle, 16), zorder=3)  # pyright: ignore[reportArgumentType]
            if found["since"] is not None:
                ax.axvline(datetime.datetime.fromtimestamp(found["since"], datetime.UTC), color=colour, linestyle=":")
        every = np.concatenate([y for _, _, y in lines[name]])
        low, high = np.percentile(every, [1, 99])
        ax.set_ylim(low - 0.25 * (high - low), high + 0.25 * (high - low))
        ax.set_ylabel(axis_label(short(names.coefficient(name)[0], 30), "" if units[name] == "1" else units[name]))
        if ax.get_legend_handles_labels()[0]:
            ax.legend(loc="upper left", ncols=5, fontsize=7)
        tidy(ax)
    locator = AutoDateLocator(maxticks=9)
    axes[-1].xaxis.set_major_locator(locator)
    axes[-1].xaxis.set_major_formatter(ConciseDateFormatter(locator))
    axes[0].set_title("Coefficients week by week; thick: vehicles that changed, dotted: since when")
    return fig


def condition_curves(records: Sequence[Record]) -> Any | None:
    """kWh/100 km of every trip against speed, temperature and mass, with the means of what was measured and of the
    models in equal shares of the trips. None where no trip has energy and distance."""
    trips: dict[str, list[np.ndarray]] = {k: [] for k in ("y", "model", *_CONDITIONS)}
    for r in records:
        c = r.get("course") or {}
        if "kwh" not in c:
            continue
        km = np.asarray(c["km"], dtype=float)
        good = km > 0.5
        trips["y"].append(100 * np.asarray(c["kwh"])[good] / km[good])
        trips["model"].append(100 * np.asarray(c["model_kwh"])[good] / km[good])
        for k in _CONDITIONS:
            x = np.array([np.nan if v is None else v for v in c.get(k, [None] * len(km))], dtype=float)
            trips[k].append(x[good])
    if not trips["y"]:
        return None
    every = {k: np.concatenate(v) for k, v in trips.items()}
    shown = [k for k in _CONDITIONS if np.isfinite(every[k]).sum() > 5 and np.nanstd(every[k]) > 0]
    if not shown or len(every["y"]) < 6:
        return None
    some = np.random.default_rng(0).permutation(len(every["y"]))[:MOST_TRIPS]
    fig = figure(WIDTH, 3.2)
    axes = fig.subplots(1, len(shown), sharey=True, squeeze=False)[0]
    for ax, k in zip(axes, shown, strict=True):
        x, y, model = every[k], every["y"], every["model"]
        ax.plot(x[some], y[some], "o", color="#9fb0bd", markersize=2.2, alpha=0.5, label="trips")
        good = np.isfinite(x)
        parts = np.array_split(np.flatnonzero(good)[np.argsort(x[good], kind="stable")], min(12, good.sum() // 3))
        at = [float(np.mean(x[p])) for p in parts]
        ax.plot(at, [float(np.mean(y[p])) for p in parts], "o", color=MEASURED, markersize=4, label="measured, mean")
        ax.plot(at, [float(np.mean(model[p])) for p in parts], color=BEFORE, linewidth=1.6, label="models, mean")
        words, unit = _CONDITIONS[k]
        ax.set_xlabel(axis_label(words, unit))
        tidy(ax)
    low, high = np.percentile(every["y"], [0.5, 99.5])
    axes[0].set_ylim(min(0.0, low), 1.1 * high)
    axes[0].set_ylabel("kWh/100 km")
    axes[0].set_title("Consumption of the trips")
    handles, words = axes[0].get_legend_handles_labels()
    fig.legend(handles, words, loc="outside upper right", ncols=3)
    return fig
