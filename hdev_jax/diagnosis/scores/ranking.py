"""The best way to have each effect: what is plausible, what it is worth, and how many ways were tried."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from jaxtyping import Float

from hdev_jax.diagnosis.candidates.candidate import Candidate
from hdev_jax.diagnosis.scores.evidence import ABSORBED, Evidence, Score
from hdev_jax.diagnosis.scores.significance import effective_number
from hdev_jax.physics import Parameter

__all__ = ["CLOSE", "LEFT_OUT", "STABLE", "best_of", "inside", "plausible", "without_idle", "worth"]

CERTAIN = 1e-6  # p below which it does not matter how small it is
CLOSE = 0.85  # of what the best is worth, for a candidate to be about as good
LEFT_OUT = 3.0  # least gain in log-likelihood over the clusters left out: chance alone gives about half a unit
STABLE = 0.25  # least share of resampled sets of clusters in which it is chosen again


def plausible(s: Score) -> bool:
    """Signs, ranges and least sizes; a switch has to make about the whole of its difference."""
    c = s.candidate
    if c.kind == "limit":
        first = c.parameter(c.sizes[0])
        size = abs(dict(c.shapes)[first.name] * s.beta[0])
        return bool((0.02 if first.smooth else 0.4) <= s.beta[0] <= 2.5 and size >= first.least)
    each = [(c.parameter(n), b) for n, b in zip(c.sizes, s.beta, strict=True)]
    return all(p.lower <= p.null + b <= p.upper for p, b in each) and any(abs(b) >= p.least for p, b in each)


def without_idle(c: Candidate, beta: Float[np.ndarray, " k"]) -> Candidate | None:
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


def _all_inside(scores: list[Score], again: Callable[[Sequence[Candidate]], list[Score]]) -> list[Score]:
    """Each of one effect's scores `inside`, by worth again where any of them has changed."""
    left = [inside(s, again) for s in scores]
    return left if all(new is old for new, old in zip(left, scores, strict=True)) else _in_order(left)


def worth(gain: float, c: Candidate) -> float:
    """Gain less what its numbers cost: as BIC would for 400 independent rows a size, 20 a shape.

    Rows of a log are not independent, and what differs only between trips has no more of them than trips.
    """
    return gain - 3.0 * len(c.columns) - 1.5 * (c.freedoms - len(c.columns))


def best_of(
    evidence: Evidence, plain: Evidence, candidates: Sequence[Candidate], slow: np.ndarray
) -> tuple[dict[str, Score], dict[str, float]]:
    """The best plausible way to have each effect, and how many independent ways were tried."""
    totals = evidence.totals()
    squares = np.diag(totals[0])[evidence.base : -1]
    there = np.isfinite(squares) & (squares > 1e-20)
    every = [k for c in candidates if (k := c.only(there[list(c.columns)])) is not None]
    ranked: dict[str, list[tuple[float, Candidate]]] = {}
    for c, gain in zip(every, evidence.gains(totals, [c.columns for c in every]), strict=True):
        ranked.setdefault(c.id, []).append((worth(float(gain), c), c))
    leading = {id_: [c for _, c in _leading(entries)] for id_, entries in ranked.items()}
    steady = {
        id_: [c for _, c in entries if c.kind == "size" and slow[list(c.columns)].all()]
        for id_, entries in ranked.items()
    }
    scored = _by_id(leading, evidence.scores([c for cs in leading.values() for c in cs]))
    scored_plain = _by_id(steady, plain.plain_scores([c for cs in steady.values() for c in cs]))
    scored = {id_: _all_inside(scores, evidence.scores) for id_, scores in scored.items()}
    scored_plain = {id_: _in_order(_all_inside(scores, plain.plain_scores)) for id_, scores in scored_plain.items()}
    best, ways = {}, {}
    for id_, entries in ranked.items():
        apart = evidence.projected(np.unique([k for _, c in entries for k in c.columns]))
        ways[id_] = min(float(len(entries)), effective_number(apart))
        looks = [_clearest(scored[id_])]
        if scores := scored_plain[id_]:
            looks.append(_clearest(scores))
        # what both looks see is told by the whitened rows, which see it better
        able = [s for s in looks if plausible(s) and s.left_out_gain > LEFT_OUT] or looks[:1]
        best[id_] = min(able, key=lambda s: (s.p > CERTAIN, s.p if s.p > CERTAIN else 0.0))
    return best, ways


def _by_id(groups: Mapping[str, Sequence[Candidate]], scores: Sequence[Score]) -> dict[str, list[Score]]:
    """Scores of all groups' candidates, one group after the other, by group again."""
    each = iter(scores)
    return {id_: [next(each) for _ in candidates] for id_, candidates in groups.items()}


def _leading(entries: list[tuple[float, Candidate]]) -> list[tuple[float, Candidate]]:
    return sorted(entries, key=lambda e: _falling(e[0]))[:6]


def _in_order(scores: Sequence[Score]) -> list[Score]:
    return sorted(scores, key=lambda s: _falling(worth(s.gain, s.candidate)))


def _falling(worth: float) -> float:
    """For sorting from the best: ways that come to the same but for rounding keep the order of the library's grids.

    A delay of a row by linear and by cubic interpolation is one column, but where a refit starts from differs.
    """
    return -float(f"{worth:.9g}")


def _clearest(scores: list[Score]) -> Score:
    """The first that is plausible, or one that explains about as much with fewer doubts: a second size may blur it.

    A way with a column that the fitted coefficients take up (a gain beside an offset) is one only where all are.
    """
    scores = [s for s in scores if s.left > ABSORBED] or scores
    able = [s for s in scores if plausible(s)]
    if not able or able[0].p <= CERTAIN:
        return (able or scores)[0]
    bar = CLOSE * worth(able[0].gain, able[0].candidate)
    return min((s for s in able if worth(s.gain, s.candidate) >= bar), key=lambda s: s.p, default=able[0])
