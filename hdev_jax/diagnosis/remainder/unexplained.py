"""What is left: how much of the residual anything in the log predicts, and what it looks like."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy import stats

from hdev_jax.diagnosis.noise.model import Noise, estimate_noise, whiten
from hdev_jax.diagnosis.noise.spectrum import Clocked, Period, strongest_period
from hdev_jax.inference import Clusters
from hdev_jax.segments import trip_slices

__all__ = ["LEAST_SHARE", "Remainder", "Rows", "remainder", "swing_w"]

# For the flexible learner and for cycles, a tenth of it for change points and levels, as far as their p hold:
# docs/planted.md counts false alarms by noise
LEVEL = 1e-3
OFFSET_LEVEL = 0.01  # of a mean over trips, once it is known that something is there
LEAST_LEVEL = 0.1  # of the residual's variance, of levels by trip
LEAST_ROWS = 8  # of a trip that is asked for its level
LEAST_SHARE = 0.02  # of the test variance; below it structure is real perhaps, but explains nothing
BASIC_WAVE = 3.0 / (2.0 * np.pi**2)  # share of it in the mean square of a load that rises and falls back (a saw-tooth)
ROUNDS = 400
APART = 2.0  # in log-likelihood, that one amount explains trips' remainders better than the next
GROWS_AS = {"time": "a power", "distance": "a force", "energy": "an efficiency"}
BINS = 10  # of the smooth correction
MOST_ROWS = 30_000  # that the flexible learner is trained on


@dataclass(frozen=True)
class Remainder:
    """The contract's `unexplained`, and a smooth correction: what a flexible learner would add, by its first channel.

    `scales_with` is what a trip's remainder is in proportion to: `time`, `distance`, `energy`, or None. `trips_differ`
    where trips have levels of their own, or are suspected to: what only trips tell may hide among them.
    """

    significant: bool
    share: float
    noise_floor_rmse: float
    depends_on: tuple[str, ...]
    signature: str
    rms: float  # of the structure that training rows alone show, in the target's unit; 0 where they show none
    cycle_w: Float[np.ndarray, " train"]  # the cycle's swing about each training row, 0 where none is or it is no power
    trips_differ: bool = False
    scales_with: str | None = None
    correction: Mapping[str, Any] | None = None  # `channel`, its values `at`, what is added there [`unit`]
    expression: str | None = None
    borne_out: bool = False  # whether training clusters left out of the learner's fit bear its share out

    def described(
        self, formula: str, channels: Sequence[str], rms: float, unit: str, error: tuple[float, float]
    ) -> "Remainder":
        """The same with a formula that fits it; `rms` is the formula's own, `error` on test rows without and with."""
        errors = f"test RMSE {error[0]:.4g} → {error[1]:.4g} {unit}"
        words = f"it follows {formula}, which the library does not hold ({errors})"
        floor = min(self.noise_floor_rmse, error[1])
        return replace(self._saying(words, channels, rms), expression=formula, noise_floor_rmse=floor)

    def hinted(self, words: str, channels: Sequence[str], rms: float) -> "Remainder":
        """The same with what rows of training trips follow, of which no formula is borne out."""
        more = f"its rows follow {words} more closely than chance could; no formula for it is borne out"
        return self._saying(more, channels, rms)

    def _saying(self, words: str, channels: Sequence[str], rms: float) -> "Remainder":
        start, between = (self.signature.rstrip("."), "; ") if self.significant else ("What is left", ": ")
        return replace(
            self, significant=True, depends_on=tuple(dict.fromkeys((*channels, *self.depends_on))),
            signature=f"{start}{between}{words}.", rms=max(self.rms, rms),
        )  # fmt: skip


@dataclass(frozen=True)
class Rows:
    """Features, residual (measured − predicted), trips and clock of one side of the split.

    `worth` is what a constant power (or force) of one `cycle_unit` is in each row's unit; `weight` what a row weighs in
    a sum; `amounts` what a sum may be in proportion to, on each row.
    """

    features: Float[np.ndarray, "row feature"]
    residual: Float[np.ndarray, " row"]
    clusters: Clusters
    trip: np.ndarray
    duration_s: np.ndarray
    worth: np.ndarray
    cycle_unit: str
    weight: np.ndarray
    amounts: Mapping[str, np.ndarray]


@dataclass(frozen=True)
class Levels:
    """Levels of trips: the trip that is furthest off, how far it is, the levels' sd, and whether they are told from
    coloured noise or only explain the residual better than it (`estimate_noise` asks for a gain of 2)."""

    worst: int
    level: float
    sd: float
    told: bool


