"""Has a residual levels? The likelihood that a load which switches gains, against its gain on noise of that colour."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import signal, stats

from hdev_jax.diagnosis.noise.noise import Noise, estimate_noise
from hdev_jax.diagnosis.settings import Settings
from hdev_jax.diagnosis.training import Training
from hdev_jax.inference.states import Decoded, StateRows, Switching, errors_alone, fit_switching
from hdev_jax.physics.states import KNOTS_C
from hdev_jax.segments import trip_slices

__all__ = ["FIRST_ROUNDS", "LOAD_NUMBERS", "Tested", "besides", "level_test", "some_rows"]

COARSE_S = (5.0, 15.0, 45.0)  # means over so many seconds have less noise, and blur the switching
FIRST_ROUNDS = 3  # of expectation-maximisation
MOST_ROWS = 30_000  # that the test looks at: time
LEAST_ROWS = 100
LEAST_STRETCH = 600  # rows of a trip that it looks at
BESIDES = (0.4, 0.6, 1.6, 2.5)  # powers of a second load to start from, over the first's
LOAD_NUMBERS = 8  # free numbers of a load: its power, its base, shares at four temperatures, a memory, the errors' size
LEAST_SPREAD = 0.5 * float(np.sqrt(2.0 * LOAD_NUMBERS))  # sd of a load's gain on noise: of half a χ² of so many


@dataclass(frozen=True)
class Tested:
    """The test of a load: its gain in log-likelihood over errors alone, and p."""

    model: Switching
    gain: float
    p: float


def level_test(rows: StateRows, training: Training, rng: np.random.Generator) -> Tested | None:
    """The load that explains most of these rows, and whether noise of their colour would give as good a one."""
    rows = some_rows(rows)
    if len(rows.trip) < LEAST_ROWS or np.ptp(rows.residual_w) <= 0 or not np.all(np.isfinite(rows.residual_w)):
        return None
    model, gain = _best(rows)
    noise = estimate_noise(rows.residual_w / rows.wide, rows.trip, rows.duration_s, levels=False)
    others: list[float] = []
    settings = training.settings
    level = settings.fdr / len(training.library)
    for _ in range(settings.shifts):
        others.append(_best(replace(rows, residual_w=_surrogate(rows, noise, rng)))[1])
        if len(others) == settings.first_look and gain <= max(others):
            return Tested(model, gain, 1.0)
        if len(others) == settings.second_look and _clear(gain, others, level, settings):
            break
    return Tested(model, gain, _p(gain, others))


def _clear(gain: float, others: Sequence[float], level: float, settings: Settings) -> bool:
    """Whether p is far below the level, or would be as far above it if all placebos had this spread."""
    return _p(gain, others) * settings.clear < level or _p(gain, others, settings.shifts) > settings.clear * level


def _p(gain: float, others: Sequence[float], count: int | None = None) -> float:
    """p of a gain among those of noise, taken as normal; or what it would be if `count` of them had this spread."""
    n = count or len(others)
    spread = max(float(np.std(others, ddof=1)), LEAST_SPREAD) * np.sqrt(1.0 + 1.0 / n)
    return float(stats.t.sf((gain - np.mean(others)) / spread, n - 1))


def some_rows(rows: StateRows) -> StateRows:
    """At most about `MOST_ROWS` rows of a log: the middle of every trip, or of trips evenly spread over the log."""
    if len(rows.trip) <= MOST_ROWS:
        return rows
    slices = [s for _, s in trip_slices(rows.trip)]
    chosen = slices[:: max(1, -(-len(slices) * LEAST_STRETCH // MOST_ROWS))]
    most = max(MOST_ROWS // len(chosen), LEAST_STRETCH)

    def middle(s: slice) -> np.ndarray:
        spare = max(s.stop - s.start - most, 0) // 2
        return np.arange(s.start + spare, s.stop - spare)

    return rows.take(np.concatenate([middle(s) for s in chosen]))


def _best(rows: StateRows) -> tuple[Switching, float]:
    """The load that gains most over errors alone, and its gain in log-likelihood; from several starts."""
    alone, memory = errors_alone(rows)
    tried: list[tuple[Switching, Decoded]] = []
    for seconds in COARSE_S:
        coarse = rows.coarse(seconds)
        if not tried or LEAST_ROWS <= len(coarse.trip) < len(rows.trip):
            tried.append(fit_switching(_two_levels(coarse, memory), rows, 1))
    first = max(tried, key=lambda t: t[1].log_likelihood)[0]
    model, decoded = fit_switching(first, rows, FIRST_ROUNDS + 1)
    gain = max(decoded.log_likelihood - alone, 0.0)  # a load of no power gains nothing
    return model if model.power_w[0] > 0 else model.turned(), gain


def _two_levels(coarse: StateRows, memory: float) -> Switching:
    """Two levels of means over some seconds by their 2-means, and how often they change."""
    x = coarse.residual_w
    low, high = np.quantile(x, (0.1, 0.9))
    for _ in range(20):
        on = x > 0.5 * (low + high)
        if not 0 < np.count_nonzero(on) < len(on):
            break
        low, high = float(np.mean(x[~on])), float(np.mean(x[on]))
    on = (x > 0.5 * (low + high)).astype(float)
    share = float(np.clip(np.mean(on), 0.05, 0.95))
    switches = float(np.sum(np.abs(np.diff(on))[np.diff(coarse.trip) == 0]))
    stays = 2.0 * share * (1.0 - share) * float(np.sum(coarse.duration_s)) / max(switches, 1.0)
    scale = np.full(2, float(np.mean(np.abs(x - np.where(on > 0, high, low)))) + 1e-9)
    return Switching(
        np.array([max(high - low, 1e-6)]), low, scale, np.full((1, len(KNOTS_C)), share), np.array([max(stays, 30.0)]),
        0.5 * memory,
    )  # fmt: skip


def besides(one: Switching) -> list[Switching]:
    """Two loads, the second of other powers than the first: that may have been fitted to the levels of both."""
    two = one.plus(replace(one, memory_s=one.memory_s.copy()))
    return [replace(two, power_w=one.power_w[0] * np.array([1.0, r])) for r in BESIDES]


def _surrogate(rows: StateRows, noise: Noise, rng: np.random.Generator) -> np.ndarray:
    """Noise of the residual's own colour: its innovations with random signs, coloured again, trip by trip."""
    out = np.empty(len(rows.trip))
    whiten = np.r_[1.0, -noise.coefficients[-1]]
    left = (rows.residual_w - np.median(rows.residual_w)) / rows.wide
    for _, s in trip_slices(rows.trip):
        innovations = np.asarray(signal.lfilter(whiten, [1.0], left[s]))
        signs = rng.choice((-1.0, 1.0), len(innovations))
        out[s] = signal.lfilter([1.0], whiten, innovations * signs)
    return out * rows.wide
