"""Databases of CAN messages (DBC, ARXML, KCD, SYM): which frame is which message, and its signals as channels."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from hdev_jax.errors import InputError
from hdev_jax.logs.ledger import Ledger
from hdev_jax.logs.readers.libraries import library
from hdev_jax.logs.readers.raw import Channel
from hdev_jax.logs.readers.signals.bits import physical
from hdev_jax.logs.readers.signals.frames import Identifier, Recording, forward

__all__ = ["FMS", "Database", "channels_of_frames"]

FMS = Path(__file__).parents[2] / "presets" / "fms.dbc"
_NULL_ADDRESS = 0xFE  # SAE J1939-81: the address of no sender, which databases write where any sender is meant
_BROADCAST = 240  # SAE J1939-21: from this PDU format on, the specific byte is part of the parameter group's number


@dataclass(frozen=True)
class Database:
    """Messages by the identifier of their frames, those of SAE J1939 by their parameter group, whoever sends them."""

    names: tuple[str, ...]
    exact: dict[tuple[int, bool], Any]
    groups: dict[int, Any]

    @staticmethod
    def load(paths: tuple[str, ...], log: Path) -> "Database":
        """Read databases. Raises `InputError` for a file that is missing or none, and without the library."""
        cantools = library("cantools", log, "can")
        exact: dict[tuple[int, bool], Any] = {}
        groups: dict[int, Any] = {}
        for path in paths:
            try:
                found = cantools.database.load_file(path, strict=False).messages
            except OSError as e:
                raise InputError(f"{path}: the database cannot be read ({e.strerror or e})") from None
            except Exception as e:  # cantools has an error for each format, and lets its parsers' through
                raise InputError(f"{path}: no database of CAN messages ({str(e)[:120]})") from None
            for m in found:
                exact.setdefault((m.frame_id, m.is_extended_frame), m)
                if _is_j1939(m):
                    groups.setdefault(_group(m.frame_id), m)
        if not exact:
            raise InputError(f"{', '.join(paths)}: a database without messages")
        return Database(tuple(Path(p).name for p in paths), exact, groups)

    def message(self, number: int, extended: bool) -> Any | None:
        """The message of a frame, None where the database has none."""
        found = self.exact.get((number, extended))
        return found if found is not None or not extended else self.groups.get(_group(number))


def _is_j1939(message: Any) -> bool:
    """Whether a message is one of SAE J1939, which says what stands for "not available" and "error"."""
    return message.is_extended_frame and (message.protocol == "j1939" or message.frame_id & 0xFF == _NULL_ADDRESS)


def _group(number: int) -> int:
    """The parameter group's number of a 29 bit identifier; a destination is no part of it."""
    group = number >> 8 & 0x3FFFF
    return group if group >> 8 & 0xFF >= _BROADCAST else group & 0x3FF00


def channels_of_frames(
    recording: Recording, database: Database, wanted: Callable[[str], bool], ledger: Ledger, file: str
) -> tuple[dict[str, Channel], Ledger]:
    """The signals of a recording as channels: by their own names, `Message.Signal` where several messages have one.

    Of a signal that several senders or buses have, the one with the most values is taken and the others are counted.
    Raises `InputError` where the recording's clock goes back.
    """
    senders: dict[str, list[Identifier]] = {}
    messages: dict[str, Any] = {}
    for identifier in recording.identifiers:
        for time, _ in recording.of(identifier):
            forward(time, file)
        message: Any = database.message(identifier.number, identifier.extended)
        senders.setdefault(message.name, []).append(identifier)
        messages[message.name] = message
    names = [s.name for m in messages.values() for s in m.signals]
    channels: dict[str, Channel] = {}
    for title, message in messages.items():
        j1939 = _is_j1939(message)
        others = {s.name: s for s in message.signals}
        for signal in message.signals:
            name = signal.name if names.count(signal.name) == 1 else f"{title}.{signal.name}"
            if not (wanted(name) or wanted(signal.name)):
                continue
            load = [partial(_values, recording, i, signal, others, j1939) for i in senders[title]]
            if len(load) > 1:
                known = [int(np.isfinite(one()[1]).sum()) for one in load]
                best = max(range(len(load)), key=known.__getitem__)
                for i, n in zip(senders[title], known, strict=True):
                    if n and i != senders[title][best]:
                        why = f"{n} values of {i} beside the {known[best]} of {senders[title][best]}: left out"
                        ledger = ledger.add("noted", why, file=file, column=name)
                load = [load[best]]
            channels[name] = Channel(load[0], signal.unit or None)
    return channels, ledger


def _values(
    recording: Recording, identifier: Identifier, signal: Any, others: dict[str, Any], j1939: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Times and values of one signal; of a multiplexed one those of the frames that have it."""
    parts: list[tuple[np.ndarray, np.ndarray]] = []
    for time, data in recording.of(identifier):
        for rows in _runs(len(time)):
            t, x = time[rows], physical(signal, data[rows], others, j1939)
            if signal.multiplexer_ids is not None:
                t, x = t[np.isfinite(x)], x[np.isfinite(x)]
            parts.append((t, x))
    if not parts:
        return np.zeros(0), np.zeros(0)
    return np.concatenate([t for t, _ in parts]), np.concatenate([x for _, x in parts])


def _runs(n: int, size: int = 1_000_000) -> Iterator[slice]:
    """Runs of rows that are decoded at a time: their bits take eight times the memory of their bytes."""
    yield from (slice(k, k + size) for k in range(0, n, size))
