"""NUTS through the whole kernel, in coordinates in which its posterior is nearly a standard normal.

Coefficients of a vehicle are estimated from its own rows and from the fleet together: θ = m(μ, τ) + L(μ, τ)·u,
m and L the mean and the root of the covariance of the linearised kernel's conditional posterior (the statistics of
`hdev_jax.inference.linear`). So u is nearly a standard normal whatever the fleet's mean μ and spread τ are, strong data
or weak: neither the centred nor the non-centred form, but the one between that these data ask for. What is left (μ, τ,
the noise) is scaled by its Laplace approximation. The density stays the model's own: the change of variables is exact.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from hdev_jax.inference.calibrate import STUDENT_DF, tabular
from hdev_jax.inference.design import design
from hdev_jax.inference.linear import Statistics, statistics
from hdev_jax.inference.posterior.draws import Draws, needs
from hdev_jax.inference.posterior.models import Model, kernel_model, log_density

__all__ = ["Coordinates", "coordinates", "numpyro_nuts", "sampled"]

WARM_UP = 300
TARGET_ACCEPTANCE = 0.65  # of whitened coordinates: longer steps, half as many


class Coordinates(NamedTuple):
    """From a near-standard normal `[dim]` to the model's sites, and the log of the volume; `moments` of each group."""

    centre: Array
    root: Array
    moments: Statistics | None
    at: Array


def _unpacked(m: Model, c: Coordinates, q: Array) -> tuple[dict[str, Array], Array]:
    """Sites of the model and log |∂ sites / ∂q|, up to a constant."""
    value, sd = (jnp.asarray(a) for a in tabular(m.table))
    k, dim = value.shape[0], c.centre.shape[0]
    h = c.centre + c.root @ q[:dim]
    z, rest = h[:k], h[k:]
    sites: dict[str, Array] = {}
    volume = jnp.zeros(())
    if m.groups:
        log_spread, rest = rest[:k], rest[k:]
        sites["mean"], sites["spread"] = value + sd * z, sd * jnp.exp(log_spread)
        volume = volume + jnp.sum(log_spread)
        u = q[dim:].reshape(m.groups, k)
        assert c.moments is not None
        tight = jnp.exp(-2.0 * log_spread)
        precision = c.moments.gram + jnp.diag(tight)[None]
        root = jnp.linalg.cholesky(precision)
        right = c.moments.moment + (tight * z)[None, :]
        half = jax.scipy.linalg.solve_triangular(root, right[..., None], lower=True)
        both = half + u[..., None]
        theta = jax.scipy.linalg.solve_triangular(jnp.swapaxes(root, -1, -2), both, lower=False)[..., 0]
        sites["theta"] = value[None, :] + sd[None, :] * theta
        volume = volume - jnp.sum(jnp.log(jnp.diagonal(root, axis1=-2, axis2=-1)))
    else:
        sites["theta"] = value + sd * z
    sites["variance"] = m.noise**2 * jnp.exp(rest[0])
    volume = volume + rest[0]
    rest = rest[1:]
    if m.grows:  # its square is what counts, and its prior is even: a sign that says nothing, and no edge at 0
        sites["growth"] = jnp.abs(rest[0])
        rest = rest[1:]
    if m.student:
        sites["df"] = jnp.exp(rest[0])
        volume = volume + rest[0]
    return sites, volume


def coordinates(m: Model, at: Any, *, noise: Any = None) -> Coordinates:
    """Coordinates from the kernel linearised `at` coefficients near the posterior's mean (`[k]` or `[group k]`)."""
    value, sd = (jnp.asarray(a) for a in tabular(m.table))
    k, at = value.shape[0], jnp.asarray(at)
    moments = None
    noise = m.noise if noise is None else noise
    if m.groups:
        x, predicted = design(m.vehicle, m.table, m.segments, m.target, at, m.group)
        r = m.measured - predicted
        weight = m.worth * m.weight**2 / noise**2
        if m.student:
            weight = weight * (STUDENT_DF + 1.0) / (STUDENT_DF + (r / noise) ** 2)
        assert m.group is not None
        moments = statistics(x * sd[None, :], r, m.measured, weight, m.group, m.groups)
        moments = moments.about((value[None, :] - at) / sd[None, :])  # moments are of steps from the table
    hyper = jnp.zeros(2 * k if m.groups else k)
    start = (jnp.mean(at, axis=0) if m.groups else at) - value
    hyper = hyper.at[:k].set(start / sd)
    if m.groups:
        hyper = hyper.at[k:].set(jnp.log(jnp.maximum(jnp.std((at - value[None, :]) / sd[None, :], axis=0), 0.05)))
    more = [2.0 * jnp.log(noise / m.noise), *([jnp.asarray(0.02)] if m.grows else [])]
    more += [jnp.log(jnp.asarray(8.0))] if m.student else []
    hyper = jnp.concatenate([hyper, jnp.stack([jnp.asarray(x) for x in more])])
    plain = Coordinates(jnp.zeros_like(hyper), jnp.eye(len(hyper)), moments, at)
    centre, root = _laplace(m, plain, hyper)
    return Coordinates(centre, root, moments, at)


