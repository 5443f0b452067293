"""Bayesian linear regression in closed form: normal-inverse-gamma, from statistics that add up over rows.

Rows are [x | r]: x what a step of one unit in each coefficient changes in the prediction, r measured − predicted at the
point where the kernel was linearised (`hdev_jax.inference.design` makes them). Everything that the posterior needs of
any number of rows is a few small sums, so chunks, trips, vehicles and machines are added, and a row is forgotten by
multiplying.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

__all__ = [
    "LEAST_ROWS", "Posterior", "Prior", "Statistics", "follow", "least_squares", "posterior", "statistics", "update",
]  # fmt: skip

LEAST_ROWS = 4.0  # what the believed noise counts for: the fewest rows at which the posterior's variance is finite
TINY = 1e-14  # share of the largest eigenvalue under which a direction is rounding and not information


class Statistics(eqx.Module):
    """Sums over rows, each by its weight; a leading axis where they are of several vehicles or trips.

    `gram` Σxxᵀ, `moment` Σxr, `square` Σr², `rows` Σ1, `driving` rows that give no energy back, `largest` max r².
    """

    gram: Float[Array, "*group k k"]
    moment: Float[Array, "*group k"]
    square: Float[Array, "*group"]
    rows: Float[Array, "*group"]
    driving: Float[Array, "*group"]
    largest: Float[Array, "*group"]

    @eqx.filter_jit
    def __add__(self, other: "Statistics") -> "Statistics":
        """Both sets of rows together; they were linearised at the same point."""
        both = jax.tree.map(jnp.add, self, other)
        return eqx.tree_at(lambda s: s.largest, both, jnp.maximum(self.largest, other.largest))

    def times(self, factor: Any) -> "Statistics":
        """Every row worth `factor` of one: what is forgotten, or what correlated errors leave of it."""
        return jax.tree.map(
            lambda a: a * jnp.reshape(factor, jnp.shape(factor) + (1,) * (a.ndim - jnp.ndim(factor))), self
        )

    @eqx.filter_jit
    def about(self, step: Float[Any, "*group k"]) -> "Statistics":
        """The same rows with r counted from a point `step` further on: exact where the model is linear."""
        along = jnp.einsum("...ij,...j->...i", self.gram, step)
        square = self.square - jnp.sum(step * (2.0 * self.moment - along), axis=-1)
        new = (self.moment - along, jnp.maximum(square, 0.0))
        return eqx.tree_at(lambda s: (s.moment, s.square), self, new)

    @eqx.filter_jit
    def total(self) -> "Statistics":
        """All groups of the leading axis together."""
        summed = jax.tree.map(lambda a: jnp.sum(a, axis=0), self)
        return eqx.tree_at(lambda s: s.largest, summed, jnp.max(self.largest, axis=0))

    @staticmethod
    def zero(k: int, *groups: int) -> "Statistics":
        """Those of no rows."""
        one = jnp.zeros(groups)
        return Statistics(jnp.zeros((*groups, k, k)), jnp.zeros((*groups, k)), one, one, one, one)


class Prior(eqx.Module):
    """What is known before: mean and precision of the coefficients, and `noise`, the root of the mean of σ².

    Conjugate: were the noise of a row twice `noise`, the coefficients' prior would be twice as wide. What is believed
    of the noise counts for `rows` rows. A leading axis where groups have their own.
    """

    mean: Float[Array, "*group k"]
    precision: Float[Array, "*group k k"]
    noise: Float[Array, "*group"]
    rows: Float[Array, "*group"]

    @staticmethod
    def of_table(mean: Any, sd: Any, noise: Any, rows: Any = LEAST_ROWS) -> "Prior":
        """From tabular values and their sds `[k]`."""
        mean, sd = jnp.asarray(mean, dtype=float), jnp.asarray(sd, dtype=float)
        return Prior(mean, jnp.diag(1.0 / sd**2), jnp.asarray(noise, dtype=float), jnp.asarray(rows, dtype=float))


class Posterior(eqx.Module):
    """θ, σ² ~ normal-inverse-gamma: θ | σ² ~ N(mean, σ²·precision⁻¹), σ² ~ IG(shape, rate)."""

    mean: Float[Array, "*group k"]
    precision: Float[Array, "*group k k"]
    shape: Float[Array, "*group"]
    rate: Float[Array, "*group"]

    @property
    def sigma(self) -> Float[Array, "*group"]:
        """Noise of a row: root of the mean of σ²."""
        return jnp.sqrt(self.rate / (self.shape - 1.0))

    @property
    def freedom(self) -> Float[Array, "*group"]:
        """Degrees of freedom of the coefficients' Student t."""
        return 2.0 * self.shape

    @property
    def covariance(self) -> Float[Array, "*group k k"]:
        """Of the coefficients, the noise integrated out: finite from `LEAST_ROWS` rows on, the prior's included."""
        return (self.rate / (self.shape - 1.0))[..., None, None] * _inverse(self.precision)

    @property
    def sd(self) -> Float[Array, "*group k"]:
        """Standard deviations of the coefficients."""
        return jnp.sqrt(jnp.diagonal(self.covariance, axis1=-2, axis2=-1))

    def draws(self, key: Array, count: int) -> tuple[Float[Array, "draw k"], Float[Array, " draw"]]:
        """Exact draws of the coefficients and of σ; one group."""
        one, two = jax.random.split(key)
        variance = self.rate / jax.random.gamma(one, self.shape, (count,))
        d = jnp.sqrt(jnp.diagonal(self.precision))
        root = jnp.linalg.cholesky(self.precision / (d[:, None] * d[None, :]))
        z = jax.random.normal(two, (len(d), count))
        step = jax.scipy.linalg.solve_triangular(root, z, trans=1, lower=True) / d[:, None]
        return self.mean[None, :] + jnp.sqrt(variance)[:, None] * step.T, jnp.sqrt(variance)

    def predicted(self, x: Float[Array, "row k"]) -> tuple[Float[Array, " row"], Float[Array, " row"]]:
        """What rows x come to beyond the linearisation point, and its scale with a row's own noise (Student t)."""
        wide = jnp.einsum("rk,kl,rl->r", x, _inverse(self.precision), x)
        return x @ self.mean, jnp.sqrt(self.rate / self.shape * (1.0 + wide))

    def total(self, x: Float[Array, "row k"], weight: Float[Array, " row"]) -> tuple[Array, Array]:
        """The weighed sum of rows x beyond the linearisation point, and its scale with the rows' noise (Student t)."""
        along = weight @ x
        wide = along @ _inverse(self.precision) @ along
        return along @ self.mean, jnp.sqrt(self.rate / self.shape * (jnp.sum(weight**2) + wide))


