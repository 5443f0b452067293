"""Is X still needed beside Y? One question: in the backward step, in exchanges, for classes, and beside unnamed terms.

The equations of the model without X are those of the model with it, X's columns moved from the base to the candidates
and its part put back into the residual: no second pass over the rows.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hdev_jax.diagnosis.candidates.candidate import Candidate
from hdev_jax.diagnosis.competition.forward import Round, forward
from hdev_jax.diagnosis.competition.refit import gained, refit, without
from hdev_jax.diagnosis.competition.state import Found, State
from hdev_jax.diagnosis.gates.gates import alike
from hdev_jax.diagnosis.gates.rejection import Kind, Rejection
from hdev_jax.diagnosis.scores.evidence import Evidence, Score
from hdev_jax.diagnosis.scores.passes import evidence_of
from hdev_jax.diagnosis.scores.scores import Scores, plausible, score_all, worth
from hdev_jax.diagnosis.training import Training
from hdev_jax.inference import Calibration

__all__ = ["backward", "classes", "exchanged", "needed"]


@dataclass(frozen=True)
class Without:
    """The evidence of a model without one of its effects, and that effect as a candidate in it."""

    evidence: Evidence
    own: Candidate
    shift: int  # of the other candidates' places

    def rivals(self, candidates: Sequence[Candidate]) -> list[Candidate]:
        """Other candidates at their places in this evidence."""
        return [replace(c, columns=tuple(k + self.shift for k in c.columns)) for c in candidates]

    def best_ways(self, candidates: Sequence[Candidate], scores: Scores) -> list[Candidate]:
        """Of each effect the way that gains most in this model: beside the effect another one may have looked best."""
        ways = self.rivals(candidates)
        gains = self.evidence.gains(self.evidence.totals(), [c.columns for c in ways])
        best: dict[str, tuple[float, Candidate]] = {}
        for c, gain in zip(ways, gains, strict=True):
            value = worth(float(gain), c, scores.settings)
            if np.isfinite(value) and (c.id not in best or value > best[c.id][0]):
                best[c.id] = (value, c)
        return [c for _, c in best.values()]


def model_without(evidence: Evidence, fit: Calibration, f: Found) -> Without:
    """The model without a found effect; its shapes are held where they are."""
    prefix = f"effects.{f.id}."
    mine = [k for k, c in enumerate(fit.table.free) if c.path.startswith(prefix)]
    sizes = [k for k in mine if fit.table.free[k].path.removeprefix(prefix) in f.score.candidate.sizes]
    order = [*sizes, *(k for k in mine if k not in sizes)]
    nulls = [f.score.candidate.parameter(fit.table.free[k].path.removeprefix(prefix)).null for k in sizes]
    values = np.r_[fit.values[sizes] - nulls, np.zeros(len(order) - len(sizes))]
    names = tuple(fit.table.free[k].path.removeprefix(prefix) for k in sizes)
    groups = tuple(fit.table.free[k].group for k in sizes)
    own = replace(f.score.candidate, sizes=names, groups=groups, columns=tuple(range(len(sizes))))
    freed = evidence.freed(order, values)
    assert isinstance(freed, Evidence)
    return Without(freed, own, len(order))


def needed(evidence: Evidence, fit: Calibration, f: Found) -> Score:
    """A found effect scored beside all that the model has besides."""
    w = model_without(evidence, fit, f)
    return (w.evidence.plain_score if f.score.plain else w.evidence.score)(w.own)


def _can_be_asked(f: Found) -> bool:
    """Whether it has columns that can be tested: a switch is either there or not, and searched effects have none."""
    c = f.score.candidate
    return c.kind == "size" and not c.effect.searched


def backward(training: Training, state: State, *, newest: bool = False) -> State:
    """The state without effects that are no longer needed beside the others, the weakest removed first.

    The newest has just passed every gate beside the others and is not tested, unless `newest`: the others have changed.
    Beside a term without a name an effect has to be as significant as when it entered, unless it reads the same channel
    (the two may be parts of one cause) or is a constant load.
    """
    settings = training.settings
    while asked := [f for f in (state.found if newest or state.terms else state.found[:-1]) if _can_be_asked(f)]:
        evidence = evidence_of(training.baseline(state.fit))
        worst: tuple[float, Found] | None = None
        for f in asked:
            score = needed(evidence, state.fit, f)
            allowed = settings.fdr / max(len(training.library), 1) if _beside_unnamed(state, f) else settings.keep
            p = max(score.p_model, score.p_cluster) if _beside_unnamed(state, f) else score.p_cluster
            if p > allowed and (worst is None or p / allowed > worst[0]):
                worst = (p / allowed, f)
        if worst is None:
            break
        drop = worst[1].id
        beside = "a term without a name" if _beside_unnamed(state, worst[1]) else "effects added later"
        state = without(training, state, drop)
        times = state.removed[drop].numbers["times"] + 1 if drop in state.removed else 1
        why = Rejection(Kind.SUPERFLUOUS, {"beside": beside, "times": times})
        state = replace(state, removed={**state.removed, drop: why})
    return state


def _beside_unnamed(state: State, f: Found) -> bool:
    c = f.score.candidate
    if all(c.parameter(size).constant for size in c.sizes):  # never gives way to a term without a name
        return False
    reads = c.effect.reads()
    return any(not reads & {*t.channels} for t in state.terms)


def classes(scores: Scores, state: State) -> tuple[Found, ...]:
    """The found effects with the classes that they have in the final model.

    An effect that cannot be tested again keeps the class that it had when it was added.
    """
    out = []
    for f in state.found:
        if not _can_be_asked(f):
            out.append(f)
            continue
        w = model_without(scores.plain if f.score.plain else scores.white, scores.baseline.fit, f)
        own = (w.evidence.plain_score if f.score.plain else w.evidence.score)(w.own)
        rivals = w.best_ways([c for c in scores.source.candidates if c.id in scores.best], scores)
        out.append(replace(f, alike=alike(w.evidence, w.own, rivals, own.gain, scores, plain=f.score.plain)))
    return tuple(out)


def exchanged(round_: Round) -> State | None:
    """The state with a found effect exchanged for another that explains clearly more in its place, or None.

    An effect added early may have been a proxy for one that was not in the model yet. All but the newest are tested;
    an exchange passes every gate of an addition, and is well ahead in the joint refits too.
    """
    training, state, scores = round_.training, round_.state, round_.scores
    for f in state.found[:-1]:
        if not _can_be_asked(f):
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
        fresh = Round(training, start, score_all(training, start.fit), round_.rng, round_.tell)
        own = _own_worth(fresh, state, f)
        while ahead and (new := forward(fresh, only=ahead)) is not None:
            first = new.found[-1]
            if _well_ahead(round_, fresh.scores.worth(replace(first.score, gain=first.gain)), own):
                round_.tell(f"exchanged {f.id} for {first.id}")
                why = Rejection(Kind.SUPERFLUOUS, {"beside": first.id, "times": 2})
                return replace(new, refused=state.refused, removed={**state.removed, f.id: why})
            ahead.remove(first.id)
    return None


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
