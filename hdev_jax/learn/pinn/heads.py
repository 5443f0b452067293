"""A network with two heads (paper 1, figure 4): hidden layers, one output for energy, two for the coefficients."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.extend.random import threefry_2x32
from jaxtyping import Array, Bool, Float, PRNGKeyArray

__all__ = ["Heads", "Network"]


class Heads(eqx.Module):
    """What the network says of each row, without units: `energy` [row], `coefficients` [row, 2]."""

    energy: Float[Array, " row"]
    coefficients: Float[Array, "row 2"]


class Network(eqx.Module):
    """Fully connected layers, each followed by ReLU, batch normalisation and dropout, in that order (section 3.3.2).

    **Arguments:** `inputs`, columns; `units` of each hidden layer; `normalised`, with batch normalisation; `dropout`,
    the share of units left out in training. Both heads begin at zero: an untrained network leaves the physics as it is.
    """

    layers: tuple[eqx.nn.Linear, ...]
    norms: tuple[eqx.nn.BatchNorm, ...]
    head: eqx.nn.Linear
    dropout: float = eqx.field(static=True)

    def __init__(self, inputs: int, units: tuple[int, ...], *, normalised: bool, dropout: float, key: PRNGKeyArray):
        sizes = (inputs, *units)
        keys = jax.random.split(key, len(units))
        self.layers = tuple(
            eqx.nn.Linear(a, b, dtype=jnp.float32, key=k) for a, b, k in zip(sizes[:-1], units, keys, strict=True)
        )
        self.norms = tuple(
            eqx.nn.BatchNorm(n, axis_name="batch", mode="batch", momentum=0.9, dtype=jnp.float32)
            for n in (units if normalised else ())
        )
        head = eqx.nn.Linear(sizes[-1], 3, dtype=jnp.float32, key=key)
        self.head = jax.tree.map(jnp.zeros_like, head)
        self.dropout = dropout

    def __call__(
        self, x: Float[Array, "row column"], state: eqx.nn.State, *, key: PRNGKeyArray | None = None
    ) -> tuple[Heads, eqx.nn.State]:
        """The heads of each row, and the running means after it; with a `key` as in training, without as in use."""
        for k, layer in enumerate(self.layers):
            x = jax.nn.relu(jax.vmap(layer)(x))
            if self.norms:
                x, state = self._normalised(self.norms[k], x, state, training=key is not None)
            if key is not None and self.dropout > 0:
                kept = _kept(jax.random.fold_in(key, k), 1.0 - self.dropout, x.shape)
                x = jnp.where(kept, x / (1.0 - self.dropout), 0.0)
        out = jax.vmap(self.head)(x)
        return Heads(out[:, 0], out[:, 1:]), state

    def _normalised(self, norm: eqx.nn.BatchNorm, x: Array, state: Any, *, training: bool) -> tuple[Array, Any]:
        one = lambda row, s: norm(row, s, inference=not training)  # noqa: E731
        return jax.vmap(one, in_axes=(0, None), out_axes=(0, None), axis_name="batch")(x, state)


def _kept(key: PRNGKeyArray, share: float, shape: tuple[int, ...]) -> Bool[Array, "row unit"]:
    """Which units stay: so large a share, to 2⁻¹⁷. Drawing takes a fifth of a step: of one random word 16 bits are for
    a unit and 16 for another, and the words are both of threefry's, where `jax.random.bits` makes one of them."""
    rows, half = shape[0], -(-shape[1] // 2)
    words = threefry_2x32(jax.random.key_data(key), jax.lax.iota(jnp.uint32, rows * half)).reshape(rows, half)
    halves = jnp.concatenate([words & 0xFFFF, words >> 16], axis=1)[:, : shape[1]]
    return halves < round(share * 2**16)
