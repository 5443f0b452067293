"""The kernel that the vehicles of one search share: every effect of the library is in it, at its null where it was not
found, so that it is compiled once. (Effects with a search of their own are in it once they are found: it is compiled
again for each.) On long logs, where absent effects cost more than compiling, each set of effects has its own."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from hdev_jax.diagnosis.candidates.candidate import as_seen
from hdev_jax.diagnosis.candidates.facts import Facts
from hdev_jax.diagnosis.candidates.programs import PER_PASS, SIDE_BY_SIDE, Place, Program
from hdev_jax.inference import ParameterTable, linearised, predict
from hdev_jax.inference.parameters import in_effect, leaf_of
from hdev_jax.physics import DECLARED, LIBRARY, Effect, Vehicle, at_null, unavailable
from hdev_jax.segments import Segments
from hdev_jax.targets import TargetName

__all__ = ["SharedKernel", "absent", "apart", "of_library"]

# Of a log of 14,000 rows a column takes 2.3 ms with every effect, so those of a step 0.3 s; to trace and compile them
# anew takes 5 to 20 s. Twice or half of it changes the time alone.
SHORT_ROWS = 65_536
# Jacobians of no more rows than that which are kept, which changes the time alone: 2 MB each for 14,000 rows and 20
# coefficients, 11 MB for a chunk of a long log
RESULTS = 12

Linearised = tuple[Float[np.ndarray, " row"], Float[np.ndarray, "row free"]]


@dataclass(frozen=True, eq=False)
class SharedKernel:
    """The programs of the vehicles of a search over the `library`, on the padded training rows `segments` of a log of
    these `facts`.

    Effects of a user are in no program but their own: nothing is known of the slopes that they have at their null.
    """

    library: Mapping[str, type[Effect]]
    facts: Facts
    segments: Segments
    _nulls: dict[type[Effect], Effect] = field(default_factory=dict, init=False, repr=False)
    _parts: dict[Any, frozenset[str]] = field(default_factory=dict, init=False, repr=False)
    _last: list[Any] = field(default_factory=list, init=False, repr=False)
    _sound: dict[TargetName, bool] = field(default_factory=dict, init=False, repr=False)
    _programs: dict[Any, Program] = field(default_factory=dict, init=False, repr=False)
    _results: dict[Any, tuple[Any, Linearised]] = field(default_factory=dict, init=False, repr=False)

    def program(self, vehicle: Vehicle, *more: Effect, declared: Sequence[Place] = ()) -> Program:
        """The vehicle with every other effect of the library that is part of the kernel, and with `more`."""
        base, found, rest = self._completed(vehicle)
        return Program.of(base, {**rest, **{e.id: e for e in more}}.values(), found, declared)

    def serves(self, vehicle: Vehicle, target: TargetName) -> bool:
        """Whether the shared programs serve this search: not on a long log, where what is absent costs more than a new
        program, nor where a reading leaves an absent effect without a finite value (NaN in a channel that the vehicle
        does not use), since 0 times that is no number either."""
        if self.facts.rows > SHORT_ROWS:
            return False
        if target not in self._sound:
            program = self.program(vehicle)
            finite = np.isfinite(program.predicted(self.segments, target, program.null))
            self._sound[target] = bool(np.all(finite == np.isfinite(predict(vehicle, self.segments, target))))
        return self._sound[target]

    def linearised(
        self, vehicle: Vehicle, table: ParameterTable, segments: Segments, target: TargetName, theta: Any = None
    ) -> Linearised:
        """The prediction, in the target's unit, and its derivative in the free coefficients, per unit of each, at their
        present values or at `theta`."""
        if not table.free:
            return linearised(vehicle, table, segments, target, theta)
        if not self._of_library(vehicle):
            leaves, form = jax.tree.flatten(vehicle if theta is None else table.insert(vehicle, theta))
            places = tuple((c.path, c.group) for c in table.free)
            key = form, tuple(np.asarray(x).tobytes() for x in leaves), places, target, id(segments)
            return self._kept(key, segments, lambda: linearised(vehicle, table, segments, target, theta))
        last = self._last  # a solver asks many times
        if not (last and last[0] is vehicle and last[1] is table and last[2] == target):
            shared = self.serves(vehicle, target)
            last[:] = vehicle, table, target, self._of_table(vehicle, table, shared=shared), shared
        (program, values, free), shared = last[3:]
        if theta is not None:
            values = values.copy()
            values[free] = np.asarray(theta)

        def compute() -> Linearised:
            rows = jax.tree.map(jnp.asarray, segments)
            result = program.linearised(rows, target, values, free, lanes=SIDE_BY_SIDE if shared else PER_PASS)
            if not all(np.all(np.isfinite(x)) for x in result):  # at these values, or on other rows than `serves` saw
                result = linearised(vehicle, table, segments, target, theta)
            return result

        return self._kept((id(program), values.tobytes(), tuple(free), target, id(segments)), segments, compute)

    def _kept(self, key: Any, segments: Segments, compute: Callable[[], Linearised]) -> Linearised:
        """What was fitted is scored at the same values, many times. The segments are held, so that no others have their
        id."""
        if key in self._results:
            return self._results[key][1]
        result = compute()
        if len(segments) <= SHORT_ROWS:
            for x in result:
                x.flags.writeable = False  # the next caller gets the same arrays
            self._results[key] = segments, result
            while len(self._results) > RESULTS:
                self._results.pop(next(iter(self._results)))
        return result

    def predict(self, vehicle: Vehicle, segments: Segments, target: TargetName) -> Float[np.ndarray, " row"]:
        """The prediction on every row, in the target's unit."""
        if self._of_library(vehicle) and self.serves(vehicle, target):
            program = self.program(vehicle)
            predicted = program.predicted(jax.tree.map(jnp.asarray, segments), target, program.null)
            if np.all(np.isfinite(predicted)):  # at these values, and on other rows than `serves` saw
                return predicted
        return np.asarray(predict(vehicle, segments, target))

    def _of_library(self, vehicle: Vehicle) -> bool:
        """Whether the vehicle is computed by programs in parts: the declared model has its own in one piece, and so
        have vehicles with other effects than this library's."""
        beside = [e for e in vehicle.effects if type(e) not in DECLARED]
        return bool(beside) and all(of_library(type(e)) and self.library.get(e.id) is type(e) for e in beside)

    def _of_table(
        self, vehicle: Vehicle, table: ParameterTable, *, shared: bool
    ) -> tuple[Program, Float[np.ndarray, " parameter"], list[int]]:
        """The program with the table's coefficients as arguments, their values, and where among them the free ones
        are. It is made once for vehicles that differ in these coefficients and, where it is shared, in effects that are
        part of the kernel."""
        heads = tuple(f"effects.{k}." for k in self.library)
        rows = [(in_effect(c.path), c.group) for c in table.rows]
        others = sorted((x for x in rows if not x[0].startswith(heads)), key=lambda x: (x[0], x[1] or 0))
        beside = {e.id: e for e in vehicle.effects if type(e) not in DECLARED}
        rest = jax.tree.leaves(
            (vehicle.mass_kg, vehicle.nominal_voltage_v, vehicle.driveline, vehicle.machine,
             [e for e in vehicle.effects if type(e) in DECLARED])
        )  # fmt: skip
        varied = {id(x) for x in jax.tree.leaves([leaf_of(vehicle, path) for path, _ in others])}
        held = tuple(np.asarray(x).tobytes() for x in rest if id(x) not in varied)
        own = [e for e in beside.values() if e.searched or not shared]
        forms = tuple((jax.tree.structure(e), *map(np.shape, jax.tree.leaves(e))) for e in own)
        key = shared, tuple(i for i, e in beside.items() if apart(e)), forms, tuple(others), held
        if key not in self._programs:
            # alone it is in parts too: in one piece every derivative passes through the corrections across rows, which
            # few coefficients change, and takes three times as long
            alone = Program.of(vehicle, (), [*beside], others) if not shared else None
            self._programs[key] = alone or self.program(vehicle, declared=others)
        program, values, place = self._programs[key], [], {}
        for k, (path, group, _, _) in enumerate(program.structure):
            leaf = leaf_of(vehicle, path) if not path.startswith(heads) else self._leaf(beside, *path.split(".")[1:])
            values.append(float(leaf if group is None else np.asarray(leaf.values)[group]))
            place[path, group] = k
        return program, np.array(values), [place[in_effect(c.path), c.group] for c in table.free]

    def _leaf(self, found: Mapping[str, Effect], effect_id: str, name: str) -> Any:
        """A parameter of a found effect, or at its null where it was found without it or not at all."""
        leaf = getattr(found[effect_id], name) if effect_id in found else None
        return getattr(self.null(self.library[effect_id]), name) if leaf is None else leaf

    def _completed(self, vehicle: Vehicle) -> tuple[Vehicle, Collection[str], dict[str, Effect]]:
        """A vehicle whose found effects have the limits that they were found without, at their null; the ids of these
        effects; the other effects of the library that are part of the kernel, at their null, by id. An effect with a
        search of its own is part of it once it is found."""
        has, part = {e.id: e for e in vehicle.effects}, self._part_of(vehicle)
        known = [c for c in self.library.values() if of_library(c)]
        found = {c.id: _with_limits(has[c.id], self.null(c)) for c in known if c.id in has}
        rest = {c.id: self.null(c) for c in known if c.id in part and c.id not in has}
        return vehicle.minus(*found).plus(*found.values()), tuple(found), rest

    def _part_of(self, vehicle: Vehicle) -> frozenset[str]:
        """Ids of the library's effects that are part of the kernel of such a vehicle, found or not."""
        key = vehicle.entry, frozenset(vehicle.stands_in)
        if key not in self._parts:
            able = (c for c in self.library.values() if not (apart(c) or c.searched))
            self._parts[key] = frozenset(c.id for c in able if not unavailable(c, self.facts.sample, *key))
        return self._parts[key]

    def null(self, effect: type[Effect]) -> Effect:
        """An effect at its null, as the search's log shows it."""
        if effect not in self._nulls:
            self._nulls[effect] = absent(effect, self.facts)
        return self._nulls[effect]


def of_library(effect: type[Effect]) -> bool:
    """Whether it is one of the library's own, not a user's of the same id."""
    return LIBRARY.get(effect.id) is effect


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
