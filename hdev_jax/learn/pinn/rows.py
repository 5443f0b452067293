"""Rows as a physics-informed network reads them: features, and for each row the declared vehicle that it is of.

Rows of different vehicles stand in one array: every coefficient of the declared vehicle is a column, and so are the
ratio and the efficiency of its driveline. The efficiency is that of the sheet's map, at the row's gear and at the
motor's speed and torque by the vehicle's force (paper 1: from calibration maps by gear and torque).
"""

from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hdev_jax.errors import InputError
from hdev_jax.physics import Driveline, Effect, Vehicle
from hdev_jax.physics.across import DISTANCE_SINCE_START, distance_since_start
from hdev_jax.physics.driveline import WHEEL_RADIUS_M
from hdev_jax.segments import Column, Ids, Segments
from hdev_jax.units import GRAVITY_MPS2

__all__ = [
    "FEATURES",
    "PHYSICAL",
    "Rows",
    "concatenated",
    "energy",
    "row_wise",
    "rows_of",
    "wheel_energy",
    "with_coefficients",
]

_REFERENCE_M = 100.0  # the length of the paper's segments; √(g·100 m) is the unit of speed
_REFERENCE_KG = 20e3
_PADDED = 4096

# The paper's three; with what the physics needs besides; with everything that has no unit; and for black boxes without
# any kernel the log's own columns and the sheet's numbers, hardly anything being worked out of them (angles have a sine
# and a cosine, and the way since the start stands for warmth).
_PRINTED = ("speed_mps", "mass_kg", "grade_rad")
_CHANNELS = (*_PRINTED, "accel_mps2", "c_rr_table", "cda_table")
_UNITLESS = (
    "acceleration", "slope", "froude", "pace", "kinetic", "c_rr_table", "drag_over_weight", "specific_energy",
    "duration", "length", "elapsed", "mass_of_sheet", "temperature", "wind_along", "wind_across", "wet", "surface_1",
    "surface_2", "surface_3", "warmth", "cornering", "efficiency", "halt",
)  # fmt: skip
_RAW = (
    *_CHANNELS, "duration_s", "distance_m", "ambient_temp_c", "mass_table_kg", "auxiliary_table_w", "time_s",
    "wind_speed_mps", "wind_sine", "wind_cosine", "wet_road", "surface_1", "surface_2", "surface_3", "curvature_1pm",
    "gear", DISTANCE_SINCE_START,
)  # fmt: skip
_COLUMNS = ("grade_rad", "ambient_temp_c", "wind_speed_mps", "wet_road", "curvature_1pm", "gear", DISTANCE_SINCE_START)
FEATURES: dict[str, tuple[str, ...]] = {"printed": _PRINTED, "channels": _CHANNELS, "unitless": _UNITLESS, "raw": _RAW}
# Those that a coefficient may depend on: not the power that is asked for, nor how steep it is.
PHYSICAL = ("froude", "temperature", "wind_along", "wind_across", "wet", "surface_1", "surface_2", "surface_3",
            "warmth", "cornering")  # fmt: skip


class Rows(eqx.Module):
    """Rows of any number of vehicles, in float32. `car` has a value of each coefficient for each row.

    `vehicle` counts the vehicles that a model was trained on; one that it was not has the number after the last.
    `weight` is 0 for a row that only fills an array; `across_wh` is energy that effects across rows add to it;
    `loose_wh` what one standard deviation of something that its whole trip shares and the log does not show (a mass
    that is off) adds to it, with its sign. `unit` is the unit of an energy: where no feature is the mass, the row's
    over 20 t, as an energy without units is one over a weight; otherwise 1.
    """

    features: Float[Array, "*row feature"] | Float[np.ndarray, "*row feature"]
    segments: Segments
    car: Vehicle
    energy_wh: Column
    vehicle: Ids
    weight: Column
    across_wh: Column
    loose_wh: Column
    unit: Column

    def __len__(self) -> int:
        return self.energy_wh.shape[0]

    def take(self, at: Any) -> "Rows":
        """Rows by index or mask."""
        return jax.tree.map(lambda x: x[at], self)

    @property
    def c_rr(self) -> Column:
        """The table's rolling resistance coefficient."""
        return self.car.effect("rolling").c_rr

    @property
    def cda_m2(self) -> Column:
        """The table's drag area [m²]."""
        return self.car.effect("aero").cda_m2


def with_coefficients(car: Vehicle, c_rr: Any, cda_m2: Any, *effects: Effect) -> Vehicle:
    """The vehicle with these two coefficients, and these effects besides."""
    where = lambda c: (c.effect("rolling").c_rr, c.effect("aero").cda_m2)  # noqa: E731
    return eqx.tree_at(where, car, (c_rr, cda_m2)).plus(*effects)


def energy(car: Vehicle, segments: Segments) -> Float[Array, " row"]:
    """Battery energy of each row by the kernel [Wh], each row with its own vehicle (paper 1, equation 5)."""
    return jax.vmap(lambda c, s: c.energy(jax.tree.map(lambda x: x[None], s))[0])(car, segments)


