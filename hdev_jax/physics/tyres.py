"""Forces of tyres and the road's surface in addition to the declared rolling resistance."""

from collections.abc import Mapping
from typing import Any, ClassVar

import jax.numpy as jnp

from hdev_jax.physics.across import DISTANCE_SINCE_START, distance_since_start
from hdev_jax.physics.effect import Car, Effect, GoesWith, Names, Parameters, Real, Row, Stage
from hdev_jax.physics.parameter import Shape, Size
from hdev_jax.physics.road import ROAD, weight_on_road
from hdev_jax.segments import Segments

__all__ = ["Cornering", "RoadSurface", "RollingLinear", "RollingSpeed", "RollingTemperature", "TyreWarmup", "WetRoad"]

REFERENCE_TEMP_C = 20.0  # where a tabular c_rr is measured (ISO 28580: 25 °C in the laboratory; 20 °C on the road)


class RollingSpeed(Effect):
    """Rolling resistance that grows with speed: m·g·cosθ·k·v²."""

    id: ClassVar[str] = "rolling_speed"
    label: ClassVar[str] = "rolling resistance that grows with speed"
    stage: ClassVar[Stage] = "road"
    equation: ClassVar[str] = "m·g·cosθ·k·v²"
    source: ClassVar[str] = "ISO 28580; Mitschke and Wallentowitz, Dynamik der Kraftfahrzeuge"
    entries: ClassVar[Names] = ROAD
    goes_with: ClassVar[GoesWith] = "weight"
    parameters: ClassVar[Parameters] = (
        Size("per_mps2", "s²/m²", 0.0, 3e-6, 0.0, 3e-5, least=1e-7, label="per speed squared"),
    )
    mistaken_for: ClassVar[Names] = ("constant_headwind",)
    separated_by: ClassVar[str] = "a sweep of speed, loaded and empty"
    per_mps2: Any

    def force(self, row: Row, car: Car) -> Real:
        return self.per_mps2 * weight_on_road(row, car) * row.square_speed_m2ps2


class RollingLinear(Effect):
    """A force linear in speed, the B of a road load: b·v. A sheet declares it as `[road] b_n_per_mps`.

    Its cause is oil in hubs and gears. With a fixed gear ratio it is nearly the same as iron loss in ω²; over a narrow
    range of speeds it is nearly the same as a headwind.
    """

    id: ClassVar[str] = "rolling_linear"
    label: ClassVar[str] = "force linear in speed"
    stage: ClassVar[Stage] = "road"
    equation: ClassVar[str] = "b·v"
    source: ClassVar[str] = "SAE J1263; UN GTR 15, annex 4 (f₁ of a coast-down)"
    entries: ClassVar[Names] = ROAD
    # f₁ of cars is up to some 15 N·s/m, of a 40 t truck some ten times that
    parameters: ClassVar[Parameters] = (
        Size("n_per_mps", "N·s/m", 0.0, 10.0, 0.0, 200.0, least=0.2, label="force per speed"),
    )
    mistaken_for: ClassVar[Names] = ("iron_loss", "driveline_drag", "constant_headwind")
    separated_by: ClassVar[str] = "a coast-down from high speed in neutral and in gear"
    declared: ClassVar[Mapping[str, str]] = {"n_per_mps": "road.b_n_per_mps"}
    n_per_mps: Any

    def force(self, row: Row, car: Car) -> Real:
        return self.n_per_mps * row.speed_mps


class RollingTemperature(Effect):
    """Rolling resistance by temperature: m·g·cosθ·k·(T − 20 °C); k is negative, as cold tyres resist more."""

    id: ClassVar[str] = "rolling_temperature"
    label: ClassVar[str] = "rolling resistance by temperature"
    stage: ClassVar[Stage] = "road"
    equation: ClassVar[str] = "m·g·cosθ·k·(T − 20 °C)"
    source: ClassVar[str] = "ISO 28580, temperature correction"
    needs: ClassVar[Names] = ("ambient_temp_c",)
    entries: ClassVar[Names] = ROAD
    goes_with: ClassVar[GoesWith] = "weight"
    # −0.6 to −0.8 % of c_rr for each kelvin (ISO 28580, truck tyres); no tyre rolls worse when warm
    parameters: ClassVar[Parameters] = (Size("per_k", "1/K", 0.0, -5e-5, -6e-4, 0.0, least=1e-6, label="per kelvin"),)
    mistaken_for: ClassVar[Names] = ("air_density", "hvac_power")
    separated_by: ClassVar[str] = "hot and cold days at several speeds"
    per_k: Any

    def force(self, row: Row, car: Car) -> Real:
        return self.per_k * (row.channels["ambient_temp_c"] - REFERENCE_TEMP_C) * weight_on_road(row, car)


