"""Scores of candidates from normal equations by cluster: no refit, no second look at the rows.

Everything is whitened (`whiten.py`), so a cluster's rows enter only through its Gram matrix of Jacobian, candidate
columns and residual. Gains, clustered tests, left-out gains, resampling and sign placebos are algebra on these.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy import stats

from hdev_jax.diagnosis.candidates import Candidate
from hdev_jax.inference import Clusters

__all__ = ["Evidence", "Score", "adjusted", "gather"]

ABSORBED = 3e-3  # share of a column left after projecting the Jacobian off, below which the log cannot show it


@dataclass(frozen=True)
class Score:
    """What a log says of one candidate beside what the vehicle has.

    `gain` in log-likelihood on training rows, `p_model` from it (χ²), `p_cluster` from a Wald test with jackknifed
    clusters (F), `left_out_gain` in log-likelihood over clusters left out in turn, `left` the share of its columns
    that the Jacobian does not hold.
    """

    candidate: Candidate
    beta: Float[np.ndarray, " k"]
    gain: float
    p_model: float
    p_cluster: float
    left_out_gain: float
    left: float

    @property
    def p(self) -> float:
        """Both tests have to agree."""
        return max(self.p_model, self.p_cluster)


@dataclass(frozen=True)
class Evidence:
    """Gram matrices by cluster of [Jacobian | candidates | residual], and the prior on the Jacobian's part."""

    grams: Float[np.ndarray, "cluster d d"]
    base: int
    precision: Float[np.ndarray, " base"]
    pull: Float[np.ndarray, " base"]
    rows: int

    def weighted(self, weight: Float[np.ndarray, " cluster"]) -> Float[np.ndarray, "d d"]:
        """One Gram matrix with each cluster counted so many times."""
        return np.tensordot(weight, self.grams, axes=1)

    def _normal(self, gram: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Normal matrix and right-hand side for the base columns and those at `at`."""
        index = np.r_[np.arange(self.base), at].astype(int)
        a = gram[..., index[:, None], index[None, :]].copy()
        b = gram[..., index, -1].copy()
        diagonal = np.arange(self.base)
        a[..., diagonal, diagonal] += self.precision
        b[..., : self.base] -= self.pull
        tiny = 1e-10 * np.einsum("...ii->...i", a)
        a[..., np.arange(len(index)), np.arange(len(index))] += tiny + 1e-300
        return a, b

    def base_reduction(self, gram: np.ndarray) -> float:
        """Half of what the base columns take off the sum of squares."""
        if not self.base:
            return 0.0
        a, b = self._normal(gram, np.empty(0, int))
        return 0.5 * float(b @ np.linalg.solve(a, b))

    def gain(self, gram: np.ndarray, at: Sequence[int], reduction: float | None = None) -> tuple[float, np.ndarray]:
        """Gain in log-likelihood of candidate columns (places from 0) over the base, and their coefficients."""
        a, b = self._normal(gram, self.base + np.asarray(at, dtype=int))
        x = np.linalg.solve(a, b)
        before = self.base_reduction(gram) if reduction is None else reduction
        return 0.5 * float(b @ x) - before, x[self.base :]

    def left(self, gram: np.ndarray, at: Sequence[int]) -> float:
        """Smallest share of the columns that is left after projecting the base columns off."""
        if not self.base:
            return 1.0
        shares = []
        for k in at:
            j = self.base + k
            a = gram[: self.base, : self.base]
            d = np.sqrt(np.maximum(np.diag(a), 1e-300))
            c = gram[: self.base, j] / d
            x = np.linalg.lstsq(a / np.outer(d, d), c, rcond=1e-10)[0]
            shares.append(1.0 - float(c @ x) / max(gram[j, j], 1e-300))
        return min(shares)

    def score(self, candidate: Candidate) -> Score:
        """All tests of one candidate."""
        total = self.grams.sum(axis=0)
        at = np.asarray(candidate.columns)
        k, g = len(at), len(self.grams)
        gain, beta = self.gain(total, at)
        p_model = float(stats.chi2.sf(2 * max(gain, 0.0), k))
        full, base = self._jackknife(self.base + at), self._jackknife(np.empty(0, int))
        left_out = self._loss(full, np.r_[np.arange(self.base), self.base + at])
        left_out_base = self._loss(base, np.arange(self.base))
        spread = full[:, self.base :] - beta
        covariance = (g - 1) / g * spread.T @ spread
        p_cluster = 1.0
        if g > k + 1:
            d = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
            wald = float((beta / d) @ np.linalg.pinv(covariance / np.outer(d, d), rcond=1e-10) @ (beta / d))
            p_cluster = float(stats.f.sf(wald * (g - k) / (k * (g - 1)), k, g - k))
        return Score(
            candidate, beta, gain, p_model, p_cluster, float(np.sum(left_out_base - left_out)), self.left(total, at)
        )

    def _jackknife(self, at: np.ndarray) -> np.ndarray:
        """Coefficients of base and `at` columns with each cluster left out in turn."""
        total = self.grams.sum(axis=0)
        a, b = self._normal(total - self.grams, at)
        d = np.sqrt(np.maximum(np.einsum("gii->gi", a), 1e-300))
        scaled = a / (d[:, :, None] * d[:, None, :])
        return np.linalg.solve(scaled, (b / d)[..., None])[..., 0] / d if a.shape[-1] else b

    def _loss(self, x: np.ndarray, index: np.ndarray) -> np.ndarray:
        """Half the sum of squares of each cluster under its own left-out coefficients."""
        grams = self.grams[:, index[:, None], index[None, :]]
        cross = self.grams[:, index, -1]
        quadratic = np.einsum("gi,gij,gj->g", x, grams, x)
        return 0.5 * (self.grams[:, -1, -1] - 2 * np.einsum("gi,gi->g", x, cross) + quadratic)

    def sign_placebos(self, candidate: Candidate, rng: np.random.Generator, draws: int) -> Float[np.ndarray, " draw"]:
        """Gains of the same columns with each cluster's sign drawn at random: what no consistent effect would give."""
        at = self.base + np.asarray(candidate.columns)
        out = np.empty(draws)
        for i in range(draws):
            sign = rng.choice([-1.0, 1.0], size=len(self.grams))
            gram = self.grams.sum(axis=0)
            flipped = np.tensordot(sign, self.grams[:, :, at], axes=1)
            inner = gram[np.ix_(at, at)]
            gram[:, at] = flipped
            gram[at, :] = flipped.T
            gram[np.ix_(at, at)] = inner
            out[i] = self.gain(gram, np.asarray(candidate.columns))[0]
        return out


def gather(
    jacobian: np.ndarray,
    candidates: np.ndarray,
    residual: np.ndarray,
    clusters: Clusters,
    *,
    moved: np.ndarray,
    prior_sd: np.ndarray,
) -> Evidence:
    """Gram matrices by cluster of whitened rows. `moved` is how far the present coefficients are from their tables."""
    z = np.concatenate([jacobian, candidates, residual[:, None]], axis=1)
    edges = np.flatnonzero(np.diff(clusters.ids)) + 1
    grams = np.stack([part.T @ part for part in np.split(z, edges)])  # one product per cluster: the only pass
    precision = 1.0 / prior_sd**2
    return Evidence(grams, jacobian.shape[1], precision, precision * moved, len(residual))


def adjusted(p: Sequence[float]) -> Float[np.ndarray, " k"]:
    """q-values that bound the share of false discoveries (Benjamini and Hochberg 1995)."""
    p = np.asarray(p, dtype=float)
    if not len(p):
        return p
    order = np.argsort(p)
    ranked = p[order] * len(p) / (np.arange(len(p)) + 1)
    q = np.minimum.accumulate(ranked[::-1])[::-1]
    out = np.empty_like(q)
    out[order] = np.minimum(q, 1.0)
    return out
