"""Is it plausible before it is physical: units, signs, charging, suspected by name with the key that mends them."""

from hdev_jax.logs.checks.plausible import suspicions
from hdev_jax.logs.checks.suspicion import Suspicion, alternatives, mended

__all__ = ["Suspicion", "alternatives", "mended", "suspicions"]
