"""Coast-downs of vehicles whose A, B and C are known: both ways, on a slope, in wind with gusts, speeds with noise."""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from hdev_jax.units import GRAVITY_MPS2

__all__ = ["CAR", "TRUCK", "Coasting", "coast_downs"]

STEP_S = 0.1  # of the integration; the log has a sample each second
GUST_S = 5.0  # how long a gust lasts: wind near the ground has most of its changes at 1 to 10 s
SLOWEST_MPS = 12.0 / 3.6  # a run ends here, below the 15 km/h at which SAE J1263 ends


@dataclass(frozen=True)
class Coasting:
    """A vehicle that coasts: its road load, and the speed from which it does."""

    a_n: float
    b_n_per_mps: float
    c_n_per_mps2: float
    mass_kg: float
    rotating: float
    from_mps: float

    def force(self, kmh: float) -> float:
        """A + B·v + C·v² [N]."""
        v = kmh / 3.6
        return self.a_n + self.b_n_per_mps * v + self.c_n_per_mps2 * v**2


# c_rr 0.006 of 29 t, and C_d·A of 5.6 m² at 1.225 kg/m³; B is a tenth of A at 20 m/s
TRUCK = Coasting(1700.0, 8.5, 3.43, 29e3, 1.04, 92.0 / 3.6)
CAR = Coasting(180.0, 1.5, 0.42, 1600.0, 1.03, 122.0 / 3.6)


def coast_downs(
    vehicle: Coasting, *, seed: int, sets: int = 1, runs: int = 8, wind: float = 2.0, gust: float = 0.7,
    slope: float = 0.002, noise_mps: float = 0.05,
) -> list[pd.DataFrame]:  # fmt: skip
    """So many logs of `runs` runs, every other one the other way, 1 Hz, integrated all at once.

    **Arguments:** `wind` along the road [m/s], the same over a set; `gust`, the standard deviation of its changes
    within a run; `slope` [1] of the road. Wind and slope are in no column.
    """
    rng = np.random.default_rng(seed)
    way = np.where(np.arange(runs) % 2 == 0, 1.0, -1.0)
    v = np.full((sets, runs), vehicle.from_mps)
    gusts, kept = gust * rng.standard_normal((sets, runs)), [v]
    stays = np.exp(-STEP_S / GUST_S)
    per_s = round(1.0 / STEP_S)
    step = 0
    while np.any(kept[-1] > SLOWEST_MPS):
        step += 1
        gusts = stays * gusts + np.sqrt(1.0 - stays**2) * gust * rng.standard_normal(v.shape)
        air = v + way * (wind + gusts)
        force = (vehicle.a_n + vehicle.b_n_per_mps * v + vehicle.c_n_per_mps2 * air * np.abs(air)
                 + vehicle.mass_kg * GRAVITY_MPS2 * np.sin(way * slope))  # fmt: skip
        v = np.maximum(v - STEP_S * force / (vehicle.mass_kg * vehicle.rotating), 0.0)
        if step % per_s == 0:
            kept.append(v)
    every = np.stack(kept, axis=2)
    read = np.maximum(every + noise_mps * rng.standard_normal(every.shape), 0.0)
    out = []
    for true, speed in zip(every, read, strict=True):
        parts = []
        for k in range(runs):
            n = int(np.sum(true[k] > SLOWEST_MPS))
            parts.append(pd.DataFrame({
                "trip_id": f"run {k + 1:02d}", "time_s": np.arange(n, dtype=float), "speed_mps": speed[k, :n],
                "heading_rad": 0.3 if way[k] > 0 else 0.3 + np.pi,
            }))  # fmt: skip
        out.append(pd.concat(parts, ignore_index=True))
    return out
