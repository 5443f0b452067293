"""The probabilistic model, once, in NumPyro: the kernel's prediction, tabular priors, vehicles that resemble."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from hdev_jax.inference.calibrate import Fit, tabular
from hdev_jax.inference.design import GROUP
from hdev_jax.inference.linear import LEAST_ROWS
from hdev_jax.inference.parameters import ParameterTable, insert, insert_by
from hdev_jax.inference.posterior.draws import needs
from hdev_jax.physics import Vehicle
from hdev_jax.segments import Segments
from hdev_jax.targets import TargetName

__all__ = ["GROWTH", "POOL_FREEDOM", "Model", "kernel_model", "log_density", "predicted_by"]

GROWTH = 0.1  # sd of the share of its own energy that a row's noise grows by
DF_SHAPE, DF_RATE = 2.0, 0.1  # of the Student t's degrees of freedom: Juárez and Steel, J. Bus. Econ. Stat. 28 (2010)
POOL_FREEDOM = 4.0  # half-t of the spread between vehicles, at the scale of the table's own sd (Gelman 2006)


class Model(eqx.Module):
    """What a posterior is of: rows, vehicle, table, and how they are put together.

    `noise` is what a row's is believed to be (its variance counts for `LEAST_ROWS` rows), `size` the |energy| that it
    grows with, `worth` the share of an independent row that each counts for. `group` of each row and `groups`, where
    every group (vehicle) has coefficients of its own, which are drawn from a fleet's whose mean has the tables' prior
    and whose spread is of the size of the tables' sds.
    """

    vehicle: Vehicle
    segments: Segments
    measured: Array
    weight: Array
    size: Array
    noise: Array
    worth: Array
    group: Array | None
    table: ParameterTable = eqx.field(static=True)
    target: TargetName = eqx.field(static=True)
    groups: int = eqx.field(static=True, default=0)
    student: bool = eqx.field(static=True, default=True)
    grows: bool = eqx.field(static=True, default=True)

    @staticmethod
    def of(
        vehicle: Vehicle, table: ParameterTable, fit: Fit, target: TargetName, *, noise: float, size: Any = None,
        group: Any = None, groups: int = 0, student: bool = True, grows: bool = True, worth: float = 1.0,
    ) -> "Model":  # fmt: skip
        """From padded rows; `group` and `size` are of the real ones."""
        extra = np.shape(fit.weight)[0] - fit.rows

        def whole(x: Any, dtype: Any) -> Array:
            return jnp.asarray(np.concatenate([np.asarray(x, dtype=dtype), np.zeros(extra, dtype=dtype)]))

        size = np.abs(np.asarray(fit.measured)[: fit.rows]) if size is None else np.abs(size)
        ids = None if group is None else whole(group, int)
        return Model(
            vehicle, jax.tree.map(jnp.asarray, fit.segments), jnp.asarray(fit.measured), jnp.asarray(fit.weight),
            whole(size, float), jnp.asarray(noise, dtype=float), jnp.asarray(worth, dtype=float), ids, table, target,
            groups, student, grows,
        )  # fmt: skip


def predicted_by(m: Model, theta: Array) -> Array:
    """The target's column with coefficients `[k]`, or `[group, k]`."""
    if m.groups:
        rows = m.segments.with_channels(**{GROUP: m.group.astype(theta.dtype)})  # pyright: ignore
        return insert_by(m.vehicle, m.table.structure, theta, GROUP).predict(rows, m.target)
    return insert(m.vehicle, m.table.structure, theta).predict(m.segments, m.target)


def kernel_model(m: Model) -> None:
    """The NumPyro model. Every sampler of this package has its density from here."""
    numpyro, dist = needs("numpyro"), needs("numpyro.distributions")
    value, sd = (jnp.asarray(a) for a in tabular(m.table))
    if m.groups:
        mean = numpyro.sample("mean", dist.Normal(value, sd).to_event(1))
        spread = dist.FoldedDistribution(dist.StudentT(POOL_FREEDOM, jnp.zeros_like(sd), sd)).to_event(1)
        tau = numpyro.sample("spread", spread)
        with numpyro.plate("groups", m.groups):
            theta = numpyro.sample("theta", dist.Normal(mean, tau).to_event(1))
    else:
        theta = numpyro.sample("theta", dist.Normal(value, sd).to_event(1))
    shape = 0.5 * LEAST_ROWS
    variance = numpyro.sample("variance", dist.InverseGamma(shape, (shape - 1.0) * m.noise**2))
    scale = jnp.sqrt(variance) * jnp.ones_like(m.size)
    if m.grows:
        growth = numpyro.sample("growth", dist.HalfNormal(GROWTH))
        scale = jnp.sqrt(variance + (growth * m.size) ** 2)
    lower = jnp.asarray([c.lower for c in m.table.free])
    upper = jnp.asarray([c.upper for c in m.table.free])
    inside = jnp.all((theta > lower) & (theta < upper), axis=-1)
    numpyro.factor("support", jnp.sum(jnp.where(inside, 0.0, -jnp.inf)))
    # outside the support the kernel may not be finite: it is asked at the edge, and the answer is not used
    predicted = predicted_by(m, jnp.clip(theta, lower, upper))
    if m.student:
        df = numpyro.sample("df", dist.Gamma(DF_SHAPE, DF_RATE))
        noise: Any = dist.StudentT(df, predicted, scale)
    else:
        noise = dist.Normal(predicted, scale)
    with needs("numpyro.handlers").scale(scale=m.worth):
        numpyro.sample("measured", noise.mask(m.weight > 0), obs=m.measured)


def log_density(m: Model, sites: dict[str, Array]) -> Array:
    """Log of prior times likelihood at values of the model's sites."""
    util = needs("numpyro.infer.util")
    return util.log_density(kernel_model, (m,), {}, sites)[0]
