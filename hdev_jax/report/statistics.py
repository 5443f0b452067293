"""Summaries that the figures draw: binned means with their error, autocorrelation, spectrum, a stretch to look at."""

from dataclasses import dataclass

import numpy as np

from hdev_jax.inference.clusters import Clusters, clusters_of
from hdev_jax.report.data import ReportData, test_rows
from hdev_jax.segments import trip_slices

__all__ = [
    "Binned",
    "autocorrelation",
    "binned",
    "blocks",
    "dependence",
    "edges_of",
    "row_seconds",
    "runs",
    "stretch",
    "thin",
    "variance_by_period",
]

BINS = 14


@dataclass(frozen=True)
class Binned:
    """Mean of a residual in bins of a channel: centre, mean, standard error (errors clustered), rows in it."""

    x: np.ndarray
    mean: np.ndarray
    error: np.ndarray
    n: np.ndarray


def runs(trip: np.ndarray) -> list[slice]:
    """Runs of equal trip ids."""
    return [s for _, s in trip_slices(trip)]


def blocks(data: ReportData, rows: np.ndarray) -> Clusters:
    """Clusters of the chosen rows, as the diagnosis has them of training rows."""
    return clusters_of(data.row("trip")[rows], np.nan_to_num(data.row("duration_s")[rows]))


