"""How a candidate's column is computed: a vehicle with effects at their null, and a derivative or difference of it."""

from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hdev_jax.inference.parameters import insert, leaf_of
from hdev_jax.physics import Effect, Grouped, Size, Vehicle
from hdev_jax.segments import Segments
from hdev_jax.targets import TargetName

__all__ = ["PER_PASS", "SIDE_BY_SIDE", "Place", "Program", "Recipe", "computed"]

Place = tuple[str, int | None]  # a coefficient's path, and its group
Structure = tuple[tuple[str, int | None, float, float], ...]
# These two change the time alone, not what is found.
PER_PASS = 4  # columns in one pass: 9 ms for 14,000 rows, one alone 7.5 ms
SIDE_BY_SIDE = 2 * PER_PASS  # coefficients' derivatives in one pass: always as many, so that one program serves all


class _Part(NamedTuple):
    """Some effects of a program's vehicle; `structure` and `at` say which of the program's numbers are theirs."""

    car: Vehicle
    structure: Structure
    at: list[int]

    def corrected(self, segments: Segments, values: Float[np.ndarray, " parameter"]) -> Segments:
        """The measurements as these effects correct them; as they are where there are none."""
        return _corrected(self.car, self.structure, segments, values[self.at]) if self.car.effects else segments


