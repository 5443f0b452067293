"""The kernel that the vehicles of one search share: every effect of the library is in it, at its null where it was not
found, so that it is compiled once."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from hdev_jax.diagnosis.candidates.candidate import as_seen
from hdev_jax.diagnosis.candidates.facts import Facts
from hdev_jax.diagnosis.candidates.programs import Place, Program
from hdev_jax.inference import ParameterTable, linearised
from hdev_jax.inference.parameters import in_effect
from hdev_jax.physics import DECLARED, LIBRARY, Effect, Vehicle, at_null, unavailable
from hdev_jax.segments import Segments
from hdev_jax.targets import TargetName

__all__ = ["SHORT_ROWS", "SharedKernel", "absent", "apart"]

# Of a log of 14,000 rows a column takes 5 ms with every effect and 1.5 ms with six, so all of them 1.5 s and 0.4 s; to
# trace and compile those of a step anew takes 5 to 20 s. Twice or half of it changes the time alone.
SHORT_ROWS = 65_536


@dataclass(frozen=True, eq=False)
class SharedKernel:
    """The programs of the vehicles of a search over the `library`, on a log of these `facts`.

    Effects of a user are in no program but their own: nothing is known of the slopes that they have at their null.
    """

    library: Mapping[str, type[Effect]]
    facts: Facts
    _nulls: dict[str, Effect] = field(default_factory=dict, init=False, repr=False)
    _last: list[Any] = field(default_factory=list, init=False, repr=False)

    def program(self, vehicle: Vehicle, *more: Effect, declared: Sequence[Place] = ()) -> Program:
        """The vehicle with every other effect of the library that is part of the kernel, and with `more`."""
        base, found, rest = self._completed(vehicle)
        return Program.of(base, [*rest.values(), *(e for e in more if e.id not in rest)], found, declared)

    def linearised(
        self, vehicle: Vehicle, table: ParameterTable, segments: Segments, target: TargetName, theta: Any = None
    ) -> tuple[Float[np.ndarray, " row"], Float[np.ndarray, "row free"]]:
        """The prediction and its derivative in the free coefficients, at their present values or at `theta`.

        The declared model has a program of its own, and so have vehicles with other effects than the library's, and
        rows of a long log, where what is absent costs more than a new program.
        """
        beside = [e for e in vehicle.effects if type(e) not in DECLARED]
        known = all(type(e) is LIBRARY.get(e.id) and not e.searched for e in beside)
        if not (beside and known and table.free) or len(segments) > SHORT_ROWS:
            return linearised(vehicle, table, segments, target, theta)
        if not (self._last and self._last[0] is vehicle and self._last[1] is table):  # a solver asks many times
            self._last[:] = vehicle, table, self._of_table(vehicle, table)
        program, free = self._last[2]
        values = program.null.copy()
        if theta is not None:
            values[free] = np.asarray(theta)
        return program.linearised(jax.tree.map(jnp.asarray, segments), target, values, free)

    def _of_table(self, vehicle: Vehicle, table: ParameterTable) -> tuple[Program, list[int]]:
        """The program with the table's coefficients as arguments, and where among them the free ones are."""
        heads = tuple(f"effects.{k}." for k in self.library)
        rows = [(in_effect(c.path), c.group) for c in table.rows]
        others = sorted((x for x in rows if not x[0].startswith(heads)), key=lambda x: (x[0], x[1] or 0))
        program = self.program(vehicle, declared=others)
        place = {(path, group): k for k, (path, group, _, _) in enumerate(program.structure)}
        return program, [place[in_effect(c.path), c.group] for c in table.free]

    def _completed(self, vehicle: Vehicle) -> tuple[Vehicle, Collection[str], dict[str, Effect]]:
        """A vehicle whose found effects have the limits that they were found without, at their null; the ids of these
        effects; the other effects of the library that are part of the kernel, at their null, by id."""
        found, rest = {}, {}
        for c in (c for c in self.library.values() if LIBRARY.get(c.id) is c and not c.searched):
            if vehicle.has(c.id):
                found[c.id] = _with_limits(vehicle.effect(c.id), self._null(c))
            elif not (apart(c) or unavailable(c, self.facts.sample, vehicle.entry, vehicle.stands_in)):
                rest[c.id] = self._null(c)
        return vehicle.minus(*found).plus(*found.values()), tuple(found), rest

    def _null(self, effect: type[Effect]) -> Effect:
        if effect.id not in self._nulls:
            self._nulls[effect.id] = absent(effect, self.facts)
        return self._nulls[effect.id]


def apart(effect: Effect | type[Effect]) -> bool:
    """Whether it is not part of the kernel, and does not change its program."""
    return effect.alone("across") or effect.alone("observe")


def absent(effect: type[Effect], facts: Facts) -> Effect:
    """An effect at its null, as a log of these facts shows it."""
    return as_seen(at_null(effect, gears=facts.gears), facts)


def _with_limits(effect: Effect, null: Effect) -> Effect:
    """The effect with the limits that it was found without at their null."""
    fields = {p.name: getattr(effect, p.name) for p in effect.parameters}
    return type(effect)(**{k: getattr(null, k) if v is None else v for k, v in fields.items()})
