"""`by_distance`: samples put together to stretches of road of one length, and halts, by trip."""

import math
from dataclasses import replace

import numpy as np

from hdev_jax.errors import InputError
from hdev_jax.logs.intervals import starts
from hdev_jax.logs.ledger import Ledger
from hdev_jax.logs.log import Log
from hdev_jax.logs.repair import CIRCULAR
from hdev_jax.segments import ACCEL_OF_WAY, ACCEL_SD, GRADE_SD, SPREAD, SQUARE_SPEED, Segments
from hdev_jax.units import unit_of

__all__ = ["HALT_S", "by_distance"]

HALT_S = 10.0  # a bus stop or a red light; shorter is stop-and-go, a part of driving the stretch
# What a metre of road has or costs: m·g·sinθ·Δs, force·Δs. Torque is a force at the shaft.
_OF_THE_ROAD = (
    "grade_rad", GRADE_SD, "altitude_m", "curvature_1pm", "wet_road", "mass_kg", "traction_force_n", "motor_torque_nm",
    ACCEL_OF_WAY, SQUARE_SPEED,
)  # fmt: skip
_WITHIN = {ACCEL_OF_WAY: "accel_of_way_mps2", SQUARE_SPEED: "square_speed_m2ps2"}  # properties of the rows
_STATES = ("gear", "road_surface")  # kinds, which have no mean
_ROUNDING = 1e-6  # of a length: ten samples of 10 m are 100 m, whatever their sum is in binary


def by_distance(log: Log, length_m: float = 100.0, *, halt_s: float = HALT_S) -> Log:
    """The log with its rows put together to stretches of `length_m` of road, and to halts.

    **Stretches.** A new stretch begins where the distance since the start of the trip passes a multiple of `length_m`.
    Rows of the log stay whole and belong to the stretch in which they *begin*, so the length of a stretch is off by at
    most that of one row. The last stretch of a trip is shorter.

    **Halts.** Rows at rest (distance and end speeds 0) that last `halt_s` together become one row with distance 0, and
    the stretch that they interrupt becomes two shorter rows. Shorter halts are part of their stretch, and so are the
    moments in which a sampled vehicle comes to rest. With `halt_s = inf` no halt is cut out.

    **Values.** Time, distance and energy are summed, and conserved in every trip to rounding. Powers and most channels
    are means over time. Slope, altitude, curvature, mass, force and torque are means over distance, where there is any;
    the slope is arcsin of the mean of sin θ, so the climbed height is conserved too. Headings and wind directions are
    mean directions [0, 2π). Flags become the share of time. The gear, the kind of surface and other whole numbers
    without a unit take the value held longest (of two held equally long, the lower).

    What varies inside a stretch is lost, but for three channels that the kernel uses: means over distance of the
    acceleration, so that m·a·Δs stays Δ(½mv²), and of v², for the drag (`accel_over_distance_mps2`,
    `square_speed_m2ps2`), and the standard deviation over distance of the acceleration (`accel_spread_mps2`): a stretch
    that is driven and braked has losses in both directions. Where force or torque is logged the kernel starts from its
    mean, and such losses cancel.

    **Arguments:** `log` of any rows (`[row]`, samples or intervals); `length_m` > 0 [m]; `halt_s` > 0 [s].

    **Returns:** a `Log` of intervals of the same trips and vehicles; its ledger says what became of rows and channels.

    **Raises:** `InputError` where a length or time is not positive, or the log has no rows.
    """
    if not (math.isfinite(length_m) and length_m > 0):
        raise InputError(f"length_m: a positive length in metres is expected, found {length_m:g}")
    if not halt_s > 0:
        raise InputError(f"halt_s: a positive time in seconds is expected (inf: no halts apart), found {halt_s:g}")
    if not len(log):
        raise InputError("a log without rows has no distance to cut")
    s = log.segments
    trip, duration, distance = (np.asarray(x) for x in (s.trip, s.duration_s, s.distance_m))
    halt = _halts(log, halt_s)
    first = np.flatnonzero(_cuts(trip, distance, halt, length_m))
    last = np.r_[first[1:], len(trip)] - 1
    row = np.repeat(np.arange(len(first)), last - first + 1)
    time, way = np.add.reduceat(duration, first), np.add.reduceat(distance, first)
    ledger = _cut_entries(log, length_m, halt_s, halts=int(halt[first].sum()), way=way, halt=halt[first])
    channels = {}
    by_way = np.where(way[row] > 0, distance, duration)
    for name, column in (s.without(SPREAD).channels | {k: getattr(s, p) for k, p in _WITHIN.items()}).items():
        x = np.asarray(column, dtype=np.float64)
        if name in CIRCULAR:
            channels[name], how = _direction(x, duration, first), "mean direction over time"
        elif name not in _WITHIN and _is_state(name, x):
            channels[name], how = _held_longest(x, duration, row), "the value held longest"
        elif name == ACCEL_SD:  # of the difference of a stretch's end speeds, whatever lies between
            usual = _mean(x, duration, first)
            spans = 2.0 if log.sampled else 1.0  # the rows between the readings of a row's acceleration
            channels[name], how = usual * np.minimum(spans / (last - first + 1), 1.0), "the error of the end speeds"
        elif name in _OF_THE_ROAD:
            channels[name], how = _mean(x, by_way, first, slope=name == "grade_rad"), "mean over distance"
        else:
            channels[name], how = _mean(x, duration, first), "mean over time"
        ledger = ledger.add("derived", f"{how} in each row", column=name)
    channels[SPREAD] = _spread(s, by_way, first)
    ledger = ledger.add("derived", "standard deviation over distance in each row", column=SPREAD)
    measured = {}
    for name, y in log.measured.items():
        total = name == "energy_wh"
        measured[name] = np.add.reduceat(y, first) if total else np.add.reduceat(y * duration, first) / time
        ledger = ledger.add("derived", f"{'sum' if total else 'mean over time'} in each row", column=name)
    segments = Segments(
        trip=trip[first],
        vehicle=np.asarray(s.vehicle)[first],
        time_s=np.asarray(s.time_s)[first],
        duration_s=time,
        distance_m=way,
        speed_start_mps=np.asarray(s.speed_start_mps)[first],
        speed_end_mps=np.asarray(s.speed_end_mps)[last],
        channels=channels,
    )
    return replace(log, segments=segments, measured=measured, ledger=ledger, sampled=False)


