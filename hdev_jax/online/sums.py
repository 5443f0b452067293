"""Sums over rows, what time does to them, and the posterior that they come to."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hdev_jax.inference.calibrate import STUDENT_DF
from hdev_jax.online.form import COUNTS, Form
from hdev_jax.online.state import State, Sums

__all__ = [
    "BELIEVED", "SHARE", "TINY", "TRIPS", "aged", "faded", "finished_trips", "level_kept", "levels_prior", "of_mean",
    "on_a_new_trip", "whole_posterior",
]  # fmt: skip

SHARE = 0.1  # of the target's root mean square: what a row's noise is believed to be before any is seen
LEVEL_SHARE = 0.03  # the same of what a trip's rows have in common: a payload or a road that is off by so much
BELIEVED = 4.0  # rows that the noise so believed counts for; `inference.linear.LEAST_ROWS`
TRIPS = 2.0  # trips that the size of a level counts for before any is finished
# what a row of Student t tells of the mean, over what its weight says (Lange, Little and Taylor, JASA 84, 1989)
INFORMATION = (STUDENT_DF + 1.0) / (STUDENT_DF + 3.0)
TINY = 1e-300


def levels_prior(state: State) -> Float[Array, " level"]:
    """Variance of each level over trips: what finished trips had, and a share of the target for the first."""
    n, square, columns = state.totals[0], state.totals[1], state.totals[2:]
    moved = columns > 1e-6 * jnp.max(columns, initial=0.0)  # a force does nothing before the vehicle first moves
    usual = jnp.where(moved, LEVEL_SHARE**2 * square / jnp.where(moved, columns, 1.0), 0.0)
    return jnp.where(n > 0, (TRIPS * usual + state.level_squares) / (TRIPS + finished_trips(state)), 1.0)


def finished_trips(state: State) -> Float[Array, ""]:
    """How many trips are over."""
    return jnp.maximum(state.counts[COUNTS.index("trips")] - 1.0, 0.0)


def of_mean(form: Form, variance: Float[Array, " member"]) -> Float[Array, " member"]:
    """Variance that a weighed row counts with for the coefficients."""
    variance = jnp.maximum(variance, TINY)
    return variance / INFORMATION if form.robust else variance


def whole_posterior(state: State) -> State:
    """The state with mean, covariance and noise of each member worked out from its sums."""
    form, n = state.form, state.totals[0]
    rho = jnp.asarray(form.memories)
    prior = jnp.concatenate([jnp.ones(len(form.names)), 1.0 / jnp.maximum(levels_prior(state), TINY)])
    usual = SHARE**2 * state.totals[1] / jnp.maximum(n, 1.0) * (1.0 - rho**2)
    eye = jnp.eye(form.size)

    def one(gram: Array, variance: Array) -> tuple[Array, Array, Array]:
        g, b, square = gram[:-1, :-1], gram[:-1, -1], gram[-1, -1]
        precision = g / variance + jnp.diag(prior)
        d = jnp.sqrt(jnp.diagonal(precision))
        root = jnp.linalg.cholesky(precision / (d[:, None] * d[None, :]))
        half = jax.scipy.linalg.solve_triangular(root, eye, lower=True) / d[None, :]
        covariance = half.T @ half
        mean = covariance @ (b / variance)
        return mean, covariance, jnp.maximum(square - mean @ (2.0 * b - g @ mean), 0.0)

    before = jnp.maximum(jnp.where(state.variance > 0, state.variance, usual), TINY)
    mean, covariance, left = jax.vmap(one)(state.sums.gram, of_mean(form, before))
    seen = jnp.maximum((BELIEVED * usual + left) / (BELIEVED + state.worth), TINY)
    variance = before if form.known_noise else jnp.where(n > 0, seen, state.variance)  # unknown before the first row
    return eqx.tree_at(lambda s: (s.mean, s.covariance, s.variance), state, (mean, covariance, variance))


def on_a_new_trip(state: State) -> State:
    """What each trip has anew taken out of the sums; what it was, added to the levels' sizes."""
    form, anew = state.form, jnp.asarray(state.form.anew, dtype=int)
    k = len(form.names)
    state = eqx.tree_at(lambda s: s.since, state, jnp.full_like(state.since, jnp.inf))
    if not form.anew:
        return state
    prior = jnp.concatenate([jnp.ones(k), 1.0 / jnp.maximum(levels_prior(state), TINY)])[anew]
    stays = jnp.all(jnp.arange(form.size + 1)[:, None] != anew[None, :], axis=1)
    members = len(form.members)
    room = of_mean(form, state.variance)[:, None] * prior[None, :]
    sums = state.sums.moved(_unit(form, form.anew), room).scaled(jnp.broadcast_to(stays, (members, len(stays))))
    mean, covariance = state.steps
    squares = state.level_squares + (mean**2 + jnp.diagonal(covariance))[k:]
    counts = state.counts.at[COUNTS.index("trips")].add(1.0)
    new = eqx.tree_at(lambda s: (s.sums, s.level_squares, s.counts), state, (sums, squares, counts))
    return eqx.tree_at(lambda s: s.counts, whole_posterior(new), state.counts)


