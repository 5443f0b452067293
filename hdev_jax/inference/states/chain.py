"""Hidden Markov chains: filter, smoother and draws of the state sequence, as scans over rows with many chains at once.

Scaled forward and backward recursions (Rabiner, Proc. IEEE 77, 1989, section V-A) and backward sampling
(Frühwirth-Schnatter, Finite Mixture and Markov Switching Models, 2006, algorithm 11.5). What a row fits may depend on
the state before it and the state after it, as in an autoregression about levels (Hamilton, Econometrica 57, 1989).
Moves may differ from row to row; the first row of a chain, or of a new trip inside it, moves from any state alike.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

__all__ = ["Smoothed", "draw", "smooth"]

UNROLL = 4  # rows in one step of a scan
TINY = 1e-300

Pairs = Float[Array, "row chain state state"]


class Smoothed(NamedTuple):
    """Probability of each state after a row given the rows before (`ahead`) and this one too (`filtered`), of each pair
    of states before and after it given all rows (`pairs`), and each chain's log-likelihood."""

    ahead: Float[Array, "row chain state"]
    filtered: Float[Array, "row chain state"]
    pairs: Pairs
    log_likelihood: Float[Array, " chain"]


def _forward(before: Any, likely: Any) -> tuple[Any, Any]:
    joint = jnp.sum(before[:, :, None] * likely, axis=1)
    norm = jnp.sum(joint, axis=-1, keepdims=True) + TINY
    filtered = joint / norm
    return filtered, (filtered, norm[:, 0])


def _backward(later: Any, likely: Any) -> tuple[Any, Any]:
    earlier = jnp.sum(likely * later[:, None, :], axis=-1)
    return earlier / (jnp.sum(earlier, axis=-1, keepdims=True) + TINY), later


@jax.jit
def smooth(moves: Pairs, fits: Pairs) -> Smoothed:
    """States of chains by filter and smoother.

    **Arguments:** `moves[t]`, chance of each state after row t given the one before (of a first row every line is the
    chance of its states); `fits[t]`, likelihood of row t for each pair of states before and after it.
    """
    chains, states = fits.shape[1:3]
    # what needs no other row is done for all rows at once
    top = jnp.max(fits, axis=(-2, -1), keepdims=True) + TINY
    likely = moves * (fits / top)
    begin = jnp.full((chains, states), 1.0 / states, fits.dtype)
    _, (filtered, norm) = jax.lax.scan(_forward, begin, likely, unroll=UNROLL)
    _, later = jax.lax.scan(_backward, jnp.ones_like(begin), likely, reverse=True, unroll=UNROLL)
    before = jnp.concatenate([begin[None], filtered[:-1]])[..., None]
    pairs = before * likely * later[..., None, :]
    pairs = pairs / (jnp.sum(pairs, axis=(-2, -1), keepdims=True) + TINY)
    total = jnp.sum(jnp.log(norm) + jnp.log(top[..., 0, 0]), axis=0)
    return Smoothed(jnp.sum(before * moves, axis=2), filtered, pairs, total)


@jax.jit
def draw(
    filtered: Float[Array, "row chain state"], moves: Pairs, fits: Pairs, *, key: PRNGKeyArray
) -> Int[Array, "row chain"]:
    """The states after each row, a sequence of each chain from its posterior."""
    rows, chains, states = filtered.shape
    uniform = jax.random.uniform(key, (rows, chains), filtered.dtype)

    def earlier(later: tuple[Any, Any], row: tuple[Any, Any, Any, Any]) -> tuple[Any, Any]:
        state, into = later
        own, u, move, fit = row
        weight = own * jnp.take_along_axis(into, state[:, None, None], axis=-1)[:, :, 0]
        total = jnp.cumsum(weight, axis=-1)
        drawn = jnp.minimum(jnp.sum(u[:, None] * total[:, -1:] > total, axis=-1), states - 1)
        return (drawn, move * (fit / (jnp.max(fit, axis=(-2, -1), keepdims=True) + TINY))), drawn

    # the last row is followed by none: every state leads on alike
    begin = (jnp.zeros(chains, int), jnp.ones((chains, states, states), filtered.dtype))
    _, drawn = jax.lax.scan(earlier, begin, (filtered, uniform, moves, fits), reverse=True)
    return drawn
