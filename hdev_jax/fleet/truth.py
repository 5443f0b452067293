"""What really happened: the forward physics of the truth, effects included, in plain NumPy over whole columns.

Equations 3-5 of paper 1 with effects after `effects.md`, written a second time on purpose: no code is shared with
`hdev_jax.physics`, so that finding here what was planted means something. Conventions where `effects.md` leaves room:

- v² is (v_i² + v_f²)/2 of equation 4 in every force; acceleration is (v_f − v_i)/duration; drag uses ρ₀ = 1.225 kg/m³.
- A sensor effect's parameter is what must be added to the reading: true mass = mass_kg·(1 + scale), true speeds and
  distance = measured·(1 + scale), true slope = grade_rad + bias_rad, or the slope channel `lag_s` later; true torque =
  (1 + gain)·torque + offset_nm. Measured power = (1 + gain)·P + offset_w, and lags by skew_s.
- Order at the battery: driveline or machine, friction_blending, regen_cutoff, regen_limit, loads, voltage_dependence,
  battery_resistance, power_gain, sampling_filter, time_skew.
- What the library holds in another form (`Plant.like`) comes where the library's effect does.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from hdev_jax.fleet.driving import FINAL_DRIVE, GEAR_RATIOS, WHEEL_RADIUS_M, Drive

__all__ = ["Truth", "power_w", "shaft_channels"]

G_MPS2 = 9.80665  # standard gravity, CGPM 1901
AIR_DENSITY_KGPM3 = 1.225  # ISO 2533, sea level, 15 °C
Columns = Mapping[str, np.ndarray]
Effects = Mapping[str, Mapping[str, float]]


@dataclass(frozen=True)
class Truth:
    """What really happened: coefficients, and the effects by id with the contract's parameter names.

    `phase` (0…1) and `lottery` (0…1) are drawn by trip: the phase of cycles, and which trips a mode change falls in.
    """

    c_rr: float = 0.0060
    cda_m2: float = 5.6
    efficiency: float = 0.91
    motoring_efficiency: float = 0.93
    regenerating_efficiency: float = 0.93
    auxiliary_w: float = 0.0
    effects: Effects = field(default_factory=dict)
    phase: tuple[float, ...] = ()
    lottery: tuple[float, ...] = ()


def _by_trip(trip: np.ndarray, values: np.ndarray, f: Callable[[slice, np.ndarray], np.ndarray]) -> np.ndarray:
    cuts = np.r_[0, np.flatnonzero(np.diff(trip)) + 1, len(trip)]
    spans = [slice(a, b) for a, b in pairwise(cuts)]
    return np.concatenate([f(s, values[s]) for s in spans])


def _coefficient(truth: Truth, name: str, trip: np.ndarray, fx: Effects) -> np.ndarray:
    """A coefficient by row, with its step or its second value where one is planted."""
    value = np.full(len(trip), getattr(truth, name))
    step, second = fx.get("step_change", {}), fx.get("mode_change", {})
    if name in second:
        value = np.where(np.array(truth.lottery)[trip] < second["share"], second[name], value)
    if name in step:
        value = value + step[name] * (trip >= step["trip"])
    return value


def _drag_n(c: Columns, cda: np.ndarray, fx: Effects, vi: np.ndarray, vf: np.ndarray) -> np.ndarray:
    """½ρ₀·CdA·(v_i² + v_f²)/2 of equation 4 and what the air adds to it [N]."""
    half_rho, v2 = 0.5 * AIR_DENSITY_KGPM3 * cda, 0.5 * (vi**2 + vf**2)
    along = c["wind_speed_mps"] * np.cos(c["wind_from_rad"] - c["heading_rad"])
    across = c["wind_speed_mps"] * np.sin(c["wind_from_rad"] - c["heading_rad"])
    against = np.zeros_like(v2)
    against += fx.get("constant_headwind", {}).get("speed_mps", 0.0)
    against += fx.get("headwind", {}).get("scale", 0.0) * along
    air_i, air_f = vi + against, vf + against
    drag = half_rho * 0.5 * (air_i * np.abs(air_i) + air_f * np.abs(air_f))
    if "air_density" in fx:
        drag += half_rho * v2 * fx["air_density"]["scale"] * (c["air_density_kgpm3"] / AIR_DENSITY_KGPM3 - 1)
    if "crosswind" in fx:
        yaw = np.arctan2(across, np.sqrt(v2) + along)
        drag += half_rho * v2 * fx["crosswind"]["drag_per_rad2"] * yaw**2
    if "wet_road" in fx:
        drag += half_rho * v2 * fx["wet_road"]["spray"] * c["wet_road"]
    return drag


def _since_brake_s(c: Columns) -> np.ndarray:
    """Time from the end of the trip's last braked row to the middle of this one [s], infinite before the first."""
    end = c["time_s"] + c["duration_s"]

    def f(rows: slice, mid: np.ndarray) -> np.ndarray:
        braked = np.where(c["brake_pressure_pa"][rows] > 0, end[rows], -np.inf)
        return np.maximum(mid - np.maximum.accumulate(np.r_[-np.inf, braked[:-1]]), 0.0)

    return _by_trip(c["trip"], c["time_s"] + 0.5 * c["duration_s"], f)


