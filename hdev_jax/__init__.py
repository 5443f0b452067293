"""Differentiable physics of electric heavy-duty vehicles: calibrate on a log, and find what the model misses."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hdev_jax.logs import read_log
    from hdev_jax.physics.vehicle import Vehicle
    from hdev_jax.segments import Segments
    from hdev_jax.verbs.calibrate import calibrate
    from hdev_jax.verbs.check import check
    from hdev_jax.verbs.diagnose import diagnose
    from hdev_jax.verbs.effects import effects
    from hdev_jax.verbs.predict import predict
    from hdev_jax.verbs.simulate import simulate

__version__ = "0.1.0"

__all__ = [
    "Segments",
    "Vehicle",
    "__version__",
    "calibrate",
    "check",
    "diagnose",
    "effects",
    "predict",
    "read_log",
    "simulate",
]

_HOME = {
    "Segments": "hdev_jax.segments",
    "Vehicle": "hdev_jax.physics.vehicle",
    "read_log": "hdev_jax.logs",
    "calibrate": "hdev_jax.verbs.calibrate",
    "check": "hdev_jax.verbs.check",
    "diagnose": "hdev_jax.verbs.diagnose",
    "effects": "hdev_jax.verbs.effects",
    "predict": "hdev_jax.verbs.predict",
    "simulate": "hdev_jax.verbs.simulate",
}


def __getattr__(name: str) -> Any:
    # On first use, so that `import hdev_jax` and `hdev --help` load no array library.
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
