"""What a physics-informed network minimises: equation 7 of paper 1, or a likelihood with what is known beforehand."""

from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, PRNGKeyArray

from hdev_jax.learn.pinn.heads import Heads
from hdev_jax.learn.pinn.model import Pinn, Prediction, centred
from hdev_jax.learn.pinn.rows import Rows
from hdev_jax.segments import Column

__all__ = ["LOG_SD", "Objective"]

LOG_SD = 0.3  # of a vehicle's coefficient about its table, in logarithms: tables are off by some ten per cent
_SPREAD_DOF = 0.1  # degrees of freedom of what is known beforehand of how far vehicles are apart


@dataclass(frozen=True)
class Objective:
    """Equation 7, or the likelihood. Batches are `Rows` [stretch, row of it, …]; `settings` are λ₁, λ₂ and λ₃ (of the
    likelihood: what the measured term, the physics term and the priors are weighed by); `rows` is how many there are.
    """

    static: Any  # the model without its weights
    rows: int

    def loss(self, weights: Any, memory: Any, batch: Rows, key: PRNGKeyArray, settings: Any) -> tuple[Array, Any]:
        """Of one batch."""
        model: Pinn = eqx.combine(weights, self.static)
        flat = _flat(batch)
        p, heads, memory = model(flat, memory, key=key)
        terms = self._squares if model.recipe.loss == "squares" else self._likelihood
        return jnp.sum(settings * jnp.stack(terms(model, p, heads, flat, batch))), memory

    def score(self, weights: Any, memory: Any, data: Rows, settings: Any) -> Array:
        """The first term alone, of rows that were held out."""
        model: Pinn = eqx.combine(weights, self.static)
        flat = _flat(data)
        p, heads, _ = model(flat, memory)
        terms = self._squares if model.recipe.loss == "squares" else self._likelihood
        return terms(model, p, heads, flat, data)[0]

    def _squares(self, model: Pinn, p: Prediction, heads: Heads, rows: Rows, batch: Rows) -> tuple[Array, ...]:
        def mean(x: Column) -> Array:
            return jnp.sum(rows.weight * x) / jnp.sum(rows.weight)

        unit = (rows.c_rr, rows.cda_m2) if model.recipe.coefficient_loss == "relative" else (1.0, 1.0)
        pairs = zip((p.c_rr, p.cda_m2), (rows.c_rr, rows.cda_m2), unit, strict=True)
        away = sum((mean(((x - table) / u) ** 2) for x, table, u in pairs), jnp.zeros(()))
        return mean((rows.energy_wh - p.energy_wh) ** 2), mean((rows.energy_wh - p.physics_wh) ** 2), away

    def _likelihood(self, model: Pinn, p: Prediction, heads: Heads, rows: Rows, batch: Rows) -> tuple[Array, ...]:
        w, count = rows.weight, jnp.sum(rows.weight)
        floor, share = jnp.exp(model.noise[2]) * model.scale_wh, jnp.exp(model.noise[3])
        loose = jnp.sqrt(floor**2 + (share * p.physics_wh) ** 2 + jnp.asarray(rows.loose_wh) ** 2)
        error, off = rows.energy_wh - p.energy_wh, rows.energy_wh - p.physics_wh
        data = jnp.sum(w * _normal(error, p.sd_wh)) / count
        physics = jnp.sum(w * _normal(off, loose)) / count
        shape = batch.weight.shape
        if model.recipe.stretch > 1:
            whole = lambda x: jnp.sum((w * x).reshape(shape), axis=1)  # noqa: E731
            shared = (jnp.exp(model.drift) * whole(p.physics_wh)) ** 2 + whole(rows.loose_wh) ** 2
            sd = jnp.sqrt(whole(p.sd_wh**2 - rows.loose_wh**2) + shared + 1e-6)
            data = data + jnp.sum(_normal(whole(error), sd) * (whole(w) > 0)) / count
        prior = 0.5 * jnp.sum(model.common**2) / LOG_SD**2 + _between_vehicles(model.own, LOG_SD)
        prior += sum(0.5 * jnp.sum(x**2) for x in model.sizes.values())
        prior += sum(_between_vehicles(x, 1.0) for x in model.own_sizes.values())
        by_row = jnp.sum(w[:, None] * heads.coefficients**2) / count
        return data, physics, prior / self.rows + 0.01 * by_row


def _between_vehicles(own: Array, usual: float) -> Array:
    """Minus the logarithm of the density of what vehicles have of their own [vehicle, …], but for a constant.

    Each column is normal about the mean, with a variance that has the scaled inverse χ² distribution about `usual`²,
    of so few degrees of freedom that the data say what it is: integrated out, a multivariate Student t (Gelman et al.,
    Bayesian Data Analysis, 3.2) of one dimension less than there are vehicles, the mean being taken out. So a
    coefficient that is alike in all vehicles is estimated from all of their rows together.
    """
    squares = jnp.sum(centred(own) ** 2, axis=0)
    power = 0.5 * (_SPREAD_DOF + own.shape[0] - 1)
    return power * jnp.sum(jnp.log1p(squares / (_SPREAD_DOF * usual**2)))


def _normal(error: Column, sd: Column) -> Array:
    """Minus the logarithm of the normal density, but for a constant."""
    return 0.5 * jnp.square(error / sd) + jnp.log(sd)


def _flat(batch: Rows) -> Rows:
    """Stretches one after the other."""
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), batch)
