"""A log, a sheet and a target brought together: what the verbs that fit or predict begin with."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from hdev_jax.diagnosis.candidates.facts import GROUPS
from hdev_jax.inference import Fit, ParameterTable, padded, predict
from hdev_jax.inference.sheet import BATTERY_TARGETS, Sheet, build, choose_entry, traction_force_from_torque
from hdev_jax.logs import Log
from hdev_jax.physics import Vehicle
from hdev_jax.physics.vehicle import Target
from hdev_jax.problem.metrics import PER_KWH, sum_weight
from hdev_jax.segments import Segments

__all__ = ["UNITS", "Problem", "prepare"]

# The target itself and what follows from it: as an input it would tell the target, of the battery with its noise, for
# the current is the measured power over the voltage.
_FOLLOWS = {
    "energy_wh": ("current_a",),
    "battery_power_kw": ("current_a",),
    "motor_torque_nm": ("motor_torque_nm", "current_a"),
    "traction_force_n": ("traction_force_n", "motor_torque_nm", "current_a"),
}
UNITS = {"energy_wh": "Wh", "battery_power_kw": "kW", "motor_torque_nm": "Nm", "traction_force_n": "N"}
PLAUSIBLE_KWH_PER_KM = (0.002, 50.0)  # a bicycle with a motor has 0.005; the largest mining trucks, uphill, some 30
LEAST_KM = 1.0  # standing still a vehicle may take any


@dataclass(frozen=True)
class Problem:
    """A log, a sheet and a target brought together."""

    log: Log
    sheet: Sheet
    target: Target
    segments: Segments  # without what the target would leak
    measured: np.ndarray
    vehicle: Vehicle
    table: ParameterTable
    notes: tuple[str, ...]

    @property
    def unit(self) -> str:
        """Unit of the target."""
        return UNITS[self.target]

    def rows(self, trips: Sequence[int]) -> np.ndarray:
        """Mask of these trips' rows, by their places among the log's names."""
        return np.isin(self.log.trip, trips)

    def weight(self) -> np.ndarray:
        """What each row weighs in a sum."""
        return sum_weight(self.target, np.asarray(self.segments.duration_s), np.asarray(self.segments.distance_m))

    @cached_property
    def _padded(self) -> Fit:
        return padded(self.segments, self.measured)

    def predict(self, vehicle: Vehicle, segments: Segments | None = None) -> np.ndarray:
        """The target's column by this vehicle on every row of the log, or of `segments` in its place."""
        rows = self._padded if segments is None else padded(segments, self.measured)
        return np.asarray(predict(vehicle, rows.segments, self.target))[: rows.rows]


def prepare(log: Log, sheet: Sheet, target: str | None = None, *, need_measured: bool = True) -> Problem:
    """The vehicle of a sheet for this log and target, with the chain entered where the log measures it.

    Raises `InputError` where the log does not measure the target, or the sheet lacks what is in use.
    """
    derived = target == "traction_force_n" and target not in log.targets and log.segments.has("motor_torque_nm")
    name: Any = target or log.default_target
    if derived:
        measured = np.asarray(traction_force_from_torque(log.segments, sheet))
    else:
        measured = log.target(name) if need_measured else np.zeros(len(log))
    segments = log.segments.without(*_FOLLOWS[name])
    built = build(sheet, segments, choose_entry(segments, name), name, vehicle_names=log.vehicle_names)
    notes = list(built.notes)
    if derived:
        notes.append("traction_force_n is not logged: it is motor torque · ratio / wheel radius · η^sign(torque)")
    if log.segments.has("current_a"):
        notes.append(f"current_a is left aside: it follows from {name} and explains nothing of it")
    for group in (g for g in GROUPS if segments.has(g)):
        if below := int(np.sum(np.asarray(segments.channels[group]) <= -1)):
            notes.append(f"{group} is below 0 in {below} rows: a coefficient by {group} takes them for 0")
    if need_measured and (odd := _consumption(log, name, measured)):
        notes.append(odd)
    if not segments.has("grade_rad") and built.vehicle.entry == "road":
        notes.append("the log has no slope: the declared model takes the road as flat")
    return Problem(log, sheet, name, segments, measured, built.vehicle, built.table, tuple(notes))


def _consumption(log: Log, target: str, measured: np.ndarray) -> str | None:
    """A remark on a consumption that no road vehicle has; None where it may be one."""
    if target not in BATTERY_TARGETS:
        return None
    meters, seconds = np.asarray(log.segments.distance_m), np.asarray(log.segments.duration_s)
    km, weight = float(np.sum(meters)) / 1e3, sum_weight(target, seconds, meters)
    kwh = float(np.sum(np.abs(measured) * weight)) / PER_KWH[target]
    least, most = PLAUSIBLE_KWH_PER_KM
    if km < LEAST_KM or least * km <= kwh <= most * km:
        return None
    mine = ("energy_wh", "battery_power_w") if target == "energy_wh" else ("battery_power_w", "energy_wh")
    column = next(c for c in mine if c in log.measured)
    source = next((c.source for c in log.columns if c.name == column), column)
    return (
        f"{kwh / km:.3g} kWh/km go in and out of the battery, which no road vehicle has ({least:g} to {most:g}): check "
        f"the unit of column {source}"
    )
