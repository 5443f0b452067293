"""Candidates: the ways to have each effect that the vehicle lacks, its sizes, groups and shapes."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from hdev_jax.diagnosis.candidates.facts import Facts
from hdev_jax.physics import Choice, Effect, Grouped, Parameter, Switch, at_null

__all__ = [
    "Candidate",
    "Grids",
    "as_seen",
    "beyond",
    "finer",
    "in_order",
    "own_shapes",
    "realised",
    "ways_of",
]


@dataclass(frozen=True)
class Candidate:
    """One way to have an effect: which of its sizes, at which shapes. `columns` are its places in the matrix.

    `kind` "size": the column is the derivative in the size, its coefficient is the size. "limit": the column is the
    difference that the switch at `shapes` makes, its coefficient should be near 1.
    """

    effect: type[Effect]
    sizes: tuple[str, ...]
    groups: tuple[int | None, ...]
    shapes: tuple[tuple[str, float], ...]
    kind: str
    columns: tuple[int, ...]

    @property
    def id(self) -> str:
        """Id of the effect."""
        return self.effect.id

    @property
    def freedoms(self) -> int:
        """How many numbers it fits, those chosen on a grid included."""
        chosen = sum(len(p.grid) > 1 for p in self.effect.parameters if not p.has_column and _matters(p, self.sizes))
        return len(self.columns) + chosen

    def only(self, kept: Sequence[bool] | np.ndarray) -> "Candidate | None":
        """With these of its columns: those of a group (a gear) may go by themselves, others all or none."""
        if all(kept):
            return self
        if None in self.groups or not any(kept):
            return None
        at = np.flatnonzero(np.asarray(kept))
        sizes, groups, columns = (tuple(x[k] for k in at) for x in (self.sizes, self.groups, self.columns))
        return replace(self, sizes=sizes, groups=groups, columns=columns)

    def narrower(self, kept: Sequence[bool] | np.ndarray) -> "Candidate | None":
        """The variant of the effect that has these of its sizes, with the shapes that act on them; None where there is
        none."""
        at = np.flatnonzero(np.asarray(kept))
        sizes = tuple(self.sizes[k] for k in at)
        if len(at) == len(self.sizes) or sizes not in self.effect.variants:
            return None
        shapes = tuple((n, v) for n, v in self.shapes if _matters(self.parameter(n), sizes))
        groups, columns = tuple(self.groups[k] for k in at), tuple(self.columns[k] for k in at)
        return replace(self, sizes=sizes, groups=groups, columns=columns, shapes=shapes)

    @property
    def by_trip(self) -> dict[str, dict[int, float]]:
        """Shapes that were estimated for each trip, `phase[3]` among `shapes`: by name, then by the trip's id."""
        out: dict[str, dict[int, float]] = {}
        for key, value in self.shapes:
            name, bracket, trip = key.partition("[")
            if bracket:
                out.setdefault(name, {})[int(trip.removesuffix("]"))] = value
        return out

    def parameter(self, name: str) -> Parameter:
        """The effect's parameter of that name."""
        return next(p for p in self.effect.parameters if p.name == name)

    @property
    def constant(self) -> bool:
        """Whether it adds the same in every row."""
        return all(self.parameter(n).constant for n in self.sizes)

    def is_constant_load(self, sizes: Mapping[str, float]) -> bool:
        """Whether these sizes, by name and against their null, make it an instrument that reads a constant power too
        much: that is a constant load of the vehicle first, under another name."""
        draws = any(self.parameter(n).constant and b > 0 for n, b in sizes.items())
        return self.effect.instrument and self.effect.of_battery and draws


def _matters(shape: Parameter, sizes: Sequence[str]) -> bool:
    """Whether a shape acts on these sizes."""
    return not shape.of or shape.of in sizes


Grids = Mapping[str, tuple[float, ...]]


def own_shapes(effect: Effect, size: str, shapes: tuple[tuple[str, float], ...]) -> tuple[tuple[str, float], ...]:
    """The shapes that act on one size: two sizes with a shape each need a column each, not one for every pair."""
    by_name = {p.name: p for p in effect.parameters}
    return tuple((n, v) for n, v in shapes if n == size or _matters(by_name[n], (size,)))


def _grid(p: Parameter, facts: Facts, grids: Grids) -> tuple[float, ...]:
    if p.name in grids:
        return grids[p.name]
    if p.name == "at_trip":
        return facts.steps
    return (facts.means[p.mean_of],) if p.mean_of else tuple(g * facts.row_s if p.in_rows else g for g in p.grid)


