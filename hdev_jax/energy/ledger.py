"""The ledger of a vehicle's energy: kWh by cause for each trip, week and vehicle, closed by what is unexplained."""

import datetime
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from scipy import sparse

from hdev_jax.energy.causes import ByCause, by_cause, is_load
from hdev_jax.energy.fitted import Fitted, interval
from hdev_jax.errors import InputError
from hdev_jax.logs import Log
from hdev_jax.physics.loads import STANDSTILL_MPS
from hdev_jax.segments import trip_slices
from hdev_jax.targets import TARGETS

__all__ = [
    "COLUMNS",
    "PARKED_S",
    "SUM",
    "TOTAL",
    "TRACTION_REST",
    "UNEXPLAINED",
    "Groups",
    "Ledger",
    "groups_of",
    "ledger_of",
]

TRACTION_REST = "traction_unexplained"
UNEXPLAINED, TOTAL, SUM = "unexplained", "measured", "all causes"
PARKED_S = 300.0  # a stop of at least so long is parking; traffic lights and bus stops are shorter
LEAST_SHARE = 0.05  # of Σ|measured| under which a total has no shares (contract, section 4: pe_percent)
COLUMNS = ("level", "name", "cause", "kwh", "lower", "upper", "kwh_per_100km", "share_percent", "cost")


@dataclass(frozen=True)
class Groups:
    """Sets of trips that a table has a block for: their `names`, and `member` [group, trip], SciPy's sparse."""

    level: str
    names: tuple[str, ...]
    member: Any


@dataclass(frozen=True)
class Ledger:
    """`rows`: a line for each level, name and cause (`COLUMNS`); `about`: one for each level and name, with what is no
    part of the sum (km, hours, regenerated share, …); `undated`: how many trips have no date and so no week."""

    rows: pd.DataFrame
    about: pd.DataFrame
    undated: int


def groups_of(log: Log) -> tuple[list[Groups], int]:
    """All trips, each vehicle where there are several, each week (ISO 8601) of trips with a date, each trip; and how
    many trips have no date."""
    names = log.trip_names
    there, first = np.unique(log.trip, return_index=True)
    vehicle = np.asarray(log.segments.vehicle)[first]
    whose = {int(i): log.vehicle_names[int(k)] for i, k in zip(there, vehicle, strict=True)}
    weeks = {i: _week(log.started_s[names[i]]) for i in whose if names[i] in log.started_s}
    out = [_by("all", dict.fromkeys(whose, "all"), len(names))]
    if len(set(whose.values())) > 1:
        out.append(_by("vehicle", whose, len(names)))
    if weeks:
        out.append(_by("week", dict(sorted(weeks.items(), key=lambda x: x[1])), len(names)))
    out.append(_by("trip", {i: names[i] for i in whose}, len(names)))
    return out, len(there) - len(weeks)


def _week(seconds: float) -> str:
    year, week, _ = datetime.datetime.fromtimestamp(seconds, datetime.UTC).isocalendar()
    return f"{year}-W{week:02d}"


def _by(level: str, label: Mapping[int, str], trips: int) -> Groups:
    names = tuple(dict.fromkeys(label.values()))
    place = {name: k for k, name in enumerate(names)}
    at = [place[name] for name in label.values()], list(label)
    return Groups(level, names, sparse.csr_array((np.ones(len(label)), at), shape=(len(names), trips)))


