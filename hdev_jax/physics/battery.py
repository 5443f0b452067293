"""Losses, limits and changes between the machine and the battery."""

from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from hdev_jax.physics.effect import Car, Effect, Names, Parameters, Point, Real, Row, Stage
from hdev_jax.physics.parameter import Choice, Size, Switch
from hdev_jax.segments import READING_ERRORS
from hdev_jax.units import GRAVITY_MPS2

__all__ = [
    "BatteryResistance",
    "EfficiencyScale",
    "FrictionBlending",
    "ModeChange",
    "RegenCutoff",
    "RegenEfficiency",
    "RegenLimit",
    "StepChange",
    "TractionLimit",
    "VoltageDependence",
]

OFF_W = 1e12  # a limit that no vehicle reaches, in place of infinity: products with it stay finite


def _ladder(low: float, high: float, steps: int) -> tuple[float, ...]:
    """A geometric grid of powers [W]."""
    return tuple(round(low * (high / low) ** (k / (steps - 1)), -2) for k in range(steps))


LIMITS = 90  # order of the switches: after every load and loss they act on


class BatteryResistance(Effect):
    """Loss in the battery's resistance: R·P²/V²."""

    id: ClassVar[str] = "battery_resistance"
    label: ClassVar[str] = "battery resistance"
    stage: ClassVar[Stage] = "battery"
    equation: ClassVar[str] = "R·P²/V²"
    source: ClassVar[str] = "Plett, Battery Management Systems, vol. 1 (Rint model)"
    needs: ClassVar[Names] = ("voltage_v|nominal_voltage_v",)  # the latter a sheet's
    # packs of vehicles have 0.03 to 0.3 Ω when warm, about three times that at −20 °C
    parameters: ClassVar[Parameters] = (Size("resistance_ohm", "Ω", 0.0, 0.1, 0.0, 1.0, least=1e-4),)
    mistaken_for: ClassVar[Names] = ("copper_loss",)
    separated_by: ClassVar[str] = "pulses of current at several states of charge"
    order: ClassVar[int] = 50
    resistance_ohm: Any

    def power(self, row: Row, car: Car, point: Point) -> Real:
        volts = jnp.maximum(jnp.abs(jnp.asarray(car.voltage(row))), 1.0)
        return self.resistance_ohm * (point.power_w / volts) ** 2


class VoltageDependence(Effect):
    """Consumption that depends on the battery's voltage: P·k·(V − V₀)."""

    id: ClassVar[str] = "voltage_dependence"
    label: ClassVar[str] = "dependence on the battery's voltage"
    stage: ClassVar[Stage] = "battery"
    equation: ClassVar[str] = "P·k·(V − V₀)"
    source: ClassVar[str] = "inverter efficiency against DC voltage"
    needs: ClassVar[Names] = ("voltage_v",)
    lacks: ClassVar[Names] = READING_ERRORS
    instead: ClassVar[str] = "slope or speed are read with errors, and the voltage that sags tells what they leave open"
    parameters: ClassVar[Parameters] = (
        # an inverter's efficiency moves by a few percent over 100 V
        Size("per_v", "1/V", 0.0, 5e-4, -5e-3, 5e-3, least=1e-6, label="per volt"),
        # about the log's own mean: about another voltage it is a gain of the power besides
        Choice("at_v", "V", 650.0, 50.0, 10.0, 2000.0, mean_of="voltage_v", label="mean voltage"),
    )
    mistaken_for: ClassVar[Names] = ("battery_resistance",)
    separated_by: ClassVar[str] = "long trips from full to empty"
    order: ClassVar[int] = 40
    per_v: Any
    at_v: Any

    def power(self, row: Row, car: Car, point: Point) -> Real:
        return point.power_w * self.per_v * (row.channels["voltage_v"] - self.at_v)


class EfficiencyScale(Effect):
    """The declared efficiency is wrong by the same amount in both directions: s·|P| is lost, P the drive's power.

    Where the efficiency is estimated, this effect is that efficiency under another name. Where it is known or a map,
    the effect is the same as `gear_efficiency` in a vehicle with one gear.
    """

    id: ClassVar[str] = "efficiency_scale"
    label: ClassVar[str] = "scale of the efficiency"
    stage: ClassVar[Stage] = "battery"
    equation: ClassVar[str] = "s·|P|"
    source: ClassVar[str] = "paper 1, eq. 5 (η); paper 2, eq. 6, 10 and 11"
    parameters: ClassVar[Parameters] = (Size("scale", "1", 0.0, 0.03, -0.3, 0.3, least=0.005),)
    mistaken_for: ClassVar[Names] = ("gear_efficiency", "copper_loss", "inverter_loss")
    separated_by: ClassVar[str] = "driving and braking at the same power, at several torques"
    order: ClassVar[int] = -10  # before the loads: at the entry to the battery
    scale: Any

    def power(self, row: Row, car: Car, point: Point) -> Real:
        return self.scale * jnp.abs(point.power_w)


