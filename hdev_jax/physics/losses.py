"""Losses of the driveline and of the machine with its inverter that a declared efficiency does not hold."""

from typing import Any, ClassVar

import jax.numpy as jnp

from hdev_jax.physics.effect import Effect
from hdev_jax.physics.parameter import Size

__all__ = ["CopperLoss", "DrivelineDrag", "GearEfficiency", "InverterLoss", "IronLoss"]


class DrivelineDrag(Effect):
    """Drag torque at the motor shaft while it turns, by gear: τ₀[n] as a force τ₀[n]·i/r at the wheel.

    The same torque in all gears is iron loss by the motor's speed under another name.
    """

    id: ClassVar = "driveline_drag"
    label: ClassVar = "drag torque of the driveline"
    stage: ClassVar = "driveline"
    equation: ClassVar = "τ₀[n]·i/r"
    source: ClassVar = "Naunheimer, Fahrzeuggetriebe (no-load losses)"
    entries: ClassVar = ("road",)
    parameters: ClassVar = (Size("torque_nm", "Nm", 0.0, 5.0, 0.0, 200.0, by="gear", whole=True, least=0.05),)
    mistaken_for: ClassVar = ("iron_loss", "constant_headwind")
    separated_by: ClassVar = "coasting in several gears"
    torque_nm: Any

    def drive(self, row, car, point):
        return self.torque_nm * car.driveline.ratio_radpm(row)


class GearEfficiency(Effect):
    """Efficiency that differs by gear: P·δ[n] lost while driving, |P|·δ[n] less while braking."""

    id: ClassVar = "gear_efficiency"
    label: ClassVar = "efficiency by gear"
    stage: ClassVar = "driveline"
    equation: ClassVar = "δ[n]·|F_w|"
    source: ClassVar = "paper 1, section 3.1 (calibration maps by gear)"
    needs: ClassVar = ("gear",)
    entries: ClassVar = ("road",)
    parameters: ClassVar = (Size("delta", "1", 0.0, 0.02, -0.3, 0.3, by="gear", least=0.001),)
    mistaken_for: ClassVar = ("copper_loss",)
    separated_by: ClassVar = "the same power in several gears"
    delta: Any

    def drive(self, row, car, point):
        return self.delta * jnp.abs(point.force_n)


class CopperLoss(Effect):
    """Resistive loss of the windings: k·τ²."""

    id: ClassVar = "copper_loss"
    label: ClassVar = "copper loss of the motor"
    stage: ClassVar = "machine"
    equation: ClassVar = "k·τ²"
    source: ClassVar = "Larminie and Lowry, Electric Vehicle Technology Explained, eq. 7.23"
    parameters: ClassVar = (
        # 5 % of 50 kW at 50 Nm, a small fast motor, are 1 W/Nm²; of a motor of 2000 Nm it is a thousandth
        Size("w_per_nm2", "W/Nm²", 0.0, 0.1, 0.0, 5.0, least=1e-6, label="power per torque squared"),
    )
    mistaken_for: ClassVar = ("battery_resistance",)
    separated_by: ClassVar = "the same power at different torque"
    w_per_nm2: Any

    def power(self, row, car, point):
        return self.w_per_nm2 * point.torque_nm**2


class IronLoss(Effect):
    """Iron and windage of a turning motor: k₁·|ω| + k₂·ω²."""

    id: ClassVar = "iron_loss"
    label: ClassVar = "iron loss of the motor"
    stage: ClassVar = "machine"
    equation: ClassVar = "k₁·|ω| + k₂·ω²"
    source: ClassVar = "Larminie and Lowry, Electric Vehicle Technology Explained, eq. 7.23"
    parameters: ClassVar = (
        # a drag torque in Nm; without ratios in the sheet it is that at the wheel
        Size("w_per_radps", "W·s/rad", 0.0, 1.0, 0.0, 500.0, least=1e-4, label="power per motor speed"),
        Size("w_per_radps2", "W·s²/rad²", 0.0, 1e-3, 0.0, 5.0, least=1e-7, label="power per motor speed squared"),
    )
    variants: ClassVar = (("w_per_radps",), ("w_per_radps2",), ("w_per_radps", "w_per_radps2"))
    mistaken_for: ClassVar = ("driveline_drag", "constant_headwind")
    separated_by: ClassVar = "the motor turning without torque"
    w_per_radps: Any
    w_per_radps2: Any

    def power(self, row, car, point):
        w = jnp.abs(point.speed_radps)
        return self.w_per_radps * w + self.w_per_radps2 * w**2


class InverterLoss(Effect):
    """Inverter: standby while the vehicle is on, and switching loss by current, b·|τ|."""

    id: ClassVar = "inverter_loss"
    label: ClassVar = "inverter loss"
    stage: ClassVar = "machine"
    equation: ClassVar = "P₀ + b·|τ|"
    source: ClassVar = "Graovac and Pürschel, IGBT Power Losses Calculation (linear part)"
    parameters: ClassVar = (
        # gate drivers, control and DC link: data sheets of traction inverters have tens to a few hundred watts; a load
        # beyond is one of the vehicle (auxiliary_power)
        Size("standby_w", "W", 0.0, 200.0, 0.0, 500.0, least=1.0),
        # 3 % of the power at 300 rad/s are 9 W/Nm; a small fast motor has several times that
        Size("per_nm_w", "W/Nm", 0.0, 2.0, 0.0, 100.0, least=1e-4, label="power per torque"),
    )
    variants: ClassVar = (("per_nm_w",), ("standby_w", "per_nm_w"))  # standby alone is auxiliary_power by another name
    mistaken_for: ClassVar = ("auxiliary_power", "copper_loss")
    separated_by: ClassVar = "steps of the key, then torque at standstill"
    standby_w: Any
    per_nm_w: Any

    def power(self, row, car, point):
        return self.standby_w + self.per_nm_w * jnp.abs(point.torque_nm)
