"""One vehicle followed: its rows by header in, what is known after each out; its state for the next start."""

import dataclasses
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from hdev_jax.inference.sheet import Sheet, augmented_sheet
from hdev_jax.logs.adapter import Adapter
from hdev_jax.online.form import Form
from hdev_jax.online.live import Live
from hdev_jax.online.state import Now, State, start
from hdev_jax.online.stream import Arrived, Stream, channels_of, target_in
from hdev_jax.online.watch import Alarm, Watch

__all__ = ["Followed", "plain", "plain_alarm"]


MOST_BEGUN = 32
_BEGUN: dict[Any, tuple[State, Watch | None, list[str]]] = {}  # vehicles of one sheet begin alike


class Followed:
    """The estimator of one vehicle, begun by its first row: which columns rows have decides what is estimated.

    `stream` puts rows in order and counts them, `live` holds the state (None before the first row), `notes` say what
    of the sheet is not used.
    """

    def __init__(self, sheet: Sheet, rules: Adapter | None = None, target: str | None = None, *, watch: bool = True):
        self.sheet: Sheet = sheet
        self.target: str | None = target
        self.watching: bool = watch
        self.stream: Stream = Stream() if rules is None else Stream(rules)
        self.live: Live | None = None
        self.watch: Watch | None = None
        self.columns: list[str] = []
        self.notes: list[str] = []
        self.began: Callable[[], None] = lambda: None  # called once the state is there

    @property
    def form(self) -> Form:
        """What rows are. Raises `ValueError` before the first one."""
        if self.live is None:
            raise ValueError("no row has come yet")
        return self.live.form

    def begin(self, names: Iterable[str]) -> None:
        """The state, once it is known which columns rows have. Raises `InputError`."""
        self.columns = sorted(names)
        self.target = target_in(self.columns, self.target)
        known = tuple(self.sheet.library.values())
        key = (augmented_sheet(self.sheet, {}, {}), tuple(self.columns), self.target, self.watching, known)
        if key in _BEGUN:
            state, self.watch, self.notes = _BEGUN[key]
        else:
            if len(_BEGUN) >= MOST_BEGUN:
                _BEGUN.pop(next(iter(_BEGUN)))
            state, self.watch, self.notes = _BEGUN[key] = self._begun()
        if (trim := self.stream.rules.edge_trim_s) > 0:
            said = f"edge_trim_s: {trim:g} s at the start of each trip are left out; where a trip ends is not known"
            self.notes = [*self.notes, said]
        self.live = Live(state)
        self.began()

    def _begun(self) -> tuple[State, Watch | None, list[str]]:
        """The state before the first row, what is watched beside it, and notes."""
        channels = channels_of(self.columns, self.sheet.library)
        state, notes = start(self.sheet, channels, self.target)  # type: ignore[arg-type]
        watch = Watch.of(state, self.sheet.library) if self.watching else None
        if watch is not None:
            state, _ = start(self.sheet, channels, self.target, candidates=watch.candidates)  # type: ignore[arg-type]
        if "grade_rad" not in channels and state.vehicle.entry == "road":
            notes.append("the rows have no slope (grade_rad): the road is taken as level")
        return state, watch, notes

    def take(self, records: Iterable[Mapping[str, Any] | None]) -> tuple[list[Arrived], Now | None]:
        """Some rows by header, in order; None for one that does not read. Raises `InputError` where none reads.

        **Returns:** the rows that were used, and what is known after each (first axis: the row), or None.
        """
        records = list(records)
        self.stream.unreadable += sum(r is None for r in records)
        read = self.stream.read([r for r in records if r is not None])
        return self._used(self.stream.intervals(self._seen(read)))

    def end(self) -> tuple[list[Arrived], Now | None]:
        """The row that waits for the next one, where none follows."""
        return self._used(self.stream.flush())

    def _seen(self, rows: list[tuple[str, dict[str, float]]]) -> Iterator[tuple[str, dict[str, float]]]:
        for trip, row in rows:
            if self.live is None:
                self.begin(row)
            yield trip, row

    def _used(self, rows: Iterable[tuple[int, dict[str, float]]]) -> tuple[list[Arrived], Now | None]:
        found = list(rows)
        if self.live is None or not found:
            return [], None
        arrived = [Arrived.of(self.form, self.stream.trips[n - 1], n, row) for n, row in found]
        vectors = np.stack([a.vector for a in arrived])
        return arrived, self.live.rows(vectors, None if self.watch is None else self.watch.columns(vectors))

    def alarm(self) -> Alarm | None:
        """What the sheet lacks, once that is certain."""
        return None if self.watch is None or self.live is None else self.watch.alarm(self.live.state)

    def counted(self) -> dict[str, int]:
        """What became of the rows; what never happened is left out."""
        every = {} if self.live is None else self.live.state.counted()
        every = every | {k: getattr(self.stream, k) for k in ("repeated", "unreadable", "trimmed", "alone")}
        return {name: n for name, n in every.items() if n}

    # --- kept between two starts -------------------------------------------------------------------------------------

    def about(self) -> dict[str, Any]:
        """All but the numbers, as plain values."""
        return {"columns": self.columns, "watch": self.watching, "target": self.target, "stream": self.stream.about()}

    def again(self, about: Mapping[str, Any], numbers: Float[np.ndarray, " number"], rules: Adapter) -> None:
        """Go on from there. Raises `KeyError` or `TypeError` for what `about` did not give, `ValueError` for numbers of
        another state."""
        self.stream = Stream.again(about["stream"], rules)
        self.target = about["target"]
        self.begin(about["columns"])
        assert self.live is not None
        self.live.numbers = numbers


def plain(x: Any) -> float | None:
    """A number as JSON has it."""
    value = float(x)
    return value if np.isfinite(value) else None


def plain_alarm(found: Alarm) -> dict[str, Any]:
    """An alarm as JSON has it."""
    return {k: plain(v) if isinstance(v, float) else v for k, v in dataclasses.asdict(found).items()}
