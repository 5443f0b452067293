"""Exchanges: a found effect, or two at once, for others that explain clearly more in their place.

An effect added early may have been a proxy for one that was not in the model yet, and two of them for two others: of
which none by itself is better than either.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np

from hdev_jax.diagnosis.candidates.candidate import Candidate
from hdev_jax.diagnosis.competition.forward import Round, forward
from hdev_jax.diagnosis.competition.grid import sharpened
from hdev_jax.diagnosis.competition.needed import Without, can_be_asked, model_without
from hdev_jax.diagnosis.competition.refit import gained, refit, without
from hdev_jax.diagnosis.competition.state import Found, State
from hdev_jax.diagnosis.gates.rejection import Kind, Rejection
from hdev_jax.diagnosis.scores.evidence import Score
from hdev_jax.diagnosis.scores.scores import Scores, plausible, score_all, worth

__all__ = ["one_exchanged", "two_exchanged"]


def one_exchanged(round_: Round) -> State | None:
    """The state with a found effect exchanged for another, or None.

    All but the newest are tested; an exchange passes every gate of an addition, and is well ahead in the joint refits
    too.
    """
    training, state, scores = round_.training, round_.state, round_.scores
    for f in state.found[:-1]:
        if not can_be_asked(f):
            continue
        w = model_without(scores.plain if f.score.plain else scores.white, scores.baseline.fit, f)
        score_of = w.evidence.plain_scores if f.score.plain else w.evidence.scores
        out = {*state.barred, *state.refused, *round_.reasons}
        ids = [id_ for id_, s in scores.best.items() if id_ not in out and s.plain == f.score.plain]
        rivals = score_of(w.rivals([scores.best[id_].candidate for id_ in ids]))
        own = scores.worth(score_of([w.own])[0])
        ahead = [s.candidate.id for s in rivals if _well_ahead(round_, scores.worth(s), own) and _bears(round_, s)]
        if not ahead:
            continue
        round_.tell(f"testing {' and '.join(ahead)} in place of {f.id}")
        start = replace(without(training, state, f.id), refused=())
        fresh = _round(round_, start)
        own = _own_worth(fresh, state, f)
        while ahead and (new := forward(fresh, only=ahead)) is not None:
            first = new.found[-1]
            if _well_ahead(round_, fresh.scores.worth(replace(first.score, gain=first.gain)), own):
                round_.tell(f"exchanged {f.id} for {first.id}")
                why = Rejection(Kind.SUPERFLUOUS, {"beside": first.id, "times": 2})
                return replace(new, refused=state.refused, removed={**state.removed, f.id: why})
            ahead.remove(first.id)
    return None


def two_exchanged(round_: Round) -> State | None:
    """The state with two found effects exchanged for two others, each of which passes every gate beside the other."""
    training, state, scores = round_.training, round_.state, round_.scores
    asked = [f for f in state.found if can_be_asked(f) and not f.score.plain]
    if len(asked) < 2:
        return None
    out = {*state.barred, *state.refused, *round_.reasons, *scores.absorbed_by}
    # each effect in its best way alone: the equations of all columns are 0.1 GB, and each pair copies them
    small, open_ = scores.white.only([s.candidate for k, s in scores.best.items() if k not in out and not s.plain])
    for f, g in combinations(asked, 2):
        ahead = _best_pair(round_, model_without(small, scores.baseline.fit, f, g), open_)
        if ahead is None:
            continue
        a, b = (c.id for c in ahead)
        round_.tested.append(_test(a, b, f.id, g.id))
        round_.tell(f"testing {a} and {b} in place of {f.id} and {g.id}")
        start = replace(without(training, state, f.id, g.id), refused=())
        fresh = _round(round_, start)
        ab, ba = _beside(fresh, a, b), _beside(fresh, b, a)
        if ab is None or ba is None or _sizes(ab.found[-2]) != _sizes(ba.found[-1]):
            continue
        own = _together(fresh.scores, gained(training, state.fit, fresh.scores), [f.score.candidate, g.score.candidate])
        if _well_ahead(round_, _together(fresh.scores, gained(training, ab.fit, fresh.scores), ahead), own):
            round_.tell(f"exchanged {f.id} and {g.id} for {a} and {b}")
            why = Rejection(Kind.SUPERFLUOUS, {"beside": f"{a} and {b}", "times": 2})
            as_fitted = replace(ba.found[-1], score=ab.found[-2].score, gain=ab.found[-2].gain)
            found = (*start.found, as_fitted, ab.found[-1])
            return replace(ab, found=found, refused=state.refused, removed={**state.removed, f.id: why, g.id: why})
    return None


def _best_pair(round_: Round, w: Without, open_: Sequence[Candidate]) -> list[Candidate] | None:
    """The best plausible pair of the candidates `open_` to replace the two that `w` is without; None where it is not
    well ahead."""
    scores, settings, totals = round_.scores, round_.training.settings, w.evidence.totals()
    rivals = w.rivals(open_)
    pairs = list(combinations([c for c in rivals if c.kind == "size"], 2))

    def together(*each: Candidate) -> Candidate:
        return replace(each[0], columns=tuple(k for c in each for k in c.columns))

    def worths(ways: Sequence[Sequence[Candidate]]) -> np.ndarray:
        gains = w.evidence.gains(totals, [together(*way).columns for way in ways])
        return np.array([_together(scores, float(x), way) for x, way in zip(gains, ways, strict=True)])

    # a third effect that is only not added yet is no reason for an exchange
    own = worths([w.each, *((*w.each, c) for c in rivals)])
    if not np.any(np.isfinite(own)):
        return None
    to_beat, of_pairs = float(np.max(own[np.isfinite(own)])), worths(pairs)
    held: Score | None = None  # of the two that are out: its tests cost more than all of the above
    for k in np.argsort(-of_pairs):
        if not _well_ahead(round_, float(of_pairs[k]), to_beat):
            return None
        a, b = pairs[int(k)]
        if _test(a.id, b.id, *(c.id for c in w.each)) in round_.state.tested:
            continue
        new = w.evidence.score(together(a, b))
        held = w.evidence.score(together(*w.each)) if held is None else held
        each = zip((a, b), np.split(new.beta, [len(a.columns)]), strict=True)
        fine = all(plausible(replace(scores.best[c.id], beta=x), settings) for c, x in each)
        fine = fine and _well_ahead(round_, new.left_out_gain, held.left_out_gain)
        if fine and all(w.evidence.beside(x.columns, y.columns) <= scores.level(y.id) for x, y in ((a, b), (b, a))):
            return [a, b]
    return None


def _test(*ids: str) -> str:
    return "+".join(ids)


def _sizes(f: Found) -> tuple[Any, ...]:
    return f.score.candidate.sizes, f.score.candidate.groups


def _round(round_: Round, state: State) -> Round:
    """A round from another state, with the same draws."""
    scores = sharpened(round_.training, score_all(round_.training, state.fit))
    return Round(round_.training, state, scores, round_.rng, round_.tell)


def _beside(start: Round, first: str, second: str) -> State | None:
    """The state with `second` added by every gate where `first` is in the model."""
    if first not in start.scores.best:
        return None
    s = start.scores.best[first]
    came = refit(start.training, start.state, s, start.scores)
    if came.fit is None:
        return None
    found = Found(first, came.score, 1.0, 0.0, (), came.gain)
    there = replace(start.state, fit=came.fit, found=(*start.state.found, found))
    return forward(_round(start, there), only=[second])


def _together(scores: Scores, gain: float, candidates: Sequence[Candidate]) -> float:
    """What the gain of some candidates together is worth."""
    return gain + sum(worth(0.0, c, scores.settings) for c in candidates)


def _bears(round_: Round, s: Score) -> bool:
    """Whether a rival by itself is plausible, significant and confirmed by cross-validation over clusters."""
    settings, id_ = round_.training.settings, s.candidate.id
    q = s.p * round_.scores.ways[id_] * len(round_.scores.best)
    return plausible(s, settings) and q <= settings.fdr and s.left_out_gain > settings.ahead


def _well_ahead(round_: Round, one: float, other: float) -> bool:
    """By more than the margin of the choice among leaders, and by more than chance."""
    settings = round_.training.settings
    return settings.close * one > other and one - other > settings.ahead


def _own_worth(fresh: Round, state: State, f: Found) -> float:
    """What a found effect is worth in its place: the best of as found, as scored now, and as refitted now."""
    scores = fresh.scores
    ways = [scores.worth(replace(f.score, gain=gained(fresh.training, state.fit, scores)))]
    if (own := scores.best.get(f.id)) is not None:
        ways.append(scores.worth(own))
        if (again := refit(fresh.training, fresh.state, own, scores)).fit is not None:
            ways.append(scores.worth(replace(own, gain=again.gain)))
    return max(ways)
