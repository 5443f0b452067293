"""The figures of a simulated fleet: routes, slopes and accelerations, consumption, gears, energy, errors."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from hdev_jax.fleet.tally import ACCEL_EDGES, GRADE_EDGES, Tally
from hdev_jax.physics import LIBRARY, Aero, Auxiliary, Grade, Inertia, Rolling, Switch
from hdev_jax.report.canvas import AFTER, BEFORE, GREY, INK, figure, tidy
from hdev_jax.report.fleet.sources import (
    CONSUMPTION,
    CYCLE_LIMITS,
    CYCLE_SPEEDS_KMH,
    PAPER_FLEET_PE,
    PAPER_MODEL_PE,
    ZTBUS,
    ZTBUS_ACCEL,
    ZTBUS_GRADE,
)

__all__ = ["consumption", "cycles", "energy", "errors", "gears", "kind", "routes", "usages"]

WIDTH = 10.0
_USES = {
    "long_haul": ("long haul", "#0072B2"),
    "regional": ("regional", "#56B4E9"),
    "construction": ("construction", "#D55E00"),
    "urban": ("urban delivery, refuse", "#E69F00"),
    "city_bus": ("city bus", "#009E73"),
}
_PLURAL = {"tractor": "tractors", "truck": "rigid trucks", "bus": "city buses", "articulated": "articulated buses"}
_LIMITED = [c.id for c in LIBRARY.values() if c.stage == "battery" and any(isinstance(p, Switch) for p in c.parameters)]
_GROUPS = (
    ("rolling", "#7f6a4f", [Rolling.id]),
    ("air", "#56B4E9", [Aero.id]),
    ("slope and inertia", "#999999", [Grade.id, Inertia.id]),
    ("driveline, declared map", "#CC79A7", ["driveline"]),
    ("auxiliaries, declared", "#F0E442", [Auxiliary.id]),
    ("not declared: tyres and road", "#4a3b28", [c.id for c in LIBRARY.values() if c.goes_with == "weight"]),
    ("not declared: wind, density", "#0072B2", [c.id for c in LIBRARY.values() if c.goes_with == "air"]),
    ("not declared: loads, climate", "#E69F00",
     [c.id for c in LIBRARY.values() if c.stage == "battery" and c.id not in _LIMITED]),
    ("not declared: limits of regeneration", "#D55E00", _LIMITED),
)  # fmt: skip


def kind(tally: Tally) -> str:
    """`tractor`, `truck`, `bus` or `articulated`."""
    v = tally.variant
    if v.bus:
        return "articulated" if "articulated" in v.name else "bus"
    return "tractor" if v.axles.endswith("trailer") else "truck"


def usages(fleet: Sequence[Tally]) -> dict[str, list[Tally]]:
    """Vehicles by use, in the order of the page; uses that the fleet lacks left out."""
    found = {u: [t for t in fleet if t.variant.usage == u] for u in _USES}
    return {u: ts for u, ts in found.items() if ts}


def _label(t: Tally) -> str:
    return f"{t.variant.model}: {t.variant.name}" if t.variant.model else t.variant.name


def routes(fleet: Sequence[Tally]) -> Any:
    """Speed against distance of one route for each use, with the limit, the halts and the road's altitude."""
    shown = [ts[0] for ts in usages(fleet).values()]
    fig = figure(WIDTH, 1.9 * len(shown) + 0.5)
    axes = np.atleast_1d(fig.subplots(len(shown), 1))
    for ax, t in zip(axes, shown, strict=True):
        r = t.route
        ax.set_title(f"{_USES[t.variant.usage][0]}: {_label(t)}, route 1")
        ground = ax.twinx()
        ground.fill_between(r["km"], r["altitude_m"], r["altitude_m"].min() - 20, color="#e8ebee", linewidth=0)
        span = max(np.ptp(r["altitude_m"]), 60.0)
        ground.set_ylim(r["altitude_m"].min() - 20, r["altitude_m"].min() + 2.2 * span)
        ground.set_ylabel("altitude [m]", color=GREY)
        ground.spines["right"].set_visible(False)
        ground.tick_params(length=2.5)
        ax.set_zorder(ground.get_zorder() + 1)
        ax.patch.set_visible(False)
        ax.step(r["km"], 3.6 * r["limit_mps"], where="post", color=GREY, linewidth=0.8, linestyle=(0, (4, 2)))
        ax.plot(r["km"], 3.6 * r["speed_mps"], color=_USES[t.variant.usage][1], linewidth=1.3)
        if len(r["stop_km"]):
            ax.plot(r["stop_km"], np.full(len(r["stop_km"]), 2.0), "^", color=INK, markersize=4)
        ax.set_ylim(0, max(60.0, 3.6 * r["limit_mps"].max() * 1.1))
        ax.set_xlim(0, r["km"][-1])
        ax.set_ylabel("speed [km/h]")
        tidy(ax)
    axes[-1].set_xlabel("distance [km]      dashed: legal limit; triangles: halts; grey: altitude")
    return fig


