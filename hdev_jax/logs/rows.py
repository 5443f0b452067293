"""Rows checked and repaired: which are dropped, which end the reading, and the trips that remain."""

from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from hdev_jax.errors import InputError
from hdev_jax.logs.columns import Piece
from hdev_jax.logs.intervals import gaps, starts, trip_median
from hdev_jax.logs.ledger import Ledger

__all__ = ["BAD_SHARE", "MAX_SPEED_MPS", "REVERSE_MPS", "Rows", "check_rows", "concatenate", "split_trips"]

MAX_SPEED_MPS = 60.0  # contract §1: above, the column is in km/h or broken
REVERSE_MPS = 0.5  # contract §1: down to −0.5 m/s a sensor's undershoot, set to 0
BAD_SHARE = 0.01  # contract §1: bad rows in needed columns, at most
_SPEEDS = ("speed_mps", "speed_start_mps", "speed_end_mps")


@dataclass(frozen=True)
class Rows:
    """All files as one table; `piece` and `row` say where a row came from."""

    pieces: tuple[Piece, ...]
    data: dict[str, np.ndarray]
    trip: np.ndarray
    vehicle: np.ndarray
    piece: np.ndarray
    row: np.ndarray
    origin_s: np.ndarray
    trip_names: tuple[str, ...]
    vehicle_names: tuple[str, ...]
    ledger: Ledger

    def take(self, keep: np.ndarray) -> "Rows":
        """Rows by mask."""
        per_row = ("trip", "vehicle", "piece", "row", "origin_s")
        picked = {k: getattr(self, k)[keep] for k in per_row}
        return replace(self, data={k: v[keep] for k, v in self.data.items()}, **picked)

    def where(self, i: int) -> str:
        """`a.csv: row 12 (line 13)`."""
        piece = self.pieces[int(self.piece[i])]
        line = f" (line {int(self.row[i]) + piece.first_line})" if piece.first_line else ""
        return f"{piece.file}: row {int(self.row[i]) + 1}{line}"

    @property
    def name(self) -> str:
        """The file, or how many."""
        files = list(dict.fromkeys(p.file for p in self.pieces))
        return files[0] if len(files) == 1 else f"log of {len(files)} files"


def concatenate(pieces: list[Piece], ledger: Ledger) -> Rows:
    """Files to one table. A channel that some files lack is left out, with a note; one trip in two files is refused."""
    names: dict[str, int] = {}
    vehicles: dict[str, int] = {}
    trip, vehicle = [], []
    for p in pieces:
        for n in p.trip_names:
            if n in names:
                other = next(q.file for q in pieces if n in q.trip_names)
                again = f"{other} and {p.file}" if other != p.file else p.file
                raise InputError(f"trip '{n}' is in {again} twice; rename one, or give trip_id in an adapter")
            names[n] = len(names)
        code = np.array([names[n] for n in p.trip_names] + [-1], np.int64)
        trip.append(code[p.trip])
        code = np.array([vehicles.setdefault(n, len(vehicles)) for n in p.vehicle_names] + [-1], np.int64)
        vehicle.append(code[p.vehicle])
        ledger = ledger + p.ledger
    everywhere = [c for c in pieces[0].data if all(c in p.data for p in pieces)]
    for c in dict.fromkeys(c for p in pieces for c in p.data if c not in everywhere):
        lacking = [p for p in pieces if c not in p.data]
        where = lacking[0].file if len({p.file for p in lacking}) == 1 else f"{len(lacking)} files or trips"
        ledger = ledger.add("noted", f"lacking in {where}, left out of the log", column=c)
    sizes = [len(p.row) for p in pieces]
    return Rows(
        pieces=tuple(pieces),
        data={c: np.concatenate([p.data[c] for p in pieces]) for c in everywhere},
        trip=np.concatenate(trip),
        vehicle=np.concatenate(vehicle),
        piece=np.repeat(np.arange(len(pieces)), sizes),
        row=np.concatenate([p.row for p in pieces]),
        origin_s=np.zeros(sum(sizes)),
        trip_names=tuple(names),
        vehicle_names=tuple(vehicles),
        ledger=ledger,
    )


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
    rows = _fill_durations(rows, sampled)
    bad, reasons = _bad_rows(rows, sampled, measured)
    rows = _one_vehicle(_check_order(rows, bad))
    if bad.any():
        total, count = len(bad), int(bad.sum())
        told = "; ".join(f"{int(n)} with {why}" for why, n in reasons.items())
        if count > BAD_SHARE * total:
            raise InputError(
                f"{rows.name}: {count} of {total} rows ({count / total:.1%}) cannot be used: {told}; the first is "
                f"{rows.where(int(np.argmax(bad)))}; at most {BAD_SHARE:.0%} are dropped, so repair the log"
            )
        ledger = rows.ledger
        for why, n in reasons.items():
            ledger = ledger.add("dropped", why, count=n)
        rows = replace(rows, ledger=ledger).take(~bad)
    return _clip_speeds(rows)


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


def _bad_rows(rows: Rows, sampled: bool, measured: list[str]) -> tuple[np.ndarray, dict[str, int]]:
    """Rows that lack what is needed, and how many for which reason (each row counts for its first)."""
    bad = np.zeros(len(rows.trip), bool)
    reasons: dict[str, int] = {}

    def rule(out: np.ndarray, why: str) -> None:
        nonlocal bad
        if n := int((out & ~bad).sum()):
            reasons[why] = n
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
        rule(same, "the same time_s as the row before, other values")
    if "distance_m" in rows.data:
        rule(rows.data["distance_m"] < 0, "distance_m negative")
        length = duration
        if length is None:
            length = np.r_[np.where(np.diff(rows.trip) == 0, np.diff(rows.data["time_s"]), np.nan), np.nan]
        length = np.where(length > 0, length, np.nan)
        too_far = rows.data["distance_m"] > 2.0 * MAX_SPEED_MPS * length
        rule(too_far, "a distance_m that no vehicle covers in its time (is it cumulative, or in another unit?)")
    return bad, reasons


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
