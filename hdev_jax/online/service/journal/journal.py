"""What survives a kill: every acknowledged row, and each vehicle's state with the row that it has seen last.

A row is committed before it is acknowledged; a state is written with the numbers of the rows that it does not hold yet.
After a kill the vehicle goes on from its last state with the rows since, in the order in which they came: it ends as it
would have without the kill. Who opened a journal last owns it: a process that goes on writing after that keeps nothing.
"""

import io
import json
import uuid
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hdev_jax import progress
from hdev_jax.errors import InputError
from hdev_jax.online.service.journal.database import Database, Row, Run, UnavailableError
from hdev_jax.online.service.journal.postgresql import SCHEMES, PostgresqlServer
from hdev_jax.online.service.journal.sqlite import SqliteFile

__all__ = ["Journal", "Kept", "Sent"]

SCHEMA = 1
_TABLES = (
    "CREATE TABLE IF NOT EXISTS rows (seq {seq}, fleet TEXT NOT NULL, vehicle TEXT NOT NULL, trip TEXT NOT NULL, "
    "time_s DOUBLE PRECISION NOT NULL, body TEXT NOT NULL, UNIQUE (fleet, vehicle, trip, time_s))",
    "CREATE INDEX IF NOT EXISTS by_vehicle ON rows (fleet, vehicle, seq)",
    "CREATE TABLE IF NOT EXISTS states (fleet TEXT NOT NULL, vehicle TEXT NOT NULL, upto BIGINT NOT NULL, "
    "about TEXT NOT NULL, numbers {blob}, PRIMARY KEY (fleet, vehicle))",
    "CREATE TABLE IF NOT EXISTS journal (version INTEGER NOT NULL, owner TEXT NOT NULL)",
)


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
    """Rows and states, in a file of SQLite or a database of PostgreSQL (`postgresql://…`).

    All methods may be called from any thread, and raise `UnavailableError` where the database is away. Raises
    `InputError` for one that is something else or cannot be reached.
    """

    def __init__(self, place: str | Path):
        scheme, _, rest = str(place).partition(":")
        server = scheme in SCHEMES
        if server != rest.startswith("//") or (server and isinstance(place, Path)):  # the rest may hold a password
            raise InputError(f"--state {scheme}:…: a file is expected, or postgresql://… as text")
        self._db: Database = PostgresqlServer(str(place)) if server else SqliteFile(place)
        self._owner: str = uuid.uuid4().hex
        self._why: str | None = None  # it takes nothing now
        try:
            with self._db.transaction() as run:
                version = self._prepared(run)
        except UnavailableError as e:
            self._db.close()
            raise InputError(f"--state {self._db.shown}: no database of hdev serve ({e}); name another") from None
        if version != SCHEMA:
            self._db.close()
            raise InputError(f"--state {self._db.shown}: of another version ({version}); name another")

    def _prepared(self, run: Run) -> int:
        """Make the tables where there are none, and own them. **Returns:** their version."""
        for statement in _TABLES:
            run(statement.format(**self._db.types._asdict()))
        if not (found := run("SELECT version FROM journal")):
            run("INSERT INTO journal VALUES (?, '')", (SCHEMA,))
        version = found[0][0] if found else SCHEMA
        if version == SCHEMA:
            run("UPDATE journal SET owner = ?", (self._owner,))
        return version

    @contextmanager
    def _writing(self) -> Iterator[Run]:
        with self._told(), self._db.transaction() as run:
            if run(f"SELECT owner FROM journal{self._db.types.lock}") != [(self._owner,)]:
                raise UnavailableError("another hdev serve now uses this database; each needs one of its own")
            yield run

    def _read(self, query: str, parameters: Sequence[Any] = ()) -> list[tuple[Any, ...]]:
        with self._told():
            return self._db.read(query, parameters)

    @contextmanager
    def _told(self) -> Iterator[None]:
        """Say once why nothing is kept, and once that it works again."""
        try:
            yield
        except UnavailableError as e:
            if self._why != str(e):
                self._why = str(e)
                progress.step(f"--state {self._db.shown}: {e}; rows are answered by 503 until that is over")
            raise
        if self._why is not None:
            self._why = None
            progress.step(f"--state {self._db.shown}: rows are kept again")

    def put(self, fleet: str, rows: Sequence[Row]) -> list[tuple[str, Sent]]:
        """Keep rows `(vehicle, trip, time_s, body)`, all or none. **Returns:** those that were not there already, with
        their vehicle: a row is the same where vehicle, trip and time are. After `UnavailableError` they may be there:
        an answer can be lost."""
        with self._writing() as run:
            new = self._db.insert(run, fleet, rows)
        return [(rows[i][0], Sent(seq, *rows[i][1:])) for seq, i in new]

    def vehicles(self) -> list[tuple[str, str]]:
        """`(fleet, vehicle)` of all that have sent a row."""
        return [(fleet, vehicle) for fleet, vehicle in self._read("SELECT DISTINCT fleet, vehicle FROM rows")]

    def kept(self, fleet: str, vehicle: str) -> Kept | None:
        """A vehicle's last state, None where it has none yet."""
        query = "SELECT upto, about, numbers FROM states WHERE fleet = ? AND vehicle = ?"
        found = self._read(query, (fleet, vehicle))
        if not found:
            return None
        upto, about, blob = found[0]
        numbers = None if blob is None else np.load(io.BytesIO(blob), allow_pickle=False)
        return Kept(upto, json.loads(about), numbers)

    def since(self, fleet: str, vehicle: str, upto: int, also: Iterable[int] = ()) -> Iterator[Sent]:
        """Rows after `upto`, and those whose number is in `also`, in the order in which they came."""
        waiting = {*also}
        found = self._read(
            "SELECT seq, trip, time_s, body FROM rows WHERE fleet = ? AND vehicle = ? AND seq >= ? ORDER BY seq",
            (fleet, vehicle, min([*waiting, upto + 1])),
        )
        found = [row for row in found if row[0] > upto or row[0] in waiting]
        return (Sent(seq, trip, time_s, json.loads(body)) for seq, trip, time_s, body in found)

    def keep(self, states: Sequence[tuple[str, str, Kept]]) -> None:
        """Write states, all or none."""
        with self._writing() as run:
            for fleet, vehicle, kept in states:
                blob = None
                if kept.numbers is not None:
                    file = io.BytesIO()
                    np.save(file, kept.numbers)
                    blob = file.getvalue()
                run(
                    "INSERT INTO states VALUES (?, ?, ?, ?, ?) ON CONFLICT (fleet, vehicle) DO UPDATE SET "
                    "upto = excluded.upto, about = excluded.about, numbers = excluded.numbers",
                    (fleet, vehicle, kept.upto, json.dumps(kept.about), blob),
                )

    def close(self) -> None:
        """No more calls after this."""
        self._db.close()
