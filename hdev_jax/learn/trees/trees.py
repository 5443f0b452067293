"""Boosted trees as arrays of a pytree, evaluated within jit: oblivious ones by bits, others by sets of leaves.

Features are read in float32 and compared as `ordered` whole numbers: right is `ordered(x) > threshold`, whatever the
library, and `tree_files` rounds its thresholds so that the outcome is the library's for every float32 there is, the
subnormal ones included, which XLA takes for 0 in a comparison of floats. Scores are sums of leaves; they are piecewise
constant, so their gradient by the features is 0.
"""

from typing import Any, ClassVar, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, UInt32

from hdev_jax.errors import InputError

__all__ = ["IDLE", "Branching", "Oblivious", "Reading", "Trees", "ordered"]

FEW = 64  # up to so many rows, all trees at once: a loop over trees would cost more than it does
IDLE = 0x7FFFFFFF  # a threshold that nothing is above


def ordered(x: Float[Array, "*row"]) -> Int[Array, "*row"]:
    """Float32 as whole numbers in the same order, −0 and 0 as one; NaN lies beyond the infinities."""
    bits = jax.lax.bitcast_convert_type(x.astype(jnp.float32), jnp.int32)
    size = bits & jnp.int32(0x7FFFFFFF)
    return jnp.where(bits < 0, -size, size)


class Reading(eqx.Module):
    """What the comparisons read: features, with something in the place of what is missing.

    **Arguments:** for each column, the `feature` and `missing`: what NaN counts as (`LOW`, `HIGH`: below or above every
    threshold; `ZERO`), and whether 0 is missing too (`ZERO_LOW`, `ZERO_HIGH`, one of LightGBM's kinds).
    `rounds_to_zero`: what is within 1e-35 of 0 is 0, as in LightGBM's predictor (kZeroThreshold).
    """

    LOW, HIGH, ZERO, ZERO_LOW, ZERO_HIGH = range(5)
    feature: Int[Array, " column"]
    missing: Int[Array, " column"]
    rounds_to_zero: bool = eqx.field(static=True, default=False)

    def __call__(self, x: Float[Array, "row feature"]) -> Int[Array, "column row"]:
        """Columns as `ordered` numbers, what is missing put below or above all others."""
        z, kind = x.astype(jnp.float32).T[self.feature], self.missing[:, None]
        if self.rounds_to_zero:
            z = jnp.where(jnp.abs(z) <= 1e-35, 0.0, z)
        none = jnp.isnan(z) | ((kind >= self.ZERO_LOW) & (z == 0))
        high = (kind == self.HIGH) | (kind == self.ZERO_HIGH)
        instead = jnp.where(kind == self.ZERO, 0, jnp.where(high, IDLE, -IDLE)).astype(jnp.int32)
        return jnp.where(none, instead, ordered(z))


class Oblivious(eqx.Module):
    """Trees that ask one question at each level (CatBoost): the answers are the bits of the leaf's number.

    **Arguments:** `column` and `threshold` [tree, level]; a tree that has fewer levels asks whether something is above
    `IDLE`. `leaves` [tree, leaf, class].
    """

    column: Int[Array, "tree level"]
    threshold: Int[Array, "tree level"]
    leaves: Float[Array, "tree leaf class"]
    block: ClassVar[int] = 65_536  # rows in one go: their scores stay in the cache, and there are enough for every core

    def _leaf(self, column: Array, threshold: Array, z: Array) -> Array:
        at = jnp.zeros(z.shape[1], jnp.int32)
        for k in range(column.shape[0]):
            at |= (z[column[k]] > threshold[k]).astype(jnp.int32) << k
        return at

    def __call__(self, z: Int[Array, "column row"]) -> Float[Array, "row class"]:
        """The sum of the leaves."""
        trees, _, classes = self.leaves.shape
        if z.shape[1] <= FEW:
            bits = (z[self.column] > self.threshold[..., None]).astype(jnp.int32)
            at = jnp.sum(bits << jnp.arange(bits.shape[1], dtype=jnp.int32)[None, :, None], axis=1)
            return jnp.sum(self.leaves[jnp.arange(trees)[:, None], at], axis=0)

        def add(total: Array, tree: tuple[Array, Array, Array]) -> tuple[Array, None]:
            column, threshold, leaves = tree
            at = self._leaf(column, threshold, z)
            return total + leaves.at[at].get(mode="promise_in_bounds"), None

        start = jnp.zeros((z.shape[1], classes), jnp.float32)
        return jax.lax.scan(add, start, (self.column, self.threshold, self.leaves))[0]


