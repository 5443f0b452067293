"""The kernel: effects at five stages, and the vehicle as their sum."""

from hdev_jax.physics.coefficients import coefficients_that_hold
from hdev_jax.physics.driveline import GEAR_PROBABILITY, Driveline, EfficiencyMap
from hdev_jax.physics.effect import Effect, Grouped, Parameter, Point
from hdev_jax.physics.library import LIBRARY, at_null, derived, library, most_group, unavailable
from hdev_jax.physics.machine import Machine
from hdev_jax.physics.vehicle import AIR_DENSITY_KGPM3, GRAVITY_MPS2, Vehicle

__all__ = [
    "AIR_DENSITY_KGPM3",
    "GEAR_PROBABILITY",
    "GRAVITY_MPS2",
    "LIBRARY",
    "Driveline",
    "Effect",
    "EfficiencyMap",
    "Grouped",
    "Machine",
    "Parameter",
    "Point",
    "Vehicle",
    "at_null",
    "coefficients_that_hold",
    "derived",
    "library",
    "most_group",
    "unavailable",
]