def wheel_force_n(drive: Drive, truth: Truth, fx: Effects) -> np.ndarray:
    """Equation 3 with what is planted at the road [N]."""
    c = drive.columns
    k = 1 + fx.get("speed_scale", {}).get("scale", 0.0)
    vi, vf = k * c["speed_start_mps"], k * c["speed_end_mps"]
    v2, accel = 0.5 * (vi**2 + vf**2), (vf - vi) / c["duration_s"]
    mass = c["mass_kg"] * (1 + fx.get("mass_scale", {}).get("scale", 0.0))
    slope = drive.grade_at(fx["grade_lag"]["lag_s"]) if "grade_lag" in fx else c["grade_rad"]
    slope = slope + fx.get("grade_bias", {}).get("bias_rad", 0.0)
    weight = mass * G_MPS2 * np.cos(slope)
    c_rr = _coefficient(truth, "c_rr", c["trip"], fx)
    force = mass * accel * (1 + fx.get("rotating_mass", {}).get("factor", 0.0))
    force = force + mass * G_MPS2 * np.sin(slope) + weight * c_rr
    force = force + _drag_n(c, _coefficient(truth, "cda_m2", c["trip"], fx), fx, vi, vf)
    if "rolling_speed" in fx:
        force = force + weight * fx["rolling_speed"]["per_mps2"] * v2
    if "rolling_temperature" in fx:
        force = force + weight * fx["rolling_temperature"]["per_k"] * (c["ambient_temp_c"] - 20.0)
    if "tyre_warmup" in fx:
        p, d = fx["tyre_warmup"], c["distance_m"]
        mid = _by_trip(c["trip"], d, lambda _, x: np.cumsum(x) - 0.5 * x)
        force = force + weight * c_rr * p["excess"] * np.exp(-mid / p["distance_m"])
    if "hyperbolic_tyre_warmup" in fx:
        p, d = fx["hyperbolic_tyre_warmup"], c["distance_m"]
        mid = _by_trip(c["trip"], d, lambda _, x: np.cumsum(x) - 0.5 * x)
        force = force + weight * c_rr * p["excess"] / (1 + mid / p["distance_m"]) ** 2
    if "curved_rolling_temperature" in fx:  # stiffer rubber the colder, as an exponential
        p = fx["curved_rolling_temperature"]
        force = force + weight * c_rr * p["share"] * np.expm1(-p["per_k"] * (c["ambient_temp_c"] - 20.0))
    if "wet_road" in fx:
        force = force + weight * c_rr * fx["wet_road"]["excess"] * c["wet_road"]
    if "linear_cornering" in fx:  # in proportion to the sideways force, not to its square
        force = force + fx["linear_cornering"]["share"] * mass * v2 * np.abs(c["curvature_1pm"])
    if "cornering" in fx:
        force = force + fx["cornering"]["coefficient"] * mass * v2**2 * c["curvature_1pm"] ** 2
    if "brake_drag" in fx:
        fade = np.exp(-_since_brake_s(c) / fx["brake_drag"]["tau_s"])
        force = force + fx["brake_drag"]["force_n"] * fade * (c["brake_pressure_pa"] == 0)
    return force


def _through(power: np.ndarray, forward: np.ndarray, backward: np.ndarray) -> np.ndarray:
    """Equation 5: divided by the efficiency when power flows to the wheels, multiplied when it flows back."""
    return np.where(power > 0, power / forward, power * backward)


