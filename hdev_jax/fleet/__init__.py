"""Synthetic fleets with known truth, in plain NumPy; nothing here is shared with `hdev_jax.physics`."""

from hdev_jax.fleet.driving import Drive
from hdev_jax.fleet.log import ENTRIES, NOISES, SyntheticLog, demo_log, size_effect, synthetic_log
from hdev_jax.fleet.truth import PLANTABLE, Plant, Truth, plantable, power_w

__all__ = [
    "ENTRIES",
    "NOISES",
    "PLANTABLE",
    "Drive",
    "Plant",
    "SyntheticLog",
    "Truth",
    "demo_log",
    "plantable",
    "power_w",
    "size_effect",
    "synthetic_log",
]
