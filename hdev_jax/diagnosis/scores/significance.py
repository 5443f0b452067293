"""What chance could do: tests with few clusters, many candidates, and many ways to have each."""

import numpy as np
from jaxtyping import Float
from scipy import special, stats

__all__ = ["clusters_needed", "clusters_to_tell", "effective_number", "least_clusters", "ruled_out", "wald"]


def least_clusters(k: int) -> int:
    """The least number of clusters for a test of `k` numbers."""
    return k + 2


def wald(
    beta: Float[np.ndarray, "*way k"],
    left_out: Float[np.ndarray, "cluster *way k"],
    freedom: Float[np.ndarray, "*way"] | None = None,
) -> Float[np.ndarray, "*way"]:
    """p of coefficients against zero, their covariance from clusters left out in turn (Hotelling's F); `freedom` of the
    covariance, where clusters are not alike."""
    g, k = left_out.shape[0], left_out.shape[-1]
    if g < least_clusters(k):
        return np.ones(beta.shape[:-1])
    spread = np.moveaxis(left_out - beta, 0, -2)
    covariance = (g - 1) / g * np.matmul(np.swapaxes(spread, -1, -2), spread)
    d = np.sqrt(np.maximum(np.einsum("...ii->...i", covariance), 1e-300))
    inverse = np.linalg.pinv(covariance / (d[..., :, None] * d[..., None, :]), rcond=1e-10)
    w = np.einsum("...i,...ij,...j->...", beta / d, inverse, beta / d)
    f = g - k if freedom is None else freedom
    return np.asarray(special.fdtrc(k, f, np.maximum(w, 0.0) * f / (k * (f + k - 1))))  # F's upper tail


def clusters_needed(p: float, k: int, clusters: int, level: float, rests_on: float | None = None) -> int | None:
    """How many clusters would bring a Wald test of `k` numbers from `p` down to `level`, its size staying as it is.

    `rests_on`: how many of them the numbers rest on, where that is the test's freedom (`Evidence.rests_on`); it grows
    as their number does. **Returns:** None where twenty times as many are not enough.
    """
    if clusters < least_clusters(k):
        return None
    share = 1.0 if rests_on is None else float(np.clip(rests_on, k + 1, clusters)) / clusters
    statistic = float(stats.f.isf(p, k, share * clusters - k))
    more = np.arange(clusters, 20 * clusters + 1)
    enough = stats.f.sf(statistic * more / clusters, k, share * more - k) <= level
    return int(more[np.argmax(enough)]) if enough.any() else None


def clusters_to_tell(share: float, k: int, level: float, most: int = 1000) -> int | None:
    """How many clusters make `k` numbers that explain this share of the clusters' differences significant at `level`.

    By the F of a regression of the clusters' means on them, in about half of the logs. None where `most` are too few.
    """
    n = np.arange(k + 2, most + 1)
    enough = stats.f.sf(share / (1.0 - share) * (n - k - 1) / k, k, n - k - 1) <= level
    return int(n[np.argmax(enough)]) if enough.any() else None


def ruled_out(share: float, p: float, k: int, clusters: int, level: float = 0.05) -> bool:
    """Whether a p as large as this would be rarer than `level` if `k` numbers explained this share of the clusters'
    differences: a noncentral F, averaged over normal columns of so many clusters."""
    free = clusters - k - 1
    if free < 1:
        return False
    amounts = stats.chi2.ppf((np.arange(50) + 0.5) / 50, clusters - 1) * share / (1.0 - share)
    return float(np.mean(stats.ncf.cdf(stats.f.isf(p, k, free), k, free, amounts))) < level


def effective_number(gram: Float[np.ndarray, "k k"]) -> float:
    """How many independent tests columns amount to, by the eigenvalues of their correlations: (Σ√λ)²/Σλ (Galwey,
    Genetic Epidemiology 33, 2009).

    One where all are alike (or there is none), their number where none is like another. The same threshold at
    neighbouring values of a grid is nearly the same test.
    """
    d = np.sqrt(np.diag(gram))
    if len(d) < 2:
        return 1.0
    each = np.maximum(np.linalg.eigvalsh(gram / np.outer(d, d)), 0.0)
    return float(np.sum(np.sqrt(each)) ** 2 / np.sum(each))