def aged(state: State, seconds: Float[Array, ""]) -> State:
    """The state so many seconds later in the trip: levels have wandered."""
    form, k = state.form, len(state.form.names)
    if not form.levels:
        return state
    kept = level_kept(form, seconds)
    wandered = levels_prior(state)[None, :] * (1.0 - kept**2)
    scale = jnp.concatenate([jnp.ones((len(kept), k)), kept], axis=1)
    room = of_mean(form, state.variance)[:, None] / jnp.maximum(wandered, TINY)
    sums = state.sums.moved(_unit(form, tuple(range(k, form.size))), room)
    sums = sums.scaled(jnp.concatenate([scale, jnp.ones((len(kept), 1))], axis=1))
    more = jnp.concatenate([jnp.zeros((len(kept), k)), wandered], axis=1)
    covariance = scale[:, :, None] * state.covariance * scale[:, None, :] + jax.vmap(jnp.diag)(more)
    return eqx.tree_at(lambda s: (s.sums, s.mean, s.covariance), state, (sums, scale * state.mean, covariance))


def level_kept(form: Form, seconds: Float[Array, ""]) -> Float[Array, "member level"]:
    """Share of each level that is left after so many seconds, φ."""
    lasting = jnp.asarray([s for _, s in form.members])
    return jnp.exp(-seconds / lasting)[:, None] * jnp.ones((1, len(form.levels)))


def faded(state: State, x: Float[Array, "member size"], hours: Float[Array, ""]) -> Sums:
    """The sums after coefficients have wandered for so long, in the direction that the row sees.

    A random walk of variance Q makes the row's own prediction less certain by xᵀQx. All of that is put in the one
    direction g = Qx/√(xᵀQx), in which the row is measured; combinations that it does not see (v with vᵀQx = 0) keep
    what is known of them, so that nothing drifts where a drive does not excite it (directional forgetting: Cao and
    Schwartz, Automatica 36, 2000). The table does not fade.
    """
    q = (state.drift**2 * hours)[None, :] * x
    g = q / jnp.sqrt(jnp.maximum(jnp.sum(x * q, axis=1), TINY))[:, None]
    along = jnp.concatenate([g, jnp.zeros((len(g), 1))], axis=1)[:, :, None]
    return state.sums.moved(along, of_mean(state.form, state.variance)[:, None])


def _unit(form: Form, places: tuple[int, ...]) -> Float[Array, "member z a"]:
    """Directions of these coefficients alone."""
    one = jnp.eye(form.size + 1)[:, jnp.asarray(places, dtype=int)]
    return jnp.broadcast_to(one, (len(form.members), *one.shape))
