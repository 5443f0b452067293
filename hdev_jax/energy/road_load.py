"""Road load A + B·v + C·v² on a flat, dry, straight road in still air, from driving in service."""

import copy
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hdev_jax.energy.fitted import DRAWS, WIDE, Fitted, forgotten, interval
from hdev_jax.errors import InputError
from hdev_jax.inference import insert, linearised, padded
from hdev_jax.inference.sheet import Sheet
from hdev_jax.inference.sheet.schema import Declared
from hdev_jax.physics import Vehicle, unavailable
from hdev_jax.physics.loads import HvacPower
from hdev_jax.physics.road import AirDensity, Crosswind, Headwind
from hdev_jax.physics.tyres import REFERENCE_TEMP_C, RollingLinear, RollingTemperature
from hdev_jax.problem import Problem
from hdev_jax.segments import WITHIN_ROWS, Segments
from hdev_jax.targets import TARGETS
from hdev_jax.units import GRAVITY_MPS2

__all__ = ["NAMES", "SHOWN_KMH", "UNITS", "RoadLoad", "driven_range", "in_service", "open_sheet", "speeds_kmh"]

NAMES = ("A", "B", "C")
UNITS = ("N", "N/(m/s)", "N/(m/s)²")
SHOWN_KMH = (50.0, 80.0)
B_SHARE = 0.2  # of A that B·v is expected to be at most, at 20 m/s (f₁ of UN GTR 15's default loads is 0)
TOGETHER, UNSAID = 0.95, 0.9  # correlation; sd over the table's: beyond these it is said
# effect, its parameter, value and sd: the physics as it is, give or take what a weather station is off by; of rolling
# resistance K₀ = 8.6·10⁻³/K of c_rr (UN GTR 15, annex 4); drag against yaw as the effect has it (SAE J1252)
WEATHER = (
    (Headwind, "scale", 1.0, 0.5),
    (Crosswind, "drag_per_rad2", 2.0, 1.5),
    (AirDensity, "scale", 1.0, 0.1),
    (RollingTemperature, "per_k", -8.6e-3, 4e-3),
)
# Loads at the battery, which would else be a force: buses' cabins lose 0.1 to 1 kW/K (`HvacPower`), trucks' less
LOADS = ((HvacPower, "below_w_per_k", 0.0, 150.0), (HvacPower, "above_w_per_k", 0.0, 150.0))
AUXILIARY_SD_W = 3e3  # of an auxiliary load that the sheet gives without an sd
# What the road load is without: no wind, no bends, dry, nobody ahead.
STILL = {
    "wind_speed_mps": 0.0, "wind_from_rad": 0.0, "heading_rad": 0.0, "curvature_1pm": 0.0, "wet_road": 0.0,
    "gap_m": 1e6, "road_surface": 0.0, "ambient_temp_c": REFERENCE_TEMP_C, "brake_pressure_pa": 0.0, "grade_rad": 0.0,
    "accel_mps2": 0.0,
}  # fmt: skip


@dataclass(frozen=True)
class RoadLoad:
    """Road load of a vehicle of `mass_kg` at the standard air density.

    `abc` A [N], B [N/(m/s)], C [N/(m/s)²] with the ends of their 90 % intervals `lower`, `upper`; the same of the force
    [N] at `speeds_kmh`; `driven_kmh`, the range of speeds that the log has (5 to 95 % of the way); `how` in a sentence.
    """

    abc: Float[np.ndarray, " 3"]
    lower: Float[np.ndarray, " 3"]
    upper: Float[np.ndarray, " 3"]
    speeds_kmh: Float[np.ndarray, " speed"]
    force: Float[np.ndarray, " speed"]
    force_lower: Float[np.ndarray, " speed"]
    force_upper: Float[np.ndarray, " speed"]
    mass_kg: float
    driven_kmh: tuple[float, float]
    how: str
    notes: tuple[str, ...] = ()


def speeds_kmh(driven: tuple[float, float]) -> Float[np.ndarray, " speed"]:
    """Where the force is given: every 5 km/h to beyond what was driven."""
    return np.arange(10.0, max(90.0, driven[1]) + 5.1, 5.0)


def driven_range(segments: Segments) -> tuple[float, float]:
    """Speeds between which 90 % of the way was driven [km/h]."""
    v, x = np.asarray(segments.speed_mps) * 3.6, np.asarray(segments.distance_m)
    order = np.argsort(v)
    share = np.cumsum(x[order]) / max(float(np.sum(x)), 1e-9)
    low, high = (float(v[order][min(np.searchsorted(share, q), len(v) - 1)]) for q in (0.05, 0.95))
    return low, high