def ways_of(effect: type[Effect], facts: Facts, grids: Grids) -> Iterable[tuple[Any, ...]]:
    """`(sizes, groups, shapes, kind)` for each way to have the effect."""
    by_name = {p.name: p for p in effect.parameters}
    sizes = tuple(p.name for p in effect.parameters if p.has_column)
    for variant in effect.variants or (sizes,):
        shapes = [p for p in effect.parameters if not p.has_column and _matters(p, variant)]
        each = [[(p.name, g) for g in _grid(p, facts, grids)] for p in shapes]
        for at in product(*each):
            if not in_order(effect, dict(at)):
                continue
            first = by_name[variant[0]]
            if isinstance(first, Switch):
                for g in _grid(first, facts, grids):
                    yield variant, (None,), (*at, (first.name, g)), "limit"
            elif first.by:
                # the commonest is the reference where it is declared already
                if groups := tuple(sorted(facts.seen(first.by)[0 if first.whole else 1 :])):
                    yield variant * len(groups), groups, at, "size"
                elif first.whole:
                    yield variant, (None,) * len(variant), at, "size"
            else:
                yield variant, (None,) * len(variant), at, "size"


def in_order(effect: type[Effect], values: Mapping[str, float]) -> bool:
    """Whether limits of one effect are in order (heating below cooling), those of these values that it has."""
    return all(values[a] < values[b] for a, b in effect.ordered if a in values and b in values)


def finer(candidate: Candidate, row_s: float, *, reach: float = 0.5, points: int = 7) -> dict[str, tuple[float, ...]]:
    """Grids for the candidate's shapes and limits, `reach` of a step to either side of its present value.

    `row_s` is the median duration of a row [s].
    """
    grids: dict[str, tuple[float, ...]] = {}
    for name, at in candidate.shapes:
        p = candidate.parameter(name)
        grid = [g * row_s if p.in_rows else g for g in p.grid]
        if isinstance(p, Choice) or len(grid) < 2 or p.smooth:
            grids[name] = (at,)
            continue
        k = int(np.argmin(np.abs(np.array(grid) - at)))
        below = grid[k - 1] if k > 0 else beyond(grid[k + 1], at)
        above = grid[k + 1] if k + 1 < len(grid) else beyond(grid[k - 1], at)
        near = np.r_[
            np.linspace(at + reach * (below - at), at, points // 2 + 1),
            np.linspace(at, at + reach * (above - at), points // 2 + 1),
        ]
        grids[name] = tuple(float(x) for x in np.unique(np.clip(near, p.lower, p.upper)))
    return grids


def beyond(from_: float, at: float) -> float:
    """One more step in the same direction; by ratio where both are positive, since a time constant stays so."""
    return at * at / from_ if min(from_, at) > 0 else 2.0 * at - from_


def as_seen(effect: Effect, facts: Facts) -> Effect:
    """The effect with one number for all rows in place of groups that the log does not have."""
    one = {p.name: np.asarray(p.null, dtype=float) for p in effect.parameters if p.whole and not facts.seen(p.by)}
    return type(effect)(**({p.name: getattr(effect, p.name) for p in effect.parameters} | one)) if one else effect


def _grouped(by_trip: Mapping[int, float]) -> Grouped:
    """A number of each trip, NaN for every other trip."""
    values = np.full(max(by_trip) + 2, np.nan)  # ids past the end take the last
    values[list(by_trip)] = list(by_trip.values())
    return Grouped(jnp.asarray(values), "trip")


def realised(candidate: Candidate, beta: Float[np.ndarray, " k"], *, gears: int = 1) -> Effect:
    """The effect with these coefficients as its sizes and the candidate's shapes: where a joint refit starts."""
    effect = at_null(candidate.effect, gears=gears)
    values: dict[str, Any] = {p.name: getattr(effect, p.name) for p in effect.parameters}
    values.update({name: np.asarray(v, dtype=float) for name, v in candidate.shapes if "[" not in name})
    values.update({name: _grouped(by_trip) for name, by_trip in candidate.by_trip.items()})
    for p in candidate.effect.parameters:
        if isinstance(p, Switch) and p.name not in candidate.sizes:
            values[p.name] = None  # not part of it: the effect skips what it costs
        if p.whole and None in candidate.groups:  # the log has no groups
            values[p.name] = np.asarray(p.null, dtype=float)
    if candidate.kind == "limit" and candidate.parameter(candidate.sizes[0]).smooth:
        values[candidate.sizes[0]] = np.asarray(dict(candidate.shapes)[candidate.sizes[0]] * float(beta[0]))
    if candidate.kind == "size":
        for name, group, b in zip(candidate.sizes, candidate.groups, beta, strict=True):
            if group is None:
                values[name] = np.asarray(float(b))
            else:
                old = values[name]
                values[name] = Grouped(jnp.asarray(old.values).at[group].set(float(b)), old.by)
    return candidate.effect(**values)
