"""What stays the same through a search: the training rows, the target, the library, the settings."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float

from hdev_jax.diagnosis.candidates.candidate import Grids
from hdev_jax.diagnosis.candidates.facts import Facts, facts_of
from hdev_jax.diagnosis.candidates.plan import Plan, plan_of
from hdev_jax.diagnosis.candidates.shared import SharedKernel
from hdev_jax.diagnosis.noise.noise import Noise, estimate_noise
from hdev_jax.diagnosis.scores.passes import Baseline
from hdev_jax.diagnosis.settings import SETTINGS, Settings
from hdev_jax.inference import CHUNK_ROWS, Calibration, Chunk, Clusters, Fit, ParameterTable, Shapes, chunks_of_fit
from hdev_jax.inference import calibrate as calibrate_rows
from hdev_jax.physics import Effect, Vehicle
from hdev_jax.segments import trip_slices
from hdev_jax.targets import TargetName

__all__ = ["Training"]


@dataclass(frozen=True, eq=False)
class Training:
    """Training rows with everything that a search over them needs beside the vehicle.

    `library` holds the candidates' classes by id; `gears` is the highest id of a gear or a kind of road that any trip
    of the log has.
    """

    rows: Fit
    target: TargetName
    clusters: Clusters
    library: Mapping[str, type[Effect]]
    gears: int
    settings: Settings = SETTINGS
    chunk_rows: int = CHUNK_ROWS
    _noise: dict[str, Any] = field(default_factory=dict, init=False, repr=False)

    @cached_property
    def trip(self) -> np.ndarray:
        """Trip id of each row."""
        return np.asarray(self.rows.segments.trip)[: self.rows.rows]

    @cached_property
    def seconds(self) -> np.ndarray:
        """Duration of each row [s]."""
        return np.asarray(self.rows.segments.duration_s)[: self.rows.rows]

    @cached_property
    def measured(self) -> np.ndarray:
        """The target as measured, in its unit."""
        return np.asarray(self.rows.measured)[: self.rows.rows]

    @cached_property
    def slices(self) -> list[slice]:
        """Rows of each trip."""
        return [s for _, s in trip_slices(self.trip)]

    @cached_property
    def facts(self) -> Facts:
        """What the candidates depend on beside the rows."""
        return facts_of(self.rows.segments, self.rows.rows)

    @cached_property
    def chunks(self) -> list[Chunk]:
        """The rows in chunks of whole trips."""
        longest = max(s.stop - s.start for s in self.slices)
        return list(chunks_of_fit(self.rows, Shapes(self.rows.rows, longest, self.chunk_rows)))

    def plan(
        self, vehicle: Vehicle, effects: Sequence[type[Effect]], grids: Grids | None = None, *, searched: bool = False
    ) -> Plan:
        """The candidates among `effects` beside the vehicle, by the programs that all vehicles of this search share."""
        facts, kernel = self.kernel.facts, self.kernel
        return plan_of(vehicle, effects, facts, self.target, grids, searched=searched, kernel=kernel)

    @cached_property
    def kernel(self) -> SharedKernel:
        """What all vehicles of this search are computed by; gears as found effects have them."""
        return SharedKernel(self.library, replace(self.facts, gears=self.gears), self.rows.segments)

    def calibrate(self, vehicle: Vehicle, table: ParameterTable) -> Calibration:
        """The vehicle fitted to these rows by least squares."""
        return calibrate_rows(
            vehicle, table, self.rows, self.target, self.clusters, chunks=self.chunks, linearise=self.kernel.linearised
        )

    def residual(self, fit: Calibration) -> Float[np.ndarray, " row"]:
        """Measured − predicted, in the target's unit."""
        return self.measured - fit.predicted

    def noise(self, fit: Calibration) -> Noise:
        """The noise of what a fit leaves."""
        if self._noise.get("of") is not fit.predicted:  # the last is used many times
            levels = self.clusters.kind == "trip"
            noise = estimate_noise(self.residual(fit), self.trip, self.seconds, levels=levels)
            self._noise.update({"of": fit.predicted, "is": noise})
        return self._noise["is"]

    def baseline(self, fit: Calibration, noise: Noise | None = None) -> Baseline:
        """What candidates are scored against: this fit with its noise, or with `noise`."""
        found = self.noise(fit) if noise is None else noise
        linearise = self.kernel.linearised
        return Baseline(lambda: self.chunks, self.clusters, len(self.slices), fit, self.target, found, linearise)

    def with_channel(self, name: str, column: Float[np.ndarray, " row"]) -> "Training":
        """The same rows with one channel more; 0 where they are padded."""
        padded = np.zeros(len(self.rows.segments))
        padded[: self.rows.rows] = column
        return replace(self, rows=replace(self.rows, segments=self.rows.segments.with_channels(**{name: padded})))
