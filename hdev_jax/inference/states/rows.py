"""Rows as the hidden Markov model takes them: a residual as a power, with what its states may depend on."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from hdev_jax.physics.loads import STANDSTILL_MPS
from hdev_jax.physics.states import COVARIATES, USUAL_C, covariates_of
from hdev_jax.segments import Segments, starts_of_runs

__all__ = ["StateRows", "rows_of"]

SAMPLES, MEANS = 0.1, 0.9  # chance that a row in which a load switches holds a share of its power
USUAL_S, MOST_RATIO = 10.0, 10.0  # 100 m at 36 km/h: an energy's errors are given as the power of a row as long


@dataclass(frozen=True)
class StateRows:
    """Rows of whole trips as the hidden Markov model takes them: what the vehicle's prediction leaves, as a power.
    `partly`: the chance that a row in which a load switches holds a share of its power and not all of it, as means over
    rows do and samples mostly do not."""

    residual_w: Float[np.ndarray, " row"]
    trip: Int[np.ndarray, " row"]
    duration_s: Float[np.ndarray, " row"]
    temp_c: Float[np.ndarray, " row"]
    standing: Int[np.ndarray, " row"]  # 1 at standstill, else 0
    partly: float = MEANS
    others: Float[np.ndarray, "row covariate"] | None = None  # `COVARIATES` in each row; None: of no interest
    energy: bool = False  # whether energies are measured: an error of one is a small power in a long row

    @property
    def beside(self) -> Float[np.ndarray, "row covariate"]:
        """`COVARIATES` in each row; 0 where they are not known."""
        return np.zeros((len(self.trip), len(COVARIATES))) if self.others is None else self.others

    @property
    def wide(self) -> Float[np.ndarray, " row"]:
        """How large the errors of each row are, as a power, over those of a row of `USUAL_S`; 1 where a power is
        measured."""
        if not self.energy:
            return np.ones(len(self.trip))
        return np.clip(USUAL_S / self.duration_s, 1.0 / MOST_RATIO, MOST_RATIO)

    @property
    def forgets_s(self) -> Float[np.ndarray, " row"]:
        """The time in which a row's error forgets that before it: of a power, the row's; of energies, of any row
        alike."""
        return np.full(len(self.trip), USUAL_S) if self.energy else self.duration_s

    @property
    def has_temperature(self) -> bool:
        """Whether the shares may depend on the temperature: where it varies at all."""
        return float(np.ptp(self.temp_c)) > 0 if len(self.temp_c) else False

    def take(self, rows: np.ndarray | slice) -> "StateRows":
        """Rows by mask, index or slice."""
        columns = (self.residual_w, self.trip, self.duration_s, self.temp_c, self.standing)
        residual, trip, seconds, temp, standing = (x[rows] for x in columns)
        others = None if self.others is None else self.others[rows]
        return StateRows(residual, trip, seconds, temp, standing, self.partly, others, self.energy)

    def coarse(self, seconds: float) -> "StateRows":
        """Means over runs of rows of at least so many seconds in a trip; the rows themselves where they are long."""
        at = starts_of_runs(self.trip, self.duration_s, seconds)
        total = np.add.reduceat(self.duration_s, at)

        def mean(x: np.ndarray) -> np.ndarray:
            return np.add.reduceat(x * self.duration_s, at) / total

        standing = (mean(self.standing.astype(float)) > 0.5).astype(int)
        return StateRows(mean(self.residual_w), self.trip[at], total, mean(self.temp_c), standing)


def rows_of(segments: Segments, residual_w: Float[np.ndarray, " row"], *, samples: bool) -> StateRows:
    """The first rows of (padded) segments with their residual [W]; `samples`: measured at an instant, no means."""
    n = len(residual_w)
    temp = np.broadcast_to(np.asarray(segments.get("ambient_temp_c", USUAL_C), dtype=float), len(segments))[:n]
    standing = (np.asarray(segments.speed_mps)[:n] < STANDSTILL_MPS).astype(int)
    return StateRows(
        np.asarray(residual_w, dtype=float), np.asarray(segments.trip)[:n], np.asarray(segments.duration_s)[:n],
        np.array(temp), standing, SAMPLES if samples else MEANS,
        np.asarray(covariates_of(segments))[:n].astype(float), not samples,
    )  # fmt: skip
