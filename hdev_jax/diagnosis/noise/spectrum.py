"""The strongest cycle of a residual, whatever its phase in each trip, and whether noise could have made it."""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int
from scipy import special, stats

from hdev_jax.diagnosis.noise.noise import Noise, whiten
from hdev_jax.segments import trip_slices

__all__ = ["Clocked", "Period", "strongest_period"]

LONGEST_S = 32_768.0  # of a window in rows' median durations: a cycle that keeps in step longer is seen by half of it
CYCLES = 3.0  # least number in a window
SAMPLES = 4.0  # least number in a cycle
PLACES = 512
LEAST_RATIO = 1.5  # of a peak to the noise around it


@dataclass(frozen=True)
class Period:
    """A peak of the spectrum: its period [s], its amplitude in units of `worth`, and p over all frequencies.

    `amplitudes` are those of the window that a row is in.
    """

    period_s: float
    amplitude: float
    p: float
    amplitudes: Float[np.ndarray, " row"]


@dataclass(frozen=True)
class Clocked:
    """Rows of a log with their noise: what whitens columns and takes each trip's level off them.

    `clock_s` is the middle of each row since the start of its trip, `worth` what a level of 1 is on it.
    """

    clock_s: Float[np.ndarray, " row"]
    duration_s: Float[np.ndarray, " row"]
    trip: Int[np.ndarray, " row"]
    worth: Float[np.ndarray, " row"]
    noise: Noise

    @classmethod
    def of(
        cls, trip: Int[np.ndarray, " row"], duration_s: Float[np.ndarray, " row"], worth: Float[np.ndarray, " row"],
        noise: Noise,
    ) -> "Clocked":  # fmt: skip
        """Rows whose clock is the sum of the durations before them."""
        clock = np.concatenate([np.cumsum(duration_s[s]) - 0.5 * duration_s[s] for _, s in trip_slices(trip)])
        return cls(clock, duration_s, trip, worth, noise)

    @property
    def slices(self) -> list[slice]:
        """Rows of each trip."""
        return [s for _, s in trip_slices(self.trip)]

    def whitened(self, columns: Float[np.ndarray, "row k"]) -> Float[np.ndarray, "row k"]:
        """Columns for generalised least squares, with a fixed intercept of each trip taken out."""
        both = whiten(np.column_stack([columns, self.worth]), self.noise, self.trip, self.duration_s)
        out, level = both[:, :-2].copy(), both[:, -2]
        for s in self.slices:
            out[s] -= np.outer(level[s], level[s] @ out[s]) / max(float(level[s] @ level[s]), 1e-300)
        return out


