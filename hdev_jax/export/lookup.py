"""Consumption at steady speeds as a table over speed, slope, mass and temperature, with its interpolation error."""

import io
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.interpolate import RegularGridInterpolator

from hdev_jax.errors import InputError
from hdev_jax.export.exported import Exported, LeftOut
from hdev_jax.export.kernel import Kernel

__all__ = ["AXES", "interpolated", "lookup"]

AXES = ("speed_mps", "grade_rad", "mass_kg", "ambient_temp_c")
VALUE = "consumption_wh_per_km"
# from walking pace, below which consumption per km is that of the loads alone, to a coach's limit
_SPEEDS = (2.0, 30.0)
_SLOPES = (-0.08, 0.08)  # of main roads
_MASSES = (0.5, 1.6)  # of the sheet's mass: empty to full
_TEMPERATURES = (-20.0, 40.0)
_ERROR = 0.01  # of the mean size of the values: the table is refined until interpolation errs less, root mean square
_MOST = 40_000  # rows
_CHECKED = 4096  # points between the grid's


def lookup(kernel: Kernel) -> Exported:
    """CSV, a row for each point of a grid, the last axis fastest; to be interpolated linearly along each axis.

    The axis whose points are too far apart gets twice as many until the error is below 1 % of the mean size of the
    values or the table has 40,000 rows; the errors are in the file beside. An axis of which the vehicle's consumption
    does not depend has one point. **Raises:** `InputError` for a sheet that wants the slope absent.
    """
    if "grade_rad" not in kernel.channels or "mass_kg" not in kernel.channels:
        raise InputError("--to lookup: the inputs grade_rad and mass_kg are expected; leave out --channels")
    left = list(kernel.left_out)
    left.append(
        LeftOut("acceleration", "the table is of steady speeds: what speeding up and braking cost is not in it")
    )
    for name in sorted({*kernel.channels} - {*AXES}):
        left.append(LeftOut(name, f"no axis of the table: held at {kernel.typical[name]:g}"))
    mass = kernel.typical["mass_kg"]
    grid = [
        np.geomspace(*_SPEEDS, 9), np.linspace(*_SLOPES, 9), np.linspace(_MASSES[0] * mass, _MASSES[1] * mass, 3),
        np.linspace(*_TEMPERATURES, 3),
    ]  # fmt: skip
    if "ambient_temp_c" not in kernel.channels:
        grid[-1] = np.array([20.0])
        left.append(LeftOut("ambient_temp_c", "no effect of the sheet depends on it: the axis has one point"))
    values, stuck = _values(kernel, grid), False
    while not stuck:
        at, errors = _errors(kernel, grid, values)
        if np.sqrt(np.mean(errors**2)) < _ERROR * np.mean(np.abs(at)):
            break
        finer = [[*grid[:k], _halved(g), *grid[k + 1 :]] for k, g in enumerate(grid) if len(g) > 1]
        able = [g for g in finer if np.prod([len(x) for x in g]) <= _MOST]
        stuck = not able
        if able:
            each = [(g, _values(kernel, g)) for g in able]
            grid, values = min(each, key=lambda x: float(np.mean(_errors(kernel, *x)[1] ** 2)))
    at, errors = _errors(kernel, grid, values)
    about = {
        "axes": {name: [float(x) for x in g] for name, g in zip(AXES, grid, strict=True)}, "value": VALUE,
        "interpolation": "linear along each axis", "checked_points": len(errors),
        "error_wh_per_km": {
            "rms": float(np.sqrt(np.mean(errors**2))), "p95": float(np.quantile(np.abs(errors), 0.95)),
            "largest": float(np.max(np.abs(errors))), "mean_size_of_values": float(np.mean(np.abs(at))),
        },
    }  # fmt: skip
    return Exported(_csv(grid, values, about), about, tuple(left))


def interpolated(axes: dict[str, Any], values: Float[np.ndarray, "*grid"], at: Float[np.ndarray, "point axis"]) -> Any:
    """What a reader of the table gets between its points; axes of one point are passed over."""
    long = [k for k, g in enumerate(axes.values()) if len(g) > 1]
    points = [np.asarray(list(axes.values())[k], float) for k in long]
    return RegularGridInterpolator(points, np.reshape(values, [len(p) for p in points]))(at[:, long])


def _values(kernel: Kernel, grid: list[np.ndarray]) -> np.ndarray:
    points = np.stack(np.meshgrid(*grid, indexing="ij"), axis=-1)
    return _consumption(kernel, points.reshape(-1, len(AXES))).reshape(points.shape[:-1])


def _consumption(kernel: Kernel, at: np.ndarray) -> np.ndarray:
    speed, *rest = at.T
    power = kernel.steady(speed, **dict(zip(AXES[1:], rest, strict=True)))
    return power / speed / 3.6


def _errors(kernel: Kernel, grid: list[np.ndarray], values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The kernel at points between the grid's, and how far linear interpolation is from it [Wh/km]."""
    u = np.random.default_rng(0).random((_CHECKED, len(AXES)))
    at = np.stack([g[0] + x * (g[-1] - g[0]) for g, x in zip(grid, u.T, strict=True)], axis=1)
    true = _consumption(kernel, at)
    return true, interpolated(dict(zip(AXES, grid, strict=True)), values, at) - true


def _halved(axis: np.ndarray) -> np.ndarray:
    """With a point in the middle of each two."""
    return np.sort(np.r_[axis, 0.5 * (axis[1:] + axis[:-1])])


def _csv(grid: list[np.ndarray], values: np.ndarray, about: dict[str, Any]) -> bytes:
    error, text = about["error_wh_per_km"], io.StringIO()
    points = np.stack(np.meshgrid(*grid, indexing="ij"), axis=-1).reshape(-1, len(AXES))
    text.write(
        f"# consumption at steady speed; linear interpolation errs by {error['rms']:.3g} Wh/km (rms), "
        f"{error['p95']:.3g} (95 %), {error['largest']:.3g} (largest)\n"
    )
    header = ",".join((*AXES, VALUE))
    np.savetxt(text, np.column_stack([points, values.ravel()]), "%.9g", ",", header=header, comments="")
    return text.getvalue().encode()
