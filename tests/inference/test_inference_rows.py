"""Rows as estimators take them: chunks of whole trips in a few shapes, and the clusters of many trips."""

import jax
import numpy as np
import pytest

from hdev_jax.inference import clusters_of, padded
from hdev_jax.inference.clusters import MOST_CLUSTERS
from hdev_jax.inference.rows import Shapes, chunks_of, cut
from hdev_jax.segments import Segments


def prepared_rows(n: int, trips: int = 1):
    """A few rows of standing still."""
    zero, one = np.zeros(n), np.ones(n)
    return Segments(np.arange(n) * trips // n, np.zeros(n, int), zero, one, zero, zero, zero, {"gear": one})


@pytest.mark.parametrize(
    ("lengths", "most", "expected"),
    [([3, 3, 3], 6, [(0, 2), (2, 3)]), ([9, 1, 1], 6, [(0, 1), (1, 3)]), ([1, 9, 1], 6, [(0, 1), (1, 2), (2, 3)]),
     ([], 6, []), ([2], 6, [(0, 1)])],
)  # fmt: skip
def test_trips_are_kept_whole(lengths, most, expected):
    assert cut(lengths, most) == expected


def test_shapes_are_few():
    """One for all chunks of a long log, powers of two of it for long trips, no more than the longest asks for."""
    assert Shapes(1000, 300).size(1000) == 1024
    long = Shapes(10**7, 400_000)
    assert {long.size(n) for n in range(1, 65_537, 97)} == {65_536}
    assert {long.size(n) for n in range(65_537, 400_001, 997)} == {131_072, 262_144, 458_752}
    with pytest.raises(ValueError, match="do not fit"):
        padded(prepared_rows(9), np.zeros(9), 8)


def test_chunks_count_their_rows_anew():
    """Bounds of trips belong to the chunk; everything else is the log's rows in order."""
    whole = padded(prepared_rows(90, 9), np.arange(90.0))
    real = jax.tree.map(lambda x: x[:90], whole.segments)
    chunks = list(chunks_of(real, np.arange(90.0), Shapes(90, 10, 35), row=500, trip=50))
    assert [(c.at.start, c.rows, c.first_trip, c.trips) for c in chunks] == [
        (500, 30, 50, 3), (530, 30, 53, 3), (560, 30, 56, 3)
    ]  # fmt: skip
    for c in chunks:
        first = np.asarray(c.segments.channels["derived:first_row_of_trip"])[: c.rows]
        np.testing.assert_array_equal(first, np.repeat([0, 10, 20], 10))
    np.testing.assert_array_equal(np.concatenate([c.measured for c in chunks]), np.arange(90.0))


def test_many_trips_share_clusters():
    trip = np.repeat(np.arange(3 * MOST_CLUSTERS + 7), 2)
    clusters = clusters_of(trip, np.ones(len(trip)))
    assert (clusters.count, clusters.kind) == (MOST_CLUSTERS, "trip")
    assert np.all(np.diff(clusters.ids) >= 0)
    assert np.all(clusters.ids[::2] == clusters.ids[1::2])  # no trip is split
    sizes = np.bincount(clusters.ids)
    assert sizes.min() >= 6
    assert sizes.max() <= 8
