"""Noise of a synthetic log, by its colour."""

import numpy as np

__all__ = ["NOISES", "noise_of_one", "root_mean_square"]

NOISES = ("white", "ar1", "ar1_white", "trip_levels", "student_t", "trip_variance")


def root_mean_square(x: np.ndarray) -> float:
    """√(mean of the squares), in the unit of `x`."""
    return float(np.sqrt(np.mean(x**2)))


def _ar1(innovations: np.ndarray, coefficient: float) -> np.ndarray:
    """Stationary AR(1) along the last axis from unit-variance innovations."""
    noise = np.empty_like(innovations)
    noise[:, 0] = innovations[:, 0]
    for k in range(1, innovations.shape[1]):
        noise[:, k] = coefficient * noise[:, k - 1] + np.sqrt(1 - coefficient**2) * innovations[:, k]
    return noise


def noise_of_one(rng: np.random.Generator, rows: np.ndarray, kind: str, coefficient: float) -> np.ndarray:
    """Noise of RMS 1 over the log. `ar1_white`: a fifth of the variance is white; `trip_levels`: half of it is a level
    by trip; `student_t`: innovations with three degrees of freedom; `trip_variance`: sizes log-normal by trip."""
    trips, n = len(rows), int(rows.max())
    white = rng.standard_normal((trips, n))
    tails = rng.standard_t(3, (trips, n)) / np.sqrt(3.0)
    other = rng.standard_normal((trips, n))
    levels, sizes = rng.standard_normal((trips, 1)), np.exp(0.6 * rng.standard_normal((trips, 1)))
    noise = {
        "white": lambda: white,
        "ar1": lambda: _ar1(white, coefficient),
        "ar1_white": lambda: np.sqrt(0.8) * _ar1(white, coefficient) + np.sqrt(0.2) * other,
        "trip_levels": lambda: np.sqrt(0.5) * (_ar1(white, coefficient) + levels),
        "student_t": lambda: _ar1(tails, coefficient),
        "trip_variance": lambda: sizes * _ar1(white, coefficient),
    }[kind]()
    flat = noise[np.arange(n)[None, :] < rows[:, None]]
    return flat / root_mean_square(flat)
