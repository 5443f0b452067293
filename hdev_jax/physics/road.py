"""Forces between the road and the wheel: the four of the papers, and those a declared model may lack."""

from collections.abc import Mapping
from typing import Any, ClassVar

import jax.numpy as jnp

from hdev_jax.physics.effect import Car, Effect, GoesWith, Names, Parameters, Real, Row, Stage
from hdev_jax.physics.parameter import Size
from hdev_jax.segments import Segments
from hdev_jax.units import AIR_DENSITY_KGPM3, GRAVITY_MPS2

__all__ = [
    "Aero",
    "AirDensity",
    "ConstantHeadwind",
    "Crosswind",
    "Drafting",
    "Grade",
    "Headwind",
    "Inertia",
    "RoadGrade",
    "Rolling",
    "RotatingMass",
    "density_of_weather",
]

ROAD = ("road",)


def _slope(row: Segments) -> Any:
    return row.get("grade_rad", 0.0)


def weight_on_road(row: Segments, car: Car) -> Any:
    """m·g·cosθ [N]. A road is never upright, so cosθ = √(1 − sin²θ): the sine is there already."""
    return car.mass(row) * GRAVITY_MPS2 * jnp.sqrt(1.0 - jnp.sin(_slope(row)) ** 2)


# --- declared: equations 3 and 4 of paper 1, equation 2 of paper 2 ---------------------------------------------------


class Inertia(Effect):
    """F_a = λ·m·a (paper 1, equation 3; λ of paper 2, equation 2)."""

    id: ClassVar[str] = "inertia"
    label: ClassVar[str] = "acceleration"
    stage: ClassVar[Stage] = "road"
    equation: ClassVar[str] = "λ·m·a"
    source: ClassVar[str] = "paper 1, eq. 3; paper 2, eq. 2"
    entries: ClassVar[Names] = ROAD
    declared: ClassVar[Mapping[str, str]] = {"rotating_mass_factor": "road.rotating_mass_factor"}
    rotating_mass_factor: Any

    def force(self, row: Row, car: Car) -> Real:
        return self.rotating_mass_factor * car.mass(row) * row.accel_of_way_mps2


class Grade(Effect):
    """F_g = m·g·sinθ (paper 1, equation 3)."""

    id: ClassVar[str] = "grade"
    label: ClassVar[str] = "slope"
    stage: ClassVar[Stage] = "road"
    equation: ClassVar[str] = "m·g·sinθ"
    source: ClassVar[str] = "paper 1, eq. 3"
    entries: ClassVar[Names] = ROAD

    def force(self, row: Row, car: Car) -> Real:
        return car.mass(row) * GRAVITY_MPS2 * jnp.sin(_slope(row))


class Rolling(Effect):
    """F_r = m·g·C_rr·cosθ (paper 1, equation 3)."""

    id: ClassVar[str] = "rolling"
    label: ClassVar[str] = "rolling resistance"
    stage: ClassVar[Stage] = "road"
    equation: ClassVar[str] = "m·g·C_rr·cosθ"
    source: ClassVar[str] = "paper 1, eq. 3"
    entries: ClassVar[Names] = ROAD
    goes_with: ClassVar[GoesWith] = "weight"
    declared: ClassVar[Mapping[str, str]] = {"c_rr": "road.c_rr"}
    c_rr: Any

    def force(self, row: Row, car: Car) -> Real:
        return self.c_rr * weight_on_road(row, car)


class Aero(Effect):
    """F_d = ½·ρ·C_d·A·(v_i² + v_f²)/2 (paper 1, equation 4), ρ the log's density or, without one, the standard ρ₀."""

    id: ClassVar[str] = "aero"
    label: ClassVar[str] = "air drag"
    stage: ClassVar[Stage] = "road"
    equation: ClassVar[str] = "½·ρ·C_d·A·(v_i² + v_f²)/2"
    source: ClassVar[str] = "paper 1, eq. 4"
    entries: ClassVar[Names] = ROAD
    goes_with: ClassVar[GoesWith] = "air"
    declared: ClassVar[Mapping[str, str]] = {"cda_m2": "road.cda_m2"}
    cda_m2: Any

    def force(self, row: Row, car: Car) -> Real:
        return car.drag(row) * row.square_speed_m2ps2


# --- air -------------------------------------------------------------------------------------------------------------


def density_of_weather(row: Segments) -> Any:
    """Density of the air [kg/m³]: p/(R·T) with the pressure of ISO 2533 at the row's altitude."""
    left = jnp.maximum(1.0 - 2.25577e-5 * row.get("altitude_m", 0.0), 0.0)  # none above 44 km
    pressure_pa = 101325.0 * left**5.25588
    return pressure_pa / (287.05 * (row.get("ambient_temp_c", 15.0) + 273.15))


