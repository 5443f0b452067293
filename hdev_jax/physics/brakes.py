"""Friction brakes and the force at the wheels: braking, holding the vehicle at rest, dragging after release."""

from typing import Any, ClassVar

import jax.numpy as jnp

from hdev_jax.physics.across import TIME_SINCE_BRAKING, time_since_braking
from hdev_jax.physics.effect import Car, Effect, Names, Parameters, Real, Row, Stage
from hdev_jax.physics.parameter import Shape, Size
from hdev_jax.segments import Segments

__all__ = ["BrakeDrag", "FrictionBrake", "StandstillHold"]

ROAD = ("road",)


class BrakeDrag(Effect):
    """Pads that drag after braking: F·exp(−t/τ), t the time since the brake was released."""

    id: ClassVar[str] = "brake_drag"
    label: ClassVar[str] = "brake drag"
    stage: ClassVar[Stage] = "road"  # at the wheel: the driveline carries it
    equation: ClassVar[str] = "F·exp(−t_release/τ)"
    source: ClassVar[str] = "Breuer and Bill, Bremsenhandbuch (residual torque)"
    needs: ClassVar[Names] = ("brake_pressure_pa",)
    entries: ClassVar[Names] = ROAD
    parameters: ClassVar[Parameters] = (
        # a residual torque of 1 to 5 Nm at each brake of a car, ten times that of a truck; 10 kN brake 10 t
        Size("force_n", "N", 0.0, 300.0, 0.0, 1e4, least=5.0),
        Shape("tau_s", "s", 30.0, 20.0, 2.0, 600.0, grid=(10.0, 30.0, 90.0), label="time constant"),
    )
    derives: ClassVar[Names] = (TIME_SINCE_BRAKING,)
    mistaken_for: ClassVar[Names] = ("tyre_warmup",)
    separated_by: ClassVar[str] = "cruising just after braking and long after"
    force_n: Any
    tau_s: Any

    def derive(self, segments: Segments) -> Segments:
        if segments.has(TIME_SINCE_BRAKING):  # worked out before
            return segments
        return segments.with_channels(**{TIME_SINCE_BRAKING: time_since_braking(segments)})

    def force(self, row: Row, car: Car) -> Real:
        moving = row.speed_mps > 0.1
        since = row.channels[TIME_SINCE_BRAKING]
        return self.force_n * jnp.where(moving & (since > 0), jnp.exp(-since / self.tau_s), 0.0)


class FrictionBrake(Effect):
    """Braking force of the friction brakes: + k·brake signal, while the vehicle moves.

    F_drive = m·a + resistances + F_brake. While braking the drive's force is negative; what the friction brakes take
    makes it less negative.
    """

    id: ClassVar[str] = "friction_brake"
    label: ClassVar[str] = "friction brake"
    stage: ClassVar[Stage] = "road"
    equation: ClassVar[str] = "+k·brake"
    source: ClassVar[str] = "paper 2, eq. 7-9 (share of braking that is not regenerated)"
    needs: ClassVar[Names] = ("brake_pressure_pa|brake_pedal_pct",)
    entries: ClassVar[Names] = ROAD
    parameters: ClassVar[Parameters] = (
        Size(
            "n_per_unit",
            "N per unit of the brake signal",
            0.0,
            1.0,
            0.0,
            1e4,
            least=1e-6,
            label="force per unit of the signal",
        ),
    )
    mistaken_for: ClassVar[Names] = ("mass_scale", "friction_blending")
    separated_by: ClassVar[str] = "braking hard and lightly"
    n_per_unit: Any

    def force(self, row: Row, car: Car) -> Real:
        brake = row.get("brake_pressure_pa", row.get("brake_pedal_pct", 0.0))
        return self.n_per_unit * jnp.where(row.speed_mps > 0.1, jnp.maximum(brake, 0.0), 0.0)


class StandstillHold(Effect):
    """At rest the brakes hold the vehicle: they carry the share s of the road's forces, and the drive the rest.

    Only a measured force or torque can show this: at rest the drive's power is zero anyway.
    """

    id: ClassVar[str] = "standstill_hold"
    label: ClassVar[str] = "brakes that hold at rest"
    stage: ClassVar[Stage] = "road"
    equation: ClassVar[str] = "−s·ΣF·[v < 0.1 m/s]"
    source: ClassVar[str] = "statics: a force that does not move is carried by the brakes"
    entries: ClassVar[Names] = ROAD
    parameters: ClassVar[Parameters] = (Size("share", "1", 0.0, 0.5, 0.0, 1.2, least=0.05),)
    mistaken_for: ClassVar[Names] = ("rolling_speed",)
    separated_by: ClassVar[str] = "standing on a slope, with and without the brake"
    order: ClassVar[int] = 90
    share: Any

    def force(self, row: Row, car: Car) -> Real:
        others = (e for e in car.effects if e.overrides("force") and not isinstance(e, StandstillHold))
        total = sum(e.force(row, car) for e in others)
        return -self.share * jnp.where(row.speed_mps < 0.1, total, 0.0)
