"""Efficiency maps: a CSV table over gear, motor speed and torque, read into the kernel's `EfficiencyMap`."""

import csv
import math
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from hdev_jax.errors import InputError
from hdev_jax.logs.adapter import near
from hdev_jax.physics import EfficiencyMap
from hdev_jax.textfiles import read_text

__all__ = ["MAP_COLUMNS", "read_map"]

_FAR = 1e9
MAP_COLUMNS = ("gear", "motor_speed_radps", "motor_torque_nm", "efficiency")


def read_map(path: str | Path) -> EfficiencyMap:
    """The map in a CSV file with the columns of `MAP_COLUMNS`, one row per grid point, in any order.

    Speeds [rad/s] and torques [Nm] are those at the motor shaft. Every combination of the gears, speeds and torques
    that occur must be there. A map with a single speed or torque does not depend on it. Other columns are ignored.

    **Raises:** `InputError` for a file that cannot be read, a missing column, a cell that is no number, an efficiency
    outside (0, 1], a point given twice, and a hole in the grid.
    """
    path = Path(path)
    return _grid(path, _points(path, read_text(path, "efficiency map")))


def _points(path: Path, text: str) -> dict[tuple[float, float, float], float]:
    """Efficiency by (gear, speed, torque)."""
    lines = text.splitlines()
    delimiter = ";" if lines and ";" in lines[0] else ","
    header = [h.strip() for h in next(csv.reader(lines[:1], delimiter=delimiter), [])]
    for name in MAP_COLUMNS:
        if name not in header:
            found = f"found {', '.join(header)}" if header else "the file is empty"
            raise InputError(
                f"efficiency map {path}: column '{name}' is missing{near(name, header)}; {found}; "
                f"expected {', '.join(MAP_COLUMNS)}"
            )
    points: dict[tuple[float, float, float], float] = {}
    for number, cells in enumerate(csv.reader(lines[1:], delimiter=delimiter), start=2):
        if not any(c.strip() for c in cells):
            continue
        row = dict(zip(header, cells, strict=False))
        gear, speed, torque, efficiency = (_cell(path, number, name, row.get(name, "")) for name in MAP_COLUMNS)
        if not 0 < efficiency <= 1:
            raise InputError(
                f"efficiency map {path}: line {number}: efficiency {efficiency:g}; a number above 0 and "
                "up to 1 is expected"
            )
        if (gear, speed, torque) in points:
            raise InputError(f"efficiency map {path}: line {number}: {_name(gear, speed, torque)} is there twice")
        points[gear, speed, torque] = efficiency
    if not points:
        raise InputError(f"efficiency map {path}: no rows; one per gear, motor speed and torque is expected")
    return points


def _cell(path: Path, line: int, column: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        found = f"found '{text.strip()}'" if text.strip() else "found nothing"
        raise InputError(f"efficiency map {path}: line {line}, column '{column}': a number is expected, {found}")
    return value


def _name(gear: float, speed: float, torque: float) -> str:
    return f"gear {gear:g}, {speed:g} rad/s, {torque:g} Nm"


def _grid(path: Path, points: dict[tuple[float, float, float], float]) -> EfficiencyMap:
    gears, speeds, torques = ([*sorted({p[k] for p in points})] for k in range(3))
    holes = [(g, s, t) for g in gears for s in speeds for t in torques if (g, s, t) not in points]
    if holes:
        more = f" and {len(holes) - 1} more" if len(holes) > 1 else ""
        raise InputError(
            f"efficiency map {path}: a hole at {_name(*holes[0])}{more}; every combination of its {len(gears)} gears, "
            f"{len(speeds)} speeds and {len(torques)} torques is expected"
        )
    values = np.array([[[points[g, s, t] for t in torques] for s in speeds] for g in gears])
    # interpolation needs a cell: an axis of one point goes on at the same value, and nothing lies beyond it
    if len(speeds) == 1:
        speeds, values = [speeds[0] - _FAR, speeds[0] + _FAR], np.repeat(values, 2, axis=1)
    if len(torques) == 1:
        torques, values = [torques[0] - _FAR, torques[0] + _FAR], np.repeat(values, 2, axis=2)
    return EfficiencyMap(*(jnp.asarray(x, dtype=float) for x in (gears, speeds, torques, values)))