def remainder(
    train: Rows, test: Rows, names: Sequence[str], unit: str, trip_names: Sequence[str], *, seed: int,
    tell: Callable[[str], None] = lambda _: None,
) -> Remainder:  # fmt: skip
    """Four looks at the residual: a flexible learner validated by trip, periods, change points, levels of trips.

    The learner (LightGBM) is trained on training rows; its share is what it predicts of the test residual. It counts
    only where it also helps on training clusters left out of its own fit. The others ask whether whitened noise could
    have done it. What is reported is measured on test rows; `rms`, which decides what was found, never sees them.
    """
    tell("what is left: a flexible learner, validated by trip")
    correction, share_train, p_learner, order = _learner(train, test, names, seed)
    share = _share(test.residual, correction)
    learned = p_learner < LEVEL and share > LEAST_SHARE
    tell("what is left: periods, change points, levels of trips")
    noise = _noise(train)
    white = whiten(train.residual[:, None], noise, train.trip, train.duration_s)[:, 0]
    period = _period(train, noise)
    change = _change_point(white, train.trip)
    levels = _levels(train, train.residual)  # about 0: what all trips share counts too, and is told apart below
    parts, depends, sizes = [], [], [0.0]
    if p_learner < LEVEL and share_train > LEAST_SHARE:
        sizes.append(float(np.sqrt(share_train * np.mean(train.residual**2))))
    if learned:
        depends += list(order)
        parts.append(f"{100 * share:.0f} % of it follows {', '.join(order)} in a way the library does not hold")
    if period is not None:
        seconds, amplitude = period.period_s, period.amplitude
        sizes.append(_rms(train, amplitude))
        depends.append("time_s")
        clock = f"{seconds / 60:.0f}-minute" if seconds >= 120 else f"{seconds:.0f}-second"
        parts.append(f"a {clock} cycle of about {amplitude:.3g} {train.cycle_unit}")
    if change is not None:
        where, row = change
        before = (train.trip == where) & (np.arange(len(train.trip)) <= row)
        sizes.append(_shift(train.residual, before, (train.trip == where) & ~before))
        depends.append("time_s")
        minutes = float(np.sum(train.duration_s[before]) / 60.0)
        parts.append(f"a change inside trip {trip_names[where]} after {minutes:.0f} min")
    mean = _shared(train) if levels is not None else 0.0
    apart = train.residual - mean
    apart[np.abs(apart) < 1e-9 * abs(mean)] = 0.0  # the rounding of a difference is nothing that differs
    differing = _levels(train, apart) if mean else levels
    if differing is not None and differing.told:
        sizes.append(differing.sd)
        depends.append("trip_id")
        worst = f"{trip_names[differing.worst]} ({differing.level:+.2g} {unit})"
        parts.append(f"levels that differ by trip by about {differing.sd:.2g} {unit}, most in {worst}")
    elif mean and levels is not None and levels.told:
        sizes.append(abs(mean))
        parts.append(f"an offset of about {mean:+.2g} {unit} that all trips share")
    scales_with = _scale(train) if parts else None
    if scales_with is not None:
        parts.append(f"from trip to trip it grows with {scales_with}, as {GROWS_AS[scales_with]} does")
    rmse = float(np.sqrt(np.mean(test.residual**2)))
    floor = rmse * float(np.sqrt(1.0 - (share if learned else 0.0)))
    signature = "What is left looks like noise: " + _colour(noise) if not parts else "What is left: " + "; ".join(parts)
    rms = max(sizes)
    depends_on = tuple(dict.fromkeys(depends))
    curve = _curve(correction, test, list(names), order[0], unit) if learned and order else None
    return Remainder(
        bool(parts), share, floor, depends_on, signature + ".", rms, _watts(train, period), differing is not None,
        scales_with=scales_with, correction=curve, borne_out=learned,
    )  # fmt: skip


def _curve(correction: np.ndarray, rows: Rows, names: list[str], channel: str, unit: str) -> dict[str, Any]:
    """The mean of a correction in bins of one channel with like numbers of rows."""
    x = rows.features[:, names.index(channel)]
    edges = np.unique(np.quantile(x, np.linspace(0, 1, BINS + 1)[1:-1]))
    place = np.searchsorted(edges, x)
    groups = [place == k for k in np.unique(place)]
    at, value = ([float(np.mean(y[g])) for g in groups] for y in (x, correction))
    return {"channel": channel, "at": at, "value": value, "unit": unit}