def open_sheet(
    sheet: Sheet, mass_kg: float, segments: Segments | None = None, *, battery: bool = True
) -> tuple[Sheet, list[str]]:
    """The sheet with c_rr, C_d·A and B estimated from the log: half of each is its sd, or what the sheet has.

    Weather that the log (`segments`) has, and the sheet no effect for, is corrected as a coast-down's would be: wind
    along and across the road, density of the air, rolling resistance with temperature. Where energy at the `battery` is
    what is measured, loads that would pass for a force are estimated too: the auxiliary one, heating and cooling.

    **Raises:** `InputError` for a sheet without `road.c_rr` or `road.cda_m2`.
    """
    sheet, notes = forgotten(sheet)
    declared = dict(sheet.declared)
    for path in ("road.c_rr", "road.cda_m2"):
        if path not in declared:
            raise sheet.fail(path, "the road load is estimated from it on")
        d = declared[path]
        if d.groups or d.per_vehicle:
            raise InputError(f"sheet {sheet.path}: {path} is per vehicle; the sheet of one vehicle is expected")
        # a table is for vehicles of the kind; what is asked for is this one's, and tables are off by more than they say
        wide = WIDE * max(abs(d.value), 1e-4)
        if d.sd is None or d.sd < wide:
            declared[path] = replace(d, sd=wide)
            notes.append(f"{path} is estimated from this log, as {d.value:g} ± {wide:.2g} before it")
    if not {"road.b_n_per_mps", f"effects.{RollingLinear.id}.n_per_mps"} & {*declared}:
        sd = B_SHARE * declared["road.c_rr"].value * mass_kg * GRAVITY_MPS2 / 20.0
        declared["road.b_n_per_mps"] = Declared(0.0, sd)
        notes.append(f"the sheet has no road.b_n_per_mps: it is estimated, as 0 ± {sd:.2g} N·s/m before the log")
    load = declared.get("battery.auxiliary_w", Declared(0.0))
    if battery and load.sd is None and not load.groups:
        declared["battery.auxiliary_w"] = replace(load, sd=AUXILIARY_SD_W)
        notes.append(
            f"battery.auxiliary_w is estimated beside the load, as {load.value:g} ± {AUXILIARY_SD_W:g} W before"
        )
    added = []
    for effect, parameter, value, sd in (*WEATHER, *(LOADS if battery else ())):
        known = any(p.startswith(f"effects.{effect.id}.") for p in sheet.declared)
        if segments is not None and not known and unavailable(effect, segments, "road") is None:
            size = declared["road.c_rr"].value if effect is RollingTemperature else 1.0
            declared[f"effects.{effect.id}.{parameter}"] = Declared(value * size, sd * size)
            added.append(effect.label)
    if added:
        both = ", ".join(dict.fromkeys(added))
        notes.append(f"corrected for weather in the log, estimated beside the load: {both}")
    other = copy.copy(sheet)
    other.declared = declared
    return other, notes


@eqx.filter_jit
def _forces(vehicle: Vehicle, structure: Any, thetas: Array, rows: Segments, without: tuple[str, ...]) -> Array:
    return jax.lax.map(lambda theta: insert(vehicle, structure, theta).minus(*without).force(rows), thetas)


def in_service(fitted: Fitted, mass_kg: float, *, seed: int = 0) -> RoadLoad:
    """A, B, C of the fitted vehicle: the forces of its road effects at steady speeds through the kernel.

    Effects that fade or that only instruments have (tyres that warm up, a brake that drags, a slope's error) are no
    part of it, nor is the weather: the air has the standard density, and it is 20 °C. **Raises:** `InputError` where
    the chain is entered behind the road, or the log never moves.
    """
    problem = fitted.problem
    if problem.vehicle.entry != "road":
        raise InputError("the log measures torque or force without what separates them from the road: see hdev check")
    if not np.any(np.asarray(problem.segments.distance_m)):
        raise InputError("the log never moves; a log of driving is expected")
    driven = driven_range(problem.segments)
    kmh = speeds_kmh(driven)
    passing = [
        e.id for e in fitted.vehicle.effects if e.id == AirDensity.id or e.acts_across_rows() or e.overrides("sense")
    ]
    car = replace_mass(fitted.vehicle, mass_kg)
    thetas = fitted.draws(seed, DRAWS)
    rows = _steady(problem, kmh / 3.6, mass_kg)
    force = np.asarray(_forces(car, problem.table.structure, jnp.asarray(thetas), rows, tuple(passing)))
    x = np.vander(kmh / 3.6, 3, increasing=True)
    abc = force @ np.linalg.pinv(x).T
    low, high = interval(abc[1:])
    f_low, f_high = interval(force[1:])
    notes = [*fitted.notes, *_left_open(fitted, abc[1:], driven, mass_kg)]
    if fading := [e for e in passing if e != AirDensity.id]:
        notes.append(f"no part of the road load: {', '.join(fading)}")
    return RoadLoad(
        abc[0], low, high, kmh, force[0], f_low, f_high, mass_kg, driven,
        f"{fitted.how}, from {TARGETS[problem.target].label}", tuple(notes),
    )  # fmt: skip


