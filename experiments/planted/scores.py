"""How a log of the planted study is scored: what counts as named, absorbed, not decidable, and as a rival's hit."""

from collections.abc import Mapping, Sequence
from itertools import permutations
from typing import Any

from hdev_jax.diagnosis.settings import SETTINGS
from hdev_jax.fleet import PLANTABLE
from hdev_jax.physics import LIBRARY

__all__ = ["TWINS", "Group", "absorbed", "alike", "exact", "false", "has_twin", "nameable", "names", "not_decidable",
           "rival_exact", "rival_false", "untouched", "with_twins"]  # fmt: skip

MOST = 3  # names of a class that still is an answer
# Planted in road segments under the study's sheet (drag area open, no declared load): an effect of the library that
# leaves nothing of the column, beside the declared coefficients, in every such log, however long and free of noise.
# Nothing in the log can separate them; a class is the right answer.
TWINS = {
    "mass_scale": "power_gain",  # its gain: the drag area gives back the one force that the mass does not touch
    "power_gain": "mass_scale",
}

Group = list[tuple[dict[str, Any], dict[str, Any]]]  # tasks with their results
Entry = Mapping[str, Any]  # `id`, `class` (as it is printed) and `class_size` (before it was cut)


def names(planted: Sequence[str]) -> list[str]:
    """What each planted effect should be called: its own id, or the library's effect that comes nearest."""
    return [PLANTABLE[k].like or k for k in planted]


def nameable(planted: Sequence[str]) -> bool:
    """Whether something was planted and the library has a name for all of it."""
    return bool(planted) and all(k in LIBRARY for k in names(planted))


def has_twin(planted: Sequence[str]) -> bool:
    """Whether something that was planted has a twin."""
    return any(k in TWINS for k in planted)


def with_twins(planted: Sequence[str], named: Sequence[Entry]) -> bool:
    """Whether the entry of each planted effect that has a twin holds both: one name by itself is a guess."""
    return all(any({k, TWINS[k]} <= set(entry["class"]) for entry in named) for k in planted if k in TWINS)


def exact(planted: Sequence[str], named: Sequence[Entry]) -> bool:
    """Every planted effect has one entry that holds it, a class of at most three; and there is no other entry."""
    left = names(planted)
    for entry in named:
        hit = next((p for p in left if p in entry["class"]), None)
        if hit is None or entry["class_size"] > MOST:
            return False
        left.remove(hit)
    return not left


def false(planted: Sequence[str], named: Sequence[Entry]) -> bool:
    """Whether an entry holds nothing of what was planted."""
    right = {*names(planted), *(p for k in planted for p in PLANTABLE[k].partly)}
    return any(not set(entry["class"]) & right for entry in named)


def absorbed(planted: Sequence[str], result: Mapping[str, Any]) -> bool:
    """Whether nothing is named, and for each planted effect a coefficient that absorbs it is far off."""
    far = [b for b in result["baseline"].values() if abs(b["prior_z"]) > SETTINGS.far]
    return not result["named"] and all(any(k in b["absorbs"] for b in far) for k in planted)


def untouched(result: Mapping[str, Any]) -> bool:
    """Whether nothing is named and every declared coefficient stays near its table's value."""
    return not result["named"] and all(abs(b["prior_z"]) <= SETTINGS.far for b in result["baseline"].values())


def not_decidable(planted: Sequence[str], result: Mapping[str, Any]) -> bool:
    """Whether nothing is named, and each planted effect is among what more trips would tell, with how many."""
    told = {c["id"] for c in result["not_decidable"] if c["clusters_needed"]}
    return not result["named"] and set(names(planted)) <= told


def alike(planted: Sequence[str], result: Mapping[str, Any]) -> list[set[str]]:
    """For each planted effect the names that are right: itself, its twin, what this log cannot distinguish from it
    by the diagnosis's own rule, and the class in which the diagnosis names it."""
    out = []
    for k in planted:
        entry = next((set(n["class"]) for n in result["named"] if k in n["class"]), set())
        out.append({k, TWINS.get(k, k), *result["alike"].get(k, ()), *entry})
    return out


def rival_exact(right: Sequence[set[str]], named: Sequence[str]) -> bool:
    """Whether every name is right, and each planted effect has one of its own. Two names of one class are one answer:
    a class of the loop's is no more than that."""
    return not rival_false(right, named) and any(
        all(n in r for n, r in zip(some, right, strict=True)) for some in permutations(named, len(right))
    )


def rival_false(right: Sequence[set[str]], named: Sequence[str]) -> bool:
    """Whether a name is right for nothing that was planted."""
    return bool(set(named) - set().union(*right))
