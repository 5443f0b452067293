"""A user's own effects: read from a Python file or given as classes, checked before anything is fitted."""

import importlib.util
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np

from hdev_jax.diagnosis.candidates.candidate import as_seen
from hdev_jax.diagnosis.candidates.facts import Facts, facts_of
from hdev_jax.diagnosis.candidates.plan import plan_of
from hdev_jax.diagnosis.candidates.programs import computed
from hdev_jax.errors import InputError
from hdev_jax.inference import padded
from hdev_jax.physics import DECLARED, LIBRARY, Effect, Parameter, at_null, library
from hdev_jax.physics.effect import HOOKS, STAGES
from hdev_jax.problem import Problem

__all__ = ["Effects", "known_effects", "tried"]

Effects = str | Path | Sequence[type[Effect]] | None  # a Python file of a user's own effects, or their classes
ROUNDING = 1e4  # units in the last place of the largest prediction, for two that count as equal


def known_effects(file: Effects) -> dict[str, type[Effect]]:
    """The library with a user's own effects: classes, or every `Effect` class that a Python file defines."""
    if file is None:
        return dict(LIBRARY)
    if not isinstance(file, str | Path):
        return _joined(list(file), "effects")
    path = Path(file)
    spec = importlib.util.spec_from_file_location("hdev_user_effects", path)
    if not path.is_file() or spec is None or spec.loader is None:
        raise InputError(f"--effects {file}: no such Python file")
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as e:  # a script that exits was not read to its end
        raise InputError(f"--effects {file}: does not run: {type(e).__name__}: {e}") from e
    own = [
        c for c in vars(module).values()
        if isinstance(c, type) and issubclass(c, Effect) and c.__module__ == module.__name__ and hasattr(c, "id")
    ]  # fmt: skip
    if not own:
        raise InputError(f"--effects {file}: defines no subclass of hdev_jax.physics.Effect with an id")
    return _joined(own, f"--effects {file}")


def _joined(own: Sequence[type[Effect]], where: str) -> dict[str, type[Effect]]:
    for c in own:
        if not (isinstance(c, type) and issubclass(c, Effect) and hasattr(c, "id")):
            raise InputError(f"{where}: {c!r} is no subclass of hdev_jax.physics.Effect with an id")
        if why := _malformed(c):
            raise InputError(f"{where}: class {c.__name__}: {why}")
    try:
        return library(own)
    except ValueError as e:
        raise InputError(f"{where}: {e}") from e


def _malformed(effect: type[Effect]) -> str | None:
    """Why a user's class is no effect, in one phrase; None where it is one."""
    stage, parameters = getattr(effect, "stage", None), effect.parameters
    if not (isinstance(effect.id, str) and effect.id.isascii() and effect.id.isidentifier()):
        return f"id is {effect.id!r}; letters, digits and underscores are expected"
    if effect.id in {c.id for c in DECLARED}:
        return f"id {effect.id!r} is a part of the declared model; give yours a name of its own"
    if stage not in STAGES:
        return f"stage is {stage!r}; one of {', '.join(STAGES)} is expected"
    if not isinstance(getattr(effect, "equation", None), str):
        return "equation is missing; a line of text is expected"
    for name in ("needs", "lacks", "entries"):
        if not _texts(value := getattr(effect, name)):
            return f"{name} is {value!r}; a tuple of names is expected"
    if not effect.entries or set(effect.entries) - {*Effect.entries}:
        return f"entries is {effect.entries!r}; some of {', '.join(Effect.entries)} are expected"
    if effect.searched:
        return f"searched is {effect.searched!r}; only effects of the library have a search of their own"
    if not any(effect.overrides(hook) for hook in HOOKS):
        return f"it overrides none of {', '.join(HOOKS)}, so it does nothing"
    if not (isinstance(parameters, tuple | list) and all(isinstance(p, Parameter) for p in parameters)):
        return "parameters is something else than a tuple of Size, Switch, Shape and Choice (hdev_jax.physics)"
    return _malformed_parameters(effect, parameters)


