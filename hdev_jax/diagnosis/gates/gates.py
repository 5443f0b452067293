"""The gates that a candidate has to pass, in order: those of its score, then those that cost draws.

Each is a function of the candidate's score and of the scores of all, and returns None (passed) or a `Rejection`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float
from scipy import stats

from hdev_jax.diagnosis.candidates.candidate import Candidate
from hdev_jax.diagnosis.gates.rejection import Kind, Rejection
from hdev_jax.diagnosis.scores.evidence import Evidence, Score
from hdev_jax.diagnosis.scores.passes import evidence_of, written_by_chunk
from hdev_jax.diagnosis.scores.scores import Scores, best_ways, plausible, worth
from hdev_jax.diagnosis.scores.significance import least_clusters
from hdev_jax.diagnosis.settings import Settings
from hdev_jax.inference import Chunk

__all__ = ["DRAWN_GATES", "MOST_IN_CLASS", "RESAMPLES", "SCORE_GATES", "Asked", "alike", "first_rejection"]

MOST_IN_CLASS = 2  # members of a class that are listed at most: contract, part 4
RESAMPLES = 100  # sets of clusters: a share to ± 5 points


@dataclass(frozen=True)
class Asked:
    """What a gate looks at: a score among all `scores`, the trips' ids by row, draws, what is `out` in this round, and
    what is `barred`: takes no place any more."""

    score: Score
    scores: Scores
    trip: np.ndarray
    rng: np.random.Generator
    out: frozenset[str] = frozenset()
    barred: frozenset[str] = frozenset()

    @property
    def unit(self) -> str:
        """What a cluster is, in words."""
        return self.scores.baseline.clusters.pieces

    @cached_property
    def stability(self) -> float:
        """Share of resampled sets of clusters in which the same effect, one of its class, or one of more numbers in
        whose class it is, comes first of its kind."""
        return _stability(self)


Gate = Callable[[Asked], Rejection | None]


def _not_absorbed(a: Asked) -> Rejection | None:
    """What a coefficient takes up is no effect of its own; where it is plausible it may be the reason of its value."""
    if not (by := a.scores.absorbed_by.get(a.score.candidate.id)):
        return None
    return Rejection(Kind.ABSORBED, {"by": by, "plausible": plausible(a.score, a.scores.settings)})


def _enough_clusters(a: Asked) -> Rejection | None:
    least, there = least_clusters(len(a.score.beta)), a.scores.white.count
    return Rejection(Kind.TOO_FEW_CLUSTERS, {"least": least, "there": there, "unit": a.unit}) if there < least else None


def _plausible(a: Asked) -> Rejection | None:
    if plausible(a.score, a.scores.settings):
        return None
    return Rejection(Kind.IMPLAUSIBLE, {"sizes": [float(b) for b in a.score.beta]})


def _confirmed(a: Asked) -> Rejection | None:
    gain = a.score.left_out_gain
    if gain > a.scores.settings.ahead:
        return None
    return Rejection(Kind.NOT_CONFIRMED, {"left_out_gain": float(gain), "unit": a.unit})


def _significant(a: Asked) -> Rejection | None:
    q = a.scores.q[a.score.candidate.id]
    return Rejection(Kind.NOT_SIGNIFICANT, {"q": float(q)}) if q > a.scores.settings.fdr else None


def _agreed(a: Asked) -> Rejection | None:
    """Where only clusters count, slow noise looks like a slow cause; generalised least squares find a cause too."""
    s, share = a.score, a.scores.settings.agreed
    if not s.plain:
        return None
    white, sd = a.scores.white.estimate(s.candidate)
    if np.any(np.sign(s.beta) * white + 2.0 * sd >= share * np.abs(s.beta)):
        return None
    return Rejection(Kind.CONTRADICTED, {"share": share})


def _worth_naming(a: Asked) -> Rejection | None:
    """What lowers the RMSE by less than 1 % is not named, by ordinary or by generalised least squares, whichever is
    more: forms of effects are not exact, and a long log makes anything significant. Where slope or speed were read with
    errors, ordinary ones alone decide: the form of those errors' distribution is a part of what the others see. A
    constant load is asked for none: it costs energy all the time, and no variance."""
    if a.score.candidate.constant and not a.scores.inexact:
        return None
    looks = (a.scores.plain,) if a.scores.inexact else (a.scores.plain, a.scores.white)
    columns, least = a.score.candidate.columns, a.scores.settings.least_share
    share = max(e.gain(e.totals(), columns)[0] / max(e.misfit(), 1e-300) for e in looks)
    return Rejection(Kind.SMALL, {"share": float(share), "least": least}) if share < least else None


def _worthwhile(a: Asked) -> Rejection | None:
    worth = a.scores.worth(a.score)
    return Rejection(Kind.OUTSCORED, {"worth": float(worth)}) if worth <= 0 else None


def _beats_placebos(a: Asked) -> Rejection | None:
    """A column that changes inside trips is moved in time by a random amount in each; one that hardly does is given a
    random sign in each trip instead. (Signs are no test of an effect in two or three trips, shifts none of a
    constant.)"""
    s, settings = a.score, a.scores.settings
    column = written_by_chunk(a.scores.baseline, a.scores.source, s.candidate.columns)
    parts = np.split(np.arange(len(column)), np.flatnonzero(np.diff(a.trip)) + 1)
    within = np.concatenate([column[p] - column[p].mean(axis=0) for p in parts])
    if s.plain or np.sum(within**2) < 0.2 * np.sum(column**2):
        signs = a.scores.evidence(s).sign_placebos(s, a.rng, settings.placebos)
        as_good = float(np.mean(signs >= s.gain))
        how = {"how": "its column with random signs by trip", "share": as_good}
        return Rejection(Kind.PLACEBO, how) if as_good > settings.placebo_level else None
    sizes = [len(p) for p in parts]
    shifts = [[int(a.rng.integers(n // 8, max(n - n // 8, 2))) for n in sizes] for _ in range(settings.shifts)]
    k = column.shape[1]

    def shifted(out: np.ndarray, chunk: Chunk) -> None:
        own = column[chunk.at]
        for t, trip in enumerate(chunk.slices(), start=chunk.first_trip):
            for i, by in enumerate(shifts):
                out[trip, i * k : (i + 1) * k] = np.roll(own[trip], by[t], axis=0)

    evidence = evidence_of(a.scores.baseline, len(shifts) * k, shifted)
    totals = evidence.totals()
    before = evidence.base_likelihood(totals)
    best = max(evidence.gain(totals, range(i * k, (i + 1) * k), before)[0] for i in range(len(shifts)))
    return Rejection(Kind.PLACEBO, {"how": "its column shifted in time", "gain": best}) if best >= s.gain else None


def _stable(a: Asked) -> Rejection | None:
    if a.stability >= a.scores.settings.stable:
        return None
    return Rejection(Kind.UNSTABLE, {"percent": 100.0 * a.stability, "unit": a.unit})


SCORE_GATES: tuple[Gate, ...] = (
    _not_absorbed,
    _enough_clusters,
    _plausible,
    _confirmed,
    _significant,
    _agreed,
    _worth_naming,
    _worthwhile,
)
DRAWN_GATES: tuple[Gate, ...] = (_beats_placebos, _stable)


def first_rejection(asked: Asked, gates: Sequence[Gate]) -> Rejection | None:
    """The answer of the first gate that turns the candidate down; None where it passes all."""
    return next((r for gate in gates if (r := gate(asked)) is not None), None)


def alike(
    evidence: Evidence, own: Candidate, rivals: Sequence[Candidate], gain: float, settings: Settings, *,
    plain: bool, inexact: float,
) -> tuple[str, ...]:  # fmt: skip
    """Its class: other effects that, put in its place, explain about as much, the best first.

    Beside such an effect it is not needed; or, where the other has no more free numbers, it adds no more than forms of
    effects are `inexact`. `own` and `rivals` hold places in `evidence`, in which it is not; a rival may come in several
    ways.
    """
    found: dict[str, float] = {}
    totals = evidence.totals()
    before = evidence.base_likelihood(totals)
    for other, score in zip(rivals, (evidence.plain_scores if plain else evidence.scores)(rivals), strict=True):
        if score.left <= settings.absorbed or not plausible(score, settings):
            continue
        if plain:
            rival, beside, more = score.gain, evidence.beside(other.columns, own.columns), np.inf
        else:
            both = tuple(dict.fromkeys((*other.columns, *own.columns)))
            rival = evidence.gain(totals, other.columns, before)[0]
            more = evidence.gain(totals, both, before)[0] - rival
            beside = float(stats.chi2.sf(2 * max(more, 0.0), len(own.columns)))
        close = more < inexact**2 * gain and other.freedoms <= own.freedoms
        if rival > settings.class_share * gain and (beside > settings.wald or close):
            found[other.id] = max(rival, found.get(other.id, -np.inf))
    return tuple(sorted(found, key=lambda id_: -found[id_]))


def _stability(a: Asked) -> float:
    """`Asked.stability`. Its rivals are the candidates with p at most 0.01 before any correction that no joint refit or
    placebo has turned down, without what takes no place any more, unless it is of its class."""
    scores, chosen = a.scores, a.score
    settings, g = scores.settings, scores.white.count
    names = {chosen.candidate.id, *of_class(a)[:MOST_IN_CLASS]}
    out = {*scores.absorbed_by, *a.out, *(a.barred - names)}
    rivals = [
        s for s in scores.best.values()
        if s.plain == chosen.plain and s.p <= 0.01 and s.candidate.id not in out
        and plausible(s, settings) and _worth_naming(replace(a, score=s)) is None
    ]  # fmt: skip
    rivals = [chosen, *sorted((s for s in rivals if s is not chosen), key=lambda s: -s.gain)[:7]]
    # one with more numbers that the chosen one does as well as (a limit at 0 W, with a share) is no rival of it
    names |= {
        s.candidate.id for s in rivals
        if s.candidate.freedoms > chosen.candidate.freedoms
        and alike(
            scores.evidence(s), s.candidate, [chosen.candidate], s.gain, settings, plain=s.plain,
            inexact=settings.inexact,
        )
    }  # fmt: skip
    small = [scores.evidence(s).only([s.candidate]) for s in rivals]
    drawn = np.stack([a.rng.integers(0, g, g) for _ in range(RESAMPLES)])
    gains = np.stack([_gains_of(s, evidence, c, drawn) for s, (evidence, (c,)) in zip(rivals, small, strict=True)])
    worths = gains + np.array([[worth(0.0, s.candidate, settings)] for s in rivals])
    named = np.array([s.candidate.id in names for s in rivals])
    return float(np.mean(named[np.argmax(worths, axis=0)] & (np.max(worths, axis=0) > 0)))


def _gains_of(s: Score, evidence: Evidence, candidate: Candidate, drawn: np.ndarray) -> Float[np.ndarray, " draw"]:
    """Gains of one candidate alone, its columns' places being of this evidence, with these clusters [draw cluster]."""
    if s.plain:
        return np.array([replace(evidence, grams=evidence.grams[d]).plain_gain(candidate.columns) for d in drawn])
    weights = np.stack([np.bincount(d, minlength=evidence.count) for d in drawn]).astype(float)
    return evidence.gains_of_draws(weights, candidate.columns)


def of_class(a: Asked, *, inexact: float | None = None) -> tuple[str, ...]:
    """The class of a candidate that the vehicle does not have yet. `inexact`: by default as set; with 0, only what
    these rows cannot distinguish."""
    s, scores = a.score, a.scores
    out = {s.candidate.id, *scores.absorbed_by}
    rivals = [o.candidate for id_, o in scores.best.items() if id_ not in out and plausible(o, scores.settings)]
    share = scores.settings.inexact if inexact is None else inexact
    if share > 0.0 and not s.plain:
        simple = [c for c in scores.source.candidates if c.id in scores.best and c.id not in out]
        rivals += best_ways(scores.white, [c for c in simple if c.freedoms <= s.candidate.freedoms], scores.settings)
    rivals = list(dict.fromkeys(rivals))
    return alike(scores.evidence(s), s.candidate, rivals, s.gain, scores.settings, plain=s.plain, inexact=share)
