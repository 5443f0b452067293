"""From trees as nested nodes to the arrays of a forest."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Union

import jax.numpy as jnp
import numpy as np

from hdev_jax.learn.trees.trees import IDLE, Branching, Oblivious, Reading

__all__ = ["Leaf", "Node", "branching", "oblivious"]

MERGED_BYTES = 32_768  # of the leaves of trees that are merged: the nearest cache of a core


@dataclass(frozen=True)
class Leaf:
    """What a tree adds."""

    value: float


@dataclass(frozen=True)
class Node:
    """A question: is the feature, read as `missing` says, beyond the threshold (`ordered`)? Then right, else left."""

    feature: int
    missing: int
    threshold: int
    left: Union["Node", Leaf]
    right: Union["Node", Leaf]


class _Columns:
    """Columns as they are asked for: one for each feature and way to read what is missing."""

    def __init__(self) -> None:
        self.found: dict[tuple[int, int], int] = {}

    def __call__(self, feature: int, missing: int) -> int:
        return self.found.setdefault((feature, missing), len(self.found))

    def reading(self) -> Reading:
        every = [*self.found] or [(0, Reading.LOW)]
        feature, missing = (jnp.asarray(k, jnp.int32) for k in zip(*every, strict=True))
        return Reading(feature, missing)


def _walk(tree: Node | Leaf) -> Iterator[tuple[Node, int, int, int]]:
    """Each node with its first leaf, the first on its right and the first behind it, leaves counted from the left."""

    def count(part: Node | Leaf, first: int) -> Iterator[Any]:
        if isinstance(part, Leaf):
            yield first + 1
            return
        *inner, middle = count(part.left, first)
        yield from inner
        *inner, end = count(part.right, middle)
        yield from inner
        yield part, first, middle, end
        yield end

    *nodes, _ = count(tree, 0)
    return iter(nodes)


def _leaves(tree: Node | Leaf) -> Iterator[float]:
    if isinstance(tree, Leaf):
        yield tree.value
    else:
        yield from _leaves(tree.left)
        yield from _leaves(tree.right)


def branching(trees: Sequence[Node | Leaf], adds_to: Sequence[int], classes: int) -> tuple[Branching, Reading]:
    """The forest of these trees; a tree adds to the class `adds_to`. Smaller trees are filled up with idle nodes."""
    columns = _Columns()
    parts = [[*_walk(t)] for t in trees]
    values = [[*_leaves(t)] for t in trees]
    nodes, most = max(1, *map(len, parts)), max(map(len, values))
    words = -(-most // 32)
    column = np.zeros((len(trees), nodes), np.int32)
    threshold = np.full((len(trees), nodes), IDLE, np.int32)
    keeps = np.full((len(trees), nodes, words), 0xFFFFFFFF, np.uint32)
    leaves = np.zeros((len(trees), most), np.float32)
    for i, (some, value) in enumerate(zip(parts, values, strict=True)):
        leaves[i, : len(value)] = value
        for k, (node, first, middle, _) in enumerate(some):
            column[i, k], threshold[i, k] = columns(node.feature, node.missing), node.threshold
            kept = np.ones(32 * words, dtype=bool)
            kept[first:middle] = False
            keeps[i, k] = np.packbits(kept.reshape(words, 32), axis=1, bitorder="little").view("<u4")[:, 0]
    arrays = (column, threshold, keeps, leaves, np.asarray(adds_to, np.int32))
    a, b, c, d, e = map(jnp.asarray, arrays)
    return Branching(a, b, c, d, e, classes), columns.reading()


def _merged(column: np.ndarray, threshold: np.ndarray, leaves: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The same sum from fewer trees: the questions of several after one another, and a leaf for each set of answers.

    What a tree costs is the look-up of its leaf, not its questions; as long as the leaves fit into the cache.
    """
    trees, levels, classes = len(column), column.shape[1], leaves.shape[2]
    together = 1
    while (1 << levels * (together + 1)) * classes * leaves.itemsize <= MERGED_BYTES:
        together += 1
    missing = -trees % together
    column = np.pad(column, ((0, missing), (0, 0)))
    threshold = np.pad(threshold, ((0, missing), (0, 0)), constant_values=IDLE)
    parts = np.pad(leaves, ((0, missing), (0, 0), (0, 0))).reshape(-1, together, leaves.shape[1], classes)
    total = parts[:, 0]
    for k in range(1, together):  # the first tree's answers are the lowest bits
        total = (parts[:, k, :, None] + total[:, None]).reshape(len(parts), -1, classes)
    return column.reshape(len(parts), -1), threshold.reshape(len(parts), -1), total


def oblivious(trees: Sequence[tuple[Sequence[tuple[int, int, int]], np.ndarray]]) -> tuple[Oblivious, Reading]:
    """The forest of these trees: questions (feature, missing, threshold), first bit first, and leaves [leaf, class]."""
    columns = _Columns()
    levels = max(1, *(len(asked) for asked, _ in trees))
    column = np.zeros((len(trees), levels), np.int32)
    threshold = np.full((len(trees), levels), IDLE, np.int32)
    leaves = np.zeros((len(trees), 1 << levels, trees[0][1].shape[1]), np.float32)
    for i, (asked, values) in enumerate(trees):
        leaves[i, : len(values)] = values
        for k, (feature, missing, border) in enumerate(asked):
            column[i, k], threshold[i, k] = columns(feature, missing), border
    return Oblivious(*map(jnp.asarray, _merged(column, threshold, leaves))), columns.reading()