def _malformed_parameters(effect: type[Effect], parameters: Sequence[Parameter]) -> str | None:
    names = [p.name for p in parameters]
    if twice := {n for n in names if names.count(n) > 1}:
        return f"two parameters are called {min(twice)}"
    for p in parameters:
        if not (p.has_column or len(p.grid) or p.mean_of):  # some of the library's have a search of their own
            return f"parameter {p.name!r}: a {type(p).__name__} without a grid is never tried; give it values to try"
        if p.of and p.of not in names:
            return f"parameter {p.name!r}: of is {p.of!r}; one of {', '.join(names)} is expected"
    if all(not p.has_column for p in parameters):
        return "parameters has no size and no switch, so it could not be found"
    if not (isinstance(effect.variants, tuple | list) and all(map(_texts, effect.variants))):
        return f"variants is {effect.variants!r}; a tuple of tuples of names is expected"
    if odd := [n for variant in effect.variants for n in variant if n not in names]:
        return f"variants has {odd[0]!r}; sets of {', '.join(names)} are expected"
    try:
        made = at_null(effect)
    except Exception as e:
        return f"cannot be made with its parameters ({', '.join(names)}): {type(e).__name__}: {e}"
    if odd := [x for x in jax.tree.leaves(made) if not eqx.is_array_like(x)]:
        return f"has a field that holds {odd[0]!r}, no number; make it a ClassVar or equinox.field(static=True)"
    return None


def _texts(names: Any) -> bool:
    return isinstance(names, tuple | list) and all(isinstance(n, str) for n in names)


def tried(problem: Problem, known: Mapping[str, type[Effect]], file: Effects, *candidates: str) -> None:
    """Compute the columns of a user's own effects on every row of the log, before anything is fitted: of those that
    are `candidates` or that the vehicle has.

    Raises `InputError` that names the class, for one that fails there, is not finite in every row, or changes
    the prediction while all of its sizes are null.
    """
    own = [c for k, c in known.items() if k not in LIBRARY and (k in candidates or problem.vehicle.has(k))]
    if not own:
        return
    car = problem.vehicle.minus(*(c.id for c in own if problem.vehicle.has(c.id)))
    rows, facts = padded(problem.segments, problem.measured), facts_of(problem.segments)
    plain = problem.predict(car)
    for c in own:
        where = f"{f'--effects {file}' if isinstance(file, str | Path) else 'effects'}: class {c.__name__}"
        bad = np.zeros(rows.rows, dtype=bool)
        try:
            plan = plan_of(car, [c], facts, problem.target, searched=True)
            for _, column in computed(plan.recipes, rows.segments, problem.target):
                bad |= ~np.isfinite(column[: rows.rows])
            null = plain if c.id in plan.left_out else problem.predict(car.plus(_idle(c, facts)))
        except Exception as e:
            hint = "; every channel that it reads belongs in its needs" if isinstance(e, KeyError) else ""
            raise InputError(f"{where}: fails on this log: {type(e).__name__}: {e}{hint}") from e
        if bad.any():
            first = int(np.argmax(bad))
            trip, at = problem.log.trip_names[problem.log.trip[first]], problem.segments.time_s[first]
            raise InputError(
                f"{where}: it or its derivative is not finite in {bad.sum()} of {rows.rows} rows, the first in trip "
                f"{trip} at {at:g} s; it must be finite in every row, in every branch"
            )
        if not np.allclose(null, plain, rtol=0.0, atol=ROUNDING * np.finfo(plain.dtype).eps * np.max(np.abs(plain))):
            raise InputError(
                f"{where}: changes the prediction by up to {np.max(np.abs(null - plain)):.3g} {problem.unit} while its "
                "sizes are null; it must add 0 there"
            )


def _idle(effect: type[Effect], facts: Facts) -> Effect:
    """With its sizes null and each shape at a value that is tried."""
    null = as_seen(at_null(effect, gears=facts.gears), facts)
    values = {p.name: getattr(null, p.name) for p in effect.parameters}
    tried = {p.name: np.asarray(float(p.grid[0])) for p in effect.parameters if not p.has_column and len(p.grid)}
    return effect(**(values | tried))
