"""What the journal asks of a database: the few places where SQLite and PostgreSQL differ."""

from collections.abc import Sequence
from contextlib import AbstractContextManager
from typing import Any, NamedTuple, Protocol

__all__ = ["Database", "Row", "Run", "Types", "UnavailableError"]

Row = tuple[str, str, float, dict[str, Any]]  # vehicle, trip, time_s, body


class UnavailableError(Exception):
    """Nothing can be kept or read now: the database is away or full, or another process has taken it over."""


class Run(Protocol):
    """A statement with `?` for its parameters, within a transaction. **Returns:** the rows it found."""

    def __call__(self, statement: str, parameters: Sequence[Any] = ()) -> list[tuple[Any, ...]]: ...


class Types(NamedTuple):
    """How a database calls them."""

    seq: str  # a number that rises with each row that is kept
    blob: str
    lock: str  # added to a SELECT: what it found stays as it is until the transaction ends


class Database(Protocol):
    """One database. All methods may be called from any thread, and raise `UnavailableError`."""

    types: Types
    shown: str  # how messages name it: no password

    def transaction(self) -> AbstractContextManager[Run]:
        """All or nothing, one at a time; on the disk once the block has ended."""
        ...

    def read(self, statement: str, parameters: Sequence[Any] = ()) -> list[tuple[Any, ...]]:
        """What a SELECT finds, outside a transaction."""
        ...

    def insert(self, run: Run, fleet: str, rows: Sequence[Row]) -> list[tuple[int, int]]:
        """Keep rows that are not there yet. **Returns:** of each that was new its number and its place in `rows`."""
        ...

    def close(self) -> None:
        """No more calls after this."""
        ...
