"""Words for ids: effects, channels with the unit they are shown in, coefficients, targets."""

from typing import Any, NamedTuple

import numpy as np

__all__ = ["Shown", "channel", "coefficient", "effect", "explained", "parameter", "target", "verbose_join"]

# ids of effects.md and of the declared model -> what to call it in a sentence
_EFFECTS = {
    "inertia": "acceleration",
    "grade": "slope",
    "rolling": "rolling resistance",
    "aero": "air drag",
    "auxiliary": "declared auxiliary load",
    "driveline": "driveline loss",
    "machine": "machine loss",
    "traction": "traction",
    "auxiliary_power": "constant auxiliary load",
    "hvac_power": "cabin heating and cooling",
    "passenger_heat": "warmth of the passengers",
    "cabin_warmup": "cabin warm-up",
    "periodic_load": "periodic load",
    "standstill_load": "load at standstill",
    "cooling_power": "cooling power",
    "constant_headwind": "constant headwind",
    "headwind": "headwind",
    "air_density": "air density",
    "crosswind": "crosswind",
    "drafting": "drafting",
    "rolling_speed": "rolling resistance that grows with speed",
    "rolling_temperature": "rolling resistance by temperature",
    "tyre_warmup": "tyre warm-up",
    "wet_road": "wet road",
    "road_surface": "road surface by place",
    "mass_scale": "payload error",
    "grade_bias": "slope bias",
    "grade_lag": "lag of the slope",
    "road_grade": "road slope",
    "rotating_mass": "rotating mass",
    "standstill_hold": "brakes that hold at rest",
    "driveline_drag": "drag torque of the driveline",
    "gear_efficiency": "efficiency by gear",
    "brake_drag": "brake drag",
    "friction_brake": "friction brake",
    "friction_blending": "blending of the friction brake",
    "regen_limit": "limit of regeneration",
    "regen_cutoff": "cut-off of regeneration at low speed",
    "traction_limit": "limit of traction power",
    "efficiency_scale": "scale of the efficiency map",
    "battery_resistance": "battery resistance",
    "copper_loss": "copper loss of the motor",
    "iron_loss": "iron loss of the motor",
    "inverter_loss": "inverter loss",
    "speed_scale": "scale of the speed signal",
    "torque_offset": "offset or gain of the torque signal",
    "power_gain": "offset or gain of the power signal",
    "time_skew": "time skew between channels",
    "sampling_filter": "filter of the measured signal",
    "accelerometer_bias": "bias of the accelerometer",
    "voltage_dependence": "dependence on the battery's voltage",
    "cornering": "cornering resistance",
    "step_change": "step change of a coefficient",
    "mode_change": "change of operating mode",
}

_PARAMETERS = {
    "tau_s": "time constant",
    "skew_s": "skew",
    "n_per_pa": "force per pressure",
    "per_k": "per kelvin",
    "per_v": "per volt",
    "per_mps2": "per speed squared",
    "drag_per_rad2": "drag per yaw squared",
    "w_per_nm2": "power per torque squared",
    "below_w_per_k": "below the heating limit",
    "above_w_per_k": "above the cooling limit",
    "heat_c": "heating limit",
    "cool_c": "cooling limit",
    "per_nm_w": "power per torque",
    "n_per_unit": "force per unit of the signal",
    "w_per_radps": "power per motor speed",
    "w_per_radps2": "power per motor speed squared",
    "w_per_passenger": "power per passenger",
}
_GROUPED = {"driveline_drag": "gear", "gear_efficiency": "gear", "road_surface": "road surface"}
_SUFFIXES = {"w", "s", "m", "mps", "nm", "n", "ohm", "rad", "c", "v", "mps2", "kg", "kw"}

_COEFFICIENTS = {
    "mass_kg": ("mass", "kg"),
    "road.c_rr": ("rolling resistance coefficient", ""),
    "road.cda_m2": ("drag area", "m²"),
    "road.rotating_mass_factor": ("rotating mass factor", ""),
    "driveline.efficiency": ("driveline efficiency", ""),
    "machine.motoring_efficiency": ("efficiency when motoring", ""),
    "machine.regenerating_efficiency": ("efficiency when regenerating", ""),
    "battery.auxiliary_w": ("auxiliary load", "W"),
}

_TARGETS = {
    "energy_wh": ("battery energy", "energy per row"),
    "battery_power_kw": ("battery power", "battery power"),
    "motor_torque_nm": ("motor torque", "motor torque"),
    "traction_force_n": ("traction force", "traction force"),
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
    return _EFFECTS.get(effect_id, effect_id.replace("_", " "))


def explained(effect_id: str) -> dict[str, Any]:
    """What the library says of an effect: `words`, `equation`, `source`, `separated_by`; empty for a user's own."""
    from hdev_jax.physics.library import DECLARED, LIBRARY

    found = LIBRARY.get(effect_id) or {c.id: c for c in DECLARED}.get(effect_id)
    if found is None:
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
    word = _PARAMETERS.get(stem) or (head if head and tail in _SUFFIXES else stem).replace("_", " ")
    if bracket and effect_id in _GROUPED:
        return f"{word} ({_GROUPED[effect_id]} {group.removesuffix(']')})"
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
    words = name.replace("_", " ")
    return _TARGETS.get(name, (words, words))


def verbose_join(items: list[str], word: str = "and") -> str:
    """`a`, `a and b`, `a, b and c`."""
    return items[0] if len(items) == 1 else f"{', '.join(items[:-1])} {word} {items[-1]}" if items else ""
