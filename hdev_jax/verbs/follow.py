"""The verb `follow`: rows of one vehicle as they arrive, what is known of it after each, and what its sheet lacks."""

import contextlib
import csv
import json as json_
import signal
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from hdev_jax.errors import InputError
from hdev_jax.inference.sheet import Sheet, augmented_sheet
from hdev_jax.logs.adapter import Adapter
from hdev_jax.logs.read import adapter_of
from hdev_jax.online import Now, Watch, start
from hdev_jax.online.live import Live, keep, kept
from hdev_jax.online.stream import Arrived, Stream, channels_of, target_in
from hdev_jax.verbs.opening import Effects, Vehicles, known_effects, sheet_of
from hdev_jax.verbs.predict import sheet_digest

__all__ = ["follow"]

SAVED_S = 5.0  # between two files of the state: what a power cut may cost
Records = Iterable[Mapping[str, Any]]


def follow(
    vehicle: Vehicles,
    rows: str | Path | Records | BinaryIO | None = None,
    state: str | Path | None = None,
    adapter: str | Path | Adapter | None = None,
    target: str | None = None,
    effects: Effects = None,
    json: bool = False,
    watch: bool = True,
) -> str | None:
    """Follow one vehicle row by row: energy of each row before it is measured, coefficients after it, alarms.

    Rows come as CSV (header first) or as JSON lines, in the columns of a log: intervals, or samples, which are told one
    row later, when it is known how long they lasted. What a row lacks keeps its last value; rows that cannot be used
    are counted, and told at the end.

    **Arguments:** `vehicle`: a sheet's path or a `Sheet`; `rows`: a file, mappings, or a stream of bytes (standard
    input by default); `state`: a file that keeps what is known, every few seconds and at the end: the same command goes
    on from it as if it had never stopped, and rows that it has had are left out. `json`: a line of JSON for each row.
    `watch`: name effects of the library that the sheet lacks.

    **Returns:** the estimates and what became of the rows, as text; None where each row was told as JSON. **Raises:**
    `InputError`.
    """
    sheet, rules = sheet_of(vehicle, known_effects(effects)), adapter_of(adapter)
    with _opened(rows) as source, _terminal(live=not json) as tell, _stopped_by_signal():
        following = _Following(sheet, rules, target, state, tell, json, watch)
        try:
            for batch in _batches(source):
                following.take(batch)
        except KeyboardInterrupt:
            pass
        following.end()
    return None if json else following.summary()


class _Following:
    """One run of the verb."""

    def __init__(
        self, sheet: Sheet, rules: Adapter, target: str | None, file: str | Path | None, tell: Callable[[str], None],
        as_json: bool, watch: bool,
    ):  # fmt: skip
        self.sheet, self.target, self.file, self.tell, self.as_json = sheet, target, file, tell, as_json
        self.watching, self.live, self.watch = watch, None, None
        self.notes: list[str] = []
        self.alarm: str | None = None
        self.saved = time.monotonic()
        self.digest = sheet_digest(augmented_sheet(sheet, {}, {}))
        self.numbers, self.about = None, {}
        with contextlib.suppress(FileNotFoundError):
            if file is not None:
                self.numbers, self.about = kept(file)
        if self.about and (self.about["sheet_sha256"] != self.digest or self.about["watch"] != watch):
            what = "another sheet" if self.about["watch"] == watch else "a run that watched other effects"
            raise InputError(f"--state {file}: of {what}; name another file, or delete it")
        self.stream = Stream.again(self.about["stream"], rules) if self.about else Stream(rules)
        if self.about:
            self._begin(self.about["columns"])

    def _begin(self, names: Iterable[str]) -> None:
        """The state, once it is known which columns rows have."""
        self.columns = sorted(names)
        self.target = target_in(self.columns, self.target)
        channels = channels_of(self.columns)
        state, self.notes = start(self.sheet, channels, self.target)  # type: ignore[arg-type]
        if self.watching:
            self.watch = Watch.of(state, self.sheet.library)
            state, _ = start(self.sheet, channels, self.target, candidates=self.watch.candidates)  # type: ignore[arg-type]
        if "grade_rad" not in channels and state.vehicle.entry == "road":
            self.notes.append("the rows have no slope (grade_rad): the road is taken as level")
        self.live = Live(state)
        if self.numbers is not None:
            try:
                self.live.numbers = self.numbers
            except ValueError:
                raise InputError(f"--state {self.file}: of another version; name another file, or delete it") from None
        if not self.as_json:
            for note in self.notes:
                self.tell(f"note: {note}")

    def take(self, records: list[Mapping[str, Any] | None]) -> None:
        """Some rows by header, in order; None for one that does not read."""
        self.stream.unreadable += sum(r is None for r in records)
        self._use(self.stream.intervals(self._seen(self.stream.read([r for r in records if r is not None]))))
        if self.file is not None and time.monotonic() - self.saved > SAVED_S:
            self._save()

    def _seen(self, rows: list[tuple[str, dict[str, float]]]) -> Iterator[tuple[str, dict[str, float]]]:
        for trip, row in rows:
            if self.live is None:
                self._begin(row)
            yield trip, row

    def _use(self, rows: Iterable[tuple[int, dict[str, float]]]) -> None:
        found = list(rows)
        if self.live is None or not found:
            return
        form = self.live.state.form
        arrived = [Arrived.of(form, self.stream.trips[n - 1], n, row) for n, row in found]
        each = [None] * len(arrived)
        if self.watch is not None:
            each = list(self.watch.columns(np.stack([a.vector for a in arrived])))
        for a, candidates in zip(arrived, each, strict=True):
            now = self.live(a.vector, candidates)
            self.tell(self._told(form, a, now))
            if now.alarm and self.alarm is None and self.watch is not None:
                self._alarmed()

    def _alarmed(self) -> None:
        assert self.live is not None
        assert self.watch is not None
        if (found := self.watch.alarm(self.live.state)) is not None:
            self.alarm = found.line()
            plain = {k: _number(v) if isinstance(v, float) else v for k, v in vars(found).items()}
            self.tell(json_.dumps({"alarm": plain}) if self.as_json else f"ALARM {self.alarm}")

    def _told(self, form: Any, a: Arrived, now: Now) -> str:
        by = dict(zip(form.columns, a.vector, strict=True))
        if self.as_json:
            told = ("predicted", "lower", "upper", "model", "energy_wh", "weight")
            plain = {k: _number(getattr(now, k)) for k in told}
            values = {n: [_number(v), _number(s)] for n, v, s in zip(form.names, now.values, now.sd, strict=True)}
            return json_.dumps(
                {"trip_id": a.trip, "time_s": _number(by["time_s"]), "measured": _number(by["measured"]), **plain,
                 "sigma": _number(now.sigma), "values": values}
            )  # fmt: skip
        each = zip(form.names, now.values, now.sd, strict=True)
        values = "  ".join(f"{n} {float(v):.4g} ± {float(s):.2g}" for n, v, s in each)
        return (
            f"{a.trip}  {by['time_s']:.1f} s  {by['measured']:.4g} {form.unit}, expected {float(now.predicted):.4g} "
            f"({float(now.lower):.4g} to {float(now.upper):.4g})  {values}"
        )

    def _save(self) -> None:
        if self.live is not None and self.file is not None:
            about = {"sheet_sha256": self.digest, "columns": self.columns, "watch": self.watching}
            keep(self.file, self.live, {**about, "stream": self.stream.about()})
            self.saved = time.monotonic()

    def end(self) -> None:
        """The last row, where nothing goes on from here; else the file."""
        if self.file is None:
            self._use(self.stream.flush())
        self._save()

    def summary(self) -> str:
        """What is known at the end."""
        if self.live is None:
            raise InputError("standard input: no rows; a header and rows of CSV, or JSON lines, are expected")
        state = self.live.state
        lines = [
            f"{name:32s} {float(v):12.6g} ± {float(s):.3g}"
            for name, v, s in zip(state.form.names, state.values, state.sd, strict=True)
        ]
        counted = state.counted() | {"repeated": self.stream.repeated, "unreadable": self.stream.unreadable}
        lines.append(", ".join(f"{n} {name}" for name, n in counted.items() if n))
        lines.append(
            f"noise of a row {float(state.sigma):.4g} {state.form.unit}, correlation {float(state.memory):.2f}"
        )
        if self.watch is not None and (found := self.watch.alarm(state)) is not None:
            lines.append(f"ALARM {found.line()}")
        return "\n".join(lines)