@dataclass(frozen=True, eq=False)
class Program:
    """A vehicle with effects at their null, compiled once for one shape of rows.

    `structure` says where each of their parameters sits, `null` holds the parameters' null values, and those of found
    effects and of the declared model as they were fitted. What only corrects measurements across rows is compiled apart
    from the kernel, and so is each `observe`: they are small, and the kernel is the same with and without. An effect
    that does more than observe is in the kernel too.
    """

    car: Vehicle
    structure: Structure
    null: Float[np.ndarray, " parameter"]

    def predicted(
        self, segments: Segments, target: TargetName, values: Float[np.ndarray, " parameter"]
    ) -> Float[np.ndarray, " row"]:
        """The prediction at these values, in the target's unit."""
        before, kernel, after = self.parts
        seen = before.corrected(segments, values)
        column = _column(kernel.car, kernel.structure, target, seen, values[kernel.at])
        for part in after:
            column = _observed(part.car, part.structure, segments, column, values[part.at])
        return np.asarray(_in_unit(self._bare, target, segments, column))

    def linearised(
        self, segments: Segments, target: TargetName, values: Float[np.ndarray, " parameter"], free: Sequence[int],
        *, lanes: int = SIDE_BY_SIDE,
    ) -> tuple[Float[np.ndarray, " row"], Float[np.ndarray, "row free"]]:  # fmt: skip
        """The prediction at these values, in the target's unit, and its derivatives in the parameters `free`, per unit
        of each, `lanes` of them in a pass."""
        along = np.zeros((-(-len(free) // lanes) * lanes, len(values)))
        along[np.arange(len(free)), free] = 1.0
        passes = [self._along(segments, target, values, along[k : k + lanes]) for k in range(0, len(along), lanes)]
        return passes[0][0], np.concatenate([slopes for _, slopes in passes], axis=1)[:, : len(free)]

    def _along(
        self, segments: Segments, target: TargetName, values: Float[np.ndarray, " parameter"],
        along: Float[np.ndarray, "direction parameter"],
    ) -> tuple[Float[np.ndarray, " row"], Float[np.ndarray, "row direction"]]:  # fmt: skip
        """The prediction at these values, and its derivatives along these directions."""
        before, kernel, after = self.parts
        seen, at = before.corrected(segments, values), values[kernel.at]
        column, slopes = _column_slopes(kernel.car, kernel.structure, target, seen, at, along[:, kernel.at])
        for k in np.flatnonzero(np.any(along[:, before.at] != 0, axis=1)):
            moved = _corrected_slope(before.car, before.structure, segments, values[before.at], along[k, before.at])
            slopes = slopes.at[:, k].add(_column_moved(kernel.car, kernel.structure, target, seen, at, moved))
        each = [slopes[:, k : k + PER_PASS] for k in range(0, len(along), PER_PASS)]  # always as many: compiled once
        for part in after:
            own, ways = values[part.at], along[:, part.at]
            shown = [
                _observed_slopes(part.car, part.structure, segments, column, own, x, ways[k * PER_PASS :][:PER_PASS])
                for k, x in enumerate(each)
            ]
            column, each = shown[0][0], [x for _, x in shown]
        converted = [np.asarray(_in_unit(self._bare, target, segments, x)) for x in (column, *each)]
        return converted[0], np.concatenate(converted[1:], axis=1)

    @cached_property
    def parts(self) -> tuple[_Part, _Part, list[_Part]]:
        """What corrects the measurements across rows, the kernel, and each effect that changes the predicted column."""
        every = self.car.effects
        across, observing = ([e for e in every if e.overrides(hook)] for hook in ("across", "observe"))
        # one after the other: where one of them does more, all stay in the kernel
        if not all(e.alone("across") and not any(isinstance(p, Size) for p in e.parameters) for e in across):
            across = []
        outside = [e.id for e in (*across, *(e for e in observing if e.alone("observe")))]
        held = [k for k, s in enumerate(self.structure) if not s[0].startswith(tuple(f"effects.{i}." for i in outside))]
        return (
            self._part(self._bare.plus(*across), self._places(across)), self._part(self.car.minus(*outside), held),
            [self._part(self._bare.plus(e), self._places([e])) for e in observing],
        )  # fmt: skip

    @cached_property
    def _bare(self) -> Vehicle:
        return self.car.minus(*(e.id for e in self.car.effects))

    def _places(self, effects: Sequence[Effect]) -> list[int]:
        heads = tuple(f"effects.{e.id}." for e in effects)
        return [k for k, s in enumerate(self.structure) if s[0].startswith(heads)]

    def _part(self, car: Vehicle, at: list[int]) -> _Part:
        return _Part(car, tuple(self.structure[k] for k in at), at)

    @staticmethod
    def of(
        vehicle: Vehicle, effects: Iterable[Effect], found: Collection[str] = (), declared: Sequence[Place] = ()
    ) -> "Program":
        """The program of a vehicle with these effects beside its own. Raises `ValueError` for one it has already.

        `found`: ids of effects of its own whose numbers are arguments as well, so that vehicles with other effects
        found share the program. `declared`: coefficients of the declared model that are arguments too; `KeyError` for
        one that the vehicle does not have.
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
        for path, group in declared:
            leaf = leaf_of(car, path)
            structure += [(path, group, -np.inf, np.inf)]
            at += [float(leaf if group is None else leaf.values[group])]
        return Program(car, tuple(structure), np.array(at))

    def recipe(
        self, effect_id: str, shapes: Sequence[tuple[str, float]], size: tuple[str, int | None] | None
    ) -> "Recipe":
        """The derivative in a size (and its group) at these shapes; without a size, the difference they make."""
        values = self.null.copy()
        for name, v in shapes:
            values[self._index(effect_id, name, None)] = v
        own = np.array([s[0].startswith(f"effects.{effect_id}.") for s in self.structure])
        return Recipe(self, values, own, None if size is None else self._index(effect_id, *size))

    def _index(self, effect_id: str, name: str, group: int | None) -> int:
        path = f"effects.{effect_id}.{name}"
        return next(i for i, s in enumerate(self.structure) if s[0] == path and s[1] in (group, None))


@dataclass(frozen=True, eq=False)
class Recipe:
    """One column: the program's derivative at `values` in the parameter `size`, or without one its difference to the
    null; `own` are the parameters of its effect."""

    program: Program
    values: Float[np.ndarray, " parameter"]
    own: Bool[np.ndarray, " parameter"]
    size: int | None


@dataclass
class _Pass:
    """Derivatives that the program gives at once, each at the shapes of its own effect: shapes of an effect whose sizes
    are at their null change no other effect's column."""

    program: Program
    values: Float[np.ndarray, " parameter"]
    claimed: Bool[np.ndarray, " parameter"]
    places: list[tuple[int, int]]  # among the recipes, and of the size

    def takes(self, r: Recipe) -> bool:
        """Whether the recipe's shapes agree with those that are here."""
        there = r.program is self.program and len(self.places) < PER_PASS
        return there and not np.any(self.claimed & r.own & (self.values != r.values))


def computed(
    recipes: Sequence[Recipe], segments: Segments, target: TargetName
) -> Iterator[tuple[int, Float[np.ndarray, " row"]]]:
    """Places among the recipes and columns of padded segments, as they are: not all need be numbers."""
    segments = jax.tree.map(jnp.asarray, segments)
    base: dict[int, np.ndarray] = {}
    passes: list[_Pass] = []
    for k, r in enumerate(recipes):
        p = r.program
        if r.size is None:
            if id(p) not in base:
                base[id(p)] = p.predicted(segments, target, p.null)
            yield k, p.predicted(segments, target, r.values) - base[id(p)]
            continue
        fits = next((x for x in passes if x.takes(r)), None)
        if fits is None:
            passes.append(fits := _Pass(p, p.null, np.zeros(len(p.null), bool), []))
        fits.values, fits.claimed = np.where(r.own, r.values, fits.values), fits.claimed | r.own
        fits.places.append((k, r.size))
    for x in passes:
        sizes = [size for _, size in x.places]
        slopes = x.program.linearised(segments, target, x.values, sizes, lanes=PER_PASS)[1]
        for column, (k, size) in zip(slopes.T, x.places, strict=True):
            if not np.all(np.isfinite(column)):  # perhaps for another's shape
                column = x.program.linearised(segments, target, recipes[k].values, [size], lanes=PER_PASS)[1][:, 0]
            yield k, column


# not `eqx.filter_jit`: every leaf is an array, and sorting them out takes longer than the column of a short log
@partial(jax.jit, static_argnums=1)
def _corrected(car: Vehicle, structure: Structure, segments: Segments, values: Any) -> Segments:
    return insert(car, structure, jnp.asarray(values)).corrected(segments)


@partial(jax.jit, static_argnums=(1, 2))
def _column(car: Vehicle, structure: Structure, target: TargetName, segments: Segments, values: Any) -> Array:
    return insert(car, structure, jnp.asarray(values)).column(segments, target)


@partial(jax.jit, static_argnums=(1, 2))
def _column_slopes(
    car: Vehicle, structure: Structure, target: TargetName, segments: Segments, values: Any, directions: Any
) -> tuple[Array, Array]:
    def column(x: Array) -> Array:
        return insert(car, structure, x).column(segments, target)

    def along(direction: Array) -> tuple[Array, Array]:
        return jax.jvp(column, (jnp.asarray(values),), (direction,))

    return jax.vmap(along, out_axes=(None, -1))(jnp.asarray(directions))


@partial(jax.jit, static_argnums=1)
def _corrected_slope(car: Vehicle, structure: Structure, segments: Segments, values: Any, tangent: Any) -> Segments:
    def numbers(x: Array) -> Segments:
        return eqx.filter(insert(car, structure, x).corrected(segments), eqx.is_inexact_array)

    return jax.jvp(numbers, (jnp.asarray(values),), (jnp.asarray(tangent),))[1]


@partial(jax.jit, static_argnums=(1, 2))
def _column_moved(
    car: Vehicle, structure: Structure, target: TargetName, segments: Segments, values: Any, moved: Segments
) -> Array:
    """The derivative of the column along `moved` measurements."""
    numbers, others = eqx.partition(segments, eqx.is_inexact_array)

    def column(x: Segments) -> Array:
        return insert(car, structure, jnp.asarray(values)).column(eqx.combine(x, others), target)

    return jax.jvp(column, (numbers,), (moved,))[1]


@partial(jax.jit, static_argnums=1)
def _observed(car: Vehicle, structure: Structure, segments: Segments, column: Array, values: Any) -> Array:
    return insert(car, structure, jnp.asarray(values)).effects[0].observe(column, segments)


@partial(jax.jit, static_argnums=1)
def _observed_slopes(
    car: Vehicle, structure: Structure, segments: Segments, column: Array, values: Any, slopes: Any, directions: Any
) -> tuple[Array, Array]:
    def observed(y: Array, x: Array) -> Array:
        return insert(car, structure, x).effects[0].observe(y, segments)

    def along(slope: Array, direction: Array) -> tuple[Array, Array]:
        return jax.jvp(observed, (column, jnp.asarray(values)), (slope, direction))

    return jax.vmap(along, in_axes=(-1, 0), out_axes=(None, -1))(jnp.asarray(slopes), jnp.asarray(directions))


@partial(jax.jit, static_argnums=1)
def _in_unit(bare: Vehicle, target: TargetName, segments: Segments, columns: Array) -> Array:
    """A column, or several side by side, in the target's unit: without effects, `shown` only converts it."""
    if columns.ndim == 1:
        return bare.shown(columns, segments, target)
    return jax.vmap(lambda x: bare.shown(x, segments, target), in_axes=-1, out_axes=-1)(columns)
