"""Histograms of a published drive cycle for the fleet's page: slopes and accelerations of the ZTBus missions.

python benchmarks/fleet_references.py     # prints what hdev_jax/report/fleet/sources.py holds
"""

import os
from pathlib import Path

import numpy as np

from hdev_jax.logs import read_log
from hdev_jax.report.fleet.sources import ACCEL_EDGES, GRADE_EDGES

__all__ = ["main"]


def main() -> None:
    """Shares by bin: of the distance for slopes, of the time in motion for accelerations."""
    root = Path(__file__).parents[1]
    data = Path(os.environ.get("HDEV_DATA") or root.parent / "shared" / "data") / "ztbus"
    log = read_log(sorted(data.glob("B*[0-9].csv.gz")), root / "configs/adapters/ztbus.toml")
    s = log.segments
    smooth = np.convolve(s.speed_mps, np.ones(3) / 3, mode="same")  # 1 Hz speeds of 0.1 m/s noise
    accel = np.gradient(smooth)
    moves = s.speed_mps > 0.5
    known = np.isfinite(s.channels["grade_rad"])
    grade = 100 * np.tan(s.channels["grade_rad"])
    for name, x, w, edges in (
        ("slope [%]", grade[known], s.distance_m[known], GRADE_EDGES),
        ("acceleration [m/s²]", accel[moves], s.duration_s[moves], ACCEL_EDGES),
    ):
        share = np.histogram(np.clip(x, edges[0], edges[-1]), edges, weights=w)[0] / w.sum()
        print(name, "(" + ", ".join(f"{v:.4f}" for v in share) + ")")
    energy = log.target("energy_wh")
    for i, trip in enumerate(log.trip_names):
        m = s.trip == i
        km, hours = s.distance_m[m].sum() / 1e3, s.duration_s[m].sum() / 3600
        print(f"{trip}: {km:.1f} km, {km / hours:.1f} km/h, {energy[m].sum() / 1e3 / km:.2f} kWh/km")


if __name__ == "__main__":
    main()
