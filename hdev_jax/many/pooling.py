"""Partial pooling in closed form: estimates that vary about a common mean by more than their errors.

x_v ~ N(θ_v, s_v²), θ_v ~ N(μ, τ²). τ² is Paule and Mandel's (J. Res. NBS 87, 1982): Σ w_v (x_v − μ)² = n − 1 with
w_v = 1/(s_v² + τ²). The standard error of the mean is Hartung and Knapp's (Statistics in Medicine 20, 2001), with n − 1
degrees of freedom, but not below the one by the weights.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy import optimize, stats

__all__ = ["MANY", "Pooled", "cauchy", "pooled", "shrunk", "without_each"]


MANY = 200  # estimates above which the spread over all stands for that without one: its error is 5 % or less


@dataclass(frozen=True)
class Pooled:
    """A common `mean` of `n` estimates, its standard `error`, and the standard deviation τ `between` them."""

    mean: float
    error: float
    between: float
    n: int
    p_alike: float  # Cochran's Q: could all be the same?

    @property
    def freedom(self) -> int:
        """Degrees of freedom of the mean's error."""
        return max(self.n - 1, 1)

    def p(self, null: float = 0.0) -> float:
        """Two-sided p-value of the mean against `null`."""
        return float(2.0 * stats.t.sf(abs(self.mean - null) / self.error, self.freedom))


def pooled(value: Float[np.ndarray, " n"], sd: Float[np.ndarray, " n"]) -> Pooled:
    """The common mean of at least two estimates. Raises `ValueError` for fewer, or an sd that is not positive."""
    n = len(value)
    if n < 2 or not (np.all(np.isfinite(value)) and np.all(np.isfinite(sd)) and np.all(sd > 0)):
        raise ValueError("two or more finite estimates with positive sds are expected")
    own = sd**2

    def misfit(t2: float) -> float:
        w = 1.0 / (own + t2)
        return float(np.sum(w * (value - np.sum(w * value) / np.sum(w)) ** 2)) - (n - 1)

    at_null = misfit(0.0)
    t2 = 0.0
    if at_null > 0:
        most = float(np.sum((value - np.mean(value)) ** 2)) + float(np.max(own))
        while misfit(most) > 0:
            most *= 4.0
        t2 = optimize.root_scalar(misfit, bracket=(0.0, most), xtol=1e-12 * most, rtol=1e-12).root
    w = 1.0 / (own + t2)
    mean = float(np.sum(w * value) / np.sum(w))
    spread = float(np.sum(w * (value - mean) ** 2)) / (n - 1)
    error = float(np.sqrt(max(spread, 1.0) / np.sum(w)))
    return Pooled(mean, error, float(np.sqrt(t2)), n, float(stats.chi2.sf(at_null + n - 1, n - 1)))


def shrunk(
    value: Float[np.ndarray, " n"], sd: Float[np.ndarray, " n"], pool: Pooled
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Each estimate shrunk towards the common mean, and its sd, which includes that of the mean (empirical Bayes)."""
    share = pool.between**2 / (pool.between**2 + sd**2)  # of the vehicle's own
    return share * value + (1 - share) * pool.mean, np.sqrt(share * sd**2 + ((1 - share) * pool.error) ** 2)


def without_each(
    value: Float[np.ndarray, " n"], sd: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Each estimate against the prediction from all others: difference, its sd, and the two-sided p-value.

    The p-value is by Student's t with n − 2 degrees of freedom."""
    n = len(value)
    away, error = np.empty(n), np.empty(n)
    if n > MANY:  # one of so many hardly moves the spread: that of all, and the mean of the others in closed form
        pool = pooled(value, sd)
        w = 1.0 / (sd**2 + pool.between**2)
        left = np.sum(w) - w
        away = value - (np.sum(w * value) - w * value) / left
        widened = pool.error**2 * np.sum(w) / left
        error = np.sqrt(sd**2 + pool.between**2 + widened)
        return away, error, 2.0 * stats.t.sf(np.abs(away) / error, n - 2)
    for k in range(n):
        other = np.arange(n) != k
        pool = pooled(value[other], sd[other])
        away[k] = value[k] - pool.mean
        error[k] = np.sqrt(sd[k] ** 2 + pool.between**2 + pool.error**2)
    return away, error, 2.0 * stats.t.sf(np.abs(away) / error, max(n - 2, 1))


def cauchy(p: Float[np.ndarray, " n"]) -> float:
    """One p-value from several of the same hypothesis, however they depend on each other (Liu and Xie, JASA 115,
    2020)."""
    t = np.mean(1.0 / np.tan(np.pi * np.clip(p, 1e-15, 1.0 - 1e-6)))
    return float(np.clip(stats.cauchy.sf(t), 0.0, 1.0))
