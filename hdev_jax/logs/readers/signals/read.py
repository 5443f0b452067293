"""A recording's signals, by name: MF4, BLF and ASC, frames decoded by a database."""

from pathlib import Path

import pandas as pd

from hdev_jax.errors import InputError
from hdev_jax.logs.adapter import Adapter
from hdev_jax.logs.ledger import Ledger
from hdev_jax.logs.readers.names import trip_of
from hdev_jax.logs.readers.raw import Channel, Raw
from hdev_jax.logs.readers.signals.database import FMS, Database, channels_of_frames
from hdev_jax.logs.readers.signals.frames import Recording, read_frames
from hdev_jax.logs.readers.signals.mdf import channels_of_mdf, frames_of_mdf, open_mdf
from hdev_jax.units import known_stem, parse_column

__all__ = ["read_signals"]

_MAGIC = {"mf4": (b"MDF     ", b"UnFinMF "), "blf": (b"LOGG",), "asc": ()}


def read_signals(path: Path, kind: str, adapter: Adapter) -> Raw:
    """The channels of a file. Frames are decoded by the databases of the adapter; without one, by what SAE J1939 and
    the FMS standard say.

    Raises `InputError` for a file that is damaged or not of its kind, without the libraries that read it, and where
    the database has none of its frames.
    """
    _check(path, kind)
    ledger, channels = Ledger(), dict[str, Channel]()
    if kind == "mf4":
        mdf = open_mdf(path)
        channels, ledger = channels_of_mdf(path, mdf, ledger)
    if not channels or adapter.dbc:
        database = Database.load(adapter.dbc or (str(FMS),), path)

        def asked(number: int, extended: bool) -> bool:
            message = database.message(number, extended)
            return message is not None and any(
                _wanted(n, adapter) for s in message.signals for n in (s.name, f"{message.name}.{s.name}")
            )

        recording = frames_of_mdf(path, mdf, asked) if kind == "mf4" else read_frames(path, kind, asked)
        decoded, ledger = _decoded(path, recording, database, adapter, ledger)
        channels |= decoded
    if not channels:
        raise InputError(f"{path}: no channel over time and no CAN frame")
    return Raw(path.name, pd.DataFrame(), trip_of(path, adapter), ledger=ledger, channels=channels, asked_only=True)


def _decoded(
    path: Path, recording: Recording, database: Database, adapter: Adapter, ledger: Ledger
) -> tuple[dict[str, Channel], Ledger]:
    others, ids = recording.others.total(), len(recording.others)
    if others:
        why = f"frames that {' and '.join(database.names)} lacks or no rule names, left out"
        ledger = ledger.add("noted", f"{why}: {others} (identifiers: {ids})", file=path.name)
    if recording.faulty:
        ledger = ledger.add("noted", f"error and remote frames, left out: {recording.faulty}", file=path.name)
    if recording.cut:
        ledger = ledger.add("noted", "never closed by its recorder: its end may be missing", file=path.name)
    if not recording.frames:
        shown = ", ".join(f"0x{n:X}" for (n, _), _ in recording.others.most_common(5)) or "none"
        if adapter.dbc:
            what = f"{' and '.join(database.names)} names none of its frames, or no rule names their signals"
        else:
            what = 'no frame of SAE J1939 that is known: name the database, dbc = "….dbc", in an adapter'
        raise InputError(f"{path}: {what}; the most frequent are {shown}")
    return channels_of_frames(recording, database, lambda n: _wanted(n, adapter), ledger, path.name)


def _wanted(name: str, adapter: Adapter) -> bool:
    """Whether a signal is read: one that a rule names, or whose name is the contract's; without rules every one."""
    if not adapter.columns or adapter.others == "keep":
        return True
    if any(name in (*r.sources, *r.alternatives) for r in adapter.columns.values()):
        return True
    try:
        return parse_column(name).known or known_stem(name) is not None
    except InputError:  # told where columns are translated
        return True


def _check(path: Path, kind: str) -> None:
    try:
        with path.open("rb") as f:
            head = f.read(8)
    except OSError as e:
        raise InputError(f"{path}: cannot be read ({e.strerror or e})") from None
    if not head:
        raise InputError(f"{path}: empty file")
    if (_MAGIC[kind] and not head.startswith(_MAGIC[kind])) or (kind == "asc" and b"\0" in head):
        raise InputError(f"{path}: its ending says {path.suffix}, its content is not")
