"""Words for ids: effects, channels with the unit they are shown in, coefficients, targets."""

from typing import Any, NamedTuple

import numpy as np

from hdev_jax.physics import DECLARED, LIBRARY
from hdev_jax.targets import TARGETS

__all__ = ["Shown", "channel", "coefficient", "effect", "explained", "parameter", "target", "verbose_join"]

_CHAIN = {"driveline": "driveline loss", "machine": "machine loss", "traction": "traction"}  # parts that are no effects
_EFFECTS = {c.id: c for c in (*LIBRARY.values(), *DECLARED)}
_PARAMETERS = {p.name: p.label for c in _EFFECTS.values() for p in c.parameters if p.label}
_SUFFIXES = {"w", "s", "m", "mps", "nm", "n", "ohm", "rad", "c", "v", "mps2", "kg", "kw"}

_COEFFICIENTS = {
    "mass_kg": ("mass", "kg"),
    "road.c_rr": ("rolling resistance coefficient", ""),
    "road.b_n_per_mps": ("force linear in speed", "N·s/m"),
    "road.cda_m2": ("drag area", "m²"),
    "road.rotating_mass_factor": ("rotating mass factor", ""),
    "driveline.efficiency": ("driveline efficiency", ""),
    "driveline.regenerating_efficiency": ("driveline efficiency when braking", ""),
    "machine.motoring_efficiency": ("efficiency when motoring", ""),
    "machine.regenerating_efficiency": ("efficiency when regenerating", ""),
    "battery.auxiliary_w": ("auxiliary load", "W"),
}


class Shown(NamedTuple):
    """How a channel is shown: its words, its unit, and `shown = factor · value`."""

    label: str
    unit: str
    factor: float = 1.0


_CHANNELS = {
    "time_s": Shown("time since start", "min", 1 / 60),
    "duration_s": Shown("duration of the row", "s"),
    "distance_m": Shown("length of the row", "m"),
    "distance_since_start_m": Shown("distance since start", "km", 1e-3),
    "speed_mps": Shown("speed", "km/h", 3.6),
    "speed_start_mps": Shown("speed at the start", "km/h", 3.6),
    "speed_end_mps": Shown("speed at the end", "km/h", 3.6),
    "accel_mps2": Shown("accelerometer", "m/s²"),
    "acceleration_mps2": Shown("acceleration", "m/s²"),
    "grade_rad": Shown("slope", "%", 100.0),
    "altitude_m": Shown("altitude", "m"),
    "mass_kg": Shown("mass", "t", 1e-3),
    "motor_torque_nm": Shown("motor torque", "Nm"),
    "motor_speed_radps": Shown("motor speed", "rpm", 30 / np.pi),
    "gear": Shown("gear", ""),
    "traction_force_n": Shown("traction force", "kN", 1e-3),
    "ambient_temp_c": Shown("outside temperature", "°C"),
    "battery_temp_c": Shown("battery temperature", "°C"),
    "air_density_kgpm3": Shown("air density", "kg/m³"),
    "wind_speed_mps": Shown("wind speed", "m/s"),
    "wind_from_rad": Shown("wind from", "°", 180 / np.pi),
    "heading_rad": Shown("heading", "°", 180 / np.pi),
    "latitude_deg": Shown("latitude", "°"),
    "longitude_deg": Shown("longitude", "°"),
    "curvature_1pm": Shown("curvature", "1/km", 1e3),
    "wet_road": Shown("wet road", ""),
    "soc": Shown("state of charge", ""),
    "voltage_v": Shown("voltage", "V"),
    "current_a": Shown("current", "A"),
    "hvac_power_w": Shown("heating and cooling power", "kW", 1e-3),
    "brake_pressure_pa": Shown("brake pressure", "bar", 1e-5),
    "brake_pedal_pct": Shown("brake pedal", "%"),
    "accelerator_pct": Shown("accelerator", "%"),
    "steering_angle_rad": Shown("steering angle", "°", 180 / np.pi),
    "articulation_angle_rad": Shown("articulation angle", "°", 180 / np.pi),
    "gap_m": Shown("gap ahead", "m"),
    "passengers": Shown("passengers", ""),
    "door_open": Shown("door open", ""),
    "grid_available": Shown("overhead line", ""),
    "halt_brake": Shown("halt brake", ""),
}


def effect(effect_id: str) -> str:
    """`"tyre_warmup"` -> `"tyre warm-up"`; of an id that is not known, its words."""
    known = _EFFECTS.get(effect_id)
    return known.label if known else _CHAIN.get(effect_id, effect_id.replace("_", " "))


def explained(effect_id: str) -> dict[str, Any]:
    """What the library says of an effect: `words`, `equation`, `source`, `separated_by`; empty for a user's own."""
    if (found := _EFFECTS.get(effect_id)) is None:
        return {}
    first = (found.__doc__ or "").strip().splitlines()[0]
    return {
        "words": first.partition(": ")[0].rstrip("."),
        "equation": found.equation,
        "source": found.source,
        "separated_by": found.separated_by,
    }


def parameter(name: str, effect_id: str = "") -> str:
    """`"speed_mps"` -> `"speed"`: the unit stands with the value; what follows a bracket stays, but for effects by
    gear or kind of road: `"torque_nm[2]"` of `driveline_drag` -> `"torque (gear 2)"`."""
    stem, bracket, group = name.partition("[")
    head, _, tail = stem.rpartition("_")
    known = {p.name: p for p in _EFFECTS[effect_id].parameters} if effect_id in _EFFECTS else {}
    own = known.get(stem)
    word = (own.label if own else _PARAMETERS.get(stem)) or (head if head and tail in _SUFFIXES else stem).replace(
        "_", " "
    )
    if bracket and own and own.by:
        return f"{word} ({own.by.replace('_', ' ')} {group.removesuffix(']')})"
    return f"{word} [{group}" if bracket else word


def coefficient(path: str) -> tuple[str, str]:
    """Words and unit of a coefficient of the sheet, by its path: `road.cda_m2` -> `("drag area", "m²")`."""
    stem, bracket, group = path.partition("[")
    if stem in _COEFFICIENTS:
        words, unit = _COEFFICIENTS[stem]
    elif stem.startswith("effects."):
        _, effect_id, name = [*path.split(".", 2), "", ""][:3]
        return f"{effect(effect_id)}: {parameter(name, effect_id)}", ""
    else:
        words, unit = stem.rpartition(".")[2].replace("_", " "), ""
    return (f"{words} [{group}" if bracket else words), unit


def channel(name: str) -> Shown:
    """How a channel is shown; one that the contract does not know, by its own name."""
    return _CHANNELS.get(name, Shown(name, ""))


def target(name: str) -> tuple[str, str]:
    """A target as a thing (`battery energy`) and as an axis (`energy per row`)."""
    if found := TARGETS.get(name):
        return found.label, found.axis
    return (words := name.replace("_", " ")), words


def verbose_join(items: list[str], word: str = "and") -> str:
    """`a`, `a and b`, `a, b and c`."""
    return items[0] if len(items) == 1 else f"{', '.join(items[:-1])} {word} {items[-1]}" if items else ""
