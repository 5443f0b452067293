"""Loads, limits and losses between the machine and the battery."""

from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from hdev_jax.physics.effect import Effect, Parameter

__all__ = [
    "Auxiliary",
    "AuxiliaryPower",
    "BatteryResistance",
    "CabinWarmup",
    "CoolingPower",
    "FrictionBlending",
    "HvacPower",
    "PeriodicLoad",
    "RegenCutoff",
    "RegenLimit",
    "StandstillLoad",
    "StepChange",
    "TractionLimit",
    "VoltageDependence",
]

OFF_W = 1e12  # a limit that no vehicle reaches, in place of infinity: products with it stay finite
STANDSTILL_MPS = 0.1


def _ladder(low: float, high: float, steps: int) -> tuple[float, ...]:
    """A geometric grid of powers [W]."""
    return tuple(round(low * (high / low) ** (k / (steps - 1)), -2) for k in range(steps))


LIMITS = 90  # order of the switches: after every load and loss they act on


class Auxiliary(Effect):
    """The declared auxiliary load of the sheet, `[battery] auxiliary_w`."""

    id: ClassVar = "auxiliary"
    stage: ClassVar = "battery"
    equation: ClassVar = "P_aux"
    source: ClassVar = "paper 1, section 3.2 (loads)"
    auxiliary_w: Any

    def power(self, row, car, point):
        return self.auxiliary_w


class AuxiliaryPower(Effect):
    """A constant load besides the declared one."""

    id: ClassVar = "auxiliary_power"
    stage: ClassVar = "battery"
    equation: ClassVar = "P₀"
    source: ClassVar = "paper 2, section III-A (loads left out there)"
    parameters: ClassVar = (Parameter("power_w", "W", 0.0, 1000.0, 0.0, 6e4, least=5.0),)
    mistaken_for: ClassVar = ("power_gain", "inverter_loss")
    separated_by: ClassVar = "standing still with the vehicle on, and with it off"
    power_w: Any

    def power(self, row, car, point):
        return self.power_w


class HvacPower(Effect):
    """Heating below one temperature and cooling above another: k₁·max(T₁−T, 0) + k₂·max(T−T₂, 0)."""

    id: ClassVar = "hvac_power"
    stage: ClassVar = "battery"
    equation: ClassVar = "k₁·max(T₁−T, 0) + k₂·max(T−T₂, 0)"
    source: ClassVar = "Basma et al., Energy 207 (2020) (bus cabin, steady state)"
    needs: ClassVar = ("ambient_temp_c",)
    parameters: ClassVar = (
        Parameter("below_w_per_k", "W/K", 0.0, 100.0, 0.0, 5e3, least=1.0),
        Parameter("above_w_per_k", "W/K", 0.0, 100.0, 0.0, 5e3, least=1.0),
        Parameter("heat_c", "°C", 18.0, 4.0, -5.0, 26.0, kind="shape", grid=(10.0, 14.0, 18.0, 22.0)),
        Parameter("cool_c", "°C", 22.0, 4.0, 14.0, 34.0, kind="shape", grid=(18.0, 22.0, 26.0)),
    )
    variants: ClassVar = (("below_w_per_k",), ("above_w_per_k",), ("below_w_per_k", "above_w_per_k"))
    mistaken_for: ClassVar = ("rolling_temperature", "air_density")
    separated_by: ClassVar = "standing still on hot and cold days"
    below_w_per_k: Any
    above_w_per_k: Any
    heat_c: Any
    cool_c: Any

    def power(self, row, car, point):
        t = row.channels["ambient_temp_c"]
        heating = self.below_w_per_k * jnp.maximum(self.heat_c - t, 0.0)
        return heating + self.above_w_per_k * jnp.maximum(t - self.cool_c, 0.0)


