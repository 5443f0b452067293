"""A finer grid of shapes about the way that a candidate was found in: thresholds and time constants between points."""

from dataclasses import replace

from hdev_jax.diagnosis.candidates.candidate import finer
from hdev_jax.diagnosis.scores.evidence import Score
from hdev_jax.diagnosis.scores.passes import both_looks
from hdev_jax.diagnosis.scores.scores import Scores, best_of, plausible
from hdev_jax.diagnosis.training import Training

__all__ = ["LEADERS", "refined", "sharpened"]


LEADERS = 3  # candidates that are refitted, or have their shapes refined, in one step
BY_ROWS = 1e-12  # p-value by rows alone below which a shape is refined before its clustered test counts


def sharpened(training: Training, scores: Scores) -> Scores:
    """The scores with the tests at finer shapes of what rows show clearly and clusters do not.

    A threshold that lies between two points of its grid does too much in some trips and too little in others.
    """
    settings = training.settings
    doubted = [
        s for id_, s in scores.best.items()
        if scores.q[id_] > settings.fdr and s.p_model < BY_ROWS and not s.plain and s.candidate.shapes
        and id_ not in scores.absorbed_by
    ]  # fmt: skip
    for s in sorted(doubted, key=lambda s: -s.gain)[:LEADERS]:
        better, ways = refined(training, s, scores)
        if better is not s and better.p * ways < s.p:
            # places stay those of the coarse grid; a refit looks for finer shapes again
            tests = {k: getattr(better, k) for k in ("p_model", "p_cluster", "left_out_gain")}
            scores.ways[s.candidate.id] *= ways
            scores.replaced(replace(s, **tests))
    return scores


def refined(training: Training, s: Score, scores: Scores) -> tuple[Score, float]:
    """The same way to have the effect with its shapes on a finer grid: switches have many small optima; and how
    many independent ways that grid tries.

    Where it differs between trips alone, the grid reaches a whole step to either side and ordinary least squares choose
    on it: thresholds of a few trips have many small optima, in which the joint refit could end.
    """
    facts, settings = training.facts, training.settings
    grids = finer(s.candidate, facts.row_s, reach=1.0 if s.plain else 0.5)
    if "at_trip" in grids:
        grids["at_trip"] = facts.steps_near(dict(s.candidate.shapes)["at_trip"])
    if all(len(g) == 1 for g in grids.values()):
        return s, 1.0
    plan = training.plan(scores.baseline.fit.vehicle, [s.candidate.effect], grids)
    own = (s.candidate.sizes, s.candidate.groups)
    only = [c.only([g in s.candidate.groups for g in c.groups]) for c in plan.candidates]
    same = [c for c in only if c is not None and (c.sizes, c.groups) == own]
    white, plain, slow = both_looks(scores.baseline, plan)
    if s.plain:
        totals = plain.totals()
        fits = [(*plain.gain(totals, c.columns), c) for c in same]
        inside = [(gain, b, c) for gain, b, c in fits if plausible(replace(s, candidate=c, beta=b), settings)]
        if not inside:
            return s, 1.0
        _, beta, c = max(inside, key=lambda f: f[0])
        return replace(s, candidate=c, beta=beta), 1.0  # its p stays that of the way it started from
    best, ways = best_of(white, plain, same, slow, settings)
    finest = best.get(s.candidate.id)
    if finest is None or finest.plain or finest.gain <= s.gain or finest.candidate.groups != s.candidate.groups:
        return s, 1.0
    return finest, ways[s.candidate.id]
