"""What survives a kill: every acknowledged row, and each vehicle's state with the row that it has seen last.

SQLite with a write-ahead log. A row is committed before it is acknowledged; a state is written with the numbers of the
rows that it does not hold yet. After a kill the vehicle goes on from its last state with the rows since, in the order
in which they came: it ends as it would have without the kill.
"""

import io
import json
import sqlite3
import threading
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hdev_jax.errors import InputError

__all__ = ["Journal", "Kept", "Sent"]

SCHEMA = 1
_TABLES = """
CREATE TABLE IF NOT EXISTS rows (
    seq INTEGER PRIMARY KEY AUTOINCREMENT, fleet TEXT NOT NULL, vehicle TEXT NOT NULL, trip TEXT NOT NULL,
    time_s REAL NOT NULL, body TEXT NOT NULL, UNIQUE (fleet, vehicle, trip, time_s)
);
CREATE INDEX IF NOT EXISTS by_vehicle ON rows (fleet, vehicle, seq);
CREATE TABLE IF NOT EXISTS states (
    fleet TEXT NOT NULL, vehicle TEXT NOT NULL, upto INTEGER NOT NULL, about TEXT NOT NULL, numbers BLOB,
    PRIMARY KEY (fleet, vehicle)
);
"""


class Sent(NamedTuple):
    """A row as it was sent, and its place in the journal."""

    seq: int
    trip: str
    time_s: float
    body: dict[str, Any]


class Kept(NamedTuple):
    """A vehicle's state: all rows up to `upto` are in it, or in what `about` names as waiting."""

    upto: int
    about: dict[str, Any]
    numbers: np.ndarray | None


class Journal:
    """The file. All methods may be called from any thread. Raises `InputError` for a file that is something else."""

    def __init__(self, path: str | Path):
        self._lock = threading.Lock()
        try:
            self._db = sqlite3.connect(path, check_same_thread=False, isolation_level=None)
            self._db.execute("PRAGMA journal_mode = WAL")
            self._db.execute("PRAGMA synchronous = FULL")
            version = self._db.execute("PRAGMA user_version").fetchone()[0]
            if version not in (0, SCHEMA):
                raise InputError(f"--state {path}: of another version ({version}); name another file")
            self._db.executescript(_TABLES)
            self._db.execute(f"PRAGMA user_version = {SCHEMA}")
        except sqlite3.Error as e:
            raise InputError(f"--state {path}: no database of hdev serve ({e}); name another file") from e

    def put(self, fleet: str, rows: Sequence[tuple[str, str, float, dict[str, Any]]]) -> list[tuple[str, Sent]]:
        """Keep rows `(vehicle, trip, time_s, body)`, all or none. **Returns:** those that were not there already, with
        their vehicle: a row is the same where vehicle, trip and time are."""
        with self._lock:
            new = []
            self._db.execute("BEGIN IMMEDIATE")
            try:
                for vehicle, trip, time_s, body in rows:
                    done = self._db.execute(
                        "INSERT OR IGNORE INTO rows (fleet, vehicle, trip, time_s, body) VALUES (?, ?, ?, ?, ?)",
                        (fleet, vehicle, trip, time_s, json.dumps(body)),
                    )
                    if done.rowcount:
                        new.append((vehicle, Sent(int(done.lastrowid or 0), trip, time_s, body)))
                self._db.execute("COMMIT")
            except BaseException:
                self._db.execute("ROLLBACK")
                raise
        return new

    def vehicles(self) -> list[tuple[str, str]]:
        """`(fleet, vehicle)` of all that have sent a row."""
        with self._lock:
            return list(self._db.execute("SELECT DISTINCT fleet, vehicle FROM rows").fetchall())

    def kept(self, fleet: str, vehicle: str) -> Kept | None:
        """A vehicle's last state, None where it has none yet."""
        with self._lock:
            query = "SELECT upto, about, numbers FROM states WHERE fleet = ? AND vehicle = ?"
            found = self._db.execute(query, (fleet, vehicle)).fetchone()
        if found is None:
            return None
        numbers = None if found[2] is None else np.load(io.BytesIO(found[2]), allow_pickle=False)
        return Kept(found[0], json.loads(found[1]), numbers)

    def since(self, fleet: str, vehicle: str, upto: int, also: Iterable[int] = ()) -> Iterator[Sent]:
        """Rows after `upto`, and those whose number is in `also`, in the order in which they came."""
        waiting = {*also}
        with self._lock:
            found = self._db.execute(
                "SELECT seq, trip, time_s, body FROM rows WHERE fleet = ? AND vehicle = ? AND seq >= ? ORDER BY seq",
                (fleet, vehicle, min([*waiting, upto + 1])),
            ).fetchall()
        found = [row for row in found if row[0] > upto or row[0] in waiting]
        return (Sent(seq, trip, time_s, json.loads(body)) for seq, trip, time_s, body in found)

    def keep(self, states: Sequence[tuple[str, str, Kept]]) -> None:
        """Write states, all or none."""
        lines = []
        for fleet, vehicle, kept in states:
            blob = None
            if kept.numbers is not None:
                file = io.BytesIO()
                np.save(file, kept.numbers)
                blob = file.getvalue()
            lines.append((fleet, vehicle, kept.upto, json.dumps(kept.about), blob))
        with self._lock:
            self._db.execute("BEGIN IMMEDIATE")
            self._db.executemany("INSERT OR REPLACE INTO states VALUES (?, ?, ?, ?, ?)", lines)
            self._db.execute("COMMIT")

    def close(self) -> None:
        """No more calls after this."""
        with self._lock:
            self._db.close()
