"""What a file's name says: its kind by the ending, its trip by the stem or an adapter's expression."""

from pathlib import Path

from hdev_jax.errors import InputError
from hdev_jax.logs.adapter import Adapter

__all__ = ["ENDINGS", "SIGNALS", "ending_of", "stem", "trip_of"]

_PLAIN = {
    ".csv": "csv",
    ".txt": "csv",
    ".tsv": "csv",
    ".vmod": "csv",
    ".parquet": "parquet",
    ".pq": "parquet",
    ".feather": "feather",
    ".arrow": "feather",
    ".jsonl": "jsonl",
    ".ndjson": "jsonl",
    ".xlsx": "xlsx",
    ".mat": "mat",
    ".xml": "xml",
}
_RECORDINGS = {".mf4": "mf4", ".mdf": "mf4", ".blf": "blf", ".asc": "asc"}
SIGNALS = tuple(dict.fromkeys(_RECORDINGS.values()))
"""The formats of recordings, which are read a channel at a time and not unzipped in memory."""
ENDINGS = {ending + zipped: kind for zipped in (".gz", "") for ending, kind in _PLAIN.items()} | _RECORDINGS
"""What a log's name may end in, and the format that it says."""


def ending_of(name: str) -> str:
    """The known ending of a name, the longest first (`.csv.gz`); an empty text without one."""
    return next((e for e in sorted(ENDINGS, key=len, reverse=True) if name.lower().endswith(e)), "")


def stem(name: str) -> str:
    """A file's name without its ending (`a.csv.gz` → `a`)."""
    ending = ending_of(name)
    return name[: -len(ending)] if ending else Path(name).stem


def trip_of(path: Path, adapter: Adapter) -> str:
    """The trip that a file is, where no column says so. Raises `InputError` if the adapter's expression fails."""
    if adapter.trip_id is None:
        return stem(path.name)
    trip = adapter.match(adapter.trip_id, path.name)
    if trip is None:
        raise InputError(f"{path}: trip_id = {adapter.trip_id!r} of {adapter.where} does not match the file's name")
    return trip
