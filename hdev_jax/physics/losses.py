"""Losses of the driveline and of the machine with its inverter that a declared efficiency does not include."""

from typing import Any, ClassVar

import jax.numpy as jnp

from hdev_jax.physics.effect import Car, Effect, Names, Parameters, Point, Real, Row, Stage
from hdev_jax.physics.parameter import Choice, Size

__all__ = ["CopperLoss", "DrivelineDrag", "GearEfficiency", "InverterLoss", "IronLoss", "PartLoad"]


class DrivelineDrag(Effect):
    """Drag torque at the motor shaft while it turns, by gear: τ₀[n] as a force τ₀[n]·i/r at the wheel.

    With the same torque in all gears the effect equals `iron_loss` proportional to the motor's speed.
    """

    id: ClassVar[str] = "driveline_drag"
    label: ClassVar[str] = "drag torque of the driveline"
    stage: ClassVar[Stage] = "driveline"
    equation: ClassVar[str] = "τ₀[n]·i/r"
    source: ClassVar[str] = "Naunheimer, Fahrzeuggetriebe (no-load losses)"
    entries: ClassVar[Names] = ("road",)
    parameters: ClassVar[Parameters] = (
        Size("torque_nm", "Nm", 0.0, 5.0, 0.0, 200.0, by="gear", whole=True, least=0.05),
    )
    mistaken_for: ClassVar[Names] = ("iron_loss", "constant_headwind")
    separated_by: ClassVar[str] = "coasting in several gears"
    torque_nm: Any

    def drive(self, row: Row, car: Car, point: Point) -> Real:
        return self.torque_nm * car.driveline.ratio_radpm(row)


class GearEfficiency(Effect):
    """Efficiency that differs by gear: P·δ[n] lost while driving, |P|·δ[n] less while braking."""

    id: ClassVar[str] = "gear_efficiency"
    label: ClassVar[str] = "efficiency by gear"
    stage: ClassVar[Stage] = "driveline"
    equation: ClassVar[str] = "δ[n]·|F_w|"
    source: ClassVar[str] = "paper 1, section 3.1 (calibration maps by gear)"
    needs: ClassVar[Names] = ("gear",)
    entries: ClassVar[Names] = ("road",)
    parameters: ClassVar[Parameters] = (Size("delta", "1", 0.0, 0.02, -0.3, 0.3, by="gear", least=0.001),)
    mistaken_for: ClassVar[Names] = ("copper_loss",)
    separated_by: ClassVar[str] = "the same power in several gears"
    delta: Any

    def drive(self, row: Row, car: Car, point: Point) -> Real:
        return self.delta * jnp.abs(point.force_n)


class CopperLoss(Effect):
    """Resistive loss of the windings: k·τ²."""

    id: ClassVar[str] = "copper_loss"
    label: ClassVar[str] = "copper loss of the motor"
    stage: ClassVar[Stage] = "machine"
    equation: ClassVar[str] = "k·τ²"
    source: ClassVar[str] = "Larminie and Lowry, Electric Vehicle Technology Explained, eq. 7.23"
    parameters: ClassVar[Parameters] = (
        # 5 % of 50 kW at 50 Nm, a small fast motor, are 1 W/Nm²; of a motor of 2000 Nm it is a thousandth
        Size("w_per_nm2", "W/Nm²", 0.0, 0.1, 0.0, 5.0, least=1e-6, label="power per torque squared"),
    )
    mistaken_for: ClassVar[Names] = ("battery_resistance",)
    separated_by: ClassVar[str] = "the same power at different torque"
    w_per_nm2: Any

    def power(self, row: Row, car: Car, point: Point) -> Real:
        return self.w_per_nm2 * point.torque_nm**2


class IronLoss(Effect):
    """Iron and windage loss of the turning motor: k₁·|ω| + k₂·ω²."""

    id: ClassVar[str] = "iron_loss"
    label: ClassVar[str] = "iron loss of the motor"
    stage: ClassVar[Stage] = "machine"
    equation: ClassVar[str] = "k₁·|ω| + k₂·ω²"
    source: ClassVar[str] = "Larminie and Lowry, Electric Vehicle Technology Explained, eq. 7.23"
    parameters: ClassVar[Parameters] = (
        # a drag torque in Nm; without ratios in the sheet it is that at the wheel
        Size("w_per_radps", "W·s/rad", 0.0, 1.0, 0.0, 500.0, least=1e-4, label="power per motor speed"),
        Size("w_per_radps2", "W·s²/rad²", 0.0, 1e-3, 0.0, 5.0, least=1e-7, label="power per motor speed squared"),
    )
    variants: ClassVar[tuple[Names, ...]] = (("w_per_radps",), ("w_per_radps2",), ("w_per_radps", "w_per_radps2"))
    mistaken_for: ClassVar[Names] = ("driveline_drag", "constant_headwind")
    separated_by: ClassVar[str] = "the motor turning without torque"
    w_per_radps: Any
    w_per_radps2: Any

    def power(self, row: Row, car: Car, point: Point) -> Real:
        w = jnp.abs(point.speed_radps)
        return self.w_per_radps * w + self.w_per_radps2 * w**2


