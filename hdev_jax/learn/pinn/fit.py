"""Fitting a physics-informed network: rows in stretches of a trip, members side by side, an ensemble's prediction."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from hdev_jax.errors import InputError
from hdev_jax.learn.pinn.loss import Objective
from hdev_jax.learn.pinn.model import C_RR_LIMIT, Pinn, Prediction, Recipe, Sized, predict
from hdev_jax.learn.pinn.rows import Rows
from hdev_jax.learn.sequences import Scale
from hdev_jax.learn.train import Plan, Trained, train

__all__ = ["PAPER_WEIGHTS", "Ensemble", "Member", "Sizes", "fit", "stretches"]

PAPER_WEIGHTS = (1.0, 0.1, 0.01)  # λ₁, λ₂, λ₃ of section 3.3.2
_AT_ONCE = 2**13  # rows of a prediction; of more, what the hidden layers say does not fit the caches


@dataclass(frozen=True)
class Member:
    """One network: its seed, and what the terms of its loss are weighed by."""

    seed: int
    weights: tuple[float, float, float] = PAPER_WEIGHTS


class Sizes(NamedTuple):
    """`Pinn`'s numbers of these names, known from elsewhere and not trained. What the network's head says of a row's
    coefficients still moves them, for all vehicles alike."""

    common: Float[np.ndarray, " 2"]
    own: Float[np.ndarray, "vehicle 2"]
    sizes: dict[str, np.ndarray]
    own_sizes: dict[str, np.ndarray]

    def of(self, model: Pinn) -> Pinn:
        """The model with these numbers. Raises `ValueError` where it has others."""

        def put(old: Array, new: Any) -> Array:
            if np.shape(old) != np.shape(new):
                raise ValueError(f"sizes: {np.shape(old)} numbers are expected, found {np.shape(new)}")
            return jnp.asarray(new, old.dtype)

        return eqx.tree_at(_sizes, model, jax.tree.map(put, _sizes(model), tuple(self)))


def _sizes(model: Pinn) -> tuple[Any, ...]:
    return model.common, model.own, model.sizes, model.own_sizes


def _trained(model: Pinn, sizes: Sizes | None) -> Any:
    """Which leaves are trained."""
    every = jax.tree.map(eqx.is_inexact_array, model)
    if sizes is None:
        return every
    return eqx.tree_at(_sizes, every, jax.tree.map(lambda _: False, _sizes(model)))


@dataclass(frozen=True)
class Ensemble:
    """Members with one recipe: weights and memory with a leading axis of members, and the features' scale."""

    model: Pinn
    memory: eqx.nn.State
    scale: Scale
    members: tuple[Member, ...]
    trained: Trained

    @property
    def diverged(self) -> np.ndarray:
        """Whether a member [member] never had a finite score: it is as it began, and says nothing."""
        finite = np.isfinite(self.trained.scores.reshape(len(self.members), -1))
        return np.logical_not(np.any(finite, axis=1))

    def predict(self, rows: Rows) -> list[Prediction]:
        """What each member says of each row, as NumPy."""
        scaled = _scaled(rows, self.scale)
        out = []
        for k in range(len(self.members)):
            arrays, static = eqx.partition(self.model, eqx.is_array)
            one = eqx.combine(jax.tree.map(lambda x, k=k: x[k], arrays), static)
            parts = []
            for first in range(0, len(rows), _AT_ONCE):
                # the last part is filled up, so that one program serves all
                at = np.minimum(np.arange(first, first + min(_AT_ONCE, _filled(len(rows)))), len(rows) - 1)
                part = jax.tree.map(
                    np.asarray, predict(one, jax.tree.map(lambda x, k=k: x[k], self.memory), scaled.take(at))
                )
                parts.append(jax.tree.map(lambda x, first=first: x[: len(rows) - first], part))
            out.append(jax.tree.map(lambda *x: np.concatenate(x), *parts))
        return out

    def mean(self, rows: Rows) -> Prediction:
        """Mean of the members that did not diverge; `sd_wh` holds the noise and how far the members are apart."""
        every = [p for p, lost in zip(self.predict(rows), self.diverged, strict=True) if not lost]
        means = jax.tree.map(lambda *x: np.mean(x, axis=0), *every)
        noise = np.mean([p.sd_wh**2 for p in every], axis=0)
        apart = np.var([p.energy_wh for p in every], axis=0)
        return eqx.tree_at(lambda p: p.sd_wh, means, np.sqrt(noise + apart))


def _filled(n: int) -> int:
    return 2 ** int(np.ceil(np.log2(max(n, 256))))


def _scaled(rows: Rows, scale: Scale) -> Rows:
    return eqx.tree_at(lambda r: r.features, rows, np.asarray(scale.apply(rows.features), np.float32))