def edges_of(x: np.ndarray, bins: int = BINS) -> np.ndarray | None:
    """Inner edges of bins with like numbers of rows; one bin a value where there are few. None: constant."""
    x = x[np.isfinite(x)]
    if not len(x):
        return None
    sample = x if len(x) <= 50_000 else x[:: len(x) // 50_000]
    values = np.unique(sample)
    if len(values) < 2 or values[-1] - values[0] <= 1e-9 * max(abs(values[-1]), abs(values[0])):
        return None
    if len(values) <= bins:
        return 0.5 * (values[1:] + values[:-1])
    edges = np.unique(np.quantile(sample, np.linspace(0, 1, bins + 1)[1:-1]))
    if len(edges) < bins // 2:  # half of the rows at one value: bins of equal width show more
        edges = np.linspace(values[0], values[-1], bins + 1)[1:-1]
    return edges


def binned(x: np.ndarray, residual: np.ndarray, cluster: np.ndarray, edges: np.ndarray, least: int = 5) -> Binned:
    """Means by bin; the error of a mean sums residuals by cluster first, for they are not independent.

    The error is NaN in a bin that only one cluster fills: one does not show how clusters differ.
    """
    good = np.isfinite(x) & np.isfinite(residual)
    x, residual, cluster = x[good], residual[good], cluster[good]
    place = np.searchsorted(edges, x)
    bins = len(edges) + 1
    n = np.bincount(place, minlength=bins)
    safe = np.maximum(n, 1)
    centre = np.bincount(place, x, minlength=bins) / safe
    mean = np.bincount(place, residual, minlength=bins) / safe
    clusters = int(cluster.max(initial=0)) + 1
    sums = np.bincount(place * clusters + cluster, residual - mean[place], minlength=bins * clusters)
    groups = sums.reshape(bins, clusters)
    there = (np.bincount(place * clusters + cluster, minlength=bins * clusters) > 0).reshape(bins, clusters).sum(axis=1)
    spread = np.sqrt(np.sum(groups**2, axis=1) * there / np.maximum(there - 1, 1)) / safe
    error = np.where(there > 1, spread, np.nan)
    few = n < least
    return Binned(centre[~few], mean[~few], error[~few], n[~few])


def dependence(x: np.ndarray, residual: np.ndarray, edges: np.ndarray) -> float:
    """Share of the residual's variance that its mean by bin of the channel makes, less what chance makes (≥ 0)."""
    good = np.isfinite(x) & np.isfinite(residual)
    x, residual = x[good], residual[good]
    if len(x) < 20:
        return 0.0
    place = np.searchsorted(edges, x)
    n = np.bincount(place, minlength=len(edges) + 1)
    mean = np.bincount(place, residual, minlength=len(n)) / np.maximum(n, 1)
    variance = float(np.mean(residual**2))
    share = float(np.sum(n * mean**2)) / len(x) / variance if variance > 0 else 0.0
    return max(share - len(n) / len(x), 0.0)


def row_seconds(data: ReportData, rows: np.ndarray) -> tuple[float, bool]:
    """Typical duration of a row [s], and whether all are (nearly) alike."""
    d = data.row("duration_s")[rows]
    d = d[np.isfinite(d) & (d > 0)]
    typical = float(np.median(d)) if len(d) else 1.0
    return typical, bool(len(d) and np.mean(np.abs(d - typical) < 0.05 * typical) > 0.9)


def autocorrelation(residual: np.ndarray, trip: np.ndarray, lags: int) -> np.ndarray:
    """Correlation of the residual with itself `0 … lags` rows later, within trips, about the overall mean."""
    r = residual - residual.mean()
    products, pairs = np.zeros(lags + 1), np.zeros(lags + 1)
    for s in runs(trip):
        x = r[s]
        size = 1 << int(np.ceil(np.log2(max(2 * len(x), 2))))
        spectrum = np.fft.rfft(x, size)
        acf = np.fft.irfft(spectrum * np.conj(spectrum), size)[: min(lags + 1, len(x))]
        products[: len(acf)] += acf
        pairs[: len(acf)] += len(x) - np.arange(len(acf))
    covariance = products / np.maximum(pairs, 1)
    return covariance / covariance[0] if covariance[0] > 0 else np.zeros(lags + 1)


def variance_by_period(
    residual: np.ndarray, trip: np.ndarray, seconds: float, longest: int = 4096
) -> tuple[np.ndarray, np.ndarray]:
    """Residual variance by length of its cycles: `(period [s], variance per octave)`, by Welch's averages (1967)."""
    lengths = [s.stop - s.start for s in runs(trip)]
    length = int(min(longest, max(lengths, default=0)))
    if length < 32:
        return np.empty(0), np.empty(0)
    length = 1 << int(np.floor(np.log2(length)))
    window = np.hanning(length)
    power, pieces = np.zeros(length // 2 + 1), 0
    for s in runs(trip):
        x = residual[s]
        for start in range(0, len(x) - length + 1, length // 2):
            piece = x[start : start + length]
            power += np.abs(np.fft.rfft((piece - piece.mean()) * window)) ** 2
            pieces += 1
    if not pieces:
        return np.empty(0), np.empty(0)
    # one-sided, per Hz; the ends, which have no mirror image, left out
    density = 2 * seconds * power[1:-1] / (pieces * np.sum(window**2))
    frequency = np.fft.rfftfreq(length, seconds)[1:-1]
    octave = np.floor(3 * np.log2(frequency / frequency[0])).astype(int)  # thirds of an octave, as acousticians use
    n = np.maximum(np.bincount(octave), 1)
    centre = np.bincount(octave, frequency) / n
    mean = np.bincount(octave, density * frequency) / n
    there = np.bincount(octave) > 0
    return 1.0 / centre[there], np.log(2) * mean[there]


def stretch(data: ReportData, rows: int = 240) -> slice | None:
    """The stretch of one test trip whose errors, before and after, are nearest to those of all test rows.

    Typical on purpose, not the best. Stretches that mostly stand still are skipped where there are others.
    """
    good = test_rows(data)
    if not good.any():
        return None
    trip = data.row("trip")
    square = [data.residual(w) ** 2 for w in ("before", "after")]
    whole = [float(np.sqrt(np.mean(s[good]))) + 1e-12 for s in square]
    measured = data.row("measured")
    spread = float(np.std(measured[good])) + 1e-12
    best, least = None, np.inf
    part = np.cumsum(np.r_[True, (np.diff(trip) != 0) | (np.diff(good.astype(int)) != 0)])
    pieces = [p for p in runs(part) if good[p.start]]
    long = [p for p in pieces if p.stop - p.start >= rows]  # of short ones, as where gaps are many, the longest
    for p in long or sorted(pieces, key=lambda p: p.start - p.stop)[:50]:
        n = p.stop - p.start
        length = min(rows, n)
        for start in range(p.start, p.stop - length + 1, max(length, (n - length) // 200)):
            here = slice(start, start + length)
            cost = sum(abs(np.log((np.sqrt(np.mean(s[here])) + 1e-12) / t)) for s, t in zip(square, whole, strict=True))
            cost += 4 * max(0.0, 0.8 - float(np.std(measured[here])) / spread)
            cost += 2 * np.log(rows / length)
            if cost < least:
                best, least = here, cost
    return best


def thin(n: int, most: int = 4000) -> np.ndarray:
    """At most so many of n rows, in order and the same every time."""
    return np.arange(n) if n <= most else np.sort(np.random.default_rng(0).choice(n, most, replace=False))
