"""Clusters: the units whose errors are taken as independent. A trip; blocks of time where trips are few."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from hdev_jax.segments import Segments, trip_slices

__all__ = [
    "BLOCK_S",
    "FEW_TRIPS",
    "MOST_CLUSTERS",
    "Clusters",
    "cluster_rows",
    "clustered",
    "clusters_of",
]

FEW_TRIPS = 8  # below this many training trips a trip is too coarse a unit (design, step 5)
MOST_CLUSTERS = 256  # give a variance to 9 %; each more costs a Gram matrix of all candidates
LEAST_RATIO = 0.1  # of a clustered to the naive variance: less is too few clusters, or rounding of no information
BLOCK_S = 300.0  # the shortest block, longer than what correlates errors on the road


@dataclass(frozen=True)
class Clusters:
    """`ids` per row, 0 … `count` − 1, contiguous; `kind` is "trip" (whole trips) or "block" (parts of one)."""

    ids: Int[np.ndarray, " row"]
    count: int
    kind: str

    @property
    def pieces(self) -> str:
        """What they are, in words."""
        return "trips" if self.kind == "trip" else "stretches of driving"

    def sums(self, rows: Float[np.ndarray, "row *k"]) -> Float[np.ndarray, "cluster *k"]:
        """Sums over each cluster."""
        starts = np.flatnonzero(np.r_[True, np.diff(self.ids) != 0])
        return np.add.reduceat(rows, starts, axis=0)

    def grams(self, rows: Float[np.ndarray, "row k"]) -> Float[np.ndarray, "cluster k k"]:
        """Gram matrix of each cluster's rows."""
        return np.stack([part.T @ part for part in np.split(rows, np.flatnonzero(np.diff(self.ids)) + 1)])


def cluster_rows(segments: Segments) -> Clusters:
    """Clusters of a log's rows, as `clusters_of` its trips and durations."""
    return clusters_of(np.asarray(segments.trip), np.asarray(segments.duration_s))


def clusters_of(
    trip: Int[np.ndarray, " row"], duration_s: Float[np.ndarray, " row"], *, few: int = FEW_TRIPS
) -> Clusters:
    """Trips where there are at least `few`, else contiguous blocks of each trip of at least `BLOCK_S` [s].

    Where there are more than `MOST_CLUSTERS` trips, neighbours share a cluster.
    """
    slices = list(trip_slices(trip))
    ids = np.zeros(len(trip), dtype=np.int64)
    if len(slices) >= few:
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
        block = np.minimum((clock - clock[0]) / (clock[-1] + 1e-9) * blocks, blocks - 1).astype(np.int64)
        local = np.unique(block, return_inverse=True)[1]  # a row longer than a block leaves one out
        ids[s] = count + local
        count = ids[s][-1] + 1
    return Clusters(ids, int(count), "block")


def clustered(
    grams: Float[np.ndarray, "cluster k k"], scores: Float[np.ndarray, "cluster k"], sigma: float,
    prior_sd: Float[np.ndarray, " k"],
) -> tuple[Float[np.ndarray, "k k"], float]:  # fmt: skip
    """Covariance with errors clustered, and how much wider it is than the naive one (at least 1).

    **Arguments:** `grams` ΣJJᵀ and `scores` ΣJr of each cluster's rows, r what the fit leaves; `sigma`, the noise of a
    row; `prior_sd` of the coefficients (infinite: no table).
    """
    g = len(grams)
    # conditioning: work in units of the naive standard errors
    information = grams.sum(axis=0)
    d = np.sqrt(np.maximum(np.diag(information), 1e-300))
    information, grams, scores = information / np.outer(d, d), grams / np.outer(d, d), scores / d
    ridge = 1e-10 * np.eye(len(d))
    bread = np.linalg.inv(information + ridge)
    # about the log's own optimum: what the prior pulls on every cluster alike is no disagreement between them
    scores = scores - grams @ (bread @ scores.sum(axis=0))
    # the estimate without each cluster, in one step: jackknifed, since a sandwich of few clusters is too narrow
    moves = np.linalg.solve(information + ridge - (1 - 1e-6) * grams, scores[:, :, None])[:, :, 0]
    robust = (g - 1) / g * moves.T @ moves if g > 1 else sigma**2 * bread
    naive = sigma**2 * bread
    informed = np.diag(information) > 0.5  # a column of zeros has nothing to be clustered
    ratio = np.diag(robust)[informed] / np.maximum(np.diag(naive)[informed], 1e-300)
    inflation = max(1.0, float(np.mean(ratio))) if informed.any() else 1.0
    # the clustered likelihood, as a normal around its own maximum, times the prior
    precision = np.linalg.inv(_no_surer(robust, naive) + 1e-300 * np.eye(len(d)))
    prior = np.diag(1.0 / (prior_sd * d) ** 2)
    return np.linalg.inv(precision + prior) / np.outer(d, d), inflation


def _no_surer(robust: Float[np.ndarray, "k k"], naive: Float[np.ndarray, "k k"]) -> Float[np.ndarray, "k k"]:
    """`robust` with at least `LEAST_RATIO` of the naive variance in every direction.

    Where rows hold no information the naive variance is unbounded and the clusters agree at 0: there the prior
    decides.
    """
    values, vectors = np.linalg.eigh(naive)
    root = vectors * np.sqrt(np.maximum(values, 1e-300))
    inverse = vectors / np.sqrt(np.maximum(values, 1e-300))
    ratios, axes = np.linalg.eigh(inverse.T @ robust @ inverse)
    axes = root @ axes
    return (axes * np.maximum(ratios, LEAST_RATIO)) @ axes.T
