"""Faults of the measurements themselves: scales, offsets, delays and filters."""

from typing import Any, ClassVar

import jax.numpy as jnp

from hdev_jax.physics.across import later_slope, less_noise, low_pass, neighbours, shifted
from hdev_jax.physics.effect import Car, Effect, Names, Parameters, Row, Signal, Stage
from hdev_jax.physics.parameter import Choice, Size, Switch
from hdev_jax.segments import ACCEL_SD, GRADE_SD, Segments

__all__ = [
    "AccelerometerBias",
    "GradeBias",
    "GradeLag",
    "GradeNoise",
    "GradeScale",
    "MassScale",
    "PowerGain",
    "SamplingFilter",
    "SpeedScale",
    "TimeSkew",
    "TorqueOffset",
]


class MassScale(Effect):
    """The mass differs from the logged one: m·(1 + s)."""

    id: ClassVar[str] = "mass_scale"
    label: ClassVar[str] = "payload error"
    stage: ClassVar[Stage] = "sensors"
    equation: ClassVar[str] = "m → m·(1 + s)"
    source: ClassVar[str] = "paper 1, section 5 (mass as future work)"
    entries: ClassVar[Names] = ("road",)
    parameters: ClassVar[Parameters] = (Size("scale", "1", 0.0, 0.1, -0.6, 1.5, least=0.005),)
    mistaken_for: ClassVar[Names] = ("rotating_mass",)
    separated_by: ClassVar[str] = "the same road empty and loaded"
    scale: Any

    def sense(self, row: Row, car: Car) -> Row:
        return row.with_channels(mass_kg=jnp.asarray(car.mass(row) * (1.0 + self.scale)))


class GradeBias(Effect):
    """The slope has an offset: θ + b. Only a road driven out and back tells it from rolling resistance."""

    id: ClassVar[str] = "grade_bias"
    label: ClassVar[str] = "slope bias"
    stage: ClassVar[Stage] = "sensors"
    instrument: ClassVar[bool] = True
    equation: ClassVar[str] = "θ → θ + b"
    source: ClassVar[str] = "mounting of an inclinometer"
    needs: ClassVar[Names] = ("grade_rad",)
    entries: ClassVar[Names] = ("road",)
    parameters: ClassVar[Parameters] = (Size("bias_rad", "rad", 0.0, 2e-3, -0.05, 0.05, least=5e-5),)
    mistaken_for: ClassVar[Names] = ("rolling",)
    separated_by: ClassVar[str] = "the same road out and back"
    bias_rad: Any

    def sense(self, row: Row, car: Car) -> Row:
        return row.with_channels(grade_rad=row.channels["grade_rad"] + self.bias_rad)


class GradeScale(Effect):
    """The slope is read too steep or too flat, for instance from smoothed heights: θ·(1 + s)."""

    id: ClassVar[str] = "grade_scale"
    label: ClassVar[str] = "scale of the slope"
    stage: ClassVar[Stage] = "sensors"
    instrument: ClassVar[bool] = True
    equation: ClassVar[str] = "θ → θ·(1 + s)"
    source: ClassVar[str] = "differences of smoothed heights"
    needs: ClassVar[Names] = ("grade_rad",)
    entries: ClassVar[Names] = ("road",)
    # a slope whose noise counts as slope is attenuated to half; a percentage taken for degrees is another matter
    parameters: ClassVar[Parameters] = (Size("scale", "1", 0.0, 0.1, -0.6, 1.0, least=0.01),)
    mistaken_for: ClassVar[Names] = ("mass_scale", "grade_lag", "grade_noise")
    separated_by: ClassVar[str] = "accelerating on the flat, and the same hills again"
    order: ClassVar[int] = -1  # before an offset
    scale: Any

    def sense(self, row: Row, car: Car) -> Row:
        return row.with_channels(grade_rad=row.channels["grade_rad"] * (1.0 + self.scale))


class GradeLag(Effect):
    """The slope signal lags: the slope logged at t is that of the road at t − L."""

    id: ClassVar[str] = "grade_lag"
    label: ClassVar[str] = "lag of the slope"
    stage: ClassVar[Stage] = "sensors"
    instrument: ClassVar[bool] = True
    equation: ClassVar[str] = "θ(t) → θ(t + L)"
    source: ClassVar[str] = "lag of a barometric altimeter"
    needs: ClassVar[Names] = ("grade_rad",)
    entries: ClassVar[Names] = ("road",)
    parameters: ClassVar[Parameters] = (
        Switch("lag_s", "s", 0.0, 1.0, -60.0, 60.0, in_rows=True, smooth=True, least=0.05,
                  grid=(-4.0, -2.0, -1.0, -0.5, 0.5, 1.0, 2.0, 4.0)),
    )  # fmt: skip
    mistaken_for: ClassVar[Names] = ("grade_bias",)
    separated_by: ClassVar[str] = "short hills, up and down"
    lag_s: Any

    def across(self, segments: Segments) -> Segments:
        return segments.with_channels(grade_rad=later_slope(segments, self.lag_s))