class CabinWarmup(Effect):
    """A load that dies away after the start: P·exp(−t/t₀)."""

    id: ClassVar = "cabin_warmup"
    stage: ClassVar = "battery"
    equation: ClassVar = "P·exp(−t/t₀)"
    source: ClassVar = "Basma et al., Energy 207 (2020) (cabin transient)"
    parameters: ClassVar = (
        Parameter("power_w", "W", 0.0, 1000.0, 0.0, 6e4, least=10.0),
        Parameter("tau_s", "s", 900.0, 600.0, 60.0, 7200.0, kind="shape", grid=(300.0, 900.0, 2400.0)),
    )
    mistaken_for: ClassVar = ("tyre_warmup",)
    separated_by: ClassVar = "standing still early and late"
    power_w: Any
    tau_s: Any

    def power(self, row, car, point):
        t = row.time_s + 0.5 * row.duration_s
        return self.power_w * jnp.exp(-t / self.tau_s)


class PeriodicLoad(Effect):
    """A load that switches on and off from the start of the trip: P while cos(2π(t/T + φ)) > cos(πD)."""

    id: ClassVar = "periodic_load"
    stage: ClassVar = "battery"
    equation: ClassVar = "P·[cos 2π(t/T + φ) > cos πD]"
    source: ClassVar = "thermostat with hysteresis"
    parameters: ClassVar = (
        Parameter("power_w", "W", 0.0, 1000.0, 0.0, 6e4, least=10.0),
        Parameter("period_s", "s", 900.0, 300.0, 60.0, 7200.0, kind="shape", grid=(600.0, 1200.0, 1500.0)),
        Parameter("duty", "1", 0.5, 0.2, 0.05, 0.95, kind="shape", grid=(0.5,)),
        Parameter("phase", "1", 0.0, 0.25, -1.0, 1.0, kind="shape", grid=(-0.25, 0.0, 0.25, 0.5)),
    )
    mistaken_for: ClassVar = ("standstill_load",)
    separated_by: ClassVar = "an hour at standstill"
    power_w: Any
    period_s: Any
    duty: Any
    phase: Any

    def power(self, row, car, point):
        t = row.time_s + 0.5 * row.duration_s
        wave = jnp.cos(2 * jnp.pi * (t / self.period_s + self.phase)) - jnp.cos(jnp.pi * self.duty)
        return self.power_w * jax.nn.sigmoid(wave / 0.05)  # 5 % of an edge, so that period and phase have a slope


class StandstillLoad(Effect):
    """A load while standing still: P·[v = 0], all of the time or only while the doors are open."""

    id: ClassVar = "standstill_load"
    stage: ClassVar = "battery"
    equation: ClassVar = "P·[v < 0.1 m/s]·(1 − d + d·door)"
    source: ClassVar = "PTO, doors and kneeling of city buses"
    parameters: ClassVar = (
        Parameter("power_w", "W", 0.0, 1000.0, 0.0, 1e5, least=10.0),
        Parameter("by_door", "1", 0.0, 1.0, 0.0, 1.0, kind="choice", grid=(0.0, 1.0)),
    )
    mistaken_for: ClassVar = ("auxiliary_power", "periodic_load")
    separated_by: ClassVar = "parked, the load on and off"
    power_w: Any
    by_door: Any

    def power(self, row, car, point):
        flag = 1.0 - self.by_door + self.by_door * row.get("door_open", 1.0)
        return self.power_w * jnp.where(row.speed_mps < STANDSTILL_MPS, flag, 0.0)


class CoolingPower(Effect):
    """Cooling of the battery: k·max(T_batt − T₀, 0)."""

    id: ClassVar = "cooling_power"
    stage: ClassVar = "battery"
    equation: ClassVar = "k·max(T_batt − T₀, 0)"
    source: ClassVar = "thermostat of a battery chiller"
    needs: ClassVar = ("battery_temp_c",)
    parameters: ClassVar = (
        Parameter("w_per_k", "W/K", 0.0, 100.0, 0.0, 5e3, least=1.0),
        Parameter("start_c", "°C", 25.0, 4.0, 5.0, 45.0, kind="shape", grid=(20.0, 25.0, 30.0)),
    )
    mistaken_for: ClassVar = ("hvac_power",)
    separated_by: ClassVar = "standing still after hard driving"
    w_per_k: Any
    start_c: Any

    def power(self, row, car, point):
        return self.w_per_k * jnp.maximum(row.channels["battery_temp_c"] - self.start_c, 0.0)


