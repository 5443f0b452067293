"""Is X significant given Y? One question: in the backward step, in exchanges, for classes, and beside unnamed terms.

The equations of the model without X are those of the model with it, X's columns moved from the base to the candidates
and its part put back into the residual: no second pass over the rows.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from hdev_jax.diagnosis.candidates.candidate import Candidate
from hdev_jax.diagnosis.competition.refit import as_reported, gained, in_range, large_enough, without
from hdev_jax.diagnosis.competition.state import Found, State
from hdev_jax.diagnosis.gates.gates import alike
from hdev_jax.diagnosis.gates.rejection import Kind, Rejection
from hdev_jax.diagnosis.scores.evidence import Evidence, Score
from hdev_jax.diagnosis.scores.passes import evidence_of
from hdev_jax.diagnosis.scores.scores import Scores, best_ways, worth
from hdev_jax.diagnosis.settings import Settings
from hdev_jax.diagnosis.training import Training
from hdev_jax.inference import Calibration
from hdev_jax.physics import unavailable

__all__ = [
    "backward", "can_be_asked", "classes", "model_without", "needed", "without_far", "without_idle_switches",
    "without_unclear",
]  # fmt: skip


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
    """The state without effects that have become too small to name, or are no longer needed beside the others, the
    weakest removed first.

    The newest has just passed every gate beside the others: unless `newest` (the others have changed) it is only asked
    whether it is one of a class with one of them.
    Beside a term without a name an effect has to be as significant as when it entered, unless it reads the same channel
    (the two may be parts of one cause) or is a constant load. The same holds for a constant load beside a cycle.
    """
    while asked := [f for f in state.found if _has_columns(f)]:
        small = [f for f in asked if not large_enough(state.fit, f.score.candidate)]
        drop, turned = (small[0], False) if small else _weakest(training, state, asked, newest=newest)
        if drop is None:
            break
        beside = "a term without a name" if _beside_unnamed(state, drop) else "effects added later"
        state = without(training, state, drop.id)
        times = state.removed[drop.id].numbers["times"] + 1 if drop.id in state.removed else 1
        why = Rejection(Kind.SUPERFLUOUS, {"beside": beside, "times": times})
        if small or turned:
            why = Rejection(Kind.IMPLAUSIBLE if small else Kind.OPPOSITE, {"times": times})
        state = replace(state, removed={**state.removed, drop.id: why})
    return state


def _weakest(
    training: Training, state: State, asked: Sequence[Found], *, newest: bool
) -> tuple[Found | None, bool]:  # fmt: skip
    """The effect that is least needed beside all others, None where each is needed; and whether it is fitted with the
    other sign than it has in its test."""
    settings = training.settings
    evidence = evidence_of(training.baseline(state.fit))
    worst: tuple[tuple[float, bool], Found, bool] | None = None
    for f in asked:
        p, turned = _p_beside(evidence, state, f, settings, old=newest or bool(state.terms) or f is not state.found[-1])
        strictly = _beside_unnamed(state, f) or _beside_cycle(state, f)
        allowed = settings.fdr / _tried(training, state) if strictly else settings.stays
        rank = (p / allowed, f.score.candidate.effect.stage == "sensors")
        if p > allowed and (worst is None or rank >= worst[0]):
            worst = (rank, f, turned)
    return worst[1:] if worst else (None, False)


def without_idle_switches(training: Training, state: State, scores: Scores) -> State:
    """The state without switches (a limit, a delay) that are not worth their numbers beside what was added later: a
    limit that is never reached any more. Only a refit can show it, so this is asked at the end."""
    for f in [f for f in state.found if not _has_columns(f) and not f.score.candidate.effect.searched]:
        c, at = f.score.candidate, _places(state.fit, f)
        if c.parameter(c.sizes[0]).smooth and np.any(
            np.abs(state.fit.values[at]) > training.settings.stands * state.fit.errors[at]
        ):
            continue  # a delay that is clearly more than nothing needs no refit
        less = without(training, state, f.id)
        lost = gained(training, state.fit, scores) - gained(training, less.fit, scores)
        if worth(lost, c, training.settings) <= 0.0:
            why = Rejection(Kind.SUPERFLUOUS, {"beside": "effects added later", "times": 2})
            state = replace(less, removed={**less.removed, f.id: why})
    return state


def without_far(training: Training, state: State, declared: Calibration) -> State:
    """The state without the effect that drives a declared coefficient far from its table, further than it was in the
    declared model: the most likely reason is that it stands for another one. Asked at the end, for on the way there a
    coefficient may hold what is not in the model yet."""
    limit = {
        c.name: max(training.settings.moved, abs(float(z)))
        for c, z in zip(declared.table.free, declared.prior_z(), strict=True) if np.isfinite(z)
    }  # fmt: skip

    def far(fit: Calibration) -> dict[str, float]:
        each = zip(fit.table.free, fit.prior_z(), strict=True)
        return {c.name: float(z) for c, z in each if abs(z) > limit.get(c.name, np.inf)}

    if not (now := far(state.fit)):
        return state
    name = max(now, key=lambda k: abs(now[k]))
    able = [f for f in state.found if not f.score.candidate.effect.searched]
    each = [(f, less) for f in able if not far((less := without(training, state, f.id)).fit)]
    if not each:
        return state
    z = [abs(dict(zip((c.name for c in s.fit.table.free), s.fit.prior_z(), strict=True))[name]) for _, s in each]
    f, less = each[int(np.argmin(z))]  # the one that moves it most
    return replace(
        less, removed={**less.removed, f.id: Rejection(Kind.FAR, {"name": name, "z": now[name], "times": 2})}
    )


def without_unclear(training: Training, state: State) -> State:
    """The state without effects none of whose sizes is distinguished from nothing by its 90 % interval as a report
    would show it: by generalised least squares where these fit (all are significant then), else as it is fitted."""
    quantile = float(stats.t.ppf(0.95, max(training.clusters.count - 1, 1)))
    while state.found and as_reported(training, state) is state.fit:
        unclear: dict[float, Found] = {}
        for f in [f for f in state.found if can_be_asked(f)]:
            at, c = _places(state.fit, f), f.score.candidate
            nulls = [c.parameter(state.fit.table.free[k].path.rpartition(".")[2]).null for k in at]
            t = float(np.max(np.abs(state.fit.values[at] - nulls) / np.maximum(state.fit.errors[at], 1e-300)))
            if t < quantile:
                unclear[t] = f
        if not unclear:
            break
        f = unclear[min(unclear)]
        why = Rejection(Kind.REFIT, {"times": 2})
        state = replace(without(training, state, f.id), removed={**state.removed, f.id: why})
    return state


def _p_beside(evidence: Evidence, state: State, f: Found, settings: Settings, *, old: bool) -> tuple[float, bool]:
    """p-value of a found effect beside all others, and whether it is fitted with the other sign than it has there: 1
    then, where it is not confirmed by cross-validation there, or where it is one of a class with one of them. The
    newest (not `old`) has been tested already but for the last."""
    if any(_doubles(evidence, state, f, g, settings) for g in state.found if g is not f):
        return 1.0, False
    if not old:
        return 0.0, False
    own = needed(evidence, state.fit, f)
    c = f.score.candidate
    now = state.fit.values[_places(state.fit, f)] - np.array([c.parameter(n).null for n in own.candidate.sizes])
    turned = bool(np.all(now * own.beta < 0.0))
    stands = own.left_out_gain > 0.0 and in_range(state.fit, c) and not turned
    return (own.p if stands else 1.0), turned and own.p <= settings.stays


def _doubles(evidence: Evidence, state: State, f: Found, g: Found, settings: Settings) -> bool:
    """Whether two found effects are one class, of which `f` is the one to go: the mass or an instrument before a cause
    in the vehicle, else the one that explains less by itself."""
    if not (can_be_asked(f) and can_be_asked(g)) or f.score.plain or g.score.plain:
        return False
    if not _correlation(state.fit, f, g) > settings.correlated:
        return False
    w = model_without(evidence, state.fit, f, g)
    totals, (own, other) = w.evidence.totals(), w.each
    before = w.evidence.base_likelihood(totals)
    mine, its = (w.evidence.gain(totals, c.columns, before)[0] for c in w.each)
    if (own.effect.stage == "sensors", -mine) < (other.effect.stage == "sensors", -its):
        return False
    return other.id in alike(w.evidence, own, [other], mine, settings, plain=False, inexact=settings.inexact)


def _places(fit: Calibration, f: Found) -> list[int]:
    """Where the sizes of a found effect are among the free coefficients."""
    paths = {f"effects.{f.id}.{n}" for n in f.score.candidate.sizes}
    return [k for k, c in enumerate(fit.table.free) if c.path in paths]


def _correlation(fit: Calibration, f: Found, g: Found) -> float:
    """The largest one between the sizes of two effects: those of one class are correlated, as their columns are."""
    sd = np.sqrt(np.maximum(np.diag(fit.covariance), 1e-300))
    both = np.ix_(_places(fit, f), _places(fit, g))
    return float(np.max(np.abs(fit.covariance[both] / np.outer(sd, sd)[both]), initial=0.0))


def _tried(training: Training, state: State) -> int:
    """How many effects of the library this log can show, as `Scores.level` counts them when one is added."""
    car, row = state.fit.vehicle, training.facts.sample
    return max(1, sum(not unavailable(c, row, car.entry, car.stands_in) for c in training.library.values()))


def _beside_cycle(state: State, f: Found) -> bool:
    """Whether it is a constant load beside a cycle: the cycle's mean is uncertain, as its duty is."""
    return f.score.candidate.constant and any(g.score.candidate.effect.searched == "spectrum" for g in state.found)


def _beside_unnamed(state: State, f: Found) -> bool:
    if f.score.candidate.constant:  # never gives way to a term without a name
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
        # beside the effect another way of a rival may have looked best
        ways = w.rivals([c for c in scores.source.candidates if c.id in scores.best])
        simple = [c for c in ways if c.freedoms <= w.own.freedoms]
        rivals = [c for some in (ways, simple) for c in best_ways(w.evidence, some, scores.settings)]
        settings = scores.settings
        members = alike(
            w.evidence, w.own, list(dict.fromkeys(rivals)), own.gain, settings, plain=f.score.plain,
            inexact=settings.inexact,
        )  # fmt: skip
        out.append(replace(f, alike=members))
    return tuple(out)
