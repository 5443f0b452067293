"""Scores of all candidates at once: the best way to have each, its FDR-adjusted p-value, what the fit absorbs of it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy import stats

from hdev_jax.diagnosis.candidates.candidate import Candidate
from hdev_jax.diagnosis.candidates.plan import Source
from hdev_jax.diagnosis.scores.evidence import Evidence, Score
from hdev_jax.diagnosis.scores.gls import generalised
from hdev_jax.diagnosis.scores.passes import Baseline, both_looks
from hdev_jax.diagnosis.scores.significance import effective_number
from hdev_jax.diagnosis.settings import Settings
from hdev_jax.diagnosis.training import Training
from hdev_jax.inference import Calibration, ParameterTable
from hdev_jax.physics import Parameter
from hdev_jax.segments import READING_ERRORS

__all__ = [
    "CERTAIN",
    "NO_EFFECT",
    "Scores",
    "best_of",
    "best_ways",
    "inside",
    "plausible",
    "score_all",
    "scored",
    "without_idle",
    "worth",
]

NO_EFFECT = "no effect on this log"
CERTAIN = 1e-6  # p below which it does not matter how small it is
LEADING = 6  # ways to have an effect that are tested in full


def plausible(s: Score, settings: Settings) -> bool:
    """Signs, ranges, least sizes, limits in order; a switch has to make about the whole of its difference, and an
    instrument's offset is not a load."""
    c = s.candidate
    shapes = dict(c.shapes)
    if c.kind == "limit":
        first = c.parameter(c.sizes[0])
        size = abs(shapes[first.name] * s.beta[0])
        least = 0.05 * settings.switch_low if first.smooth else settings.switch_low
        return bool(least <= s.beta[0] <= 1.0 / settings.switch_low and size >= first.least)
    each = [(c.parameter(n), b) for n, b in zip(c.sizes, s.beta, strict=True)]
    enough = any if None not in c.groups else all  # a gear may have nothing; a gain of 0 beside an offset is a load
    if c.is_constant_load(dict(zip(c.sizes, s.beta, strict=True))):
        return False
    return all(p.lower <= p.null + b <= p.upper for p, b in each) and enough(abs(b) >= p.least for p, b in each)


def without_idle(c: Candidate, beta: np.ndarray) -> Candidate | None:
    """Without the group whose size is furthest beyond a null that bounds its range: a gear in which nothing drags.

    None where no size is, or where it cannot go by itself. A size beyond another bound stays, and is not plausible.
    """
    past = [_past_null(c.parameter(n), b) for n, b in zip(c.sizes, beta, strict=True)]
    return c.only(np.arange(len(past)) != int(np.argmax(past))) if c.kind == "size" and max(past) > 0.0 else None


def _past_null(p: Parameter, b: float) -> float:
    if p.null not in (p.lower, p.upper):
        return 0.0
    return max(-b if p.null == p.lower else b, 0.0)


def inside(s: Score, scores: Callable[[Sequence[Candidate]], list[Score]]) -> Score:
    """The score without the groups whose sizes come out beyond a null that bounds their range.

    One after the other, the furthest first; none comes back. What the others explain is χ² of their own number, given
    that these went (the conditional form of the chi-bar-square test: Wollan and Dykstra, 1986).
    """
    while (fewer := without_idle(s.candidate, s.beta)) is not None:
        (s,) = scores([fewer])
    return s


def worth(gain: float, c: Candidate, settings: Settings) -> float:
    """Gain in log-likelihood less what its numbers cost.

    Rows of a log are not independent, and what differs only between trips has no more of them than trips.
    """
    return gain - settings.size_cost * len(c.columns) - settings.shape_cost * (c.freedoms - len(c.columns))


def best_ways(evidence: Evidence, candidates: Sequence[Candidate], settings: Settings) -> list[Candidate]:
    """Of each effect the way that is worth most; candidates hold places in `evidence`."""
    best: dict[str, tuple[float, Candidate]] = {}
    gains = evidence.gains(evidence.totals(), [c.columns for c in candidates])
    for c, gain in zip(candidates, gains, strict=True):
        value = worth(float(gain), c, settings)
        if np.isfinite(value) and (c.id not in best or value > best[c.id][0]):
            best[c.id] = (value, c)
    return [c for _, c in best.values()]