def _laplace(m: Model, plain: Coordinates, h: Array) -> tuple[Array, Array]:
    """Mode of what is no group's own, by damped Newton steps, and the root of the inverse curvature there."""
    damping = 1e-3
    value, slope, curvature = _objective(m, plain, h)
    for _ in range(40):
        values, vectors = jnp.linalg.eigh(curvature)
        bent = jnp.maximum(jnp.abs(values), 1e-3) + damping
        step = -vectors @ ((vectors.T @ slope) / bent)
        step = step / jnp.maximum(1.0, jnp.max(jnp.abs(step)) / 2.0)
        new = _objective(m, plain, h + step)
        if bool(new[0] <= value):
            gain = float(value - new[0])
            h, (value, slope, curvature), damping = h + step, new, max(damping * 0.1, 1e-6)
            if gain < 1e-3:
                break
        else:
            damping = damping * 10.0 + 1e-2
            if damping > 1e8:
                break
    values, vectors = jnp.linalg.eigh(curvature)
    return h, vectors / jnp.sqrt(jnp.maximum(jnp.abs(values), 0.05))[None, :]


@eqx.filter_jit
def _objective(m: Model, plain: Coordinates, h: Array) -> tuple[Array, Array, Array]:
    def minus(h: Array) -> Array:
        zeros = jnp.zeros(m.groups * len(m.table.free))
        sites, volume = _unpacked(m, plain, jnp.concatenate([h, zeros]))
        return -(log_density(m, sites) + volume)

    value, slope = jax.value_and_grad(minus)(h)
    return value, slope, jax.hessian(minus)(h)


def sampled(
    m: Model, at: Any, *, key: Array, chains: int = 4, draws: int = 1000, warm_up: int = WARM_UP, noise: Any = None
) -> Draws:
    """Draws from the model's posterior by BlackJAX's NUTS, started around the Laplace approximation.

    **Arguments:** `at`, coefficients near the posterior's mean, as `linear_fit` or `calibrate` finds them; `noise` of a
    row there. Each chain adapts its own step. **Returns:** `Draws` of every site of `kernel_model`.
    """
    run = compiled(m, chains=chains, draws=draws, warm_up=warm_up)
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        return run(m, coordinates(m, at, noise=noise), key)


def compiled(m: Model, *, chains: int, draws: int, warm_up: int) -> Callable[[Model, Coordinates, Array], Draws]:
    """The sampler as one program for models of one shape: what is timed apart from its compilation."""
    blackjax = needs("blackjax")
    k = len(m.table.free)

    @eqx.filter_jit
    def run(m: Model, c: Coordinates, key: Array) -> Any:
        def log_posterior(q: Array) -> Array:
            sites, volume = _unpacked(m, c, q)
            value = log_density(m, sites) + volume
            return jnp.where(jnp.isfinite(value), value, -jnp.inf)

        def chain(key: Array) -> Any:
            first, adapt, sample = jax.random.split(key, 3)
            dim = c.centre.shape[0] + m.groups * k
            start = 0.5 * jax.random.normal(first, (dim,))
            warm = blackjax.window_adaptation(
                blackjax.nuts, log_posterior, target_acceptance_rate=TARGET_ACCEPTANCE, initial_step_size=0.5
            )
            (state, parameters), _ = warm.run(adapt, start, num_steps=warm_up)
            kernel = blackjax.nuts(log_posterior, **parameters)

            def step(state: Any, key: Array) -> Any:
                state, info = kernel.step(key, state)
                sites, _ = _unpacked(m, c, state.position)
                return state, (sites, info.is_divergent, info.num_integration_steps)

            return jax.lax.scan(step, state, jax.random.split(sample, draws))[1]

        return jax.lax.map(chain, jax.random.split(key, chains))

    def go(m: Model, c: Coordinates, key: Array) -> Draws:
        with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
            sites, divergent, steps = jax.block_until_ready(run(m, c, key))
        return _named(m, {k: np.asarray(v) for k, v in sites.items()}, np.asarray(divergent), np.asarray(steps))

    return go


def _named(
    m: Model, sites: dict[str, np.ndarray], diverging: np.ndarray, steps: Any, by: str = "BlackJAX NUTS"
) -> Draws:
    axes = {"theta": ("vehicle", "coefficient") if m.groups else ("coefficient",)}
    axes |= {k: ("coefficient",) for k in ("mean", "spread") if k in sites}
    labels = {"coefficient": [c.name for c in m.table.free]}
    if m.groups:
        labels["vehicle"] = [str(g) for g in range(m.groups)]
    noise = "Student t" if m.student else "normal"
    grown = ", growing with energy" if m.grows else ""
    how = f"{by} on the full likelihood through the kernel ({noise} noise{grown})"
    return Draws(sites, how, axes, labels, diverging, np.asarray(steps, dtype=float))


def numpyro_nuts(m: Model, *, key: Array, chains: int = 2, draws: int = 1000, warm_up: int = 500) -> Draws:
    """The same posterior by NumPyro's own NUTS on all rows, as it comes: the check, and what speeds are compared with.

    It starts at the tables' values.
    """
    infer = needs("numpyro.infer")
    value, sd = (jnp.asarray(a) for a in tabular(m.table))
    start = {
        "mean": value,
        "spread": 0.5 * sd,
        "variance": m.noise**2,
        "growth": jnp.asarray(0.02),
        "df": jnp.asarray(8.0),
    }
    start["theta"] = jnp.tile(value, (m.groups, 1)) if m.groups else value
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        kernel = infer.NUTS(kernel_model, init_strategy=infer.init_to_value(values=start))
        sampler = infer.MCMC(
            kernel, num_warmup=warm_up, num_samples=draws, num_chains=chains, chain_method="sequential",
            progress_bar=False,
        )  # fmt: skip
        sampler.run(key, m, extra_fields=("diverging", "num_steps"))
        sites = {k: np.asarray(v) for k, v in sampler.get_samples(group_by_chain=True).items()}
        extra = sampler.get_extra_fields(group_by_chain=True)
    return _named(m, sites, np.asarray(extra["diverging"]), extra["num_steps"], "NumPyro NUTS")