def stretches(rows: Rows, length: int) -> Rows:
    """Rows in stretches of a trip [stretch, `length`]; what fills the last of a trip has weight 0.

    Rows of a trip must follow one another.
    """
    if length == 1:
        return jax.tree.map(lambda x: np.asarray(x)[:, None], rows)
    trip, vehicle = np.asarray(rows.segments.trip), np.asarray(rows.vehicle)
    starts = np.flatnonzero(np.r_[True, (trip[1:] != trip[:-1]) | (vehicle[1:] != vehicle[:-1])])
    ends = np.r_[starts[1:], len(trip)]
    firsts = np.concatenate([np.arange(a, b, length) for a, b in zip(starts, ends, strict=True)])
    last = np.repeat(ends, [-(-(b - a) // length) for a, b in zip(starts, ends, strict=True)])
    at = firsts[:, None] + np.arange(length)[None, :]
    inside = at < last[:, None]
    out = rows.take(np.minimum(at, last[:, None] - 1))
    return eqx.tree_at(lambda r: r.weight, out, np.where(inside, out.weight, np.float32(0)))


def fit(
    recipe: Recipe,
    rows: Rows,
    held: Rows,
    *,
    vehicles: int,
    members: Sequence[Member],
    plan: Plan,
    rate: float = 0.005,
    effects: tuple[Sized, ...] = (),
    sizes: Sizes | None = None,
    checkpoint: Path | None = None,
    tell: Callable[[int, float, float], None] | None = None,
) -> Ensemble:
    """Adam at `rate` on batches of `plan.batch` rows; the best epoch by the rows `held`.

    **Arguments:** `vehicles`, how many there are in `rows`; `sizes` of coefficients and effects that are known;
    `checkpoint`, a file to go on from, as in `train`; it does not hold `sizes`. All members train in one program.

    **Raises:** `DivergedError` where no member is left; `InputError` where there are no rows, or where a table's c_rr
    is not within the bounds that the recipe keeps it in.
    """
    if not len(rows) or not len(held):
        raise InputError(f"{len(rows)} rows to train on and {len(held)} held out; some of both are needed")
    tables = np.concatenate([np.asarray(r.c_rr) for r in (rows, held)])
    outside = tables[~((tables > 0) & (tables < C_RR_LIMIT))]
    if recipe.coefficients == "bounded" and len(outside):
        raise InputError(
            f"bounded coefficients: a table's c_rr is {outside[0]:.4g}, between 0 and {C_RR_LIMIT} is expected; "
            "take free ones"
        )
    scale = Scale.of(np.asarray(rows.features, float))
    data = stretches(_scaled(rows, scale), recipe.stretch)
    check = stretches(_scaled(held, scale), recipe.stretch)
    plan = Plan(**{**plan.__dict__, "batch": max(1, plan.batch // recipe.stretch)})
    told = np.asarray(rows.energy_wh, float) / np.asarray(rows.unit, float)
    make = partial(
        eqx.nn.make_with_state(Pinn), recipe, vehicles, scale_wh=float(np.std(told)), mean_wh=float(np.mean(told)),
        effects=effects,
    )  # fmt: skip
    made = [make(key=jax.random.fold_in(jax.random.key(m.seed), 0)) for m in members]
    models = [model if sizes is None else sizes.of(model) for model, _ in made]
    arrays = [eqx.partition(model, _trained(model, sizes)) for model in models]
    static = arrays[0][1]
    weights = jax.tree.map(lambda *x: jnp.stack(x), *(w for w, _ in arrays))
    memory = jax.tree.map(lambda *x: jnp.stack(x), *(s for _, s in made))
    keys = jnp.stack([jax.random.fold_in(jax.random.key(m.seed), 1) for m in members])
    settings = jnp.asarray([m.weights for m in members], jnp.float32)
    single = len(members) == 1
    if single:
        weights, memory = jax.tree.map(lambda x: x[0], (weights, memory))
        keys, settings = keys[0], settings[0]
    trained = train(
        Objective(static, len(rows)), weights, memory, jax.tree.map(jnp.asarray, data), optax.adam(rate), plan,
        key=keys, held=jax.tree.map(jnp.asarray, check), settings=settings, members="" if single else "in turn",
        checkpoint=checkpoint, tell=tell,
    )  # fmt: skip
    weights, memory = trained.weights, trained.memory
    if single:
        weights, memory = jax.tree.map(lambda x: x[None], (weights, memory))
    alike = jax.tree.map(lambda x: jnp.stack([x] * len(members)) if eqx.is_array(x) else x, static)
    return Ensemble(eqx.combine(weights, alike), memory, scale, tuple(members), trained)