def _shaft_speed_radps(c: Columns) -> np.ndarray:
    ratio = np.array(GEAR_RATIOS)[c["gear"].astype(int) - 1] * FINAL_DRIVE
    return c["distance_m"] / c["duration_s"] * ratio / WHEEL_RADIUS_M


def _driveline_drag_nm(c: Columns, p: Mapping[str, float]) -> np.ndarray:
    """Torque of the driveline's drag [Nm], in all gears and in this one."""
    by_gear = np.array([p.get(f"torque_nm[{n}]", 0.0) for n in range(1, len(GEAR_RATIOS) + 1)])
    return p.get("torque_nm", 0.0) + by_gear[c["gear"].astype(int) - 1]


def shaft_channels(drive: Drive, truth: Truth) -> dict[str, np.ndarray]:
    """Motor torque [Nm] and speed [rad/s] and traction force [N] of the drive without planted effects; the driveline
    between shaft and wheels loses 4 %."""
    c = drive.columns
    force = wheel_force_n(drive, truth, {})
    ratio = np.array(GEAR_RATIOS)[c["gear"].astype(int) - 1] * FINAL_DRIVE
    torque = np.where(c["distance_m"] > 0, force * WHEEL_RADIUS_M / ratio, 0.0)
    torque = np.where(torque > 0, torque / 0.96, torque * 0.96)
    force = np.where(c["distance_m"] > 0, force, 0.0)
    return {"motor_torque_nm": torque, "motor_speed_radps": _shaft_speed_radps(c), "traction_force_n": force}


def _electric_w(drive: Drive, truth: Truth, fx: Effects, entry: str) -> np.ndarray:
    """Electrical power of the drive [W]: road, driveline and machine, as far as the entry lies upstream."""
    c, one = drive.columns, np.ones(len(drive.columns["trip"]))
    second = fx.get("mode_change", {})
    if entry == "road":
        k = 1 + fx.get("speed_scale", {}).get("scale", 0.0)
        wheel = wheel_force_n(drive, truth, fx) * k * c["distance_m"] / c["duration_s"]
        back = np.full(len(one), truth.efficiency)
        if "regenerating_efficiency" in second:
            weak = np.array(truth.lottery)[c["trip"]] < second["share"]
            back = np.where(weak, second["regenerating_efficiency"], back)
        drag = _driveline_drag_nm(c, fx.get("driveline_drag", {})) * _shaft_speed_radps(c)
        return _through(wheel, truth.efficiency * one, back) + drag
    back = _coefficient(truth, "regenerating_efficiency", c["trip"], fx)
    if entry == "wheel":
        wheel = c["traction_force_n"] * c["distance_m"] / c["duration_s"]
        return _through(wheel, truth.motoring_efficiency * one, back)
    p = fx.get("torque_offset", {})
    omega = c["motor_speed_radps"]
    torque = (1 + p.get("gain", 0.0)) * c["motor_torque_nm"] + p.get("offset_nm", 0.0)
    power = _through(torque * omega, truth.motoring_efficiency * one, back)
    power = power + fx.get("copper_loss", {}).get("w_per_nm2", 0.0) * torque**2
    p = fx.get("iron_loss", {})
    power = power + p.get("w_per_radps", 0.0) * omega + p.get("w_per_radps2", 0.0) * omega**2
    p = fx.get("inverter_loss", {})
    return power + p.get("standby_w", 0.0) + p.get("per_nm_w", 0.0) * np.abs(torque)


