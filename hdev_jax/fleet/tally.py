"""What is kept of a vehicle's rows for the report: sums, histograms, one route to draw; no more for more rows."""

from typing import Any

import numpy as np

from hdev_jax.fleet.driver import STEP_M
from hdev_jax.fleet.roads import STEPS
from hdev_jax.fleet.simulator import Batch
from hdev_jax.fleet.variants import Variant

__all__ = ["ACCEL_EDGES", "GRADE_EDGES", "Tally"]

GRADE_EDGES = np.linspace(-10.0, 10.0, 21)  # %
ACCEL_EDGES = np.linspace(-2.0, 2.0, 17)  # m/s²
_POINTS = 1500  # rows kept to draw
_TRIPS = 2000  # consumption by trip kept to draw


class Tally:
    """Running sums of one vehicle. `add` a batch at a time."""

    def __init__(self, variant: Variant, effects: dict[str, dict[str, Any]]):
        self.variant: Variant = variant
        self.effects: dict[str, dict[str, Any]] = effects
        self.rows: int = 0
        self.trips: int = 0
        self.halts: int = 0
        self.sums: dict[str, float] = {}
        self.parts: dict[str, float] = {}
        self.gears: np.ndarray = np.zeros(variant.gears, int)
        self.grade: np.ndarray = np.zeros(len(GRADE_EDGES) - 1)
        self.accel: np.ndarray = np.zeros(len(ACCEL_EDGES) - 1)
        self.kwh_per_km: np.ndarray = np.zeros(0)
        self.points: dict[str, np.ndarray] = {}
        self.route: dict[str, np.ndarray] = {}

    def state(self) -> dict[str, Any]:
        """Everything that was counted, plain values and arrays: what `of` makes the same tally from."""
        return {k: v for k, v in vars(self).items() if k not in ("variant", "effects")}

    @staticmethod
    def of(variant: Variant, effects: dict[str, dict[str, Any]], state: dict[str, Any]) -> "Tally":
        """A tally as it was when its `state` was taken."""
        tally = Tally(variant, effects)
        vars(tally).update(state)
        return tally

    def _plus(self, name: str, value: Any) -> None:
        self.sums[name] = self.sums.get(name, 0.0) + float(value)

    def add(self, batch: Batch) -> None:
        """Count a batch in."""
        log, truth = batch.log, batch.truth
        y, trip = log["energy_wh"], log["trip"]
        self.rows += len(y)
        self.trips += len(np.unique(trip))
        self.halts += int(np.sum(log["distance_m"] == 0))
        self._plus("km", log["distance_m"].sum() / 1e3)
        self._plus("hours", log["duration_s"].sum() / 3600)
        self._plus("energy_wh", y.sum())
        for name in ("tabular_wh", "tabular_wheel_wh"):
            self._plus(name, truth[name].sum())
            self._plus(f"{name}_squares", np.sum((truth[name] - y) ** 2))
        self._plus("noise_squares", np.sum((truth["energy_true_wh"] - y) ** 2))
        for k, x in truth.items():
            if k.startswith("energy_wh:"):
                name = k.removeprefix("energy_wh:")
                self.parts[name] = self.parts.get(name, 0.0) + float(x.sum())
        gear = truth["gear"]
        self.gears += np.bincount(gear, minlength=self.variant.gears + 1)[1:]
        self._plus("ambiguous", np.sum(truth["gear_lowest"] != truth["gear_highest"]))
        moving = log["distance_m"] > 0
        self._plus("same_gear", np.sum((gear == truth["gear_middle"])[moving]))
        self._plus("shifts", truth["shifts"].sum())
        self._histograms(batch)
        self._trips(trip, y, log["distance_m"])
        if not self.points:
            some = np.flatnonzero(moving)[:: max(1, int(moving.sum()) // _POINTS)][:_POINTS]
            names = ("gear", "load_share", "efficiency", "motor_speed_radps", "motor_torque_nm", "requested_torque_nm")
            self.points = {k: truth[k][some] for k in names}
            self.points["speed_mps"] = (log["distance_m"] / log["duration_s"])[some]
            self.route = _route(batch)

    def _histograms(self, batch: Batch) -> None:
        """Slope by distance and acceleration by time in motion, of the drive by step; of a part of the routes."""
        few = slice(0, 48)
        speed = np.asarray(batch.fine.speed_mps)[:, few]
        seconds = np.asarray(batch.fine.step_s)[:, few]
        used = np.arange(len(seconds))[:, None] < (batch.routes.length[few] * STEPS)[None, :]
        accel = np.diff(speed**2, axis=0) / (2 * STEP_M)
        grade = 100 * np.tan(batch.routes.grade_step[few].T)
        self.accel += np.histogram(np.clip(accel[used], -1.999, 1.999), ACCEL_EDGES, weights=seconds[used])[0]
        self.grade += np.histogram(np.clip(grade[used], -9.999, 9.999), GRADE_EDGES)[0] * STEP_M

    def _trips(self, trip: np.ndarray, y: np.ndarray, distance: np.ndarray) -> None:
        if len(self.kwh_per_km) >= _TRIPS:
            return
        local = trip - trip.min()
        km = np.bincount(local, distance) / 1e3
        self.kwh_per_km = np.r_[self.kwh_per_km, (np.bincount(local, y) / 1e3)[km > 1] / km[km > 1]]

    # --- what they come to -------------------------------------------------------------------------------------------

    @property
    def kwh_km(self) -> float:
        """Consumption of all trips [kWh/km]."""
        return self.sums["energy_wh"] / 1e3 / self.sums["km"]

    def error_percent(self, name: str = "tabular_wh") -> float:
        """100·(Σ predicted − Σ measured)/Σ measured."""
        return 100 * (self.sums[name] / self.sums["energy_wh"] - 1)

    def rmse(self, name: str = "tabular_wh") -> float:
        """By row [Wh]."""
        return float(np.sqrt(self.sums[f"{name}_squares"] / self.rows))


def _route(batch: Batch) -> dict[str, np.ndarray]:
    """The first route by step: place, speed, cap, altitude."""
    n = int(batch.routes.length[0]) * STEPS
    climb = np.cumsum(np.sin(batch.routes.grade_step[0, :n]) * STEP_M)
    return {
        "km": np.arange(n + 1) * STEP_M / 1e3,
        "speed_mps": np.asarray(batch.fine.speed_mps)[: n + 1, 0],
        "limit_mps": np.r_[np.repeat(batch.routes.limit_mps[0], STEPS)[:n], 0.0],
        "gear": np.r_[np.asarray(batch.fine.gear)[:n, 0], 1],
        "altitude_m": batch.routes.altitude_m[0, 0] + np.r_[0.0, climb],
        "stop_km": np.flatnonzero(batch.routes.halt_s[0]) * 0.1,
    }
