"""A coefficient with a second value in some trips: which trips is decided by how each of them differs from the rest.

Trips are sorted by their own estimates of the size, and split in two where that explains most. It is a mode where two
values are enough: random intercepts of trips are not two values. And it is a mode of that coefficient where its second
value explains more than a gain of the whole power in the same trips: an error of the power's sensor or another mass in
those trips gives every coefficient an apparent second value.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy import stats

from hdev_jax.diagnosis.candidates.candidate import Candidate
from hdev_jax.diagnosis.competition.cycle import barred
from hdev_jax.diagnosis.competition.refit import joined
from hdev_jax.diagnosis.competition.state import Found, State, Verdict
from hdev_jax.diagnosis.gates.gates import RESAMPLES
from hdev_jax.diagnosis.gates.rejection import Kind, Rejection
from hdev_jax.diagnosis.scores.evidence import Score
from hdev_jax.diagnosis.scores.passes import evidence_of
from hdev_jax.diagnosis.settings import Settings
from hdev_jax.diagnosis.training import Training
from hdev_jax.inference import Clusters
from hdev_jax.inference.rows import Chunk
from hdev_jax.physics.battery import ModeChange, StepChange

__all__ = ["add_mode"]

ID = ModeChange.id
LASTING = {
    name for sizes in StepChange.variants for name in sizes
}  # sizes for which a permanent change is an effect of its own
MOST_SPLITS = 4000  # resampled sets are fewer where many trips have many splits each
RANDOM = (0.0, 0.03, 0.1, 0.2, 0.35, 0.5, 0.7, 1.0, 1.4, 2.0)  # variances of random levels, over the sizes' own

Grams = Float[np.ndarray, "trip d d"]
Every = Float[np.ndarray, "coefficient trip d d"]
Split = tuple[float, np.ndarray, float, float, float]


def add_mode(training: Training, state: State, rng: np.random.Generator) -> tuple[State | None, Verdict | None]:
    """The state with a mode of some trips added and refitted, or a verdict on why it is not."""
    if state.fit.vehicle.has(ID) or ID not in training.library:
        return None, None
    if (verdict := barred(training, state, ModeChange)) is not None:
        return None, verdict
    settings, slices = training.settings, training.slices

    def no(kind: Kind, detail: str, gain: float | None = None, q: float = 1.0) -> tuple[None, Verdict]:
        return None, Verdict(ID, gain, q, Rejection(kind, {"detail": detail}))

    if len(slices) < (least := settings.least_count):
        return no(Kind.TOO_FEW_CLUSTERS, f"at least {least} trips are needed to split them in two groups")
    ids = np.concatenate([np.full(s.stop - s.start, k) for k, s in enumerate(slices)])
    noise = training.noise(state.fit)
    baseline = replace(
        training.baseline(state.fit, replace(noise, level_sd=0.0)), clusters=Clusters(ids, len(slices), "trip")
    )
    on = {"in_mode": (1.0,), "share": (0.5,)}
    plan = training.plan(state.fit.vehicle, [ModeChange], on, searched=True)

    def write(out: np.ndarray, chunk: Chunk) -> None:
        plan.write(out[:, :-1], chunk.segments)
        out[:, -1] = np.nan_to_num(training.kernel.predict(state.fit.vehicle, chunk.segments, training.target))

    evidence = evidence_of(baseline, plan.width + 1, write)
    every = np.stack([evidence.only([c])[0].grams for c in plan.candidates])
    prior, level = (np.diag(evidence.precision), evidence.pull), settings.fdr / len(training.library)
    lasting = [set(c.sizes) <= LASTING for c in plan.candidates]
    best = _best(every, *prior, settings)
    if best is None:
        return no(Kind.NO_EFFECT, "no effect in any trip")
    k, (gain, z, size, *_) = best
    c, p = plan.candidates[k], _p(gain, len(slices), len(every))
    q = min(1.0, p * len(training.library))
    if (why := _against(best[1], lasting[k], len(every), level, settings)) is not None:
        return no(Kind.NOT_SIGNIFICANT, why, gain, q)
    alone, (column,) = evidence.only([c])
    in_mode = alone.within(z).score(column)
    power, (gain_of_it,) = evidence.only([replace(c, columns=(plan.width,))])
    if power.within(z).score(gain_of_it).gain > in_mode.gain - settings.ahead:
        why = "in those trips a gain of the whole power explains as much as this coefficient"
        return no(Kind.OUTSCORED, why, gain, q)
    left_out = alone.left_out_gain_of_mode(z)
    if left_out <= settings.ahead or in_mode.p_cluster > settings.fdr:
        return None, Verdict(ID, gain, q, Rejection(Kind.NOT_CONFIRMED, {"left_out_gain": left_out}))
    names = [int(training.trip[s.start]) for s in slices]
    chosen = tuple((f"in_mode[{t}]", float(x)) for t, x in zip(names, z, strict=True))
    seconds = np.array([np.sum(training.seconds[s]) for s in slices])
    share = float(z @ seconds / np.sum(seconds))
    candidate = Candidate(ModeChange, c.sizes, (None,), (("share", share), *chosen), "size", ())
    score = Score(candidate, np.array([size]), gain, p, in_mode.p_cluster, left_out, 1.0)
    fit = joined(training, state, score, noise) or joined(training, state, score)
    before = float(np.mean(training.residual(state.fit) ** 2))
    if fit is None or before - float(np.mean(training.residual(fit) ** 2)) < settings.least_share * before:
        return None, Verdict(ID, gain, q, Rejection(Kind.REFIT))
    # reported, no gate: two trips of eight are both in a resampled set in four of ten
    stability = _stability(every, lasting, *prior, level, rng, settings)
    found = Found(ID, score, q, stability, (), gain)
    return replace(state, fit=fit, found=(*state.found, found)), None


def _solved(a: np.ndarray, b: np.ndarray) -> tuple[float, np.ndarray]:
    """Gain in log-likelihood and coefficients of normal equations that may be singular."""
    d = np.sqrt(np.maximum(np.diag(a), 1e-300))
    x = np.linalg.pinv(a / np.outer(d, d), rcond=1e-9, hermitian=True) @ (b / d) / d
    return 0.5 * float(b @ x), x


def _p(gain: float, trips: int, coefficients: int) -> float:
    """p of a split: every way to split the trips in two counts, and every coefficient that may have a second value."""
    ways = (trips - 1) * np.log(2.0) + np.log(coefficients)
    return float(np.exp(min(stats.chi2.logsf(2.0 * gain, 1) + ways, 0.0)))


def _best(every: Every, precision: np.ndarray, pull: np.ndarray, settings: Settings) -> tuple[int, Split] | None:
    """Which coefficient's split of the trips gains most, and the split."""
    splits = [
        (k, split) for k, grams in enumerate(every) if (split := _split(grams, precision, pull, settings)) is not None
    ]
    return max(splits, key=lambda s: s[1][0], default=None)


