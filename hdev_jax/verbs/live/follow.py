"""The verb `follow`: rows of one vehicle as they arrive, what is known of it after each, and what its sheet lacks."""

import contextlib
import json as json_
import signal
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

from hdev_jax import progress
from hdev_jax.diagnosis.candidates.own import Effects, known_effects
from hdev_jax.errors import InputError
from hdev_jax.inference.sheet import Sheet, augmented_sheet
from hdev_jax.logs.adapter import Adapter
from hdev_jax.logs.read import adapter_of
from hdev_jax.online import Now
from hdev_jax.online.followed import Followed, plain, plain_alarm
from hdev_jax.online.live import keep, kept
from hdev_jax.online.stream import Arrived
from hdev_jax.verbs.live.lines import Batch, Records, batches, opened
from hdev_jax.verbs.live.mqtt import Topic, subscribed
from hdev_jax.verbs.opening import Vehicles, sheet_of
from hdev_jax.verbs.predict import sheet_digest

__all__ = ["follow"]

INPUT = "standard input"  # where rows come from, in messages
SAVED_S = 5.0  # between two files of the state: what a power cut may cost


def follow(
    vehicle: Vehicles,
    rows: str | Path | Records | BinaryIO | None = None,
    state: str | Path | None = None,
    adapter: str | Path | Adapter | None = None,
    target: str | None = None,
    effects: Effects = None,
    json: bool = False,
    watch: bool = True,
    mqtt: str | None = None,
) -> str | None:
    """Follow one vehicle row by row: energy of each row before it is measured, coefficients after it, alarms.

    Rows come as CSV (header first) or as JSON lines, in the columns of a log. A row is an interval or a sample; a
    sample is used one row later, when its length is known. A channel that a row lacks keeps its last value. Rows that
    cannot be used are counted and listed at the end.

    **Arguments:**

    - `vehicle`: a sheet's path or a `Sheet`.
    - `rows`: a file, mappings, or a stream of bytes; by default standard input.
    - `state`: a file in which the estimates are saved every few seconds and at the end. The same command continues from
      it as if it had never stopped, and skips rows that it has seen.
    - `json`: write a line of JSON for each row.
    - `watch`: name effects of the library that the sheet lacks.
    - `mqtt`: `mqtt://HOST:PORT/TOPIC` instead of `rows`; a message is a row as JSON, or a list of rows. It runs until
      it is stopped.

    **Returns:** the estimates and the counts of rows as text; None where each row was written as JSON. **Raises:**
    `InputError`.
    """
    sheet, rules = sheet_of(vehicle, known_effects(effects)), adapter_of(adapter)
    if mqtt is not None and rows is not None:
        raise InputError("--mqtt: rows come from a topic or from a file; leave one of them out")
    with contextlib.ExitStack() as stack:
        stop, tell = stack.enter_context(_stopped_by_signal()), stack.enter_context(_terminal(live=not json))
        following = _Following(sheet, rules, target, state, tell, json, watch)
        if mqtt is None:
            named = str(rows) if isinstance(rows, str | Path) else INPUT
            source = batches(stack.enter_context(opened(rows)), again=state is not None, waiting=stop.waiting)
        else:
            following.topic = topic = stack.enter_context(subscribed(mqtt, state))
            topic.again = following.began_again
            named, source = topic.place.shown, topic.batches(stop.waiting)
        whole = True
        try:
            with contextlib.suppress(KeyboardInterrupt):
                for batch in source:
                    whole = False
                    following.take(batch)
                    whole = True
            if not whole:  # asked twice: rows are half used, and the file stays as it was
                return None if json else "stopped within a batch of rows; --state holds what was saved before"
            following.end()
            return None if json else following.summary()
        except InputError as e:
            if str(e).startswith(INPUT):
                raise InputError(f"{named}{str(e).removeprefix(INPUT)}") from None
            raise


