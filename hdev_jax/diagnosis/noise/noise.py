"""The noise of a log: its colour, the level of each trip, the scale of each trip; and what makes it white."""

import itertools
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from hdev_jax.segments import trip_slices

__all__ = ["Noise", "estimate_noise", "log_likelihood_of_trip", "whiten"]

MAX_ORDER = 24
PIECE = 64  # rows at a time: one product of small matrices in place of a pass for each lag
BLOCK_S = 600.0
BLOCK_VARIANCES = (0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0)  # of the residual's own
LEVEL_SHARES = (0.0, 0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.7, 0.85)
LARGE_SHARE = 0.3  # of trips' means: from here on the grid is too coarse, and lags of the whole too inexact


@dataclass(frozen=True)
class Noise:
    """Gaussian working model of the residual: AR(p) inside a trip, plus a level and a scale of each trip.

    `coefficients[k]` predicts the row at position k of its trip from the k rows before it (the last line serves all
    later rows), `scales[k]` is the standard deviation of that prediction's error. `level_sd` is the standard deviation
    of the trips' intercepts, `block_sd` that of intercepts of blocks of `BLOCK_S` inside them: what wanders more slowly
    than an autoregression of a few rows can follow. `trip_scale` multiplies `scales`, by trip in the order of the rows.
    """

    coefficients: Float[np.ndarray, "position lag"]
    scales: Float[np.ndarray, " position"]
    level_sd: float
    trip_scale: Float[np.ndarray, " trip"]
    log_likelihood: float
    block_sd: float = 0.0

    @property
    def order(self) -> int:
        """Order of the autoregression."""
        return self.coefficients.shape[1]

    def after(self, trips: int) -> "Noise":
        """The noise of a log that begins so many trips later."""
        return replace(self, trip_scale=self.trip_scale[min(trips, len(self.trip_scale) - 1) :])


def _levinson(acov: np.ndarray, order: int) -> tuple[np.ndarray, np.ndarray]:
    """Predictors of every order up to `order` and the sd of their errors (Levinson 1946, Durbin 1960).

    Orders that the sequence cannot support have an infinite sd.
    """
    phi = np.zeros((order + 1, order))
    var = np.empty(order + 1)
    var[0] = acov[0]
    for k in range(1, order + 1):
        prev = phi[k - 1, : k - 1]
        reflection = (acov[k] - prev @ acov[k - 1 : 0 : -1]) / var[k - 1] if k > 1 else acov[1] / acov[0]
        if abs(reflection) >= 0.9999 and k > 1:  # no stationary noise has it: the lags of short trips are not exact
            var[k:] = np.inf
            break
        reflection = np.clip(reflection, -0.9999, 0.9999)
        phi[k, : k - 1] = prev - reflection * prev[::-1]
        phi[k, k - 1] = reflection
        var[k] = var[k - 1] * (1 - reflection**2)
    return phi, np.sqrt(np.maximum(var, 1e-300))


def _blocks(trip: np.ndarray, duration_s: np.ndarray) -> list[slice]:
    """Rows of each block of about `BLOCK_S`; a last piece under half of it joins the one before."""
    out = []
    for _, s in trip_slices(trip):
        clock = np.cumsum(duration_s[s])
        count = max(1, round(float(clock[-1]) / BLOCK_S))
        edges = np.searchsorted(clock, np.linspace(0, clock[-1], count + 1)[1:-1])
        out += [slice(int(a), int(b)) for a, b in itertools.pairwise(np.r_[s.start, s.start + edges, s.stop]) if b > a]
    return out


def _autocovariance(x: np.ndarray, slices: list[slice], order: int) -> np.ndarray:
    """Autocovariance about zero up to lag `order`: each lag with the number of pairs it has, so that short trips are
    not biased to white."""
    longest = max(s.stop - s.start for s in slices)
    acov, pairs = np.zeros(order + 1), np.zeros(order + 1)
    size = 1 << int(np.ceil(np.log2(2 * longest)))
    for s in slices:
        n = s.stop - s.start
        lags = min(order + 1, n)
        acov[:lags] += np.fft.irfft(np.abs(np.fft.rfft(x[s], size)) ** 2, size)[:lags]
        pairs[:lags] += n - np.arange(lags)
    pairs = np.maximum(pairs, 1.0)
    # divided by n, not by pairs, where there is plenty of either: that keeps the sequence positive definite
    return acov / (pairs if longest < 50 * order else pairs[0])


