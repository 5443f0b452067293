"""A finer grid of shapes about the way that a candidate was found in: thresholds and time constants between points."""

from dataclasses import replace

from hdev_jax.diagnosis.candidates.candidate import finer, plan_of
from hdev_jax.diagnosis.scores.evidence import Score
from hdev_jax.diagnosis.scores.look import Loop, View
from hdev_jax.diagnosis.scores.ranking import best_of, plausible
from hdev_jax.diagnosis.scores.sums import both_looks

__all__ = ["refined", "sharpened"]

LOUD = 1e-12  # p of the working model alone
MOST_SHARPENED = 3


def refined(problem: Loop, s: Score, view: View) -> tuple[Score, float]:
    """The same way to have the effect with its shapes on a finer grid, and how many ways that grid tries.

    Switches have many small optima.

    Where trips alone tell it, the grid reaches a whole step to either side and least squares chooses on it: thresholds
    of a few trips have many small optima for the joint refit to end in.
    """
    facts = problem.facts
    grids = finer(s.candidate, facts.row_s, reach=1.0 if s.plain else 0.5)
    if "at_trip" in grids:
        grids["at_trip"] = facts.steps_near(dict(s.candidate.shapes)["at_trip"])
    if all(len(g) == 1 for g in grids.values()):
        return s, 1.0
    plan = plan_of(view.ground.fit.vehicle, [s.candidate.effect], facts, problem.target, grids)
    own = (s.candidate.sizes, s.candidate.groups)
    only = [c.only([g in s.candidate.groups for g in c.groups]) for c in plan.candidates]
    same = [c for c in only if c is not None and (c.sizes, c.groups) == own]
    evidence, plain, slow = both_looks(view.ground, plan)
    if s.plain:
        totals = plain.totals()
        fits = [(*plain.gain(totals, c.columns), c) for c in same]
        inside = [(gain, beta, c) for gain, beta, c in fits if plausible(replace(s, candidate=c, beta=beta))]
        if not inside:
            return s, 1.0
        _, beta, c = max(inside, key=lambda f: f[0])
        return replace(s, candidate=c, beta=beta), 1.0  # its p stays that of the way it started from
    best, ways = best_of(evidence, plain, same, slow)
    finest = best.get(s.candidate.id)
    if finest is None or finest.plain or finest.gain <= s.gain or finest.candidate.groups != s.candidate.groups:
        return s, 1.0
    return finest, ways[s.candidate.id]


def sharpened(problem: Loop, view: View) -> View:
    """The view with a second, finer look at what rows speak for loudly and clusters do not.

    A threshold that lies between two points of its grid does too much in some trips and too little in others.
    """
    doubted = [
        s for id_, s in view.best.items()
        if view.q[id_] > problem.fdr and s.p_model < LOUD and not s.plain and s.candidate.shapes
        and id_ not in view.absorbed_by
    ]  # fmt: skip
    for s in sorted(doubted, key=lambda s: -s.gain)[:MOST_SHARPENED]:
        finer_one, ways = refined(problem, s, view)
        if finer_one is not s and finer_one.p * ways < s.p:
            # places among the view's columns stay those of its own grid; a refit looks for finer shapes again
            tests = {k: getattr(finer_one, k) for k in ("p_model", "p_cluster", "left_out_gain")}
            view.best[s.candidate.id] = replace(s, **tests)
            view.counted(s.candidate.id, ways)
    return view
