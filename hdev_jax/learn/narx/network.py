"""The sigmoid network of paper 2, equations 17-19: an offset, a linear part and units that see a projection."""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

__all__ = ["Parts", "Shape", "direct", "free_run", "output", "unpack"]

UNROLL = 16  # steps of the recursion compiled in one piece


@dataclass(frozen=True)
class Shape:
    """What is fixed before anything is fitted.

    **Arguments:** `columns`, regressors of a row, past outputs first; `feedback`, how many of them are past outputs;
    `linear`, how many of the first columns enter linearly (X·M·L of equation 17 with M a selection); `units`, sigmoids;
    `seen`, the columns that the units see (Q of equation 19, a selection too).
    """

    columns: int
    feedback: int
    linear: int
    units: int
    seen: tuple[int, ...]

    @property
    def size(self) -> int:
        """Number of free parameters: 1 + linear + units·(2 + seen)."""
        return 1 + self.linear + self.units * (2 + len(self.seen))

    @property
    def fed_back(self) -> tuple[int, ...]:
        """Positions in `seen` that are past outputs."""
        return tuple(i for i, c in enumerate(self.seen) if c < self.feedback)


class Parts(NamedTuple):
    """y₀, L, s, b and c of equations 17 and 19."""

    offset: Float[Array, ""]
    linear: Float[Array, " linear"]
    size: Float[Array, " unit"]
    slope: Float[Array, "unit seen"]
    shift: Float[Array, " unit"]


def unpack(shape: Shape, theta: Float[Array, " parameter"]) -> Parts:
    """The parameter vector in its parts."""
    a, n, q = 1 + shape.linear, shape.units, len(shape.seen)
    return Parts(
        theta[0], theta[1:a], theta[a : a + n], theta[a + n : a + n + n * q].reshape(n, q), theta[a + n + n * q :]
    )


def _plus(x: Array, shift: Array) -> Array:
    return x + shift.reshape((1,) * (x.ndim - 1) + shift.shape)


def output(shape: Shape, theta: Float[Array, " parameter"], x: Float[Array, "*row column"]) -> Float[Array, "*row"]:
    """y = y₀ + X·L + Σ sᵢ·σ(X·Q·bᵢ + cᵢ) of regressors `x`, all normalised (equations 17-19)."""
    p = unpack(shape, theta)
    unit = jax.nn.sigmoid(_plus(x[..., jnp.array(shape.seen, dtype=int)] @ p.slope.T, p.shift))
    return p.offset + x[..., : shape.linear] @ p.linear + unit @ p.size


def direct(
    shape: Shape, theta: Float[Array, " parameter"], x: Float[Array, "row column"]
) -> tuple[Float[Array, " row"], Float[Array, "row parameter"], Float[Array, "row feedback"]]:
    """The output, its gradient in the parameters with the regressors held, and its gradient in past outputs."""
    p = unpack(shape, theta)
    seen = x[:, jnp.array(shape.seen, dtype=int)]
    unit = jax.nn.sigmoid(_plus(seen @ p.slope.T, p.shift))
    steep = unit * (1 - unit) * p.size[None, :]
    slopes = (steep[:, :, None] * seen[:, None, :]).reshape(x.shape[0], shape.units * len(shape.seen))
    jac = jnp.concatenate([jnp.ones((x.shape[0], 1), x.dtype), x[:, : shape.linear], unit, slopes, steep], axis=1)
    back = jnp.zeros((x.shape[0], shape.feedback), x.dtype)
    kept = min(shape.feedback, shape.linear)
    back = back.at[:, :kept].add(p.linear[None, :kept])
    if shape.fed_back:
        at = jnp.array([shape.seen[i] for i in shape.fed_back])
        back = back.at[:, at].add(steep @ p.slope[:, jnp.array(shape.fed_back)])
    y = p.offset + x[:, : shape.linear] @ p.linear + unit @ p.size
    return y, jac, back


def free_run(
    shape: Shape,
    theta: Float[Array, " parameter"],
    start: Float[Array, "*batch feedback"],
    exogenous: Float[Array, "time *batch exogenous"],
) -> Float[Array, "time *batch"]:
    """Simulation: past outputs are the model's own (paper 2, figure 11b). A scan; what does not feed back is parallel.

    **Arguments:** `start`, y(−1), y(−2), …; `exogenous`, the columns that are not past outputs.
    """
    p, back = unpack(shape, theta), shape.feedback
    kept = min(back, shape.linear)
    base = p.offset + exogenous[..., : shape.linear - kept] @ p.linear[kept:]
    forward = tuple(i for i in range(len(shape.seen)) if i not in shape.fed_back)
    at = jnp.array([shape.seen[i] - back for i in forward], dtype=int)
    into = _plus(exogenous[..., at] @ p.slope[:, jnp.array(forward, dtype=int)].T, p.shift)
    if not shape.fed_back:
        base = base + jax.nn.sigmoid(into) @ p.size
    if back == 0:
        return base
    closed = jnp.zeros(back, base.dtype).at[:kept].set(p.linear[:kept])
    if not shape.fed_back:

        def step(past: tuple[Array, ...], x: Array) -> tuple[tuple[Array, ...], Array]:
            y = x
            for a, z in zip(closed, past, strict=True):
                y = y + a * z
            return (y, *past[:-1]), y

        first = tuple(start[..., i] for i in range(back))
        return jax.lax.scan(step, first, base, unroll=UNROLL)[1]
    picked = jnp.array([shape.seen[i] for i in shape.fed_back])
    slope = p.slope[:, jnp.array(shape.fed_back)].T

    def step_through(past: Array, x: tuple[Array, Array]) -> tuple[Array, Array]:
        y = x[0] + past @ closed + jax.nn.sigmoid(x[1] + past[..., picked] @ slope) @ p.size
        return jnp.concatenate([y[..., None], past[..., :-1]], axis=-1), y

    return jax.lax.scan(step_through, start, (base, into), unroll=4)[1]