def _wind_along(row: Segments) -> Any:
    """Wind against the vehicle [m/s]: it blows *from* `wind_from_rad`."""
    return row.channels["wind_speed_mps"] * jnp.cos(row.channels["wind_from_rad"] - row.channels["heading_rad"])


def _extra_drag(row: Segments, car: Car, wind_mps: Any) -> Any:
    """Drag at air speed v + w less drag at v, with the sign of the air speed: the mean of both ends, as in `Aero`."""
    ends = (row.speed_start_mps, row.speed_end_mps)
    return car.drag(row) * 0.5 * sum((v + wind_mps) * jnp.abs(v + wind_mps) - v**2 for v in ends)


class ConstantHeadwind(Effect):
    """The same headwind w in every row: ½ρC_dA((v+w)² − v²)."""

    id: ClassVar[str] = "constant_headwind"
    label: ClassVar[str] = "constant headwind"
    stage: ClassVar[Stage] = "road"
    equation: ClassVar[str] = "½ρ·C_dA·((v+w)² − v²)"
    source: ClassVar[str] = "paper 2, eq. 2"
    entries: ClassVar[Names] = ROAD
    goes_with: ClassVar[GoesWith] = "air"
    parameters: ClassVar[Parameters] = (Size("speed_mps", "m/s", 0.0, 2.0, -15.0, 15.0, least=0.1),)
    mistaken_for: ClassVar[Names] = ("iron_loss", "driveline_drag")
    separated_by: ClassVar[str] = "drive the same road out and back"
    speed_mps: Any

    def force(self, row: Row, car: Car) -> Real:
        return _extra_drag(row, car, self.speed_mps)


class Headwind(Effect):
    """Measured wind along the heading: ½ρC_dA((v + s·w·cos(from − heading))² − v²)."""

    id: ClassVar[str] = "headwind"
    label: ClassVar[str] = "headwind"
    stage: ClassVar[Stage] = "road"
    equation: ClassVar[str] = "½ρ·C_dA·((v + s·w·cos δ)² − v²)"
    source: ClassVar[str] = "paper 2, eq. 2"
    needs: ClassVar[Names] = ("wind_speed_mps", "wind_from_rad", "heading_rad")
    entries: ClassVar[Names] = ROAD
    goes_with: ClassVar[GoesWith] = "air"
    parameters: ClassVar[Parameters] = (Size("scale", "1", 0.0, 1.0, 0.0, 2.5, least=0.02),)
    mistaken_for: ClassVar[Names] = ("constant_headwind", "crosswind")
    separated_by: ClassVar[str] = "headings all around on one windy day"
    scale: Any

    def force(self, row: Row, car: Car) -> Real:
        return _extra_drag(row, car, self.scale * _wind_along(row))


class AirDensity(Effect):
    """Drag with the air density of temperature and altitude, where none is logged: s·(ρ/ρ₀ − 1)·½ρ₀C_dA·v²."""

    id: ClassVar[str] = "air_density"
    label: ClassVar[str] = "air density"
    stage: ClassVar[Stage] = "road"
    equation: ClassVar[str] = "s·(ρ/ρ₀ − 1)·½ρ₀·C_dA·v²"
    source: ClassVar[str] = "ISO 2533"
    needs: ClassVar[Names] = ("ambient_temp_c|altitude_m",)
    lacks: ClassVar[Names] = ("air_density_kgpm3",)
    instead: ClassVar[str] = "the declared drag uses the log's air density"
    entries: ClassVar[Names] = ROAD
    goes_with: ClassVar[GoesWith] = "air"
    parameters: ClassVar[Parameters] = (Size("scale", "1", 0.0, 1.0, 0.0, 3.0, least=0.05),)
    mistaken_for: ClassVar[Names] = ("rolling_temperature",)
    separated_by: ClassVar[str] = "hot and cold days at motorway speed"
    scale: Any

    def force(self, row: Row, car: Car) -> Real:
        return self.scale * (density_of_weather(row) / AIR_DENSITY_KGPM3 - 1.0) * car.drag(row) * row.square_speed_m2ps2