class InverterLoss(Effect):
    """Inverter loss, standby and switching: P₀ while the vehicle is on, and b·|τ| by current."""

    id: ClassVar[str] = "inverter_loss"
    label: ClassVar[str] = "inverter loss"
    stage: ClassVar[Stage] = "machine"
    equation: ClassVar[str] = "P₀ + b·|τ|"
    source: ClassVar[str] = "Graovac and Pürschel, IGBT Power Losses Calculation (linear part)"
    parameters: ClassVar[Parameters] = (
        # gate drivers, control and DC link: data sheets of traction inverters have tens to a few hundred watts; a load
        # beyond is one of the vehicle (auxiliary_power)
        Size("standby_w", "W", 0.0, 200.0, 0.0, 500.0, least=1.0),
        # 3 % of the power at 300 rad/s are 9 W/Nm; a small fast motor has several times that
        Size("per_nm_w", "W/Nm", 0.0, 2.0, 0.0, 100.0, least=1e-4, label="power per torque"),
    )
    # standby alone is auxiliary_power by another name
    variants: ClassVar[tuple[Names, ...]] = (("per_nm_w",), ("standby_w", "per_nm_w"))
    mistaken_for: ClassVar[Names] = ("auxiliary_power", "copper_loss")
    separated_by: ClassVar[str] = "steps of the key, then torque at standstill"
    standby_w: Any
    per_nm_w: Any

    def power(self, row: Row, car: Car, point: Point) -> Real:
        return self.standby_w + self.per_nm_w * jnp.abs(point.torque_nm)


class PartLoad(Effect):
    """Efficiency that falls at low load and at high load: P₀·|P|/(P_h + |P|) + c·P², P the drive's power.

    A loss proportional to |P| is no part of it: that is the declared efficiency (`efficiency_scale`). The first term
    grows from 0 without load to half of P₀ at P_h and levels off at P₀; so it differs from a load at standstill.
    """

    id: ClassVar[str] = "part_load"
    label: ClassVar[str] = "efficiency that depends on the load"
    stage: ClassVar[Stage] = "machine"
    of_efficiency: ClassVar[bool] = True
    equation: ClassVar[str] = "P₀·|P|/(P_h + |P|) + c·P²"
    source: ClassVar[str] = "Larminie and Lowry, Electric Vehicle Technology Explained, eq. 7.23 (constant, copper)"
    parameters: ClassVar[Parameters] = (
        # a drive of 100 kW that has 94 % at its best and 75 % at a twentieth of its power loses 1.4 kW more than 6 %
        Size("standby_w", "W", 0.0, 500.0, 0.0, 1.5e4, least=20.0, label="loss at high load"),
        # 5 % of 50 kW, of a small machine at its rated power, are 1e-6 per watt; of a truck's 300 kW a sixth of that
        Size("per_w", "1/W", 0.0, 1e-7, 0.0, 5e-6, least=5e-9, label="loss per power squared"),
        # chosen, not fitted: half a step of this grid changes the curve by less than a seventh of P₀
        Choice("half_w", "W", 3e3, 2e3, 300.0, 1e5, grid=(1e3, 3e3, 1e4, 3e4), of="standby_w", label="half-loss power"),
    )
    variants: ClassVar[tuple[Names, ...]] = (("standby_w",), ("per_w",), ("standby_w", "per_w"))
    mistaken_for: ClassVar[Names] = ("power_gain", "copper_loss", "battery_resistance", "regen_efficiency")
    separated_by: ClassVar[str] = "constant speeds, from slow to fast"
    order: ClassVar[int] = 10  # of the machine's losses the last: it takes what they leave
    standby_w: Any
    per_w: Any
    half_w: Any

    def power(self, row: Row, car: Car, point: Point) -> Real:
        load = jnp.abs(point.power_w)
        return self.standby_w * load / (self.half_w + load) + self.per_w * load**2
