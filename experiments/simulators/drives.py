"""What a vehicle drives: micro-trips of standard cycles in random order, over random hills."""

from dataclasses import dataclass

import numpy as np

__all__ = ["Drive", "hills", "micro_trips", "random_drive"]

STOP_MPS = 0.05


@dataclass(frozen=True)
class Drive:
    """One trip at 1 Hz: `speed_mps` at each second, from standstill to standstill, and the slope `grade` (rise over
    run) of the second that ends there."""

    speed_mps: np.ndarray
    grade: np.ndarray


def micro_trips(speed_mps: np.ndarray) -> list[np.ndarray]:
    """A cycle at 1 Hz cut at its stops: each part begins at rest, drives, and ends with the stop that follows."""
    moves = np.asarray(speed_mps) > STOP_MPS
    begins = np.flatnonzero(moves[1:] & ~moves[:-1])
    ends = [*begins[1:], len(speed_mps) - 1]
    return [np.asarray(speed_mps[a : b + 1], dtype=float) for a, b in zip(begins, ends, strict=True)]


def random_drive(
    rng: np.random.Generator, cycles: list[np.ndarray], seconds: float, *, stretch: float = 1.0, top_mps: float = 60.0,
    steepest: float = 0.04,
) -> Drive:  # fmt: skip
    """Micro-trips drawn until `seconds` are over; the first of each cycle is in turn as likely as any.

    **Arguments:** `stretch`, by which time is lengthened, so that a heavy vehicle accelerates less; `top_mps`, the
    highest speed, to which all are scaled; `steepest`, the largest slope.
    """
    parts = [p for c in cycles for p in micro_trips(c)]
    highest = max(float(np.max(p)) for p in parts)
    scale = min(1.0, top_mps / highest)
    speed = np.zeros(3)
    while len(speed) < seconds:
        part = scale * parts[int(rng.integers(len(parts)))]
        at = np.arange(0.0, len(part) - 1, 1.0 / stretch)
        speed = np.concatenate([speed, np.interp(at, np.arange(len(part)), part), np.zeros(int(rng.integers(2, 15)))])
    before = np.r_[0.0, speed[:-1]]
    return Drive(speed, hills(rng, np.cumsum(0.5 * (before + speed)), steepest))


def hills(rng: np.random.Generator, distance_m: np.ndarray, steepest: float) -> np.ndarray:
    """Slope (rise over run) at each distance: five waves of 300 m to 3 km with random phases, `steepest` at most."""
    lengths = rng.uniform(300.0, 3000.0, 5)
    waves = np.sin(2 * np.pi * (distance_m[:, None] / lengths + rng.uniform(0.0, 1.0, 5)))
    return steepest * np.tanh(1.2 * waves @ rng.normal(size=5) / np.sqrt(2.5))