def cycles(fleet: Sequence[Tally]) -> Any:
    """Slopes and accelerations against a measured cycle and published limits; mean speeds against published cycles."""
    fig = figure(WIDTH, 6.2)
    grid = fig.add_gridspec(2, 2, height_ratios=[1.25, 1.0])
    slope, accel, speed = fig.add_subplot(grid[0, 0]), fig.add_subplot(grid[0, 1]), fig.add_subplot(grid[1, :])
    for use, ts in usages(fleet).items():
        words, colour = _USES[use]
        for ax, name, edges in ((slope, "grade", GRADE_EDGES), (accel, "accel", ACCEL_EDGES)):
            share = np.sum([getattr(t, name) for t in ts], axis=0)
            ax.stairs(100 * share / share.sum(), edges, color=colour, linewidth=1.4, label=words)
    for ax, share, edges in ((slope, ZTBUS_GRADE, GRADE_EDGES), (accel, ZTBUS_ACCEL, ACCEL_EDGES)):
        ax.stairs(100 * np.array(share), edges, color=INK, linewidth=1.2, linestyle=(0, (3, 1.5)), label=ZTBUS)
        ax.set_ylim(bottom=0)
        tidy(ax)
    top = accel.get_ylim()[1]
    for i, (name, (low, high)) in enumerate(CYCLE_LIMITS.items()):
        y = top * (0.97 - 0.075 * i)
        accel.plot([low, high], [y, y], "|-", color=GREY, linewidth=0.9, markersize=6)
        accel.annotate(
            name, (low, y), (-3, 0), textcoords="offset points", fontsize=7, color=GREY, ha="right", va="center"
        )
    accel.set_xlim(-3.3, 2.1)
    slope.set_title("Slope of the road")
    slope.set_xlabel("slope [%]")
    slope.set_ylabel("share of the distance [%]")
    accel.set_title("Acceleration; grey: least and most of published cycles")
    accel.set_xlabel("acceleration [m/s²]")
    accel.set_ylabel("share of the time in motion [%]")
    slope.legend(loc="upper left", fontsize=7, handlelength=1.4, borderaxespad=0.1)
    _speeds(speed, fleet)
    return fig


def _speeds(ax: Any, fleet: Sequence[Tally]) -> None:
    """Mean speed of each vehicle by use, over those of published cycles."""
    uses = usages(fleet)
    for i, (name, value) in enumerate(CYCLE_SPEEDS_KMH.items()):
        ax.axvline(value, color="#c4ccd3", linewidth=1.0, zorder=1)
        level = len(uses) - 0.25 + 0.55 * (i % 3)
        ax.annotate(name, (value, level), fontsize=7, color=GREY, ha="center", va="bottom",
                    bbox={"facecolor": "white", "linewidth": 0, "pad": 0.8})  # fmt: skip
    for i, (use, ts) in enumerate(uses.items()):
        x = [t.sums["km"] / t.sums["hours"] for t in ts]
        ax.plot(x, np.full(len(x), len(uses) - 1 - i), "o", color=_USES[use][1], markersize=5, alpha=0.85)
    ax.set_yticks(range(len(uses)), [_USES[u][0] for u in reversed(uses)])
    ax.set_ylim(-0.6, len(uses) + 1.5)
    ax.set_xlim(0, 85)
    ax.set_title("Mean speed with halts, a dot for each vehicle; lines: published cycles")
    ax.set_xlabel("mean speed [km/h]")
    ax.spines["left"].set_visible(False)
    tidy(ax, grid="x")
    ax.grid(visible=False)


def consumption(fleet: Sequence[Tally]) -> Any:
    """kWh/km of each vehicle, over all trips and the spread of the trips, with what was published for its kind."""
    order = sorted(
        fleet, key=lambda t: (("tractor", "truck", "bus", "articulated").index(kind(t)), t.variant.mass_kg[1])
    )
    rows, y, ticks = [], 0.0, []
    last = ""
    fig = figure(WIDTH, 0.235 * len(order) + 2.4)
    ax = fig.subplots()
    for t in order:
        if kind(t) != last:
            y += 0.0 if not last else 0.8
            last = kind(t)
            y += 1.0
            rows.append((last, y))
        y += 1.0
        low, quarter, most, high = np.percentile(t.kwh_per_km, [5, 25, 75, 95])
        ax.plot([low, high], [y, y], color="#b6c0c9", linewidth=1.2, zorder=2)
        ax.plot([quarter, most], [y, y], color="#8fa3b5", linewidth=5, solid_capstyle="butt", zorder=3)
        ax.plot([t.kwh_km], [y], "o", color=AFTER, markersize=4.5, zorder=4)
        ticks.append((y, _label(t)))
    for name, at in rows:
        for i, (_, value, _) in enumerate(CONSUMPTION[name]):
            ax.plot([value], [at], "D", color=BEFORE, markersize=5, zorder=4)
            ax.annotate(
                str(i + 1), (value, at), (0, 5), textcoords="offset points", fontsize=7, color=BEFORE, ha="center"
            )
        ticks.append((at, f"published, {_PLURAL[name]}"))
    ticks.sort()
    ax.set_yticks([p for p, _ in ticks], [name for _, name in ticks], fontsize=7.5)
    for label in ax.get_yticklabels():
        if label.get_text().startswith("published"):
            label.set_color(BEFORE)
    ax.set_ylim(y + 0.8, 0.2)
    ax.set_xlim(left=0)
    ax.set_xlabel(
        "consumption [kWh/km]      dot: all trips; bar: half of the trips; line: nine in ten; diamond: published"
    )
    tidy(ax, grid="x")
    return fig