class BatteryResistance(Effect):
    """Loss in the battery's resistance: R·P²/V²."""

    id: ClassVar = "battery_resistance"
    stage: ClassVar = "battery"
    equation: ClassVar = "R·P²/V²"
    source: ClassVar = "Plett, Battery Management Systems, vol. 1 (Rint model)"
    needs: ClassVar = ("voltage_v",)
    parameters: ClassVar = (Parameter("resistance_ohm", "Ω", 0.0, 0.1, 0.0, 2.0, least=1e-4),)
    mistaken_for: ClassVar = ("copper_loss",)
    separated_by: ClassVar = "pulses of current at several states of charge"
    order: ClassVar = 50
    resistance_ohm: Any

    def power(self, row, car, point):
        volts = jnp.maximum(jnp.abs(jnp.asarray(row.channels["voltage_v"])), 1.0)
        return self.resistance_ohm * (point.power_w / volts) ** 2


class VoltageDependence(Effect):
    """Consumption that follows the voltage: P·k·(V − 600 V)."""

    id: ClassVar = "voltage_dependence"
    stage: ClassVar = "battery"
    equation: ClassVar = "P·k·(V − V₀)"
    source: ClassVar = "inverter efficiency against DC voltage"
    needs: ClassVar = ("voltage_v",)
    parameters: ClassVar = (Parameter("per_v", "1/V", 0.0, 5e-4, -0.02, 0.02, least=1e-6),)
    mistaken_for: ClassVar = ("battery_resistance",)
    separated_by: ClassVar = "long trips from full to empty"
    order: ClassVar = 40
    per_v: Any

    def power(self, row, car, point):
        return point.power_w * self.per_v * (row.channels["voltage_v"] - 600.0)


class FrictionBlending(Effect):
    """Braking power that the friction brakes take: s·|P| less recovered while the brake has pressure."""

    id: ClassVar = "friction_blending"
    stage: ClassVar = "battery"
    equation: ClassVar = "−s·min(P, 0)·[p_brake > p₀]"
    source: ClassVar = "paper 2, eq. 7-9 (η_rg)"
    needs: ClassVar = ("brake_pressure_pa",)
    parameters: ClassVar = (
        Parameter("share", "1", 0.0, 0.3, 0.0, 1.0, least=0.01),
        Parameter("above_pa", "Pa", 2e4, 2e4, 0.0, 1e6, kind="choice", grid=(0.0, 2e4, 1e5)),
    )
    mistaken_for: ClassVar = ("regen_cutoff", "regen_limit")
    separated_by: ClassVar = "braking with and without pressure at one speed"
    order: ClassVar = 30
    share: Any
    above_pa: Any

    def power(self, row, car, point):
        pressed = row.channels["brake_pressure_pa"] > self.above_pa
        return -self.share * jnp.where(pressed, jnp.minimum(point.power_w, 0.0), 0.0)


class RegenLimit(Effect):
    """The battery takes no more than P_lim: + max(−P − P_lim, 0)."""

    id: ClassVar = "regen_limit"
    stage: ClassVar = "battery"
    equation: ClassVar = "max(−P − P_lim, 0)"
    source: ClassVar = "charge limit of the battery management"
    parameters: ClassVar = (
        Parameter("power_w", "W", OFF_W, 5e3, 500.0, OFF_W, kind="limit",
                  grid=_ladder(1e4, 3.5e5, 14)),
    )  # fmt: skip
    mistaken_for: ClassVar = ("friction_blending",)
    separated_by: ClassVar = "hard braking from speed, battery full"
    order: ClassVar = LIMITS
    power_w: Any

    def power(self, row, car, point):
        return jnp.maximum(-point.power_w - self.power_w, 0.0)


