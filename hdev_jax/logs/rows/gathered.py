"""All files of a log as one table, in trips: interleaved vehicles sorted apart, a clock begun anew a new trip."""

from dataclasses import dataclass, replace

import numpy as np

from hdev_jax.errors import InputError
from hdev_jax.logs.columns import Piece
from hdev_jax.logs.intervals import starts, trip_median
from hdev_jax.logs.ledger import Ledger

__all__ = ["Rows", "concatenate", "regrouped", "split_restarts"]


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
        return f"{piece.file}: {piece.where(int(self.row[i]))}"

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


def regrouped(rows: Rows) -> Rows:
    """Vehicles whose rows are interleaved by time, one trip after the other; a trip that goes on after another one of
    the same vehicle stays where it is, to be refused."""
    first = starts(rows.trip)
    opened = rows.trip[first]
    if len(np.unique(opened)) == len(opened) or (rows.trip < 0).any():
        return rows
    pairs = np.unique(np.c_[rows.trip, rows.vehicle], axis=0)
    if len(pairs) > len(np.unique(rows.trip)) or len(rows.vehicle_names) < 2:
        return rows
    order = np.argsort(rows.vehicle, kind="stable")
    apart = rows.trip[order][starts(rows.trip[order])]
    if len(np.unique(apart)) < len(apart):
        return rows
    rank = np.argsort(np.unique(rows.trip, return_index=True)[1], kind="stable").argsort()
    order = np.argsort(rank[np.unique(rows.trip, return_inverse=True)[1]], kind="stable")
    per_row = ("trip", "vehicle", "piece", "row", "origin_s")
    ledger = rows.ledger.add("noted", "rows of several vehicles interleaved: sorted apart", count=len(order))
    moved = {k: getattr(rows, k)[order] for k in per_row}
    return replace(rows, data={k: v[order] for k, v in rows.data.items()}, ledger=ledger, **moved)


def split_restarts(rows: Rows) -> Rows:
    """A clock that goes back to where it began, and runs on from there, begins a new trip `name/2`."""
    time = rows.data.get("time_s")
    if time is None or len(time) < 3:
        return rows
    first = starts(rows.trip)
    edges = np.flatnonzero(first)
    begin = np.repeat(time[edges], np.diff(np.r_[edges, len(time)]))
    step = np.r_[np.nan, np.diff(time)]
    step[first] = np.nan
    with np.errstate(invalid="ignore"):
        usual = trip_median(np.where(step > 0, step, np.nan), rows.trip)
        following = np.r_[time[1:], np.nan]
        again = (step < 0) & (time <= begin + usual) & (following > time) & (following < time - step)
        again[:-1] &= rows.trip[1:] == rows.trip[:-1]
    if not again[:-1].any():
        return rows
    trip, names, ledger = rows.trip.copy(), list(rows.trip_names), rows.ledger
    ends = np.r_[edges[1:], len(trip)]
    part: dict[int, int] = {}
    for i in np.flatnonzero(again[:-1]):  # over restarts, of which there are few
        old = int(rows.trip[i])
        part[old] = part.get(old, 1) + 1
        while (name := f"{rows.trip_names[old]}/{part[old]}") in names:
            part[old] += 1
        trip[i : int(ends[np.searchsorted(ends, i, "right")])] = len(names)
        names.append(name)
        why = f"the clock begins anew in {rows.where(int(i))}; the rows from there are trip '{name}'"
        ledger = ledger.add("split", why, trip=rows.trip_names[old])
    return replace(rows, trip=trip, trip_names=tuple(names), ledger=ledger)
