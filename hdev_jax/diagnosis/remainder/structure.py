"""Structure of a residual that noise could not have made: cycles, change points, random intercepts of trips."""

from dataclasses import dataclass

import numpy as np
from scipy import stats

from hdev_jax.diagnosis.noise.noise import Noise, estimate_noise
from hdev_jax.diagnosis.noise.spectrum import Clocked, Period, strongest_period
from hdev_jax.diagnosis.remainder.rows import Rows
from hdev_jax.diagnosis.settings import Settings
from hdev_jax.segments import trip_slices

__all__ = [
    "GROWS_AS", "Levels", "change_point", "colour", "cycle_rms", "levels_of", "period_of", "scales_with",
    "shared_offset",
]  # fmt: skip

OFFSET_LEVEL = 0.01  # of a mean over trips, once it is known that something is there
LEAST_ROWS = 8  # of a trip whose intercept is estimated
BASIC_WAVE = 3.0 / (2.0 * np.pi**2)  # share of it in the mean square of a load that rises and falls back (a saw-tooth)
APART = 2.0  # in log-likelihood, that one amount explains trips' remainders better than the next
GROWS_AS = {"time": "a power", "distance": "a force", "energy": "an efficiency"}


@dataclass(frozen=True)
class Levels:
    """Random intercepts of trips: the trip that is furthest off, how far it is, their sd, and whether they are
    significant or only explain the residual better than coloured noise (`estimate_noise` needs a gain of 2)."""

    worst: int
    level: float
    sd: float
    significant: bool


def scales_with(rows: Rows, settings: Settings) -> str | None:
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
    significant = n > 2 and len(missed) * stats.f.sf(f, 1, n - 1) < settings.level
    return best if significant and 0.5 * n * np.log(missed[second] / missed[best]) > APART else None


def colour(noise: Noise) -> str:
    """Words for the noise of a residual that nothing predicts."""
    first = float(noise.coefficients[1, 0]) if noise.order else 0.0
    return "independent from row to row" if abs(first) < 0.1 else f"correlated from row to row ({first:.2f})"


def period_of(rows: Rows, noise: Noise, settings: Settings) -> Period | None:
    """A cycle that noise with the spectrum around it could not have made."""
    hit = strongest_period(rows.residual, Clocked.of(rows.trip, rows.duration_s, rows.worth, noise))
    least = BASIC_WAVE * settings.least_share * np.mean(rows.residual**2)
    if hit is None or hit.p > settings.level or cycle_rms(rows, hit.amplitude) ** 2 < least:
        return None
    return hit


def cycle_rms(rows: Rows, amplitude: float) -> float:
    """Root mean square of a cycle in the residual's unit."""
    return float(amplitude * np.sqrt(0.5 * np.mean(rows.worth**2)))


def change_point(white: np.ndarray, trip: np.ndarray, settings: Settings) -> tuple[int, int] | None:
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
    if best is None or stats.kstwobign.sf(best[0]) * len(slices) > settings.level / 10:
        return None
    return best[1:]


def _of_some_length(trip: np.ndarray) -> dict[int, slice]:
    """Trips with rows enough to have a level, and where they are."""
    return {t: s for t, s in trip_slices(trip) if s.stop - s.start >= LEAST_ROWS}


def shared_offset(rows: Rows) -> float:
    """The mean of the trips' means where it differs significantly from 0, else 0: random intercepts about 0 have a mean
    too, by chance."""
    means = np.array([float(np.mean(rows.residual[s])) for s in _of_some_length(rows.trip).values()])
    if len(means) < 2:
        return 0.0
    mean, error = float(np.mean(means)), float(np.std(means, ddof=1) / np.sqrt(len(means)))
    p = 2.0 * float(stats.t.sf(abs(mean) / (error + 1e-300), len(means) - 1))
    return mean if p < OFFSET_LEVEL else 0.0


def levels_of(rows: Rows, residual: np.ndarray, settings: Settings) -> Levels | None:
    """Random intercepts of trips, significant or suspected; None where there is no sign of them.

    They are about 0: the mean of the residual is part of them. The likelihood ratio of the noise with random
    intercepts against the noise without, each with an order of its own; half a χ², since a variance of 0 is at its
    bound (Self and Liang 1987).
    """
    long = _of_some_length(rows.trip)
    if len(long) < 4:
        return None
    plain, noise = (estimate_noise(residual, rows.trip, rows.duration_s, levels=x) for x in (False, True))
    # the share is one of a grid that holds the least itself: rounding must not decide
    if not noise.level_sd or noise.level_sd**2 < (settings.least_levels - 1e-9) * np.mean(residual**2):
        return None
    gain = noise.log_likelihood - plain.log_likelihood
    p = 0.5 * float(stats.chi2.sf(2.0 * max(gain, 0.0), 1))
    means = {t: float(np.mean(residual[s])) for t, s in long.items()}
    worst = max(means, key=lambda t: abs(means[t]))
    return Levels(worst, means[worst], noise.level_sd, p <= settings.level / 10)
