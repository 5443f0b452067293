"""What each candidate would add to every row, without refitting anything, and by which programs it is computed."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from hdev_jax.diagnosis.candidates.candidate import Candidate, Grids, own_shapes, ways_of
from hdev_jax.diagnosis.candidates.facts import Facts, facts_of
from hdev_jax.diagnosis.candidates.programs import Program, Recipe, computed
from hdev_jax.diagnosis.candidates.shared import SharedKernel, absent, apart, of_library
from hdev_jax.diagnosis.candidates.unnamed import Terms
from hdev_jax.physics import Effect, Switch, Vehicle, unavailable
from hdev_jax.segments import Segments
from hdev_jax.targets import TargetName

__all__ = ["Plan", "Source", "columns", "plan_of"]

TOGETHER = 6  # effects in one program of a long log: more of them run slower, fewer take longer to compile


@dataclass(frozen=True)
class Plan:
    """The candidates that a log allows, and how each of their columns is made of any of its rows.

    Made once from the facts of the whole log; whole trips are then evaluated a chunk at a time.
    """

    candidates: tuple[Candidate, ...]
    left_out: Mapping[str, str]
    target: TargetName
    recipes: tuple[Recipe, ...]

    @property
    def width(self) -> int:
        """How many columns there are."""
        return len(self.recipes)

    def write(self, out: np.ndarray, segments: Segments, at: Sequence[int] | None = None) -> None:
        """Write the columns `at` (all by default) of padded segments into `out` [row, column], in the target's unit;
        what is no number counts as 0."""
        recipes = [self.recipes[k] for k in (range(self.width) if at is None else at)]
        for k, column in computed(recipes, segments, self.target):
            out[:, k] = np.nan_to_num(column, posinf=0.0, neginf=0.0)


Source = Plan | Terms  # what makes candidates' columns of any rows


def plan_of(
    vehicle: Vehicle, effects: Sequence[type[Effect]], facts: Facts, target: TargetName, grids: Grids | None = None,
    *, searched: bool = False, kernel: SharedKernel | None = None,
) -> Plan:  # fmt: skip
    """Every candidate that a log of these facts allows beside what the vehicle has.

    `grids` replaces the grids of parameters by name; `searched` takes effects with a search of their own too. With the
    `kernel` of a search, which is of the same facts, its vehicles share the programs, whichever effects were found.
    """
    left_out: dict[str, str] = {}
    nulls: list[Effect] = []
    has, entry, stands_in = {e.id for e in vehicle.effects}, vehicle.entry, vehicle.stands_in
    for c in effects:
        if c.id in has or (c.searched and not searched):
            continue
        if why := unavailable(c, facts.sample, entry, stands_in):
            left_out[c.id] = why
        else:
            nulls.append(absent(c, facts) if kernel is None else kernel.null(c))
    known = [e for e in nulls if of_library(type(e))]
    if kernel is not None and kernel.serves(vehicle, target):
        groups = _shared(vehicle, known, kernel)
    else:
        groups = _separate(vehicle, known, effects)
    # nothing is known of the slopes that a user's effect has at its null: it is in no program but its own
    groups += [g for e in nulls if not of_library(type(e)) for g in _separate(vehicle, [e], [type(e)])]

    found: list[Candidate] = []
    place: dict[tuple[Any, ...], int] = {}
    recipes: list[Recipe] = []
    for g in groups:
        for e in g.effects:
            for sizes, subs, shapes, kind in ways_of(type(e), facts, grids or {}):
                if g.sizes is not None and sizes != g.sizes:
                    continue
                keys = [(e.id, s, k, own_shapes(e, s, shapes), kind) for s, k in zip(sizes, subs, strict=True)]
                for key in keys:
                    if key not in place:
                        place[key] = len(recipes)
                        recipes.append(g.program.recipe(e.id, shapes, None if kind == "limit" else key[1:3]))
                found.append(Candidate(type(e), sizes, subs, shapes, kind, tuple(place[k] for k in keys)))
    return Plan(tuple(found), left_out, target, tuple(recipes))


@dataclass(frozen=True, eq=False)
class _Group:
    """A program and the effects whose columns it makes, for `sizes` alone where these are given."""

    program: Program
    effects: Sequence[Effect]
    sizes: tuple[str, ...] | None = None


def _separate(vehicle: Vehicle, nulls: Sequence[Effect], effects: Sequence[type[Effect]]) -> list[_Group]:
    """Programs that run fast: a few effects of one row beside the vehicle, or one effect across rows."""
    # in the same company whatever the log lacks, so that logs share programs
    company = {id_: k // TOGETHER for k, id_ in enumerate(c.id for c in effects if not c.acts_across_rows())}
    groups: list[_Group] = []
    for k in sorted({company[e.id] for e in nulls if e.id in company}):
        group = [e for e in nulls if company.get(e.id) == k]
        groups.append(_Group(Program.of(vehicle, group), group))
    for e in (e for e in nulls if e.acts_across_rows()):
        groups += [_Group(Program.of(vehicle, [only]), [only], sizes) for only, sizes in _variants(e)]
    return groups


def _shared(vehicle: Vehicle, nulls: Sequence[Effect], kernel: SharedKernel) -> list[_Group]:
    """Programs with one kernel, whichever effects were found: those of one row in one, others each in its own."""
    rowwise = [e for e in nulls if not apart(e)]
    groups = [_Group(kernel.program(vehicle, *rowwise), rowwise)]
    return groups + [
        _Group(kernel.program(vehicle, only), [only], sizes) for e in nulls if apart(e) for only, sizes in _variants(e)
    ]


def _variants(effect: Effect) -> Iterator[tuple[Effect, tuple[str, ...]]]:
    """An effect across rows by the sizes that are tried together, without its other limits: what is idle is not
    cheap."""
    for sizes in type(effect).variants or (tuple(p.name for p in effect.parameters if p.has_column),):
        idle = {p.name for p in effect.parameters if isinstance(p, Switch) and p.name not in sizes}
        kept = {p.name: None if p.name in idle else getattr(effect, p.name) for p in effect.parameters}
        yield type(effect)(**kept), sizes


def columns(
    vehicle: Vehicle,
    effects: Sequence[type[Effect]],
    segments: Segments,
    rows: int,
    target: TargetName,
    grids: Grids | None = None,
) -> tuple[list[Candidate], Float[np.ndarray, "row k"], dict[str, str]]:
    """Every candidate's columns on the first `rows` rows of padded segments, all at once: for few rows or effects.

    **Returns:** candidates, their columns in the target's unit, and why the other effects were left out.
    """
    plan = plan_of(vehicle, effects, facts_of(segments, rows), target, grids)
    out = np.zeros((len(segments), plan.width))
    plan.write(out, segments)
    return list(plan.candidates), out[:rows], dict(plan.left_out)
