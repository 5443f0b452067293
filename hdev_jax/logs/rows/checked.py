"""Rows checked and repaired: which are dropped, which end the reading."""

from dataclasses import replace

import numpy as np
import pandas as pd

from hdev_jax.errors import InputError
from hdev_jax.logs.intervals import starts
from hdev_jax.logs.limits import BAD_SHARE, MANY_STEEP, MAX_GRADE_RAD, MAX_POWER_W, MAX_SPEED_MPS, REVERSE_MPS
from hdev_jax.logs.rows.gathered import Rows, regrouped, split_restarts

__all__ = ["check_rows"]

SLOPE_COUNTS_MPS = 1.0  # below, a slope from altitude over distance is noise, and costs little
_SAME = "the same time_s as the row before, other values"
_SPEEDS = ("speed_mps", "speed_start_mps", "speed_end_mps")


def check_rows(rows: Rows, sampled: bool, measured: list[str]) -> Rows:
    """Duplicates and bad rows dropped and counted, speeds clipped, order checked; `origin_s` is then a trip's start."""
    rows = _drop_duplicates(rows)
    for c in _SPEEDS:
        if c in rows.data and np.nanmax(rows.data[c], initial=0.0) > MAX_SPEED_MPS:
            i = int(np.nanargmax(rows.data[c] > MAX_SPEED_MPS))
            raise InputError(
                f"{rows.where(i)}, column {c}: {rows.data[c][i]:.6g} m/s is above {MAX_SPEED_MPS:g} m/s; "
                f"if the file has km/h, name the column {c.replace('_mps', '_kmh')} or give its unit in an adapter"
            )
    rows = _with_targets(split_restarts(regrouped(rows)), measured)
    rows = _fill_durations(_without_cliffs(rows), sampled)
    bad, reasons = _bad_rows(rows, sampled, measured)
    rows = _one_vehicle(_check_order(rows, bad))
    if bad.any():
        total, count = len(bad), int(bad.sum())
        told = "; ".join(f"{n} with {why}" for why, (n, _) in reasons.items())
        if count > BAD_SHARE * total:
            raise InputError(
                f"{rows.name}: {count} of {total} rows ({count / total:.1%}) cannot be used: {told}; the first is "
                f"{rows.where(int(np.argmax(bad)))}; at most {BAD_SHARE:.0%} are dropped, so repair the log"
                f"{_mend(reasons)}"
            )
        ledger = rows.ledger
        for why, (n, first) in reasons.items():
            ledger = ledger.add("dropped", f"{why}; first in {rows.where(first)}", count=n)
        rows = replace(rows, ledger=ledger).take(~bad)
    return _clip_speeds(rows)


def _with_targets(rows: Rows, measured: list[str]) -> Rows:
    """Trips that never measure what others do are left out: a combustion car among electric ones."""
    for c in measured:
        there = np.bincount(rows.trip[rows.trip >= 0], np.isfinite(rows.data[c])[rows.trip >= 0], len(rows.trip_names))
        lacking = (there == 0)[rows.trip] & (rows.trip >= 0)
        if lacking.any() and not lacking.all():
            trips = len(np.unique(rows.trip[lacking]))
            why = f"not measured in any row of {trips} trip{'s' if trips > 1 else ''}: left out"
            ledger = rows.ledger.add("dropped", why, count=int(lacking.sum()), column=c)
            rows = replace(rows, ledger=ledger).take(~lacking)
    return rows