@dataclass
class Scores:
    """The scores of all candidates, from where the vehicle stands.

    `white` and `plain` are the evidence by generalised and by ordinary least squares; `slow` says which columns hardly
    change inside a trip; `best` is the best form of each effect, `ways` in how many independent forms it was tried;
    `absorbs` lists by coefficient the effects that cannot be distinguished from it, `absorbed_by` the reverse.
    """

    white: Evidence
    plain: Evidence
    baseline: Baseline
    source: Source
    settings: Settings
    slow: np.ndarray
    best: dict[str, Score]
    ways: dict[str, float]
    left_out: dict[str, str]
    absorbs: dict[str, list[str]]
    absorbed_by: dict[str, str]
    q: dict[str, float] = field(init=False)

    def __post_init__(self) -> None:
        self._adjust()

    def _adjust(self) -> None:
        every = [1.0 if k in self.absorbed_by else min(1.0, s.p * self.ways[k]) for k, s in self.best.items()]
        self.q = dict(zip(self.best, map(float, stats.false_discovery_control(every)), strict=True))

    @cached_property
    def inexact(self) -> bool:
        """Whether slope or speed were read with errors that matter."""
        return any(next(iter(self.baseline.chunks())).segments.has(k) for k in READING_ERRORS)

    def replaced(self, s: Score) -> None:
        """Have an effect in another way than the one that looked best, and adjust every p-value again."""
        self.best[s.candidate.id] = s
        self._adjust()

    def evidence(self, s: Score) -> Evidence:
        """The evidence that a score is of."""
        return self.plain if s.plain else self.white

    def again(self, s: Score) -> Callable[[Sequence[Candidate]], list[Score]]:
        """The tests that a score is made by."""
        return self.plain.plain_scores if s.plain else self.white.scores

    def worth(self, s: Score) -> float:
        """What a score's gain is worth."""
        return worth(s.gain, s.candidate, self.settings)

    def between(self, candidate: Candidate) -> bool:
        """Whether its columns hardly change inside a trip: it differs between trips alone."""
        return bool(self.slow[list(candidate.columns)].all())

    def level(self, id_: str) -> float:
        """What a p-value of one test has to be, by Bonferroni over the library and the ways to have the effect."""
        return self.settings.fdr / (len(self.best) * self.ways[id_])


def score_all(training: Training, fit: Calibration, made: Source | None = None) -> Scores:
    """Score everything in one pass: the library's effects, or candidates `made` elsewhere."""
    baseline = training.baseline(fit)
    known, _ = generalised(baseline)
    source = made or training.plan(known.vehicle, list(training.library.values()))
    return scored(replace(baseline, fit=known), source, training.settings)


def scored(baseline: Baseline, source: Source, settings: Settings) -> Scores:
    """Every candidate of the source scored in one pass over the log's chunks."""
    white, plain, slow = both_looks(baseline, source)
    best, ways = best_of(white, plain, source.candidates, slow, settings)
    left_out = dict(source.left_out)
    for id_ in sorted({c.id for c in source.candidates} - set(best)):
        left_out[id_] = NO_EFFECT
    absorbs, absorbed_by = _absorption(white, baseline.fit.table, best, source.candidates, settings)
    return Scores(white, plain, baseline, source, settings, slow, best, ways, left_out, absorbs, absorbed_by)


def best_of(
    white: Evidence, plain: Evidence, candidates: Sequence[Candidate], slow: np.ndarray, settings: Settings
) -> tuple[dict[str, Score], dict[str, float]]:
    """The best plausible way to have each effect, and how many independent ways were tried."""
    totals = white.totals()
    squares = np.diag(totals[0])[white.base : -1]
    there = np.isfinite(squares) & (squares > 1e-20)
    every = [k for c in candidates if (k := c.only(there[list(c.columns)])) is not None]
    ranked: dict[str, list[tuple[float, Candidate]]] = {}
    for c, gain in zip(every, white.gains(totals, [c.columns for c in every]), strict=True):
        ranked.setdefault(c.id, []).append((worth(float(gain), c, settings), c))
    leading = {
        id_: [c for _, c in sorted(entries, key=lambda e: -_rounded(e[0]))[:LEADING]] for id_, entries in ranked.items()
    }
    steady = {
        id_: [c for _, c in entries if c.kind == "size" and slow[list(c.columns)].all()]
        for id_, entries in ranked.items()
    }
    by_rows = _by_id(leading, white.scores([c for cs in leading.values() for c in cs]))
    by_trips = _by_id(steady, plain.plain_scores([c for cs in steady.values() for c in cs]))
    by_rows = {id_: _all_inside(scores, white.scores, settings) for id_, scores in by_rows.items()}
    by_trips = {
        id_: _in_order(_all_inside(scores, plain.plain_scores, settings), settings) for id_, scores in by_trips.items()
    }
    best, ways = {}, {}
    for id_, entries in ranked.items():
        apart = white.projected(np.unique([k for _, c in entries for k in c.columns]))
        ways[id_] = min(float(len(entries)), effective_number(apart))
        looks = [_clearest(by_rows[id_], settings)]
        if scores := by_trips[id_]:
            looks.append(_clearest(scores, settings))
            ways[id_] *= 2.0  # both ordinary and generalised least squares are tried
        # where both show it, generalised least squares estimate it better
        able = [s for s in looks if plausible(s, settings) and s.left_out_gain > settings.ahead] or looks[:1]
        best[id_] = min(able, key=lambda s: (s.p > CERTAIN, s.p if s.p > CERTAIN else 0.0))
    return best, ways


