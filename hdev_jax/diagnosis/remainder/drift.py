"""What drifts: a remainder with a memory, what it behaves like, how large it is and how long it lasts.

A load under a controller has no levels and no channel. Means over a minute have little of the rows' own noise. Where
they are correlated from one minute to the next, their size says what they are: the same at standstill and at any speed
(a load), in proportion to speed (a force) or to power (a gain). Its course and its energy in each trip are those of a
Gauss-Markov process of that size and memory; where it behaves like none of these, the course is that of a load.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy import stats

from hdev_jax.diagnosis.settings import Settings
from hdev_jax.inference.states import course
from hdev_jax.segments import starts_of_runs, trip_slices

__all__ = ["Drift", "Slow", "drift_of"]

MINUTE_S = 60.0
LEAST_BLOCKS = 30
LONGEST = 60  # minutes between two means, at most


@dataclass(frozen=True)
class Slow:
    """Means over minutes, or over `mean_s`, of what a prediction leaves [W], with what it may be in proportion to: 1,
    the speed [m/s], the predicted power [W]; `seconds` and `trip` of each, and when it begins [s from the trip's first
    row]."""

    left_w: Float[np.ndarray, " minute"]
    forms: dict[str, Float[np.ndarray, " minute"]]
    seconds: Float[np.ndarray, " minute"]
    trip: Int[np.ndarray, " minute"]
    begins_s: Float[np.ndarray, " minute"]
    mean_s: float = MINUTE_S

    @classmethod
    def of(
        cls, residual_w: Float[np.ndarray, " row"], predicted_w: Float[np.ndarray, " row"],
        speed_mps: Float[np.ndarray, " row"], duration_s: Float[np.ndarray, " row"], trip: Int[np.ndarray, " row"],
        mean_s: float = MINUTE_S,
    ) -> "Slow":  # fmt: skip
        """From rows of whole trips."""
        at = starts_of_runs(trip, duration_s, mean_s)
        seconds = np.add.reduceat(duration_s, at)
        left, speed, power = (
            np.add.reduceat(x * duration_s, at) / seconds for x in (residual_w, np.abs(speed_mps), np.abs(predicted_w))
        )
        begins = np.concatenate([np.cumsum(seconds[s]) - seconds[s] for _, s in trip_slices(trip[at])])
        return cls(left, {"load": np.ones(len(at)), "force": speed, "gain": power}, seconds, trip[at], begins, mean_s)

    def take(self, kept: np.ndarray) -> "Slow":
        """Some of the minutes."""
        forms = {k: x[kept] for k, x in self.forms.items()}
        return Slow(self.left_w[kept], forms, self.seconds[kept], self.trip[kept], self.begins_s[kept], self.mean_s)


@dataclass(frozen=True)
class Drift:
    """What a slow remainder behaves like, its standard deviation (of a load in W, of a force in N, of a gain as a share
    of power; NaN where it is none of these), and the time after which its correlation has fallen to 1/e [s]; `own_w`,
    the rows' own noise in a mean over a minute, and `power_w`, its standard deviation as a load."""

    like: str
    sd: float
    memory_s: float
    own_w: float = 0.0
    power_w: float = 0.0

    @property
    def words(self) -> str:
        """As a part of a sentence; empty where nothing drifts."""
        if self.memory_s <= 0:
            return ""
        size = {
            "load": f"like a load of {self.sd / 1e3:.2g} kW (standard deviation)",
            "force": f"like a force of {float(f'{self.sd:.2g}'):g} N (standard deviation)",
            "gain": f"like a gain of {100 * self.sd:.2g} % of the power (standard deviation)",
        }.get(self.like, "but like no single load, force or gain")
        return f"it drifts, {size}; its correlation time is about {self.memory_s / 60:.0f} min"

    def course(self, slow: Slow, names: Sequence[str], shown: Sequence[int]) -> dict[str, Any] | None:
        """Its energy in each trip, and its power over one of the trips `shown`: the one in which it varies most; means
        and 90 % intervals given all that was measured in a trip. None where nothing drifts."""
        if self.memory_s <= 0 or self.own_w <= 0:
            return None
        g, sd = (slow.forms["load"], self.power_w) if self.like == "none" else (slow.forms[self.like], self.sd)
        found = course(
            slow.left_w, g, self.own_w * np.sqrt(slow.mean_s / slow.seconds), g * slow.seconds / 3.6e6, slow.seconds,
            slow.trip, sd=sd, memory_s=self.memory_s,
        )  # fmt: skip
        trips = [t for t, _ in trip_slices(slow.trip)]
        wide = float(stats.norm.ppf(0.95))
        ends = [found.total - wide * found.total_sd, found.total + wide * found.total_sd]
        kwh = zip(found.total.tolist(), *(x.tolist() for x in ends), strict=True)
        at = [np.flatnonzero(slow.trip == t) for t in shown]
        here = max(at, key=lambda rows: float(np.std(g[rows] * found.mean[rows])))
        mean, half = (g * found.mean)[here], wide * (g * found.sd)[here]
        return {
            "kwh_by_trip": {names[t]: list(each) for t, each in zip(trips, kwh, strict=True)},
            "trip": names[int(slow.trip[here[0]])], "time_s": (slow.begins_s + 0.5 * slow.seconds)[here].tolist(),
            "left_w": slow.left_w[here].tolist(), "power_w": mean.tolist(), "lower_w": (mean - half).tolist(),
            "upper_w": (mean + half).tolist(),
        }  # fmt: skip


def drift_of(slow: Slow, settings: Settings) -> Drift:
    """What is slow in what a prediction leaves. `like` is "none" with a memory of 0 where nothing is."""
    nothing = Drift("none", float("nan"), 0.0)
    whole = slow.seconds > 0.5 * slow.mean_s
    if np.count_nonzero(whole) < LEAST_BLOCKS:
        return nothing
    left = slow.left_w - np.mean(slow.left_w)
    memory = slow.mean_s * _memory(left, slow.trip, settings) if np.any(left) else 0.0
    if memory <= 0:
        return nothing
    # the rows' own noise in a mean: what neighbouring means do not share
    inside = np.diff(slow.trip) == 0
    own = max(0.5 * float(np.mean(np.diff(left)[inside] ** 2)), 1e-12)
    found = {like: _fit(left[whole], x[whole], own) for like, x in slow.forms.items()}
    best, second = sorted(found, key=lambda k: -found[k][0])[:2]
    like = best if found[best][0] - found[second][0] > settings.ahead else "none"
    sd = found[best][1] if like != "none" else float("nan")
    return Drift(like, sd, memory, float(np.sqrt(own)), found["load"][1])


def _memory(slow: np.ndarray, trip: np.ndarray, settings: Settings) -> int:
    """Means after which the correlation of means has fallen to 1/e; 0 where neighbours are not correlated."""

    def correlation(lag: int) -> tuple[float, int]:
        pair = trip[lag:] == trip[:-lag]
        return float(np.sum((slow[lag:] * slow[:-lag])[pair]) / np.sum(slow**2)), int(pair.sum())

    first, n = correlation(1)
    if n < LEAST_BLOCKS or first < settings.drifts or stats.norm.sf(first * np.sqrt(n)) > settings.level:
        return 0
    for lag in range(2, LONGEST + 1):
        if lag >= len(slow):
            break
        value, pairs = correlation(lag)
        if pairs < LEAST_BLOCKS or value < np.exp(-1):
            return lag
    return LONGEST


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