@contextlib.contextmanager
def _opened(rows: str | Path | Records | BinaryIO | None) -> Iterator[Records | BinaryIO]:
    """Where rows come from. Raises `InputError` for a file that cannot be read."""
    if rows is None:
        yield sys.stdin.buffer
    elif isinstance(rows, str | Path):
        try:
            file = open(rows, "rb")  # noqa: SIM115
        except OSError as e:
            raise InputError(f"{rows}: cannot be read ({e.strerror or e})") from e
        with file:
            yield file
    else:
        yield rows


def _number(x: Any) -> float | None:
    value = float(x)
    return value if np.isfinite(value) else None


def _batches(rows: Records | BinaryIO) -> Iterator[list[Mapping[str, Any] | None]]:
    """Rows by header as they come, all that are there at a time."""
    if not hasattr(rows, "read1"):
        yield [*rows]  # type: ignore[misc]
        return
    header: list[str] | None = None
    mark = ","
    for lines in _lines(rows):  # type: ignore[arg-type]
        found: list[Mapping[str, Any] | None] = []
        for line in lines:
            text = line.decode("utf-8", errors="replace").strip("\ufeff\r\n \0")
            if not text:
                continue
            if text.startswith("{"):
                found.append(_of_json(text))
            elif header is None:
                mark = ";" if text.count(";") > text.count(",") else ","
                header = next(csv.reader([text], delimiter=mark))
            else:
                cells = next(csv.reader([text], delimiter=mark))
                if cells != header:  # a source that began again sends its header again
                    found.append(dict(zip(header, cells, strict=True)) if len(cells) == len(header) else None)
        if found:
            yield found


def _of_json(text: str) -> Mapping[str, Any] | None:
    try:
        found = json_.loads(text)
    except ValueError:
        return None
    return found if isinstance(found, dict) else None


def _lines(stream: BinaryIO) -> Iterator[list[bytes]]:
    """Whole lines, all that have come since the last ones."""
    rest = b""
    while piece := stream.read1(1 << 16):  # type: ignore[attr-defined]
        *lines, rest = (rest + piece).split(b"\n")
        yield lines
    if rest:
        yield [rest]


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


@contextlib.contextmanager
def _stopped_by_signal() -> Iterator[None]:
    """A process that is asked to end saves first."""

    def stop(*_: Any) -> None:
        raise KeyboardInterrupt

    try:
        before = signal.signal(signal.SIGTERM, stop)
    except ValueError:  # not in the main thread
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
