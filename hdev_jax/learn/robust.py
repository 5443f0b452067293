"""Robust least squares for models that are linear in their coefficients."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

__all__ = ["HUBER", "Linear", "huber_fit"]

HUBER = 1.345  # 95 % efficiency under normal noise (Huber, Robust Statistics, 1981); in robust standard deviations
MAD_TO_SD = 1.4826


class Linear(NamedTuple):
    """Coefficients and the robust standard deviation of what they leave."""

    beta: Float[np.ndarray, " column"]
    sigma: float


def huber_fit(
    x: Any, y: Any, *, corner: float = HUBER, ridge: float = 1e-9, sweeps: int = 30, start: Any = None
) -> Linear:
    """Huber's M-estimate by reweighted least squares, in columns of unit size; least squares for an infinite corner.

    **Arguments:** `x` `[row, column]`, `y` `[row]`; `corner`, in robust standard deviations of the residual; `ridge`,
    relative to each column's own square; `start`, coefficients to begin from.
    """
    size = np.sqrt(np.mean(np.square(x), axis=0))
    size = np.where(size > 0, size, 1.0)
    z, y = np.asarray(x) / size, np.asarray(y, dtype=float)
    damp = ridge * len(y) * np.eye(z.shape[1])
    beta = np.linalg.solve(z.T @ z + damp, z.T @ y) if start is None else np.asarray(start) * size
    sigma = 0.0
    for _ in range(sweeps if np.isfinite(corner) else 1):
        r = z @ beta - y
        sigma = MAD_TO_SD * float(np.median(np.abs(r))) + 1e-300
        if not np.isfinite(corner):
            break
        w = np.minimum(1.0, corner * sigma / np.maximum(np.abs(r), 1e-300))
        weighed = z * w[:, None]
        new = np.linalg.solve(weighed.T @ z + damp, weighed.T @ y)
        moved = float(np.max(np.abs(z[:: max(1, len(z) // 1000)] @ (new - beta))))
        beta = new
        if moved < 1e-4 * sigma:
            break
    return Linear(beta / size, sigma)
