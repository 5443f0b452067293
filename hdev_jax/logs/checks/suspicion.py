"""A suspicion: what is wrong with a log, why one thinks so, and the key of an adapter that mends it."""

from dataclasses import asdict, dataclass

import numpy as np

from hdev_jax.errors import InputError
from hdev_jax.logs.log import Log
from hdev_jax.units import UNITS_IN_USE, conversion

__all__ = ["Suspicion", "alternatives", "mended"]


@dataclass(frozen=True)
class Suspicion:
    """`what` is suspected (`unit of speed_mps`), the `evidence`, and how to `mend` it."""

    what: str
    evidence: str
    mend: str

    def line(self) -> str:
        """One line for the terminal."""
        return f"{self.what}: {self.evidence}; {self.mend}"

    def to_dict(self) -> dict[str, str]:
        """As the contract's diagnosis.json has it."""
        return asdict(self)


def alternatives(log: Log, name: str) -> dict[str, float]:
    """Other units that column `name` may have been in, and what its values would have to be multiplied by."""
    column = next((c for c in log.columns if c.name == name), None)
    units = UNITS_IN_USE.get(name, ())
    declared = (column.unit if column is not None else "") or units[0]

    def factor(unit: str) -> float:
        small = np.asarray(1e-3)  # of slopes, where the tangent is the angle
        return float(
            conversion(name, unit, where=name).call(small) - conversion(name, unit, where=name).call(0 * small)
        )

    try:
        own = factor(declared)
    except InputError:  # made from several columns, or by an expression: its unit is the one in memory
        own = factor(units[0])
    found = {unit: factor(unit) / own for unit in units}
    return {unit: k for unit, k in found.items() if abs(k - 1.0) > 1e-3}


def mended(log: Log, name: str, *, unit: str | None = None, sign: bool = False) -> str:
    """The line of an adapter that reads the column in another unit, or turns its sign."""
    column = next((c for c in log.columns if c.name == name), None)
    source = column.source if column is not None else name
    if " * " in source:  # voltage times current
        return f'in an adapter: [columns] {name} = {{ expr = "-voltage_v * current_a" }}, or turn the sign of current_a'
    declared = column.unit if column is not None else ""
    keys = [f'source = "{source}"']
    keys += ["affine = [0, -1]"] if sign else []
    keys += [f'unit = "{unit or declared}"'] if unit or declared else []
    return f"in an adapter: [columns] {name} = {{ {', '.join(keys)} }}"
