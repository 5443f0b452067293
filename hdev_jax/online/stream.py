"""Rows as they arrive, in anybody's columns, to the rows that a state takes: units, trips, intervals of samples."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pandas as pd

from hdev_jax.errors import InputError
from hdev_jax.logs.adapter import Adapter
from hdev_jax.logs.columns import translate
from hdev_jax.logs.limits import GAP_SAMPLES, REVERSE_MPS
from hdev_jax.logs.log import KINEMATICS, MEASURED
from hdev_jax.logs.readers.raw import Raw
from hdev_jax.online.form import NEEDED, Form
from hdev_jax.online.running import Running, running_channels
from hdev_jax.physics import LIBRARY, Effect
from hdev_jax.targets import TARGETS, target_of
from hdev_jax.units import J_PER_WH

__all__ = ["Arrived", "Stream", "channels_of", "target_in"]

# in the file of the state
KEPT = ("trips", "origin_s", "held", "before", "last_s", "so_far", "running", "repeated", "unreadable", "trimmed",
        "alone", "gone_s")  # fmt: skip
LATER = {"trimmed", "alone", "gone_s"}  # that a file of an older version lacks
Row = dict[str, float]
ENDS = ("speed_start_mps", "speed_end_mps")
READ = ("mass_kg", "grade_rad", "air_density_kgpm3", "gear", "motor_torque_nm", "motor_speed_radps", "traction_force_n",
        "voltage_v", "soc")  # fmt: skip


@dataclass
class Stream:
    """What has to be kept of a stream between rows. `trips` names those so far, the last is the one that goes on.

    `held`, rows that wait for the next one, and `before`, the row before them: a sample stands for half of the way to
    each neighbour. `continued`: it began again, and may send what it had sent; `understood`: some row has been read.
    `so_far` is of the trip that is the `running`-th, whose rows with a duration last `gone_s`.
    `repeated` counts rows that were there already when a stream began again, `unreadable` those that do not read,
    `trimmed` those within `edge_trim_s` of a trip's start, `alone` samples without a neighbour: they have no length.
    """

    rules: Adapter = field(default_factory=Adapter)
    trips: list[str] = field(default_factory=list)
    origin_s: float = float("nan")
    held: dict[str, float] | None = None
    before: dict[str, float] | None = None
    last_s: float = float("nan")
    so_far: Running = field(default_factory=Running)
    running: int = 0
    continued: bool = False
    understood: bool = False
    repeated: int = 0
    unreadable: int = 0
    trimmed: int = 0
    alone: int = 0
    gone_s: float = 0.0

    def __post_init__(self) -> None:
        a = self.rules
        if a.layout != "table" or a.long is not None or a.clock is not None or a.companion is not None:
            raise InputError(
                f"{a.where}: hdev follow takes rows of a table; layout, long, clock and companion are for files"
            )
        if a.rows is not None or a.repeated_stamps != "drop":
            raise InputError(f"{a.where}: rows and repeated_stamps are for files; send the rows that are to be used")
        if a.stamp != "middle":
            raise InputError(f'{a.where}: stamp = "{a.stamp}" is for files; hdev follow takes samples, or intervals')
        if counters := [k for k, r in a.columns.items() if r.counter]:
            raise InputError(f"{a.where}: columns.{counters[0]}: counter is for files; send what each row added")
        if a.columns:  # a row cannot be filled from rows that are still to come; the last value stands in
            plain = {k: replace(r, fill=None, initial=None) for k, r in a.columns.items()}
            self.rules = replace(a, columns=plain)

    def about(self) -> dict[str, Any]:
        """What goes into the file of the state, as plain values."""
        return {k: getattr(self, k) for k in KEPT}

    @staticmethod
    def again(about: Mapping[str, Any], rules: Adapter) -> "Stream":
        """The stream that goes on from there. Raises `KeyError` or `TypeError` for what `about` did not give."""
        known = {k: about[k] for k in KEPT if k in about or k not in LATER}
        known["so_far"] = Running(*known["so_far"])
        return Stream(rules, **known, continued=True, understood=True)

    # --- rows in the contract's columns ------------------------------------------------------------------------------

    def read(self, records: Iterable[Mapping[str, Any]]) -> list[tuple[str, dict[str, float]]]:
        """Rows by header to `(trip, row in SI)`. What does not read is counted. Raises `InputError` where none does."""
        records = list(records)
        try:
            found = self._translated(records)
        except InputError:
            if len(records) == 1 and not self.understood:
                raise
        else:
            self.understood = self.understood or bool(found)
            return found
        if len(records) == 1:
            self.unreadable += 1
            return []
        half = max(len(records) // 2, 1)
        return self.read(records[:half]) + self.read(records[half:])

    def _translated(self, records: list[Mapping[str, Any]]) -> list[tuple[str, dict[str, float]]]:
        if not records:
            return []
        table = pd.DataFrame(records)
        piece = translate(Raw("standard input", table, "stream"), self.rules)
        names = list(piece.data)
        values = np.stack([piece.data[c] for c in names], axis=1) if names else np.zeros((len(table), 0))
        trips, trip = [], self.trips[-1] if self.trips else "stream"
        for k in piece.trip:  # a blank one is the trip before
            trip = piece.trip_names[k] if k >= 0 and piece.trip_names[k].strip() else trip
            trips.append(trip)
        return [(trip, dict(zip(names, map(float, row), strict=True))) for trip, row in zip(trips, values, strict=True)]

    # --- intervals ---------------------------------------------------------------------------------------------------

    def intervals(self, rows: Iterable[tuple[str, dict[str, float]]]) -> Iterator[tuple[int, dict[str, float]]]:
        """Rows that are complete: the number of their trip, and the row with its interval and running channels."""
        yield from map(self._ran, self._intervals(rows))

    def flush(self) -> Iterator[tuple[int, dict[str, float]]]:
        """The row that waits, as the last of its stretch."""
        yield from map(self._ran, self._flushed())

    def _ran(self, at: tuple[int, dict[str, float]]) -> tuple[int, dict[str, float]]:
        number, row = at
        if number != self.running:
            self.so_far, self.running = Running(), number
        self.so_far, channels = self.so_far.after(row)
        return number, row | channels

    def _intervals(self, rows: Iterable[tuple[str, dict[str, float]]]) -> Iterator[tuple[int, dict[str, float]]]:
        for trip, row in rows:
            if self._was_there(trip, row):
                self.repeated += 1
                continue
            opens = not self.trips or trip != self.trips[-1]
            time = row.get("time_s", np.nan)
            if not opens and self._breaks(row):
                yield from self._flushed()
            if opens:
                yield from self._flushed()
                self.trips.append(trip)
                self.origin_s, self.gone_s = time, 0.0
            self.origin_s = time if np.isnan(self.origin_s) else self.origin_s
            self.last_s = time if np.isfinite(time) else self.last_s
            row = row | {"time_s": time - self.origin_s} if "time_s" in row else row
            since = row["time_s"] if np.isfinite(time) else self.gone_s
            self.gone_s += np.nan_to_num(row.get("duration_s", 0.0))
            if 0.0 <= since < self.rules.edge_trim_s:  # a clock that goes back is no start of a trip
                self.trimmed += 1
                continue
            if "speed_mps" not in row and np.isfinite(row.get("duration_s", np.nan)):
                if self.held is not None and "speed_mps" not in self.held:
                    yield len(self.trips), _interval(self.before, self.held, row)
                    self.before = self.held = None
                yield from self._flushed()
                yield len(self.trips), row  # whole by itself
            elif self.held is None:
                self.held = row
            else:
                yield len(self.trips), _interval(self.before, self.held, row)
                self.before, self.held = self.held, row

    def _flushed(self) -> Iterator[tuple[int, dict[str, float]]]:
        if self.held is not None and (self.before is not None or np.isfinite(self.held.get("duration_s", np.nan))):
            yield len(self.trips), _interval(self.before, self.held, None)
        elif self.held is not None:
            self.alone += 1
        self.held = self.before = None

    def _breaks(self, row: dict[str, float]) -> bool:
        """Whether a gap or a clock that goes back parts this row from the one that waits."""
        if self.held is None or "time_s" not in row:
            return False
        step = row["time_s"] - self.origin_s - self.held["time_s"]
        own = self.held["time_s"] - self.before["time_s"] if self.before is not None else np.inf
        return step <= 0 or step > GAP_SAMPLES * own

    def _was_there(self, trip: str, row: dict[str, float]) -> bool:
        """Whether a stream that began again sends what it had sent before it stopped."""
        if not self.continued:
            return False
        time = row.get("time_s", np.nan)
        old = trip in self.trips[:-1] or (bool(self.trips) and trip == self.trips[-1] and time <= self.last_s)
        self.continued = old
        return old


def _interval(
    before: dict[str, float] | None, row: dict[str, float], after: dict[str, float] | None
) -> dict[str, float]:
    """The row with its interval: a sample reaches half-way to each neighbour, its end speeds are the means with them;
    at the ends of a stretch as far out as in, with the acceleration beside it."""
    if "speed_mps" not in row:  # an interval by its ends, as long as to the next one
        other = (row, after) if after is not None else (before, row)
        step = other[1]["time_s"] - other[0]["time_s"] if other[0] is not None else np.nan
        return row | {"duration_s": step}
    v = _speed(row)
    back = row["time_s"] - before["time_s"] if before is not None and "time_s" in row else np.nan
    ahead = after["time_s"] - row["time_s"] if after is not None and "time_s" in row else np.nan
    back, ahead = (ahead if np.isnan(back) else back), (back if np.isnan(ahead) else ahead)
    first = 0.5 * (_speed(before) + v) if before is not None else np.nan
    last = 0.5 * (v + _speed(after)) if after is not None else np.nan
    first, last = (2.0 * v - last if before is None else first), (2.0 * v - first if after is None else last)
    first, last = (v, v) if before is None and after is None else (first, last)
    duration = row.get("duration_s", np.nan)
    duration = duration if np.isfinite(duration) else 0.5 * (back + ahead)
    # a speed that is none, or backwards, makes its own row unusable
    ends = {"speed_start_mps": max(first, 0.0), "speed_end_mps": max(last, 0.0)} if v >= 0 else dict.fromkeys(ENDS, v)
    distance = row.get("distance_m", np.nan)
    out = {k: x for k, x in row.items() if k != "speed_mps"} | ends | {"duration_s": duration}
    out["distance_m"] = distance if np.isfinite(distance) else v * duration
    return out


def _speed(row: Row) -> float:
    """Speed of a sample; down to −0.5 m/s it stands."""
    v = row["speed_mps"]
    return 0.0 if -REVERSE_MPS <= v < 0.0 else v


@dataclass(frozen=True)
class Arrived:
    """A row as a state takes it, and the name of its trip."""

    trip: str
    vector: np.ndarray

    @staticmethod
    def of(form: Form, trip: str, number: int, row: Mapping[str, float]) -> "Arrived":
        """From a row with its interval."""
        at = {"trip": float(number), "measured": measured_in(row, form.target)}
        return Arrived(trip, np.array([at[c] if c in at else row.get(c, np.nan) for c in form.columns], dtype=float))


def channels_of(names: Iterable[str], library: Mapping[str, type[Effect]] = LIBRARY) -> tuple[str, ...]:
    """The columns of rows that the kernel or any effect of the library reads."""
    known = {*READ, *(c for e in library.values() for c in e.reads())}
    return tuple(sorted({*names} & known - {*NEEDED, *KINEMATICS, *MEASURED} | {*running_channels(names)}))


def target_in(names: Iterable[str], asked: str | None) -> str:
    """What rows of these columns measure nearest the battery, or what is asked for. Raises `InputError`."""
    there = {*names}
    found = [t for t in TARGETS.values() if there & {*t.columns}]
    found.sort(key=lambda t: (not t.of_battery, t.of_battery and t.columns[0] not in there))
    if asked is not None:
        if asked not in TARGETS or target_of(asked) not in found:
            raise InputError(f"--target {asked}: the rows do not measure it; they have {', '.join(sorted(there))}")
        return asked
    if not found:
        raise InputError(
            "standard input: no target: energy_wh, battery_power_w (_kw), motor_torque_nm or traction_force_n is "
            f"expected; the rows have {', '.join(sorted(there))}"
        )
    return found[0].name


def measured_in(row: Mapping[str, float], target: str) -> float:
    """The row's measured target; NaN where it has none."""
    t = TARGETS[target]
    if not t.of_battery:
        return row.get(t.columns[0], np.nan)
    if t.columns[0] in row:
        value = row[t.columns[0]]
        return value / 1e3 if t.weight == "duration" else value
    hours = row.get("duration_s", np.nan) / J_PER_WH
    if t.weight == "duration":
        return row.get("energy_wh", np.nan) / hours / 1e3
    return row.get("battery_power_w", np.nan) * hours