class RegenEfficiency(Effect):
    """A smaller (or larger) share of the braking energy is recovered than the sheet says: s·max(−P, 0) is lost.

    The plausible range ends at −0.05: a machine brakes hardly better than it drives.
    """

    id: ClassVar[str] = "regen_efficiency"
    label: ClassVar[str] = "efficiency of regeneration"
    stage: ClassVar[Stage] = "battery"
    of_efficiency: ClassVar[bool] = True
    same_as: ClassVar[Names] = ("driveline.regenerating_efficiency", "machine.regenerating_efficiency")
    equation: ClassVar[str] = "s·max(−P, 0)"
    source: ClassVar[str] = "paper 2, eq. 7-9 (η_rg)"
    parameters: ClassVar[Parameters] = (Size("share", "1", 0.0, 0.1, -0.05, 1.0, least=0.005),)
    mistaken_for: ClassVar[Names] = (
        "friction_blending", "mass_scale", "power_gain", "speed_scale", "regen_limit", "mode_change"
    )  # fmt: skip
    separated_by: ClassVar[str] = "coasting and braking on the flat, and the balance of charge"
    order: ClassVar[int] = 25
    share: Any

    def power(self, row: Row, car: Car, point: Point) -> Real:
        return self.share * jnp.maximum(-point.power_w, 0.0)


class FrictionBlending(Effect):
    """Braking power that the friction brakes take: s·|P| is not recovered while there is brake pressure."""

    id: ClassVar[str] = "friction_blending"
    label: ClassVar[str] = "blending of the friction brake"
    stage: ClassVar[Stage] = "battery"
    equation: ClassVar[str] = "−s·min(P, 0)·[p_brake > p₀]"
    source: ClassVar[str] = "paper 2, eq. 7-9 (η_rg)"
    needs: ClassVar[Names] = ("brake_pressure_pa",)
    parameters: ClassVar[Parameters] = (
        Size("share", "1", 0.0, 0.3, 0.0, 1.0, least=0.01),
        Choice("above_pa", "Pa", 2e4, 2e4, 0.0, 1e6, grid=(0.0, 2e4, 1e5)),
    )
    mistaken_for: ClassVar[Names] = ("regen_cutoff", "regen_limit")
    separated_by: ClassVar[str] = "braking with and without pressure at one speed"
    order: ClassVar[int] = 30
    share: Any
    above_pa: Any

    def power(self, row: Row, car: Car, point: Point) -> Real:
        pressed = row.channels["brake_pressure_pa"] > self.above_pa
        return -self.share * jnp.where(pressed, jnp.minimum(point.power_w, 0.0), 0.0)


class RegenLimit(Effect):
    """The battery accepts at most P_lim, or only a part of what exceeds it: + s·max(−P − P_lim, 0).

    s = 1 is a hard limit. With brakes that blend, s is smaller.
    """

    id: ClassVar[str] = "regen_limit"
    label: ClassVar[str] = "limit of regeneration"
    stage: ClassVar[Stage] = "battery"
    equation: ClassVar[str] = "s·max(−P − P_lim, 0)"
    source: ClassVar[str] = "charge limit of the battery management"
    parameters: ClassVar[Parameters] = (
        Switch("power_w", "W", OFF_W, 5e3, 500.0, OFF_W, grid=_ladder(1e4, 3.5e5, 27)),
        Choice("share", "1", 1.0, 0.3, 0.0, 1.0, grid=(1.0, 0.5)),
    )
    mistaken_for: ClassVar[Names] = ("friction_blending", "regen_efficiency")
    separated_by: ClassVar[str] = "hard braking from speed, battery full"
    order: ClassVar[int] = LIMITS
    power_w: Any
    share: Any = 1.0

    def power(self, row: Row, car: Car, point: Point) -> Real:
        return self.share * jnp.maximum(-point.power_w - self.power_w, 0.0)


class RegenCutoff(Effect):
    """Nothing is recovered below v₀: −min(P, 0)·[v < v₀]."""

    id: ClassVar[str] = "regen_cutoff"
    label: ClassVar[str] = "cut-off of regeneration at low speed"
    stage: ClassVar[Stage] = "battery"
    equation: ClassVar[str] = "−min(P, 0)·[v < v₀]"
    source: ClassVar[str] = "blending out of regeneration at walking pace"
    parameters: ClassVar[Parameters] = (
        Switch("speed_mps", "m/s", 0.0, 1.0, 0.3, 12.0, grid=(1.0, 1.7, 2.5, 3.5, 4.5, 5.5, 6.5, 8.0, 10.0)),
    )
    mistaken_for: ClassVar[Names] = ("friction_blending",)
    separated_by: ClassVar[str] = "slow braking to standstill"
    order: ClassVar[int] = LIMITS - 1
    speed_mps: Any

    def power(self, row: Row, car: Car, point: Point) -> Real:
        # an edge of 0.1 m/s, about as fine as speeds are measured, so that v₀ has a slope; nothing at the null v₀ = 0
        below = jax.nn.sigmoid((self.speed_mps - row.speed_mps) / 0.1)
        return jnp.where(self.speed_mps > 0, -below * jnp.minimum(point.power_w, 0.0), 0.0)


