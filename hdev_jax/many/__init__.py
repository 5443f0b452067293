"""Many measured vehicles: each is diagnosed by itself, then all are compared and pooled."""

from hdev_jax.many.beside import looking_again
from hdev_jax.many.result import FleetResult, fleet_result
from hdev_jax.many.sources import Source, sources
from hdev_jax.many.vehicle import vehicle_record
from hdev_jax.many.workers import Workers, computed

__all__ = ["FleetResult", "Source", "Workers", "computed", "fleet_result", "looking_again", "sources", "vehicle_record"]
