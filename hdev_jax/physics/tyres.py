"""What tyres and the road's surface cost beside the declared rolling resistance."""

from typing import Any, ClassVar

import jax.numpy as jnp

from hdev_jax.physics.across import DISTANCE_SINCE_START, distance_since_start
from hdev_jax.physics.effect import Effect, Parameter
from hdev_jax.physics.road import ROAD, mean_square_speed, weight_on_road

__all__ = ["Cornering", "RoadSurface", "RollingSpeed", "RollingTemperature", "TyreWarmup", "WetRoad"]

REFERENCE_TEMP_C = 20.0  # where a tabular c_rr is measured (ISO 28580: 25 °C in the laboratory; 20 °C on the road)


class RollingSpeed(Effect):
    """Rolling resistance that grows with speed: m·g·cosθ·k·v²."""

    id: ClassVar = "rolling_speed"
    stage: ClassVar = "road"
    equation: ClassVar = "m·g·cosθ·k·v²"
    source: ClassVar = "ISO 28580; Mitschke and Wallentowitz, Dynamik der Kraftfahrzeuge"
    entries: ClassVar = ROAD
    parameters: ClassVar = (Parameter("per_mps2", "s²/m²", 0.0, 3e-6, 0.0, 3e-5, least=1e-7),)
    mistaken_for: ClassVar = ("constant_headwind",)
    separated_by: ClassVar = "a sweep of speed, loaded and empty"
    per_mps2: Any

    def force(self, row, car):
        return self.per_mps2 * weight_on_road(row, car) * mean_square_speed(row)


class RollingTemperature(Effect):
    """Rolling resistance by temperature: m·g·cosθ·k·(T − 20 °C); k is negative, cold tyres roll worse."""

    id: ClassVar = "rolling_temperature"
    stage: ClassVar = "road"
    equation: ClassVar = "m·g·cosθ·k·(T − 20 °C)"
    source: ClassVar = "ISO 28580, temperature correction"
    needs: ClassVar = ("ambient_temp_c",)
    entries: ClassVar = ROAD
    parameters: ClassVar = (Parameter("per_k", "1/K", 0.0, -5e-5, -6e-4, 6e-4, least=1e-6),)
    mistaken_for: ClassVar = ("air_density", "hvac_power")
    separated_by: ClassVar = "hot and cold days at several speeds"
    per_k: Any

    def force(self, row, car):
        return self.per_k * (row.channels["ambient_temp_c"] - REFERENCE_TEMP_C) * weight_on_road(row, car)


class TyreWarmup(Effect):
    """Cold tyres at the start: m·g·cosθ·C_rr·e·exp(−d/d₀), d the distance since the start of the trip."""

    id: ClassVar = "tyre_warmup"
    stage: ClassVar = "road"
    equation: ClassVar = "m·g·cosθ·C_rr·e·exp(−d/d₀)"
    source: ClassVar = "SAE J2452 (warm-up)"
    entries: ClassVar = ROAD
    parameters: ClassVar = (
        Parameter("excess", "1", 0.0, 0.3, 0.0, 3.0, least=0.01),
        Parameter("distance_m", "m", 1e4, 5e3, 500.0, 6e4, kind="shape", grid=(2e3, 5e3, 1e4, 2e4)),
    )
    mistaken_for: ClassVar = ("cabin_warmup",)
    separated_by: ClassVar = "a restart after a short stop"
    excess: Any
    distance_m: Any

    def derive(self, segments):
        if segments.has(DISTANCE_SINCE_START):  # worked out before
            return segments
        return segments.with_channels(**{DISTANCE_SINCE_START: distance_since_start(segments)})

    def force(self, row, car):
        cold = jnp.exp(-row.channels[DISTANCE_SINCE_START] / self.distance_m)
        return self.excess * cold * car.rolling() * weight_on_road(row, car)


class WetRoad(Effect):
    """Water on the road: m·g·cosθ·C_rr·e·wet, and spray, ½ρ₀C_dA·s·wet·v²."""

    id: ClassVar = "wet_road"
    stage: ClassVar = "road"
    equation: ClassVar = "wet·(m·g·cosθ·C_rr·e + s·½ρ₀·C_dA·v²)"
    source: ClassVar = "Mitschke and Wallentowitz, Dynamik der Kraftfahrzeuge"
    needs: ClassVar = ("wet_road",)
    entries: ClassVar = ROAD
    parameters: ClassVar = (
        Parameter("excess", "1", 0.0, 0.2, 0.0, 4.0, least=0.01),
        Parameter("spray", "1", 0.0, 0.2, 0.0, 2.0, least=0.01),
    )
    variants: ClassVar = (("excess",), ("spray",), ("excess", "spray"))
    mistaken_for: ClassVar = ("rolling_temperature",)
    separated_by: ClassVar = "the same road dry and wet, slow and fast"
    excess: Any
    spray: Any

    def force(self, row, car):
        return self.rolling(row, car) + self.spraying(row, car)

    def rolling(self, row, car):
        """The part that goes with the weight [N]."""
        return row.channels["wet_road"] * self.excess * car.rolling() * weight_on_road(row, car)

    def spraying(self, row, car):
        """The part that goes with the drag area [N]."""
        return row.channels["wet_road"] * self.spray * car.drag() * mean_square_speed(row)


class RoadSurface(Effect):
    """Rolling resistance by kind or place of the road: m·g·cosθ·C_rr·e[surface], against the commonest of the log."""

    id: ClassVar = "road_surface"
    stage: ClassVar = "road"
    equation: ClassVar = "m·g·cosθ·C_rr·e[surface]"
    source: ClassVar = "Sandberg, Rolling resistance: basic information and state of the art, MIRIAM (2011)"
    needs: ClassVar = ("road_surface",)  # whole numbers from 0: kinds of surface, or stretches of road
    entries: ClassVar = ROAD
    parameters: ClassVar = (Parameter("excess", "1", 0.0, 0.2, -0.6, 3.0, least=0.01, by="road_surface"),)
    mistaken_for: ClassVar = ("grade_bias", "wet_road")
    separated_by: ClassVar = "the same surfaces up and down, and at several loads"
    excess: Any

    def force(self, row, car):
        return self.excess * car.rolling() * weight_on_road(row, car)


class Cornering(Effect):
    """Cornering resistance: c·m·v⁴·κ² (slip angles that turn lateral force into drag)."""

    id: ClassVar = "cornering"
    stage: ClassVar = "road"
    equation: ClassVar = "c·m·v⁴·κ²"
    source: ClassVar = "Mitschke and Wallentowitz, Dynamik der Kraftfahrzeuge (curve resistance)"
    needs: ClassVar = ("curvature_1pm",)
    entries: ClassVar = ROAD
    parameters: ClassVar = (Parameter("coefficient", "s²/m", 0.0, 0.02, 0.0, 1.0, least=1e-4),)
    mistaken_for: ClassVar = ("rolling_speed",)
    separated_by: ClassVar = "heading rate: straight and winding roads at one speed"
    coefficient: Any

    def force(self, row, car):
        lateral = mean_square_speed(row) * row.channels["curvature_1pm"]
        return self.coefficient * car.mass(row) * lateral**2