@jax.jit
def _inverse(a: Float[Array, "*group k k"]) -> Float[Array, "*group k k"]:
    """Of a symmetric positive matrix, through its eigenvalues after scaling its diagonal to 1: never NaN."""
    d = jnp.sqrt(jnp.maximum(jnp.diagonal(a, axis1=-2, axis2=-1), 1e-300))
    scale = d[..., :, None] * d[..., None, :]
    values, vectors = jnp.linalg.eigh(a / scale)
    values = jnp.maximum(values, TINY * values[..., -1:])
    return (vectors / values[..., None, :]) @ jnp.swapaxes(vectors, -1, -2) / scale


def _solved(a: Float[Array, "k k"], b: Float[Array, " k"]) -> Float[Array, " k"]:
    """a⁻¹b by Cholesky, of a positive matrix scaled to a unit diagonal."""
    d = jnp.sqrt(jnp.diagonal(a))
    # one unit of rounding on the diagonal: what columns that are multiples of each other leave of the second pivot
    root = jnp.linalg.cholesky(a / (d[:, None] * d[None, :]) + TINY * jnp.eye(d.shape[0], dtype=d.dtype))
    y = jax.scipy.linalg.solve_triangular(root, b / d, lower=True)
    return jax.scipy.linalg.solve_triangular(root, y, trans=1, lower=True) / d


@eqx.filter_jit
def statistics(
    x: Float[Any, "row k"], r: Float[Any, " row"], measured: Float[Any, " row"], weight: Float[Any, " row"],
    group: Any = None, groups: int = 1,
) -> Statistics:  # fmt: skip
    """Sums of rows; of each group, 0 … `groups` − 1, where `group` gives the row's.

    A row's `weight` is what its square counts for (1 over the ratio of its variance to the others'; 0: none).
    """
    x, r, weight = jnp.asarray(x), jnp.asarray(r), jnp.asarray(weight)
    heavy = weight > 0
    each = Statistics(
        weight[:, None, None] * x[:, :, None] * x[:, None, :], (weight * r)[:, None] * x, weight * r**2,
        weight, weight * (jnp.asarray(measured) >= 0), jnp.where(heavy, weight * r**2, 0.0),
    )  # fmt: skip
    if group is None:
        return each.total()
    summed = jax.tree.map(lambda a: jax.ops.segment_sum(a, group, groups), each)
    largest = jnp.maximum(jax.ops.segment_max(each.largest, group, groups), 0.0)  # of no rows: 0
    return eqx.tree_at(lambda s: s.largest, summed, largest)


