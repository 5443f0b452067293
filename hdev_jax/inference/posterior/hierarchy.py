"""A fleet's coefficients by exact draws on sufficient statistics: linear in them, normal noise, vehicles that resemble.

r_v = x·θ_v + ε, ε ~ N(0, σ²); θ_v ~ N(μ, diag τ²); μ ~ N(table); τ half-t of the size of the tables' sds; σ² as in
`linear`. The vehicles' coefficients and the fleet's mean are integrated out by hand; what is left, (log τ, log σ²), has
as many dimensions as coefficients and one more, and is drawn from a Student t around its mode, each draw accepted or
not by its odds (independence Metropolis: Tierney, Annals of Statistics 22 (1994)). Given those, mean and vehicles are
drawn exactly. All draws are made at once, in NumPy (a program would take longer to compile than they take to make), and
none sees the rows: only their sums.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float

from hdev_jax.inference.design import LinearFit
from hdev_jax.inference.linear import LEAST_ROWS
from hdev_jax.inference.posterior.draws import Draws
from hdev_jax.inference.posterior.models import POOL_FREEDOM

__all__ = ["Resembling", "Sums", "drawn", "fleet_draws", "marginal", "resembling"]

PROPOSAL_FREEDOM = 6.0  # tails of the proposal: heavier than the posterior's, so that no draw sticks
WIDER = 1.1  # and a little wider
PIECE = 200_000  # vehicles times draws at a time: columns that stay in the cache

Columns = list[np.ndarray]


class Sums(NamedTuple):
    """Statistics of each vehicle from the tables' values, in units of the tables' sds and of the noise believed."""

    gram: Float[np.ndarray, "vehicle k k"]
    moment: Float[np.ndarray, "vehicle k"]
    square: float
    rows: float


def _lower(a: Sequence[Sequence[Any]]) -> list[Columns]:
    """Cholesky's root of many small matrices, entry by entry: a call for each would be the cost."""
    k = len(a)
    low: list[Columns] = [[a[0][0]] * k for _ in range(k)]
    for j in range(k):
        below = a[j][j] - sum(low[j][p] ** 2 for p in range(j))
        low[j][j] = np.sqrt(np.maximum(below, 1e-300))
        for i in range(j + 1, k):
            low[i][j] = (a[i][j] - sum(low[i][p] * low[j][p] for p in range(j))) / low[j][j]
    return low


def _forward(low: list[Columns], b: Columns) -> Columns:
    """L⁻¹b."""
    out: Columns = []
    for i, right in enumerate(b):
        out.append((right - sum(low[i][p] * out[p] for p in range(i))) / low[i][i])
    return out


def _backward(low: list[Columns], b: Columns) -> Columns:
    """L⁻ᵀb."""
    k = len(b)
    out: Columns = [b[0]] * k
    for i in reversed(range(k)):
        out[i] = (b[i] - sum(low[p][i] * out[p] for p in range(i + 1, k))) / low[i][i]
    return out


def _parts(phi: Float[np.ndarray, "n dim"], data: Sums) -> Any:
    """Of (log τ, log σ²): τ⁻², roots and half-solved right sides by vehicle; root and right side of the mean."""
    vehicles, k = data.moment.shape
    tight, variance = np.exp(-2.0 * phi[:, :k]), np.exp(phi[:, k])
    low = _lower([[data.gram[:, i, j] / variance[:, None] + (tight[:, i : i + 1] if i == j else 0.0)
                   for j in range(k)] for i in range(k)])  # fmt: skip
    half = _forward(low, [data.moment[:, i] / variance[:, None] for i in range(k)])
    one = np.ones_like(half[0])
    cross = [_forward(low, [tight[:, j : j + 1] * one if i == j else 0.0 * one for i in range(k)]) for j in range(k)]
    each = np.moveaxis(np.array(cross), 2, 0).reshape(len(phi), k, k * vehicles)
    taken = each @ np.swapaxes(each, 1, 2)
    own = [[(vehicles * tight[:, a] + 1.0 if a == b else 0.0) - taken[:, a, b] for b in range(k)] for a in range(k)]
    right = list((each @ np.moveaxis(np.array(half), 1, 0).reshape(len(phi), k * vehicles, 1))[..., 0].T)
    return tight, variance, low, half, _lower(own), right


