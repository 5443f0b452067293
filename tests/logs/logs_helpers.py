"""Small logs to write and read back."""

from pathlib import Path

import numpy as np
import pandas as pd

from hdev_jax.logs import Adapter, Log, read_log

N = 300


def samples(n: int = N, dt: float = 1.0, seed: int = 0, trip: str = "A") -> pd.DataFrame:
    """One trip of samples with battery power."""
    rng = np.random.default_rng(seed)
    speed = np.abs(10.0 + np.cumsum(rng.normal(0, 0.3, n)))
    return pd.DataFrame(
        {
            "trip_id": trip,
            "time_s": np.arange(n) * dt,
            "speed_mps": speed,
            "ambient_temp_c": 10.0 + rng.normal(0, 1.0, n),
            "battery_power_w": 500.0 * speed + rng.normal(0, 10.0, n),
        }
    )


def intervals(n: int = N, seed: int = 0, trip: str = "A") -> pd.DataFrame:
    """One trip of intervals with energy."""
    rng = np.random.default_rng(seed)
    v = np.abs(10.0 + np.cumsum(rng.normal(0, 0.3, n + 1)))
    duration = 200.0 / (v[1:] + v[:-1])
    return pd.DataFrame(
        {
            "trip_id": trip,
            "time_s": np.r_[0.0, np.cumsum(duration)[:-1]],
            "duration_s": duration,
            "distance_m": 100.0,
            "speed_start_mps": v[:-1],
            "speed_end_mps": v[1:],
            "grade_rad": rng.normal(0, 0.01, n),
            "energy_wh": 20.0 + rng.normal(0, 1.0, n),
        }
    )


def write(folder: Path, frame: pd.DataFrame, name: str = "log.csv", **options) -> Path:
    """The frame as a file of the kind that the name says."""
    path = folder / name
    if name.endswith(".parquet"):
        frame.to_parquet(path)
    else:
        frame.to_csv(path, index=False, **options)
    return path


def read(folder: Path, frame: pd.DataFrame, adapter: dict | None = None, name: str = "log.csv") -> Log:
    """Write the frame and read it back."""
    path = write(folder, frame, name)
    return read_log(path, None if adapter is None else Adapter.from_dict(adapter))
