"""Charging at standstill: no drive, cut out and counted; the vehicle stands, and power flows into the battery."""

from dataclasses import replace

import numpy as np

from hdev_jax.logs.intervals import starts
from hdev_jax.logs.limits import CHARGES_W, STANDS_MPS
from hdev_jax.logs.rows.gathered import Rows
from hdev_jax.units import J_PER_WH

__all__ = ["without_charging"]

LASTS_S = 60.0  # regeneration is over within a sample or two after a stop; the shortest charge at a stop lasts minutes
BEYOND = 6.0  # standard deviations of noise at standstill
COHERENT = 8  # rows of one sign: 1 in 256 of as many rows of noise
CHARGED_WH = 200.0  # of one stand; less is also what the noise of a log of intervals gives while standing
_DRIVES = 20  # rows that accelerate, for a judgement on the sign


def _spread(power: np.ndarray) -> float:
    """Standard deviation of noisy power about 0 at standstill [W], by its positive side: charging is on the other."""
    return float(np.quantile(np.maximum(power, 0.0), 0.9)) / 1.2816 if len(power) else 0.0  # of a normal distribution


def without_charging(rows: Rows, sampled: bool, keep: bool) -> Rows:
    """Rows without those of charging; with `keep` they stay and are counted.

    Where power is negative while the vehicle accelerates, its sign is turned, and nothing is cut.
    """
    data = rows.data
    if not len(rows.trip) or not ({"battery_power_w", "energy_wh"} & data.keys()):
        return rows
    duration = _durations(rows)
    power = data["battery_power_w"] if "battery_power_w" in data else data["energy_wh"] * J_PER_WH / duration
    if sampled:
        v0 = v1 = data["speed_mps"]
        change = np.r_[np.diff(v0), 0.0]
    else:
        v0, v1 = data["speed_start_mps"], data["speed_end_mps"]
        change = v1 - v0
    stands = np.maximum(np.abs(v0), np.abs(v1)) < STANDS_MPS
    if "distance_m" in data:  # an interval may stand at both ends and drive between them
        stands &= ~(data["distance_m"] > STANDS_MPS * duration)
    pulls = ~stands & (change > 0) & (v0 > 1.0)
    if pulls.sum() >= _DRIVES and np.median(power[pulls]) < 0:
        return rows
    charges = stands & (power < CHARGES_W)
    if not charges.any():
        return rows
    opens = starts(rows.trip)
    opens[1:] |= stands[1:] != stands[:-1]
    edges = np.flatnonzero(opens)
    run = np.cumsum(opens) - 1
    long = np.add.reduceat(np.where(charges, duration, 0.0), edges) >= LASTS_S
    long &= np.add.reduceat(np.where(charges, -power * duration, 0.0), edges) >= CHARGED_WH * J_PER_WH
    index = np.arange(len(run))
    first = np.minimum.reduceat(np.where(charges, index, len(run)), edges)
    last = np.maximum.reduceat(np.where(charges, index, -1), edges)
    inside = (index >= first[run]) & (index <= last[run])
    # one sign in many rows, or far beyond what a noisy log shows at standstill: a few rows may be negative by chance
    rows_in, rows_of = np.add.reduceat(charges, edges), np.add.reduceat(inside, edges)
    coherent = (rows_in >= COHERENT) & (rows_in >= 0.9 * rows_of)
    mean = np.add.reduceat(np.where(charges, power, 0.0), edges) / np.maximum(rows_in, 1)
    long &= coherent | (mean < -BEYOND * _spread(power[stands]))
    cut = long[run] & inside
    if not cut.any():
        return rows
    kwh = -float(np.sum(power[cut] * duration[cut])) / 3.6e6
    trips = len(np.unique(rows.trip[cut]))
    what = f"charging at standstill, {np.sum(duration[cut]) / 60.0:.0f} min and {kwh:.3g} kWh in {trips} trip"
    what += "s" if trips > 1 else ""
    if keep:
        why = f"{what}; kept, as the adapter says"
        return replace(rows, ledger=rows.ledger.add("noted", why, count=int(cut.sum())))
    why = f'{what}; charging = "keep" in an adapter keeps it'
    return replace(rows, ledger=rows.ledger.add("dropped", why, count=int(cut.sum()))).take(~cut)


def _durations(rows: Rows) -> np.ndarray:
    if "duration_s" in rows.data:
        return rows.data["duration_s"]
    step = np.diff(rows.data["time_s"], append=np.nan)
    step[np.r_[rows.trip[1:] != rows.trip[:-1], True]] = np.nan
    return np.where(np.isfinite(step), step, float(np.nanmedian(step)) if np.isfinite(step).any() else 1.0)
