"""The loop: calibrate, score every candidate, let the leaders compete, add what clears the bar, repeat."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from hdev_jax.diagnosis.candidates.cycles import add_cycle
from hdev_jax.diagnosis.candidates.modes import add_mode
from hdev_jax.diagnosis.competition.exchange import exchanged
from hdev_jax.diagnosis.competition.refit import grow
from hdev_jax.diagnosis.competition.select import choose, prune
from hdev_jax.diagnosis.competition.sharpen import sharpened
from hdev_jax.diagnosis.scores.look import Loop, Search, View, look
from hdev_jax.inference import Fit, ParameterTable, calibrate, cluster_rows
from hdev_jax.physics import Effect, Vehicle
from hdev_jax.physics.vehicle import Target

__all__ = ["search"]

MOST_EFFECTS = 10


def search(
    vehicle: Vehicle,
    table: ParameterTable,
    rows: Fit,
    target: Target,
    effects: Sequence[type[Effect]],
    *,
    fdr: float,
    seed: int,
    gears: int,
    tell: Callable[[str], None] = lambda _: None,
    remember: Callable[[int, Callable[[], Search]], Search] = lambda _, compute: compute(),
) -> Search:
    """Steps 1 to 5 of the loop on training rows alone.

    **Arguments:** the declared vehicle with its table, `rows` from `padded`, the candidates' classes, `fdr` the level
    of false discoveries over the whole library, `seed` for placebos and resampling, `gears` the highest id of a gear
    or a kind of road that any trip has, `tell` for progress, `remember` what keeps the state of each step for a run
    that is killed.

    **Returns:** the vehicle with every effect that cleared the bar, its fit, and a verdict on every other candidate.
    """
    clusters = cluster_rows(rows.segments.take(np.arange(rows.rows)))

    def declared() -> Search:
        tell("calibrating the declared model")
        return Search(vehicle, table, calibrate(vehicle, table, rows, target, clusters))

    state = remember(0, declared)
    for step in range(1, MOST_EFFECTS + 2):
        problem = Loop(rows, target, clusters, effects, fdr, np.random.default_rng([seed, step]), gears)
        state = remember(step, lambda p=problem, s=state, k=step: _step(p, s, k, tell))
        if state.finished:
            break
    return state


def _step(problem: Loop, state: Search, step: int, tell: Callable[[str], None]) -> Search:
    """One look at all candidates, and the vehicle with the one that is taken; `finished` where none is."""
    tell(f"scoring candidates, step {step}")
    view = sharpened(problem, look(problem, state))
    if step == 1:
        state = replace(state, absorbs=view.absorbs)
    choice = choose(problem, state, view, tell, skip=state.refused) if step <= MOST_EFFECTS else None
    if choice is None and state.refused and step <= MOST_EFFECTS:
        choice = choose(problem, state, view, tell, skip=tuple(view.reasons))  # tried just now: no second time
    if choice is None and step <= MOST_EFFECTS:
        # last: what misses an effect that comes and goes with the traffic is not noise, and may have cycles
        for add in (add_cycle, add_mode):
            if choice is None:
                choice, why = add(problem, state)
                view.sought += [why] if why is not None else []
    if choice is None:
        swapped = exchanged(problem, state, view, tell) if step <= MOST_EFFECTS else None
        if swapped is not None:
            return _added(prune(problem, swapped, tell), view, problem.fdr)
        grown = grow(problem, state, tell)
        return replace(grown or state, verdicts=view.verdicts(state, problem.fdr), finished=grown is None)
    choice = replace(choice, refused=tuple(dict.fromkeys((*state.refused, *view.reasons))))
    tell(f"added {choice.found[-1].id}")
    return _added(prune(problem, choice, tell), view, problem.fdr)


def _added(state: Search, view: View, fdr: float) -> Search:
    """The state after an effect was added or exchanged, with its fit on the trail."""
    trail = {**state.trail, ",".join(f.id for f in state.found): [float(x) for x in state.fit.values]}
    return replace(state, verdicts=view.verdicts(state, fdr), trail=trail)
