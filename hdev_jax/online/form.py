"""What stays the same while a vehicle is followed: its columns, its coefficients, how its noise is modelled."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hdev_jax.errors import InputError
from hdev_jax.inference.parameters import ParameterTable
from hdev_jax.targets import TARGETS, TargetName

__all__ = ["COUNTS", "LASTING_S", "LEVELS", "MEMORIES", "NEEDED", "Form", "packed"]

NEEDED = ("trip", "time_s", "duration_s", "distance_m", "speed_start_mps", "speed_end_mps", "measured")
COUNTS = ("rows", "used", "unusable", "unmeasured", "charging", "outliers", "gaps", "clock_jumps", "trips")
# correlation of a row's error with the one before: from white noise to one that lasts for 30 rows
MEMORIES = (0.0, 0.5, 0.75, 0.87, 0.93, 0.97)
LASTING_S = (600.0, 3600.0)  # how long what a trip's rows have in common lasts: a road and its wind; a load, a payload
LEVELS: dict[str, tuple[str, ...]] = {
    "energy_wh": ("power", "force"), "battery_power_kw": ("power", "force"), "motor_torque_nm": ("constant",),
    "traction_force_n": ("constant",),
}  # fmt: skip


@dataclass(frozen=True)
class Form:
    """The structure of a state. Hashable: states of one form share a compiled program, and can be stacked.

    **Fields:**

    - `columns`: of a row, in order: `NEEDED`, then the channels.
    - `structure`, `names`, `units`: where each coefficient sits (`ParameterTable.structure`), its name and its unit.
    - `by_trip`: indices of the coefficients that are estimated anew in each trip.
    - `levels`: errors that neighbouring rows of a trip share (a load, a force).
    - `members`: the models of the noise that are weighed against each other, each a correlation from row to row and
      the time for which levels last [s].
    - `robust`: outliers count less. `drifts`: some coefficient drifts. `known_noise`: the noise of a row is declared.
    - `level`: probability inside the intervals.
    - `candidates`: the effect that each watched candidate is a form of. `alpha`: the probability that any effect is
      ever named although none is missing.
    """

    columns: tuple[str, ...]
    target: TargetName
    structure: tuple[tuple[str, int | None, float, float], ...]
    names: tuple[str, ...]
    units: tuple[str, ...]
    by_trip: tuple[int, ...]
    levels: tuple[str, ...]
    members: tuple[tuple[float, float], ...]
    robust: bool
    drifts: bool
    known_noise: bool
    level: float
    candidates: tuple[str, ...] = ()
    alpha: float = 0.01

    @staticmethod
    def of(
        table: ParameterTable, channels: tuple[str, ...], target: TargetName, *, by_trip: tuple[str, ...],
        levels: bool, memories: tuple[float, ...], lasting_s: tuple[float, ...], robust: bool, drifts: bool,
        known_noise: bool, level: float, candidates: tuple[str, ...] = (), alpha: float = 0.01,
    ) -> "Form":  # fmt: skip
        """The form of a vehicle's table of coefficients. Raises `ValueError` for what is out of range."""
        if not memories or not all(0.0 <= m < 1.0 for m in memories):
            raise ValueError(f"memories: correlations of at least 0 and below 1 are expected, found {memories}")
        if levels and not (lasting_s and all(s > 0.0 for s in lasting_s)):
            raise ValueError(f"lasting_s: times above 0 s are expected, found {lasting_s}")
        if not 0.0 < level < 1.0:
            raise ValueError(f"level: a probability between 0 and 1 is expected, found {level}")
        names = tuple(c.name for c in table.free)
        return Form(
            (*NEEDED, *sorted(set(channels) - {*NEEDED})), target, table.structure, names,
            tuple(c.unit for c in table.free),
            tuple(k for k, c in enumerate(table.free) if c.path in by_trip), LEVELS[target] if levels else (),
            tuple((m, s) for m in memories for s in (lasting_s if levels else (math.inf,))), robust, drifts,
            known_noise, level, candidates, alpha,
        )  # fmt: skip

    @property
    def channels(self) -> tuple[str, ...]:
        """Columns that a row may lack."""
        return self.columns[len(NEEDED) :]

    @property
    def memories(self) -> tuple[float, ...]:
        """Correlation from row to row of each member."""
        return tuple(m for m, _ in self.members)

    @property
    def effects(self) -> tuple[str, ...]:
        """The effects that are watched, each once."""
        return tuple(dict.fromkeys(self.candidates))

    @property
    def size(self) -> int:
        """How many numbers are estimated: coefficients, then levels of the trip."""
        return len(self.names) + len(self.levels)

    @property
    def anew(self) -> tuple[int, ...]:
        """Indices of what is estimated anew in each trip."""
        return (*self.by_trip, *range(len(self.names), self.size))

    @property
    def counts(self) -> tuple[str, ...]:
        """What is counted: how each row was used, and how often a channel's last value stood in for a missing one."""
        return (*COUNTS, *(f"held {c}" for c in ("distance_m", *self.channels)))

    @property
    def unit(self) -> str:
        """Unit of the target."""
        return TARGETS[self.target].unit


def packed(form: Form, row: Mapping[str, float]) -> np.ndarray:
    """The vector `[column]` that `update` takes, from a row as a mapping of names to numbers; NaN where one is missing.

    **Raises:** `InputError` for a name that the form does not have.
    """
    if unknown := sorted(set(row) - set(form.columns)):
        raise InputError(f"row: unknown column '{unknown[0]}'; accepted: {', '.join(form.columns)}")
    return np.array([row.get(c, np.nan) for c in form.columns], dtype=float)