class TractionLimit(Effect):
    """The drive gives no more than P_lim: − max(P − P_lim, 0)."""

    id: ClassVar[str] = "traction_limit"
    label: ClassVar[str] = "limit of traction power"
    stage: ClassVar[Stage] = "battery"
    equation: ClassVar[str] = "−max(P − P_lim, 0)"
    source: ClassVar[str] = "derating of motor or battery"
    entries: ClassVar[Names] = ("road",)
    parameters: ClassVar[Parameters] = (Switch("power_w", "W", OFF_W, 1e4, 5e3, OFF_W, grid=_ladder(3e4, 5e5, 12)),)
    mistaken_for: ClassVar[Names] = ("copper_loss",)
    separated_by: ClassVar[str] = "full throttle uphill"
    order: ClassVar[int] = LIMITS
    power_w: Any

    def power(self, row: Row, car: Car, point: Point) -> Real:
        return -jnp.maximum(point.power_w - self.power_w, 0.0)


class StepChange(Effect):
    """A lasting change from trip k on: a load, a rolling resistance, or a loss proportional to power."""

    id: ClassVar[str] = "step_change"
    label: ClassVar[str] = "step change of a coefficient"
    stage: ClassVar[Stage] = "battery"
    equation: ClassVar[str] = "[trip ≥ k]·(ΔP + Δc·m·g·v + Δg·|P|)"
    source: ClassVar[str] = "ageing, a service event, a fault"
    parameters: ClassVar[Parameters] = (
        Size("power_w", "W", 0.0, 1000.0, -6e4, 6e4, least=100.0),
        Size("c_rr", "1", 0.0, 1e-3, -0.02, 0.02, least=2e-5),
        Size("loss", "1", 0.0, 0.05, -0.5, 0.5, least=0.002),
        Choice("at_trip", "1", 0.0, 1.0, grid=()),  # every trip with three of the same vehicle on either side
    )
    variants: ClassVar[tuple[Names, ...]] = (("power_w",), ("c_rr",), ("loss",))
    mistaken_for: ClassVar[Names] = ("rolling_temperature", "mass_scale")
    separated_by: ClassVar[str] = "the same trip again, before and after a service"
    between_trips: ClassVar[bool] = True
    order: ClassVar[int] = 20
    power_w: Any
    c_rr: Any
    loss: Any
    at_trip: Any

    def power(self, row: Row, car: Car, point: Point) -> Real:
        at_trip = jnp.asarray(self.at_trip)
        after = jnp.where(jnp.asarray(row.trip).astype(at_trip.dtype) >= at_trip - 0.5, 1.0, 0.0)
        weight = car.mass(row) * GRAVITY_MPS2 * row.speed_mps
        return after * (self.power_w + self.c_rr * weight + self.loss * jnp.abs(point.power_w))


class ModeChange(Effect):
    """A second mode in some trips: a load, a rolling resistance, a loss, or weaker regeneration.

    A search finds the trips in the mode. On a trip outside the fit (`in_mode` NaN) z is the share of trips in the
    mode.
    """

    id: ClassVar[str] = "mode_change"
    label: ClassVar[str] = "change of operating mode"
    stage: ClassVar[Stage] = "battery"
    equation: ClassVar[str] = "z·(ΔP + Δc·m·g·v + Δg·|P| + Δr·max(−P, 0)), z of each trip 0 or 1"
    source: ClassVar[str] = "limp mode, weak regeneration, a second driver's setting"
    parameters: ClassVar[Parameters] = (
        Size("power_w", "W", 0.0, 1000.0, -6e4, 6e4, least=100.0),
        Size("c_rr", "1", 0.0, 1e-3, -0.02, 0.02, least=2e-5),
        Size("loss", "1", 0.0, 0.05, -0.5, 0.5, least=0.002),
        Size("regeneration", "1", 0.0, 0.1, -0.9, 0.9, least=0.005),
        Choice("share", "1", 0.5, 0.2, 0.0, 1.0),
        Choice("in_mode", "1", float("nan"), 1.0, 0.0, 1.0),
    )
    # a load that is there in some trips only could be anything: it may be declared, but is not looked for
    variants: ClassVar[tuple[Names, ...]] = (("regeneration",), ("loss",), ("c_rr",))
    searched: ClassVar[str] = "trips"
    mistaken_for: ClassVar[Names] = ("step_change", "mass_scale")
    separated_by: ClassVar[str] = "the same trip in either mode"
    order: ClassVar[int] = 20
    power_w: Any
    c_rr: Any
    loss: Any
    regeneration: Any
    share: Any
    in_mode: Any

    def power(self, row: Row, car: Car, point: Point) -> Real:
        z = jnp.where(jnp.isnan(self.in_mode), self.share, self.in_mode)
        weight = car.mass(row) * GRAVITY_MPS2 * row.speed_mps
        recovered = jnp.maximum(-point.power_w, 0.0)
        losses = self.loss * jnp.abs(point.power_w) + self.regeneration * recovered
        return z * (self.power_w + self.c_rr * weight + losses)
