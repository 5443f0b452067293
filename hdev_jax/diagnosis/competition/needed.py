"""Is X still needed beside Y? One question: in the backward step, in exchanges, for classes, and beside unnamed terms.

The equations of the model without X are those of the model with it, X's columns moved from the base to the candidates
and its part put back into the residual: no second pass over the rows.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hdev_jax.diagnosis.candidates.candidate import Candidate
from hdev_jax.diagnosis.competition.refit import without
from hdev_jax.diagnosis.competition.state import Found, State
from hdev_jax.diagnosis.gates.gates import alike
from hdev_jax.diagnosis.gates.rejection import Kind, Rejection
from hdev_jax.diagnosis.scores.evidence import Evidence, Score
from hdev_jax.diagnosis.scores.passes import evidence_of
from hdev_jax.diagnosis.scores.scores import Scores, worth
from hdev_jax.diagnosis.training import Training
from hdev_jax.inference import Calibration
from hdev_jax.physics import unavailable

__all__ = ["backward", "can_be_asked", "classes", "model_without", "needed"]


@dataclass(frozen=True)
class Without:
    """The evidence of a model without some of its effects, and those as candidates in it."""

    evidence: Evidence
    each: tuple[Candidate, ...]
    shift: int  # of the other candidates' places

    @property
    def own(self) -> Candidate:
        """The one effect that is out."""
        (own,) = self.each
        return own

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


def model_without(evidence: Evidence, fit: Calibration, *out: Found) -> Without:
    """The model without found effects; their shapes are held where they are."""
    sizes: list[int] = []
    shapes: list[int] = []
    each, nulls = [], []
    for f in out:
        c, prefix = f.score.candidate, f"effects.{f.id}."
        mine = {k: row.path.removeprefix(prefix) for k, row in enumerate(fit.table.free) if row.path.startswith(prefix)}
        own = [k for k, name in mine.items() if name in c.sizes]
        places = tuple(range(len(sizes), len(sizes) + len(own)))
        names, groups = tuple(mine[k] for k in own), tuple(fit.table.free[k].group for k in own)
        each.append(replace(c, sizes=names, groups=groups, columns=places))
        nulls += [c.parameter(n).null for n in names]
        sizes += own
        shapes += [k for k in mine if k not in own]
    values = np.r_[fit.values[sizes] - nulls, np.zeros(len(shapes))]
    freed = evidence.freed([*sizes, *shapes], values)
    assert isinstance(freed, Evidence)
    return Without(freed, tuple(each), len(sizes) + len(shapes))


def needed(evidence: Evidence, fit: Calibration, f: Found) -> Score:
    """A found effect scored beside all that the model has besides."""
    w = model_without(evidence, fit, f)
    return (w.evidence.plain_score if f.score.plain else w.evidence.score)(w.own)


def _has_columns(f: Found) -> bool:
    """Whether it has columns that can be tested: a switch is either there or not."""
    return f.score.candidate.kind == "size"


def can_be_asked(f: Found) -> bool:
    """Whether it can be tested against others: effects with a search of their own are no candidates like others."""
    return _has_columns(f) and not f.score.candidate.effect.searched


def backward(training: Training, state: State, *, newest: bool = False) -> State:
    """The state without effects that are no longer needed beside the others, the weakest removed first.

    The newest has just passed every gate beside the others and is not tested, unless `newest`: the others have changed.
    Beside a term without a name an effect has to be as significant as when it entered, unless it reads the same channel
    (the two may be parts of one cause) or is a constant load. The same holds for a constant load beside a cycle.
    """
    settings = training.settings
    while asked := [f for f in (state.found if newest or state.terms else state.found[:-1]) if _has_columns(f)]:
        evidence = evidence_of(training.baseline(state.fit))
        worst: tuple[float, Found] | None = None
        for f in asked:
            p = needed(evidence, state.fit, f).p
            strictly = _beside_unnamed(state, f) or _beside_cycle(state, f)
            allowed = settings.fdr / _tried(training, state) if strictly else settings.keep
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


def _tried(training: Training, state: State) -> int:
    """How many effects of the library this log can show, as `Scores.level` counts them when one is added."""
    car, row = state.fit.vehicle, training.facts.sample
    return max(1, sum(not unavailable(c, row, car.entry, car.stands_in) for c in training.library.values()))


def _constant(f: Found) -> bool:
    return all(f.score.candidate.parameter(size).constant for size in f.score.candidate.sizes)


def _beside_cycle(state: State, f: Found) -> bool:
    """Whether it is a constant load beside a cycle: the cycle's mean is uncertain, as its duty is."""
    return _constant(f) and any(g.score.candidate.effect.searched == "spectrum" for g in state.found)


def _beside_unnamed(state: State, f: Found) -> bool:
    if _constant(f):  # never gives way to a term without a name
        return False
    c = f.score.candidate
    reads = c.effect.reads()
    return any(not reads & {*t.channels} for t in state.terms)


def classes(scores: Scores, state: State) -> tuple[Found, ...]:
    """The found effects with the classes that they have in the final model.

    An effect that cannot be tested again keeps the class that it had when it was added.
    """
    out = []
    for f in state.found:
        if not can_be_asked(f):
            out.append(f)
            continue
        w = model_without(scores.plain if f.score.plain else scores.white, scores.baseline.fit, f)
        own = (w.evidence.plain_score if f.score.plain else w.evidence.score)(w.own)
        rivals = w.best_ways([c for c in scores.source.candidates if c.id in scores.best], scores)
        out.append(replace(f, alike=alike(w.evidence, w.own, rivals, own.gain, scores, plain=f.score.plain)))
    return tuple(out)
