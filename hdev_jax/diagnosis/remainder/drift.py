"""What drifts: a remainder with a memory, what it behaves like, how large it is and how long it lasts.

A load under a controller has no levels and no channel. Means over a minute have little of the rows' own noise. Where
they are correlated from one minute to the next, their size says what they are: the same at standstill and at any speed
(a load), in proportion to speed (a force) or to power (a gain).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy import stats

from hdev_jax.diagnosis.settings import Settings
from hdev_jax.segments import starts_of_runs

__all__ = ["LIKE", "Drift", "drift_of"]

MINUTE_S = 60.0
LEAST_BLOCKS = 30
LIKE = ("load", "force", "gain", "none")
LONGEST = 60  # minutes between two means, at most


@dataclass(frozen=True)
class Drift:
    """What a slow remainder behaves like, its standard deviation (of a load in W, of a force in N, of a gain as a share
    of power; NaN where it is none of these), and the time after which its correlation has fallen to 1/e [s]."""

    like: str
    sd: float
    memory_s: float

    @property
    def words(self) -> str:
        """As a part of a sentence; empty where nothing drifts."""
        if self.memory_s <= 0:
            return ""
        size = {
            "load": f"like a load of {self.sd / 1e3:.2g} kW",
            "force": f"like a force of {self.sd:.2g} N",
            "gain": f"like a gain of {100 * self.sd:.2g} % of the power",
        }.get(self.like, "like no single load, force or gain")
        return f"it drifts, {size} (standard deviation), and forgets in about {self.memory_s / 60:.0f} min"


def drift_of(
    residual_w: Float[np.ndarray, " row"],
    predicted_w: Float[np.ndarray, " row"],
    speed_mps: Float[np.ndarray, " row"],
    duration_s: Float[np.ndarray, " row"],
    trip: Int[np.ndarray, " row"],
    settings: Settings,
) -> Drift:
    """What is slow in a residual [W]. `like` is "none" with a memory of 0 where nothing is."""
    at = starts_of_runs(trip, duration_s, MINUTE_S)
    seconds = np.add.reduceat(duration_s, at)
    whole = seconds > 0.5 * MINUTE_S
    nothing = Drift("none", float("nan"), 0.0)
    if np.count_nonzero(whole) < LEAST_BLOCKS:
        return nothing

    def mean(x: np.ndarray) -> np.ndarray:
        return np.add.reduceat(x * duration_s, at) / seconds

    slow = mean(residual_w)
    block_trip = trip[at]
    slow = slow - np.mean(slow)
    if not np.any(slow):
        return nothing
    memory = _memory(slow, block_trip, settings)
    if memory <= 0:
        return nothing
    # the rows' own noise in a mean: what neighbouring means do not share
    inside = np.diff(block_trip) == 0
    own = max(0.5 * float(np.mean(np.diff(slow)[inside] ** 2)), 1e-12)
    forms = {"load": np.ones(len(slow)), "force": mean(np.abs(speed_mps)), "gain": mean(np.abs(predicted_w))}
    found = {like: _fit(slow[whole], x[whole], own) for like, x in forms.items()}
    best, second = sorted(found, key=lambda k: -found[k][0])[:2]
    like = best if found[best][0] - found[second][0] > settings.ahead else "none"
    return Drift(like, found[best][1] if like != "none" else float("nan"), memory)


def _memory(slow: np.ndarray, trip: np.ndarray, settings: Settings) -> float:
    """Time after which the correlation of minutes has fallen to 1/e [s]; 0 where neighbours are not correlated."""

    def correlation(lag: int) -> tuple[float, int]:
        pair = trip[lag:] == trip[:-lag]
        return float(np.sum((slow[lag:] * slow[:-lag])[pair]) / np.sum(slow**2)), int(pair.sum())

    first, n = correlation(1)
    if n < LEAST_BLOCKS or first < settings.drifts or stats.norm.sf(first * np.sqrt(n)) > settings.level:
        return 0.0
    for lag in range(2, LONGEST + 1):
        if lag >= len(slow):
            break
        value, pairs = correlation(lag)
        if pairs < LEAST_BLOCKS or value < np.exp(-1):
            return lag * MINUTE_S
    return LONGEST * MINUTE_S


def _fit(slow: np.ndarray, x: np.ndarray, own: float) -> tuple[float, float]:
    """Log-likelihood of means whose standard deviation is s·x beside their own, at the best s; and s."""
    square = np.mean(x**2) + 1e-300
    total = float(np.mean(slow**2))
    best = (-np.inf, 0.0)
    for share in np.geomspace(0.01, 4.0, 60):
        variance = share * total * x**2 / square + own
        value = -0.5 * float(np.sum(np.log(variance) + slow**2 / variance))
        if value > best[0]:
            best = (value, float(np.sqrt(share * total / square)))
    return best
