"""What a file's name says: its kind by the ending, its trip by the stem or an adapter's expression."""

from pathlib import Path

from hdev_jax.errors import InputError
from hdev_jax.logs.adapter import Adapter

__all__ = ["ENDINGS", "stem", "trip_of"]

ENDINGS = {".csv": "csv", ".csv.gz": "csv", ".parquet": "parquet", ".pq": "parquet", ".mat": "mat"}


def stem(name: str) -> str:
    """A file's name without its ending (`a.csv.gz` → `a`)."""
    for ending in sorted(ENDINGS, key=len, reverse=True):
        if name.lower().endswith(ending):
            return name[: -len(ending)]
    return Path(name).stem


def trip_of(path: Path, adapter: Adapter) -> str:
    """The trip that a file is, where no column says so. Raises `InputError` if the adapter's expression fails."""
    if adapter.trip_id is None:
        return stem(path.name)
    trip = adapter.match(adapter.trip_id, path.name)
    if trip is None:
        raise InputError(f"{path}: trip_id = {adapter.trip_id!r} of {adapter.where} does not match the file's name")
    return trip
