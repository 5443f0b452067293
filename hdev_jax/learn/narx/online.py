"""Recursive identification with forgetting: a model that is linear in its coefficients, followed while it ages."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hdev_jax.errors import InputError

__all__ = ["Recursive", "follow", "recursive", "update"]


class Recursive(NamedTuple):
    """State of recursive least squares: coefficients and the inverse of their information."""

    beta: Float[Array, " column"] | Float[np.ndarray, " column"]
    covariance: Float[Array, "column column"] | Float[np.ndarray, "column column"]


def recursive(beta: Any, x: Any = None, *, prior: float = 1e6) -> Recursive:
    """A state to begin with: `beta`, known as well as rows `x` `[row, column]` tell; hardly (`prior`) without any."""
    beta = np.asarray(beta, dtype=float)
    if x is None:
        return Recursive(beta, prior * np.eye(len(beta)))
    gram = np.asarray(x).T @ np.asarray(x)
    inverse = np.linalg.inv(gram + np.eye(len(beta)) / prior)
    return Recursive(beta, (inverse + inverse.T) / 2)


def update(
    state: Recursive,
    x: Float[Any, " column"],
    y: Any,
    forgetting: Any,
    corner: Any = np.inf,
    ceiling: Any = np.inf,
    xp: Any = jnp,
) -> tuple[Recursive, Any]:
    """One row: the state after it, and its prediction from the state before it.

    K = P·x/(λ/w + xᵀ·P·x), β ← β + K·(y − xᵀβ), P ← (P − K·xᵀ·P)/λ (Ljung, System Identification, 1999, 11.13), with
    Huber's weight w = min(1, corner/|e|). λ = 1 and an infinite corner is least squares of all rows so far.

    **Arguments:** `state`, its P symmetric; `forgetting` λ in (0, 1]; `corner` above 0; `ceiling`: P grows no more once
    its trace is there, so that standing still, which tells nothing, does not wind it up; `xp`, NumPy where a row comes
    at a time, JAX inside a program.
    """
    beta, covariance = state
    predicted = x @ beta
    error = y - predicted
    along = covariance @ x
    size = forgetting * xp.maximum(1.0, abs(error) / corner) + x @ along
    # a product of equals is symmetric to the last bit: what is not would grow by 1/λ with every row, no row lowers it
    root = along / xp.sqrt(size)
    smaller = covariance - root[:, None] * root[None, :]
    grown = smaller.trace() < ceiling * forgetting
    return Recursive(beta + along * (error / size), smaller / forgetting**grown), predicted


@jax.jit
def _follow(state: Recursive, x: Array, y: Array, forgetting: Array, corner: Array, ceiling: Array) -> Any:
    def step(state: Recursive, row: tuple[Array, Array]) -> tuple[Recursive, Array]:
        return update(state, row[0], row[1], forgetting, corner, ceiling)

    return jax.lax.scan(step, state, (x, y))


def follow(
    state: Recursive, x: Any, y: Any, *, forgetting: float, corner: float = np.inf, ceiling: float = np.inf
) -> tuple[Recursive, Float[np.ndarray, " row"]]:
    """A whole trip, row by row: the state after it and the prediction of every row from the rows before it.

    **Arguments:** `x` `[row, column]`, `y` `[row]`; the rest as in `update`. Raises `InputError` for a `forgetting`
    outside (0, 1].
    """
    if not 0 < forgetting <= 1:
        raise InputError(f"forgetting factor {forgetting:g}: above 0 and at most 1 (1 forgets nothing)")
    begin = Recursive(jnp.asarray(state.beta, dtype=float), jnp.asarray(state.covariance, dtype=float))
    real = partial(jnp.asarray, dtype=float)
    last, predicted = _follow(begin, real(x), real(y), real(forgetting), real(corner), real(ceiling))
    return Recursive(np.asarray(last.beta), np.asarray(last.covariance)), np.asarray(predicted)