@jax.jit
def posterior(prior: Prior, data: Statistics) -> Posterior:
    """The posterior of one group; for several, `jax.vmap`. The cost does not depend on the rows that are in `data`.

    Λ = Λ₀ + Σxxᵀ, Λm = Λ₀m₀ + Σxr, a = a₀ + n/2, b = b₀ + ½(Σ(r − xm)² + (m − m₀)ᵀΛ₀(m − m₀)), Λ₀ being the prior's
    precision in units of its noise (Bishop, Pattern Recognition and Machine Learning, 2006, section 3.3; Gelman et al.,
    Bayesian Data Analysis, 2013, section 14.8).
    """
    relative = prior.precision * prior.noise**2
    precision = relative + data.gram
    mean = prior.mean + _solved(precision, data.moment - data.gram @ prior.mean)
    moved = mean - prior.mean
    # not Σr² + m₀ᵀΛ₀m₀ − mᵀΛm, which loses its digits, and its sign, where the fit is good
    left = data.square - mean @ (2.0 * data.moment - data.gram @ mean)
    misfit = jnp.maximum(left, 0.0) + moved @ relative @ moved
    shape = 0.5 * (prior.rows + data.rows)
    return Posterior(mean, precision, shape, (0.5 * prior.rows - 1.0) * prior.noise**2 + 0.5 * misfit)


def least_squares(data: Statistics) -> tuple[Float[Array, " k"], Float[Array, "k k"], Float[Array, ""]]:
    """Ordinary least squares from the statistics, the baseline without a table: values, covariance, noise of a row.

    The shortest of all solutions where columns are multiples of each other (the step from the linearisation point).
    """
    k = data.moment.shape[-1]
    d = jnp.sqrt(jnp.maximum(jnp.diagonal(data.gram), 1e-300))
    values, vectors = jnp.linalg.eigh(data.gram / (d[:, None] * d[None, :]))
    determined = values > 1e-12 * jnp.maximum(values[-1], 1e-300)
    inverse = jnp.where(determined, 1.0 / jnp.where(determined, values, 1.0), 0.0)
    step = (vectors * inverse[None, :]) @ (vectors.T @ (data.moment / d)) / d
    left = jnp.maximum(data.square - step @ (2.0 * data.moment - data.gram @ step), 0.0)
    variance = left / jnp.maximum(data.rows - k, 1.0)
    return step, variance * ((vectors * inverse[None, :]) @ vectors.T) / (d[:, None] * d[None, :]), jnp.sqrt(variance)


def update(
    state: Statistics, x: Float[Array, " k"], r: Any, *, forgetting: Any = 1.0, weight: Any = 1.0, driving: Any = 1.0
) -> Statistics:
    """One row more, after what was there has faded by `forgetting` (1: nothing does; then it is the sum of all rows).

    The table does not fade: standing still, without information, leads back to it and never to an open covariance.
    """
    r = jnp.asarray(r)
    one = Statistics(
        weight * x[:, None] * x[None, :], weight * r * x, weight * r**2, jnp.asarray(weight, dtype=r.dtype),
        jnp.asarray(weight * driving, dtype=r.dtype), weight * r**2,
    )  # fmt: skip
    return state.times(jnp.asarray(forgetting, dtype=r.dtype)) + one


def follow(
    prior: Prior, state: Statistics, x: Float[Any, "row k"], r: Float[Any, " row"], *, forgetting: Any = 1.0
) -> tuple[Statistics, tuple[Float[Array, " row"], Float[Array, " row"], Float[Array, "row k"]]]:
    """Row by row as the vehicle drives: the statistics after all rows; and for each row what the rows before it
    predict of it, the scale of that (Student t), and the coefficients after it. For several vehicles, `jax.vmap`.
    """

    def step(carry: tuple[Statistics, Posterior], row: tuple[Array, Array]) -> Any:
        state, before = carry
        x, r = row
        wide = jnp.sqrt(before.rate / before.shape * (1.0 + x @ _solved(before.precision, x)))
        state = update(state, x, r, forgetting=forgetting)
        after = posterior(prior, state)
        return (state, after), (x @ before.mean, wide, after.mean)

    begin = (state, posterior(prior, state))
    (last, _), by_row = jax.lax.scan(step, begin, (jnp.asarray(x), jnp.asarray(r)))
    return last, by_row
