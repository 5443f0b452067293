"""Loads that switch, added to a synthetic log: which second each is on in is drawn, whatever the log shows.

Second by second in plain NumPy, shared with nothing of the kernel: a row holds the share of its time that a load is on.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np

from hdev_jax.fleet.log import SyntheticLog

__all__ = ["KINDS", "Load", "with_loads"]

Kind = Literal["chain", "thermostat", "timer"]
KINDS: tuple[Kind, ...] = ("chain", "thermostat", "timer")
CABIN_C, HYSTERESIS_C, CABIN_TAU_S = 20.0, 1.0, 900.0  # a bus's cabin cools by 1/e in a quarter of an hour


@dataclass(frozen=True)
class Load:
    """An on/off load of `power_w` [W].

    `kind`: `chain`, a Markov chain that is on a share of time and stays on for `dwell_s` on average; with `by_temp`
    the share falls by so much per kelvin above 10 °C; `thermostat`, a heater with hysteresis whose share is `share` at
    10 °C; `timer`, a clock of `dwell_s` on, as long off as the share asks, with 20 % of jitter.
    """

    power_w: float
    kind: Kind = "chain"
    share: float = 0.4
    dwell_s: float = 90.0
    by_temp: float = 0.0


def _share(load: Load, temp_c: float) -> float:
    return float(np.clip(load.share - load.by_temp * (temp_c - 10.0), 0.0, 0.98))


def _seconds_on(load: Load, temp_c: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Whether it is on in each second of a trip, from the outside temperature in each."""
    n = len(temp_c)
    out = np.zeros(n)
    if load.kind == "thermostat":
        # heat balance: dT/dt = (T_out − T)/tau + heat·on, the heat such that it is on for `share` at 10 °C
        heat = (CABIN_C - 10.0) / CABIN_TAU_S / load.share
        cabin, on = CABIN_C + rng.uniform(-HYSTERESIS_C, HYSTERESIS_C), bool(rng.random() < load.share)
        for k in range(n):
            on = cabin < CABIN_C + HYSTERESIS_C if on else cabin < CABIN_C - HYSTERESIS_C
            cabin += (temp_c[k] - cabin) / CABIN_TAU_S + heat * on
            out[k] = on
        return out
    k, on = 0, bool(rng.random() < _share(load, temp_c[0]))
    first = True
    while k < n:
        share = _share(load, temp_c[k])
        mean = load.dwell_s if on else load.dwell_s * (1.0 - share) / max(share, 1e-3)
        length = rng.exponential(mean) if load.kind == "chain" else mean * (1.0 + 0.2 * rng.standard_normal())
        if first:  # the trip begins somewhere inside
            length, first = length * (1.0 if load.kind == "chain" else rng.random()), False
        stop = min(n, k + max(1, round(length)))
        out[k:stop] = on
        k, on = stop, not on
    return out


def with_loads(log: SyntheticLog, loads: Sequence[Load], *, seed: int) -> SyntheticLog:
    """The log with these loads in its target. `truth` gets `on:<k>`, the share of each row that load k is on."""
    frame, truth = log.frame.copy(), log.truth.copy()
    rng = np.random.default_rng([seed, 48])
    trip = frame["trip_id"].to_numpy()
    temp = frame["ambient_temp_c"].to_numpy(dtype=float) if "ambient_temp_c" in frame else np.full(len(frame), 10.0)
    seconds = np.asarray(log.drive.columns["duration_s"], dtype=float)
    cuts = np.r_[0, np.flatnonzero(trip[1:] != trip[:-1]) + 1, len(trip)]
    power = np.zeros(len(frame))
    for k, load in enumerate(loads):
        share = np.zeros(len(frame))
        for a, b in pairwise(cuts):
            edges = np.r_[0.0, np.cumsum(seconds[a:b])]
            clock = np.arange(int(np.ceil(edges[-1])) + 1)
            outside = np.interp(clock, 0.5 * (edges[1:] + edges[:-1]), temp[a:b])
            total = np.r_[0.0, np.cumsum(_seconds_on(load, outside, rng))]
            on_by = np.interp(edges, np.arange(len(total)), total)
            share[a:b] = np.diff(on_by) / seconds[a:b]
        truth[f"on:{k}"] = share
        power += load.power_w * share
    if log.target == "energy_wh":
        frame["energy_wh"] += power * seconds / 3600.0
    else:
        column = "battery_power_kw" if "battery_power_kw" in frame else "battery_power_w"
        frame[column] += power / (1e3 if column.endswith("kw") else 1.0)
    return replace(log, frame=frame, truth=truth)
