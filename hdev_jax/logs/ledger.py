"""The ledger: everything that was changed, dropped or noted on the way from the files to the segments."""

from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace

__all__ = ["KINDS", "Entry", "Ledger"]

KINDS = ("dropped", "filled", "clipped", "split", "trimmed", "derived", "noted")


@dataclass(frozen=True)
class Entry:
    """One thing done to `count` rows (0: to none, a remark), where, and why."""

    kind: str
    reason: str
    count: int = 0
    file: str = ""
    trip: str = ""
    column: str = ""

    def line(self) -> str:
        """`filled 12 rows of gear in trip T01 (a.csv): missing, taken from the row before`."""
        where = f" of {self.column}" if self.column else ""
        where += f" in trip {self.trip}" if self.trip else ""
        where += f" ({self.file})" if self.file else ""
        rows = f" {self.count} row{'s' if self.count != 1 else ''}" if self.count else ""
        return f"{self.kind}{rows}{where}: {self.reason}"


@dataclass(frozen=True)
class Ledger:
    """Entries in the order in which they were written. Immutable: `ledger.add(...)` returns a longer one."""

    entries: tuple[Entry, ...] = ()

    def add(
        self, kind: str, reason: str, *, count: int = 0, file: str = "", trip: str = "", column: str = ""
    ) -> "Ledger":
        """The ledger with one entry more."""
        if kind not in KINDS:
            raise ValueError(f"ledger kind '{kind}'; known: {', '.join(KINDS)}")
        return Ledger((*self.entries, Entry(kind, reason, int(count), file, trip, column)))

    def __add__(self, other: "Ledger") -> "Ledger":
        return Ledger((*self.entries, *other.entries))

    def __iter__(self) -> Iterator[Entry]:
        return iter(self.entries)

    def __len__(self) -> int:
        return len(self.entries)

    def count(self, kind: str, column: str | None = None) -> int:
        """Rows of all entries of a kind (and column)."""
        return sum(e.count for e in self.entries if e.kind == kind and column in (None, e.column))

    def merged(self) -> tuple[Entry, ...]:
        """The same thing done in several files or trips as one entry with the rows added up."""
        groups: dict[tuple[str, str, str], list[Entry]] = {}
        for e in self.entries:
            groups.setdefault((e.kind, e.column, e.reason), []).append(e)
        out = []
        for same in groups.values():
            files, trips = {e.file for e in same} - {""}, {e.trip for e in same} - {""}
            out.append(
                replace(
                    same[0],
                    count=sum(e.count for e in same),
                    file=f"{len(files)} files" if len(files) > 1 else "".join(files),
                    trip="" if len(trips) > 1 else "".join(trips),
                )
            )
        return tuple(out)

    def to_dicts(self) -> list[dict[str, str | int]]:
        """Merged entries as plain dicts, for JSON and the report."""
        return [asdict(e) for e in self.merged()]

    def lines(self) -> list[str]:
        """Merged entries as one line each."""
        return [e.line() for e in self.merged()]
