"""The vehicles of all fleets in one process: rows put in order, used, and kept."""

import itertools
import math
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from hdev_jax import __version__
from hdev_jax.errors import InputError
from hdev_jax.inference.sheet import Sheet, augmented_sheet
from hdev_jax.logs.adapter import Adapter
from hdev_jax.online.followed import Followed, plain, plain_alarm
from hdev_jax.online.forecast import forecast
from hdev_jax.online.service.given import RefusedError
from hdev_jax.online.service.journal import Journal, Kept, Sent
from hdev_jax.online.state import Now
from hdev_jax.online.stream import Arrived

__all__ = ["Fleet"]

ORDERED_S = 60.0  # rows that come this much late are put in order; so much the estimates are behind the newest row
KEPT_ROWS = 500  # of a vehicle between two states that are written: what a start has to use again
KEPT_S = 10.0
MOST_WAITING = 5000  # rows of a vehicle; beyond, the first ones wait no longer
FARTHEST_S = 86_400.0  # ahead of the newest row of its trip: a clock at fault
SHOWN = 240  # rows that a page of a vehicle has


@dataclass
class _Vehicle:
    """One vehicle in memory: its estimator, rows that wait for those before them, what is new since it was kept."""

    followed: Followed
    upto: int = 0
    waiting: list[Sent] = field(default_factory=list)
    newest: tuple[str, float] | None = None
    used_s: float = -math.inf  # time of the last row that was used, in its trip
    ended: list[str] = field(default_factory=list)  # trips
    late: int = 0
    ahead: int = 0
    unused: int = 0  # that could not be used
    refused: str | None = None  # why its rows cannot be used at all
    last: dict[str, Any] = field(default_factory=dict)
    recent: list[dict[str, Any]] = field(default_factory=list)
    shown: tuple[int, dict[str, Any]] | None = None  # the last answer about it, and the row that it is of
    since: int = 0
    kept_at: float = field(default_factory=time.monotonic)

    def about(self) -> dict[str, Any]:
        """All but the numbers of the state, as plain values."""
        return {
            **(self.followed.about() if self.followed.live is not None else {}),
            "waiting": [s.seq for s in self.waiting], "newest": self.newest, "used_s": _finite(self.used_s),
            "ended": self.ended, "late": self.late, "ahead": self.ahead, "unused": self.unused, "refused": self.refused,
            "last": self.last, "recent": self.recent,
        }  # fmt: skip


def _alike(records: Sequence[dict[str, Any]], *, begun: bool) -> list[list[dict[str, Any]]]:
    """Runs of rows with the same fields: what a row is taken for depends on its own alone, not on its batch. The first
    row of all, which says which columns there are, is one by itself."""
    first = 0 if begun else 1
    runs = itertools.groupby(records[first:], key=lambda r: tuple(sorted(r)))
    return [*([r] for r in records[:first]), *(list(run) for _, run in runs)]


def _finite(x: float) -> float | None:
    return x if math.isfinite(x) else None