def wheel_energy(car: Vehicle, segments: Segments) -> Float[Array, " row"]:
    """Energy at the wheels of each row by the kernel [Wh] (paper 1, equation 4)."""
    force = jax.vmap(lambda c, s: c.force(jax.tree.map(lambda x: x[None], s))[0])(car, segments)
    return force * segments.distance_m / 3600.0


def row_wise(effect: Effect | type[Effect]) -> bool:
    """Whether an effect acts within a row. Only those can be part of a network's physics, whose rows are shuffled."""
    kind = effect if isinstance(effect, type) else type(effect)
    return not any(getattr(kind, hook) is not getattr(Effect, hook) for hook in ("across", "observe"))


def rows_of(
    vehicle: Vehicle,
    segments: Segments,
    energy_wh: np.ndarray,
    *,
    number: int,
    features: Sequence[str] = _UNITLESS,
    effects: Sequence[Effect] = (),
    calibrated: Vehicle | None = None,
    across_wh: np.ndarray | None = None,
    loose_wh: np.ndarray | None = None,
) -> Rows:
    """The rows of one declared vehicle.

    **Arguments:** `vehicle`, as it is declared, entered at the road; `number`, its place among the vehicles;
    `features`, names of `FEATURES`; `effects`, those whose channels are to be worked out by trip; `calibrated`, the
    vehicle at whose force the efficiency is read and whose energy is a feature, in the place of the declared one;
    `across_wh` [row], what effects across rows add to each row's energy, which its own channels do not show (none: 0);
    `loose_wh` [row], what one standard deviation of what a trip's rows share and the log does not show adds (none: 0).

    **Raises:** `InputError` for a vehicle that is not entered at the road or lacks rolling or aero, for an effect that
    acts across rows, for an unknown feature and for a channel that a feature needs and the log lacks.
    """
    if vehicle.entry != "road" or not (vehicle.has("rolling") and vehicle.has("aero")):
        raise InputError("the network's physics: a vehicle with rolling and aero, entered at the road, is expected")
    if whole := [e.id for e in (*vehicle.effects, *effects) if not row_wise(e)]:
        raise InputError(
            f"the network's physics: {whole[0]} acts across rows, which are shuffled; hand over what it moves"
        )
    n = len(segments)
    padding = np.minimum(np.arange(-(-n // _PADDED) * _PADDED), n - 1)  # logs of about one length share a program
    s, sheet = jax.tree.map(
        lambda x: np.asarray(x)[:n], _sheet(calibrated or vehicle, segments.take(padding), tuple(effects))
    )
    columns = [_feature(name, s, vehicle, sheet) for name in features]
    # a gear ratio of 1, so that ratio and efficiency are the row's own
    back = vehicle.driveline.regenerating_efficiency
    line = Driveline(
        sheet["efficiency"],
        None,
        sheet["ratio"] * WHEEL_RADIUS_M,
        np.full(n, WHEEL_RADIUS_M),
        covers_machine=True,
        regenerating_efficiency=None if back is None else np.full(n, back),
    )
    wide = lambda x: np.broadcast_to(np.asarray(x, float), (n, *np.shape(x)))  # noqa: E731
    plain = Vehicle(
        vehicle.effects, mass_kg=vehicle.mass_kg, machine=vehicle.machine, nominal_voltage_v=vehicle.nominal_voltage_v
    )
    car = eqx.tree_at(lambda c: c.driveline, jax.tree.map(wide, plain), line)
    car = eqx.tree_at(lambda c: c.driveline.efficiency, car, sheet["efficiency"])
    small = lambda x: np.asarray(x, np.float32) if np.issubdtype(np.asarray(x).dtype, np.floating) else np.asarray(x)  # noqa: E731
    s = Segments(
        np.asarray(s.trip, np.int32), np.full(n, number, np.int32), s.time_s, s.duration_s, s.distance_m,
        s.speed_start_mps, s.speed_end_mps, s.channels,
    )  # fmt: skip
    return Rows(
        np.stack(columns, axis=1).astype(np.float32), jax.tree.map(small, s), jax.tree.map(small, car),
        np.asarray(energy_wh, np.float32), np.full(n, number, np.int32), np.ones(n, np.float32),
        *(np.zeros(n, np.float32) if x is None else np.asarray(x, np.float32) for x in (across_wh, loose_wh)),
        unit=(np.ones(n) if "mass_kg" in features else _mass(s, vehicle) / _REFERENCE_KG).astype(np.float32),
    )  # fmt: skip


def concatenated(parts: Sequence[Rows]) -> Rows:
    """Rows one after the other; all must have the same channels."""
    shared = set.intersection(*(set(p.segments.channels) for p in parts))
    kept = [eqx.tree_at(lambda r: r.segments, p, p.segments.without(*set(p.segments.channels) - shared)) for p in parts]
    return jax.tree.map(lambda *x: np.concatenate(x), *kept)


@eqx.filter_jit
def _sheet(vehicle: Vehicle, segments: Segments, effects: tuple[Effect, ...]) -> tuple[Segments, dict[str, Array]]:
    """The rows with what is worked out by trip, and what the vehicle says of each: energy, ratio and efficiency of the
    driveline."""
    if not segments.has(DISTANCE_SINCE_START):
        segments = segments.with_channels(**{DISTANCE_SINCE_START: distance_since_start(segments)})
    for e in effects:
        segments = e.derive(segments)
    force = vehicle.force(segments)

    def one(row: Segments, f: Array) -> tuple[Any, Any]:
        ratio = vehicle.driveline.ratio_radpm(row)
        eta = vehicle.driveline.efficiency_at(row, row.speed_mps * ratio, f / ratio)
        return jnp.broadcast_to(eta, f.shape), jnp.broadcast_to(ratio, f.shape)

    eta, ratio = jax.vmap(one)(jax.tree.map(jnp.asarray, segments), force)
    return segments, {"energy": vehicle.energy(segments), "efficiency": eta, "ratio": ratio}


def _mass(s: Segments, vehicle: Vehicle) -> np.ndarray:
    return np.asarray(s.get("mass_kg", float(vehicle.mass_kg))) * np.ones(len(s))


def _feature(name: str, s: Segments, vehicle: Vehicle, sheet: Mapping[str, np.ndarray]) -> np.ndarray:
    """A column of `FEATURES`. Every one of `_UNITLESS` is a ratio of two quantities of the same kind."""
    if name not in (known := tuple(dict.fromkeys(n for f in FEATURES.values() for n in f))):
        raise InputError(f"no feature {name!r}; they are {', '.join(known)}")
    one = np.ones(len(s))
    mass = _mass(s, vehicle)
    square = np.asarray(s.square_speed_m2ps2)
    weight = mass * GRAVITY_MPS2
    unit = GRAVITY_MPS2 * _REFERENCE_M
    cda, c_rr = float(vehicle.effect("aero").cda_m2), float(vehicle.effect("rolling").c_rr)

    def channel(key: str) -> np.ndarray:
        if not s.has(key):
            raise InputError(f"feature {name}: the log has no {key}; leave that feature out, or add the column")
        return np.asarray(s.channels[key])

    def wind() -> np.ndarray:
        return channel("wind_from_rad") - channel("heading_rad")

    match name.rpartition("_"):
        case "surface", _, k:
            return (channel("road_surface") == int(k)) * one
        case _ if name in ("speed_mps", "accel_mps2", "time_s", "duration_s", "distance_m"):
            return np.asarray(getattr(s, name))
        case _ if name == "mass_kg":
            return mass
        case _ if name in _COLUMNS:
            return channel(name) * one
        case "wind", _, "sine":
            return np.sin(wind())
        case "wind", _, "cosine":
            return np.cos(wind())
        case _ if name == "mass_table_kg":
            return float(vehicle.mass_kg) * one
        case _ if name == "auxiliary_table_w":
            return (float(vehicle.effect("auxiliary").auxiliary_w) if vehicle.has("auxiliary") else 0.0) * one
        case _ if name == "c_rr_table":
            return c_rr * one
        case _ if name == "cda_table":
            return cda * one
        case _ if name == "acceleration":
            return np.asarray(s.accel_mps2) / GRAVITY_MPS2
        case _ if name == "slope":
            return np.sin(channel("grade_rad"))
        case _ if name == "froude":
            return square / unit
        case _ if name == "pace":
            return np.square(np.asarray(s.speed_mps)) / unit
        case _ if name == "length":
            return np.asarray(s.distance_m) / _REFERENCE_M
        case _ if name == "elapsed":
            return np.asarray(s.time_s) * np.sqrt(GRAVITY_MPS2 / _REFERENCE_M) / 1e3
        case _ if name == "kinetic":
            return (np.asarray(s.speed_end_mps) ** 2 - np.asarray(s.speed_start_mps) ** 2) / (2.0 * unit)
        case _ if name == "drag_over_weight":
            return np.asarray(vehicle.drag(s)) * square / weight
        case _ if name == "specific_energy":
            return sheet["energy"] * 3600.0 / (weight * _REFERENCE_M)
        case _ if name == "duration":
            return np.asarray(s.duration_s) * np.sqrt(GRAVITY_MPS2 / _REFERENCE_M) / 10.0
        case _ if name == "mass_of_sheet":
            return mass / float(vehicle.mass_kg)
        case _ if name == "temperature":
            return (channel("ambient_temp_c") - 20.0) / 293.15
        case _ if name == "wind_along":
            v, w = np.asarray(s.speed_mps), channel("wind_speed_mps") * np.cos(wind())
            return ((v + w) * np.abs(v + w) - v * v) / unit
        case _ if name == "wind_across":
            return np.square(channel("wind_speed_mps") * np.sin(wind())) / unit
        case _ if name == "wet":
            return channel("wet_road")
        case _ if name == "warmth":
            return np.exp(-channel(DISTANCE_SINCE_START) / 6000.0)
        case _ if name == "cornering":
            return np.square(square * channel("curvature_1pm") / GRAVITY_MPS2)
        case _ if name == "efficiency":
            return sheet["efficiency"]
        case _ if name == "halt":
            return (np.asarray(s.distance_m) == 0) * one
    raise AssertionError(name)