def gears(fleet: Sequence[Tally]) -> Any:
    """Gear by speed and load of up to three vehicles with different gearboxes, and the share of each gear."""
    shown: list[Tally] = []
    for count in (12, 4, 2):
        shown += [t for t in fleet if t.variant.gears == count][:1]
    shown = shown or [t for t in fleet if t.variant.gears > 1][:3]
    if not shown:
        return None
    import matplotlib as mpl

    fig = figure(WIDTH, 3.4)
    axes = np.atleast_1d(fig.subplots(1, len(shown), sharey=True))
    for ax, t in zip(axes, shown, strict=True):
        p, n = t.points, t.variant.gears
        colours = mpl.colormaps["viridis"](np.linspace(0.0, 0.95, n))
        ax.scatter(3.6 * p["speed_mps"], 100 * p["load_share"], s=4, color=colours[p["gear"] - 1], linewidth=0)
        for g in range(n):
            inside = p["gear"] == g + 1
            if inside.sum() > 15:
                x = 3.6 * np.median(p["speed_mps"][inside])
                ax.annotate(str(g + 1), (x, 103), fontsize=7, color=INK, ha="center", annotation_clip=False)
        ax.set_title(f"{_label(t)}", pad=14, fontsize=7.5)
        ax.set_xlabel("speed [km/h]")
        ax.set_ylim(0, 102)
        tidy(ax, grid="both")
    axes[0].set_ylabel("power at the wheels over rated [%]")
    return fig


def energy(fleet: Sequence[Tally]) -> Any:
    """What each vehicle's energy goes to, declared and not declared [kWh/km]."""
    fig = figure(WIDTH, 0.22 * len(fleet) + 1.7)
    ax = fig.subplots()
    y = np.arange(len(fleet))[::-1]
    left = np.zeros(len(fleet))
    negative = np.zeros(len(fleet))
    for words, colour, ids in _GROUPS:
        x = np.array([sum(t.parts.get(k, 0.0) for k in ids) / 1e3 / t.sums["km"] for t in fleet])
        if not np.any(x):
            continue
        ax.barh(y, np.maximum(x, 0), left=left, color=colour, height=0.72, label=words)
        ax.barh(y, np.minimum(x, 0), left=negative, color=colour, height=0.72)
        left, negative = left + np.maximum(x, 0), negative + np.minimum(x, 0)
    ax.set_yticks(y, [_label(t) for t in fleet], fontsize=7.5)
    ax.set_ylim(-0.7, len(fleet) - 0.3)
    ax.set_xlim(1.15 * negative.min() if negative.min() < 0 else 0.0, 1.03 * left.max())
    ax.set_xlabel("energy [kWh/km]")
    fig.legend(loc="outside upper center", ncols=3, fontsize=7.5, handlelength=1.2)
    tidy(ax, grid="x")
    return fig


def errors(fleet: Sequence[Tally]) -> Any:
    """Percent error of each sheet's own prediction; the paper's for its four models and its fleet."""
    fig = figure(WIDTH, 0.2 * len(fleet) + 1.5)
    ax = fig.subplots()
    y = np.arange(len(fleet) + 1)[::-1]
    total = 100 * (sum(t.sums["tabular_wh"] for t in fleet) / sum(t.sums["energy_wh"] for t in fleet) - 1)
    values = [t.error_percent() for t in fleet] + [total]
    ax.barh(y, values, color=["#8fa3b5"] * len(fleet) + [AFTER], height=0.66)
    for at, t in zip(y[:-1], fleet, strict=True):
        if t.variant.model:
            ax.plot([PAPER_MODEL_PE[t.variant.model]], [at], "D", color=BEFORE, markersize=6)
    ax.plot([PAPER_FLEET_PE], [0], "D", color=BEFORE, markersize=6, label="paper 1, tables 1 and 2", linestyle="none")
    ax.axvline(0, color=GREY, linewidth=0.8)
    ax.set_yticks(y, [*(_label(t) for t in fleet), "all of the fleet"], fontsize=7.5)
    ax.set_ylim(-0.7, len(fleet) + 0.7)
    ax.set_xlabel("energy by the tabular sheet against measured [%]")
    ax.legend(loc="lower right")
    tidy(ax, grid="x")
    return fig