class _Following:
    """One run of the verb."""

    def __init__(
        self, sheet: Sheet, rules: Adapter, target: str | None, file: str | Path | None, tell: Callable[[str], None],
        as_json: bool, watch: bool,
    ):  # fmt: skip
        self.file, self.tell, self.as_json, self.asked = file, tell, as_json, target
        self.alarmed = self.refused = False
        self.topic: Topic | None = None  # that rows come from, if not from a stream
        self.saved = time.monotonic()
        self.digest = sheet_digest(augmented_sheet(sheet, {}, {}))
        self.vehicle = Followed(sheet, rules, target, watch=watch)
        self.vehicle.began = self._noted
        with contextlib.suppress(FileNotFoundError):
            if file is not None:
                self._again(*kept(file), rules)

    def _again(self, numbers: Any, about: Mapping[str, Any], rules: Adapter) -> None:
        """Go on from the file of a state. Raises `InputError` where it is of another run."""
        try:
            digest, watched, target = (about[k] for k in ("sheet_sha256", "watch", "target"))
            if digest != self.digest:
                raise self._other("another sheet")
            if watched != self.vehicle.watching:
                raise self._other("a run that watched other effects")
            if self.asked not in (None, target):
                raise self._other(f"a run whose target is {target}")
            self.vehicle.again(about, numbers, rules)
        except (KeyError, TypeError, ValueError) as e:
            raise self._other("another version") from e

    def _other(self, what: str) -> InputError:
        return InputError(f"--state {self.file}: of {what}; name another file, or delete it")

    def _noted(self) -> None:
        if not self.as_json:
            for note in self.vehicle.notes:
                self.tell(f"note: {note}")

    def take(self, records: Batch) -> None:
        """Some rows by header, in order; None for one that does not read."""
        first = 0
        while self.topic is not None and self.vehicle.live is None and first < len(records):
            self._first(records[first], self.topic)
            first += 1
        self._use(self.vehicle.take(records[first:]))
        full = self.topic is not None and self.topic.full
        if self.file is None or full or time.monotonic() - self.saved > SAVED_S:
            self._save()

    def _first(self, record: Mapping[str, Any] | None, topic: Topic) -> None:
        """What may be the first row of a topic: whatever else was sent there before must not end the run, each time."""
        try:
            self._use(self.vehicle.take([record]))
        except InputError as e:
            self.vehicle.stream.unreadable += 1
            if not self.refused:
                self.refused = True
                progress.step(f"{topic.place.shown}{str(e).removeprefix(INPUT)}; waiting for other rows")

    def _use(self, rows: tuple[list[Arrived], Now | None]) -> None:
        arrived, known = rows
        for i, a in enumerate(arrived):
            assert known is not None
            now = known.row(i)
            self.tell(self._told(self.vehicle.form, a, now))
            if now.alarm and not self.alarmed and (found := self.vehicle.alarm()) is not None:
                self.alarmed = True
                self.tell(json_.dumps({"alarm": plain_alarm(found)}) if self.as_json else f"ALARM {found.line()}")

    def _told(self, form: Any, a: Arrived, now: Now) -> str:
        by = dict(zip(form.columns, a.vector, strict=True))
        if self.as_json:
            told = ("predicted", "lower", "upper", "model", "energy_wh", "weight")
            own = {k: plain(getattr(now, k)) for k in told}
            values = {n: [plain(v), plain(s)] for n, v, s in zip(form.names, now.values, now.sd, strict=True)}
            return json_.dumps(
                {"trip_id": a.trip, "time_s": plain(by["time_s"]), "measured": plain(by["measured"]), **own,
                 "sigma": plain(now.sigma), "values": values}
            )  # fmt: skip
        each = zip(form.names, now.values, now.sd, strict=True)
        values = "  ".join(f"{n} {float(v):.4g} ± {float(s):.2g}" for n, v, s in each)
        return (
            f"{a.trip}  {by['time_s']:.1f} s  {by['measured']:.4g} {form.unit}, expected {float(now.predicted):.4g} "
            f"({float(now.lower):.4g} to {float(now.upper):.4g})  {values}"
        )

    def _save(self) -> None:
        if self.vehicle.live is not None and self.file is not None:
            keep(self.file, self.vehicle.live, {"sheet_sha256": self.digest, **self.vehicle.about()})
        if self.topic is not None:
            self.topic.kept()
        self.saved = time.monotonic()

    def began_again(self) -> None:
        """What comes next may have been there."""
        self.vehicle.stream.continued = True

    def end(self) -> None:
        """The last row, where nothing goes on from here; else the file."""
        if self.file is None:
            self._use(self.vehicle.end())
        self._save()

    def summary(self) -> str:
        """What is known at the end."""
        if self.vehicle.live is None:
            expected = "a header and rows of CSV, or JSON lines, are expected"
            if self.topic is not None:
                expected = "messages of JSON, a row or a list of rows each, are expected"
            raise InputError(f"{INPUT}: no rows; {expected}")
        state = self.vehicle.live.state
        lines = [
            f"{name:32s} {float(v):12.6g} ± {float(s):.3g}"
            for name, v, s in zip(state.form.names, state.values, state.sd, strict=True)
        ]
        lines.append(", ".join(f"{n} {name}" for name, n in self.vehicle.counted().items()))
        lines.append(
            f"noise of a row {float(state.sigma):.4g} {state.form.unit}, correlation {float(state.memory):.2f}"
        )
        if (found := self.vehicle.alarm()) is not None:
            lines.append(f"ALARM {found.line()}")
        return "\n".join(lines)


@contextlib.contextmanager
def _terminal(*, live: bool) -> Iterator[Callable[[str], None]]:
    """What becomes of a line: on a terminal one line that lives, elsewhere a line each."""
    if live and sys.stdout.isatty():
        from rich.console import Console
        from rich.live import Live as Shown
        from rich.text import Text

        with Shown(console=Console(highlight=False), refresh_per_second=8, transient=True) as shown:

            def tell(line: str) -> None:
                if line.startswith(("ALARM", "note:")):
                    shown.console.print(Text(line))
                else:
                    shown.update(Text(line, overflow="ellipsis", no_wrap=True))

            yield tell
    else:

        def write(line: str) -> None:
            sys.stdout.write(line + "\n")
            sys.stdout.flush()

        yield write


class _Stop:
    """Ctrl-C, or to be asked to end: at once while rows are waited for, else when those that are there have been used,
    so that what is saved is whole. Asked twice: at once."""

    def __init__(self) -> None:
        self.now, self.asked = False, False

    def __call__(self, *_: Any) -> None:
        if self.now or self.asked:
            raise KeyboardInterrupt
        self.asked = True

    @contextlib.contextmanager
    def waiting(self) -> Iterator[None]:
        """Around what waits for rows."""
        self.now = True
        try:
            if self.asked:
                raise KeyboardInterrupt
            yield
        finally:
            self.now = False


@contextlib.contextmanager
def _stopped_by_signal() -> Iterator[_Stop]:
    """A process that is asked to end saves first."""
    stop, before = _Stop(), {}
    with contextlib.suppress(ValueError):  # not in the main thread
        before[signal.SIGTERM] = signal.signal(signal.SIGTERM, stop)
        if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # else it is to be left alone
            before[signal.SIGINT] = signal.signal(signal.SIGINT, stop)
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
