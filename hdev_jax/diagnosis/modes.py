"""A coefficient with a second value in some trips: which trips is sought by how each of them differs from the rest.

Trips are sorted by the size that each asks for alone, and split in two where that explains most. It is a mode where
two values are enough: levels that differ from trip to trip at random are not two, and stay levels.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy import stats

from hdev_jax.diagnosis.candidates import Candidate, plan_of
from hdev_jax.diagnosis.evidence import Score
from hdev_jax.diagnosis.look import Found, Loop, Search, Verdict, barred
from hdev_jax.diagnosis.refit import joined
from hdev_jax.diagnosis.sums import evidence_of
from hdev_jax.inference import Clusters
from hdev_jax.physics.battery import ModeChange
from hdev_jax.segments import trip_slices

__all__ = ["add_mode"]

ID = ModeChange.id
LEAST_TRIPS = 8  # with fewer, any trips fall into two groups
LEAST_SIDE = 2  # trips of either mode
ENOUGH = 0.01  # p from which on two values leave trips that differ still
RANDOM = (0.0, 0.03, 0.1, 0.2, 0.35, 0.5, 0.7, 1.0, 1.4, 2.0)  # variances of random levels, over the sizes' own
BEATS = 3.0  # in log-likelihood, that two values are better than levels that differ at random
LEAST_SHARE = 0.02  # of the residual's variance
RESAMPLES = 100

Grams = Float[np.ndarray, "trip d d"]


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
    evidence = evidence_of(ground, plan.width, lambda out, chunk: plan.write(out, chunk.segments))
    base, best = evidence.base, None
    for c in plan.candidates:
        at = np.r_[np.arange(base), base + c.columns[0], evidence.grams.shape[-1] - 1]
        split = _split(evidence.grams[:, at[:, None], at[None, :]], np.diag(evidence.precision), evidence.pull)
        if split is not None and (best is None or split[0] > best[1][0]):
            best = c, split
    if best is None:
        return None, Verdict(ID, None, 1.0, "no trip tells of it")
    c, (gain, z, size, left, over_levels) = best
    n = len(slices)
    p = _p(gain, n, len(plan.candidates))
    q = min(1.0, p * len(problem.effects))
    if q > problem.fdr:
        return None, Verdict(ID, gain, q, f"trips do not fall into two groups (q = {q:.2g})")
    if stats.chi2.sf(2.0 * left, n - 2) < ENOUGH or over_levels < BEATS:
        return None, Verdict(ID, gain, q, "trips differ, but two values are not enough for them")
    if _ordered(z):
        return None, Verdict(ID, gain, q, "a change that stays from one trip on says as much")
    names = [int(problem.trip[s.start]) for s in slices]
    chosen = tuple((f"in_mode[{t}]", float(x)) for t, x in zip(names, z, strict=True))
    seconds = np.array([np.sum(problem.seconds[s]) for s in slices])
    share = float(z @ seconds / np.sum(seconds))
    candidate = Candidate(ModeChange, c.sizes, (None,), (("share", share), *chosen), "size", ())
    score = Score(candidate, np.array([size]), gain, p, p, gain, 1.0)
    new = joined(problem, state, score, noise) or joined(problem, state, score)
    before = float(np.mean((problem.measured - state.fit.predicted) ** 2))
    if new is None or before - float(np.mean((problem.measured - new.fit.predicted) ** 2)) < LEAST_SHARE * before:
        return None, Verdict(ID, gain, q, "in the joint refit it is out of range or not told from nothing")
    stability = _stability(evidence.grams, c, base, z)
    found = Found(ID, score, q, stability, (), gain)
    return replace(new, found=[*state.found, found]), None


def _solved(a: np.ndarray, b: np.ndarray) -> tuple[float, np.ndarray]:
    """Gain in log-likelihood and coefficients of normal equations that may be singular."""
    d = np.sqrt(np.maximum(np.diag(a), 1e-300))
    x = np.linalg.pinv(a / np.outer(d, d), rcond=1e-9, hermitian=True) @ (b / d) / d
    return 0.5 * float(b @ x), x


def _p(gain: float, trips: int, coefficients: int) -> float:
    """p of a split: every way to split the trips in two counts, and every coefficient that may have a second value."""
    ways = (trips - 1) * np.log(2.0) + np.log(coefficients)
    return float(np.exp(min(stats.chi2.logsf(2.0 * gain, 1) + ways, 0.0)))


def _split(
    grams: Grams, precision: np.ndarray, pull: np.ndarray
) -> tuple[float, np.ndarray, float, float, float] | None:
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
        column = z @ cross
        gain, y = _solved(np.block([[a, column[:, None]], [column[None], z @ square]]), np.r_[b, z @ told])
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


def _stability(grams: Grams, c: Candidate, base: int, z: np.ndarray) -> float:
    """Share of resampled sets of trips in which the mode gains more than its number costs."""
    rng = np.random.default_rng(0)
    column, last = base + c.columns[0], grams.shape[-1] - 1
    hits = 0
    for _ in range(RESAMPLES):
        w = np.bincount(rng.integers(0, len(grams), len(grams)), minlength=len(grams)).astype(float)
        a = np.tensordot(w, grams, axes=1)
        side = np.tensordot(w * z, grams, axes=1)
        inner = a[:base, :base] + 1e-12 * np.diag(np.diag(a)[:base])
        alone, _ = _solved(inner, a[:base, last])
        cross = side[:base, column]
        both = np.block([[inner, cross[:, None]], [cross[None], side[column, column]]])
        hits += _solved(both, np.r_[a[:base, last], side[column, last]])[0] - alone > 3.0
    return hits / RESAMPLES
