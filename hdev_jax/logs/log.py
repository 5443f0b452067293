"""`Log`: what a reader hands on. Segments for the kernel, measurements for the residual, the ledger for the user."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from hdev_jax.errors import InputError
from hdev_jax.logs.adapter import near
from hdev_jax.logs.columns import ColumnInfo
from hdev_jax.logs.instruments import Instrument
from hdev_jax.logs.ledger import Ledger
from hdev_jax.segments import Segments
from hdev_jax.targets import TARGETS
from hdev_jax.units import J_PER_WH

__all__ = ["KINEMATICS", "MEASURED", "Log"]

MEASURED = ("battery_power_w", "energy_wh")
# what a row is, before any channel: fields of `Segments`, or what they are made of
KINEMATICS = ("time_s", "duration_s", "distance_m", "speed_mps", "speed_start_mps", "speed_end_mps")


@dataclass(frozen=True)
class Log:
    """A log in memory, SI, float64 on the host.

    **Fields:**

    - `segments`: the rows, as the kernel takes them.
    - `measured`: `battery_power_w` or `energy_wh` `[row]`, positive out of the battery; not among the channels.
    - `trip_names`, `vehicle_names`: `trip_names[trip[i]]` and `vehicle_names[segments.vehicle[i]]` name row i.
    - `sampled`: rows are samples, not intervals.
    - `columns`, `files`: where each column came from.
    - `part`: where a trip was split, the part of each row, as an index of `trip_names`; else None.
    - `started_s`: start of each trip whose clock has a date, in seconds since 1970.
    - `instruments`: noise and resolution of the channels that were read.
    """

    segments: Segments
    measured: dict[str, np.ndarray]
    trip_names: tuple[str, ...]
    vehicle_names: tuple[str, ...]
    ledger: Ledger = field(default_factory=Ledger)
    columns: tuple[ColumnInfo, ...] = ()
    sampled: bool = False
    files: tuple[str, ...] = ()
    part: np.ndarray | None = None
    started_s: Mapping[str, float] = field(default_factory=dict)
    instruments: tuple[Instrument, ...] = ()

    @classmethod
    def from_frame(cls, frame: Any, *, name: str = "frame", adapter: Any = None) -> "Log":
        """A log from a table in memory, by the same rules as from a file.

        **Arguments:** `frame`: a pandas, polars or pyarrow table, or a mapping of names to arrays. `name`: what
        messages call the table, and the trip's name where there is no `trip_id`. `adapter`: a TOML file, where columns
        have other names. **Raises:** `InputError`, one line that says what to do.
        """
        from hdev_jax.logs.read import log_from_frame  # that module makes logs

        return log_from_frame(frame, name=name, adapter=adapter)

    def __len__(self) -> int:
        return len(self.segments)

    def __repr__(self) -> str:
        measured = ", ".join(self.measured) or "nothing at the battery"
        return (
            f"Log({len(self):,} rows, {len(self.trip_names)} trips, {len(self.vehicle_names)} vehicles; "
            f"measured: {measured}; channels: {', '.join(self.segments.channels) or 'none'})"
        )

    @property
    def trip(self) -> np.ndarray:
        """The trip of each row, or its part of a split trip, as an index of `trip_names`."""
        return np.asarray(self.segments.trip if self.part is None else self.part)

    @property
    def targets(self) -> tuple[str, ...]:
        """Names of the targets that this log measures, nearest the battery first."""
        there = {*self.measured, *self.segments.channels}
        found = [t for t in TARGETS.values() if there & {*t.columns}]
        # of the battery's that first which is measured itself
        found.sort(key=lambda t: (not t.of_battery, t.of_battery and t.columns[0] not in there))
        return tuple(t.name for t in found)

    @property
    def default_target(self) -> str:
        """The measured target nearest the battery. Raises `InputError` where the log measures none."""
        if not self.targets:
            none = f"none of {', '.join(self._accepted())} is measured"
            raise InputError(f"{self._name()}: no target: {none}{self._near()}")
        return self.targets[0]

    def target(self, name: str) -> np.ndarray:
        """The measured target `[row]` in the unit of its name. Raises `InputError` if the log lacks it."""
        if name not in TARGETS:
            raise InputError(f"unknown target '{name}'{near(name, tuple(TARGETS))} accepted: {', '.join(TARGETS)}")
        if name not in self.targets:
            has = f"it has {', '.join(self.targets)}" if self.targets else "it measures none"
            raise InputError(f"{self._name()}: target {name} is not in this log ({has}){self._near()}")
        hours = self.segments.duration_s / 3600.0
        if not TARGETS[name].of_battery:
            return np.asarray(self.segments.channels[name])
        if TARGETS[name].weight == "duration":
            return np.asarray(self._watts() / 1000.0)
        return np.asarray(self.measured[name] if name in self.measured else self._watts() * hours)

    def _watts(self) -> np.ndarray:
        if "battery_power_w" in self.measured:
            return self.measured["battery_power_w"]
        return np.asarray(self.measured["energy_wh"] * J_PER_WH / self.segments.duration_s)

    def _name(self) -> str:
        return self.files[0] if len(self.files) == 1 else f"log of {len(self.files)} files"

    @staticmethod
    def _accepted() -> tuple[str, ...]:
        return ("energy_wh", "battery_power_w", "battery_power_kw", "motor_torque_nm", "traction_force_n")

    def _near(self) -> str:
        for wanted in self._accepted():
            for column in self.segments.channels:
                if column not in TARGETS and (hint := near(column, [wanted], 0.8)):
                    return f"; column '{column}'{hint}"
        powers = [c.source for c in self.columns if c.unit.lower() in ("w", "kw", "watts") and c.name == c.source]
        if powers:
            return f"; say in an adapter (hdev check --skeleton) whether '{powers[0]}' is battery_power_w"
        return ""

    def select(self, trips: Sequence[int]) -> "Log":
        """The rows of these trips, by their ids; ids and names stay as they are."""
        return self.take(np.isin(self.trip, np.asarray(list(trips), dtype=np.int64)))

    def take(self, rows: np.ndarray) -> "Log":
        """The log with some of its rows, by a mask or indices `[row]`."""
        measured = {k: v[rows] for k, v in self.measured.items()}
        part = None if self.part is None else self.part[rows]
        return replace(self, segments=self.segments.take(rows), measured=measured, part=part)

    def trip_id(self, name: str) -> int:
        """The id of a trip by its name. Raises `InputError`, with the nearest name, if there is none."""
        if name not in self.trip_names:
            shown = ", ".join(self.trip_names[:8]) + (", …" if len(self.trip_names) > 8 else "")
            raise InputError(f"no trip '{name}' in {self._name()}{near(name, self.trip_names)}; it has {shown}")
        return self.trip_names.index(name)

    def fingerprint(self) -> str:
        """SHA-256 of names and numbers: two logs with the same one give the same results."""
        s = self.segments
        columns: dict[str, object] = {
            "trip": self.trip,
            **{k: getattr(s, k) for k in ("vehicle", "time_s", "duration_s", "distance_m")},
            **{k: getattr(s, k) for k in ("speed_start_mps", "speed_end_mps")},
            **{f"channel {k}": v for k, v in sorted(s.channels.items())},
            **{f"measured {k}": v for k, v in sorted(self.measured.items())},
        }
        sha = hashlib.sha256(repr((self.trip_names, self.vehicle_names, self.sampled)).encode())
        for name, x in columns.items():
            array = np.ascontiguousarray(x)
            sha.update(f"{name} {array.dtype.str} {array.shape}".encode())
            sha.update(array.data)
        return sha.hexdigest()
