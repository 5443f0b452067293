"""Channels of a trip that a row adds to, as rows come: the distance driven so far, the time since the last braking.

What the kernel works out for whole trips (`physics.across`), one row after the other: effects that need no more of a
trip than these act on each row alone.
"""

from collections.abc import Iterable, Iterator, Mapping
from typing import NamedTuple

import numpy as np

from hdev_jax.physics.across import BRAKING_PA, DISTANCE_SINCE_START, TIME_SINCE_BRAKING

__all__ = ["Running", "running_channels"]

PRESSURE = "brake_pressure_pa"


def running_channels(names: Iterable[str]) -> tuple[str, ...]:
    """Those that rows with these columns allow."""
    return (DISTANCE_SINCE_START, *((TIME_SINCE_BRAKING,) if PRESSURE in names else ()))


class Running(NamedTuple):
    """Of the trip so far: metres driven, and the end of its last braked row [s]; NaN before any."""

    metres: float = 0.0
    braked_s: float = float("nan")

    def after(self, row: Mapping[str, float]) -> tuple["Running", dict[str, float]]:
        """One row more, with its interval: what is known after it, and the row's channels, at its middle."""
        duration = row.get("duration_s", np.nan)
        metres = row.get("distance_m", np.nan)
        if not np.isfinite(metres):
            metres = 0.5 * (row.get("speed_start_mps", np.nan) + row.get("speed_end_mps", np.nan)) * duration
        metres = metres if np.isfinite(metres) and metres >= 0.0 else 0.0
        time, braking = row.get("time_s", np.nan), row.get(PRESSURE, np.nan) > BRAKING_PA
        since = 0.0 if braking or np.isnan(self.braked_s) else time + 0.5 * duration - self.braked_s
        end = time + duration
        channels = {DISTANCE_SINCE_START: self.metres + 0.5 * metres, TIME_SINCE_BRAKING: since}
        return Running(self.metres + metres, end if braking and np.isfinite(end) else self.braked_s), channels

    @staticmethod
    def over(rows: Iterable[tuple[object, Mapping[str, float]]]) -> Iterator[dict[str, float]]:
        """The channels of every row of a log, each with its trip."""
        trip, so_far = object(), Running()
        for other, row in rows:
            if other != trip:
                trip, so_far = other, Running()
            so_far, channels = so_far.after(row)
            yield channels
