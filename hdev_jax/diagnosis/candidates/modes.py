"""A coefficient with a second value in some trips: which trips is sought by how each of them differs from the rest.

Trips are sorted by the size that each asks for alone, and split in two where that explains most. It is a mode where
two values are enough: levels that differ from trip to trip at random are not two, and stay levels. And it is a
mode of that coefficient where its second value says more than the whole power times a number in the same trips: a gain
of the power's sensor or another mass, in those trips, makes every coefficient look as if it had a second value.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy import stats

from hdev_jax.diagnosis.candidates.candidate import Candidate, plan_of
from hdev_jax.diagnosis.competition.refit import joined
from hdev_jax.diagnosis.scores.chunks import Chunk
from hdev_jax.diagnosis.scores.evidence import Score
from hdev_jax.diagnosis.scores.look import Found, Loop, Search, Verdict, barred
from hdev_jax.diagnosis.scores.ranking import LEFT_OUT
from hdev_jax.diagnosis.scores.significance import wald
from hdev_jax.diagnosis.scores.sums import evidence_of
from hdev_jax.inference import Clusters, predict
from hdev_jax.physics.battery import ModeChange, StepChange
from hdev_jax.segments import trip_slices

__all__ = ["add_mode"]

ID = ModeChange.id
LASTING = {name for sizes in StepChange.variants for name in sizes}  # what a change for good is sought of
LEAST_TRIPS = 8  # with fewer, any trips fall into two groups
LEAST_SIDE = 2  # trips of either mode
ENOUGH = 0.01  # p from which on two values leave trips that differ still
RANDOM = (0.0, 0.03, 0.1, 0.2, 0.35, 0.5, 0.7, 1.0, 1.4, 2.0)  # variances of random levels, over the sizes' own
BEATS = 3.0  # in log-likelihood, that two values are better than levels at random, or than the power as a whole
LEAST_SHARE = 0.02  # of the residual's variance
RESAMPLES, MOST_SPLITS = 100, 4000  # resampled sets of trips; fewer of them where many trips have many splits each

Grams = Float[np.ndarray, "trip d d"]
Every = Float[np.ndarray, "coefficient trip d d"]
Split = tuple[float, np.ndarray, float, float, float]


def add_mode(problem: Loop, state: Search) -> tuple[Search | None, Verdict | None]:
    """The state with a mode of some trips added and refitted, or a verdict on why it is not; neither where no trip's
    mode could be told."""
    if (why := barred(problem, state, ModeChange)) is not None:
        return None, Verdict(ID, None, 1.0, why) if why else None
    slices = [s for _, s in trip_slices(problem.trip)]
    if len(slices) < LEAST_TRIPS:
        return None, Verdict(ID, None, 1.0, f"needs {LEAST_TRIPS} trips to fall into two groups")
    ids = np.concatenate([np.full(s.stop - s.start, k) for k, s in enumerate(slices)])
    noise = problem.noise(state.fit)
    ground = replace(
        problem.ground(state.fit, replace(noise, level_sd=0.0)), clusters=Clusters(ids, len(slices), "trip")
    )
    on = {"in_mode": (1.0,), "share": (0.5,)}
    plan = plan_of(state.fit.vehicle, [ModeChange], problem.facts, problem.target, on, searched=True)

    def write(out: np.ndarray, chunk: Chunk) -> None:
        plan.write(out[:, :-1], chunk.segments)
        out[:, -1] = np.nan_to_num(np.asarray(predict(state.fit.vehicle, chunk.segments, problem.target)))

    evidence = evidence_of(ground, plan.width + 1, write)
    base, last = np.arange(evidence.base), evidence.grams.shape[-1] - 1
    columns = [*(c.columns[0] for c in plan.candidates), plan.width]
    places = [np.r_[base, evidence.base + k, last] for k in columns]
    *each, power = (evidence.grams[:, at[:, None], at[None, :]] for at in places)
    every = np.stack(each)
    prior, level = (np.diag(evidence.precision), evidence.pull), problem.fdr / len(problem.effects)
    lasting = [set(c.sizes) <= LASTING for c in plan.candidates]
    best = _best(every, *prior)
    if best is None:
        return None, Verdict(ID, None, 1.0, "no trip tells of it")
    k, (gain, z, size, *_) = best
    c, p = plan.candidates[k], _p(gain, len(slices), len(every))
    q = min(1.0, p * len(problem.effects))
    if (why := _against(best[1], lasting[k], len(every), level)) is not None:
        return None, Verdict(ID, gain, q, why)
    if _gain(power, *prior, z) > gain - BEATS:
        return None, Verdict(
            ID, gain, q, "in those trips the power as a whole says as much, not this coefficient alone"
        )
    left_out, p_cluster = _left_out(every[k], *prior, z)
    if left_out <= LEFT_OUT or p_cluster > problem.fdr:
        return None, Verdict(ID, gain, q, "does not lower the error on trips left out of the fit")
    names = [int(problem.trip[s.start]) for s in slices]
    chosen = tuple((f"in_mode[{t}]", float(x)) for t, x in zip(names, z, strict=True))
    seconds = np.array([np.sum(problem.seconds[s]) for s in slices])
    share = float(z @ seconds / np.sum(seconds))
    candidate = Candidate(ModeChange, c.sizes, (None,), (("share", share), *chosen), "size", ())
    score = Score(candidate, np.array([size]), gain, p, p_cluster, left_out, 1.0)
    new = joined(problem, state, score, noise) or joined(problem, state, score)
    before = float(np.mean((problem.measured - state.fit.predicted) ** 2))
    if new is None or before - float(np.mean((problem.measured - new.fit.predicted) ** 2)) < LEAST_SHARE * before:
        return None, Verdict(ID, gain, q, "in the joint refit it is out of range or not told from nothing")
    # told, not asked for: two trips of eight are both in a resampled set in four of ten
    stability = _stability(every, lasting, *prior, level, problem.rng.spawn(1)[0])
    found = Found(ID, score, q, stability, (), gain)
    return replace(new, found=[*state.found, found]), None


def _solved(a: np.ndarray, b: np.ndarray) -> tuple[float, np.ndarray]:
    """Gain in log-likelihood and coefficients of normal equations that may be singular."""
    d = np.sqrt(np.maximum(np.diag(a), 1e-300))
    x = np.linalg.pinv(a / np.outer(d, d), rcond=1e-9, hermitian=True) @ (b / d) / d
    return 0.5 * float(b @ x), x


def _with_mode(
    a: np.ndarray, b: np.ndarray, cross: np.ndarray, square: float, told: float
) -> tuple[np.ndarray, np.ndarray]:
    """Normal equations of the common coefficients and one more column."""
    return np.block([[a, cross[:, None]], [cross[None], np.array([[square]])]]), np.r_[b, told]


def _gain(grams: Grams, precision: np.ndarray, pull: np.ndarray, z: np.ndarray) -> float:
    """Gain in log-likelihood of the column in the trips `z`, beside the common coefficients."""
    base, total = len(pull), grams.sum(axis=0)
    a, b = total[:base, :base] + precision, total[:base, base + 1] - pull
    mode = z @ grams[:, :base, base], float(z @ grams[:, base, base]), float(z @ grams[:, base, base + 1])
    return _solved(*_with_mode(a, b, *mode))[0] - _solved(a, b)[0]


def _p(gain: float, trips: int, coefficients: int) -> float:
    """p of a split: every way to split the trips in two counts, and every coefficient that may have a second value."""
    ways = (trips - 1) * np.log(2.0) + np.log(coefficients)
    return float(np.exp(min(stats.chi2.logsf(2.0 * gain, 1) + ways, 0.0)))


def _best(every: Every, precision: np.ndarray, pull: np.ndarray) -> tuple[int, Split] | None:
    """Which coefficient's split of the trips gains most, and the split."""
    splits = [(k, split) for k, grams in enumerate(every) if (split := _split(grams, precision, pull)) is not None]
    return max(splits, key=lambda s: s[1][0], default=None)