def estimate_noise(
    residual: Float[np.ndarray, " row"],
    trip: Int[np.ndarray, " row"],
    duration_s: Float[np.ndarray, " row"],
    *,
    levels: bool,
) -> Noise:
    """The colour of a residual, by trip: order by AIC up to 24, random intercepts of trips by maximum likelihood.

    `levels=False` where trips are too few for random intercepts. Trips of a scale of their own (`trip_scale`)
    are shrunk towards one common scale, as far as their number of rows allows.
    """
    slices = [s for _, s in trip_slices(trip)]
    common = float(np.sqrt(np.mean(residual**2)))
    if common < 1e-150:  # met exactly: nothing is left to have a colour
        return Noise(np.zeros((2, 1)), np.ones(2), 0.0, np.ones(len(slices)), 0.0)
    longest = max(s.stop - s.start for s in slices)
    order = int(max(1, min(MAX_ORDER, longest // 4)))
    acov = _autocovariance(residual / common, slices, order)
    levels = levels and len(slices) >= 4
    tried = [(share, acov - share * acov[0]) for share in (LEVEL_SHARES if levels else (0.0,))]
    inside = np.concatenate([residual[s] - np.mean(residual[s]) for s in slices]) / common
    if (between := 1.0 - float(np.mean(inside**2))) > LARGE_SHARE:
        colour = _autocovariance(inside, slices, order)
        tried += [(0.0, colour + between), *([(between, colour)] if levels else [])]

    best: tuple[float, Noise] | None = None
    falls, last = 0, -np.inf
    for share, rest in tried:
        # over the shares of the grid the likelihood has one maximum: once it has fallen twice it falls on
        if rest[0] <= 1e-12 or (falls == 2 and share in LEVEL_SHARES):
            continue
        phi, sd = _levinson(rest, order)
        aic = len(residual) * 2 * np.log(sd) + 2 * np.arange(order + 1)
        keep = max(1, int(np.argmin(aic)))
        noise = Noise(phi[: keep + 1, :keep], sd[: keep + 1] * common, float(np.sqrt(share)) * common, np.ones(1), 0.0)
        loglik = _log_likelihood(noise, residual, trip, slices) - keep
        falls, last = (falls + 1 if loglik < last else 0), loglik
        if best is None or loglik > best[0] + (2.0 if share > 0 and best[1].level_sd == 0 else 0.0):
            best = (loglik, noise)
    assert best is not None
    noise = best[1]
    # scale by trip from what is white, shrunk by the number of rows: 50 rows are worth as much as the common scale
    white = _filtered(residual[:, None], noise, trip)[:, 0]
    rows = np.array([s.stop - s.start for s in slices])
    own = np.array([np.mean(white[s] ** 2) for s in slices])
    pooled = float(np.mean(white**2))
    scale = np.sqrt((rows * own + 50.0 * pooled) / (rows + 50.0))
    noise = replace(noise, trip_scale=np.maximum(scale, 1e-6), log_likelihood=best[0])
    return replace(noise, block_sd=_block_sd(noise, residual, trip, duration_s, common))


def _block_sd(noise: Noise, residual: np.ndarray, trip: np.ndarray, duration_s: np.ndarray, common: float) -> float:
    """Standard deviation of the blocks' intercepts by maximum likelihood, 0 where it gains less than 5."""
    blocks = _blocks(trip, duration_s)
    if len(blocks) < 3 * len(np.unique(trip)) or len(residual) < 20 * len(blocks):
        return 0.0
    both = whiten(residual[:, None], noise, trip, duration_s)
    starts = np.array([b.start for b in blocks])
    uu = np.add.reduceat(both[:, 1] ** 2, starts)
    uz = np.add.reduceat(both[:, 1] * both[:, 0], starts)
    variances = np.array(BLOCK_VARIANCES)[:, None] * common**2
    gain = np.sum(0.5 * variances * uz**2 / (1 + variances * uu) - 0.5 * np.log1p(variances * uu), axis=1)
    k = int(np.argmax(gain))
    return float(np.sqrt(variances[k, 0])) if gain[k] > 5.0 else 0.0


def _log_likelihood(noise: Noise, residual: np.ndarray, trip: np.ndarray, slices: list[slice]) -> float:
    """Gaussian log-likelihood with the random intercepts integrated out."""
    both = _filtered(residual[:, None], noise, trip)
    z, u = both[:, 0], both[:, 1]
    logs = np.log(noise.scales)
    total = -0.5 * float(z @ z)
    for s in slices:
        first = min(noise.order, s.stop - s.start)  # rows that fewer than `order` rows go before
        total -= float(np.sum(logs[:first])) + (s.stop - s.start - first) * float(logs[noise.order])
        uu, uz = float(u[s] @ u[s]), float(u[s] @ z[s])
        g = noise.level_sd**2
        total += -0.5 * np.log1p(g * uu) + 0.5 * g * uz**2 / (1 + g * uu)
    return float(total)


def _filtered(
    columns: Float[np.ndarray, "row k"], noise: Noise, trip: Int[np.ndarray, " row"]
) -> Float[np.ndarray, "row k+1"]:
    """Columns, and a level of 1, less what the rows before predict of them, over the prediction's sd."""
    order, plain = noise.order, np.column_stack([columns, np.ones(len(columns))])
    out = np.empty_like(plain)
    # what a row keeps of those before it, as a matrix: of a trip's first rows, and of `PIECE` rows after others
    first, last = np.eye(order), np.r_[-noise.coefficients[order][::-1], 1.0] / noise.scales[order]
    for k in range(order):
        first[k, :k] = -noise.coefficients[k, :k][::-1]
    first /= noise.scales[:order, None]
    later = np.zeros((PIECE, PIECE + order))
    for k in range(PIECE):
        later[k, k : k + order + 1] = last
    for _, s in trip_slices(trip):
        begun = min(s.start + order, s.stop)
        out[s.start : begun] = first[: begun - s.start, : begun - s.start] @ plain[s.start : begun]
        for at in range(begun, s.stop, PIECE):
            rows = min(PIECE, s.stop - at)
            np.matmul(later[:rows, : rows + order], plain[at - order : at + rows], out=out[at : at + rows])
    return out


def whiten(
    columns: Float[np.ndarray, "row k"],
    noise: Noise,
    trip: Int[np.ndarray, " row"],
    duration_s: Float[np.ndarray, " row"],
) -> Float[np.ndarray, "row k+1"]:
    """Columns for generalised least squares: independent rows of variance 1, except for the random intercepts of trips.

    Random intercepts of blocks are taken out by their variance. The last column is an intercept of 1 of each trip;
    `Sums.evidence` takes those out by their variance.
    """
    k = columns.shape[1]
    out = _filtered(columns, noise, trip)
    for t, (_, s) in enumerate(trip_slices(trip)):
        out[s] /= noise.trip_scale[min(t, len(noise.trip_scale) - 1)]
    if noise.block_sd > 0:
        for b in _blocks(trip, duration_s):
            level = out[b, k].copy()
            square = float(level @ level)
            shrink = 1.0 - 1.0 / np.sqrt(1.0 + noise.block_sd**2 * square)
            out[b] -= (shrink / square) * np.outer(level, level @ out[b])
    return out


def log_likelihood_of_trip(white: Float[np.ndarray, "row column"], level_sd: float) -> Float[np.ndarray, " residual"]:
    """Of each of some whitened residuals of a trip, but for a constant, its random intercept integrated out; the last
    column is that of an intercept of 1, as `whiten` returns it."""
    left, level = white[:, :-1], white[:, -1]
    shared = level_sd**2 * (level @ left) ** 2 / (1.0 + level_sd**2 * float(level @ level))
    return -0.5 * (np.sum(left**2, axis=0) - shared)