def replace_mass(vehicle: Vehicle, mass_kg: float) -> Vehicle:
    """The same vehicle with this mass."""
    return eqx.tree_at(lambda v: v.mass_kg, vehicle, np.asarray(mass_kg, dtype=float))


def _steady(problem: Problem, v: np.ndarray, mass_kg: float) -> Segments:
    """A row of a second at each speed, every channel of the log at its neutral value, else at its median."""
    logged = problem.segments.without(*WITHIN_ROWS).channels  # a steady speed varies inside no row
    channels = {k: STILL.get(k, float(np.median(np.asarray(x)))) for k, x in logged.items()}
    channels = {k: x for k, x in channels.items() if k != "air_density_kgpm3"}
    if "mass_kg" in logged:
        channels["mass_kg"] = mass_kg
    rows = Segments.from_arrays(duration_s=np.ones(len(v)), speed_start_mps=v, speed_end_mps=v, **channels)
    return padded(rows, np.zeros(len(v)), len(v)).segments


def _left_open(
    fitted: Fitted, abc: Float[np.ndarray, "draw 3"], driven: tuple[float, float], mass_kg: float
) -> list[str]:
    """What this log cannot tell, in sentences."""
    out, table = [], fitted.problem.table
    correlation = np.corrcoef(abc.T)
    for i, j in ((0, 1), (1, 2), (0, 2)):
        if abs(correlation[i, j]) > TOGETHER:
            out.append(
                f"{NAMES[i]} and {NAMES[j]} are known only together (correlation {correlation[i, j]:+.2f}): the force "
                "at the speeds driven is surer than either; driving at other speeds would separate them"
            )
    sd = np.sqrt(np.diag(fitted.covariance))
    for name, c, s in zip((c.path for c in table.free), table.free, sd, strict=True):
        letter = {"road.c_rr": "A", "road.b_n_per_mps": "B", "road.cda_m2": "C"}.get(name)
        if letter and c.sd and s > UNSAID * c.sd:
            out.append(f"{letter}: the log does not determine it; its interval is hardly narrower than before ({name})")
    if not driven[0] < SHOWN_KMH[0] < driven[1] or not driven[0] < SHOWN_KMH[1] < driven[1]:
        out.append(
            f"90 % of the way was driven at {driven[0]:.0f} to {driven[1]:.0f} km/h: forces at other speeds are "
            "extrapolated"
        )
    return [*out, *_held(fitted, mass_kg)]


def _held(fitted: Fitted, mass_kg: float) -> list[str]:
    """By how much A would be another if what the sheet holds were: auxiliary load, efficiency."""
    problem, out = fitted.problem, []
    if not TARGETS[problem.target].of_battery:
        return out
    table = problem.table
    rows = padded(problem.segments, problem.measured)
    for path, step, words in (("battery.auxiliary_w", 1e3, "1 kW"), ("driveline.efficiency", 0.01, "0.01")):
        if any(c.path == path for c in table.free) or not any(c.path == path for c in table.rows):
            continue
        opened = replace(table, rows=tuple(replace(c, free=c.free or c.path == path) for c in table.rows))
        _, slopes = linearised(fitted.vehicle, opened, rows.segments, problem.target)
        slopes = slopes[: rows.rows]
        at = [c.path for c in opened.free].index(path)
        kept = np.delete(slopes, at, axis=1)
        precision = np.diag([0.0 if c.sd is None else 1.0 / c.sd**2 for c in table.free])
        noise = max(float(np.var(problem.measured - fitted.predicted)), 1e-12)
        moved = -np.linalg.solve(kept.T @ kept / noise + precision, kept.T @ slopes[:, at] / noise)
        k = [c.path for c in table.free].index("road.c_rr")
        force = step * float(moved[k]) * mass_kg * GRAVITY_MPS2
        out.append(f"{path} is not estimated: if it were {words} higher, A would change by {force:+.3g} N")
    return out