def _against(split: Split, lasting: bool, coefficients: int, level: float, settings: Settings) -> str | None:
    """Why a split is no mode, its p to be no larger than `level`; or None.

    `lasting`: whether a change of the coefficient for good is an effect of its own. One of its trips that follow each
    other is left to that; where there is no such effect they are a mode like any other.
    """
    gain, z, _, left, over_levels = split
    if (p := _p(gain, len(z), coefficients)) > level:
        return f"trips do not form two groups (p = {p:.2g})"
    if stats.chi2.sf(2.0 * left, len(z) - 2) < settings.mode_enough or over_levels < settings.ahead:
        return "trips differ, but by more than two values"
    stays = lasting and np.count_nonzero(np.diff(z)) <= 1  # all trips from one on, or all before it
    return "a permanent change from one trip on explains as much" if stays else None


def _split(grams: Grams, precision: np.ndarray, pull: np.ndarray, settings: Settings) -> Split | None:
    """Gain of the best split of the trips in two, the trips of the second mode, its size, what more one value for
    each trip would gain, and how much better two values are than levels that differ at random; None where no trip has
    the column."""
    n, base = len(grams), len(pull)
    cross, square, moment = grams[:, :base, base], grams[:, base, base], grams[:, base, base + 1]
    if np.count_nonzero(square > 1e-20) < settings.least_count:
        return None
    total = grams.sum(axis=0)
    a, b = total[:base, :base] + precision, total[:base, base + 1] - pull
    alone, _ = _solved(a, b)
    # one value for each trip beside the common coefficients
    every, x = _solved(np.block([[a, cross.T], [cross, np.diag(square)]]), np.r_[b, moment])
    order = np.argsort(x[base:])
    best: tuple[float, np.ndarray, float] | None = None
    for k in range(settings.mode_side, n - settings.mode_side + 1):
        z = np.zeros(n)
        z[order[k:] if n - k <= k else order[:k]] = 1.0  # the rarer mode is the second
        c = (z @ cross)[:, None]  # of one more column beside the common coefficients
        gain, y = _solved(np.block([[a, c], [c.T, np.array([[z @ square]])]]), np.r_[b, z @ moment])
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


def _stability(
    every: Every, lasting: Sequence[bool], precision: np.ndarray, pull: np.ndarray, level: float,
    rng: np.random.Generator, settings: Settings,
) -> float:  # fmt: skip
    """Share of resampled sets of trips that form two modes again, whichever trips those are."""
    n = every.shape[1]
    draws, hits = int(np.clip(MOST_SPLITS // n, 10, RESAMPLES)), 0
    for _ in range(draws):
        drawn = np.sort(rng.integers(0, n, n))
        best = _best(every[:, drawn], precision, pull, settings)
        if best is not None and _against(best[1], lasting[best[0]], len(every), level, settings) is None:
            in_mode = best[1][1] > 0
            hits += min(len(np.unique(drawn[in_mode])), len(np.unique(drawn[~in_mode]))) >= settings.mode_side
    return hits / draws
