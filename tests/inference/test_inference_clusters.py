"""Which rows err together."""

import numpy as np
import pytest
from inference_rows import driving

from hdev_jax.inference import cluster_rows, clusters_of
from hdev_jax.inference.clusters import BLOCK_S, FEW_TRIPS


def test_many_trips_are_their_own_clusters():
    s = driving(*range(3, 3 + FEW_TRIPS))
    clusters = cluster_rows(s)
    assert (clusters.kind, clusters.count) == ("trip", FEW_TRIPS)
    np.testing.assert_array_equal(clusters.ids, s.trip)


@pytest.mark.parametrize("lengths", [(1000,), (300, 200), (59, 61, 130, 700), (1,), (5, 5), (300,) * (FEW_TRIPS - 1)])
def test_few_trips_are_cut_into_blocks_of_time(lengths):
    """At least five minutes long but where the trip is shorter, inside one trip, contiguous, numbered from 0."""
    dt = 5.0
    s = driving(*lengths, dt=dt)
    clusters = cluster_rows(s)
    assert clusters.kind == "block"
    assert clusters.count == len(np.unique(clusters.ids)) <= max(60, len(lengths))
    assert set(np.diff(clusters.ids)) <= {0, 1}
    assert clusters.ids[0] == 0
    for k in range(clusters.count):
        rows = clusters.ids == k
        (trip,) = np.unique(s.trip[rows])
        whole = dt * lengths[trip]
        # blocks are cut between rows, so each may lose or gain one
        assert dt * rows.sum() >= min(BLOCK_S - dt, whole)
    for trip, n in enumerate(lengths):
        count = len(np.unique(clusters.ids[s.trip == trip]))
        assert count == np.clip(dt * n // BLOCK_S, 1, max(1, 60 // len(lengths)))


def test_ids_of_the_trips_do_not_matter():
    """Training trips are some of a log's: their ids have gaps and need not begin at 0."""
    s = driving(*(10,) * 12)
    some = s.take(np.isin(s.trip, [1, 3, 4, 5, 7, 8, 9, 11]))
    clusters = cluster_rows(some)
    assert clusters.count == 8
    np.testing.assert_array_equal(clusters.ids, np.repeat(np.arange(8), 10))


def test_sums():
    s = driving(7, 100, 90)
    clusters = cluster_rows(s)
    rows = np.random.default_rng(0).normal(size=(len(s), 3))
    expected = np.stack([rows[clusters.ids == k].sum(axis=0) for k in range(clusters.count)])
    np.testing.assert_allclose(clusters.sums(rows), expected, atol=1e-12)
    np.testing.assert_allclose(clusters.sums(rows[:, 0]), expected[:, 0], atol=1e-12)


def test_a_row_longer_than_a_block_leaves_no_gap():
    """Ids are numbered from 0 without one left out, whatever a row lasts."""
    duration = np.r_[np.full(40, 60.0), 1500.0, np.full(40, 60.0)]
    clusters = clusters_of(np.zeros(81, dtype=int), duration)
    assert sorted(set(clusters.ids)) == list(range(clusters.count))
    assert len(clusters.sums(duration)) == clusters.count
