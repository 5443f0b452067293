"""Errors of a prediction, as the contract counts them."""

from typing import Any

import numpy as np
from jaxtyping import Float

__all__ = ["PER_KWH", "metrics", "sum_weight"]

# of a weighed sum, by target: Wh, kW·s and N·m; a torque's sum is no energy
PER_KWH = {"energy_wh": 1e3, "battery_power_kw": 3600.0, "traction_force_n": 3.6e6}


def sum_weight(target: str, duration_s: np.ndarray, distance_m: np.ndarray) -> Float[np.ndarray, " row"]:
    """What a row weighs in a sum: power by duration, force and torque by distance, energy as it is.

    A torque turns with the wheels: by distance its sum is work, of one gear, and standing still adds nothing.
    """
    if target == "energy_wh":
        return np.ones(len(duration_s))
    return np.asarray(duration_s if target == "battery_power_kw" else distance_m, dtype=float)


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