def _by_id(groups: Mapping[str, Sequence[Candidate]], scores: Sequence[Score]) -> dict[str, list[Score]]:
    """Scores of all groups' candidates, one group after the other, by group again."""
    each = iter(scores)
    return {id_: [next(each) for _ in candidates] for id_, candidates in groups.items()}


def _all_inside(
    scores: list[Score], again: Callable[[Sequence[Candidate]], list[Score]], settings: Settings
) -> list[Score]:
    """Each of one effect's scores `inside`, by worth again where any of them has changed."""
    left = [inside(s, again) for s in scores]
    return left if all(new is old for new, old in zip(left, scores, strict=True)) else _in_order(left, settings)


def _in_order(scores: Sequence[Score], settings: Settings) -> list[Score]:
    return sorted(scores, key=lambda s: -_rounded(worth(s.gain, s.candidate, settings)))


def _rounded(value: float) -> float:
    """For sorting: ways that come to the same but for rounding keep the order of the library's grids.

    A delay of a row by linear and by cubic interpolation is one column, but where a refit starts from differs.
    """
    return float(f"{value:.6g}")


def _clearest(scores: list[Score], settings: Settings) -> Score:
    """The first that is plausible, or one that explains about as much with fewer doubts: a second size may blur it.

    A way with a column that the fitted coefficients take up (a gain beside an offset) is one only where all are.
    """
    scores = [s for s in scores if s.left > settings.absorbed] or scores
    able = [s for s in scores if plausible(s, settings)]
    if not able or able[0].p <= CERTAIN:
        return (able or scores)[0]
    bar = settings.close * worth(able[0].gain, able[0].candidate, settings)
    close = (s for s in able if worth(s.gain, s.candidate, settings) >= bar)
    return min(close, key=lambda s: _rounded(s.p), default=able[0])


def _absorption(
    white: Evidence, table: ParameterTable, best: dict[str, Score], candidates: Sequence[Candidate], settings: Settings
) -> tuple[dict[str, list[str]], dict[str, str]]:
    """Which candidates lie in the span of the fitted coefficients, and of which one mostly.

    Of an effect with several sizes one may: a gain, though not the offset beside it. A coefficient may have absorbed
    that effect too, which by its other ways can still be found. An effect that is a coefficient under another name
    (`Effect.same_as`) is in it whatever the rows say: what distinguishes them is the model's error.
    """
    names = [c.name for c in table.free]
    absorbs: dict[str, list[str]] = {n: [] for n in names}
    by: dict[str, str] = {}
    if not names:
        return absorbs, by
    for id_, s in best.items():
        if same := [c.name for c in table.free if c.path in s.candidate.effect.same_as]:
            absorbs[same[0]].append(id_)
            by[id_] = same[0]
    plainest = [c for c in candidates if c.kind == "size" and c.id in best and c.freedoms == len(c.columns) == 1]
    for c in [*(s.candidate for s in best.values() if s.left <= settings.absorbed), *plainest]:
        left, weights = min((white.span(k) for k in c.columns), key=lambda x: x[0])
        if left > settings.absorbed or any(c.id in ids for ids in absorbs.values()):
            continue
        name = names[int(np.argmax(np.abs(weights)))]
        absorbs[name].append(c.id)
        if best[c.id].left <= settings.absorbed:
            by[c.id] = name
    return absorbs, by
