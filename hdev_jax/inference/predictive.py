"""What a prediction may be off by on trips that no fit has seen: a row's noise, and how a trip's errors add up."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy import optimize, special, stats

from hdev_jax.inference.calibrate import STUDENT_DF, Calibration, Fit, jacobian
from hdev_jax.inference.clusters import LEAST_RATIO, Clusters, clusters_of
from hdev_jax.inference.design import tabular
from hdev_jax.physics.vehicle import Target
from hdev_jax.segments import Segments

__all__ = ["Spread", "covariance_root", "errors_left_out", "left_out", "spread_of", "sums_of"]

FEW = 2  # trips from which on a total is judged by trips; of a single one by its blocks

ENOUGH_ROWS = 20_000  # tell the shape of a row's noise; every so many of more
MOST_FREEDOM = 200.0  # of a Student t that is a normal
MOST_LAG = 20  # rows: enough to tell what is left of a correlation from a row's own noise
DECAYS = np.linspace(0.3, 0.99, 70)  # of the correlation, from a row to the next
FAULT = 6.0  # scales: where outliers are weighed down, a row beyond this is an instrument's fault and no trip's energy


@dataclass(frozen=True)
class Spread:
    """Errors of new rows and of new trips, besides what the coefficients leave open.

    A row is off by a Student t of `freedom` degrees whose scale is √(`scale`² + (`growth`·predicted)²), in the target's
    unit. The weighed sum of a trip's rows has `together` times the sum of the squares of those scales as its variance,
    which is known to `total_freedom` degrees of freedom: one for each training trip, predicted by a fit without it.
    """

    scale: float
    growth: float
    freedom: float
    together: float
    total_freedom: float

    def row(self, level: float, predicted: Float[np.ndarray, " row"]) -> Float[np.ndarray, " row"]:
        """Half the interval of each row, the coefficients known."""
        reach = float(stats.t.ppf(0.5 + level / 2, self.freedom))
        return reach * np.sqrt(_square(self.scale, self.growth, predicted))

    def total(
        self, level: float, open_sd: float, weight: Float[np.ndarray, " row"], predicted: Float[np.ndarray, " row"]
    ) -> float:
        """Half the interval of the weighed sum of these rows, of which the coefficients leave `open_sd` open."""
        own = self.together * float(np.sum(weight**2 * _square(self.scale, self.growth, predicted)))
        return float(stats.t.ppf(0.5 + level / 2, self.total_freedom) * np.sqrt(open_sd**2 + own))


def _square(scale: float, growth: float, predicted: Float[np.ndarray, " row"]) -> Float[np.ndarray, " row"]:
    return scale**2 + (growth * predicted) ** 2


def sums_of(segments: Segments) -> Clusters:
    """Whose sums a trip's total is judged by: trips, or blocks of time where there is but one."""
    return clusters_of(np.asarray(segments.trip), np.asarray(segments.duration_s), few=FEW)


def covariance_root(covariance: Float[np.ndarray, "k k"]) -> Float[np.ndarray, "k k"]:
    """R with RRᵀ = covariance, which may be singular."""
    d = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    values, vectors = np.linalg.eigh(covariance / np.outer(d, d))
    return d[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))


def left_out(
    fit: Calibration, rows: Fit, target: Target, weight: Float[np.ndarray, " row"],
    noise: Literal["normal", "student_t"] = "normal",
) -> tuple[Spread, Clusters]:  # fmt: skip
    """The spread of a fit's errors on trips that it has not seen, from its own rows by leaving each trip out.

    **Arguments:** `rows` the padded rows of the fit; `weight` of a real row in a trip's total. **Returns:** the spread,
    and whose sums it was seen in.
    """
    n = rows.rows
    segments = rows.segments.take(np.arange(len(rows.segments)) < n)
    clusters = sums_of(segments)
    left = np.asarray(rows.measured)[:n] - fit.predicted
    tail = (STUDENT_DF + 1.0) / (STUDENT_DF + (left / fit.sigma) ** 2) if noise == "student_t" else np.ones(n)
    x = jacobian(fit.vehicle, fit.table, rows.segments, target)[:n]
    error = left
    open_sd = np.zeros(clusters.count)
    if fit.table.free:
        error = errors_left_out(x, left, tail / (fit.sigma**2 * fit.inflation), clusters, tabular(fit.table)[1])
        open_sd = np.linalg.norm(clusters.sums(weight[:, None] * x) @ covariance_root(fit.covariance), axis=1)
    return spread_of(error, fit.predicted, weight, clusters, open_sd, robust=noise == "student_t"), clusters


def errors_left_out(
    x: Float[np.ndarray, "row k"], r: Float[np.ndarray, " row"], counted: Float[np.ndarray, " row"],
    clusters: Clusters, prior_sd: Float[np.ndarray, " k"],
) -> Float[np.ndarray, " row"]:  # fmt: skip
    """Measured − predicted of each row by the fit without the row's cluster, in one step from the fit of all.

    A fit bends towards the rows that it has seen, and towards the sums of few trips most of all.

    **Arguments:** `x` ∂ predicted / ∂θ and `r` measured − predicted at the fit; `counted`, the precision that each row
    counted for in it; `prior_sd` of the coefficients' tables.
    """
    x = x * prior_sd
    root = np.sqrt(counted)[:, None]
    grams, scores = clusters.grams(root * x), clusters.sums(counted[:, None] * x * r[:, None])
    rest = np.eye(x.shape[1]) + grams.sum(axis=0) - grams
    moved = np.linalg.solve(rest, scores[:, :, None])[:, :, 0]
    return r + np.sum(x * moved[clusters.ids], axis=1)


