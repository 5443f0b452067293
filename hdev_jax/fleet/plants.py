"""What can be planted in a synthetic log: default parameters, which of them is the size, where a log can show it."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

__all__ = ["PLANTABLE", "Plant", "plantable"]


@dataclass(frozen=True)
class Plant:
    """A plantable effect: its default parameters, the one that carries the size, and where a log can show it.

    `null` is the value of `size` without the effect (infinite for a limit). `match` says which side gives way where a
    ratio of effect to noise is asked for: "noise" where another size would be implausible, or jumps. `like` is the
    library's effect that comes nearest to one which the library does not hold in this form; `partly` are effects that
    a part of it is, as a constant load is the mean of one that switches. `absorbed` are entries
    where declared coefficients take all of it: it can be planted there, but has no size beyond them.
    """

    parameters: Mapping[str, float]
    size: tuple[str, ...]
    entries: tuple[str, ...] = ("road", "shaft", "wheel")
    modes: tuple[str, ...] = ("segments", "samples")
    null: float = 0.0
    match: str = "effect"
    in_library: bool = True
    like: str | None = None
    partly: tuple[str, ...] = ()
    absorbed: tuple[str, ...] = ()


_ROAD = ("road",)
_SHAFT = ("shaft",)
PLANTABLE: dict[str, Plant] = {
    "auxiliary_power": Plant({"power_w": 4000.0}, ("power_w",)),
    "hvac_power": Plant(
        {"below_w_per_k": 350.0, "above_w_per_k": 250.0, "heat_c": 14.0, "cool_c": 20.0},
        ("below_w_per_k", "above_w_per_k"),
    ),
    "cabin_warmup": Plant({"power_w": 9000.0, "tau_s": 400.0}, ("power_w",)),
    "periodic_load": Plant({"power_w": 7000.0, "period_s": 300.0, "duty": 0.4}, ("power_w",)),
    "standstill_load": Plant({"power_w": 9000.0}, ("power_w",)),
    "constant_headwind": Plant({"speed_mps": 3.0}, ("speed_mps",), _ROAD, match="noise"),
    "headwind": Plant({"scale": 0.98}, ("scale",), _ROAD, match="noise"),
    "air_density": Plant({"scale": 1.0}, ("scale",), _ROAD, match="noise"),
    "crosswind": Plant({"drag_per_rad2": 2.5}, ("drag_per_rad2",), _ROAD, match="noise"),
    "rolling_speed": Plant({"per_mps2": 6e-6}, ("per_mps2",), _ROAD, match="noise"),
    "rolling_temperature": Plant({"per_k": -6e-5}, ("per_k",), _ROAD, match="noise"),
    "tyre_warmup": Plant({"excess": 0.4, "distance_m": 7000.0}, ("excess",), _ROAD, match="noise"),
    "wet_road": Plant({"excess": 0.25, "spray": 0.12}, ("excess", "spray"), _ROAD, match="noise"),
    "mass_scale": Plant({"scale": 0.06}, ("scale",), _ROAD),
    "grade_bias": Plant({"bias_rad": 0.002}, ("bias_rad",), _ROAD, match="noise"),
    "grade_lag": Plant({"lag_s": 3.0}, ("lag_s",), _ROAD),
    "rotating_mass": Plant({"factor": 0.08}, ("factor",), _ROAD),
    "speed_scale": Plant({"scale": 0.02}, ("scale",), _ROAD),
    "cornering": Plant({"coefficient": 0.02}, ("coefficient",), _ROAD, match="noise"),
    # a clutch whose plates drag while it stands open, in the middle gears; the same torque in all is iron loss
    "driveline_drag": Plant(
        {"torque_nm[1]": 10.0, "torque_nm[2]": 25.0, "torque_nm[3]": 25.0, "torque_nm[4]": 10.0},
        ("torque_nm", "torque_nm[1]", "torque_nm[2]", "torque_nm[3]", "torque_nm[4]"),
        _ROAD,
    ),
    "brake_drag": Plant({"force_n": 1500.0, "tau_s": 30.0}, ("force_n",), _ROAD),
    "friction_blending": Plant({"share": 0.35}, ("share",)),
    "regen_limit": Plant({"power_w": 90e3}, ("power_w",), null=np.inf),
    "regen_cutoff": Plant({"speed_mps": 6.0}, ("speed_mps",), match="noise"),
    "copper_loss": Plant({"w_per_nm2": 0.03}, ("w_per_nm2",), _SHAFT),
    "iron_loss": Plant({"w_per_radps": 6.0, "w_per_radps2": 0.015}, ("w_per_radps", "w_per_radps2"), _SHAFT),
    "inverter_loss": Plant({"standby_w": 0.0, "per_nm_w": 15.0}, ("standby_w", "per_nm_w"), _SHAFT, match="noise"),
    "torque_offset": Plant({"offset_nm": 12.0, "gain": 0.0}, ("offset_nm", "gain"), _SHAFT),
    "battery_resistance": Plant({"resistance_ohm": 0.08}, ("resistance_ohm",)),
    "voltage_dependence": Plant({"per_v": 1.5e-3}, ("per_v",)),
    "power_gain": Plant({"gain": 0.04, "offset_w": 0.0}, ("gain", "offset_w"), _ROAD, absorbed=_SHAFT),
    "time_skew": Plant({"skew_s": 0.4}, ("skew_s",), modes=("samples",)),
    "sampling_filter": Plant({"tau_s": 1.0}, ("tau_s",), modes=("samples",)),
    "step_change": Plant({"auxiliary_w": 5000.0, "trip": 10.0}, ("auxiliary_w", "c_rr", "cda_m2")),
    "mode_change": Plant(
        {"regenerating_efficiency": 0.6, "share": 0.35}, ("regenerating_efficiency", "auxiliary_w", "c_rr", "cda_m2")
    ),
    "outside_thermal_cycle": Plant(
        {"power_w": 8000.0, "period_s": 1500.0}, ("power_w",), in_library=False, partly=("auxiliary_power",)
    ),
    "outside_humidity_load": Plant(
        {"power_w": 2500.0, "threshold_pct": 70.0},
        ("power_w",),
        in_library=False,
        match="noise",
        partly=("auxiliary_power", "switching_load"),
    ),
    # what the library holds in another form
    "squared_hvac_power": Plant({"w_per_k2": 20.0, "at_c": 17.0}, ("w_per_k2",), in_library=False, like="hvac_power"),
    "hyperbolic_tyre_warmup": Plant(
        {"excess": 0.6, "distance_m": 7000.0}, ("excess",), _ROAD, match="noise", in_library=False, like="tyre_warmup"
    ),
    "curved_rolling_temperature": Plant(
        {"share": 0.15, "per_k": 0.045}, ("share",), _ROAD, match="noise", in_library=False, like="rolling_temperature"
    ),
    "linear_cornering": Plant({"share": 0.12}, ("share",), _ROAD, match="noise", in_library=False, like="cornering"),
    "fading_regen_cutoff": Plant(
        {"none_below_mps": 3.0, "speed_mps": 9.0}, ("speed_mps",), match="noise", in_library=False, like="regen_cutoff"
    ),
    "cold_battery_resistance": Plant(
        {"resistance_ohm": 0.08, "per_k": 0.04}, ("resistance_ohm",), in_library=False, like="battery_resistance"
    ),
}


def plantable(entry: str = "road", mode: str = "segments") -> tuple[str, ...]:
    """Ids that a log of this entry and mode can carry, those outside the library of effects last."""
    fits = [k for k, p in PLANTABLE.items() if entry in p.entries and mode in p.modes]
    return tuple(sorted(fits, key=lambda k: not PLANTABLE[k].in_library))
