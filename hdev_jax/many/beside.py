"""A second scan of the vehicles of a type, with the effects that they show together already in their models."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from hdev_jax.many.evidence import Again
from hdev_jax.many.vehicle import scanned_again
from hdev_jax.many.workers import Workers, computed

__all__ = ["looking_again"]

LOOSE = 10.0  # times the sd with which a vehicle's own effect was fitted: wide enough that no log is counted twice


def looking_again(
    tasks: Sequence[Mapping[str, Any]], where: Workers, tell: Callable[[str], None] = lambda _: None
) -> Again:
    """The function that `effects_of_types` takes as `again`: it scans vehicles with more effects in their models.

    **Arguments:** `tasks`: those of `vehicle_record`. `where`: the processes or the cluster. `tell`: takes progress as
    text.
    """
    by_name = {t["name"]: t for t in tasks}

    def again(records: Sequence[Mapping[str, Any]], shown: Mapping[str, Any]) -> dict[str, Any]:
        tell(f"scanning {len(records)} vehicles again, with {', '.join(shown)} in their models")
        todo = [{**by_name[r["name"]], "beside": {**shown, **_loose(r["fitted"])}} for r in records]
        found = [r for _, r in computed(scanned_again, todo, where)]
        if odd := [r for r in found if r["message"]]:
            tell(f"{len(odd)} of them cannot be fitted so and are left out; {odd[0]['name']}: {odd[0]['message']}")
        return {r["name"]: r["scan"] for r in found}

    return again


def _loose(fitted: Mapping[str, Mapping[str, Sequence[float]]]) -> dict[str, dict[str, list[float]]]:
    return {e: {n: [v, LOOSE * sd] for n, (v, sd) in ps.items()} for e, ps in fitted.items()}
