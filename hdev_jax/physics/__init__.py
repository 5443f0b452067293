"""The kernel: effects at five stages, and the vehicle as their sum."""

from hdev_jax.physics.coefficients import coefficients_that_hold
from hdev_jax.physics.driveline import GEAR_PROBABILITY, Driveline, EfficiencyMap
from hdev_jax.physics.effect import Effect, Grouped, Parameter, Point
from hdev_jax.physics.library import LIBRARY, at_null, derived, library, most_group, unavailable
from hdev_jax.physics.machine import Machine
from hdev_jax.physics.vehicle import Vehicle

__all__ = [
    "GEAR_PROBABILITY",
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
