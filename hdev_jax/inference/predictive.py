"""What a prediction may be off by on trips that no fit has seen: a row's noise, and how a trip's errors add up."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy import optimize, special

from hdev_jax.inference.calibrate import STUDENT_DF, Calibration, Fit, Linearise, linearised, tabular
from hdev_jax.inference.clusters import LEAST_RATIO, Clusters, clusters_of
from hdev_jax.segments import Segments
from hdev_jax.targets import TargetName

__all__ = ["Spread", "covariance_root", "errors_left_out", "left_out", "spread_of", "sums_of"]

FEW = 2  # trips from which on a total is judged by trips; a single one by its autocorrelation
ENOUGH_ROWS = 20_000  # show the shape of a row's noise; every so many of more
MOST_FREEDOM = 200.0  # of a Student t that is a normal
MOST_LAG = 20  # rows: enough to separate what is left of a correlation from a row's own noise
DECAYS = np.linspace(0.3, 0.99, 70)  # of the correlation, from a row to the next
GROWS = 3.0  # least gain in log-likelihood, of rows worth independent ones, for a noise that grows
FAULT = 6.0  # scales: where outliers are weighed down, a row beyond this is an instrument's fault and no trip's energy


@dataclass(frozen=True)
class Spread:
    """Errors of new rows and of new trips, besides what the coefficients leave open.

    A row is off by a Student t of `freedom` degrees whose scale s is √(`scale`² + (`growth`·predicted)²), in the
    target's unit. The sum of a trip's rows, each weighed by w, has the variance `together`·Σw²s² + (`level`·Σws)²: what
    goes from row to row, and what all rows of a trip share. It is known to `total_freedom` degrees of freedom: one for
    each training trip, predicted by a fit without it, and fewer where trips differ in variance. Rows last about
    `row_s`. `open_times`: how much more the coefficients leave open, as a variance, than the fit's covariance says
    whose blocks of one trip err together.
    """

    scale: float
    growth: float
    freedom: float
    together: float
    level: float
    total_freedom: float
    row_s: float
    open_times: float = 1.0

    def rows(
        self, level: float, open_sd: Float[np.ndarray, " row"], predicted: Float[np.ndarray, " row"]
    ) -> Float[np.ndarray, " row"]:
        """Half the interval of each row, of which the coefficients leave `open_sd` open."""
        own = float(special.stdtrit(self.freedom, 0.5 + level / 2)) * np.sqrt(
            _square(self.scale, self.growth, predicted)
        )
        return np.hypot(float(special.ndtri(0.5 + level / 2)) * np.sqrt(self.open_times) * open_sd, own)

    def total(
        self, level: float, open_sd: float, weight: Float[np.ndarray, " row"], predicted: Float[np.ndarray, " row"]
    ) -> float:
        """Half the interval of the weighed sum of these rows, of which the coefficients leave `open_sd` open."""
        each = weight * np.sqrt(_square(self.scale, self.growth, predicted))
        own = self.together * float(np.sum(each**2)) + (self.level * float(np.sum(each))) ** 2
        return float(special.stdtrit(self.total_freedom, 0.5 + level / 2) * np.sqrt(self.open_times * open_sd**2 + own))


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
    fit: Calibration, rows: Fit, target: TargetName, weight: Float[np.ndarray, " row"],
    noise: Literal["normal", "student_t"] = "normal", *, linearise: Linearise = linearised,
) -> tuple[Spread, Clusters]:  # fmt: skip
    """The spread of a fit's errors on trips that it has not seen, from its own rows by leaving each trip out.

    **Arguments:** `rows` the padded rows of the fit; `weight` of a real row in its trip; `linearise` as `calibrate`
    takes it. **Returns:** the spread, and whose sums it was seen in.
    """
    n, robust = rows.rows, noise == "student_t"
    segments = rows.segments.take(np.arange(len(rows.segments)) < n)
    clusters, row_s = sums_of(segments), float(np.median(np.asarray(segments.duration_s)))
    error = np.asarray(rows.measured)[:n] - fit.predicted
    open_sd = np.zeros(clusters.count)
    if fit.table.free:
        x = linearise(fit.vehicle, fit.table, rows.segments, target)[1][:n]
        tail = (STUDENT_DF + 1.0) / (STUDENT_DF + (error / fit.sigma) ** 2) if robust else np.ones(n)
        counted = tail / (fit.sigma**2 * fit.inflation)
        error, open_sd = errors_left_out(x, error, counted, weight, clusters, tabular(fit.table)[1])
    # of one row the coefficients leave next to nothing open beside its noise
    spread = spread_of(error, fit.predicted, weight, clusters, open_sd, np.zeros(n), row_s=row_s, robust=robust)
    by_gls = all(c.known for c in fit.table.free)  # standard errors that hold the autocorrelation already
    if clusters.kind == "block" and not by_gls:  # as the inflation of the fit's covariance, at their full length
        lasting = _times(error / np.sqrt(_square(spread.scale, spread.growth, fit.predicted)), clusters)[0]
        spread = replace(spread, open_times=max(lasting / fit.inflation, 1.0))
    return spread, clusters


def errors_left_out(
    x: Float[np.ndarray, "row k"], r: Float[np.ndarray, " row"], counted: Float[np.ndarray, " row"],
    weight: Float[np.ndarray, " row"], clusters: Clusters, prior_sd: Float[np.ndarray, " k"],
) -> tuple[Float[np.ndarray, " row"], Float[np.ndarray, " cluster"]]:  # fmt: skip
    """Measured − predicted of each row by the fit without the row's cluster, in one step from the fit of all; and what
    that fit's coefficients leave open of the cluster's weighed sum, as a standard deviation.

    A fit bends towards the rows that it has seen, and towards the sums of few trips most of all.

    **Arguments:** `x` ∂ predicted / ∂θ and `r` measured − predicted at the fit; `counted`, the precision that each row
    counted for in it; `weight` of a row in a sum; `prior_sd` of the coefficients' tables.
    """
    x = x * prior_sd
    root = np.sqrt(counted)[:, None]
    grams, scores = clusters.grams(root * x), clusters.sums(counted[:, None] * x * r[:, None])
    rest = np.eye(x.shape[1]) + grams.sum(axis=0) - grams
    sums = clusters.sums(weight[:, None] * x)
    moved, along = np.moveaxis(np.linalg.solve(rest, np.stack([scores, sums], axis=-1)), -1, 0)
    error = r + np.sum(x * moved[clusters.ids], axis=1)
    return error, np.sqrt(np.maximum(np.sum(sums * along, axis=1), 0.0))


def spread_of(
    error: Float[np.ndarray, " row"], predicted: Float[np.ndarray, " row"], weight: Float[np.ndarray, " row"],
    clusters: Clusters, open_sd: Float[np.ndarray, " cluster"], open_row: Float[np.ndarray, " row"], *, row_s: float,
    robust: bool = False,
) -> Spread:  # fmt: skip
    """The spread that these errors of rows, of which no fit has seen their cluster, are one sample of.

    **Arguments:** `error` measured − predicted; `weight` of a row in a sum; `open_sd` of each cluster's weighed sum and
    `open_row` of each row: what the coefficients leave open of them is no noise. `row_s`, what a row lasts. `robust`: a
    row beyond `FAULT` scales is no energy.
    """
    scale, growth, freedom, loss = _of_rows(error, np.zeros(len(error)), open_row)
    grown = _of_rows(error, predicted, open_row)
    # correlated rows hold less information: in a short drive the noise is soon larger by chance where the energy is
    if (loss - grown[3]) * len(error) / _times(error / scale, clusters)[0] > GROWS:
        scale, growth, freedom, _ = grown
    square = _square(scale, growth, predicted)
    if robust:
        error = np.clip(error, -FAULT * np.sqrt(square), FAULT * np.sqrt(square))
    z = error / np.sqrt(square)
    # a scale estimated from few trips is itself uncertain: heavier tails (Satterthwaite 1946, over trips)
    by_trip = clusters.sums(z**2)
    few = len(by_trip) < 2
    own = 2.1 if few else 2.0 * np.sum(by_trip) ** 2 / max(len(by_trip) * float(np.var(by_trip, ddof=1)), 1e-12)
    freedom = 1.0 / (1.0 / freedom + 1.0 / max(float(own), 2.1))
    times, squares = _times(z, clusters)
    if clusters.kind == "block":
        worth = float(np.clip(len(z) / times, 1.0, clusters.count))
        return Spread(scale, growth, freedom, float(np.mean(z**2)) * times, 0.0, worth, row_s)
    each = weight * np.sqrt(square)
    sums, alone, shared = clusters.sums(weight * error) ** 2, clusters.sums(each**2), clusters.sums(each) ** 2
    seen = alone > 0  # a trip that stood all the time has no work
    if not seen.any():
        return Spread(scale, growth, freedom, 1.0, 0.0, 1.0, row_s)
    sums, alone, shared, open_sd = (a[seen] for a in (sums, alone, shared, open_sd))

    def excess(together: float) -> float:
        return float(np.mean(sums / (open_sd**2 + together * alone))) - 1.0

    low, high = LEAST_RATIO, max(2.0 * float(np.max(sums / alone)), 1.0)
    whole = low if excess(low) <= 0 else float(optimize.root_scalar(excess, bracket=(low, high), method="brentq").root)
    # what rows of a trip have in common beyond their correlation from row to row grows with the trip
    together = min(whole, float(np.mean(z**2)) * times)
    level = np.sqrt((whole - together) * float(np.sum(alone)) / float(np.sum(shared)))
    # squares of n normal sums tell a variance to n degrees; where theirs differ, by a squared coefficient of variation
    # of h, their own is (2 + 3h)·mean² (Satterthwaite 1946). What goes from row to row alone differs like that.
    unlike = _unlike(z, clusters, squares) * (together / whole) ** 2
    total_freedom = float(np.sum(seen)) / (1.0 + 1.5 * unlike)
    return Spread(scale, growth, freedom, together, float(level), total_freedom, row_s)


def _unlike(z: Float[np.ndarray, " row"], clusters: Clusters, squares: float) -> float:
    """By how much trips differ in the variance of their rows, beyond what chance makes of rows whose squares go
    together `squares` times: squared coefficient of variation. Levels of trips are taken off: they are no variance."""
    count, square = np.bincount(clusters.ids), _without_means(z, clusters) ** 2
    each, mean = clusters.sums(square) / count, float(np.mean(square))
    if len(count) < 2 or not mean > 0:
        return 0.0
    inside = float(np.mean((square - each[clusters.ids]) ** 2))
    return max((float(np.var(each, ddof=1)) - inside * squares * float(np.mean(1.0 / count))) / mean**2, 0.0)


def _without_means(z: Float[np.ndarray, " row"], clusters: Clusters) -> Float[np.ndarray, " row"]:
    return z - (clusters.sums(z) / np.bincount(clusters.ids))[clusters.ids]


def _times(z: Float[np.ndarray, " row"], clusters: Clusters) -> tuple[float, float]:
    """How much wider a sum is, as a variance, than of independent rows, by the correlation from row to row: no block of
    a trip is long enough to show it. An AR(1) with white noise on it, correlations A·ρᵏ: 1 − A + A·(1 + ρ)/(1 − ρ).
    And the same of a sum of squares, whose correlations are A²·ρ²ᵏ where rows are normal (Isserlis 1918).

    Correlations of a short series come out too small, by what its mean is uncertain (Kendall 1954): added again. Of
    several trips the mean of each, its level, is taken off.
    """
    ids = clusters.ids if clusters.kind == "trip" else np.zeros(len(z), dtype=int)
    if clusters.kind == "trip":
        z = _without_means(z, clusters)
    n, square = len(z) / (ids[-1] + 1), float(np.mean(z**2))
    lags = np.arange(1, min(MOST_LAG, int(n) // 5) + 1)
    if not len(lags) or not square > 0:
        return 1.0, 1.0
    seen = np.array([np.mean((z[:-k] * z[k:])[ids[:-k] == ids[k:]]) for k in lags]) / square
    powers, times, squares = DECAYS[:, None] ** lags, 1.0, 1.0
    for _ in range(4):
        r = (seen + times / n) / (1.0 + times / n)
        if r[0] < 2.0 / np.sqrt(len(z)):
            return 1.0, 1.0
        share = np.clip(powers @ r / np.sum(powers**2, axis=1), 0.0, 1.0)
        best = int(np.argmin(np.sum((r - share[:, None] * powers) ** 2, axis=1)))
        a, rho = float(share[best]), float(DECAYS[best])
        times, squares = 1.0 + 2.0 * a * rho / (1.0 - rho), 1.0 + 2.0 * a**2 * rho**2 / (1.0 - rho**2)
    return times, squares


def _of_rows(error: np.ndarray, predicted: np.ndarray, open_row: np.ndarray) -> tuple[float, float, float, float]:
    """Scale, growth, degrees of freedom of a row's Student t by maximum likelihood; −log of that, mean of the rows."""
    every = max(len(error) // ENOUGH_ROWS, 1)
    error, size, besides = error[::every], np.abs(predicted[::every]), open_row[::every] ** 2
    unit = max(float(np.sqrt(np.mean(error**2))), 1e-9 * max(float(np.max(size)), 1.0))
    typical = max(float(np.sqrt(np.mean(size**2))), 1e-300)
    error, size, besides = error / unit, size / typical, besides / unit**2

    def loss(z: np.ndarray) -> tuple[float, np.ndarray]:  # and its slopes
        half, scale, growth = 0.5 * np.exp(z[2]), np.exp(2.0 * z[0]), (z[1] * size) ** 2
        square = scale + growth + besides
        ratio = error**2 / square / (2.0 * half)
        constant = special.gammaln(half + 0.5) - special.gammaln(half) - 0.5 * np.log(2.0 * np.pi * half)
        share, tail = ratio / (1.0 + ratio), np.log1p(ratio)
        by_square = (0.5 - (half + 0.5) * share) / square
        by_half = special.digamma(half + 0.5) - special.digamma(half) - 0.5 / half
        by_half = float(np.mean(tail - (half + 0.5) / half * share)) - float(by_half)
        slopes = 2.0 * scale * np.mean(by_square), 2.0 * z[1] * np.mean(by_square * size**2), half * by_half
        return float(np.mean(0.5 * np.log(square) + (half + 0.5) * tail)) - float(constant), np.array(slopes)

    most = 2.0 if np.any(size > 0) else 0.0  # where nothing is predicted nothing grows
    bounds = [(np.log(1e-3), np.log(2.0)), (0.0, most), (np.log(2.1), np.log(MOST_FREEDOM))]
    start = np.array([np.log(0.7), min(0.3, most), np.log(8.0)])
    best = optimize.minimize(loss, start, jac=True, method="L-BFGS-B", bounds=bounds)
    z = best.x
    return unit * float(np.exp(z[0])), float(z[1]) * unit / typical, float(np.exp(z[2])), float(best.fun)
