"""Is it plausible before it is physical: units, signs, charging, suspected by name with the key that mends them."""

from hdev_jax.logs.checks.plausible import COASTING, constant_target, suspicions
from hdev_jax.logs.checks.suspicion import Suspicion, alternatives, mended

__all__ = ["COASTING", "Suspicion", "alternatives", "constant_target", "mended", "suspicions"]