def _without_cliffs(rows: Rows) -> Rows:
    """Slopes that no road has: where they are few, or the vehicle hardly moves, they count as missing; where they are
    many, the column is in another unit."""
    grade = rows.data.get("grade_rad")
    if grade is None or not (steep := np.isfinite(grade) & (np.abs(grade) > MAX_GRADE_RAD)).any():
        return rows
    speed = next(rows.data[c] for c in _SPEEDS if c in rows.data)
    driven = np.isfinite(grade) & (speed > SLOPE_COUNTS_MPS)
    count, total = int((steep & driven).sum()), int(driven.sum())
    what = f"steeper than {MAX_GRADE_RAD:g} rad ({np.tan(MAX_GRADE_RAD):.0%}), which no road is"
    if count > MANY_STEEP * total:
        i = int(np.argmax(steep & driven))
        raise InputError(
            f"{rows.where(i)}, slope: {grade[i]:.4g} rad, and {count} of {total} rows driven are {what}; check the "
            f"unit in the column's name (grade_rad, grade_tan, grade_pct, grade_deg) or in the adapter"
        )
    ledger = rows.ledger.add("noted", f"{what}: taken as missing", count=int(steep.sum()), column="grade_rad")
    return replace(rows, data={**rows.data, "grade_rad": np.where(steep, np.nan, grade)}, ledger=ledger)


def _drop_duplicates(rows: Rows) -> Rows:
    """Rows that repeat another in every column. Without a clock equal rows are just steady driving."""
    time = rows.data.get("time_s")
    if time is None:
        return rows
    suspects = np.flatnonzero(pd.DataFrame({"trip": rows.trip, "t": time}).duplicated(keep=False) & np.isfinite(time))
    if len(suspects) == 0:
        return rows
    frame = pd.DataFrame({"trip": rows.trip[suspects], **{k: v[suspects] for k, v in rows.data.items()}})
    again = np.zeros(len(time), bool)
    again[suspects[frame.duplicated().to_numpy()]] = True
    if not again.any():
        return rows
    ledger = rows.ledger.add("dropped", "duplicate of an earlier row", count=int(again.sum()))
    return replace(rows, ledger=ledger).take(~again)


def _fill_durations(rows: Rows, sampled: bool) -> Rows:
    """Missing durations from the clock, else from distance and end speeds; missing distances are made later."""
    duration = rows.data.get("duration_s")
    if duration is None or np.isfinite(duration).all():
        return rows
    x = np.where(np.isfinite(duration), duration, np.nan)
    missing = np.isnan(x)
    if "time_s" in rows.data:
        step = np.r_[np.where(np.diff(rows.trip) == 0, np.diff(rows.data["time_s"]), np.nan), np.nan]
        x = np.where(missing, step, x)
    if not sampled and "distance_m" in rows.data:
        with np.errstate(divide="ignore", invalid="ignore"):
            x = np.where(
                np.isnan(x),
                2.0 * rows.data["distance_m"] / (rows.data["speed_start_mps"] + rows.data["speed_end_mps"]),
                x,
            )
    x = np.where(np.isfinite(x) & (x > 0) | ~missing, x, np.nan)
    done = int((missing & ~np.isnan(x)).sum())
    ledger = rows.ledger.add("filled", "missing, from the clock or the distance", count=done, column="duration_s")
    return replace(rows, data={**rows.data, "duration_s": x}, ledger=ledger if done else rows.ledger)


def _bad_rows(rows: Rows, sampled: bool, measured: list[str]) -> tuple[np.ndarray, dict[str, tuple[int, int]]]:
    """Rows that lack what is needed; by reason how many, and the first (each row counts for its first reason)."""
    bad = np.zeros(len(rows.trip), bool)
    reasons: dict[str, tuple[int, int]] = {}

    def rule(out: np.ndarray, why: str) -> None:
        nonlocal bad
        if n := int((out & ~bad).sum()):
            reasons[why] = (n, int(np.argmax(out & ~bad)))
            bad = bad | out

    rule(rows.trip < 0, "no trip_id")
    rule(rows.vehicle < 0, "no vehicle_id")
    speeds = ("speed_mps",) if sampled else _SPEEDS[1:]
    for c in ("time_s", "duration_s", *speeds, *measured):
        if c in rows.data:
            rule(~np.isfinite(rows.data[c]), f"{c} missing")
    for c in speeds:
        rule(rows.data[c] < -REVERSE_MPS, f"{c} below −{REVERSE_MPS} m/s (driving in reverse is not modelled)")
    duration = rows.data.get("duration_s")
    if duration is not None:
        rule(duration <= 0, "duration_s not positive")
    if "time_s" in rows.data:
        same = np.r_[False, (np.diff(rows.data["time_s"]) == 0) & (np.diff(rows.trip) == 0)]
        rule(same, _SAME)
    length = duration
    if length is None and "time_s" in rows.data:
        length = np.r_[np.where(np.diff(rows.trip) == 0, np.diff(rows.data["time_s"]), np.nan), np.nan]
    if length is not None:
        length = np.where(length > 0, length, np.nan)
    if "distance_m" in rows.data:
        rule(rows.data["distance_m"] < 0, "distance_m negative")
        if length is not None:
            too_far = rows.data["distance_m"] > 2.0 * MAX_SPEED_MPS * length
            rule(too_far, "a distance_m that no vehicle covers in its time (is it cumulative, or in another unit?)")
    most = f"more than {MAX_POWER_W / 1e6:g} MW (is it in another unit, or a fault of the instrument?)"
    if "battery_power_w" in rows.data:
        rule(np.abs(rows.data["battery_power_w"]) > MAX_POWER_W, f"a battery power of {most}")
    if "energy_wh" in rows.data and length is not None:
        counts = most.replace("(is it", "(is it a counter, for which an adapter says counter = true,")
        rule(np.abs(rows.data["energy_wh"]) * 3600.0 > MAX_POWER_W * length, f"an energy_wh that means {counts}")
    return bad, reasons


