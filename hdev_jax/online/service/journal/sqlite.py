"""A file of SQLite, with a write-ahead log that is synced before a transaction ends."""

import json
import sqlite3
import threading
import weakref
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hdev_jax.errors import InputError
from hdev_jax.online.service.journal.database import Row, Run, Types, UnavailableError

__all__ = ["SqliteFile"]


class SqliteFile:
    """The file. Raises `InputError` for one that is something else."""

    types: Types = Types("INTEGER PRIMARY KEY AUTOINCREMENT", "BLOB", "")

    def __init__(self, path: str | Path):
        self.shown: str = str(path)
        self._lock = threading.Lock()
        db: sqlite3.Connection | None = None
        try:
            db = sqlite3.connect(path, check_same_thread=False, isolation_level=None)
            db.execute("PRAGMA journal_mode = WAL")
            db.execute("PRAGMA synchronous = FULL")
            self._db: sqlite3.Connection = db
        except sqlite3.Error as e:
            if db is not None:
                db.close()
            raise InputError(f"--state {path}: no database of hdev serve ({e}); name another file") from e
        weakref.finalize(self, db.close)  # also where nobody closes it

    @contextmanager
    def transaction(self) -> Iterator[Run]:
        """All or nothing, one at a time; on the disk once the block has ended."""
        with self._using():
            self._db.execute("BEGIN IMMEDIATE")
            try:
                yield self._run
                self._db.execute("COMMIT")
            except BaseException:
                if self._db.in_transaction:
                    self._db.execute("ROLLBACK")
                raise

    def read(self, statement: str, parameters: Sequence[Any] = ()) -> list[tuple[Any, ...]]:
        """What a SELECT finds, outside a transaction."""
        with self._using():
            return self._run(statement, parameters)

    def insert(self, run: Run, fleet: str, rows: Sequence[Row]) -> list[tuple[int, int]]:
        """Keep rows that are not there yet. **Returns:** of each that was new its number and its place in `rows`."""
        new = []
        for i, (vehicle, trip, time_s, body) in enumerate(rows):
            done = self._db.execute(
                "INSERT OR IGNORE INTO rows (fleet, vehicle, trip, time_s, body) VALUES (?, ?, ?, ?, ?)",
                (fleet, vehicle, trip, time_s, json.dumps(body)),
            )
            if done.rowcount:
                new.append((int(done.lastrowid or 0), i))
        return new

    def close(self) -> None:
        """No more calls after this."""
        with self._lock:
            self._db.close()

    def _run(self, statement: str, parameters: Sequence[Any] = ()) -> list[tuple[Any, ...]]:
        return self._db.execute(statement, parameters).fetchall()

    @contextmanager
    def _using(self) -> Iterator[None]:
        with self._lock:
            try:
                yield
            except sqlite3.Error as e:  # no space left, another program that holds the file
                raise UnavailableError(str(e)) from e
