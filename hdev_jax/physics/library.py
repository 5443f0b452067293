"""The library: every effect that a diagnosis may add, and which of them a given log can show."""

from collections.abc import Iterable

import jax
import jax.numpy as jnp
import numpy as np

from hdev_jax.physics import battery, brakes, loads, losses, road, sensors, states, tyres
from hdev_jax.physics.across import with_bounds
from hdev_jax.physics.effect import STAGES, Effect, Grouped
from hdev_jax.physics.parameter import GROUPS
from hdev_jax.segments import Segments

__all__ = [
    "DECLARED",
    "LIBRARY",
    "at_null",
    "derived",
    "library",
    "most_group",
    "unavailable",
]

DECLARED: tuple[type[Effect], ...] = (road.Inertia, road.Grade, road.Rolling, road.Aero, loads.Auxiliary)


def _all() -> dict[str, type[Effect]]:
    found = [
        c
        for module in (sensors, road, brakes, tyres, losses, loads, states, battery)
        for c in (getattr(module, name) for name in module.__all__)
        if isinstance(c, type) and issubclass(c, Effect) and c.parameters
    ]
    return {c.id: c for c in sorted(found, key=lambda c: (STAGES.index(c.stage), c.id))}


LIBRARY: dict[str, type[Effect]] = _all()


def library(extra: Iterable[type[Effect]] = ()) -> dict[str, type[Effect]]:
    """The library by id, with a user's own effects added. Raises `ValueError` for an id that exists already."""
    found = dict(LIBRARY)
    for c in extra:
        if c.id in found:
            raise ValueError(f"effect id {c.id!r} is in the library already; give yours a name of its own")
        found[c.id] = c
    return found


def most_group(segments: Segments, channels: tuple[str, ...] = GROUPS) -> int:
    """The highest id in the channels by which coefficients may be grouped (gear, kind of surface); at least 1."""
    seen = [np.asarray(segments.channels[k], dtype=float) for k in channels if segments.has(k)]
    finite = [x[np.isfinite(x)] for x in seen]
    return max([1, *(int(x.max()) for x in finite if len(x))])


def at_null(effect: type[Effect], *, gears: int = 1) -> Effect:
    """An instance with every size at its null value and every shape at its default.

    **Arguments:** `gears`: the highest id for which a grouped size needs a value, from `most_group`.
    """
    values = {}
    for p in effect.parameters:
        if p.by:
            values[p.name] = Grouped(jnp.full(gears + 1, p.null), p.by)
        else:
            values[p.name] = np.asarray(p.null, dtype=float)
    return effect(**values)


@jax.jit
def derived(segments: Segments) -> Segments:
    """The same rows with every channel that an effect of the library derives by trip."""
    segments = with_bounds(segments)
    for c in LIBRARY.values():
        e = at_null(c)
        if e.overrides("derive") and all(any(segments.has(n) for n in need.split("|")) for need in c.needs):
            segments = e.derive(segments)
    return segments


def unavailable(effect: type[Effect], segments: Segments, entry: str, stands_in: Iterable[str] = ()) -> str | None:
    """Why this log cannot show the effect, in one phrase; None where it can.

    **Arguments:** `entry`: where the chain begins (`Vehicle.entry`). `stands_in`: values that can replace a channel
    (`Vehicle.stands_in`).
    """
    if entry not in effect.entries:
        where = {"road": "road", "wheel": "measured traction force", "shaft": "measured motor torque"}[entry]
        return f"cannot act where the chain is entered at the {where}"
    for need in effect.needs:
        if not any(segments.has(n) or n in stands_in for n in need.split("|")):
            return f"needs a channel that the log lacks: {need.replace('|', ' or ')}"
    if present := [n for n in effect.lacks if segments.has(n)]:
        return effect.instead or f"the log has {present[0]} itself"
    return None
