"""The declared car of paper 2 and what `hdev diagnose` adds to it from the training trip, as a model of the tables."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

import hdev_jax
from experiments.runner.config import CONFIGS
from experiments.runner.data import fingerprint
from hdev_jax.diagnosis.diagnose import diagnose
from hdev_jax.inference import padded, predict
from hdev_jax.inference.sheet import read_sheet
from hdev_jax.learn import Trip
from hdev_jax.logs import Log
from hdev_jax.physics import LIBRARY, Vehicle
from hdev_jax.problem import Split, prepare

__all__ = ["Diagnosed", "diagnosis_key"]

SHEET = CONFIGS / "vehicles" / "kia_niro.toml"
TARGET = "battery_power_kw"
LOOP = ("diagnosis", "problem", "inference", "physics")  # what a diagnosis is made of


def diagnosis_key(settings: Mapping[str, Any]) -> dict[str, str]:
    """What a task has among its values besides: the fingerprint of the sheet and of the loop, where it diagnoses."""
    return {"diagnosis": _fingerprint()} if settings["kind"] == "diagnosed" else {}


@cache
def _fingerprint() -> str:
    package = Path(hdev_jax.__file__).parent
    sources = sorted(p for part in LOOP for p in (package / part).rglob("*.py"))
    return fingerprint([SHEET, Path(__file__), *sources])


@dataclass(frozen=True)
class Diagnosed:
    """The vehicle after the loop. It has no feedback: one step ahead and free run are one prediction."""

    vehicle: Vehicle
    effects: tuple[str, ...]
    parameters: int

    @staticmethod
    def of(trip: Trip, seed: int) -> "Diagnosed":
        """Everything is found and fitted on `trip`; it stands in for the test trips too, which nothing here reads."""
        segments = replace(trip.segments, trip=np.zeros(len(trip), np.int32), vehicle=np.zeros(len(trip), np.int32))
        power = {"battery_power_w": 1000.0 * np.asarray(trip.target, float)}
        log = Log(segments, power, (trip.name,), ("car",), files=(f"trip {trip.name}",))
        result = diagnose(prepare(log, read_sheet(SHEET), TARGET), Split(log, (0,), (0,), ()), LIBRARY, seed=seed)
        effects = tuple(e["id"] for e in result.summary["effects"])
        return Diagnosed(result.after, effects, result.summary["parameters_fitted"])

    @property
    def settings(self) -> dict[str, Any]:
        """What was found, for the run's own record."""
        return {"effects": list(self.effects)}

    def predict(self, trip: Trip) -> np.ndarray:
        """Battery power of every row [kW]."""
        rows = padded(trip.segments, np.asarray(trip.target, float))
        return np.asarray(predict(self.vehicle, rows.segments, TARGET))[: rows.rows]

    def simulate(self, trip: Trip) -> np.ndarray:
        """As `predict`."""
        return self.predict(trip)

    def measured(self, trip: Trip) -> np.ndarray:
        """Every row [kW]."""
        return np.asarray(trip.target)
