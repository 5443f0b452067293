"""A database of a PostgreSQL server, reached anew where it was away."""

import importlib
import json
import selectors
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any

from hdev_jax.errors import InputError
from hdev_jax.online.service.journal.database import Row, Run, Types, UnavailableError

__all__ = ["SCHEMES", "PostgresqlServer"]

SCHEMES = ("postgresql", "postgres")
EXTRA = "hdev serve needs psycopg for PostgreSQL: pip install 'hdev_jax[serve]'"
# A server that does not answer is given up after these, and asked again no sooner than RETRY_S later.
OPTIONS = {
    "connect_timeout": "5",
    "tcp_user_timeout": "10000",
    "keepalives_idle": "10",
    "application_name": "hdev serve",
}
RETRY_S = 1.0
# On the disk before it is acknowledged, whatever the server's default is; who vanished holds no lock for long.
SESSION = (
    "SELECT set_config('synchronous_commit', 'on', false) WHERE current_setting('synchronous_commit') = 'off'",
    "SET idle_in_transaction_session_timeout = '10s'",
    "SET lock_timeout = '20s'",
)
INSERT = (
    "INSERT INTO rows (fleet, vehicle, trip, time_s, body) SELECT ?, vehicle, trip, time_s, body FROM "
    "unnest(?::text[], ?::text[], ?::float8[], ?::text[]) WITH ORDINALITY AS sent (vehicle, trip, time_s, body, place) "
    "ORDER BY place ON CONFLICT DO NOTHING RETURNING seq, vehicle, trip, time_s"
)


class PostgresqlServer:
    """The database at a URL. Raises `InputError` for one that cannot be reached."""

    types: Types = Types("BIGINT GENERATED ALWAYS AS IDENTITY PRIMARY KEY", "BYTEA", " FOR UPDATE")

    def __init__(self, url: str):
        try:
            self._psycopg: Any = importlib.import_module("psycopg")
        except ImportError as e:
            raise InputError(EXTRA) from e
        self._given: dict[str, Any] = OPTIONS | self._parsed(url)
        host, port, name = (str(self._given.get(k, "")) for k in ("host", "port", "dbname"))
        self.shown: str = f"postgresql://{host}{':' if port else ''}{port}/{name}"
        self._lock = threading.Lock()
        self._closed: bool = False
        self._not_before, self._last = 0.0, ""  # when it is tried again, and why not sooner
        try:
            self._db: Any = self._connected()
        except self._psycopg.Error as e:
            raise InputError(f"--state {self.shown}: cannot be reached: {_line(e)}") from None
        encoding = self._db.info.parameter_status("server_encoding")
        if encoding != "UTF8":
            self._db.close()
            raise InputError(f"--state {self.shown}: in {encoding}; a database in UTF8 is expected")

    def _parsed(self, url: str) -> dict[str, Any]:
        """What is in the URL. A message never holds more of it than host, port and database: a password with an `@` or
        `/` in it, for one, ends up as something else."""
        given = {}
        with suppress(self._psycopg.Error):
            given = self._psycopg.conninfo.conninfo_to_dict(url)
        places = [str(given.get(k, "")) for k in ("host", "port", "dbname")]
        if not given or any("@" in p for p in places) or not set(places[1]) <= set("0123456789,"):
            raise InputError(
                "--state: no URL of PostgreSQL; postgresql://USER@HOST:PORT/DATABASE is expected, with %40 for @ and "
                "%2F for / in a name or password"
            )
        return given

    @contextmanager
    def transaction(self) -> Iterator[Run]:
        """All or nothing, one at a time; on the disk once the block has ended."""
        with self._using() as db, db.transaction():
            yield self._run

    def read(self, statement: str, parameters: Sequence[Any] = ()) -> list[tuple[Any, ...]]:
        """What a SELECT finds, outside a transaction."""
        with self._using():
            return self._run(statement, parameters)

    def insert(self, run: Run, fleet: str, rows: Sequence[Row]) -> list[tuple[int, int]]:
        """Keep rows that are not there yet. **Returns:** of each that was new its number and its place in `rows`."""
        place: dict[tuple[str, str, float], int] = {}
        for i, row in enumerate(rows):
            place.setdefault(row[:3], i)
        first = [rows[i] for i in place.values()]
        columns = (
            [r[0] for r in first],
            [r[1] for r in first],
            [r[2] for r in first],
            [json.dumps(r[3]) for r in first],
        )
        return sorted(
            (seq, place[vehicle, trip, time_s]) for seq, vehicle, trip, time_s in run(INSERT, (fleet, *columns))
        )

    def close(self) -> None:
        """No more calls after this."""
        with self._lock:
            self._closed = True
            if self._db is not None:
                self._db.close()

    # --- the connection ----------------------------------------------------------------------------------------------

    def _connected(self) -> Any:
        db = self._psycopg.connect(**self._given, autocommit=True)
        for statement in SESSION:
            db.execute(statement)
        return db

    def _run(self, statement: str, parameters: Sequence[Any] = ()) -> list[tuple[Any, ...]]:
        cursor = self._db.execute(statement.replace("?", "%s"), parameters, binary=True)
        return cursor.fetchall() if cursor.description else []

    @contextmanager
    def _using(self) -> Iterator[Any]:
        """The connection, made anew where it was lost."""
        with self._lock:
            try:
                if self._closed:
                    raise UnavailableError("the service ends")
                if self._db is None or self._lost():
                    if time.monotonic() < self._not_before:
                        raise UnavailableError(self._last)
                    self._db = None
                    self._db = self._connected()
                yield self._db
            except self._psycopg.Error as e:
                self._last = _line(e)
                if self._db is None:
                    self._not_before = time.monotonic() + RETRY_S
                raise UnavailableError(self._last) from None

    def _lost(self) -> bool:
        """Whether the connection has ended: a server that goes says so while nobody asks."""
        if self._db.closed:
            return True
        with selectors.DefaultSelector() as selector:
            selector.register(self._db.fileno(), selectors.EVENT_READ)
            if not selector.select(0):
                return False
        self._db.close()
        return True


def _line(error: Exception) -> str:
    """What the driver says, which never holds a password, in one line."""
    return " ".join(str(error).split()) or type(error).__name__
