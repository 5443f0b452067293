"""A finer grid of shapes about the way that a candidate was found in: thresholds and time constants between points."""

from dataclasses import replace

from hdev_jax.diagnosis.candidates.candidate import finer, plan_of
from hdev_jax.diagnosis.scores.evidence import Score
from hdev_jax.diagnosis.scores.passes import both_looks
from hdev_jax.diagnosis.scores.scores import Scores, best_of, plausible
from hdev_jax.diagnosis.training import Training

__all__ = ["refined"]


def refined(training: Training, s: Score, scores: Scores) -> Score:
    """The same way to have the effect with its shapes on a finer grid: switches have many small optima.

    Where it differs between trips alone, the grid reaches a whole step to either side and ordinary least squares choose
    on it: thresholds of a few trips have many small optima, in which the joint refit could end.
    """
    facts, settings = training.facts, training.settings
    grids = finer(s.candidate, facts.row_s, reach=1.0 if s.plain else 0.5)
    if "at_trip" in grids:
        grids["at_trip"] = facts.steps_near(dict(s.candidate.shapes)["at_trip"])
    if all(len(g) == 1 for g in grids.values()):
        return s
    plan = plan_of(scores.baseline.fit.vehicle, [s.candidate.effect], facts, training.target, grids)
    own = (s.candidate.sizes, s.candidate.groups)
    only = [c.only([g in s.candidate.groups for g in c.groups]) for c in plan.candidates]
    same = [c for c in only if c is not None and (c.sizes, c.groups) == own]
    white, plain, slow = both_looks(scores.baseline, plan)
    if s.plain:
        totals = plain.totals()
        fits = [(*plain.gain(totals, c.columns), c) for c in same]
        inside = [(gain, b, c) for gain, b, c in fits if plausible(replace(s, candidate=c, beta=b), settings)]
        if not inside:
            return s
        _, beta, c = max(inside, key=lambda f: f[0])
        return replace(s, candidate=c, beta=beta)  # its p stays that of the way it started from
    best, _ = best_of(white, plain, same, slow, settings)
    finest = best.get(s.candidate.id)
    if finest is None or finest.plain or finest.gain <= s.gain or finest.candidate.groups != s.candidate.groups:
        return s
    return finest
