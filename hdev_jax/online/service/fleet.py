"""The vehicles of all fleets in one process: rows are kept, acknowledged, and then used one vehicle after the other."""

import contextlib
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from hdev_jax import __version__, progress
from hdev_jax.errors import InputError
from hdev_jax.inference.sheet import Sheet, augmented_sheet
from hdev_jax.online.followed import Followed
from hdev_jax.online.service.journal import Journal, Kept, Sent, UnavailableError
from hdev_jax.online.service.tracked import Tracked

__all__ = ["Fleet"]

KEPT_ROWS = 500  # of a vehicle between two states that are written: what a start has to use again
KEPT_S = 10.0
Key = tuple[str, str]  # fleet and vehicle


class Fleet:
    """Every vehicle that sends rows. `sheet_for(fleet, vehicle)` gives its sheet, or raises `InputError`.

    `put` answers once rows are in the journal; a thread of its own uses them. Whoever asks about a vehicle sees all
    rows that were acknowledged before. Rows are used in an order that follows from the rows alone (`Tracked`): a start
    from the journal ends in the same state.
    """

    def __init__(
        self, journal: Journal, sheet_for: Callable[[str, str], Sheet], *, watch: bool = True,
        effects_sha256: str | None = None,
    ):  # fmt: skip
        self.journal: Journal = journal
        self._sheet_for, self._watch, self._effects = sheet_for, watch, effects_sha256
        self._vehicles: dict[Key, Tracked] = {}
        self._names: dict[str, set[str]] = {}
        for name, vehicle in journal.vehicles():
            self._names.setdefault(name, set()).add(vehicle)
        self._lock = threading.RLock()  # of what is known of vehicles
        self._entry = threading.Lock()  # of what comes in; where both are held, this one is the inner
        self._pending: dict[Key, list[Sent]] = {}
        self._doubtful: set[Key] = set()  # of whose rows the journal may have more than was answered
        self._sheeted: set[Key] = set()
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="vehicles")
        self.behind: int = 0  # rows that are acknowledged and not used yet
        self.version: int = 0  # of what is known: more with each batch

    # --- rows in -----------------------------------------------------------------------------------------------------

    def put(self, fleet: str, rows: Sequence[tuple[str, str, float, dict[str, Any]]]) -> dict[str, int]:
        """Keep rows, to be used in turn. **Returns:** how many were `accepted`, and `repeated` before. Raises
        `InputError` for a vehicle without a sheet: then none is kept; `UnavailableError` where none can be."""
        for key in {(fleet, r[0]) for r in rows} - self._sheeted:
            self._sheet_for(*key)
            self._sheeted.add(key)
        with self._entry:
            try:
                new = self.journal.put(fleet, rows)
            except UnavailableError:
                self._doubtful.update((fleet, r[0]) for r in rows)
                raise
            for vehicle, sent in new:
                self._waiting((fleet, vehicle)).append(sent)
            for vehicle in {r[0] for r in rows if (fleet, r[0]) in self._doubtful}:
                self._waiting((fleet, vehicle))  # perhaps all of them were kept before
            self._names.setdefault(fleet, set()).update(r[0] for r in rows)
            self.behind += len(new)
        return {"accepted": len(new), "repeated": len(rows) - len(new)}

    def _waiting(self, key: Key) -> list[Sent]:
        """The rows of a vehicle that are to be used; the first one starts the worker."""
        if key not in self._pending:
            self._worker.submit(self._used, key)
        return self._pending.setdefault(key, [])

    def _used(self, key: Key) -> None:
        try:
            self._current(key)
        except (
            InputError,
            UnavailableError,
        ):  # its sheet was taken away, or the database: whoever asks gets the reason
            return  # its rows stay in the journal
        except Exception as e:  # nobody waits for this
            progress.step(f"vehicle {key[1]}: its rows could not be used ({type(e).__name__}: {e})")

    def _current(self, key: Key) -> Tracked:
        """The vehicle with all its rows so far used. Raises `InputError` where it has no sheet, `UnavailableError`
        where the journal is to be read and cannot be."""
        with self._lock:
            with self._entry:
                sents = self._pending.pop(key, [])
                self.behind -= len(sents)
                if key in self._doubtful:
                    self._doubtful.remove(key)
                    self._vehicles.pop(key, None)  # again from the journal, with rows whose commit was not confirmed
            vehicle = self._vehicles.get(key)
            anew = vehicle is None
            if vehicle is None:
                vehicle = self._vehicles[key] = self._again(key)
            sents = [s for s in sents if s.seq > vehicle.upto]  # those before it has from the journal
            if sents or anew:
                vehicle.take(sents)
                self._keep([key])
                self.version += 1
            return vehicle

    def _again(self, key: Key) -> Tracked:
        """The vehicle as the journal has it."""
        sheet, kept = self._sheet_for(*key), self.journal.kept(*key)
        # of another sheet, version or watch, or of a state that had other numbers: from its first row
        if kept is not None and kept.about.get("of") == self._of(sheet):
            with contextlib.suppress(KeyError, TypeError, ValueError):
                vehicle = Tracked(Followed(sheet, watch=self._watch))
                vehicle.again(kept)
                sents = [*self.journal.since(*key, vehicle.upto, kept.about["waiting"])]
                vehicle.waiting = [s for s in sents if s.seq <= vehicle.upto]
                vehicle.take([s for s in sents if s.seq > vehicle.upto])
                return vehicle
        vehicle = Tracked(Followed(sheet, watch=self._watch))
        vehicle.take([*self.journal.since(*key, 0)])
        return vehicle

    def _of(self, sheet: Sheet) -> list[Any]:
        """What a state is of."""
        own = [] if self._effects is None else [self._effects]
        return [augmented_sheet(sheet, {}, {}), self._watch, __version__, *own]

    # --- kept --------------------------------------------------------------------------------------------------------

    def _keep(self, keys: Sequence[Key], *, all_: bool = False) -> None:
        now, states = time.monotonic(), []
        for key in keys:
            v = self._vehicles[key]
            if v.since and (all_ or v.since >= KEPT_ROWS or now - v.kept_at > KEPT_S):
                numbers = None if v.followed.live is None else np.array(v.followed.live.numbers)
                about = {"of": self._of(v.followed.sheet), **v.about()}
                states.append((*key, Kept(v.upto, about, numbers)))
        with contextlib.suppress(UnavailableError):  # the rows are in the journal: a state only spares a start time
            if states:
                self.journal.keep(states)
            for fleet, name, _ in states:
                self._vehicles[fleet, name].since, self._vehicles[fleet, name].kept_at = 0, now

    def close(self) -> None:
        """Use the rows that are there and write every state; the journal is closed."""
        self._worker.shutdown()
        with self._lock:
            self._keep([*self._vehicles], all_=True)
            self.journal.close()

    # --- what is known -----------------------------------------------------------------------------------------------

    def names(self, fleet: str) -> list[str]:
        """Vehicles of a fleet that have sent rows."""
        with self._entry:
            return sorted(self._names.get(fleet, ()))

    def known(self, fleet: str, name: str) -> dict[str, Any] | None:
        """What is known of a vehicle now; None where the fleet has none of this name."""
        with self._entry:
            there = name in self._names.get(fleet, ())
        if not there:
            return None
        with self._lock:
            try:
                return self._current((fleet, name)).known(name)
            except InputError as e:  # its sheet was taken away
                return {"vehicle_id": name, "sheet": None, "alarm": None, "rows": {}, "notes": [], "refused": str(e)}

    def recent(self, fleet: str, name: str) -> list[dict[str, Any]]:
        """The last rows that were used: time, measured, predicted with its interval."""
        with self._lock:
            v = self._vehicles.get((fleet, name))  # in memory, or without a sheet
            return [] if v is None else list(v.recent)

    def ahead(self, fleet: str, name: str, rows: Sequence[Mapping[str, Any]], **battery: Any) -> dict[str, Any]:
        """Energy of rows to come, and what of the battery is left. Raises `RefusedError` before a first row."""
        with self._lock:
            return self._current((fleet, name)).forecast(rows, **battery)
