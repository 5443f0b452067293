"""Candidates: what each effect that the vehicle lacks would add to every row, without refitting anything."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hdev_jax.inference import insert
from hdev_jax.physics import Effect, Grouped, Parameter, Vehicle, at_null, most_group, unavailable
from hdev_jax.physics.vehicle import Target
from hdev_jax.segments import Segments

__all__ = ["FIXED", "Candidate", "Column", "columns", "finer", "realised"]

FIXED = ("shape", "choice")  # what has no column of its own


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
        chosen = sum(len(p.grid) > 1 for p in self.effect.parameters if p.kind in FIXED and _matters(p, self.sizes))
        return len(self.columns) + chosen

    def parameter(self, name: str) -> Parameter:
        """The effect's parameter of that name."""
        return next(p for p in self.effect.parameters if p.name == name)


@dataclass(frozen=True)
class Column:
    """One column to compute: an effect's size (and group) at given shapes, or the difference a limit makes."""

    effect_id: str
    name: str
    group: int | None
    shapes: tuple[tuple[str, float], ...]
    kind: str


def _matters(shape: Parameter, sizes: Sequence[str]) -> bool:
    """Whether a shape acts on these sizes; hvac's two thresholds belong to one size each."""
    owner = {"heat_c": "below_w_per_k", "cool_c": "above_w_per_k"}.get(shape.name)
    return owner is None or owner in sizes


Grids = Mapping[str, tuple[float, ...]]


def _own(effect: Effect, size: str, shapes: tuple[tuple[str, float], ...]) -> tuple[tuple[str, float], ...]:
    """The shapes that act on one size: two sizes with a shape each need a column each, not one for every pair."""
    by_name = {p.name: p for p in effect.parameters}
    return tuple((n, v) for n, v in shapes if n == size or _matters(by_name[n], (size,)))


def _grid(p: Parameter, segments: Segments, row_s: float, grids: Grids) -> tuple[float, ...]:
    if p.name in grids:
        return grids[p.name]
    if p.name == "at_trip":
        trips = np.unique(np.asarray(segments.trip))
        # three trips on either side at least: with fewer, one odd trip would be a step
        return tuple(float(t) for t in trips[3:-2]) if len(trips) >= 6 else ()
    return tuple(g * row_s if p.in_rows else g for g in p.grid)


def _of_effect(effect: type[Effect], segments: Segments, row_s: float, grids: Grids) -> Iterable[tuple[Any, ...]]:
    """`(sizes, groups, shapes, kind)` for each way to have the effect."""
    by_name = {p.name: p for p in effect.parameters}
    sizes = tuple(p.name for p in effect.parameters if p.kind not in FIXED)
    for variant in effect.variants or (sizes,):
        shapes = [p for p in effect.parameters if p.kind in FIXED and _matters(p, variant)]
        each = [[(p.name, g) for g in _grid(p, segments, row_s, grids)] for p in shapes]
        for at in product(*each):
            first = by_name[variant[0]]
            if first.kind == "limit":
                for g in _grid(first, segments, row_s, grids):
                    yield variant, (None,), (*at, (first.name, g)), "limit"
            elif first.by:
                gear = np.asarray(segments.channels[first.by]).astype(int)
                seen = [
                    int(k) for k, n in zip(*np.unique(gear, return_counts=True), strict=True) if n > 0.02 * len(gear)
                ]
                if len(seen) > 1:  # the commonest is the reference: it is declared already
                    most = max(seen, key=lambda k: int(np.sum(gear == k)))
                    groups = tuple(k for k in seen if k != most)
                    yield variant * len(groups), groups, at, "size"
            else:
                yield variant, (None,) * len(variant), at, "size"


