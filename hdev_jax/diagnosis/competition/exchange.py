"""Swaps: what was found beside fewer effects may have stood in for another that was not there yet."""

from collections.abc import Callable
from dataclasses import replace

from hdev_jax.diagnosis.competition.refit import gained, refit, without
from hdev_jax.diagnosis.competition.select import choose, clears
from hdev_jax.diagnosis.competition.sharpen import sharpened
from hdev_jax.diagnosis.scores.look import Found, Loop, Search, View, look
from hdev_jax.diagnosis.scores.ranking import CLOSE, LEFT_OUT, worth

__all__ = ["exchanged"]

Tell = Callable[[str], None]


def exchanged(problem: Loop, state: Search, seen: View, tell: Tell) -> Search | None:
    """The state with a found effect exchanged for another that does clearly more in its place; None where none does.

    All but the newest are asked. A swap clears every bar of an addition to the others, and leaves what it replaces well
    behind, sought anew too, in the joint refits: one of its class comes to the same. `seen` is the last look with all
    in: what says there no more than a found effect would in another form does not take that effect's place either.
    What has left so may be added again beside what came, but takes nothing's place.
    """
    for f in state.found[:-1]:
        if f.score.candidate.effect.searched:
            continue
        start = replace(without(problem, state, f.id), refused=())
        view = sharpened(problem, look(problem, start))
        own = view.best.get(f.id)
        if own is None or own.plain != f.score.plain:
            continue
        barred = {f.id, *state.taken_out, *state.exchanged, *seen.in_other_forms}
        more = [
            id_ for id_, s in view.best.items()
            if id_ not in barred and s.plain == own.plain and clears(problem, view, s)
            and _well_ahead(worth(s.gain, s.candidate), worth(own.gain, own.candidate))
        ]  # fmt: skip
        if not more:
            continue
        tell(f"does {' or '.join(more)} do more than {f.id} in its place")
        best = _best_of(problem, start, state, f, view)
        while (new := choose(problem, start, view, tell, skip=[k for k in view.best if k not in more])) is not None:
            first = new.found[-1]
            if _well_ahead(worth(first.gain, first.score.candidate), best):
                tell(f"exchanged {f.id} for {first.id}")
                return replace(new, refused=state.refused, exchanged=(*state.exchanged, f.id))
            more.remove(first.id)
    return None


def _well_ahead(one: float, other: float) -> bool:
    """By a share that the look's own choice allows for, and by more than chance gives."""
    return CLOSE * one > other and one - other > LEFT_OUT


def _best_of(problem: Loop, start: Search, state: Search, f: Found, view: View) -> float:
    """What a found effect is worth in its place: as it was found, as it looks now, and as it would be fitted now."""
    own = view.best[f.id]
    ways = [(gained(problem, state.fit, view), f.score.candidate), (own.gain, own.candidate)]
    if isinstance(again := refit(problem, start, own, view), tuple):
        ways.append((again[1], own.candidate))
    return max(worth(gain, c) for gain, c in ways)
