"""Hidden states in words: what the chances of a load that switches depend on, when a mode begins and ends."""

from collections.abc import Mapping
from typing import Any

__all__ = ["contrast", "modes"]

MOST_CHANGES = 3  # of a mode, that are dated


def contrast(c: Mapping[str, Any]) -> str:
    """`more often at standstill (61 % against 30 % in motion)`."""
    ends = sorted((("share_high", "high"), ("share_low", "low")), key=lambda k: -c[k[0]])
    (more, where), (less, elsewhere) = ((f"{100 * c[share]:.0f}\u00a0%", c[said]) for share, said in ends)
    return f"more often {where} ({more} against {less} {elsewhere})"


def modes(effect: Mapping[str, Any]) -> str:
    """`; the second mode from 2022-01-06 05:02 (trip B183) on, until 2022-03-09 05:25 (trip B190)`."""
    changes = effect.get("modes", {}).get("changes", [])
    if not changes:
        return ""
    if len(changes) > MOST_CHANGES:
        there = [x > 0.5 for x in effect["modes"]["probability"].values()]
        return f"; the second mode in {sum(there)} of {len(there)} trips"
    said = []
    for c in changes:
        when = c["start"][:16].replace("T", " ") if c["start"] else ""
        where = f"{when} (trip {c['trip']})" if when else f"trip {c['trip']}"
        said.append(f"from {where} on" if c["to"] == "second" else f"until {where}")
    return f"; the second mode {', '.join(said)}"
