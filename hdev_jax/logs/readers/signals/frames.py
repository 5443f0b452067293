"""CAN frames of a recording, of one identifier, bus and length together: arrays of times and bytes, nothing a frame."""

import struct
import zlib
from array import array
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from hdev_jax.errors import InputError
from hdev_jax.logs.readers.libraries import library

__all__ = ["Asked", "Identifier", "Recording", "forward", "read_frames"]

Asked = Callable[[int, bool], bool]
"""Whether frames of an identifier (and whether it is an extended one) are wanted."""

_BLF_SIZE_AT = 16  # of the header: what the file's size was when it was closed
_BLF_HEADER = 144
_LATE_S = 1.0  # frames wait for the bus for milliseconds; a recorder that begins anew goes back further


@dataclass(frozen=True)
class Identifier:
    """Frames that are of one message, of one sender: their bus, identifier, and whether it is an extended one."""

    bus: int
    number: int
    extended: bool

    def __str__(self) -> str:
        return f"0x{self.number:X} (bus {self.bus + 1})"


@dataclass
class Recording:
    """The frames asked for, by identifier and length: times [s] and bytes; how many others there were, by number; how
    many error and remote frames; whether the recorder never closed the file."""

    frames: dict[tuple[Identifier, int], tuple["array[float]", bytearray]] = field(default_factory=dict)
    others: Counter[tuple[int, bool]] = field(default_factory=Counter)
    faulty: int = 0
    cut: bool = False

    def add(self, identifier: Identifier, time: float, data: bytes) -> None:
        """One frame more."""
        key = identifier, len(data)
        if (kept := self.frames.get(key)) is None:
            kept = self.frames[key] = array("d"), bytearray()
        kept[0].append(time)
        kept[1].extend(data)

    def extend(self, identifier: Identifier, time: np.ndarray, data: np.ndarray) -> None:
        """Many frames of one length more: times `[frame]`, bytes `[frame, byte]`."""
        kept = self.frames.setdefault((identifier, data.shape[1]), (array("d"), bytearray()))
        kept[0].frombytes(np.ascontiguousarray(time, np.float64).tobytes())
        kept[1].extend(np.ascontiguousarray(data, np.uint8).tobytes())

    def of(self, identifier: Identifier) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Times `[frame]` and bytes `[frame, byte]` of an identifier, for each length."""
        for (other, length), (time, data) in self.frames.items():
            if other == identifier:
                yield np.frombuffer(time, np.float64), np.frombuffer(data, np.uint8).reshape(len(time), length)

    def count(self, identifier: Identifier) -> int:
        """How many frames of an identifier there are."""
        return sum(len(time) for (other, _), (time, _) in self.frames.items() if other == identifier)

    @property
    def identifiers(self) -> list[Identifier]:
        """Every identifier asked for that the recording has."""
        return list(dict.fromkeys(i for i, _ in self.frames))


def forward(time: np.ndarray, file: str) -> None:
    """Raises `InputError` where a clock [s] goes back: what follows is another recording, which would be mixed in."""
    if len(time) > 1 and (step := np.diff(time)).min() < -_LATE_S:
        i = int(step.argmin())
        back = f"from {time[i]:.10g} to {time[i + 1]:.10g} s"
        raise InputError(f"{file}: the clock goes back {back}: two recordings in one file? Split it")


def read_frames(path: Path, kind: str, asked: Asked) -> Recording:
    """The frames of a BLF or ASC file. Raises `InputError` where it is truncated or damaged, or its times cannot be
    read."""
    can = library("can", path, "can")
    recording = Recording()
    known: dict[tuple[int, bool], bool] = {}
    recording.cut = _is_cut(path, kind)
    try:
        reader = can.BLFReader(path) if kind == "blf" else can.ASCReader(path)
        with reader:
            for message in reader:
                _take(recording, message, asked, known)
    except (ValueError, IndexError, EOFError, OSError, struct.error, zlib.error, AssertionError, can.CanError) as e:
        total = sum(len(t) for t, _ in recording.frames.values()) + recording.others.total()
        why = str(e)[:80] or type(e).__name__
        raise InputError(f"{path}: truncated or damaged after {total} frames ({why})") from None
    if getattr(reader, "timestamps_format", None) == "relative":
        raise InputError(f"{path}: its times count from line to line; save it with 'timestamps absolute'")
    if not recording.frames and not recording.others:
        raise InputError(f"{path}: no CAN frame with data ({recording.faulty} error or remote frames)")
    return recording


def _take(recording: Recording, message: Any, asked: Asked, known: dict[tuple[int, bool], bool]) -> None:
    if message.is_error_frame or message.is_remote_frame:
        recording.faulty += 1
        return
    name = message.arbitration_id, message.is_extended_id
    if (wanted := known.get(name)) is None:
        wanted = known[name] = asked(*name)
    if not wanted:
        recording.others[name] += 1
        return
    bus = message.channel if isinstance(message.channel, int) else 0
    recording.add(Identifier(bus, *name), message.timestamp, bytes(message.data))


def _is_cut(path: Path, kind: str) -> bool:
    """Whether a file was never closed. Raises `InputError` where its end is missing: a BLF file that was closed knows
    how long it is; the last line of an ASC file has an end."""
    size = path.stat().st_size
    with path.open("rb") as f:
        head = f.read(4096)
        f.seek(max(size - 256, 0))
        tail = f.read()
    if kind == "asc":
        closed = b"end triggerblock" in tail.lower() or b"begin triggerblock" not in head.lower()
        if not closed and not tail.endswith(b"\n"):
            raise InputError(f"{path}: truncated: its last line ends early; fetch it again, or delete that line")
        return not closed
    told = int.from_bytes(head[_BLF_SIZE_AT : _BLF_SIZE_AT + 8], "little")
    if told > max(_BLF_HEADER, size):
        raise InputError(f"{path}: truncated: {size} bytes of {told}; fetch it again, or record it anew")
    return told <= _BLF_HEADER
