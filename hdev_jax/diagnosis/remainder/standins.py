"""Found effects that stood in for a cause that the library does not hold.

A cause without a name leaves its mean, or its mean by trip, to whatever comes nearest. Once the rest is described (by a
formula, or as a cycle of so much in each trip) an effect that is real is found again beside the description; one that
stood in for it is not.
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from hdev_jax.diagnosis.candidates.cycles import add_cycle
from hdev_jax.diagnosis.candidates.expression import TERM, Described, describing
from hdev_jax.diagnosis.candidates.modes import add_mode
from hdev_jax.diagnosis.competition.refit import without
from hdev_jax.diagnosis.competition.select import choose
from hdev_jax.diagnosis.competition.sharpen import sharpened
from hdev_jax.diagnosis.scores.look import Found, Loop, Search, look
from hdev_jax.inference import calibrate, effect_coefficients

__all__ = ["beside", "stand_ins"]

BY_TRIP = {"spectrum": add_cycle, "trips": add_mode}
Tell = Callable[[str], None]


def beside(problem: Loop, state: Search, load_w: Float[np.ndarray, " row"]) -> tuple[Loop, Search]:
    """The loop and the state with a load in proportion to `load_w` [W or, in front of the battery, N; padded as the
    loop's rows] in the base."""
    scale = float(np.sqrt(np.mean(load_w[: problem.rows.rows] ** 2)))
    segments = problem.rows.segments.with_channels(**{TERM: load_w / scale})
    problem = replace(problem, rows=replace(problem.rows, segments=segments))
    effect = describing(problem.target)(np.asarray(scale))
    table = state.table.plus(*effect_coefficients(effect, ("k",), shapes=False))
    fit = calibrate(state.fit.vehicle.plus(effect), table, problem.rows, problem.target, problem.clusters)
    return problem, replace(state, vehicle=fit.vehicle, table=table, fit=fit)


def stand_ins(
    problem: Loop, state: Search, channels: Sequence[str], tell: Tell, asked: Collection[str]
) -> tuple[str, ...]:
    """Effects of those `asked` that are not found again beside the description of the rest in `state`'s vehicle.

    One that reads one of the description's `channels`, or has sizes by one, is left: the two may be one cause, told in
    parts.
    """
    gone = []
    for f in reversed(state.found):
        effect = f.score.candidate.effect
        if f.id not in asked or {*effect.needs, *(p.by for p in effect.parameters)} & {*channels}:
            continue
        tell(f"is {f.id} found again beside what is left")
        if not _again(problem, state, f, tell):
            gone.append(f.id)
    return tuple(gone)


def _again(problem: Loop, state: Search, f: Found, tell: Tell) -> bool:
    """Whether the effect clears every bar from where the vehicle stands without it."""
    start = without(problem, state, f.id)
    named = [g for g in start.found if g.id != Described.id]
    start = replace(start, found=named, refused=(), taken_out=())
    if (by := f.score.candidate.effect.searched) in BY_TRIP:
        return BY_TRIP[by](problem, start)[0] is not None
    view = sharpened(problem, look(problem, start))
    # itself: a twin may do no more than take back what the description has too much of
    others = [id_ for id_ in view.best if id_ != f.id]
    return choose(problem, start, view, tell, skip=others, forms=False) is not None