class GradeNoise(Effect):
    """The slope's noise counts as slope: the road is flatter where a row differs from its neighbours."""

    id: ClassVar[str] = "grade_noise"
    label: ClassVar[str] = "noise of the slope"
    stage: ClassVar[Stage] = "sensors"
    instrument: ClassVar[bool] = True
    equation: ClassVar[str] = "θ → θ − σ²·r/Var r, r what the neighbours do not say of θ"
    source: ClassVar[str] = "Carroll et al., Measurement Error in Nonlinear Models, chapter 4 (regression calibration)"
    needs: ClassVar[Names] = ("grade_rad",)
    lacks: ClassVar[Names] = (GRADE_SD,)
    instead: ClassVar[str] = "the noise of the slope was seen in the log itself, and smoothed"
    entries: ClassVar[Names] = ("road",)
    parameters: ClassVar[Parameters] = (
        # an inclinometer in a vehicle shows 0.3 %, heights of 1 m over 100 m 1.4 %; 5e-4 is 5 cm over 100 m
        Switch("sd_rad", "rad", 0.0, 0.01, 0.0, 0.1, grid=(0.0025, 0.005, 0.01, 0.02, 0.04), least=5e-4),
    )
    mistaken_for: ClassVar[Names] = ("grade_scale", "mass_scale")
    separated_by: ClassVar[str] = "the same roads again, and the spectrum of the slope"
    order: ClassVar[int] = -1  # of readings as they are: a lag that is taken out mixes neighbours and their errors
    sd_rad: Any

    def across(self, segments: Segments) -> Segments:
        return segments.with_channels(grade_rad=less_noise(segments.channels["grade_rad"], segments, self.sd_rad))


class SpeedScale(Effect):
    """Speed and distance are wrong by a factor, by worn tyres or another size of them: v·(1 + s)."""

    id: ClassVar[str] = "speed_scale"
    label: ClassVar[str] = "scale of the speed signal"
    stage: ClassVar[Stage] = "sensors"
    instrument: ClassVar[bool] = True
    equation: ClassVar[str] = "v → v·(1 + s), d → d·(1 + s)"
    source: ClassVar[str] = "wear and pressure of tyres"
    entries: ClassVar[Names] = ("road",)
    # a speedometer may show 10 % and 4 km/h too much (UN Regulation 39); load changes a tyre's radius by 0.3 %
    parameters: ClassVar[Parameters] = (Size("scale", "1", 0.0, 0.03, -0.1, 0.1, least=0.003),)
    mistaken_for: ClassVar[Names] = ("mass_scale", "rotating_mass")
    separated_by: ClassVar[str] = "a position by satellite"
    scale: Any

    def sense(self, row: Row, car: Car) -> Row:
        return row.faster(1.0 + self.scale)


class AccelerometerBias(Effect):
    """The accelerometer is tilted: a_sensor − b. It matters where the slope comes from the accelerometer."""

    id: ClassVar[str] = "accelerometer_bias"
    label: ClassVar[str] = "bias of the accelerometer"
    stage: ClassVar[Stage] = "sensors"
    instrument: ClassVar[bool] = True
    equation: ClassVar[str] = "a_sensor → a_sensor − b"
    source: ClassVar[str] = "mounting tilt"
    needs: ClassVar[Names] = ("accel_mps2",)
    lacks: ClassVar[Names] = ("grade_rad",)
    entries: ClassVar[Names] = ("road",)
    parameters: ClassVar[Parameters] = (Size("bias_mps2", "m/s²", 0.0, 0.05, -1.0, 1.0, least=0.002),)
    mistaken_for: ClassVar[Names] = ("rolling",)
    separated_by: ClassVar[str] = "standing still on the flat"
    bias_mps2: Any

    def sense(self, row: Row, car: Car) -> Row:
        return row.with_channels(accel_mps2=row.channels["accel_mps2"] - self.bias_mps2)


class TorqueOffset(Effect):
    """The torque signal has an offset and a gain: τ·(1 + g) + τ₀."""

    id: ClassVar[str] = "torque_offset"
    label: ClassVar[str] = "offset or gain of the torque signal"
    stage: ClassVar[Stage] = "sensors"
    instrument: ClassVar[bool] = True
    equation: ClassVar[str] = "τ → τ·(1 + g) + τ₀"
    source: ClassVar[str] = "torque estimated from currents"
    needs: ClassVar[Names] = ("motor_torque_nm",)
    entries: ClassVar[Names] = ("shaft",)
    parameters: ClassVar[Parameters] = (
        Size("offset_nm", "Nm", 0.0, 1.0, -200.0, 200.0, least=0.5),
        # what an inverter estimates from currents is within 5 %
        Size("gain", "1", 0.0, 0.03, -0.1, 0.1, least=0.005),
    )
    variants: ClassVar[tuple[Names, ...]] = (("offset_nm",), ("gain",), ("offset_nm", "gain"))
    mistaken_for: ClassVar[Names] = ("iron_loss", "driveline_drag")
    separated_by: ClassVar[str] = "coasting at zero torque"
    offset_nm: Any
    gain: Any

    def sense(self, row: Row, car: Car) -> Row:
        return row.with_channels(motor_torque_nm=row.channels["motor_torque_nm"] * (1.0 + self.gain) + self.offset_nm)


