"""One vehicle of a service: its rows put in order, used by its estimator, and its estimates as JSON has them."""

import itertools
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from hdev_jax.errors import InputError
from hdev_jax.logs.adapter import Adapter
from hdev_jax.online.followed import Followed, plain, plain_alarm
from hdev_jax.online.forecast import forecast
from hdev_jax.online.service.given import RefusedError
from hdev_jax.online.service.journal import Kept, Sent
from hdev_jax.online.state import Now
from hdev_jax.online.stream import Arrived

__all__ = ["Tracked"]

ORDERED_S = 60.0  # rows that come this much late are put in order; so much the estimates are behind the newest row
MOST_WAITING = 5000  # rows of a vehicle; beyond, the first ones wait no longer
FARTHEST_S = 86_400.0  # ahead of the newest row of its trip: a clock at fault
SHOWN = 240  # rows that a page of a vehicle has


def _finite(x: float) -> float | None:
    return x if math.isfinite(x) else None


@dataclass
class Tracked:
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

    def again(self, kept: Kept) -> None:
        """Go on from there."""
        about, self.upto = kept.about, kept.upto
        if kept.numbers is not None:
            self.followed.again(about, kept.numbers, Adapter())
            self.followed.stream.continued = False  # what came twice is the journal's to say
        self.newest = tuple(about["newest"]) if about["newest"] else None
        self.used_s = -math.inf if about["used_s"] is None else about["used_s"]
        self.ended, self.refused = about["ended"], about["refused"]
        self.late, self.ahead, self.unused = (about[k] for k in ("late", "ahead", "unused"))
        self.last, self.recent = about["last"], about["recent"]

    def about(self) -> dict[str, Any]:
        """All but the numbers of the state, as plain values."""
        return {
            **(self.followed.about() if self.followed.live is not None else {}),
            "waiting": [s.seq for s in self.waiting], "newest": self.newest, "used_s": _finite(self.used_s),
            "ended": self.ended, "late": self.late, "ahead": self.ahead, "unused": self.unused, "refused": self.refused,
            "last": self.last, "recent": self.recent,
        }  # fmt: skip

    def take(self, sents: Sequence[Sent]) -> None:
        """Rows in the order in which they came; what follows does not depend on how many come at once."""
        due: list[Sent] = []
        for sent in sents:
            self.upto = max(self.upto, sent.seq)
            self.since += 1
            if self.newest is not None and sent.trip != self.newest[0]:
                if sent.trip in self.ended:
                    self.late += 1
                    continue
                due += sorted(self.waiting, key=lambda s: s.time_s)
                self.ended.append(self.newest[0])
                self.waiting, self.newest, self.used_s = [], None, -math.inf
            if sent.time_s <= self.used_s or (self.newest is not None and sent.time_s <= self.newest[1] - ORDERED_S):
                self.late += 1
                continue
            if self.newest is not None and sent.time_s > self.newest[1] + FARTHEST_S:
                self.ahead += 1
                continue
            self.waiting.append(sent)
            if len(self.waiting) > MOST_WAITING:
                self.waiting.sort(key=lambda s: s.time_s)
                first, self.waiting = self.waiting[: MOST_WAITING // 2], self.waiting[MOST_WAITING // 2 :]
                self.used_s = first[-1].time_s
                due += first
            if self.newest is None or sent.time_s > self.newest[1]:
                self.newest = (sent.trip, sent.time_s)
                until = sent.time_s - ORDERED_S
                ready = sorted((s for s in self.waiting if s.time_s <= until), key=lambda s: s.time_s)
                if ready:
                    self.used_s = ready[-1].time_s
                    self.waiting = [s for s in self.waiting if s.time_s > until]
                    due += ready
        self._use(due)

    def _use(self, due: Sequence[Sent]) -> None:
        records = [{**s.body, **({"trip_id": s.trip} if s.trip else {})} for s in due]
        for part in self._parts(records):
            try:
                arrived, now = self.followed.take(part)
                if now is not None:
                    shown = range(max(len(arrived) - SHOWN, 0), len(arrived))
                    told = [self._told(arrived[i], now, i) for i in shown]
                    self.recent = [*self.recent, *told][-SHOWN:]
                    self.last = self.recent[-1] | self._known(arrived[-1], now.row(-1))
                self.refused = None
            except InputError as e:
                sheet = str(self.followed.sheet.path)  # no path of this machine goes to a client
                self.refused = str(e).removeprefix("standard input: ").replace(sheet, Path(sheet).name)
                self.unused += len(part)
            except Exception as e:  # a row that nothing foresaw is counted, and no start fails by it
                self.refused = f"{len(part)} rows could not be used ({type(e).__name__})"
                self.unused += len(part)

    def _parts(self, records: list[dict[str, Any]]) -> Iterator[list[dict[str, Any]]]:
        """Runs of rows with the same fields: what a row is taken for depends on its own alone, not on its batch."""
        first = 0
        while self.followed.live is None and first < len(records):  # the first row says which columns there are
            first += 1
            yield [records[first - 1]]
        for _, run in itertools.groupby(records[first:], key=lambda r: tuple(sorted(r))):
            yield list(run)

    def _told(self, arrived: Arrived, now: Now, i: int) -> dict[str, Any]:
        """A row as the page draws it."""
        at = self.followed.form.columns.index
        return {
            "time_s": plain(arrived.vector[at("time_s")]), "measured": plain(arrived.vector[at("measured")]),
            **{k: plain(getattr(now, k)[i]) for k in ("predicted", "lower", "upper")},
        }  # fmt: skip

    def _known(self, arrived: Arrived, now: Now) -> dict[str, Any]:
        """What the last row left."""
        form = self.followed.form
        each = zip(form.names, now.values, now.sd, strict=True)
        return {
            "trip_id": arrived.trip, "sigma": plain(now.sigma), "unit": form.unit,
            "values": {n: [plain(v), plain(s)] for n, v, s in each},
        }  # fmt: skip

    # --- what is known -----------------------------------------------------------------------------------------------

    def known(self, name: str) -> dict[str, Any]:
        """What is known of it now, as plain values."""
        if self.shown is None or self.shown[0] != self.upto:
            alarm = self.followed.alarm()
            told = {
                "vehicle_id": name, "sheet": self.followed.sheet.name, **self.last,
                "alarm": None if alarm is None else plain_alarm(alarm) | {"text": alarm.line()},
                "rows": {
                    **self.followed.counted(), "late": self.late, "far ahead": self.ahead, "not usable": self.unused,
                    "waiting": len(self.waiting),
                },
                "notes": self.followed.notes, "refused": self.refused,
            }  # fmt: skip
            self.shown = self.upto, told
        return self.shown[1]

    def forecast(self, rows: Sequence[Mapping[str, Any]], **battery: Any) -> dict[str, Any]:
        """Energy of rows to come, and what of the battery is left. Raises `RefusedError` before a first row."""
        if self.followed.live is None:
            raise RefusedError(["rows"], "no row of this vehicle has been used yet; send its trip first")
        state, trips = self.followed.live.state, self.followed.stream.trips
        vectors, so_far = [], self.followed.stream.so_far
        at = {c: float(x) for c, x in zip(state.form.columns, np.asarray(state.last), strict=True)}
        time = at["time_s"] + at["duration_s"]  # of the trip, as the state counts it
        for i, row in enumerate(rows):
            for key in ("duration_s", "speed_start_mps", "speed_end_mps"):
                value = row.get(key)
                if value is None or value < 0 or (key == "duration_s" and value == 0):
                    raise RefusedError(["rows", i, key], "a number above 0 is expected: rows to come are intervals")
            known = {k: float(x) for k, x in row.items() if isinstance(x, int | float)}
            known["time_s"], time = time, time + known["duration_s"]
            so_far, running = so_far.after(known)
            vectors.append(Arrived.of(state.form, trips[-1], len(trips), known | running).vector)
        reserve = battery.pop("reserve", 0.0)
        if battery.get("capacity_wh") is None:
            battery["capacity_wh"] = self.followed.sheet.capacity_wh
        try:
            told = forecast(state, np.stack(vectors), **battery)
        except ValueError as e:
            raise RefusedError(["rows"], str(e)) from e
        end = told.soc_at_end
        return {
            "energy_wh": told.energy_wh, "interval_wh": list(told.interval_wh), "level": told.level,
            "soc_at_end": None if end is None else list(end), "chance_of_arriving": told.chance_of_arriving(reserve),
        }  # fmt: skip