def _scale(rows: Rows) -> str | None:
    """What a trip's remainder is in proportion to; None where it is to nothing, or as well to something else.

    Sums over longer trips are noisier as the root of their time, and count so much less.
    """
    _, trip = np.unique(rows.trip, return_inverse=True)
    root = np.sqrt(np.bincount(trip, rows.duration_s))
    total = np.bincount(trip, rows.weight * rows.residual) / root
    squares, n = float(total @ total), len(total)
    missed = {}
    for name, amount in rows.amounts.items():
        x = np.bincount(trip, amount) / root
        missed[name] = max(squares - float(total @ x) ** 2 / max(float(x @ x), 1e-300), 1e-12 * squares + 1e-300)
    best, second = sorted(missed, key=missed.__getitem__)[:2]
    f = (n - 1) * (squares - missed[best]) / missed[best]
    told = n > 2 and len(missed) * stats.f.sf(f, 1, n - 1) < LEVEL
    return best if told and 0.5 * n * np.log(missed[second] / missed[best]) > APART else None


def _colour(noise: Noise) -> str:
    """Words for the noise of a residual that nothing predicts."""
    first = float(noise.coefficients[1, 0]) if noise.order else 0.0
    return "independent from row to row" if abs(first) < 0.1 else f"correlated from row to row ({first:.2f})"


def _share(residual: np.ndarray, predicted: np.ndarray) -> float:
    """Share of a residual's squares that a prediction of it takes away, 0 at least."""
    squares = float(np.sum(residual**2))
    return float(np.clip(1.0 - np.sum((residual - predicted) ** 2) / max(squares, 1e-300), 0.0, 1.0))