def ledger_of(fitted: Fitted, *, price: float | None = None, road: Fitted | None = None, seed: int = 0) -> Ledger:
    """Energy by cause, with 90 % intervals, of a log that measures it.

    What the battery gave, by cause as `causes` attributes it; *unexplained* is measured less the sum of the causes, so
    that each block adds up to the measured energy exactly. Intervals of causes are draws of the coefficients through
    the kernel; that of *unexplained* has the noise of the trips besides: where it holds 0, what is left is no more than
    noise and coefficients allow.

    **Arguments:** `price` of a kWh, in any currency; `road`, the same vehicle fitted to the traction force or the motor
    torque where the log measures that: what the drive gave is then told by road forces, and what these leave of it
    (friction brakes, what the model lacks) is a cause of its own.

    **Raises:** `InputError` where the target is not the battery's.
    """
    problem = fitted.problem
    if not TARGETS[problem.target].of_battery:
        raise InputError(f"a ledger is of battery energy or power, and {problem.target} is measured before the battery")
    parts = by_cause(fitted, fitted.draws(seed))
    if road is not None:
        parts = parts.split("traction", by_cause(road, road.draws(seed + 1)), TRACTION_REST)
    log = problem.log
    measured_wh = np.asarray(log.target("energy_wh"))
    flows = _flows(log, measured_wh)
    noise = fitted.noise_kwh()
    wobble = np.random.default_rng(seed).standard_t(fitted.freedom, (len(parts.drawn), len(noise))) * noise
    groups, undated = groups_of(log)
    rows, about = [], []
    for g in groups:
        block = parts.grouped(g.member)
        sums = {k: g.member @ x for k, x in flows.items()}
        km, total, size = (sums[k] for k in ("km", "measured", "size"))
        low, high = interval(block.drawn)
        left = total - block.value.sum(axis=1)
        off = interval(total - block.drawn.sum(axis=2) + (g.member @ wobble.T).T)
        for k, name in enumerate(g.names):
            lines = [(c, block.value[k, j], low[k, j], high[k, j]) for j, c in enumerate(block.causes)]
            lines += [(UNEXPLAINED, left[k], off[0][k], off[1][k]), (TOTAL, total[k], total[k], total[k])]
            shares = abs(total[k]) > LEAST_SHARE * size[k]
            for cause, kwh, lower, upper in lines:
                rows.append(
                    (g.level, name, cause, kwh, lower, upper,
                     100.0 * kwh / km[k] if km[k] > 0 else np.nan,
                     100.0 * kwh / total[k] if shares else np.nan,
                     np.nan if price is None else price * kwh)
                )  # fmt: skip
            about.append(
                {"level": g.level, "name": name, **_about({n: float(x[k]) for n, x in sums.items()}, block, k)}
            )
    return Ledger(pd.DataFrame(rows, columns=list(COLUMNS)), pd.DataFrame(about), undated)


def _flows(log: Log, measured_wh: np.ndarray) -> dict[str, np.ndarray]:
    """Sums of each trip: km, hours, energy out of and back into the battery, while standing, while parked [kWh]."""
    s = log.segments
    seconds, kwh = np.asarray(s.duration_s), measured_wh / 1e3
    stands = np.asarray(s.speed_mps) < STANDSTILL_MPS
    parked = _long(stands, np.asarray(s.trip), seconds)

    def by_trip(x: np.ndarray) -> np.ndarray:
        return np.bincount(log.trip, weights=x, minlength=len(log.trip_names))

    return {
        "trips": by_trip(np.r_[True, np.diff(log.trip) != 0].astype(float)),
        "km": by_trip(np.asarray(s.distance_m) / 1e3),
        "hours": by_trip(seconds / 3600.0),
        "measured": by_trip(kwh),
        "size": by_trip(np.abs(kwh)),
        "out": by_trip(np.maximum(kwh, 0.0)),
        "regenerated": by_trip(np.maximum(-kwh, 0.0)),
        "standing": by_trip(np.where(stands, kwh, 0.0)),
        "parked": by_trip(np.where(parked, kwh, 0.0)),
        "parked_hours": by_trip(np.where(parked, seconds / 3600.0, 0.0)),
    }


def _long(stands: np.ndarray, trip: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """Rows in stops of at least `PARKED_S`."""
    out = np.zeros(len(stands), dtype=bool)
    for _, s in trip_slices(trip):
        runs = np.cumsum(np.r_[0, np.diff(stands[s].astype(int)) != 0])
        long = np.bincount(runs, weights=seconds[s]) >= PARKED_S
        out[s] = stands[s] & long[runs]
    return out


def _about(sums: Mapping[str, float], block: ByCause, k: int) -> dict[str, Any]:
    """What a block says besides its sum. Regenerated: energy into the battery over energy out of it, row by row."""
    out = sums["out"]
    loads = [j for j, c in enumerate(block.causes) if is_load(c)]
    auxiliary = float(block.value[k, loads].sum())
    low, high = (float(x) for x in interval(block.drawn[:, k, loads].sum(axis=1)))
    per = 100.0 / out if out > 0 else np.nan
    return {
        **{n: sums[n] for n in ("km", "hours")}, "trips": int(sums["trips"]),
        "measured_kwh": sums["measured"],
        "kwh_per_100km": 100.0 * sums["measured"] / sums["km"] if sums["km"] > 0 else np.nan,
        "regenerated_kwh": sums["regenerated"], "regenerated_percent": per * sums["regenerated"],
        "auxiliary_kwh": auxiliary, "auxiliary_percent": per * auxiliary,
        "auxiliary_percent_lower": per * low, "auxiliary_percent_upper": per * high,
        "standing_kwh": sums["standing"], "parked_kwh": sums["parked"], "parked_hours": sums["parked_hours"],
    }  # fmt: skip
