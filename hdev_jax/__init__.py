"""Differentiable physics of electric heavy-duty vehicles: calibrate on a log, and find what the model misses."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hdev_jax.api import calibrate, check, diagnose, effects, predict, simulate
    from hdev_jax.logs import read_log
    from hdev_jax.physics.vehicle import Vehicle
    from hdev_jax.segments import Segments

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
    "calibrate": "hdev_jax.api",
    "check": "hdev_jax.api",
    "diagnose": "hdev_jax.api",
    "effects": "hdev_jax.api",
    "predict": "hdev_jax.api",
    "simulate": "hdev_jax.api",
}


def __getattr__(name: str) -> Any:
    # On first use, so that `import hdev_jax` and `hdev --help` load no array library.
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
