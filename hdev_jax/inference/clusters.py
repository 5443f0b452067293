"""Clusters: the units whose errors are taken as independent. A trip; blocks of time where trips are few."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from hdev_jax.segments import Segments, trip_slices

__all__ = ["BLOCK_S", "FEW_TRIPS", "MOST_CLUSTERS", "Clusters", "cluster_rows", "clusters_of"]

FEW_TRIPS = 8  # below this many training trips a trip is too coarse a unit (design, step 5)
MOST_CLUSTERS = 256  # tell a variance to 9 %; each more costs a Gram matrix of all candidates
BLOCK_S = 300.0  # the shortest block, longer than what correlates errors on the road


@dataclass(frozen=True)
class Clusters:
    """`ids` per row, 0 … `count` − 1, contiguous; `kind` is "trip" (whole trips) or "block" (parts of one)."""

    ids: Int[np.ndarray, " row"]
    count: int
    kind: str

    def sums(self, rows: Float[np.ndarray, "row *k"]) -> Float[np.ndarray, "cluster *k"]:
        """Sums over each cluster."""
        starts = np.flatnonzero(np.r_[True, np.diff(self.ids) != 0])
        return np.add.reduceat(rows, starts, axis=0)


def cluster_rows(segments: Segments) -> Clusters:
    """Clusters of a log's rows, as `clusters_of` its trips and durations."""
    return clusters_of(np.asarray(segments.trip), np.asarray(segments.duration_s))


def clusters_of(trip: Int[np.ndarray, " row"], duration_s: Float[np.ndarray, " row"]) -> Clusters:
    """Trips where there are at least `FEW_TRIPS`, else contiguous blocks of each trip of at least `BLOCK_S` [s].

    Where there are more than `MOST_CLUSTERS` trips, neighbours share a cluster.
    """
    slices = list(trip_slices(trip))
    ids = np.zeros(len(trip), dtype=np.int64)
    if len(slices) >= FEW_TRIPS:
        most = min(len(slices), MOST_CLUSTERS)
        for k, (_, s) in enumerate(slices):
            ids[s] = k * most // len(slices)
        return Clusters(ids, most, "trip")
    count = 0
    for _, s in slices:
        clock = np.cumsum(duration_s[s])
        # no more than 60 blocks in all: beyond that they only get shorter, not more independent
        most = max(1, 60 // len(slices))
        blocks = int(np.clip(clock[-1] // BLOCK_S, 1, most))
        ids[s] = count + np.minimum((clock - clock[0]) / (clock[-1] + 1e-9) * blocks, blocks - 1).astype(np.int64)
        count = ids[s][-1] + 1
    return Clusters(ids, int(count), "block")