def _halts(log: Log, halt_s: float) -> np.ndarray:
    """True for rows that are part of standing still for `halt_s` or longer, from end to end."""
    s = log.segments
    ends = np.asarray(s.speed_start_mps) + np.asarray(s.speed_end_mps)
    standing = (np.asarray(s.distance_m) == 0) & (ends == 0)
    first = starts(np.asarray(s.trip))
    first[1:] |= standing[1:] != standing[:-1]
    edges = np.flatnonzero(first)
    stood = np.add.reduceat(np.asarray(s.duration_s), edges)
    # a hundred samples of 0.1 s are 10 s, whatever their sum is in binary
    return standing & np.repeat(stood >= halt_s * (1.0 - _ROUNDING), np.diff(np.r_[edges, len(standing)]))


def _cuts(trip: np.ndarray, distance_m: np.ndarray, halt: np.ndarray, length_m: float) -> np.ndarray:
    """True at rows that open a new one: of a trip, of a stretch by where they begin, of a halt and after it."""
    first = starts(trip)
    edges = np.flatnonzero(first)
    begin = np.cumsum(distance_m) - distance_m
    begin -= np.repeat(begin[edges], np.diff(np.r_[edges, len(trip)]))
    stretch = np.floor(begin / length_m + _ROUNDING)
    first[1:] |= (halt[1:] != halt[:-1]) | (~halt[1:] & (stretch[1:] != stretch[:-1]))
    return first


def _cut_entries(log: Log, length_m: float, halt_s: float, *, halts: int, way: np.ndarray, halt: np.ndarray) -> Ledger:
    """The log's ledger, and what was put together."""
    ledger = log.ledger.add("derived", f"{length_m:g} m of road each, or a halt, from {len(log)} rows", count=len(way))
    if halts:
        ledger = ledger.add("derived", f"halts of {halt_s:g} s or longer, apart from the road", count=halts)
    if short := int(np.sum(~halt & (way < 0.5 * length_m))):
        ledger = ledger.add(
            "noted", f"under half of {length_m:g} m: before or after a halt, or ends a trip", count=short
        )
    if whole := int(np.sum(np.asarray(log.segments.distance_m) > length_m)):
        ledger = ledger.add("noted", f"longer than {length_m:g} m as they came, not divided", count=whole)
    return ledger


def _is_state(name: str, x: np.ndarray) -> bool:
    """Whether a channel holds kinds or counts: whole numbers without a unit that are more than a flag."""
    if name in _STATES:
        return True
    whole = unit_of(name) in (None, "dimensionless") and bool(np.all(x == np.round(x)))
    return whole and not np.all((x == 0) | (x == 1))


def _mean(x: np.ndarray, weight: np.ndarray, first: np.ndarray, *, slope: bool = False) -> np.ndarray:
    """Weighted mean of each row; inside the range of its values, so that what is constant stays so to the last bit."""
    total = np.add.reduceat(weight, first)
    if slope:
        mean = np.arcsin(np.clip(np.add.reduceat(np.sin(x) * weight, first) / total, -1.0, 1.0))
    else:
        mean = np.add.reduceat(x * weight, first) / total
    return np.clip(mean, np.minimum.reduceat(x, first), np.maximum.reduceat(x, first))


def _spread(s: Segments, weight: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Standard deviation of the acceleration in each row, with what it may be, or was, inside the rows before [m/s²].
    (Not of the slope: a logged one varies by its noise more than a road does in 100 m.)"""
    x = np.asarray(s.accel_of_way_mps2)
    mean, total = _mean(x, weight, first), np.add.reduceat(weight, first)
    away = x - np.repeat(mean, np.diff(np.r_[first, len(x)]))
    inside = away**2 + sum(np.asarray(s.get(k, np.zeros(len(s)))) ** 2 for k in (SPREAD, ACCEL_SD))
    return np.sqrt(np.add.reduceat(inside * weight, first) / total)


def _direction(x: np.ndarray, weight: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Direction of the sum of unit vectors [rad], in [0, 2π]."""
    y, z = (np.add.reduceat(f(x) * weight, first) for f in (np.sin, np.cos))
    return np.mod(np.arctan2(y, z), 2.0 * np.pi)


def _held_longest(x: np.ndarray, duration_s: np.ndarray, row: np.ndarray) -> np.ndarray:
    """For each row the value with the longest time; the lower of two."""
    order = np.lexsort((x, row))
    values, rows = x[order], row[order]
    edges = np.flatnonzero(starts(rows) | np.r_[True, values[1:] != values[:-1]])
    values, rows, held = values[edges], rows[edges], np.add.reduceat(duration_s[order], edges)
    longest = np.lexsort((-held, rows))  # stable: of equal times the lower value comes first
    return values[longest][starts(rows[longest])]
