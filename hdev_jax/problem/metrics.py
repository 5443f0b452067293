"""Errors of a prediction, as the contract counts them."""

from typing import Any

import numpy as np
from jaxtyping import Float

from hdev_jax.targets import TARGETS

__all__ = ["metrics", "sum_weight"]


def sum_weight(target: str, duration_s: np.ndarray, distance_m: np.ndarray) -> Float[np.ndarray, " row"]:
    """What a row weighs in a sum (`Target.weight`)."""
    weights = {"row": np.ones(len(duration_s)), "duration": duration_s, "distance": distance_m}
    return np.asarray(weights[TARGETS[target].weight], dtype=float)


def metrics(measured: np.ndarray, predicted: np.ndarray, weight: np.ndarray) -> dict[str, Any]:
    """`rmse`, `mse`, `bias` (predicted − measured), `pe_percent`, `fit_percent`, `n`, in the target's unit.

    `pe_percent` is None where the sum is under 5 % of the sum of magnitudes (a round trip that gives back what it
    took has no percentage); `fit_percent` (paper 2, equation 21) is None where the target is constant.
    """
    error = predicted - measured
    total, magnitude = float(np.sum(weight * measured)), float(np.sum(weight * np.abs(measured)))
    spread = float(np.sqrt(np.mean((measured - np.mean(measured)) ** 2)))
    rmse = float(np.sqrt(np.mean(error**2)))
    return {
        "rmse": rmse,
        "mse": rmse**2,
        "bias": float(np.mean(error)),
        "pe_percent": 100.0 * float(np.sum(weight * error)) / total if abs(total) > 0.05 * magnitude else None,
        "fit_percent": 100.0 * (1.0 - rmse / spread) if spread > 0 else None,
        "n": len(measured),
    }