def spread_of(
    error: Float[np.ndarray, " row"], predicted: Float[np.ndarray, " row"], weight: Float[np.ndarray, " row"],
    clusters: Clusters, open_sd: Float[np.ndarray, " cluster"], *, robust: bool = False,
) -> Spread:  # fmt: skip
    """The spread that these errors of rows, of which no fit has seen their cluster, are one sample of.

    **Arguments:** `error` measured − predicted; `weight` of a row in a sum; `open_sd` of each cluster's weighed sum:
    what the coefficients leave open of it is no noise. `robust`: a row beyond `FAULT` scales is no energy.
    """
    scale, growth, freedom = _of_rows(error, predicted)
    square = _square(scale, growth, predicted)
    if robust:
        error = np.clip(error, -FAULT * np.sqrt(square), FAULT * np.sqrt(square))
    # a scale that few trips have told is itself uncertain: tails of its own (Satterthwaite 1946, over trips)
    told = clusters.sums(error**2 / square)
    known = 2.0 * np.sum(told) ** 2 / max(len(told) * float(np.var(told, ddof=1)), 1e-12) if len(told) > 1 else 2.1
    freedom = 1.0 / (1.0 / freedom + 1.0 / max(float(known), 2.1))
    if clusters.kind == "block":
        together, total_freedom = _of_one_trip(error / np.sqrt(square), clusters.count)
        return Spread(scale, growth, freedom, together, total_freedom)
    sums, alone = clusters.sums(weight * error) ** 2, clusters.sums(weight**2 * square)

    def excess(together: float) -> float:
        return float(np.mean(sums / (open_sd**2 + together * alone))) - 1.0

    low, high = LEAST_RATIO, max(2.0 * float(np.max(sums / np.maximum(alone, 1e-300))), 1.0)
    together = low if excess(low) <= 0 else optimize.root_scalar(excess, bracket=(low, high), method="brentq").root
    return Spread(scale, growth, freedom, float(together), float(clusters.count))


def _of_one_trip(z: Float[np.ndarray, " row"], blocks: int) -> tuple[float, float]:
    """How a trip's errors add up, from the one trip that there is: its autocorrelation, which no block of it is long
    enough to show. An AR(1) with white noise on it, correlations A·ρᵏ, makes sums 1 − A + A·(1 + ρ)/(1 − ρ) times as
    wide, as a variance, as independent rows; the trip is worth so many rows fewer.

    Correlations of a short series come out too small, by what its mean is uncertain (Kendall 1954): added again.
    """
    n, square = len(z), float(np.mean(z**2))
    lags = np.arange(1, min(MOST_LAG, n // 5) + 1)
    if not len(lags) or not square > 0:
        return 1.0, 1.0
    seen = np.array([np.mean(z[:-k] * z[k:]) for k in lags]) / square
    powers = DECAYS[:, None] ** lags
    times = 1.0
    for _ in range(4):
        r = (seen + times / n) / (1.0 + times / n)
        if r[0] < 2.0 / np.sqrt(n):  # as white as can be told
            return square, float(blocks)
        share = np.clip(powers @ r / np.sum(powers**2, axis=1), 0.0, 1.0)
        best = int(np.argmin(np.sum((r - share[:, None] * powers) ** 2, axis=1)))
        times = 1.0 + share[best] * 2.0 * DECAYS[best] / (1.0 - DECAYS[best])
    return square * float(times), float(np.clip(n / times, 1.0, blocks))


def _of_rows(error: np.ndarray, predicted: np.ndarray) -> tuple[float, float, float]:
    """Scale, growth and degrees of freedom of a row's Student t, by maximum likelihood."""
    every = max(len(error) // ENOUGH_ROWS, 1)
    error, size = error[::every], np.abs(predicted[::every])
    unit = max(float(np.sqrt(np.mean(error**2))), 1e-9 * max(float(np.max(size)), 1.0))
    error, size = error / unit, size / unit

    def loss(z: np.ndarray) -> float:
        half, square = 0.5 * np.exp(z[2]), np.exp(2.0 * z[0]) + (z[1] * size) ** 2
        constant = special.gammaln(half + 0.5) - special.gammaln(half) - 0.5 * np.log(2.0 * np.pi * half)
        tail = (half + 0.5) * np.log1p(error**2 / square / (2.0 * half))
        return float(np.mean(0.5 * np.log(square) + tail)) - float(constant)

    typical = max(float(np.median(size)), 1e-9)
    bounds = [(np.log(1e-3), np.log(2.0)), (0.0, 2.0 / typical), (np.log(2.1), np.log(MOST_FREEDOM))]
    start = np.array([np.log(0.7), 0.1 / typical, np.log(8.0)])
    z = optimize.minimize(loss, start, method="L-BFGS-B", bounds=bounds).x
    return unit * float(np.exp(z[0])), float(z[1]), float(np.exp(z[2]))