class Crosswind(Effect):
    """Drag area that grows with the yaw angle ψ of the air: k·ψ²·½ρC_dA·v²."""

    id: ClassVar[str] = "crosswind"
    label: ClassVar[str] = "crosswind"
    stage: ClassVar[Stage] = "road"
    equation: ClassVar[str] = "k·ψ²·½ρ·C_dA·v²"
    source: ClassVar[str] = "SAE J1252 (drag against yaw)"
    needs: ClassVar[Names] = ("wind_speed_mps", "wind_from_rad", "heading_rad")
    entries: ClassVar[Names] = ROAD
    goes_with: ClassVar[GoesWith] = "air"
    parameters: ClassVar[Parameters] = (
        Size("drag_per_rad2", "1/rad²", 0.0, 2.0, 0.0, 20.0, least=0.05, label="drag per yaw squared"),
    )
    mistaken_for: ClassVar[Names] = ("headwind",)
    separated_by: ClassVar[str] = "headings across and along the wind"
    drag_per_rad2: Any

    def force(self, row: Row, car: Car) -> Real:
        delta = row.channels["wind_from_rad"] - row.channels["heading_rad"]
        side = row.channels["wind_speed_mps"] * jnp.sin(delta)
        # the speed that the drag has; the breath of 1 µm/s keeps the angle and its slope finite in still air
        speed = jnp.sqrt(row.square_speed_m2ps2 + 1e-12)
        yaw = jnp.arctan2(jnp.abs(side), speed + row.channels["wind_speed_mps"] * jnp.cos(delta))
        return self.drag_per_rad2 * yaw**2 * car.drag(row) * row.square_speed_m2ps2


class Drafting(Effect):
    """Drag saved behind another vehicle: −r·½ρC_dA·v²·exp(−gap/30 m)."""

    id: ClassVar[str] = "drafting"
    label: ClassVar[str] = "drafting"
    stage: ClassVar[Stage] = "road"
    equation: ClassVar[str] = "−r·exp(−gap/30 m)·½ρ·C_dA·v²"
    source: ClassVar[str] = "Hucho, Aerodynamik des Automobils (platoons)"
    needs: ClassVar[Names] = ("gap_m",)
    entries: ClassVar[Names] = ROAD
    goes_with: ClassVar[GoesWith] = "air"
    parameters: ClassVar[Parameters] = (Size("reduction", "1", 0.0, 0.3, 0.0, 0.8, least=0.02),)
    mistaken_for: ClassVar[Names] = ("constant_headwind",)
    separated_by: ClassVar[str] = "stretches with and without a leader"
    reduction: Any

    def force(self, row: Row, car: Car) -> Real:
        near = jnp.exp(-jnp.maximum(row.channels["gap_m"], 0.0) / 30.0)
        return -self.reduction * near * car.drag(row) * row.square_speed_m2ps2


# --- mass and slope --------------------------------------------------------------------------------------------------


class RotatingMass(Effect):
    """Inertia of rotating parts, in addition to the declared one: f·m·a."""

    id: ClassVar[str] = "rotating_mass"
    label: ClassVar[str] = "rotating mass"
    stage: ClassVar[Stage] = "road"
    equation: ClassVar[str] = "f·m·a"
    source: ClassVar[str] = "paper 2, eq. 2 (λ)"
    entries: ClassVar[Names] = ROAD
    parameters: ClassVar[Parameters] = (Size("factor", "1", 0.0, 0.05, 0.0, 0.6, least=0.002),)
    mistaken_for: ClassVar[Names] = ("mass_scale",)
    separated_by: ClassVar[str] = "accelerating on the flat, and climbing at a steady speed"
    factor: Any

    def force(self, row: Row, car: Car) -> Real:
        return self.factor * car.mass(row) * row.accel_of_way_mps2


class RoadGrade(Effect):
    """Slope where the log has none, from an accelerometer, which feels gravity: s·m·(a_sensor − dv/dt)."""

    id: ClassVar[str] = "road_grade"
    label: ClassVar[str] = "road slope"
    stage: ClassVar[Stage] = "road"
    equation: ClassVar[str] = "s·m·(a_sensor − dv/dt)"
    source: ClassVar[str] = "paper 2, eq. 2, slope from the specific force"
    needs: ClassVar[Names] = ("accel_mps2",)
    lacks: ClassVar[Names] = ("grade_rad",)
    entries: ClassVar[Names] = ROAD
    parameters: ClassVar[Parameters] = (Size("scale", "1", 0.0, 1.0, 0.0, 2.0, least=0.02),)
    mistaken_for: ClassVar[Names] = ("mass_scale",)
    separated_by: ClassVar[str] = "hills"
    scale: Any

    def force(self, row: Row, car: Car) -> Real:
        return self.scale * car.mass(row) * (row.channels["accel_mps2"] - row.accel_mps2)
