"""One raw table to the contract's columns in SI, its rows with the names of their trips and vehicles."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hdev_jax.errors import InputError
from hdev_jax.logs.adapter import Adapter, near
from hdev_jax.logs.columns.clocked import clocked, named
from hdev_jax.logs.columns.headers import Header, parse_header
from hdev_jax.logs.columns.labels import id_columns, labels, within_vehicles
from hdev_jax.logs.columns.long import channels_of_long
from hdev_jax.logs.columns.uneven import on_one_clock
from hdev_jax.logs.columns.work import MEASURED_COLUMNS, ColumnInfo, Work
from hdev_jax.logs.ledger import Ledger
from hdev_jax.logs.presets import recognised
from hdev_jax.logs.readers.raw import Raw, place

__all__ = ["ColumnInfo", "Piece", "translate"]


@dataclass(frozen=True)
class Piece:
    """One table in the contract's columns: float64 arrays, trips as codes into `trip_names`."""

    file: str
    data: dict[str, np.ndarray]
    trip: np.ndarray
    trip_names: tuple[str, ...]
    vehicle: np.ndarray
    vehicle_names: tuple[str, ...]
    row: np.ndarray
    lines: Sequence[int] | None
    columns: tuple[ColumnInfo, ...]
    headers: tuple[str, ...]
    ledger: Ledger

    def where(self, row: int) -> str:
        """`row 3 (line 4)` of a row of the file counted from 0."""
        return place(row, self.lines)


def translate(raw: Raw, adapter: Adapter) -> Piece:
    """Columns of a raw table under the contract's names in SI. Raises `InputError` (file, row, column, what to do)."""
    raw, adapter = _of_its_tool(raw, adapter)
    by_channel = adapter.long is not None or bool(raw.channels)
    if raw.asked_only:
        raw = named(raw, adapter)
    elif adapter.long is not None:
        raw = channels_of_long(raw, adapter)
    if by_channel:
        raw, adapter = clocked(raw, adapter), adapter.without("time_s")
    work, named_by = _begun(raw, adapter)
    if adapter.clock is not None and not by_channel and "time_s" in work.data:
        by_channel = True
        kept = [c for columns in named_by.ids.values() for c in columns]
        shown = next(f" {c.source} " for c in work.columns if c.name == "time_s")
        rest = raw.table.drop(columns=[h for h in work.headers if f" {h} " in shown and h not in kept])
        raw = replace(raw, table=rest, ledger=work.ledger)
        raw = on_one_clock(raw, adapter, work.data["time_s"], named_by.trip, kept)
        adapter = adapter.without("time_s")
        work, named_by = _begun(raw, adapter)
    for name in adapter.columns:
        work.derive(name, ())
    work.note_lacking()
    if adapter.others != "drop":
        work.keep_others({c for columns in named_by.ids.values() for c in columns})
    work.power_of_voltage_and_current()
    piece = Piece(
        file=raw.file,
        data=work.data,
        trip=named_by.trip,
        trip_names=named_by.trip_names,
        vehicle=named_by.vehicle,
        vehicle_names=named_by.vehicle_names,
        row=np.arange(len(named_by.trip)),
        lines=raw.lines,
        columns=tuple(work.columns),
        headers=tuple(work.headers),
        ledger=work.ledger,
    )
    return _measured_rows(piece, work, adapter, by_channel)


@dataclass(frozen=True)
class _Named:
    """Which columns name the trips and vehicles of a table, and which row is of which."""

    ids: dict[str, tuple[str, ...]]
    trip: np.ndarray
    trip_names: tuple[str, ...]
    vehicle: np.ndarray
    vehicle_names: tuple[str, ...]


def _begun(raw: Raw, adapter: Adapter) -> tuple[Work, _Named]:
    """The work on a table: its trips and vehicles named, its clock read."""
    headers = [str(c) for c in raw.table.columns]
    raw = replace(raw, table=raw.table.set_axis(headers, axis=1))
    ids = {name: id_columns(raw, adapter, name, headers) for name in ("trip_id", "vehicle_id")}
    vehicle, vehicle_names = labels(raw, ids["vehicle_id"], raw.vehicle or "vehicle")
    of_vehicle = ids["vehicle_id"] if not ids["trip_id"] and len(vehicle_names) > 1 else ()
    trip, trip_names = labels(raw, ids["trip_id"] or of_vehicle, raw.trip)
    trip, trip_names, counted_anew = within_vehicles(trip, trip_names, vehicle, vehicle_names)
    work = Work(raw, adapter, headers, trip)
    if counted_anew:
        work.note("trip_id", "each vehicle counts its trips anew: trips are named vehicle-trip")
    if "time_s" in adapter.columns:
        work.derive("time_s", ())
    else:
        work.clock()
    return work, _Named(ids, trip, trip_names, vehicle, vehicle_names)


def _of_its_tool(raw: Raw, adapter: Adapter) -> tuple[Raw, Adapter]:
    """Without an adapter, and where the file names no speed as the contract does: the preset of the tool that writes
    such headers, noted."""
    headers = list(raw.channels) or [str(c) for c in raw.table.columns]
    if adapter.columns or adapter.preset or any(_is_speed(Header.of(h, raw.units.get(h))) for h in headers):
        return raw, adapter
    found = recognised(headers)
    if found is None:
        return raw, adapter
    why = f"its header is that of {found.preset}: read by the preset of that name"
    return replace(raw, ledger=raw.ledger.add("noted", why, file=raw.file)), adapter.over(found)


def _is_speed(header: Header) -> bool:
    try:
        return parse_header(header).name in ("speed_mps", "speed_start_mps")
    except InputError:  # told where columns are translated
        return True


def _measured_rows(piece: Piece, work: Work, adapter: Adapter, by_channel: bool) -> Piece:
    """The rows where what the adapter names was measured; without a name those where a target was filled are left out:
    what was filled is no measurement."""
    if adapter.rows is not None:
        header = adapter.rows
        if header not in piece.data and header not in work.headers:
            known = [*piece.data, *work.headers]
            raise InputError(f"{piece.file}: rows = '{header}' of {adapter.where}: no such column{near(header, known)}")
        x = work.unfilled.get(header, piece.data.get(header))
        keep = np.isfinite(x) if x is not None else work.raw.table[header].notna().to_numpy()
        why = f"rows = '{header}' of the adapter: it was not measured there"
    else:
        if by_channel:  # put on another channel's clock, a target is there at its own times alone
            work.unfilled = {c: piece.data[c] for c in MEASURED_COLUMNS if c in piece.data} | work.unfilled
        filled = [c for c in MEASURED_COLUMNS if c in work.unfilled and c in piece.data]
        if not filled:
            return piece
        keep = np.isfinite(work.unfilled[filled[0]])
        header, why = filled[0], "not measured there; what is filled is no measurement"
    if keep.all():
        return piece
    if not keep.any():
        raise InputError(f"{piece.file}: '{header}' has no value in any row")
    why += f" ({(~keep).mean():.0%} of the rows)"
    return replace(
        piece,
        data={k: v[keep] for k, v in piece.data.items()},
        trip=piece.trip[keep],
        vehicle=piece.vehicle[keep],
        row=piece.row[keep],
        ledger=piece.ledger.add("dropped", why, count=int((~keep).sum()), file=piece.file, column=header),
    )
