"""The page of the effects, made from their classes: each with its figure, the same drive for all of them."""

import io
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
from mkdocs.structure.files import File, Files

import hdev_jax
from hdev_jax.compiling import compile_quickly, keep_compiled
from hdev_jax.fleet import synthetic_log
from hdev_jax.physics import (
    LIBRARY,
    Aero,
    Auxiliary,
    Driveline,
    Effect,
    Grade,
    Grouped,
    Inertia,
    Rolling,
    Size,
    Switch,
    Vehicle,
    at_null,
    most_group,
    unavailable,
)
from hdev_jax.report.names import effect as name_of
from hdev_jax.segments import Segments

__all__ = ["on_files"]

STAGES = {
    "sensors": "Instruments and inputs",
    "road": "Road: forces at the wheels",
    "driveline": "Driveline",
    "machine": "Machine and inverter",
    "battery": "Battery and loads",
}
LEAD = """# The library of effects

{count} effects that a declared model may lack. `hdev effects` lists them in a terminal, `hdev diagnose` tries those
whose channels the log has. The figures show one drive of an 18 t truck (synthetic, 1 Hz): the power that the effect
adds, over time and against speed, at the size given under the figure. Grey: the vehicle's speed. This page is made from
the classes in `hdev_jax/physics/`.

"""
GREY, BLUE = "#9aa5b1", "#0b6e99"


def on_files(files: Files, config: Any) -> Files:
    """Adds the page and its figures to the site."""
    mpl.use("Agg")
    jax.config.update("jax_enable_x64", True)
    compile_quickly()
    keep_compiled()
    parts = [LEAD.format(count=len(LIBRARY))]
    drives = {entry: _drive(entry) for entry in ("road", "shaft")}
    for stage, title in STAGES.items():
        parts.append(f"## {title}\n")
        for c in (c for c in LIBRARY.values() if c.stage == stage):
            size, png = _figure(c, drives)
            src = f"effects/{c.id}.png"
            if png:
                files.append(File.generated(config, src, content=png))
            parts += _section(c, src, size)
    files.append(File.generated(config, "effects.md", content="\n".join(parts)))
    return files


def _section(c: type[Effect], figure: str, size: str) -> Iterator[str]:
    summary = " ".join((c.__doc__ or "").split("\n\n")[0].split())
    yield f"### {name_of(c.id)} {{ #{c.id} }}\n"
    yield f"`{c.id}`: {c.equation}\n\n{summary}\n"
    if size:
        yield f"![Power that {name_of(c.id)} adds over a drive and against speed]({figure})\n\n*{size}*\n"
    else:
        yield "*Without a figure: by itself, on a vehicle that has none of the other effects, it adds nothing.*\n"
    mistaken = [f"[{name_of(i)}](#{i})" if i in LIBRARY else name_of(i) for i in c.mistaken_for]
    facts = {
        "parameters": "; ".join(f"`{p.name}` [{p.unit}], {p.lower:g} to {p.upper:g}" for p in c.parameters),
        "needs": ", ".join(" or ".join(f"`{n}`" for n in need.split("|")) for need in c.needs),
        "may be mistaken for": ", ".join(mistaken),
        "distinguished by": c.separated_by,
        "source": c.source,
    }
    yield "\n".join(f"- {k}: {v}" for k, v in facts.items() if v) + "\n"


def _drive(entry: str) -> tuple[Vehicle, Segments]:
    """A truck and fifteen minutes of its driving, with every channel that an effect may read."""
    frame = synthetic_log(seed=4, trips=1, rows_per_trip=900, mode="samples", entry=entry).frame
    t = np.arange(len(frame))
    frame["gap_m"] = 40.0 + 25.0 * np.sin(t / 60.0)
    frame["passengers"] = (t // 120) % 40
    frame["road_surface"] = (t // 200) % 2
    frame["hvac_power_w"] = 3000.0 + 1000.0 * np.sin(t / 90.0)
    frame["accel_mps2"] = np.gradient(frame["speed_mps"].to_numpy()) + 9.81 * np.sin(frame["grade_rad"].to_numpy())
    segments = jax.tree.map(jnp.asarray, hdev_jax.Log.from_frame(frame).segments)
    terms = [Inertia(1.03), Grade(), Rolling(0.006), Aero(5.6), Auxiliary(2500.0)]
    car = Vehicle(terms, mass_kg=18e3, driveline=Driveline(0.91), entry=entry, nominal_voltage_v=650.0)
    return car, segments


def _typical(c: type[Effect], segments: Segments) -> tuple[Effect, str]:
    """The effect at a size that vehicles have, and its values in words."""
    null = at_null(c, gears=most_group(segments))
    values, words = {}, []
    for p in c.parameters:
        value: Any = getattr(null, p.name)
        if isinstance(p, Size | Switch) and not _idle(c, p.name):
            number = p.null + p.scale if isinstance(p, Size) else float(p.grid[len(p.grid) // 2])
            value = Grouped(jnp.full_like(value.values, number), value.by) if isinstance(value, Grouped) else number
            words.append(f"{p.name} {number:g} {p.unit}")
        elif isinstance(p, Switch):
            value = None
        elif np.ndim(value) == 0 and np.isfinite(float(value)):
            words.append(f"{p.name} {float(value):g} {p.unit}")
        values[p.name] = value
    return c(**values), ", ".join(words)


def _idle(c: type[Effect], name: str) -> bool:
    """Of sizes that are tried in turn only the first set is shown."""
    return bool(c.variants) and name not in c.variants[0]


def _figure(c: type[Effect], drives: dict[str, tuple[Vehicle, Segments]]) -> tuple[str, bytes]:
    from matplotlib.figure import Figure

    entry = next((e for e in ("road", "shaft") if e in c.entries), "road")
    car, segments = drives[entry]
    segments = segments.without(*(n for n in c.lacks if segments.has(n)))
    if why := unavailable(c, segments, entry, car.stands_in):
        raise ValueError(f"the figure of {c.id}: {why}")
    e, words = _typical(c, segments)
    added = np.asarray(car.plus(e).power(segments) - car.power(segments)) / 1e3
    if not np.any(np.abs(added) > 1e-6):
        return "", b""
    minutes, speed = np.asarray(segments.time_s) / 60.0, np.asarray(segments.speed_mps) * 3.6
    fig = Figure(figsize=(7.2, 2.0), dpi=110, layout="constrained")
    left, right = fig.subplots(1, 2, width_ratios=(2.4, 1.0))
    left.fill_between(minutes, speed, color=GREY, alpha=0.3, linewidth=0)
    left.set_ylabel("speed [km/h]", color="#5f6b76")
    over = left.twinx()
    over.plot(minutes, added, color=BLUE, linewidth=1.0)
    over.set_ylabel("added [kW]", color=BLUE)
    left.set_xlabel("time [min]")
    right.plot(speed, added, ".", color=BLUE, markersize=1.5)
    right.set_xlabel("speed [km/h]")
    for ax in (left, over, right):
        ax.spines[["top"]].set_visible(False)
    buffer = io.BytesIO()
    fig.savefig(buffer, format="png", metadata={"Software": None})
    return words, buffer.getvalue()
