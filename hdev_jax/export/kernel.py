"""A sheet as a function of named columns: the kernel with its coefficients at their values."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hdev_jax.errors import InputError
from hdev_jax.export.exported import LeftOut
from hdev_jax.inference.sheet import Sheet, build
from hdev_jax.physics import EfficiencyMap, ModeChange, StepChange, Vehicle
from hdev_jax.segments import Segments
from hdev_jax.units import AIR_DENSITY_KGPM3, unit_of

__all__ = ["INTERVAL", "Kernel", "check_drive", "kernel_of"]

INTERVAL = ("duration_s", "distance_m", "speed_start_mps", "speed_end_mps")
TIME = "time_s"  # since the start of the trip: an input where an effect goes by it
CHANNELS = ("grade_rad", "mass_kg")  # inputs beside the interval, unless others are asked for
_LAST = 10**6  # a trip after every change that a sheet dates by trips
_TYPICAL = {"ambient_temp_c": 20.0, "battery_temp_c": 20.0, "voltage_v": 600.0, "soc": 0.5, "gear": 1.0}
_TYPICAL |= {"air_density_kgpm3": AIR_DENSITY_KGPM3}
_LATER_S = 1800.0  # into the trip
_MASS_KG = 20e3  # where the sheet has none


@dataclass(frozen=True)
class Kernel:
    """Battery energy of a row [Wh] from named columns.

    **Fields:** `inputs`, names of the columns in order: `INTERVAL`, `time_s` where an effect goes by the time since the
    start of the trip, then channels of a log; `typical`, a value of each
    channel at which it is held where a format has no place for it; `left_out`, what of the sheet is not in `vehicle`.
    """

    sheet: Sheet
    vehicle: Vehicle
    inputs: tuple[str, ...]
    typical: Mapping[str, float]
    left_out: tuple[LeftOut, ...]

    @property
    def channels(self) -> tuple[str, ...]:
        """The inputs beside the interval of driving."""
        return tuple(k for k in self.inputs if k not in INTERVAL)

    def function(self) -> Callable[..., Float[Array, " row"]]:
        """Energy [Wh] of rows from the inputs, one array each, in order."""

        def energy_wh(*columns: Float[Array, " row"]) -> Float[Array, " row"]:
            named: dict[str, Any] = dict(zip(self.inputs, columns, strict=True))
            none = jnp.zeros_like(columns[0], dtype=jnp.int32)
            row = Segments(
                trip=none + _LAST, vehicle=none, time_s=named.pop(TIME, jnp.zeros_like(columns[0])),
                **{k: named.pop(k) for k in INTERVAL}, channels=named,
            )  # fmt: skip
            return self.vehicle.energy(row)

        return energy_wh

    def steady(self, speed_mps: Any, seconds: float = 1.0, **channels: Any) -> Float[np.ndarray, " point"]:
        """Battery power at steady speeds [W], the channels as given, else typical."""
        drive = {
            "duration_s": seconds,
            "distance_m": np.asarray(speed_mps, float) * seconds,
            "speed_start_mps": speed_mps,
        }
        drive |= {"speed_end_mps": speed_mps} | {k: channels.get(k, self.typical[k]) for k in self.channels}
        columns = np.broadcast_arrays(*(np.atleast_1d(np.asarray(drive[k], float)) for k in self.inputs))
        return np.asarray(self.function()(*map(jnp.asarray, columns))) * (3600.0 / seconds)

    def described(self) -> list[dict[str, Any]]:
        """Name, unit and typical value of each input, for the file beside."""
        return [
            {"name": k, "unit": unit_of(k)} | ({"typical": self.typical[k]} if k in self.typical else {})
            for k in self.inputs
        ]


def kernel_of(sheet: Sheet, channels: Iterable[str] | None = None) -> Kernel:
    """The sheet's chain from the road to the battery, with the channels that its effects need.

    **Arguments:** `channels`, which inputs there shall be beside the interval of driving (by default slope, mass and
    what the sheet's effects read). **Raises:** `InputError` where the sheet lacks a coefficient that is in use.
    """
    given = _channels(sheet) if channels is None else tuple(dict.fromkeys(channels))
    if odd := sorted(set(given) & {*INTERVAL, "trip", "vehicle", TIME}):
        raise InputError(f"--channels: {odd[0]} is no channel; {', '.join(INTERVAL)} are inputs in any case")
    declared = sheet.declared.get("mass_kg")
    typical = {k: _TYPICAL.get(k, 0.0) for k in given}
    if "mass_kg" in typical:
        typical["mass_kg"] = declared.value if declared else _MASS_KG
    if "voltage_v" in typical and sheet.nominal_voltage_v is not None:
        typical["voltage_v"] = sheet.nominal_voltage_v
    if "gear" in typical:
        typical["gear"] = float(len(sheet.gear_ratios or ()) or 1)
    built = build(sheet, _rows(1.0, 10.0, 10.0, typical), "road", "energy_wh")
    vehicle = built.vehicle
    left = [LeftOut(*_skipped(note)) for note in built.notes if note.startswith("effect ")]
    for e in vehicle.effects:
        if e.acts_across_rows():
            vehicle = vehicle.minus(e.id)
            left.append(LeftOut(f"effects.{e.id}", "it acts across rows, and every row is computed by itself"))
    for path, d in sheet.declared.items():
        if d.per_vehicle:
            left.append(LeftOut(path, "it differs by vehicle: the first vehicle's value is used"))
    for effect, what in ((StepChange, "the state after the change"), (ModeChange, "the mean over its modes")):
        if vehicle.has(effect.id):
            left.append(LeftOut(f"effects.{effect.id}", f"it differs by trip: {what} is used"))
    if free := [c.path for c in built.table.free]:
        left.append(LeftOut("sd", f"the uncertainty of {', '.join(dict.fromkeys(free))} is not in the file"))
    if (
        isinstance(vehicle.driveline.efficiency, EfficiencyMap)
        and len(sheet.gear_ratios or ()) > 1
        and "gear" not in given
    ):
        left.append(LeftOut("driveline.map", "there is no input 'gear': it is read in the last gear's ratio"))
    timed = (TIME,) if _goes_by_time(vehicle, typical) else ()
    return Kernel(sheet, vehicle, (*INTERVAL, *timed, *given), typical | dict.fromkeys(timed, _LATER_S), tuple(left))


def check_drive(kernel: Kernel, seed: int = 0) -> Segments:
    """Half an hour of stop and go, of steady driving and of hills, in rows of 1 s: what exports are compared on.

    Speeds are sums of cosines that come to rest; the channels but the slope are at their typical values.
    """
    t = np.arange(1800.0)
    town = 7.0 * (1.0 - np.cos(2 * np.pi * t / 75.0)) * (t < 900)
    road = 21.0 * np.clip(np.minimum((t - 900) / 60.0, (1799 - t) / 60.0), 0.0, 1.0) * (t >= 900)
    speed = town + road
    slope = 0.02 * np.sin(2 * np.pi * t / 400.0 + seed)[1:]
    channels = {k: v for k, v in kernel.typical.items() if k != TIME} | (
        {"grade_rad": slope} if "grade_rad" in kernel.typical else {}
    )
    return _rows(1.0, speed[:-1], speed[1:], channels)


def _goes_by_time(vehicle: Vehicle, typical: Mapping[str, float]) -> bool:
    """Whether the energy of a row depends on how long ago the trip began."""
    rows = _rows(1.0, np.full(64, 10.0), 10.0, typical)
    energy = vehicle.energy(eqx.tree_at(lambda s: s.time_s, rows, np.geomspace(0.1, 1e4, 64)))
    return float(jnp.ptp(energy)) > 1e-9 * float(jnp.max(jnp.abs(energy)))


def _rows(duration: Any, start: Any, end: Any, channels: Mapping[str, Any]) -> Segments:
    return Segments.from_arrays(duration_s=duration, speed_start_mps=start, speed_end_mps=end, **channels)


def _channels(sheet: Sheet) -> tuple[str, ...]:
    """Slope, mass, the gear of a map, and what the sheet's effects read, unless an effect wants it absent."""
    found: dict[str, None] = dict.fromkeys(CHANNELS)
    absent: set[str] = set()
    if sheet.efficiency_map is not None and len(sheet.gear_ratios or ()) > 1:
        found["gear"] = None
    for path, d in sheet.declared.items():
        if path.startswith("effects."):
            effect = sheet.library[path.split(".")[1]]
            absent |= {*effect.lacks}
            for need in effect.needs:
                ways = need.split("|")
                if not ("nominal_voltage_v" in ways and sheet.nominal_voltage_v is not None):
                    found[ways[0]] = None
            if d.groups and not d.per_vehicle:
                found |= dict.fromkeys(p.by for p in effect.parameters if p.by)
    return tuple(k for k in found if k not in absent)


def _skipped(note: str) -> tuple[str, str]:
    """What and why, of a note on an effect that is skipped."""
    head, why = note.split(" is skipped: ", 1)
    return f"effects.{head.split()[1]}", why
