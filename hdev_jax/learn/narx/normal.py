"""Normal equations of a network, summed over chunks: of its one-step errors, and of its free run in windows."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hdev_jax.learn.narx.network import Shape, direct, free_run

__all__ = ["Equations", "Rows", "Windows", "one_step", "rows_of", "simulated", "windows_of"]

Equations = tuple[Float[Array, ""], Float[Array, " parameter"], Float[Array, "parameter parameter"]]
CHUNK = 256  # rows: the Jacobian of a chunk stays in cache
BURN_IN = 64  # steps before a window counts: what is left of a wrong start is then below rounding for poles within 0.6


class Rows(eqx.Module):
    """Regressors and outputs in chunks; rows that fill up the last chunk have weight 0."""

    x: Float[Array, "chunk row column"]
    y: Float[Array, "chunk row"]
    weight: Float[Array, "chunk row"]


class Windows(eqx.Module):
    """Windows of a trip that are simulated side by side, groups of them at a time; burn-in has weight 0."""

    exogenous: Float[Array, "group time window exogenous"]
    y: Float[Array, "group time window"]
    start: Float[Array, "group window feedback"]
    weight: Float[Array, "group time window"]


def rows_of(x: np.ndarray, y: np.ndarray, weight: np.ndarray | None = None, chunk: int = CHUNK) -> Rows:
    """Rows in chunks of `chunk`."""
    w = np.ones(len(y)) if weight is None else np.asarray(weight, dtype=float)
    count = -(-len(y) // chunk)

    def cut(a: np.ndarray) -> Array:
        full = np.concatenate([a, np.zeros((count * chunk - len(a), *a.shape[1:]))])
        return jnp.asarray(full.reshape(count, chunk, *a.shape[1:]))

    return Rows(cut(np.asarray(x, dtype=float)), cut(np.asarray(y, dtype=float)), cut(w))


def windows_of(
    x: np.ndarray, y: np.ndarray, feedback: int, *, length: int = 256, burn_in: int = BURN_IN, group: int = 32
) -> Windows:
    """A trip cut into windows of `length` rows, each started `burn_in` rows earlier from measured outputs.

    **Arguments:** `x` `[row, column]` with the past outputs first; `y` `[row]`; `group` windows are worked on at once.
    """
    n = len(y)
    count = -(-n // length)
    groups = -(-count // group)
    begin = np.arange(groups * group) * length - burn_in
    at = begin[:, None] + np.arange(length + burn_in)
    counts = (np.arange(length + burn_in) >= burn_in) & (at < n)
    inside = np.clip(at, 0, n - 1)
    first = np.clip(begin, 0, n - 1)  # the first window holds its start through the burn-in

    def by_group(a: np.ndarray) -> Array:  # [window, time, …] → [group, time, window, …]
        return jnp.asarray(np.moveaxis(a.reshape(groups, group, *a.shape[1:]), 1, 2))

    return Windows(
        by_group(x[inside, feedback:]),
        by_group(y[inside]),
        jnp.asarray(x[first, :feedback].reshape(groups, group, feedback)),
        by_group(counts.astype(float)),
    )


def _robust(error: Array, weight: Array, huber: Array) -> tuple[Array, Array]:
    """Huber's loss, twice over, and the weight that makes it least squares (Huber 1964)."""
    size = jnp.abs(error)
    inside = size <= huber
    loss = jnp.where(inside, error**2, huber * (2 * size - huber))
    return (weight * loss).sum(), weight * jnp.where(inside, 1.0, huber / jnp.where(inside, 1.0, size))


def _add(total: Equations, error: Array, jac: Array, weight: Array, huber: Array, single: bool) -> Equations:
    loss, w = _robust(error, weight, huber)
    root = jac * jnp.sqrt(w)[:, None]
    if single:  # a chunk's share of the Hessian, which only steers the step; the sum over chunks is kept in double
        root = root.astype(jnp.float32)
    hessian = (root.T @ root).astype(total[2].dtype)
    return total[0] + 0.5 * loss, total[1] + (w * error) @ jac, total[2] + hessian


def _empty(theta: Array) -> Equations:
    p = theta.shape[0]
    return jnp.zeros((), theta.dtype), jnp.zeros(p, theta.dtype), jnp.zeros((p, p), theta.dtype)


def one_step(
    shape: Shape, theta: Float[Array, " parameter"], rows: Rows, huber: Float[Array, ""], *, single: bool = False
) -> Equations:
    """Loss, gradient and Gauss-Newton Hessian of ½Σ ρ(y − ŷ), ŷ from measured past outputs (paper 2, equation 20).

    `single`: products of the Hessian in float32, at half the time; loss and gradient, and so the minimum, are not.
    """

    def add(total: Equations, chunk: Rows) -> tuple[Equations, None]:
        y, jac, _ = direct(shape, theta, chunk.x)
        return _add(total, y - chunk.y, jac, chunk.weight, huber, single), None

    return jax.lax.scan(add, _empty(theta), rows)[0]


def simulated(
    shape: Shape, theta: Float[Array, " parameter"], windows: Windows, huber: Float[Array, ""], *, single: bool = False
) -> Equations:
    """The same for the free run, every window at once.

    Sensitivities follow the recursion of the output, sₖ = ∂ŷₖ/∂θ + Σ ∂ŷₖ/∂ŷₖ₋ᵢ·sₖ₋ᵢ: gradients of all steps are worked
    out side by side, only the sum is scanned.
    """
    back = shape.feedback

    def add(total: Equations, w: Windows) -> tuple[Equations, None]:
        y = free_run(shape, theta, w.start, w.exogenous)
        time, count = y.shape
        before = jnp.concatenate([jnp.moveaxis(w.start[:, ::-1], 1, 0), y])  # y(−back) … y(−1), y(0), …
        past = jnp.stack([before[back - 1 - i : back - 1 - i + time] for i in range(back)], axis=-1)
        x = jnp.concatenate([past, w.exogenous], axis=-1)
        _, jac, fed = direct(shape, theta, x.reshape(time * count, -1))
        jac, fed = jac.reshape(time, count, -1), fed.reshape(time, count, back)

        def follow(past: tuple[Array, ...], row: tuple[Array, Array]) -> tuple[tuple[Array, ...], Array]:
            s = row[0]
            for i in range(back):
                s = s + row[1][:, i, None] * past[i]
            return (s, *past[:-1]), s

        none = tuple(jnp.zeros_like(jac[0]) for _ in range(back))
        whole = jax.lax.scan(follow, none, (jac, fed))[1]
        error, weight = (y - w.y).reshape(-1), w.weight.reshape(-1)
        return _add(total, error, whole.reshape(time * count, -1), weight, huber, single), None

    return jax.lax.scan(add, _empty(theta), windows)[0]