def strongest_period(residual: Float[np.ndarray, " row"], rows: Clocked) -> Period | None:
    """The most significant peak over the noise around it; None where the trips are too short for a cycle.

    Periodograms of the matched filter of the whitened residual, in windows of equal length, added up
    whatever the phase (Bartlett 1948): at each frequency a sum of as many exponential variables as there are windows,
    times the level of the noise there, taken from its neighbours: the noise as estimated has the cycle in it, and is
    too high there.
    """
    # An autoregression of a higher order predicts a strong cycle, and would take it out; so would intercepts of trips
    # and of blocks a slow one. What one coefficient leaves of the noise's colour is smooth.
    noise = rows.noise
    first = {"coefficients": noise.coefficients[:2, :1], "scales": noise.scales[:2]}
    rows = replace(rows, noise=replace(noise, **first, level_sd=0.0, block_sd=0.0))
    seconds = [float(np.sum(rows.duration_s[s])) for s in rows.slices]
    step = float(np.median(rows.duration_s))
    window = min(float(np.median(seconds)), LONGEST_S * step)
    while window >= 128 * step and sum(int(t / window + 0.5) for t in seconds) < 2:
        window /= 2  # a single trip is its own repetition
    if window < 64 * step:
        return None
    signal, weight = _matched(rows.whitened(residual[:, None])[:, 0], rows)
    size = 1 << int(np.ceil(np.log2(2 * window / step)))  # twice as fine as the window resolves
    power, count = np.zeros(size // 2 + 1), 0
    pieces = [w for s in rows.slices for w in _windows(rows.clock_s, s, window)]
    for piece in pieces:
        clock = rows.clock_s[piece] - rows.clock_s[piece.start]
        even = np.bincount((clock / step).astype(int), signal[piece], minlength=size)[:size]
        power += np.abs(np.fft.rfft(even)) ** 2 / float(weight[piece] @ weight[piece])
        count += 1
    if count < 2:
        return None
    frequency = np.fft.rfftfreq(size, step)
    inside = np.flatnonzero((frequency >= CYCLES / window) & (frequency <= 1 / (SAMPLES * step)))
    if not len(inside):
        return None
    per = round(size * step / window)  # points of the grid to an independent frequency
    heights = power[inside] / _floors(power, inside, per, count)
    k, height = int(inside[np.argmax(heights)]), float(np.max(heights))
    p = float(stats.gamma.sf(height, count)) * len(inside) / per if height >= LEAST_RATIO * count else 1.0
    near = inside[np.abs(inside - k) <= 2 * per]  # a strong peak lifts the floor beneath itself least at its feet
    k = int(near[np.argmax(power[near])])
    period, by_window = _refined(residual, rows, pieces, float(frequency[k]), 1 / (size * step))
    mean = float(np.sqrt(np.mean(by_window**2)))
    amplitudes = np.full(len(residual), mean)  # the end of a trip, in no window, has that of the others
    for piece, x in zip(pieces, by_window, strict=True):
        amplitudes[piece] = x
    return Period(period, mean, min(p, 1.0), amplitudes)


def _matched(white: np.ndarray, rows: Clocked) -> tuple[np.ndarray, np.ndarray]:
    """The matched filter of each row: its product with a load is that of the load's whitened column with `white`.
    Second, what a row weighs.

    Rows differ in length, and whitening takes from each what the one before predicts: what is left of a slow load is
    mostly what a long row has more of it than a short one. First rows, which none predicts, would outweigh many others
    and are left out.
    """
    signal, weight = np.empty_like(white), np.empty_like(white)
    for k, s in enumerate(rows.slices):
        sd = float(rows.noise.scales[1]) * float(rows.noise.trip_scale[min(k, len(rows.noise.trip_scale) - 1)])
        v = np.r_[0.0, white[s][1:], 0.0] / sd
        signal[s] = rows.worth[s] * (v[:-1] - float(rows.noise.coefficients[1, 0]) * v[1:])
        weight[s] = rows.worth[s] / sd
    return signal, weight


def _windows(clock: np.ndarray, trip: slice, window: float) -> list[slice]:
    """Rows of each window of a trip; what is left at its end counts where it is half of one."""
    total = float(clock[trip.stop - 1])
    edges = np.arange(0.0, total, window)
    starts = trip.start + np.searchsorted(clock[trip], edges)
    parts = [slice(int(a), int(b)) for a, b in pairwise([*starts, trip.stop])]
    return [p for p in parts if p.stop - p.start > 8 and clock[p.stop - 1] - clock[p.start] > 0.45 * window]


def _floors(power: np.ndarray, at: np.ndarray, per: int, count: int) -> np.ndarray:
    """The floor at every place; in long windows at some of them, evenly spread in log frequency, and between them."""
    some = at if len(at) <= PLACES else np.unique(np.geomspace(at[0], at[-1], PLACES).round().astype(int))
    floors = [np.log(_floor(power, int(k), per, count)) for k in some]
    return np.exp(np.interp(np.log(at), np.log(some), floors))


def _floor(power: np.ndarray, k: int, per: int, count: int) -> float:
    """The noise level at a place of the grid plus two standard errors, from independent frequencies around it.

    A smooth spectrum, falling as a power of frequency at most: its logarithm is linear in that of frequency. The
    logarithm of a sum of `count` exponential variables is digamma(count) on the average.
    """
    wide = max(6, k // per // 3)
    near = np.r_[np.arange(-wide, -1), np.arange(2, wide + 1)] * per + k
    near = near[(near >= 2 * per) & (near < len(power))]
    x = np.log(near)
    design = np.stack([x - x.mean(), np.ones(len(x))], axis=1)
    line = np.linalg.lstsq(design, np.log(power[near] + 1e-300) - float(special.digamma(count)), rcond=None)[0]
    at = np.array([np.log(k) - x.mean(), 1.0])
    se = float(np.sqrt(special.polygamma(1, count) * at @ np.linalg.inv(design.T @ design) @ at))
    return float(np.exp(line @ at + 2.0 * se))


def _refined(
    residual: np.ndarray, rows: Clocked, pieces: list[slice], frequency: float, width: float
) -> tuple[float, np.ndarray]:
    """Period and amplitude in each window by generalised least squares near a frequency."""
    white = rows.whitened(residual[:, None])[:, 0]
    best = (-1.0, 0.0, np.zeros(len(pieces)))
    for f in frequency + width * np.linspace(-1, 1, 9):
        angle = 2 * np.pi * f * rows.clock_s
        columns = rows.whitened(rows.worth[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1))
        gain, square = 0.0, []
        for s in pieces:
            x = np.linalg.lstsq(columns[s], white[s], rcond=None)[0]
            gain += float(white[s] @ columns[s] @ x)
            square.append(float(x @ x))
        if gain > best[0]:
            best = gain, float(1.0 / f), np.sqrt(square)
    return best[1], best[2]