class Branching(eqx.Module):
    """Trees of any shape (LightGBM, XGBoost), by sets of leaves: no walk, no gather but that of the leaf.

    A node that sends the row right strikes out the leaves on its left; of what is left of all leaves the first is the
    row's (QuickScorer: Lucchese et al., SIGIR 2015). Sets are words of 32 bits.

    **Arguments:** `column`, `threshold` [tree, node] and `keeps` [tree, node, word], what is left of the leaves where
    the row is above the threshold; `leaves` [tree, leaf]; `adds_to` [tree], the class.
    """

    column: Int[Array, "tree node"]
    threshold: Int[Array, "tree node"]
    keeps: UInt32[Array, "tree node word"]
    leaves: Float[Array, "tree leaf"]
    adds_to: Int[Array, " tree"]
    classes: int = eqx.field(static=True)
    block: ClassVar[int] = 8192  # rows in one go: their sets stay in the cache

    def __call__(self, z: Int[Array, "column row"]) -> Float[Array, "row class"]:
        """The sum of the leaves."""
        every = jnp.uint32(0xFFFFFFFF)
        trees, _, words = self.keeps.shape
        if z.shape[1] <= FEW:
            right = (z[self.column] > self.threshold[..., None])[..., None]
            sets = jnp.where(right, self.keeps[:, :, None, :], every)
            left = jax.lax.reduce(sets, every, jax.lax.bitwise_and, (1,))
            at = _first(tuple(left[..., k] for k in range(words)))
            found = self.leaves[jnp.arange(trees)[:, None], at]
            return jax.ops.segment_sum(found, self.adds_to, self.classes).T

        def strike(left: tuple[Array, ...], node: tuple[Array, Array, Array]) -> tuple[tuple[Array, ...], None]:
            column, threshold, keeps = node
            right = z[column] > threshold
            return tuple(w & jnp.where(right, keeps[k], every) for k, w in enumerate(left)), None

        def add(total: Array, tree: tuple[Array, ...]) -> tuple[Array, None]:
            column, threshold, keeps, leaves, adds_to = tree
            whole = tuple(jnp.full(z.shape[1], every) for _ in range(words))
            left, _ = jax.lax.scan(strike, whole, (column, threshold, keeps), unroll=4)
            return total.at[adds_to].add(leaves.at[_first(left)].get(mode="promise_in_bounds")), None

        start = jnp.zeros((self.classes, z.shape[1]), jnp.float32)
        parts = (self.column, self.threshold, self.keeps, self.leaves, self.adds_to)
        return jax.lax.scan(add, start, parts)[0].T


def _first(words: tuple[Array, ...]) -> Array:
    """The place of the lowest bit that is set in any of the words."""
    place = jnp.zeros(words[0].shape, jnp.int32)
    for k in reversed(range(len(words))):
        w = words[k]
        lowest = jax.lax.population_count(~w & (w - jnp.uint32(1))).astype(jnp.int32)
        place = jnp.where(w != 0, 32 * k + lowest, place)
    return place


class Trees(eqx.Module):
    """A boosted model: forest, offset and what its scores mean. `tree_files` makes it of a library's file.

    **Arguments:** `features`, the names in their order; `classes`, what each column of `probabilities` stands for;
    `link`: scores to probabilities by softmax or by the logistic function (two classes), or neither (a regression).
    """

    reading: Reading
    forest: Oblivious | Branching
    offset: Float[Array, " score"]
    scale: Float[Array, ""]
    features: tuple[str, ...] = eqx.field(static=True)
    classes: tuple[float, ...] = eqx.field(static=True)
    link: Literal["softmax", "logistic", "identity"] = eqx.field(static=True)

    def scores(self, x: Float[Array, "row feature"]) -> Float[Array, "row score"]:
        """Raw scores of rows of features, read in float32. Raises `ValueError` for another number of features."""
        if x.shape[1] != len(self.features):
            raise ValueError(f"the trees have {len(self.features)} features, found {x.shape[1]}")
        return _blocked(self._scores, x, self.forest.block)

    def _scores(self, x: Array) -> Array:
        return self.offset[None, :] + self.scale * self.forest(self.reading(x))

    def probabilities(self, x: Float[Array, "row feature"]) -> Float[Array, "row class"]:
        """Probability of each class. Raises `ValueError` for a regression, and as `scores`."""
        match self.link:
            case "softmax":
                return jax.nn.softmax(self.scores(x), axis=1)
            case "logistic":
                p = jax.nn.sigmoid(self.scores(x)[:, 0])
                return jnp.stack([1 - p, p], axis=1)
        raise ValueError("these trees are a regression: they have scores and no probabilities")

    def expect(self, features: tuple[str, ...]) -> "Trees":
        """The same trees. Raises `InputError` unless they were trained on these features, in this order."""
        if self.features != features:
            raise InputError(
                f"the trees were trained on the features {', '.join(self.features)}, found {', '.join(features)}; "
                "give these, in that order, or train again"
            )
        return self


def _blocked(f: Any, x: Array, block: int) -> Array:
    """`f` by blocks of rows, the last one on its own."""
    whole = x.shape[0] // block
    if x.shape[0] <= block:
        return f(x)
    parts = jax.lax.map(f, x[: whole * block].reshape(whole, block, x.shape[1])).reshape(whole * block, -1)
    rest = x[whole * block :]
    return jnp.concatenate([parts, f(rest)]) if rest.shape[0] else parts
