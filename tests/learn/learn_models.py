"""Small models for the tests of physics-informed networks, and rows of two trucks for them."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from learn_trucks import FEATURES, TABLE, energy_by_hand, road, truck_rows

from hdev_jax.learn.pinn.model import Pinn, Recipe, Sized
from hdev_jax.learn.pinn.rows import concatenated
from hdev_jax.physics import LIBRARY

PLAIN = Recipe(features=FEATURES, units=(6,), normalised=False, dropout=0.0)
AUXILIARY = Sized(LIBRARY["auxiliary_power"], (("power_w", 0),))
KEY = jax.random.key(0)


def recipe(**changes: Any) -> Recipe:
    return dataclasses.replace(PLAIN, **changes)


def made(recipe: Recipe, vehicles: int = 2, seed: int | None = 5, effects: tuple[Sized, ...] = ()) -> tuple[Any, Any]:
    """A model and its memory; with a seed, with random weights in its heads and in what vehicles have of their own."""
    model, memory = eqx.nn.make_with_state(Pinn)(
        recipe, vehicles, scale_wh=50.0, mean_wh=30.0, effects=effects, key=KEY
    )
    if seed is None:
        return model, memory
    rng = np.random.default_rng(seed)
    where = lambda m: (m.network.head, m.common, m.own, m.sizes, m.own_sizes)  # noqa: E731
    random = lambda x: jnp.asarray(rng.normal(0, 0.2, x.shape), jnp.float32)  # noqa: E731
    return eqx.tree_at(where, model, jax.tree.map(random, where(model))), memory


def two_trucks(rows: int = 40) -> Any:
    """Rows of two trucks with tables of their own, and energies that are not quite the table's."""
    parts = []
    for k, c_rr in enumerate((0.006, 0.009)):
        s = road(rows, 2, seed=k)
        s = dataclasses.replace(s, trip=np.asarray(s.trip) + 2 * k)
        table = {**TABLE, "c_rr": 1.2 * c_rr, "auxiliary_w": 3000.0}
        parts.append(truck_rows(s, energy_by_hand(s, table), number=k, c_rr=c_rr))
    return concatenated(parts)


def by_hand(rows: Any, c_rr: Any, cda: Any, *, wheel: bool = False) -> np.ndarray:
    return energy_by_hand(jax.tree.map(np.asarray, rows.segments), {**TABLE, "c_rr": c_rr, "cda_m2": cda}, wheel=wheel)