def _against(split: Split, lasting: bool, coefficients: int, level: float) -> str | None:
    """Why a split is no mode, its p to be no larger than `level`; or None.

    `lasting`: whether a change of the coefficient for good is an effect of its own. One of its trips that follow each
    other is left to that; of what has no such effect they are a mode like any other.
    """
    gain, z, _, left, over_levels = split
    if (p := _p(gain, len(z), coefficients)) > level:
        return f"trips do not fall into two groups (p = {p:.2g})"
    if stats.chi2.sf(2.0 * left, len(z) - 2) < ENOUGH or over_levels < BEATS:
        return "trips differ, but two values are not enough for them"
    return "a change that stays from one trip on says as much" if lasting and _ordered(z) else None


def _split(grams: Grams, precision: np.ndarray, pull: np.ndarray) -> Split | None:
    """Gain of the best split of the trips in two, the trips of the second mode, its size, what more one value for
    each trip would gain, and how much better two values are than levels that differ at random; None where no trip has
    the column."""
    n, base = len(grams), len(pull)
    cross, square, told = grams[:, :base, base], grams[:, base, base], grams[:, base, base + 1]
    if np.count_nonzero(square > 1e-20) < LEAST_TRIPS:
        return None
    total = grams.sum(axis=0)
    a, b = total[:base, :base] + precision, total[:base, base + 1] - pull
    alone, _ = _solved(a, b)
    # one value for each trip beside the common coefficients
    every, x = _solved(np.block([[a, cross.T], [cross, np.diag(square)]]), np.r_[b, told])
    order = np.argsort(x[base:])
    best: tuple[float, np.ndarray, float] | None = None
    for k in range(LEAST_SIDE, n - LEAST_SIDE + 1):
        z = np.zeros(n)
        z[order[k:] if n - k <= k else order[:k]] = 1.0  # the rarer mode is the second
        gain, y = _solved(*_with_mode(a, b, z @ cross, z @ square, z @ told))  # pyright: ignore[reportArgumentType]
        if best is None or gain > best[0]:
            best = gain, z, float(y[-1])
    assert best is not None
    better = _over_levels(x[base:], np.maximum(square, 1e-300), best[1])
    return best[0] - alone, best[1], best[2], max(every - best[0], 0.0), better