class RegenCutoff(Effect):
    """Nothing is recovered below v₀: −min(P, 0)·[v < v₀]."""

    id: ClassVar = "regen_cutoff"
    stage: ClassVar = "battery"
    equation: ClassVar = "−min(P, 0)·[v < v₀]"
    source: ClassVar = "blending out of regeneration at walking pace"
    parameters: ClassVar = (
        Parameter(
            "speed_mps", "m/s", 0.0, 1.0, 0.3, 12.0, kind="limit", grid=(1.0, 1.7, 2.5, 3.5, 4.5, 5.5, 6.5, 8.0, 10.0)
        ),
    )
    mistaken_for: ClassVar = ("friction_blending",)
    separated_by: ClassVar = "slow braking to standstill"
    order: ClassVar = LIMITS - 1
    speed_mps: Any

    def power(self, row, car, point):
        # an edge of 0.1 m/s, about as fine as speeds are measured, so that v₀ has a slope; nothing at the null v₀ = 0
        below = jax.nn.sigmoid((self.speed_mps - row.speed_mps) / 0.1)
        return jnp.where(self.speed_mps > 0, -below * jnp.minimum(point.power_w, 0.0), 0.0)


class TractionLimit(Effect):
    """The drive gives no more than P_lim: − max(P − P_lim, 0)."""

    id: ClassVar = "traction_limit"
    stage: ClassVar = "battery"
    equation: ClassVar = "−max(P − P_lim, 0)"
    source: ClassVar = "derating of motor or battery"
    entries: ClassVar = ("road",)
    parameters: ClassVar = (
        Parameter("power_w", "W", OFF_W, 1e4, 5e3, OFF_W, kind="limit", grid=_ladder(3e4, 5e5, 12)),
    )
    mistaken_for: ClassVar = ("copper_loss",)
    separated_by: ClassVar = "full throttle uphill"
    order: ClassVar = LIMITS
    power_w: Any

    def power(self, row, car, point):
        return -jnp.maximum(point.power_w - self.power_w, 0.0)


class StepChange(Effect):
    """A change that stays, from trip k on: a load, a rolling resistance, or a loss in proportion to power."""

    id: ClassVar = "step_change"
    stage: ClassVar = "battery"
    equation: ClassVar = "[trip ≥ k]·(ΔP + Δc·m·g·v + Δg·|P|)"
    source: ClassVar = "ageing, a service event, a fault"
    parameters: ClassVar = (
        Parameter("power_w", "W", 0.0, 1000.0, -6e4, 6e4, least=10.0),
        Parameter("c_rr", "1", 0.0, 1e-3, -0.02, 0.02, least=2e-5),
        Parameter("loss", "1", 0.0, 0.05, -0.5, 0.5, least=0.002),
        Parameter("at_trip", "1", 0.0, 1.0, kind="choice", grid=()),  # every trip with two before and two after
    )
    variants: ClassVar = (("power_w",), ("c_rr",), ("loss",))
    mistaken_for: ClassVar = ("rolling_temperature", "mass_scale")
    separated_by: ClassVar = "the same trip again, before and after a service"
    order: ClassVar = 20
    power_w: Any
    c_rr: Any
    loss: Any
    at_trip: Any

    def power(self, row, car, point):
        at_trip = jnp.asarray(self.at_trip)
        after = jnp.where(jnp.asarray(row.trip).astype(at_trip.dtype) >= at_trip - 0.5, 1.0, 0.0)
        weight = car.mass(row) * 9.80665 * row.speed_mps
        return after * (self.power_w + self.c_rr * weight + self.loss * jnp.abs(point.power_w))
