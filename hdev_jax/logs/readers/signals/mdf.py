"""ASAM MDF files (MF4): measured channels, and frames of a bus that were recorded as they are."""

import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from hdev_jax.errors import InputError
from hdev_jax.logs.ledger import Ledger
from hdev_jax.logs.readers.libraries import library
from hdev_jax.logs.readers.raw import Channel
from hdev_jax.logs.readers.signals.frames import Asked, Identifier, Recording, forward

__all__ = ["channels_of_mdf", "frames_of_mdf", "open_mdf"]

_FRAME = "CAN_DataFrame"
_DECODED = (_FRAME, "LIN_Frame")  # by asammdf, given a database
_BUS_EVENTS = ("CAN_", "LIN_", "ETH_", "FLX_", "MOST_")  # ASAM MDF, bus logging: names of its groups
_TIME = 1  # synchronisation by time; others count angles, metres or records
_RECORDS = 1_000_000  # frames looked at together
_TEXTS = (6, 7, 8, 9, 10, 11, 12, 13, 14)  # data types of MDF 4 that are texts, bytes, structures of a date


def open_mdf(path: Path) -> Any:
    """The file, open, with the channels that a database of its own decodes from its frames.

    Raises `InputError` where it is damaged, and without the library.
    """
    asammdf = library("asammdf", path, "can")
    with _silent_deletion():
        try:
            # frames are read whole where asammdf decodes them: only where it can
            mdf = asammdf.MDF(path, process_bus_logging=False)
            return asammdf.MDF(path) if _own_database(mdf) else mdf
        except Exception as e:  # asammdf's own, struct's, zlib's and more, by where the damage is
            why = str(e)[:120]
    raise InputError(f"{path}: truncated or damaged MDF file ({why})")


def _own_database(mdf: Any) -> bool:
    """Whether the file has a database attached to its frames."""
    channels = (c for group in mdf.groups for c in group.channels)
    return any(c.name in _DECODED and getattr(c, "attachment", None) is not None for c in channels)


@contextmanager
def _silent_deletion() -> Iterator[None]:
    """A reader that could not open its file fails again where Python deletes it, and would say so on the terminal."""
    hook, sys.unraisablehook = sys.unraisablehook, lambda _: None
    try:
        yield
    finally:
        sys.unraisablehook = hook


def channels_of_mdf(path: Path, mdf: Any, ledger: Ledger) -> tuple[dict[str, Channel], Ledger]:
    """The measured channels of a file by name, `Group.Name` where several groups have one."""
    found: list[tuple[str, str, int, int, str]] = []
    other = text = 0
    for g, group in enumerate(mdf.groups):
        if any(c.name.startswith(_BUS_EVENTS) for c in group.channels):
            continue
        master = mdf.masters_db.get(g)
        if master is None or getattr(group.channels[master], "sync_type", _TIME) != _TIME:
            other += len(group.channels)
            continue
        told = (getattr(group.channel_group, key, "") for key in ("acq_name", "comment"))
        title = next((text for text in told if text), f"group {g}")
        for i, c in enumerate(group.channels):
            if i == master:
                continue
            if c.data_type in _TEXTS and mdf.version >= "4":
                text += 1
                continue
            unit = getattr(c, "unit", "") or getattr(c.conversion, "unit", "") or ""
            found.append((c.name, title.strip(), g, i, unit.strip()))
    for count, why in ((other, "channels that are not over time"), (text, "channels of text or bytes")):
        if count:
            ledger = ledger.add("noted", f"{why}, left out: {count}", file=path.name)
    names = Counter(name for name, *_ in found)
    channels: dict[str, Channel] = {}
    for name, title, g, i, unit in found:
        full = name if names[name] == 1 else f"{title}.{name}"
        full = full if full not in channels else f"{title} ({g}).{name}"
        channels[full] = Channel(partial(_load, path, mdf, name, g, i), unit or None)
    return channels, ledger


def _load(path: Path, mdf: Any, name: str, group: int, index: int) -> tuple[np.ndarray, np.ndarray]:
    """One channel; what the file marks as invalid is NaN, a word of a table of words its number."""
    with _one_line(path):
        signal = mdf.select([(name, group, index)], ignore_value2text_conversions=True)[0]
    x = np.asarray(signal.samples)
    if x.ndim != 1 or x.dtype.kind not in "fiub":
        return np.zeros(0), np.zeros(0)
    x = x.astype(np.float64)
    if signal.invalidation_bits is not None:
        x = np.where(np.asarray(signal.invalidation_bits, bool), np.nan, x)
    time = np.asarray(signal.timestamps, np.float64)
    forward(time, path.name)
    return time, x


@contextmanager
def _one_line(path: Path) -> Iterator[None]:
    """Errors of the reader as one line."""
    try:
        yield
    except Exception as e:
        raise InputError(f"{path}: truncated or damaged MDF file ({str(e)[:120]})") from None


def frames_of_mdf(path: Path, mdf: Any, asked: Asked) -> Recording:
    """The CAN frames that the file recorded, a run of records at a time."""
    recording = Recording()
    for g, group in enumerate(mdf.groups):
        names = {c.name.rpartition(".")[2]: i for i, c in enumerate(group.channels) if c.name.startswith(f"{_FRAME}.")}
        if not {"ID", "DataBytes"} <= names.keys():
            continue
        for bus, number, extended, length, time, data in _records(path, mdf, g, names):
            both = np.stack([bus, number, extended, length], axis=1)
            kinds, of = np.unique(both, axis=0, return_inverse=True)
            for k, (b, n, e, size) in enumerate(kinds.tolist()):
                rows = of.ravel() == k
                if asked(n, bool(e)):
                    recording.extend(Identifier(b, n, bool(e)), time[rows], data[rows, :size])
                else:
                    recording.others[n, bool(e)] += int(rows.sum())
    return recording


def _records(path: Path, mdf: Any, group: int, names: dict[str, int]) -> Iterator[tuple[np.ndarray, ...]]:
    """Bus, identifier, whether it is extended, length, time and bytes of a group's frames."""
    total = mdf.groups[group].channel_group.cycles_nr
    for start in range(0, total, _RECORDS):
        count = min(_RECORDS, total - start)

        def get(name: str, start: int = start, count: int = count) -> Any:
            with _one_line(path):
                return mdf.get(group=group, index=names[name], raw=True, record_offset=start, record_count=count)

        number, data = get("ID"), np.asarray(get("DataBytes").samples, np.uint8)
        whole = np.asarray(number.samples, np.int64)
        extended = np.asarray(get("IDE").samples, np.int64) if "IDE" in names else (whole > 0x7FF).astype(np.int64)
        size = next((n for n in ("DataLength", "DLC") if n in names), None)
        length = np.asarray(get(size).samples, np.int64) if size else np.full(len(whole), data.shape[1])
        bus = (
            np.asarray(get("BusChannel").samples, np.int64) if "BusChannel" in names else np.zeros(len(whole), np.int64)
        )
        yield bus, whole & 0x1FFFFFFF, extended, np.minimum(length, data.shape[1]), number.timestamps, data
