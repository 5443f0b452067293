"""One pass over a log's rows: the Jacobian, candidates' columns and the residual become Gram matrices by cluster.

Gram matrices add up over rows, so a chunk of whole trips is evaluated, whitened, added and forgotten.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from hdev_jax.diagnosis.candidates.plan import Source
from hdev_jax.diagnosis.noise.noise import Noise, whiten
from hdev_jax.diagnosis.scores.evidence import Evidence
from hdev_jax.inference import Calibration, Chunk, Clusters, linearised
from hdev_jax.inference.calibrate import WEAK, Linearise
from hdev_jax.segments import trip_slices
from hdev_jax.targets import TargetName

__all__ = ["LEVELS", "Baseline", "Sums", "both_looks", "distance_from_table", "evidence_of", "written_by_chunk"]

LEVELS = (0.0, 0.03, 0.1, 0.3, 1.0, 3.0)  # variances of levels that are tried, over the one estimated

Write = Callable[[np.ndarray, Chunk], None]  # fills an array [padded row, column] for a chunk


@dataclass(frozen=True)
class Baseline:
    """What candidates are scored against: the log's chunks, its clusters, the fitted vehicle, the noise of what it
    leaves.

    `chunks()` starts from the first chunk each time; `trips` is how many the log has; `linearise` gives predictions
    and Jacobians.
    """

    chunks: Callable[[], Iterable[Chunk]]
    clusters: Clusters
    trips: int
    fit: Calibration
    target: TargetName
    noise: Noise
    linearise: Linearise = linearised

    def rows(self, chunk: Chunk, width: int, write: Write) -> Float[np.ndarray, "padded k"]:
        """[Jacobian | `width` columns | residual] of a chunk, 0 where it is padded."""
        base = len(self.fit.table.free)
        out = np.empty((len(chunk.segments), base + width + 1))
        fit = self.fit
        predicted, out[:, :base] = self.linearise(fit.vehicle, fit.table, chunk.segments, self.target, fit.values)
        write(out[:, base : base + width], chunk)
        out[: chunk.rows, -1] = chunk.measured - predicted[: chunk.rows]
        out[chunk.rows :] = 0.0
        return out

    def white(self, chunk: Chunk, rows: Float[np.ndarray, "padded k"]) -> Float[np.ndarray, "row k+1"]:
        """A chunk's rows and an intercept, whitened."""
        return whiten(rows, self.noise.after(chunk.first_trip), chunk.trip, chunk.seconds)[: chunk.rows]


class Sums:
    """Gram matrices by cluster of rows [Jacobian | candidates | residual], and their products with intercepts of trips.

    **Arguments:** `width` of the rows, how many clusters and trips the log has.
    """

    def __init__(self, width: int, clusters: int, trips: int):
        self.grams: np.ndarray = np.zeros((clusters, width, width))
        self.levels: np.ndarray = np.zeros((trips, width))
        self.squares: np.ndarray = np.zeros(trips)
        self.home: np.ndarray = np.zeros(trips, dtype=int)

    def add(self, rows: Float[np.ndarray, "row k"], clusters: Int[np.ndarray, " row"]) -> None:
        """Add rows, `clusters` being the cluster of each."""
        for g, part in trip_slices(clusters):
            self.grams[g] += rows[part].T @ rows[part]

    def add_levels(
        self, rows: Float[np.ndarray, "row k"], level: Float[np.ndarray, " row"], clusters: Int[np.ndarray, " row"],
        slices: Iterable[slice], first_trip: int = 0,
    ) -> None:  # fmt: skip
        """Add what a level of 1 of each trip (`level` on its rows) meets; `slices` from `first_trip` on."""
        for t, s in enumerate(slices, start=first_trip):
            self.levels[t], self.squares[t], self.home[t] = level[s] @ rows[s], level[s] @ level[s], clusters[s.start]

    def evidence(
        self, base: int, *, moved: Float[np.ndarray, " base"], prior_sd: Float[np.ndarray, " base"],
        level_sd: float = 0.0, variance: float = 1.0,
    ) -> Evidence:  # fmt: skip
        """The evidence in them.

        **Arguments:** `base`, the number of Jacobian columns; `moved`, how far the present coefficients are from their
        tables, whose sds are `prior_sd`; `level_sd` of the trips' levels (0: `add_levels` is not needed); `variance`,
        what one row counts for.
        """
        precision = 1.0 / prior_sd**2
        trips = slice(None) if level_sd > 0 else slice(0, 0)
        grams = self.grams if variance == 1.0 else self.grams / variance
        return Evidence(
            grams, self.levels[trips], self.squares[trips], self.home[trips],
            np.array(LEVELS if level_sd > 0 else (0.0,)) * level_sd**2, base, precision, precision * moved,
        )  # fmt: skip