def _mend(reasons: dict[str, tuple[int, int]]) -> str:
    """The key of an adapter that helps against the most frequent reason."""
    if _SAME in reasons:
        return ', or spread them: repeated_stamps = "spread" in an adapter'
    missing = next((why.removesuffix(" missing") for why in reasons if why.endswith("_w missing")), None)
    if missing is None:
        return ""
    return f"; where columns have rates of their own, clock = … in an adapter names the one of {missing}"


def _check_order(rows: Rows, bad: np.ndarray) -> Rows:
    """Trips contiguous, time forward; then each trip's first time is its origin."""
    good = np.flatnonzero(~bad)
    trip = rows.trip[good]
    if len(good) == 0:
        return rows
    first = starts(trip)
    opened = trip[first]
    if len(np.unique(opened)) < len(opened):
        again = pd.Series(opened).duplicated().to_numpy()
        i = int(good[np.flatnonzero(first)[int(np.argmax(again))]])
        name = rows.trip_names[rows.trip[i]]
        raise InputError(f"{rows.where(i)}: trip '{name}' goes on after another one; its rows must stand together")
    if "time_s" not in rows.data:
        return rows
    time = rows.data["time_s"][good]
    back = np.flatnonzero(~first[1:] & (np.diff(time) < 0)) + 1
    if len(back):
        i, before = int(good[back[0]]), float(time[back[0] - 1])
        raise InputError(
            f"{rows.where(i)}, column time_s: time runs backwards in trip '{rows.trip_names[rows.trip[i]]}' "
            f"({before:.10g} then {time[back[0]]:.10g} s); sort the rows, or give each trip its own trip_id"
        )
    origin = np.zeros(len(rows.trip_names))
    origin[opened] = time[first]
    return replace(rows, origin_s=np.where(rows.trip >= 0, origin[rows.trip], 0.0))


def _one_vehicle(rows: Rows) -> Rows:
    change = np.flatnonzero((np.diff(rows.trip) == 0) & (np.diff(rows.vehicle) != 0) & (rows.trip[1:] >= 0))
    change = change[(rows.vehicle[change] >= 0) & (rows.vehicle[change + 1] >= 0)]
    if len(change):
        i = int(change[0]) + 1
        raise InputError(f"{rows.where(i)}, column vehicle_id: trip '{rows.trip_names[rows.trip[i]]}' changes vehicle")
    return rows


def _clip_speeds(rows: Rows) -> Rows:
    data, ledger = dict(rows.data), rows.ledger
    for c in _SPEEDS:
        if c in data and (low := data[c] < 0).any():
            data[c] = np.where(low, 0.0, data[c])
            why = f"between −{REVERSE_MPS} and 0 m/s, set to 0"
            ledger = ledger.add("clipped", why, count=int(low.sum()), column=c)
    return replace(rows, data=data, ledger=ledger)