def marginal(phi: Float[np.ndarray, "n dim"], data: Sums) -> Float[np.ndarray, " n"]:
    """Log posterior of (log τ, log σ²), coefficients integrated out, up to a constant."""
    vehicles, k = data.moment.shape
    tight, variance, low, half, root, right = _parts(phi, data)
    out = -0.5 * data.rows * phi[:, k] - 0.5 * data.square / variance
    out = out + 0.5 * vehicles * np.sum(np.log(tight), axis=1)
    out = out + sum(np.sum(0.5 * half[i] ** 2 - np.log(low[i][i]), axis=1) for i in range(k))
    y = _forward(root, right)
    out = out + sum(0.5 * y[i] ** 2 - np.log(root[i][i]) for i in range(k))
    spread2 = np.exp(2.0 * phi[:, :k])
    out = out + np.sum(phi[:, :k] - 0.5 * (POOL_FREEDOM + 1.0) * np.log1p(spread2 / POOL_FREEDOM), axis=1)
    shape = 0.5 * LEAST_ROWS
    return out - shape * phi[:, k] - (shape - 1.0) / variance


def _given(
    phi: Float[np.ndarray, "n dim"], data: Sums, rng: np.random.Generator | None
) -> tuple[Float[np.ndarray, "n k"], Float[np.ndarray, "n vehicle k"]]:
    """The fleet's mean and the vehicles' coefficients given (log τ, log σ²): exact draws, without `rng` what they are
    expected to be."""
    (vehicles, k), n = data.moment.shape, len(phi)
    noise: Any = np.zeros if rng is None else rng.standard_normal
    tight, _, low, half, root, right = _parts(phi, data)
    y = _forward(root, right)
    mean = _backward(root, [y[i] + noise(n) for i in range(k)])
    pull = _forward(low, [np.repeat((tight[:, i] * mean[i])[:, None], vehicles, axis=1) for i in range(k)])
    theta = _backward(low, [half[i] + pull[i] + noise((n, vehicles)) for i in range(k)])
    return np.stack(mean, axis=-1), np.stack(theta, axis=-1)