def distance_from_table(fit: Calibration) -> tuple[np.ndarray, np.ndarray]:
    """How far the fitted coefficients are from their tables, and the tables' standard deviations.

    A size known from this log, by generalised least squares, has no prior from a table.
    """
    prior = np.array([c.value for c in fit.table.free])
    sd = np.array([WEAK * c.scale if c.sd is None else c.sd for c in fit.table.free])
    return fit.values - prior, sd


def _add_white(sums: Sums, baseline: Baseline, chunk: Chunk, rows: np.ndarray) -> None:
    white = baseline.white(chunk, rows)
    ids = baseline.clusters.ids[chunk.at]
    sums.add(white[:, :-1], ids)
    if baseline.noise.level_sd > 0:
        sums.add_levels(white[:, :-1], white[:, -1], ids, chunk.slices(), chunk.first_trip)


def evidence_of(baseline: Baseline, width: int = 0, write: Write = lambda out, chunk: None) -> Evidence:
    """Evidence by generalised least squares from the Jacobian, `width` columns that `write` makes, and the residual."""
    moved, sd = distance_from_table(baseline.fit)
    sums = Sums(len(sd) + width + 1, baseline.clusters.count, baseline.trips)
    for chunk in baseline.chunks():
        _add_white(sums, baseline, chunk, baseline.rows(chunk, width, write))
    return sums.evidence(len(sd), moved=moved, prior_sd=sd, level_sd=baseline.noise.level_sd)


def both_looks(
    baseline: Baseline, source: Source, variance: float | None = None
) -> tuple[Evidence, Evidence, Bool[np.ndarray, " column"]]:
    """Evidence by generalised least squares, and by ordinary least squares with rows of `variance` times the clusters'
    inflation (of the residual, if none is given).

    Third, which columns hardly change inside a trip, and so differ between trips alone.
    """
    moved, sd = distance_from_table(baseline.fit)
    base = len(sd)
    white, plain = (Sums(base + source.width + 1, baseline.clusters.count, baseline.trips) for _ in range(2))
    between, rows_in_all = np.zeros(source.width), 0
    for chunk in baseline.chunks():
        rows = baseline.rows(chunk, source.width, lambda out, c: source.write(out, c.segments))
        _add_white(white, baseline, chunk, rows)
        rows = rows[: chunk.rows]
        plain.add(rows, baseline.clusters.ids[chunk.at])
        for s in chunk.slices():
            between += np.sum(rows[s, base:-1], axis=0) ** 2 / (s.stop - s.start)
        rows_in_all += chunk.rows
    total = np.einsum("gii->i", plain.grams)
    # a log that is met exactly has no variance; nothing is worth more than a part in 10¹² of what was predicted
    least = 1e-24 * float(np.mean(np.square(baseline.fit.predicted)))
    own = float(total[-1]) / rows_in_all if variance is None else variance
    counted = max(own, least, 1e-300) * baseline.fit.inflation
    return (
        white.evidence(base, moved=moved, prior_sd=sd, level_sd=baseline.noise.level_sd),
        plain.evidence(base, moved=moved, prior_sd=sd, variance=counted),
        between > 0.5 * total[base:-1],
    )


def written_by_chunk(baseline: Baseline, source: Source, at: tuple[int, ...]) -> Float[np.ndarray, "row k"]:
    """A few of the source's columns on every row of the log."""
    out = np.empty((len(baseline.clusters.ids), len(at)))
    for chunk in baseline.chunks():
        part = np.empty((len(chunk.segments), len(at)))
        source.write(part, chunk.segments, at)
        out[chunk.at] = part[: chunk.rows]
    return out
