"""Rows as estimators take them: padded to a few shapes that compile once, in chunks of whole trips.

What adds up over rows needs no more than a chunk at a time, and every pass over a log runs the same compiled programs.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from hdev_jax.physics import derived
from hdev_jax.physics.across import FIRST, LAST
from hdev_jax.segments import Segments, trip_slices

__all__ = ["CHUNK_ROWS", "Chunk", "Fit", "Shapes", "chunks_of", "chunks_of_fit", "cut", "padded", "padded_rows"]

Real = Float[Array, " row"] | Float[np.ndarray, " row"]
FEW_ROWS = 4_096
CHUNK_ROWS = 65_536  # rows at a time: 200 columns of them are 0.1 GB


class Fit(eqx.Module):
    """The rows of one problem, padded to a shape that others share. Rows past the log have weight 0."""

    segments: Segments
    measured: Real
    weight: Real
    rows: int


def padded_rows(n: int) -> int:
    """1,024, 2,048 or 4,096 rows, or the next of four shapes per octave beyond: logs of like length share programs.

    Compiling takes far longer than the rows of a short log, so short logs have few shapes.
    """
    octave = max(10, int(np.ceil(np.log2(max(n, 1)))))
    quantum = 2**octave if 2**octave <= FEW_ROWS else 2 ** (octave - 3)
    return int(np.ceil(max(n, 1) / quantum) * quantum)


def padded(segments: Segments, measured: np.ndarray, size: int | None = None) -> Fit:
    """Rows padded to `size` rows, by default to `padded_rows` of them. Raises `ValueError` where they do not fit."""
    n = len(segments)
    size = padded_rows(n) if size is None else size
    if size < n:
        raise ValueError(f"{n} rows do not fit into {size}; give a size of at least as many rows")
    extra = size - n

    def pad(x: Any, fill: Any = None) -> np.ndarray:
        x = np.asarray(x)
        return np.concatenate([x, np.full(extra, x[-1] if fill is None else fill, dtype=x.dtype)]) if extra else x

    out = jax.tree.map(pad, segments)
    # a trip of its own, standing still: finite everywhere, and no neighbour of a real row
    out = eqx.tree_at(
        lambda s: (s.trip, s.distance_m),
        out,
        (pad(segments.trip, fill=int(np.max(np.asarray(segments.trip))) + 1), pad(segments.distance_m, fill=0.0)),
    )
    out = jax.tree.map(np.asarray, derived(out))
    return Fit(out, pad(measured, fill=0.0), np.r_[np.ones(n), np.zeros(extra)], n)


@dataclass(frozen=True)
class Chunk:
    """Whole trips of a log. `segments` are padded, the first `rows` of them are the log's `at`.

    `first_trip` is the place of its first trip among the log's, `trips` how many there are.
    """

    segments: Segments
    measured: Float[np.ndarray, " row"]
    at: slice
    first_trip: int
    trips: int

    @property
    def rows(self) -> int:
        """Number of rows that are the log's own."""
        return self.at.stop - self.at.start

    @property
    def trip(self) -> Int[np.ndarray, " padded"]:
        """Trip ids, the padding's included."""
        return np.asarray(self.segments.trip)

    @property
    def seconds(self) -> Float[np.ndarray, " padded"]:
        """Durations [s], the padding's included."""
        return np.asarray(self.segments.duration_s)

    def slices(self) -> Iterator[slice]:
        """Its trips' rows, from its first row on."""
        return (s for _, s in trip_slices(self.trip[: self.rows]))


@dataclass(frozen=True)
class Shapes:
    """What chunks of a log are padded to: one shape, and for trips longer than that a power of two of it.

    `rows` of the whole log, `longest` of its longest trip, `chunk_rows` wanted in a chunk.
    """

    rows: int
    longest: int
    chunk_rows: int = CHUNK_ROWS

    def size(self, rows: int) -> int:
        """Padded length of a chunk of so many rows."""
        if self.rows <= self.chunk_rows:
            return padded_rows(self.rows)  # one chunk, no longer than it has to be
        size = self.chunk_rows
        while size < rows:
            size *= 2
        return min(size, max(padded_rows(self.longest), self.chunk_rows))


def cut(lengths: Sequence[int], most: int) -> list[tuple[int, int]]:
    """`(first trip, one past the last)` of runs of whole trips with at most so many rows; a longer trip is alone."""
    out, first, rows = [], 0, 0
    for k, n in enumerate(lengths):
        if k > first and rows + n > most:
            out.append((first, k))
            first, rows = k, 0
        rows += n
    return [*out, (first, len(lengths))] if len(lengths) else out


def chunks_of(
    segments: Segments, measured: Float[np.ndarray, " row"], shapes: Shapes, *, row: int = 0, trip: int = 0
) -> Iterator[Chunk]:
    """Chunks of these rows, which are whole trips and begin at the log's `row` and `trip`."""
    slices = [s for _, s in trip_slices(np.asarray(segments.trip))]
    bare = segments.without(FIRST, LAST)  # rows are counted from 0 in each chunk
    for first, last in cut([s.stop - s.start for s in slices], shapes.chunk_rows):
        at = slice(slices[first].start, slices[last - 1].stop)
        part = jax.tree.map(lambda x, at=at: np.asarray(x)[at], bare)
        fit = padded(part, measured[at], shapes.size(at.stop - at.start))
        where = slice(row + at.start, row + at.stop)
        yield Chunk(jax.tree.map(jnp.asarray, fit.segments), measured[at], where, trip + first, last - first)


def chunks_of_fit(rows: Fit, shapes: Shapes) -> Iterable[Chunk]:
    """Chunks of a log that is in memory; one that fits into a chunk is taken as it is padded already."""
    measured = np.asarray(rows.measured)[: rows.rows]
    if rows.rows > shapes.chunk_rows:
        real = jax.tree.map(lambda x: np.asarray(x)[: rows.rows], rows.segments)
        return chunks_of(real, measured, shapes)
    trips = sum(1 for _ in trip_slices(np.asarray(rows.segments.trip)[: rows.rows]))
    whole = jax.tree.map(jnp.asarray, rows.segments)
    return [Chunk(whole, measured, slice(0, rows.rows), 0, trips)]