class TyreWarmup(Effect):
    """Cold tyres at the start: m·g·cosθ·C_rr·e·exp(−d/d₀), d the distance since the start of the trip."""

    id: ClassVar[str] = "tyre_warmup"
    label: ClassVar[str] = "tyre warm-up"
    stage: ClassVar[Stage] = "road"
    equation: ClassVar[str] = "m·g·cosθ·C_rr·e·exp(−d/d₀)"
    source: ClassVar[str] = "SAE J2452 (warm-up)"
    entries: ClassVar[Names] = ROAD
    goes_with: ClassVar[GoesWith] = "weight"
    parameters: ClassVar[Parameters] = (
        # a tyre at −20 °C rolls at about twice its warm resistance (SAE J2452)
        Size("excess", "1", 0.0, 0.3, 0.0, 2.0, least=0.01),
        Shape("distance_m", "m", 1e4, 5e3, 500.0, 6e4, grid=(2e3, 5e3, 1e4, 2e4)),
    )
    derives: ClassVar[Names] = (DISTANCE_SINCE_START,)
    mistaken_for: ClassVar[Names] = ("cabin_warmup",)
    separated_by: ClassVar[str] = "a restart after a short stop"
    excess: Any
    distance_m: Any

    def derive(self, segments: Segments) -> Segments:
        if segments.has(DISTANCE_SINCE_START):  # worked out before
            return segments
        return segments.with_channels(**{DISTANCE_SINCE_START: distance_since_start(segments)})

    def force(self, row: Row, car: Car) -> Real:
        cold = jnp.exp(-row.channels[DISTANCE_SINCE_START] / self.distance_m)
        return self.excess * cold * car.rolling() * weight_on_road(row, car)


class WetRoad(Effect):
    """Water on the road: m·g·cosθ·C_rr·e·wet, and spray, ½ρC_dA·s·wet·v²."""

    id: ClassVar[str] = "wet_road"
    label: ClassVar[str] = "wet road"
    stage: ClassVar[Stage] = "road"
    equation: ClassVar[str] = "wet·(m·g·cosθ·C_rr·e + s·½ρ·C_dA·v²)"
    source: ClassVar[str] = "Mitschke and Wallentowitz, Dynamik der Kraftfahrzeuge"
    needs: ClassVar[Names] = ("wet_road",)
    entries: ClassVar[Names] = ROAD
    goes_with: ClassVar[GoesWith] = "weight"
    parameters: ClassVar[Parameters] = (
        Size("excess", "1", 0.0, 0.2, 0.0, 4.0, least=0.01),
        Size("spray", "1", 0.0, 0.2, 0.0, 2.0, least=0.01),
    )
    variants: ClassVar[tuple[Names, ...]] = (("excess",), ("spray",), ("excess", "spray"))
    mistaken_for: ClassVar[Names] = ("rolling_temperature",)
    separated_by: ClassVar[str] = "the same road dry and wet, slow and fast"
    excess: Any
    spray: Any

    def force(self, row: Row, car: Car) -> Real:
        rolling, spray = self.split(row, car)
        return rolling + spray

    def split(self, row: Row, car: Car) -> tuple[Real, Real]:
        # Spray is a share of the drag area at the square of the speed, whatever the vehicle weighs: the source has the
        # resistance of displaced water go with the tyres' width and the speed, not with their load.
        wet = row.channels["wet_road"]
        rolling = wet * self.excess * car.rolling() * weight_on_road(row, car)
        return rolling, wet * self.spray * car.drag(row) * row.square_speed_m2ps2


class RoadSurface(Effect):
    """Rolling resistance by kind or place of the road: m·g·cosθ·C_rr·e[surface], relative to the commonest surface."""

    id: ClassVar[str] = "road_surface"
    label: ClassVar[str] = "road surface by place"
    stage: ClassVar[Stage] = "road"
    equation: ClassVar[str] = "m·g·cosθ·C_rr·e[surface]"
    source: ClassVar[str] = "Sandberg, Rolling resistance: basic information and state of the art, MIRIAM (2011)"
    needs: ClassVar[Names] = ("road_surface",)  # whole numbers from 0: kinds of surface, or stretches of road
    entries: ClassVar[Names] = ROAD
    goes_with: ClassVar[GoesWith] = "weight"
    parameters: ClassVar[Parameters] = (Size("excess", "1", 0.0, 0.2, -0.6, 3.0, least=0.01, by="road_surface"),)
    mistaken_for: ClassVar[Names] = ("grade_bias", "wet_road")
    separated_by: ClassVar[str] = "the same surfaces up and down, and at several loads"
    excess: Any

    def force(self, row: Row, car: Car) -> Real:
        return self.excess * car.rolling() * weight_on_road(row, car)


class Cornering(Effect):
    """Cornering resistance: c·m·v⁴·κ² (slip angles that turn lateral force into drag)."""

    id: ClassVar[str] = "cornering"
    label: ClassVar[str] = "cornering resistance"
    stage: ClassVar[Stage] = "road"
    equation: ClassVar[str] = "c·m·v⁴·κ²"
    source: ClassVar[str] = "Mitschke and Wallentowitz, Dynamik der Kraftfahrzeuge (curve resistance)"
    needs: ClassVar[Names] = ("curvature_1pm",)
    entries: ClassVar[Names] = ROAD
    goes_with: ClassVar[GoesWith] = "weight"
    # the mass over the cornering stiffness of all tyres: 0.01 to 0.03 s²/m; more where axles scrub
    parameters: ClassVar[Parameters] = (Size("coefficient", "s²/m", 0.0, 0.02, 0.0, 0.3, least=1e-4),)
    mistaken_for: ClassVar[Names] = ("rolling_speed",)
    separated_by: ClassVar[str] = "heading rate: straight and winding roads at one speed"
    coefficient: Any

    def force(self, row: Row, car: Car) -> Real:
        lateral = row.square_speed_m2ps2 * row.channels["curvature_1pm"]
        return self.coefficient * car.mass(row) * lateral**2
