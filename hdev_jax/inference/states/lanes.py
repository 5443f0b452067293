"""Whole trips side by side in a few lanes, so that a scan over rows runs them together."""

from typing import Any, NamedTuple

import numpy as np

from hdev_jax.inference.rows import padded_rows
from hdev_jax.segments import trip_slices

__all__ = ["Lanes"]

LANES = 16  # trips run side by side


class Lanes(NamedTuple):
    """Where each row is: whole trips one after the other in a few lanes of about the same length."""

    lane: np.ndarray
    place: np.ndarray
    shape: tuple[int, int]
    starts: np.ndarray  # rows that begin a trip

    @classmethod
    def of(cls, trip: np.ndarray) -> "Lanes":
        slices = [s for _, s in trip_slices(trip)]
        filled = np.zeros(min(LANES, len(slices)), dtype=int)
        lane, place = np.empty(len(trip), dtype=int), np.empty(len(trip), dtype=int)
        for s in sorted(slices, key=lambda s: s.start - s.stop):
            k = int(np.argmin(filled))
            lane[s], place[s] = k, filled[k] + np.arange(s.stop - s.start)
            filled[k] += s.stop - s.start
        longest = int(filled.max())
        # a scan takes as long as its rows: no fewer than 64, and shapes that double up to those of any other program
        size = max(64, 2 ** (longest - 1).bit_length()) if longest <= padded_rows(1) else padded_rows(longest)
        return cls(lane, place, (size, len(filled)), np.array([s.start for s in slices]))

    def spread(self, values: np.ndarray, fill: Any) -> np.ndarray:
        out = np.empty((*self.shape, *values.shape[1:]))
        out[...] = fill
        out[self.place, self.lane] = values
        return out
