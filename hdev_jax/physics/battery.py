"""Losses, limits and changes between the machine and the battery."""

from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from hdev_jax.physics.effect import Effect, Parameter
from hdev_jax.units import GRAVITY_MPS2

__all__ = [
    "BatteryResistance",
    "FrictionBlending",
    "ModeChange",
    "RegenCutoff",
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
    """Consumption that follows the voltage: P·k·(V − V₀)."""

    id: ClassVar = "voltage_dependence"
    stage: ClassVar = "battery"
    equation: ClassVar = "P·k·(V − V₀)"
    source: ClassVar = "inverter efficiency against DC voltage"
    needs: ClassVar = ("voltage_v",)
    parameters: ClassVar = (
        Parameter("per_v", "1/V", 0.0, 5e-4, -0.02, 0.02, least=1e-6),
        # where the sheet's efficiencies hold; far off it is a gain of the power, which they may not be able to absorb
        Parameter(
            "at_v", "V", 650.0, 50.0, 200.0, 1000.0, kind="shape", grid=(350.0, 550.0, 600.0, 650.0, 700.0, 800.0)
        ),
    )
    mistaken_for: ClassVar = ("battery_resistance",)
    separated_by: ClassVar = "long trips from full to empty"
    order: ClassVar = 40
    per_v: Any
    at_v: Any

    def power(self, row, car, point):
        return point.power_w * self.per_v * (row.channels["voltage_v"] - self.at_v)


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
                  grid=_ladder(1e4, 3.5e5, 27)),
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
        Parameter("at_trip", "1", 0.0, 1.0, kind="choice", grid=()),  # every trip with three on either side
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
        weight = car.mass(row) * GRAVITY_MPS2 * row.speed_mps
        return after * (self.power_w + self.c_rr * weight + self.loss * jnp.abs(point.power_w))


class ModeChange(Effect):
    """A second mode that holds in some trips: a load, a rolling resistance, a loss, or regeneration that is weaker.

    Which trips is sought, not declared; on a trip that nobody has fitted (`in_mode` NaN) it weighs as often as it was
    seen.
    """

    id: ClassVar = "mode_change"
    stage: ClassVar = "battery"
    equation: ClassVar = "z·(ΔP + Δc·m·g·v + Δg·|P| + Δr·max(−P, 0)), z of each trip 0 or 1"
    source: ClassVar = "limp mode, weak regeneration, a second driver's setting"
    parameters: ClassVar = (
        Parameter("power_w", "W", 0.0, 1000.0, -6e4, 6e4, least=10.0),
        Parameter("c_rr", "1", 0.0, 1e-3, -0.02, 0.02, least=2e-5),
        Parameter("loss", "1", 0.0, 0.05, -0.5, 0.5, least=0.002),
        Parameter("regeneration", "1", 0.0, 0.1, -0.9, 0.9, least=0.005),
        Parameter("share", "1", 0.5, 0.2, 0.0, 1.0, kind="choice"),
        Parameter("in_mode", "1", float("nan"), 1.0, 0.0, 1.0, kind="choice"),
    )
    # a load that is there in some trips only could be anything: it may be declared, but is not looked for
    variants: ClassVar = (("regeneration",), ("loss",), ("c_rr",))
    searched: ClassVar = "trips"
    mistaken_for: ClassVar = ("step_change", "mass_scale")
    separated_by: ClassVar = "the same trip in either mode"
    order: ClassVar = 20
    power_w: Any
    c_rr: Any
    loss: Any
    regeneration: Any
    share: Any
    in_mode: Any

    def power(self, row, car, point):
        z = jnp.where(jnp.isnan(self.in_mode), self.share, self.in_mode)
        weight = car.mass(row) * GRAVITY_MPS2 * row.speed_mps
        recovered = jnp.maximum(-point.power_w, 0.0)
        losses = self.loss * jnp.abs(point.power_w) + self.regeneration * recovered
        return z * (self.power_w + self.c_rr * weight + losses)
