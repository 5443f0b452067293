"""Each effect of the library by itself, worked out for all those of one log in one pass: a vehicle has all of them, one
at its typical size and the others at their null, where they add exactly nothing."""

import dataclasses
from collections import Counter
from functools import cache, partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import physics_rows as made

from hdev_jax.physics import LIBRARY, Choice, Vehicle
from hdev_jax.physics.effect import Effect

STEP = 1e-5
WEIGHTS = np.linspace(0.5, 1.5, sum(made.LENGTHS))  # of the rows
SEED = 0  # of a log of which no row lies on a switch of any effect at its typical size
# Of each effect: null; typical; typical again, in the direction of its own numbers; less and more a step in it; null
# and typical without resistances and loads, where the flat stretch at one speed has no force and no power.
FORMS = 7
NULL, TYPICAL, OWN, BELOW, ABOVE, NULL_AT_ZERO, TYPICAL_AT_ZERO = range(FORMS)


class Alone(NamedTuple):
    """Energy of the vehicle without the effect, `[row]`; by form: energy and what is in it, and the derivative of the
    energy in one direction of all numbers of vehicle and log or of the effect's own, `[form, row]`; in reverse what
    each number has in that of the rows' weighted sum, `[form, number]`."""

    bare: np.ndarray
    energy: np.ndarray
    parts: dict[str, np.ndarray]
    along: np.ndarray
    terms: np.ndarray


def alone(effect_id: str) -> Alone:
    return _of_log(*_log(effect_id))[effect_id]


def log_of(effect_id: str) -> Any:
    return made.log_for(effect_id, seed=SEED)


def filled(*trees: Any) -> Any:
    """A stack of them, again and again."""
    many = (trees * -(-MOST // len(trees)))[:MOST]
    return jax.tree.map(lambda *x: np.stack([np.asarray(y) for y in x]), *many)


def directions(numbers: Any) -> Any:
    """Each number on the scale of its own size, so that one direction sees them all; what is not known, as a phase that
    nobody has fitted, has no size."""
    rng = np.random.default_rng(0)
    return jax.tree.map(lambda x: (np.nan_to_num(np.abs(x)) + 1e-3) * rng.choice([-1.0, 1.0], np.shape(x)), numbers)


def both_modes(numbers: Any, rest: Any, direction: Any) -> tuple[Any, Any, Any]:
    """Energy and its derivative in the direction by row, and in reverse that of their weighted sum by each number."""
    value, forward = jax.linearize(partial(_energy, rest), numbers)
    (reverse,) = jax.linear_transpose(forward, numbers)(jnp.asarray(WEIGHTS))
    return value, forward(direction), reverse


def _energy(rest: Any, numbers: Any) -> Any:
    vehicle, segments = eqx.combine(numbers, rest)
    return vehicle.energy(segments)


def terms(reverse: Any, direction: Any) -> np.ndarray:
    """By vehicle of a stack, what each number has in the derivative in a direction."""
    pairs = zip(*map(jax.tree.leaves, (reverse, direction)), strict=True)
    return np.concatenate([np.reshape(a * b, (len(a), -1)) for a, b in pairs], axis=1)


def _log(effect_id: str) -> tuple[str, bool, bool]:
    """The entry and log that an effect is seen at; sensors by themselves, as each is a pass of the breakdown."""
    effect = LIBRARY[effect_id]
    hidden = "grade_rad" in effect.lacks
    return made.entry_of(effect_id), hidden, effect.stage == "sensors" and not hidden


# vehicles in a stack, so many in all of them: little is compiled twice
MOST = FORMS * max(Counter(_log(i) for i in made.EFFECTS).values())


@cache
def _of_log(*which: Any) -> dict[str, Alone]:
    ids = [i for i in made.EFFECTS if _log(i) == which]
    nulls = {i: made.null(i) for i in ids}
    forms, own = zip(*(_forms(i, nulls) for i in ids), strict=True)
    log = log_of(ids[0])
    cars, logs = filled(*(car for each in forms for car in each)), filled(log)
    numbers, rest = eqx.partition((cars, logs), made.is_real)
    direction = directions(numbers)
    still = jax.tree.map(np.zeros_like, eqx.filter(log, made.is_real))
    for k, tangent in enumerate(own):
        mine = eqx.filter(tangent, made.is_real), still
        direction = jax.tree.map(partial(_with, FORMS * k + OWN), direction, mine)
    energy, along, reverse = map(_arrays, jax.vmap(both_modes)(numbers, rest, direction))
    parts = _arrays(jax.vmap(lambda c, s: c.breakdown(s))(cars, logs))
    products = terms(reverse, direction)
    out, bare = {}, cache(partial(_bare, logs))
    for k, i in enumerate(ids):
        here = slice(FORMS * k, FORMS * (k + 1))
        mine = {name: x[here] for name, x in parts.items()}
        # (of the two bases, one has the slope besides)
        without = bare(i if made.without_effect(i).has("road_grade") else None, made.entry_of(i))
        out[i] = Alone(without[FORMS * k], energy[here], mine, along[here], products[here])
    return out


def _bare(logs: Any, effect_id: str | None, entry: str) -> np.ndarray:
    """The energies without the effect, by the same operations on arrays of the same size: how a last bit is rounded
    depends on both."""
    base = made.without_effect(effect_id) if effect_id else made.baseline(entry)
    numbers, rest = eqx.partition((filled(base), logs), made.is_real)
    return np.asarray(jax.vmap(lambda n, r: jax.linearize(partial(_energy, r), n)[0])(numbers, rest))


def _arrays(tree: Any) -> Any:
    return jax.tree.map(np.asarray, tree)


def _with(k: int, x: np.ndarray, value: np.ndarray) -> np.ndarray:
    """The array with another value at one place."""
    x = x.copy()
    x[k] = value
    return x


def _forms(effect_id: str, nulls: dict[str, Effect]) -> tuple[list[Vehicle], Vehicle]:
    """The vehicles of an effect, and the direction of the effect's own numbers."""
    effect, null = made.typical(effect_id), nulls[effect_id]
    held = {p.name for p in effect.parameters if isinstance(p, Choice)}
    flat, back = jax.flatten_util.ravel_pytree({k: v for k, v in vars(effect).items() if k not in held})
    scale = np.where(np.asarray(flat) == 0, 1.0, np.abs(flat))
    direction = np.random.default_rng(0).normal(size=flat.shape)
    direction *= scale / np.linalg.norm(direction)
    below, above = (dataclasses.replace(effect, **back(flat + s * direction)) for s in (-STEP, STEP))
    bare = made.without_effect(effect_id)
    nothing = {"auxiliary_w": 0.0} | ({"c_rr": 0.0, "cda_m2": 0.0} if bare.entry == "road" else {})
    unforced = made.baseline(bare.entry, **nothing)
    others = [e for i, e in nulls.items() if i != effect_id and not bare.has(i)]
    plain = [bare.plus(*others, form) for form in (null, effect, effect, below, above)]
    all_others = [e for i, e in nulls.items() if i != effect_id]
    cars = [*plain, *(unforced.plus(*all_others, form) for form in (null, effect))]
    zeros = jax.tree.map(np.zeros_like, plain[0])
    moved = dataclasses.replace(zeros.effect(effect_id), **back(jnp.asarray(direction)))
    return cars, zeros.minus(effect_id).plus(moved)