def _in_pieces(phi: np.ndarray, data: Sums) -> list[np.ndarray]:
    return np.array_split(phi, max(1, len(phi) * len(data.moment) // PIECE))


def _mode(data: Sums, start: np.ndarray, width: np.ndarray) -> tuple[np.ndarray, np.ndarray, bool]:
    """The mode of `marginal` by damped Newton steps, the root of the inverse curvature there, and whether they ended
    before they were stopped.

    By differences, a fifth of `width` (about the posterior's sds) apart.
    """
    dim, here = len(start), start
    steps = 0.2 * np.diag(width)
    pairs = [(a, b) for a in range(dim) for b in range(a)]
    root = np.diag(width)
    for _ in range(30):
        plus, minus = here + steps, here - steps
        corners = [here + s * steps[a] + t * steps[b] for a, b in pairs for s in (1, -1) for t in (1, -1)]
        f = marginal(np.stack([here, *plus, *minus, *corners]), data)
        up, down, rest = f[1 : dim + 1], f[dim + 1 : 2 * dim + 1], f[2 * dim + 1 :].reshape(-1, 4)
        slope = (up - down) / 0.4  # in units of the widths
        bend = np.diag((up - 2 * f[0] + down) / 0.04)
        for (a, b), c in zip(pairs, rest, strict=True):
            bend[a, b] = bend[b, a] = (c[0] - c[1] - c[2] + c[3]) / 0.16
        values, vectors = np.linalg.eigh(-bend)
        values = np.maximum(np.abs(values), 0.1)
        root = width[:, None] * vectors / np.sqrt(values)
        move = vectors @ ((vectors.T @ slope) / values)
        move = width * move / max(1.0, float(np.max(np.abs(move))) / 4.0)
        tries = here + np.array([1.0, 0.5, 0.2, 0.05, 0.0])[:, None] * move
        best = int(np.argmax(marginal(tries, data)))
        moved = float(np.max(np.abs((tries[best] - here) / width)))
        here = tries[best]
        if moved < 0.05:
            return here, root, True
    return here, root, False


def _width(data: Sums) -> Float[np.ndarray, " dim"]:
    """About the posterior sds of (log τ, log σ²) where rows determine all coefficients."""
    vehicles, k = data.moment.shape
    return np.r_[np.full(k, 1.0 / np.sqrt(2.0 * vehicles + 2.0)), np.sqrt(2.0 / (data.rows + LEAST_ROWS))]


class Resembling(NamedTuple):
    """The fleet's mean, the spread of its vehicles and each one's coefficients, in the units of its `Sums`; whether the
    search for the spread came to rest."""

    mean: Float[np.ndarray, " k"]
    spread: Float[np.ndarray, " k"]
    theta: Float[np.ndarray, "vehicle k"]
    converged: bool


def resembling(data: Sums, start: Float[np.ndarray, " dim"]) -> Resembling:
    """What is expected of a fleet at the mode of (log τ, log σ²): empirical Bayes. `start`: a guess of that mode."""
    mode, _, converged = _mode(data, start, _width(data))
    (mean,), (theta,) = _given(mode[None], data, None)
    return Resembling(mean, np.exp(mode[:-1]), theta, converged)


def _accepted(weight: np.ndarray, odds: np.ndarray) -> np.ndarray:
    """Which proposal each draw is, by chain: the proposal's own, or the one that was there."""
    chains, draws = weight.shape
    kept = np.zeros((chains, draws), dtype=int)
    at, every = np.zeros(chains, dtype=int), np.arange(chains)
    for t in range(draws):
        at = np.where(odds[:, t] < weight[:, t] - weight[every, at], t, at)
        kept[:, t] = at
    return kept


def drawn(
    data: Sums, start: Float[np.ndarray, " dim"], rng: np.random.Generator, *, chains: int, draws: int
) -> dict[str, np.ndarray]:
    """Draws `[chain, draw, …]` of `mean`, `spread`, `theta`, `variance` in the units of `data`; `kept`, how often a
    proposal was taken. `start`: a guess of (log τ, log σ²).
    """
    mode, root, _ = _mode(data, start, _width(data))
    dim, freedom, n = len(mode), PROPOSAL_FREEDOM, chains * draws
    stretch = np.sqrt(freedom / rng.chisquare(freedom, (n, 1)))
    z = WIDER * stretch * rng.standard_normal((n, dim))
    phi = mode + z @ root.T
    proposal = -0.5 * (freedom + dim) * np.log1p(np.sum(z**2, axis=-1) / (WIDER**2 * freedom))
    weight = np.concatenate([marginal(part, data) for part in _in_pieces(phi, data)]) - proposal
    weight = np.where(np.isfinite(weight), weight, -np.inf)
    kept = _accepted(weight.reshape(chains, draws), np.log(rng.uniform(size=(chains, draws))))
    phi = np.take_along_axis(phi.reshape(chains, draws, dim), kept[..., None], axis=1)
    parts = [_given(part, data, rng) for part in _in_pieces(phi.reshape(n, dim), data)]
    mean, theta = (np.concatenate(x) for x in zip(*parts, strict=True))
    return {
        "mean": mean.reshape(chains, draws, -1), "spread": np.exp(phi[..., :-1]),
        "theta": theta.reshape(chains, draws, *theta.shape[1:]), "variance": np.exp(phi[..., -1]),
        "kept": np.mean(kept[:, 1:] != kept[:, :-1]),
    }  # fmt: skip


def fleet_draws(fit: LinearFit, *, key: Array, chains: int = 4, draws: int = 1000) -> Draws:
    """Draws of a fleet's posterior from a `linear_fit` by groups, in the tables' units.

    Exact where the kernel is linear between the tables' values and the points where vehicles were linearised.
    """
    own, scale = fit.table.free, fit.scale
    value = np.array([c.value for c in own])
    noise = float(np.median(np.asarray(fit.prior.noise)))  # as believed, which the prior of σ² is of
    moments = fit.statistics.about((value[None, :] - fit.at) / scale)  # of all from one point
    gram, moment = np.asarray(moments.gram) / noise**2, np.asarray(moments.moment) / noise**2
    rows = float(np.sum(np.asarray(moments.rows)))
    data = Sums(gram, moment, float(np.sum(np.asarray(moments.square))) / noise**2, rows)
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)))
    k = len(own)
    seen = np.asarray(fit.posterior.mean) + (fit.at - value) / scale
    left = float(np.median(np.asarray(fit.posterior.sigma)))
    start = np.r_[np.log(np.clip(np.std(seen, axis=0), 0.1, 10.0)), 2.0 * np.log(left / noise)]
    sites = drawn(data, start, rng, chains=chains, draws=draws)
    kept = float(sites.pop("kept"))
    sites["theta"], sites["mean"] = value + scale * sites["theta"], value + scale * sites["mean"]
    sites["spread"], sites["variance"] = scale * sites["spread"], noise**2 * sites["variance"]
    axes = {"theta": ("vehicle", "coefficient"), "mean": ("coefficient",), "spread": ("coefficient",)}
    labels = {"coefficient": [c.name for c in own], "vehicle": [str(g) for g in range(len(fit.at))]}
    how = (
        f"sufficient statistics, worth {rows:,.0f} independent rows (linear, normal noise): exact draws given the "
        f"spread of {k} coefficients and the noise, whose draws were accepted {100 * kept:.0f} % of the time"
    )
    return Draws(sites, how, axes, labels)