def _over_levels(x: np.ndarray, precision: np.ndarray, z: np.ndarray) -> float:
    """Log-likelihood of trips' sizes with two values, less that with normal levels of the variance that suits them."""

    def likelihood(group: np.ndarray, variance: float) -> float:
        total = variance + 1.0 / precision[group]
        mean = float(np.sum(x[group] / total) / np.sum(1.0 / total))
        return -0.5 * float(np.sum((x[group] - mean) ** 2 / total + np.log(total)))

    # which trip is in which mode was chosen: each choice costs what a coin would
    two = likelihood(z > 0, 0.0) + likelihood(z == 0, 0.0) - len(z) * float(np.log(2.0))
    spread = float(np.var(x)) + 1e-300
    return two - max(likelihood(z >= 0, v * spread) for v in RANDOM)


def _ordered(z: np.ndarray) -> bool:
    """Whether the second mode is all trips from one on, or all before it."""
    return int(np.count_nonzero(np.diff(z))) <= 1


def _left_out(grams: Grams, precision: np.ndarray, pull: np.ndarray, z: np.ndarray) -> tuple[float, float]:
    """Gain in log-likelihood over trips left out of the fit in turn, and p of the size with these clusters.

    Which mode a trip is in that was left out is not known beforehand: either is as likely as it is among the others.
    """
    n, base = len(grams), len(pull)
    cross, square, told = grams[:, :base, base], grams[:, base, base], grams[:, base, base + 1]
    inner, right = grams[:, :base, :base], grams[:, :base, base + 1]

    def fitted(times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        a, b = np.tensordot(times, inner, axes=1) + precision, times @ right - pull
        on = times * z
        return _solved(a, b)[1], _solved(*_with_mode(a, b, on @ cross, on @ square, on @ told))[1]  # pyright: ignore[reportArgumentType]

    def likelihood(t: int, x: np.ndarray, size: float) -> float:
        quadratic = x @ inner[t] @ x + 2.0 * size * float(x @ cross[t]) + size**2 * square[t]
        return float(x @ right[t] + size * told[t] - 0.5 * quadratic)

    gain, sizes = 0.0, []
    for t in range(n):
        others = (np.arange(n) != t).astype(float)
        without, (*x, size) = fitted(others)
        share, x = float(others @ z) / (n - 1), np.array(x)
        off, on = likelihood(t, x, 0.0) + np.log1p(-share), likelihood(t, x, size) + np.log(share)
        gain += float(np.logaddexp(off, on)) - likelihood(t, without, 0.0)
        sizes.append([size])
    return gain, float(wald(fitted(np.ones(n))[1][-1:], np.array(sizes)))


def _stability(
    every: Every, lasting: Sequence[bool], precision: np.ndarray, pull: np.ndarray, level: float,
    rng: np.random.Generator,
) -> float:  # fmt: skip
    """Share of resampled sets of trips that fall into two modes again, whichever trips they are then."""
    n = every.shape[1]
    draws, hits = int(np.clip(MOST_SPLITS // n, 10, RESAMPLES)), 0
    for _ in range(draws):
        drawn = np.sort(rng.integers(0, n, n))
        best = _best(every[:, drawn], precision, pull)
        if best is not None and _against(best[1], lasting[best[0]], len(every), level) is None:
            in_mode = best[1][1] > 0
            hits += min(len(np.unique(drawn[in_mode])), len(np.unique(drawn[~in_mode]))) >= LEAST_SIDE
    return hits / draws
