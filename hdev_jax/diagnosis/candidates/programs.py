"""How a candidate's column is computed: a vehicle with effects at their null, and a derivative or difference of it."""

from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hdev_jax.inference import insert
from hdev_jax.physics import Effect, Grouped, Vehicle
from hdev_jax.segments import Segments
from hdev_jax.targets import TargetName

__all__ = ["Program", "Recipe", "computed", "written"]

Structure = tuple[tuple[str, int | None, float, float], ...]


@dataclass(frozen=True, eq=False)
class Program:
    """A vehicle with effects at their null, compiled once for one shape of rows.

    `structure` says where each of their parameters sits, `null` holds the parameters' null values, and those of found
    effects as they were fitted.
    """

    car: Vehicle
    structure: Structure
    null: Float[np.ndarray, " parameter"]

    @staticmethod
    def of(vehicle: Vehicle, effects: Iterable[Effect], found: Collection[str] = ()) -> "Program":
        """The program of a vehicle with these effects beside its own. Raises `ValueError` for one it has already.

        `found`: ids of effects of its own whose numbers are arguments as well, so that vehicles with other effects
        found share the program.
        """
        car, structure, at = vehicle.plus(*effects), [], []
        added = {e.id for e in car.effects} - {e.id for e in vehicle.effects} | {*found}
        for e in (e for e in car.effects if e.id in added):
            for p in e.parameters:
                leaf = getattr(e, p.name)
                if leaf is None:
                    continue
                grouped = isinstance(leaf, Grouped)
                values = np.atleast_1d(np.asarray(leaf.values if grouped else leaf, dtype=float))
                path = f"effects.{e.id}.{p.name}"
                structure += [(path, g if grouped else None, -np.inf, np.inf) for g in range(len(values))]
                at += [*values]
        return Program(car, tuple(structure), np.array(at))

    def recipe(
        self, effect_id: str, shapes: Sequence[tuple[str, float]], size: tuple[str, int | None] | None
    ) -> "Recipe":
        """The derivative in a size (and its group) at these shapes; without a size, the difference they make."""
        values = self.null.copy()
        for name, v in shapes:
            values[self._index(effect_id, name, None)] = v
        if size is None:
            return Recipe(self, values, None)
        tangent = np.zeros_like(values)
        tangent[self._index(effect_id, *size)] = 1.0
        return Recipe(self, values, tangent)

    def _index(self, effect_id: str, name: str, group: int | None) -> int:
        path = f"effects.{effect_id}.{name}"
        return next(i for i, s in enumerate(self.structure) if s[0] == path and s[1] in (group, None))


@dataclass(frozen=True, eq=False)
class Recipe:
    """One column: the program's derivative at `values` along `tangent`, or without one its difference to the null."""

    program: Program
    values: Float[np.ndarray, " parameter"]
    tangent: Float[np.ndarray, " parameter"] | None


def computed(recipes: Sequence[Recipe], segments: Segments, target: TargetName) -> Iterator[Float[np.ndarray, " row"]]:
    """The recipes' columns of padded segments, one after the other, as they are: not all need be numbers."""
    segments = jax.tree.map(jnp.asarray, segments)
    base: dict[int, np.ndarray] = {}
    for r in recipes:
        p = r.program
        if r.tangent is not None:
            yield np.asarray(_slope(p.car, p.structure, target, segments, r.values, r.tangent))
        else:
            if id(p) not in base:
                base[id(p)] = np.asarray(_predict(p.car, p.structure, target, segments, p.null))
            yield np.asarray(_predict(p.car, p.structure, target, segments, r.values)) - base[id(p)]


def written(out: np.ndarray, recipes: Sequence[Recipe], segments: Segments, target: TargetName) -> None:
    """Write the recipes' columns of padded segments into `out` [row, column]; what is no number counts as 0."""
    for k, column in enumerate(computed(recipes, segments, target)):
        out[:, k] = np.nan_to_num(column, posinf=0.0, neginf=0.0)


# not `eqx.filter_jit`: every leaf is an array, and sorting them out takes longer than the column of a short log
@partial(jax.jit, static_argnums=(1, 2))
def _predict(car: Vehicle, structure: Structure, target: TargetName, segments: Segments, values: Any) -> Array:
    return insert(car, structure, jnp.asarray(values)).predict(segments, target)


@partial(jax.jit, static_argnums=(1, 2))
def _slope(
    car: Vehicle, structure: Structure, target: TargetName, segments: Segments, values: Any, tangent: Any
) -> Array:
    def predict(x: Array) -> Array:
        return insert(car, structure, x).predict(segments, target)

    return jax.jvp(predict, (jnp.asarray(values),), (jnp.asarray(tangent),))[1]
