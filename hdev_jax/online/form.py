"""What stays the same while a vehicle is followed: its columns, its coefficients, how its noise is modelled."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hdev_jax.errors import InputError
from hdev_jax.inference.parameters import ParameterTable
from hdev_jax.targets import TARGETS, TargetName

__all__ = ["COUNTS", "LEVELS", "MEMORIES", "NEEDED", "Form", "packed"]

NEEDED = ("trip", "time_s", "duration_s", "distance_m", "speed_start_mps", "speed_end_mps", "measured")
COUNTS = ("rows", "used", "unusable", "unmeasured", "outliers", "gaps", "clock_jumps", "trips")
# correlation of a row's error with the one before: from white noise to one that lasts for 50 rows
MEMORIES = (0.0, 0.3, 0.6, 0.8, 0.9, 0.95, 0.98)
LEVELS: dict[str, tuple[str, ...]] = {
    "energy_wh": ("power", "force"), "battery_power_kw": ("power", "force"), "motor_torque_nm": ("constant",),
    "traction_force_n": ("constant",),
}  # fmt: skip


@dataclass(frozen=True)
class Form:
    """The structure of a state. Hashable: states of one form share a compiled program, and can be stacked.

    **Fields:** `columns` of a row in order (`NEEDED`, then the channels); `structure` says where each coefficient sits
    (`ParameterTable.structure`), `names` and `units` what it is called; `by_trip`, places of coefficients that each
    trip has anew; `levels`, what a trip's rows have in common besides (a load, a force); `memories`, the correlations
    from row to row that are weighed against each other; `robust`, whether outliers count less; `drifts`, whether any
    coefficient wanders; `known_noise`, whether the noise of a row is declared and not estimated; `level`, probability
    inside the intervals.
    """

    columns: tuple[str, ...]
    target: TargetName
    structure: tuple[tuple[str, int | None, float, float], ...]
    names: tuple[str, ...]
    units: tuple[str, ...]
    by_trip: tuple[int, ...]
    levels: tuple[str, ...]
    memories: tuple[float, ...]
    robust: bool
    drifts: bool
    known_noise: bool
    level: float

    @staticmethod
    def of(
        table: ParameterTable, channels: tuple[str, ...], target: TargetName, *, by_trip: tuple[str, ...],
        levels: bool, memories: tuple[float, ...], robust: bool, drifts: bool, known_noise: bool, level: float,
    ) -> "Form":  # fmt: skip
        """The form of a vehicle's table of coefficients. Raises `ValueError` for what is out of range."""
        if not memories or not all(0.0 <= m < 1.0 for m in memories):
            raise ValueError(f"memories: correlations of at least 0 and below 1 are expected, found {memories}")
        if not 0.0 < level < 1.0:
            raise ValueError(f"level: a probability between 0 and 1 is expected, found {level}")
        names = tuple(c.name for c in table.free)
        return Form(
            (*NEEDED, *sorted(channels)), target, table.structure, names, tuple(c.unit for c in table.free),
            tuple(k for k, c in enumerate(table.free) if c.path in by_trip), LEVELS[target] if levels else (),
            tuple(memories), robust, drifts, known_noise, level,
        )  # fmt: skip

    @property
    def channels(self) -> tuple[str, ...]:
        """Columns of a row that it may do without."""
        return self.columns[len(NEEDED) :]

    @property
    def size(self) -> int:
        """How many numbers are estimated: coefficients, then levels of the trip."""
        return len(self.names) + len(self.levels)

    @property
    def anew(self) -> tuple[int, ...]:
        """Places of those that each trip has anew."""
        return (*self.by_trip, *range(len(self.names), self.size))

    @property
    def counts(self) -> tuple[str, ...]:
        """What is counted: rows by what became of them, and by channel how often its last value stood in."""
        return (*COUNTS, *(f"held {c}" for c in ("distance_m", *self.channels)))

    @property
    def unit(self) -> str:
        """Unit of the target."""
        return TARGETS[self.target].unit


def packed(form: Form, row: Mapping[str, float]) -> np.ndarray:
    """A row by name as the vector that `update` takes; NaN where it has none.

    Raises `InputError` for a name that the form does not have.
    """
    if unknown := sorted(set(row) - set(form.columns)):
        raise InputError(f"row: unknown column '{unknown[0]}'; accepted: {', '.join(form.columns)}")
    return np.array([row.get(c, np.nan) for c in form.columns], dtype=float)
