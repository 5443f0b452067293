"""Trips as they are used: ends cut off, split at gaps, numbered in the order of the rows."""

from dataclasses import replace

import numpy as np

from hdev_jax.errors import InputError
from hdev_jax.logs.intervals import gaps, starts, trip_median
from hdev_jax.logs.rows.gathered import Rows

__all__ = ["split_trips"]


def split_trips(rows: Rows, edge_trim_s: float, sampled: bool) -> Rows:
    """Ends of trips cut off, trips split at gaps, trips of one row dropped; ids 0, 1, … in the order of the rows."""
    if len(rows.trip) == 0:
        raise InputError(f"{rows.name}: no usable trip: no row is left")
    if edge_trim_s > 0:
        time = rows.data["time_s"] if "time_s" in rows.data else np.cumsum(rows.data["duration_s"])
        edges = np.flatnonzero(starts(rows.trip))
        sizes = np.diff(np.r_[edges, len(time)])
        t0, t1 = np.repeat(time[edges], sizes), np.repeat(time[edges + sizes - 1], sizes)
        out = (time - t0 < edge_trim_s) | (t1 - time < edge_trim_s)
        ledger = rows.ledger.add("trimmed", f"{edge_trim_s:g} s at both ends of each trip", count=int(out.sum()))
        rows = replace(rows, ledger=ledger).take(~out)
        if len(rows.trip) == 0:
            raise InputError(f"{rows.name}: no usable trip: all are shorter than twice edge_trim_s = {edge_trim_s:g} s")
    rows = _split_at_gaps(rows)
    size = np.bincount(rows.trip, minlength=len(rows.trip_names))
    single = size[rows.trip] == 1
    if single.all():
        raise InputError(f"{rows.name}: no usable trip: each has a single row; a trip needs two or more")
    if single.any():
        ledger = rows.ledger.add("dropped", "a trip of one row", count=int(single.sum()))
        rows = replace(rows, ledger=ledger).take(~single)
    used = rows.trip[starts(rows.trip)]
    lost = sorted(set(range(len(size))) - set(used.tolist()) - set(np.flatnonzero(size == 1).tolist()))
    ledger = rows.ledger
    for t in lost:
        ledger = ledger.add("dropped", "no row of this trip is left", trip=rows.trip_names[t])
    new = np.full(len(size), -1, np.int64)
    new[used] = np.arange(len(used))
    cars = list(dict.fromkeys(rows.vehicle[starts(rows.vehicle)].tolist()))
    car = np.full(len(rows.vehicle_names), -1, np.int64)
    car[cars] = np.arange(len(cars))
    return replace(
        rows,
        trip=new[rows.trip],
        vehicle=car[rows.vehicle],
        trip_names=tuple(rows.trip_names[t] for t in used),
        vehicle_names=tuple(rows.vehicle_names[c] for c in cars),
        ledger=ledger,
    )


def _split_at_gaps(rows: Rows) -> Rows:
    """A gap longer than ten samples starts a new trip `name/2` with a clock of its own."""
    if "time_s" not in rows.data:
        return rows
    time = rows.data["time_s"]
    opens = gaps(rows.trip, time, rows.data.get("duration_s"))
    if not opens.any():
        return rows
    trip, names, ledger, origin = rows.trip.copy(), list(rows.trip_names), rows.ledger, rows.origin_s.copy()
    step = np.r_[np.nan, np.diff(time)]
    step[starts(rows.trip)] = np.nan
    usual = trip_median(step, rows.trip)
    ends = np.r_[np.flatnonzero(starts(rows.trip))[1:], len(trip)]
    part: dict[int, int] = {}
    for i in np.flatnonzero(opens):  # over gaps, of which there are few
        old = int(rows.trip[i])
        part[old] = part.get(old, 1) + 1
        while (name := f"{rows.trip_names[old]}/{part[old]}") in names:
            part[old] += 1
        stop = int(ends[np.searchsorted(ends, i, "right")])
        trip[i:stop], origin[i:stop] = len(names), time[i]
        names.append(name)
        ledger = ledger.add(
            "split",
            f"a gap of {step[i]:.6g} s, more than ten samples of {usual[i]:.6g} s; the rows after it are trip '{name}'",
            file=rows.pieces[int(rows.piece[i])].file,
            trip=rows.trip_names[old],
        )
    return replace(rows, trip=trip, origin_s=origin, trip_names=tuple(names), ledger=ledger)