def _loads_w(c: Columns, truth: Truth, fx: Effects) -> np.ndarray:
    """Electrical loads besides the drive [W]."""
    start, dt = c["time_s"], c["duration_s"]
    load = _coefficient(truth, "auxiliary_w", c["trip"], fx) + fx.get("auxiliary_power", {}).get("power_w", 0.0)
    if "hvac_power" in fx:
        p, temp = fx["hvac_power"], c["ambient_temp_c"]
        load = load + p["below_w_per_k"] * np.maximum(p["heat_c"] - temp, 0.0)
        load = load + p["above_w_per_k"] * np.maximum(temp - p["cool_c"], 0.0)
    if "squared_hvac_power" in fx:
        p = fx["squared_hvac_power"]
        load = load + p["w_per_k2"] * (c["ambient_temp_c"] - p["at_c"]) ** 2
    if "cabin_warmup" in fx:
        p = fx["cabin_warmup"]
        mean = p["tau_s"] / dt * -np.expm1(-dt / p["tau_s"])  # of the exponential over the row
        load = load + p["power_w"] * mean * np.exp(-start / p["tau_s"])
    if "standstill_load" in fx:
        load = load + fx["standstill_load"]["power_w"] * c["standstill_flag"]
    phase = np.array(truth.phase)[c["trip"]] if truth.phase else np.zeros(len(dt))
    if "periodic_load" in fx:
        p = fx["periodic_load"]

        def on_time(t: np.ndarray) -> np.ndarray:  # integral of the square wave, in periods
            x = t / p["period_s"] + phase
            return p["duty"] * np.floor(x) + np.minimum(x - np.floor(x), p["duty"])

        load = load + p["power_w"] * (on_time(start + dt) - on_time(start)) * p["period_s"] / dt
    if "outside_thermal_cycle" in fx:  # a saw-tooth in six trips of ten
        p = fx["outside_thermal_cycle"]
        tooth = np.mod((start + 0.5 * dt) / p["period_s"] + phase, 1.0)
        load = load + p["power_w"] * tooth * (np.array(truth.lottery)[c["trip"]] < 0.6)
    if "outside_humidity_load" in fx:
        p = fx["outside_humidity_load"]
        load = load + p["power_w"] * (c["humidity_pct"] > p["threshold_pct"])
    return load


def power_w(drive: Drive, truth: Truth, entry: str = "road", effects: Effects | None = None) -> np.ndarray:
    """Mean power out of the battery by row [W], with `effects` (those of `truth` if none are given; `{}` is the
    baseline): energy_wh = power·duration/3600."""
    fx = truth.effects if effects is None else effects
    c = drive.columns
    power = _electric_w(drive, truth, fx, entry)
    if "friction_blending" in fx:
        wasted = (power < 0) & (c["brake_pressure_pa"] > 0)
        power = power * np.where(wasted, 1 - fx["friction_blending"]["share"], 1.0)
    if "regen_cutoff" in fx:
        slow = c["distance_m"] / c["duration_s"] < fx["regen_cutoff"]["speed_mps"]
        power = np.where((power < 0) & slow, 0.0, power)
    if "fading_regen_cutoff" in fx:  # from all to nothing between two speeds
        p = fx["fading_regen_cutoff"]
        width = max(p["speed_mps"] - p["none_below_mps"], 1e-9)
        share = np.clip((c["distance_m"] / c["duration_s"] - p["none_below_mps"]) / width, 0.0, 1.0)
        power = np.where(power < 0, share * power, power)
    if "regen_limit" in fx:
        power = np.maximum(power, -fx["regen_limit"]["power_w"])
    power = power + _loads_w(c, truth, fx)
    if "voltage_dependence" in fx:  # about the log's mean voltage
        power = power * (1 + fx["voltage_dependence"]["per_v"] * (c["voltage_v"] - c["voltage_v"].mean()))
    if "battery_resistance" in fx:
        power = power + fx["battery_resistance"]["resistance_ohm"] * power**2 / c["voltage_v"] ** 2
    if "cold_battery_resistance" in fx:
        p = fx["cold_battery_resistance"]
        ohm = p["resistance_ohm"] * np.exp(-p["per_k"] * (c["battery_temp_c"] - 20.0))
        power = power + ohm * power**2 / c["voltage_v"] ** 2
    if "power_gain" in fx:
        power = (1 + fx["power_gain"]["gain"]) * power + fx["power_gain"]["offset_w"]
    if "sampling_filter" in fx:
        kernel = np.exp(-np.arange(400) * drive.sample_s / fx["sampling_filter"]["tau_s"])
        kernel /= kernel.sum()  # a first-order meter, started in balance

        def meter(_: slice, x: np.ndarray) -> np.ndarray:
            return np.convolve(np.r_[np.full(len(kernel) - 1, x[0]), x], kernel, mode="valid")

        power = _by_trip(c["trip"], power, meter)
    if "time_skew" in fx:
        skew = fx["time_skew"]["skew_s"]
        power = _by_trip(c["trip"], power, lambda s, x: np.interp(c["time_s"][s] - skew, c["time_s"][s], x))
    return power
