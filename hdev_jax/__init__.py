"""Differentiable physics of electric heavy-duty vehicles: calibrate on a log, and find what the model misses."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hdev_jax.inference.sheet import Sheet, read_sheet
    from hdev_jax.logs import Log, read_log
    from hdev_jax.physics.vehicle import Vehicle
    from hdev_jax.segments import Segments
    from hdev_jax.verbs.calibrate import calibrate
    from hdev_jax.verbs.check import check
    from hdev_jax.verbs.diagnose import diagnose
    from hdev_jax.verbs.effects import effects
    from hdev_jax.verbs.energy.compare import compare
    from hdev_jax.verbs.energy.ledger import ledger
    from hdev_jax.verbs.energy.result import EnergyResult
    from hdev_jax.verbs.energy.roadload import roadload
    from hdev_jax.verbs.energy.saved import saved
    from hdev_jax.verbs.energy.whatif import whatif
    from hdev_jax.verbs.init import init
    from hdev_jax.verbs.live.follow import follow
    from hdev_jax.verbs.live.serve import serve
    from hdev_jax.verbs.predict import predict
    from hdev_jax.verbs.programs.export import export
    from hdev_jax.verbs.result import CalibrationResult, Diagnosis, Prediction
    from hdev_jax.verbs.simulate import simulate

__version__ = "0.1.0"

__all__ = [
    "CalibrationResult",
    "Diagnosis",
    "EnergyResult",
    "Log",
    "Prediction",
    "Segments",
    "Sheet",
    "Vehicle",
    "__version__",
    "calibrate",
    "check",
    "compare",
    "diagnose",
    "effects",
    "export",
    "follow",
    "init",
    "ledger",
    "predict",
    "read_log",
    "read_sheet",
    "roadload",
    "saved",
    "serve",
    "simulate",
    "whatif",
]

_HOME = {
    "CalibrationResult": "hdev_jax.verbs.result",
    "Diagnosis": "hdev_jax.verbs.result",
    "EnergyResult": "hdev_jax.verbs.energy.result",
    "Log": "hdev_jax.logs",
    "Prediction": "hdev_jax.verbs.result",
    "Sheet": "hdev_jax.inference.sheet",
    "read_sheet": "hdev_jax.inference.sheet",
    "Segments": "hdev_jax.segments",
    "Vehicle": "hdev_jax.physics.vehicle",
    "read_log": "hdev_jax.logs",
    "calibrate": "hdev_jax.verbs.calibrate",
    "check": "hdev_jax.verbs.check",
    "diagnose": "hdev_jax.verbs.diagnose",
    "effects": "hdev_jax.verbs.effects",
    "export": "hdev_jax.verbs.programs.export",
    "follow": "hdev_jax.verbs.live.follow",
    "serve": "hdev_jax.verbs.live.serve",
    "init": "hdev_jax.verbs.init",
    "compare": "hdev_jax.verbs.energy.compare",
    "saved": "hdev_jax.verbs.energy.saved",
    "whatif": "hdev_jax.verbs.energy.whatif",
    "roadload": "hdev_jax.verbs.energy.roadload",
    "ledger": "hdev_jax.verbs.energy.ledger",
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