class PowerGain(Effect):
    """The power sensor has a gain and an offset: P·(1 + g) + P₀. An offset above 0 is a constant load first."""

    id: ClassVar[str] = "power_gain"
    label: ClassVar[str] = "offset or gain of the power signal"
    stage: ClassVar[Stage] = "sensors"
    instrument: ClassVar[bool] = True
    equation: ClassVar[str] = "P → P·(1 + g) + P₀"
    source: ClassVar[str] = "current sensor"
    of_battery: ClassVar[bool] = True
    parameters: ClassVar[Parameters] = (
        # twice the 5 % of a current sensor in a vehicle; electric meters are within 2 % (EN 50470, classes A and B)
        Size("gain", "1", 0.0, 0.03, -0.1, 0.1, least=0.005),
        Size("offset_w", "W", 0.0, 500.0, -2e4, 2e4, least=50.0, constant=True),
    )
    # an offset alone is auxiliary_power by another name, and so is one above 0 beside a gain (`is_constant_load`)
    variants: ClassVar[tuple[Names, ...]] = (("gain",), ("gain", "offset_w"))
    mistaken_for: ClassVar[Names] = ("auxiliary_power",)
    separated_by: ClassVar[str] = "the balance of charge over a trip"
    order: ClassVar[int] = 10
    gain: Any
    offset_w: Any

    def observe(self, column: Signal, segments: Segments) -> Signal:
        return column * (1.0 + self.gain) + self.offset_w


class TimeSkew(Effect):
    """The target's clock is late: P(t − s); positive where the target lags the other channels."""

    id: ClassVar[str] = "time_skew"
    label: ClassVar[str] = "time skew between channels"
    stage: ClassVar[Stage] = "sensors"
    instrument: ClassVar[bool] = True
    equation: ClassVar[str] = "P(t) → P(t − s)"
    source: ClassVar[str] = "messages of several control units on one bus"
    parameters: ClassVar[Parameters] = (
        Switch("skew_s", "s", 0.0, 0.5, -30.0, 30.0, in_rows=True, smooth=True, least=0.005,
                  grid=(-4.0, -2.0, -1.0, -0.4, 0.4, 1.0, 2.0, 4.0), label="skew"),
        Choice("cubic", "1", 0.0, 1.0, 0.0, 1.0, grid=(0.0, 1.0)),
    )  # fmt: skip
    mistaken_for: ClassVar[Names] = ("sampling_filter", "rotating_mass")
    separated_by: ClassVar[str] = "steps of the pedal"
    skew_s: Any
    cubic: Any

    def observe(self, column: Signal, segments: Segments) -> Signal:
        return shifted(column, segments, self.skew_s, self.cubic)


class SamplingFilter(Effect):
    """The target is filtered: P + c₁·Δ₁²P + c₂·Δ₂²P with Δⱼ² = x(k−j) − 2x(k) + x(k+j), or a lag of first order τ.

    Negative taps c sharpen the target: then the inputs are what was smoothed.
    """

    id: ClassVar[str] = "sampling_filter"
    label: ClassVar[str] = "filter of the measured signal"
    stage: ClassVar[Stage] = "sensors"
    instrument: ClassVar[bool] = True
    equation: ClassVar[str] = "P → P + Σ cⱼ·(P₋ⱼ − 2P + P₊ⱼ), or τ·dP/dt + P"
    source: ClassVar[str] = "Proakis and Manolakis, Digital Signal Processing (symmetric FIR; first-order lag)"
    lacks: ClassVar[Names] = (ACCEL_SD,)
    instead: ClassVar[str] = "the speeds are read in coarse steps and were smoothed, which is a filter by itself"
    parameters: ClassVar[Parameters] = (
        Size("tap_1", "1", 0.0, 0.1, -1.0, 1.0, least=0.002),
        Size("tap_2", "1", 0.0, 0.1, -1.0, 1.0, least=0.002),
        Switch(
            "tau_s",
            "s",
            0.0,
            1.0,
            0.0,
            120.0,
            in_rows=True,
            smooth=True,
            grid=(0.5, 1.0, 2.0, 5.0),
            label="time constant",
        ),
    )
    variants: ClassVar[tuple[Names, ...]] = (("tap_1",), ("tap_1", "tap_2"), ("tau_s",))
    mistaken_for: ClassVar[Names] = ("time_skew",)
    separated_by: ClassVar[str] = "steps of the pedal"
    order: ClassVar[int] = 5
    tap_1: Any
    tap_2: Any
    tau_s: Any  # None where only the taps are in use: the recursion is not run

    def observe(self, column: Signal, segments: Segments) -> Signal:
        sharp = column + self.tap_1 * neighbours(column, segments, 1) + self.tap_2 * neighbours(column, segments, 2)
        return sharp if self.tau_s is None else low_pass(sharp, segments, self.tau_s)