class Fleet:
    """Every vehicle that sends rows. `sheet_for(fleet, vehicle)` gives its sheet, or raises `InputError`.

    Rows are used in the order of their time, `ORDERED_S` behind the newest of their vehicle, or at once where a new
    trip begins: an order that follows from the rows alone, so that a start from the journal ends in the same state.
    """

    def __init__(self, journal: Journal, sheet_for: Callable[[str, str], Sheet], *, watch: bool = True):
        self.journal: Journal = journal
        self._sheet_for, self._watch = sheet_for, watch
        self._vehicles: dict[tuple[str, str], _Vehicle] = {}
        self._lock = threading.RLock()
        self._names: dict[str, set[str]] = {}
        for name, vehicle in journal.vehicles():
            self._names.setdefault(name, set()).add(vehicle)
        self.version: int = 0  # of what is known: more with each batch

    # --- rows in -----------------------------------------------------------------------------------------------------

    def put(self, fleet: str, rows: Sequence[tuple[str, str, float, dict[str, Any]]]) -> dict[str, int]:
        """Keep rows, then use those whose turn it is. **Returns:** how many were `accepted`, and `repeated` before."""
        for vehicle in {r[0] for r in rows}:
            self._vehicle(fleet, vehicle)  # a vehicle without a sheet is refused before anything is kept
        with self._lock:
            new = self.journal.put(fleet, rows)
            by: dict[str, list[Sent]] = {}
            for vehicle, sent in new:
                by.setdefault(vehicle, []).append(sent)
            for vehicle, sents in by.items():
                self._take(self._vehicle(fleet, vehicle), sents)
            self._names.setdefault(fleet, set()).update(by)
            self._keep(fleet, by)
            self.version += 1
        return {"accepted": len(new), "repeated": len(rows) - len(new)}

    def _vehicle(self, fleet: str, name: str) -> _Vehicle:
        """The vehicle as it is in memory, or as the journal has it. Raises `InputError` where it has no sheet."""
        with self._lock:
            found = self._vehicles.get((fleet, name))
            if found is None:
                found = self._vehicles[fleet, name] = self._again(fleet, name)
        return found

    def _again(self, fleet: str, name: str) -> _Vehicle:
        sheet = self._sheet_for(fleet, name)
        vehicle, kept = _Vehicle(Followed(sheet, watch=self._watch)), self.journal.kept(fleet, name)
        # of another sheet, version or watch: from its first row
        if kept is not None and kept.about.get("of") == self._of(sheet):
            about, vehicle.upto = kept.about, kept.upto
            if kept.numbers is not None:
                vehicle.followed.again(about, kept.numbers, Adapter())
                vehicle.followed.stream.continued = False  # what came twice is the journal's to say
            vehicle.newest = tuple(about["newest"]) if about["newest"] else None
            vehicle.used_s = -math.inf if about["used_s"] is None else about["used_s"]
            vehicle.ended, vehicle.refused = about["ended"], about["refused"]
            vehicle.late, vehicle.ahead, vehicle.unused = (about[k] for k in ("late", "ahead", "unused"))
            vehicle.last, vehicle.recent = about["last"], about["recent"]
            sents = [*self.journal.since(fleet, name, vehicle.upto, about["waiting"])]
            vehicle.waiting = [s for s in sents if s.seq <= vehicle.upto]
            sents = [s for s in sents if s.seq > vehicle.upto]
        else:
            sents = [*self.journal.since(fleet, name, 0)]
        for sent in sents:  # as they came: one by one ends as any batches do
            self._take(vehicle, [sent])
        return vehicle

    def _of(self, sheet: Sheet) -> list[Any]:
        """What a state is of."""
        return [augmented_sheet(sheet, {}, {}), self._watch, __version__]

    def _take(self, vehicle: _Vehicle, sents: Sequence[Sent]) -> None:
        """Rows in the order in which they came; what follows does not depend on how many come at once."""
        due: list[Sent] = []
        for sent in sents:
            vehicle.upto = max(vehicle.upto, sent.seq)
            vehicle.since += 1
            if vehicle.newest is not None and sent.trip != vehicle.newest[0]:
                if sent.trip in vehicle.ended:
                    vehicle.late += 1
                    continue
                due += sorted(vehicle.waiting, key=lambda s: s.time_s)
                vehicle.ended.append(vehicle.newest[0])
                vehicle.waiting, vehicle.newest, vehicle.used_s = [], None, -math.inf
            if sent.time_s <= vehicle.used_s or (
                vehicle.newest is not None and sent.time_s <= vehicle.newest[1] - ORDERED_S
            ):
                vehicle.late += 1
                continue
            if vehicle.newest is not None and sent.time_s > vehicle.newest[1] + FARTHEST_S:
                vehicle.ahead += 1
                continue
            vehicle.waiting.append(sent)
            if len(vehicle.waiting) > MOST_WAITING:
                vehicle.waiting.sort(key=lambda s: s.time_s)
                first, vehicle.waiting = vehicle.waiting[: MOST_WAITING // 2], vehicle.waiting[MOST_WAITING // 2 :]
                vehicle.used_s = first[-1].time_s
                due += first
            if vehicle.newest is None or sent.time_s > vehicle.newest[1]:
                vehicle.newest = (sent.trip, sent.time_s)
                until = sent.time_s - ORDERED_S
                ready = sorted((s for s in vehicle.waiting if s.time_s <= until), key=lambda s: s.time_s)
                if ready:
                    vehicle.used_s = ready[-1].time_s
                    vehicle.waiting = [s for s in vehicle.waiting if s.time_s > until]
                    due += ready
        self._use(vehicle, due)

    def _use(self, vehicle: _Vehicle, due: Sequence[Sent]) -> None:
        records = [{**s.body, **({"trip_id": s.trip} if s.trip else {})} for s in due]
        for part in _alike(records, begun=vehicle.followed.live is not None):
            try:
                arrived, now = vehicle.followed.take(part)
                if now is not None:
                    shown = range(max(len(arrived) - SHOWN, 0), len(arrived))
                    told = [self._told(vehicle.followed, arrived[i], now, i) for i in shown]
                    vehicle.recent = [*vehicle.recent, *told][-SHOWN:]
                    vehicle.last = vehicle.recent[-1] | self._known(vehicle.followed, arrived[-1], now.row(-1))
                vehicle.refused = None
            except InputError as e:
                sheet = str(vehicle.followed.sheet.path)  # no path of this machine goes to a client
                vehicle.refused = str(e).removeprefix("standard input: ").replace(sheet, Path(sheet).name)
                vehicle.unused += len(part)
            except Exception as e:  # a row that nothing foresaw is counted, and no start fails by it
                vehicle.refused = f"{len(part)} rows could not be used ({type(e).__name__})"
                vehicle.unused += len(part)

    @staticmethod
    def _told(followed: Followed, arrived: Arrived, now: Now, i: int) -> dict[str, Any]:
        """A row as the page draws it."""
        at = followed.form.columns.index
        return {
            "time_s": plain(arrived.vector[at("time_s")]), "measured": plain(arrived.vector[at("measured")]),
            **{k: plain(getattr(now, k)[i]) for k in ("predicted", "lower", "upper")},
        }  # fmt: skip

    @staticmethod
    def _known(followed: Followed, arrived: Arrived, now: Now) -> dict[str, Any]:
        each = zip(followed.form.names, now.values, now.sd, strict=True)
        return {
            "trip_id": arrived.trip, "sigma": plain(now.sigma), "unit": followed.form.unit,
            "values": {n: [plain(v), plain(s)] for n, v, s in each},
        }  # fmt: skip

    # --- kept --------------------------------------------------------------------------------------------------------

    def _keep(self, fleet: str, names: Mapping[str, Any] | Sequence[str], *, all_: bool = False) -> None:
        now, states = time.monotonic(), []
        for name in names:
            v = self._vehicle(fleet, name)
            if v.since and (all_ or v.since >= KEPT_ROWS or now - v.kept_at > KEPT_S):
                numbers = None if v.followed.live is None else np.array(v.followed.live.numbers)
                about = {"of": self._of(v.followed.sheet), **v.about()}
                states.append((fleet, name, Kept(v.upto, about, numbers)))
                v.since, v.kept_at = 0, now
        if states:
            self.journal.keep(states)

    def close(self) -> None:
        """Write every state; the journal is closed."""
        with self._lock:
            for fleet in {f for f, _ in self._vehicles}:
                self._keep(fleet, [n for f, n in self._vehicles if f == fleet], all_=True)
            self.journal.close()

    # --- what is known -----------------------------------------------------------------------------------------------

    def names(self, fleet: str) -> list[str]:
        """Vehicles of a fleet that have sent rows."""
        with self._lock:
            return sorted(self._names.get(fleet, ()))

    def known(self, fleet: str, name: str) -> dict[str, Any] | None:
        """What is known of a vehicle now; None where the fleet has none of this name."""
        with self._lock:
            if name not in self._names.get(fleet, ()):
                return None
            try:
                v = self._vehicle(fleet, name)
            except InputError as e:  # its sheet was taken away
                return {"vehicle_id": name, "sheet": None, "alarm": None, "rows": {}, "notes": [], "refused": str(e)}
            if v.shown is not None and v.shown[0] == v.upto:
                return v.shown[1]
            alarm = v.followed.alarm()
            told = {
                "vehicle_id": name, "sheet": v.followed.sheet.name, **v.last,
                "alarm": None if alarm is None else plain_alarm(alarm) | {"text": alarm.line()},
                "rows": {
                    **v.followed.counted(), "late": v.late, "far ahead": v.ahead, "not usable": v.unused,
                    "waiting": len(v.waiting),
                },
                "notes": v.followed.notes, "refused": v.refused,
            }  # fmt: skip
            v.shown = v.upto, told
            return told

    def recent(self, fleet: str, name: str) -> list[dict[str, Any]]:
        """The last rows that were used: time, measured, predicted with its interval."""
        with self._lock:
            v = self._vehicles.get((fleet, name))  # in memory, or without a sheet
            return [] if v is None else list(v.recent)

    def ahead(self, fleet: str, name: str, rows: Sequence[Mapping[str, Any]], **battery: Any) -> dict[str, Any]:
        """Energy of rows to come, and what of the battery is left. Raises `RefusedError` before a first row."""
        with self._lock:
            v = self._vehicle(fleet, name)
            if v.followed.live is None:
                raise RefusedError(["rows"], "no row of this vehicle has been used yet; send its trip first")
            state, trips = v.followed.live.state, v.followed.stream.trips
        vectors = []
        for i, row in enumerate(rows):
            for key in ("duration_s", "speed_start_mps", "speed_end_mps"):
                value = row.get(key)
                if value is None or value < 0 or (key == "duration_s" and value == 0):
                    raise RefusedError(["rows", i, key], "a number above 0 is expected: rows to come are intervals")
            vectors.append(
                Arrived.of(
                    state.form,
                    trips[-1],
                    len(trips),
                    {k: float(x) for k, x in row.items() if isinstance(x, int | float)},
                ).vector
            )
        reserve = battery.pop("reserve", 0.0)
        if battery.get("capacity_wh") is None:
            battery["capacity_wh"] = v.followed.sheet.capacity_wh
        try:
            told = forecast(state, np.stack(vectors), **battery)
        except ValueError as e:
            raise RefusedError(["rows"], str(e)) from e
        end = told.soc_at_end
        return {
            "energy_wh": told.energy_wh, "interval_wh": list(told.interval_wh), "level": told.level,
            "soc_at_end": None if end is None else list(end), "chance_of_arriving": told.chance_of_arriving(reserve),
        }  # fmt: skip