def finer(candidate: Candidate, row_s: float, *, reach: float = 0.5, points: int = 7) -> dict[str, tuple[float, ...]]:
    """Grids for the candidate's shapes and limits, `reach` of a step to either side of where it stands."""
    grids: dict[str, tuple[float, ...]] = {}
    for name, at in candidate.shapes:
        p = candidate.parameter(name)
        grid = [g * row_s if p.in_rows else g for g in p.grid]
        if p.kind == "choice" or len(grid) < 2 or p.smooth:
            grids[name] = (at,)
            continue
        k = int(np.argmin(np.abs(np.array(grid) - at)))
        below = grid[k - 1] if k > 0 else at - (grid[k + 1] - at)
        above = grid[k + 1] if k + 1 < len(grid) else at + (at - grid[k - 1])
        near = np.r_[
            np.linspace(at + reach * (below - at), at, points // 2 + 1),
            np.linspace(at, at + reach * (above - at), points // 2 + 1),
        ]
        grids[name] = tuple(float(x) for x in np.unique(np.clip(near, p.lower, p.upper)))
    return grids


def _row_level(effect: Effect) -> bool:
    return not any(effect.overrides(h) for h in ("across", "observe", "derive"))


def columns(
    vehicle: Vehicle,
    effects: Sequence[type[Effect]],
    segments: Segments,
    rows: int,
    target: Target,
    grids: Grids | None = None,
) -> tuple[list[Candidate], Float[np.ndarray, "row k"], dict[str, str]]:
    """Every candidate's columns on the first `rows` rows of padded segments.

    Effects of one row share one vehicle with all of them at their null value, so that one compiled `jvp` serves all;
    what acts across rows has a vehicle of its own. `grids` replaces the grids of parameters by name.

    **Returns:** candidates, their columns in the target's unit, and why the other effects were left out.
    """
    left_out: dict[str, str] = {}
    usable = []
    for c in effects:
        if vehicle.has(c.id):
            continue
        if why := unavailable(c, segments, vehicle.entry):
            left_out[c.id] = why
        else:
            usable.append(c)
    row_s = float(np.median(np.asarray(segments.duration_s)[:rows]))
    gears = most_group(segments)
    nulls = {c.id: at_null(c, gears=gears) for c in usable}
    shared = [e for e in nulls.values() if _row_level(e)]
    groups: list[tuple[list[Effect], tuple[str, ...] | None]] = [(shared, None)] if shared else []
    for e in (e for e in nulls.values() if not _row_level(e)):
        for sizes in type(e).variants or (tuple(p.name for p in e.parameters if p.kind not in FIXED),):
            groups.append(([_only(e, sizes)], sizes))

    found: list[Candidate] = []
    data: list[np.ndarray] = []
    place: dict[Column, int] = {}
    segments = jax.tree.map(jnp.asarray, segments)
    for group, only in groups:
        car = vehicle.plus(*group)
        structure, null = _structure(group)
        base = None
        for e in group:
            for sizes, subs, shapes, kind in _of_effect(type(e), segments, row_s, grids or {}):
                if only is not None and sizes != only:
                    continue
                keys = [Column(e.id, s, g, _own(e, s, shapes), kind) for s, g in zip(sizes, subs, strict=True)]
                for key in keys:
                    if key in place:
                        continue
                    values = null.copy()
                    for name, v in shapes:
                        values[_index(structure, e.id, name, None)] = v
                    if kind == "limit":
                        base = np.asarray(_predict(car, structure, target, segments, null)) if base is None else base
                        column = np.asarray(_predict(car, structure, target, segments, values)) - base
                    else:
                        tangent = np.zeros_like(null)
                        tangent[_index(structure, e.id, key.name, key.group)] = 1.0
                        column = np.asarray(_slope(car, structure, target, segments, values, tangent))
                    place[key] = len(data)
                    data.append(np.nan_to_num(column[:rows], posinf=0.0, neginf=0.0))
                found.append(Candidate(type(e), sizes, subs, shapes, kind, tuple(place[k] for k in keys)))
    matrix = np.stack(data, axis=1) if data else np.zeros((rows, 0))
    return found, matrix, left_out


def _only(effect: Effect, sizes: tuple[str, ...]) -> Effect:
    """The effect with the limits that are not among `sizes` taken out: what acts across rows is not cheap."""
    idle = {p.name for p in effect.parameters if p.kind == "limit" and p.name not in sizes}
    return type(effect)(**{p.name: None if p.name in idle else getattr(effect, p.name) for p in effect.parameters})


def _structure(effects: Sequence[Effect]) -> tuple[tuple[Any, ...], np.ndarray]:
    structure, null = [], []
    for e in effects:
        for p in e.parameters:
            leaf = getattr(e, p.name)
            if leaf is None:
                continue
            count = len(leaf.values) if isinstance(leaf, Grouped) else None
            for g in range(count) if count is not None else (None,):
                structure.append((f"effects.{e.id}.{p.name}", g, -np.inf, np.inf))
                null.append(p.null)
    return tuple(structure), np.array(null)


def _index(structure: Sequence[Any], effect_id: str, name: str, group: int | None) -> int:
    return next(i for i, s in enumerate(structure) if s[0] == f"effects.{effect_id}.{name}" and s[1] in (group, None))


@eqx.filter_jit
def _predict(car: Vehicle, structure: Any, target: Target, segments: Segments, values: Any) -> Array:
    return insert(car, structure, jnp.asarray(values)).predict(segments, target)


@eqx.filter_jit
def _slope(car: Vehicle, structure: Any, target: Target, segments: Segments, values: Any, tangent: Any) -> Array:
    def predict(x: Array) -> Array:
        return insert(car, structure, x).predict(segments, target)

    return jax.jvp(predict, (jnp.asarray(values),), (jnp.asarray(tangent),))[1]


def realised(candidate: Candidate, beta: Float[np.ndarray, " k"], *, gears: int = 1) -> Effect:
    """The effect with these coefficients as its sizes and the candidate's shapes: where a joint refit starts."""
    effect = at_null(candidate.effect, gears=gears)
    values: dict[str, Any] = {p.name: getattr(effect, p.name) for p in effect.parameters}
    values.update({name: np.asarray(v, dtype=float) for name, v in candidate.shapes})
    for p in candidate.effect.parameters:
        if p.kind == "limit" and p.name not in candidate.sizes:
            values[p.name] = None  # not part of it: the effect skips what it costs
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
