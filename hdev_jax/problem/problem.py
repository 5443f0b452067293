"""A log, a sheet and a target brought together: where the verbs that fit or predict start."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from hdev_jax.inference import Fit, ParameterTable, padded
from hdev_jax.inference import predict as predict_rows
from hdev_jax.inference.sheet import Sheet, build, choose_entry, traction_force_from_torque
from hdev_jax.logs import Log
from hdev_jax.physics import GROUPS, Vehicle
from hdev_jax.problem.metrics import sum_weight
from hdev_jax.segments import Segments
from hdev_jax.targets import TARGETS, TargetName

__all__ = ["Problem", "derivable", "prepare"]

PLAUSIBLE_KWH_PER_KM = (0.002, 50.0)  # a bicycle with a motor has 0.005; the largest mining trucks, uphill, some 30
LEAST_KM = 1.0  # standing still a vehicle may take any


@dataclass(frozen=True)
class Problem:
    """A log, a sheet and a target brought together."""

    log: Log
    sheet: Sheet
    target: TargetName
    segments: Segments  # without what the target would leak
    measured: np.ndarray
    vehicle: Vehicle
    table: ParameterTable
    notes: tuple[str, ...]

    @property
    def unit(self) -> str:
        """Unit of the target."""
        return TARGETS[self.target].unit

    def rows(self, trips: Sequence[int]) -> np.ndarray:
        """Mask of these trips' rows, by their places among the log's names."""
        return np.isin(self.log.trip, trips)

    def weight(self) -> np.ndarray:
        """What each row weighs in a sum."""
        return sum_weight(self.target, np.asarray(self.segments.duration_s), np.asarray(self.segments.distance_m))

    @cached_property
    def _padded(self) -> Fit:
        return padded(self.segments, self.measured)

    def predict(
        self, vehicle: Vehicle, segments: Segments | None = None, *, compute: Callable[..., Any] = predict_rows
    ) -> np.ndarray:
        """The target's column by this vehicle on every row of the log, or of `segments` in its place.

        `compute` takes and gives what `hdev_jax.inference.predict` does.
        """
        rows = self._padded if segments is None else padded(segments, self.measured)
        return np.asarray(compute(vehicle, rows.segments, self.target))[: rows.rows]


def prepare(log: Log, sheet: Sheet, target: str | None = None, *, need_measured: bool = True) -> Problem:
    """The vehicle of a sheet for this log and target, with the chain entered where the log measures it.

    Raises `InputError` where the log does not measure the target, or the sheet lacks what is in use.
    """
    name: Any = target or log.default_target
    derived = derivable(log, name)
    if derived:
        measured = np.asarray(traction_force_from_torque(log.segments, sheet))
    else:
        measured = log.target(name) if need_measured else np.zeros(len(log))
    segments = log.segments.without(*(TARGETS[name].follows if name in TARGETS else ()))
    built = build(sheet, segments, choose_entry(segments, name, sheet), name, vehicle_names=log.vehicle_names)
    notes = list(built.notes)
    if derived:
        notes.append(f"{name} is not logged: it is motor torque · ratio / wheel radius · η^sign(torque)")
    if log.segments.has("current_a"):
        notes.append(f"current_a is not used: it follows from {name} and cannot explain it")
    for group in (g for g in GROUPS if segments.has(g)):
        if below := int(np.sum(np.asarray(segments.channels[group]) <= -1)):
            notes.append(f"{group} is below 0 in {below} rows: a coefficient by {group} takes them as 0")
    if need_measured and (odd := _consumption(log, name, measured)):
        notes.append(odd)
    if not segments.has("grade_rad") and built.vehicle.entry == "road":
        notes.append("the log has no slope: the declared model assumes a flat road")
    return Problem(log, sheet, name, segments, measured, built.vehicle, built.table, tuple(notes))


def derivable(log: Log, target: str) -> bool:
    """Whether a target that is not logged can be worked out from what is, with the sheet's ratios."""
    source = TARGETS[target].derived_from if target in TARGETS else ""
    return bool(source) and target not in log.targets and log.segments.has(source)


def _consumption(log: Log, target: str, measured: np.ndarray) -> str | None:
    """A note on a consumption outside the range of road vehicles; None inside it."""
    record = TARGETS[target]
    if not record.of_battery or record.per_kwh is None:
        return None
    meters, seconds = np.asarray(log.segments.distance_m), np.asarray(log.segments.duration_s)
    km, weight = float(np.sum(meters)) / 1e3, sum_weight(target, seconds, meters)
    kwh = float(np.sum(np.abs(measured) * weight)) / record.per_kwh
    least, most = PLAUSIBLE_KWH_PER_KM
    if km < LEAST_KM or least * km <= kwh <= most * km:
        return None
    column = next(c for c in record.columns if c in log.measured)
    source = next((c.source for c in log.columns if c.name == column), column)
    return (
        f"{kwh / km:.3g} kWh/km through the battery, outside the range of road vehicles ({least:g} to {most:g}): check "
        f"the unit of column {source}"
    )