def _learner(
    train: Rows, test: Rows, names: Sequence[str], seed: int
) -> tuple[np.ndarray, float, float, tuple[str, ...]]:
    """Correction on test rows, what share is predicted of training clusters left out in turn and its p, and the
    features it leans on."""
    import lightgbm as lgb

    every = max(1, len(train.residual) // MOST_ROWS)  # neighbours say the same: a thinned log teaches as much
    train = Rows(
        train.features[::every], train.residual[::every], replace(train.clusters, ids=train.clusters.ids[::every]),
        train.trip[::every], train.duration_s[::every], train.worth[::every], train.cycle_unit, train.weight[::every],
        {k: x[::every] for k, x in train.amounts.items()},
    )  # fmt: skip
    rng = np.random.default_rng(seed)
    fold = rng.permutation(np.arange(train.clusters.count) % 4)[train.clusters.ids]
    rows = len(train.residual)
    parameters = {
        "objective": "regression", "learning_rate": 0.05, "num_leaves": 15, "verbosity": -1, "num_threads": 1,
        "min_data_in_leaf": int(max(20, rows // 200)), "lambda_l2": 10.0, "feature_fraction": 0.8, "seed": seed,
        "deterministic": True, "force_row_wise": True, "max_bin": 127,
    }  # fmt: skip
    scale = float(np.std(train.residual)) + 1e-300

    def part(at: np.ndarray, **options: Any) -> Any:
        return lgb.Dataset(train.features[at], train.residual[at] / scale, feature_name=_safe(names), **options)

    out_of_fold, steps = np.zeros(rows), []
    folds = np.unique(fold)
    for k, k_next in zip(folds, np.roll(folds, -1), strict=True) if len(folds) > 2 else ():
        # rounds are chosen on the fold after the one that is predicted, which has no say in them
        data = part((fold != k) & (fold != k_next))
        check = part(fold == k_next, reference=data)
        stop = [lgb.early_stopping(20, verbose=False)]
        steps.append(max(lgb.train(parameters, data, ROUNDS, valid_sets=[check], callbacks=stop).best_iteration, 0))
        booster = lgb.train(parameters, part(fold != k), max(steps[-1], 1))
        out_of_fold[fold == k] = np.asarray(booster.predict(train.features[fold == k])) * scale
    rounds = int(np.median(steps)) if steps else 0
    if rounds < 2:
        return np.zeros(len(test.residual)), 0.0, 1.0, ()
    gain = train.clusters.sums(train.residual**2 - (train.residual - out_of_fold) ** 2)
    size = train.clusters.sums(train.residual**2)
    relative = gain / np.mean(size)
    t = np.mean(relative) / (np.std(relative, ddof=1) / np.sqrt(len(relative)) + 1e-300)
    p = float(stats.t.sf(t, len(relative) - 1))
    booster = lgb.train(parameters, part(np.ones(rows, bool)), rounds)
    correction = np.asarray(booster.predict(test.features)) * scale
    importance = booster.feature_importance("gain")
    first = np.argsort(-importance)[:3]
    leading = tuple(str(names[int(i)]) for i in first if importance[i] > 0.15 * importance.sum())
    return correction, _share(train.residual, out_of_fold), p, leading


def _safe(names: Sequence[str]) -> list[str]:
    return [f"f{i}" for i in range(len(names))]


def _noise(rows: Rows) -> Noise:
    return estimate_noise(rows.residual, rows.trip, rows.duration_s, levels=False)


def swing_w(rows: Rows) -> Float[np.ndarray, " row"]:
    """The amplitude [W] of the cycle that the residual has about each row; 0 where it has none or it is no power."""
    return _watts(rows, _period(rows, _noise(rows)))


def _watts(rows: Rows, period: Period | None) -> np.ndarray:
    watts = {"kW": 1000.0, "W": 1.0}.get(rows.cycle_unit, 0.0)
    return watts * period.amplitudes if period is not None else np.zeros(len(rows.residual))


def _rms(rows: Rows, amplitude: float) -> float:
    """Root mean square of a cycle in the residual's unit."""
    return float(amplitude * np.sqrt(0.5 * np.mean(rows.worth**2)))


def _period(rows: Rows, noise: Noise) -> Period | None:
    """A cycle that noise with the spectrum around it could not have made."""
    hit = strongest_period(rows.residual, Clocked.of(rows.trip, rows.duration_s, rows.worth, noise))
    least = BASIC_WAVE * LEAST_SHARE * np.mean(rows.residual**2)
    if hit is None or hit.p > LEVEL or _rms(rows, hit.amplitude) ** 2 < least:
        return None
    return hit


def _change_point(white: np.ndarray, trip: np.ndarray) -> tuple[int, int] | None:
    """The trip in which the whitened residual shifts and the row after which it does, by the maximum of its bridge
    (Kolmogorov's distribution)."""
    best: tuple[float, int, int] | None = None
    slices = list(trip_slices(trip))
    for t, s in slices:
        n = s.stop - s.start
        if n < 50:
            continue
        path = np.cumsum(white[s] - np.mean(white[s])) / (np.std(white[s]) * np.sqrt(n) + 1e-300)
        k = int(np.argmax(np.abs(path)))
        if best is None or abs(path[k]) > best[0]:
            best = (float(abs(path[k])), t, s.start + k)
    if best is None or stats.kstwobign.sf(best[0]) * len(slices) > LEVEL / 10:
        return None
    return best[1:]


def _shift(residual: np.ndarray, before: np.ndarray, after: np.ndarray) -> float:
    """Root mean square, over all rows, of what the means of a trip's two parts differ from the trip's own by."""
    n, m = int(before.sum()), int(after.sum())
    if not n or not m:
        return 0.0
    step = float(np.mean(residual[after]) - np.mean(residual[before]))
    return abs(step) * float(np.sqrt(n * m / (n + m) / len(residual)))


def _of_some_length(trip: np.ndarray) -> dict[int, slice]:
    """Trips with rows enough to have a level, and where they are."""
    return {t: s for t, s in trip_slices(trip) if s.stop - s.start >= LEAST_ROWS}


def _shared(rows: Rows) -> float:
    """The mean of trips' own means, if they tell it from 0: of trips that differ about 0 it is none of its own, however
    far chance moves it."""
    means = np.array([float(np.mean(rows.residual[s])) for s in _of_some_length(rows.trip).values()])
    if len(means) < 2:
        return 0.0
    mean, error = float(np.mean(means)), float(np.std(means, ddof=1) / np.sqrt(len(means)))
    p = 2.0 * float(stats.t.sf(abs(mean) / (error + 1e-300), len(means) - 1))
    return mean if p < OFFSET_LEVEL else 0.0


def _levels(rows: Rows, residual: np.ndarray) -> Levels | None:
    """Levels that trips have of their own, told or suspected; None where there is no sign of them.

    They are about 0: of a residual that has a mean, it is among them. The likelihood ratio of the noise with random
    levels against the noise without, each with an order of its own; half a χ², since a variance at its bound is no
    two-sided question (Self and Liang 1987).
    """
    long = _of_some_length(rows.trip)
    if len(long) < 4:
        return None
    plain, noise = (estimate_noise(residual, rows.trip, rows.duration_s, levels=x) for x in (False, True))
    # the share is one of a grid that holds the least itself: rounding must not decide
    if not noise.level_sd or noise.level_sd**2 < (LEAST_LEVEL - 1e-9) * np.mean(residual**2):
        return None
    gain = noise.log_likelihood - plain.log_likelihood
    p = 0.5 * float(stats.chi2.sf(2.0 * max(gain, 0.0), 1))
    means = {t: float(np.mean(residual[s])) for t, s in long.items()}
    worst = max(means, key=lambda t: abs(means[t]))
    return Levels(worst, means[worst], noise.level_sd, p <= LEVEL / 10)
