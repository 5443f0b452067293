"""What the candidates of a log depend on beside its rows: channels, trips, groups, the length of a row."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Float, Int

from hdev_jax.physics import GROUPS, most_group
from hdev_jax.segments import Segments

__all__ = ["Facts", "facts_of", "merged", "thinned"]

MOST_STEPS = 24  # places for a change that stays: beyond, every few trips, and refined about the best
LEAST_SHARE = 0.02  # of the rows, for a group to have a coefficient of its own


@dataclass(frozen=True)
class Facts:
    """What of a whole log its candidates depend on; the rows themselves may come a chunk at a time.

    `sample` is one row (which channels there are), `trips` the ids in order, `vehicles` whose each is, `row_s` the
    median duration of a row [s], `groups` how many rows each id of a grouping channel has, `gears` the highest such id
    (at least 1), `means` of the channels.
    """

    sample: Segments
    trips: Int[np.ndarray, " trip"]
    vehicles: Int[np.ndarray, " trip"]
    rows: int
    row_s: float
    groups: Mapping[str, Mapping[int, int]]
    gears: int
    means: Mapping[str, float]

    @property
    def steps(self) -> tuple[float, ...]:
        """Ids of trips from which on something may have changed: of the last vehicle's trips alone."""
        return thinned(self._open)

    @property
    def _open(self) -> Int[np.ndarray, " trip"]:
        """Trips with three of the same vehicle on either side: fewer are odd trips, and vehicles differ."""
        own = self.trips[len(self.trips) - np.argmin(np.r_[self.vehicles[::-1] == self.vehicles[-1], False]) :]
        return own[3:-2]

    def steps_near(self, at: float) -> tuple[float, ...]:
        """The trips between the two steps beside `at`; `at` alone where every trip is a step already."""
        steps = self.steps
        if at not in steps or len(steps) == len(self._open):
            return (at,)
        k = steps.index(at)
        low, high = steps[max(k - 1, 0)], steps[min(k + 1, len(steps) - 1)]
        inside = self.trips[(self.trips >= min(low + 1, at)) & (self.trips <= max(high - 1, at))]
        return tuple(sorted({at, *thinned(inside)}))

    def seen(self, channel: str) -> list[int]:
        """Groups of the channel that enough rows are in, the commonest first."""
        counts = self.groups.get(channel, {})
        enough = [k for k, n in sorted(counts.items()) if n > LEAST_SHARE * self.rows]
        return sorted(enough, key=lambda k: -counts[k])


def thinned(ids: np.ndarray, most: int = MOST_STEPS) -> tuple[float, ...]:
    """At most so many of the ids, evenly spread."""
    at = np.arange(len(ids)) if len(ids) <= most else np.linspace(0, len(ids) - 1, most).round().astype(int)
    return tuple(float(t) for t in np.asarray(ids)[at])


def facts_of(segments: Segments, rows: int | None = None) -> Facts:
    """Facts of the first `rows` rows, all of them by default. Raises `ValueError` where there are none."""
    n = len(segments) if rows is None else rows
    if n < 1:
        raise ValueError("a log of no rows has no candidates; expected at least one row")
    part = jax.tree.map(lambda x: np.asarray(x)[:n], segments)
    groups = {}
    for name in GROUPS:
        if part.has(name):
            x = np.asarray(part.channels[name], dtype=float)
            # an id below 0 (reverse, unknown) takes what 0 has: `Grouped.at`
            ids, counts = np.unique(np.maximum(x[np.isfinite(x)].astype(int), 0), return_counts=True)
            groups[name] = {int(k): int(c) for k, c in zip(ids, counts, strict=True)}
    row_s = float(np.median(np.asarray(part.duration_s)))
    trips, first = np.unique(np.asarray(part.trip), return_index=True)
    vehicles = np.asarray(part.vehicle)[first]
    means = {k: float(np.mean(v)) for k, v in part.channels.items()}
    return Facts(segments.take(np.arange(1)), trips, vehicles, n, row_s, groups, most_group(part), means)


def merged(parts: Iterable[Facts], duration_s: Float[np.ndarray, " row"]) -> Facts:
    """Facts of a log from those of its parts and the durations of all its rows [s].

    Raises `ValueError` where the parts do not have the same channels.
    """
    every = list(parts)
    first = every[0]
    groups: dict[str, dict[int, int]] = {name: {} for name in first.groups}
    for f in every:
        if odd := set(f.sample.channels) ^ set(first.sample.channels):
            raise ValueError(f"every part of a log has the same channels; not in all of them: {', '.join(sorted(odd))}")
        for name, counts in f.groups.items():
            for k, n in counts.items():
                groups[name][k] = groups[name].get(k, 0) + n
    trips, at = np.unique(np.concatenate([f.trips for f in every]), return_index=True)
    vehicles = np.concatenate([f.vehicles for f in every])[at]
    rows, gears = sum(f.rows for f in every), max(f.gears for f in every)
    means = {k: sum(f.means[k] * f.rows for f in every) / rows for k in first.means}
    return Facts(first.sample, trips, vehicles, rows, float(np.median(duration_s)), groups, gears, means)
