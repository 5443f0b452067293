"""`read_log`: files, adapter and checks put together."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from hdev_jax.errors import InputError, MissingColumnError
from hdev_jax.logs.adapter import Adapter, near
from hdev_jax.logs.columns import ColumnInfo, Piece, translate
from hdev_jax.logs.columns.clocks import FIRST_DATE_S, LAST_DATE_S
from hdev_jax.logs.instruments import Slope, end_speeds, instruments_of, metres, slope_of, speed_of
from hdev_jax.logs.intervals import sample_intervals, starts, trip_median
from hdev_jax.logs.ledger import Ledger
from hdev_jax.logs.log import KINEMATICS, MEASURED, Log
from hdev_jax.logs.presets import is_preset, preset
from hdev_jax.logs.readers import Raw, find_files, read_raw
from hdev_jax.logs.repair import repair
from hdev_jax.logs.rows.charging import without_charging
from hdev_jax.logs.rows.checked import check_rows
from hdev_jax.logs.rows.gathered import Rows, concatenate
from hdev_jax.logs.rows.stamps import as_means, noted_stamps
from hdev_jax.logs.rows.trips import split_trips
from hdev_jax.segments import ACCEL_SD, GRADE_SD, Segments
from hdev_jax.units import accepted

__all__ = ["log_from_frame", "read_log"]

POSITION = ("latitude_deg", "longitude_deg")


def read_log(paths: str | Path | Sequence[str | Path], adapter: str | Path | Adapter | None = None) -> Log:
    """Read one log from files and folders (several files are one log).

    **Arguments:** `paths`: files and folders; trips keep this order. `adapter`: the path of a TOML file or an
    `Adapter`, where the files have other column names.

    **Raises:** `InputError` for a log that section 1 of the contract refuses: one line that says which file, row and
    column is at fault, and what to do.
    """
    given = [paths] if isinstance(paths, str | Path) else list(paths)
    if not given:
        raise InputError("no log given; name one or more files")
    rules = adapter_of(adapter)
    files, left = find_files([Path(p) for p in given], rules)
    ledger = Ledger()
    for name, why in left.items():
        ledger = ledger.add("noted", why, file=name)
    raws = [raw for path in files for raw in read_raw(path, rules)]
    return _assembled(raws, rules, ledger, tuple(p.name for p in files))


def log_from_frame(frame: Any, *, name: str = "frame", adapter: str | Path | Adapter | None = None) -> Log:
    """A log from a table in memory, by the same rules as from a file.

    **Arguments:** `frame`, a pandas, polars or pyarrow table (whatever narwhals reads) or a mapping of names to arrays,
    a row for each interval or sample, the unit part of each column's name; `name` stands for the file in messages, and
    for the trip where there is no column `trip_id`; `adapter` as for `read_log`.

    **Raises:** `InputError` for what a file would be refused for, `TypeError` for what is no table.
    """
    import narwhals as nw
    import pandas as pd

    rules = adapter_of(adapter)
    if isinstance(frame, Mapping):
        lengths = {k: len(np.atleast_1d(np.asarray(v))) for k, v in frame.items()}
        if len(set(lengths.values())) > 1:
            raise InputError(f"{name}: columns of different lengths: {lengths}; one value a row is expected")
        table = pd.DataFrame({str(k): np.atleast_1d(np.asarray(v)) for k, v in frame.items()})
    else:
        table = nw.from_native(frame, eager_only=True).to_pandas()
    table = table.reset_index(drop=True)
    if table.empty:
        raise InputError(f"{name}: no rows")
    return _assembled([Raw(name, table, name)], rules, Ledger(), (name,))


def adapter_of(adapter: str | Path | Adapter | None) -> Adapter:
    """The adapter in a file, by the name of a preset, or as it is; what it leaves open is its preset's."""
    if adapter is None:
        return Adapter()
    if isinstance(adapter, str | Path):
        if is_preset(adapter):
            return preset(str(adapter))
        adapter = Adapter.load(adapter)
    if adapter.preset is not None and not adapter.where.startswith("preset "):
        return adapter.over(preset(adapter.preset, adapter.where))
    return adapter


def _assembled(raws: Sequence[Raw], rules: Adapter, ledger: Ledger, files: tuple[str, ...]) -> Log:
    """One log from raw tables: columns in SI, rows checked, trips by name."""
    pieces = [translate(raw, rules) for raw in raws]
    sampled = _require(pieces)
    rows = concatenate(pieces, ledger)
    measured = [c for c in MEASURED if c in rows.data]
    for c in list(measured):
        if not np.isfinite(rows.data[c]).any():
            measured.remove(c)
            left = {k: v for k, v in rows.data.items() if k != c}
            rows = replace(rows, data=left, ledger=rows.ledger.add("noted", "no value in any row, absent", column=c))
    rows = without_charging(check_rows(rows, sampled, measured), sampled, rules.charging == "keep")
    rows = split_trips(rows, rules.edge_trim_s, sampled)
    if sampled and rules.stamp != "middle":
        if "time_s" not in rows.data:
            raise InputError(f"{rows.name}: stamp = '{rules.stamp}' needs time_s; the log has durations alone")
        rows, sampled = as_means(rows, rules.stamp), False
    elif sampled:
        rows = noted_stamps(rows)
    columns = _columns(pieces)
    return _log(rows, sampled, measured, columns, files)


def _require(pieces: list[Piece]) -> bool:
    """Whether the rows are samples; refuses a log that lacks what every row needs, with the near name."""
    ends = all("speed_start_mps" in p.data and "speed_end_mps" in p.data for p in pieces)
    for p in pieces:
        free = [h for h in p.headers if h not in {c.source for c in p.columns} or h in p.data]
        free = [h for h in free if h not in KINEMATICS]
        if not ends and "speed_mps" not in p.data:
            lacking = [c for c in ("speed_start_mps", "speed_end_mps") if c not in p.data]
            wanted = lacking[0] if len(lacking) == 1 else "speed_mps"
            also = "" if len(lacking) == 1 else " (or speed_start_mps and speed_end_mps)"
            raise MissingColumnError(f"{p.file}: no column {wanted}{also}{_nearest([*lacking, wanted], free, p)}")
        if "time_s" not in p.data and "duration_s" not in p.data:
            raise MissingColumnError(
                f"{p.file}: no column time_s or duration_s{_nearest(['time_s', 'duration_s'], free, p)}"
            )
    for c in ("time_s", "duration_s"):
        other = "duration_s" if c == "time_s" else "time_s"
        lacking = [p for p in pieces if c not in p.data]
        if lacking and any(other not in p.data for p in pieces):
            raise InputError(f"{lacking[0].file}: no column {c}, which another file of this log needs")
    return not ends


def _nearest(wanted: list[str], free: list[str], piece: Piece) -> str:
    stems = [w.rpartition("_")[0] for w in wanted]
    for name in dict.fromkeys(wanted):
        for header in free:
            if near(header, accepted(name.rpartition("_")[0]), 0.7) or header.lower() in stems:
                return f"; '{header}' is near: rename it {name} (or {', '.join(accepted(stems[0])[1:3])})"
    shown = ", ".join(piece.headers[:8]) + (", …" if len(piece.headers) > 8 else "")
    return f"; the file has {shown}; rename one, or write an adapter (hdev check --skeleton)"


def _columns(pieces: list[Piece]) -> tuple[ColumnInfo, ...]:
    return tuple(dict.fromkeys(c for p in pieces for c in p.columns))


def _log(
    rows: Rows, sampled: bool, measured: list[str], columns: tuple[ColumnInfo, ...], files: tuple[str, ...]
) -> Log:
    rows, read = _with_speed(rows, sampled), rows.data
    data, trip, ledger = rows.data, rows.trip, rows.ledger
    time, duration, v_start, v_end = _intervals(rows, sampled)
    mean = 0.5 * (v_start + v_end)
    speed = data.get("speed_mps", mean)
    made = np.where(np.isfinite(speed), speed, mean) * duration
    distance = data.get("distance_m", made)
    if (gone := ~np.isfinite(distance)).any():
        distance = np.where(gone, made, distance)
        ledger = ledger.add("filled", "missing, speed × duration", count=int(gone.sum()), column="distance_m")
    if "distance_m" not in data:
        ledger = ledger.add("derived", "speed × duration", column="distance_m")
    moved = float(made.sum())
    if moved > 0 and not 0.5 < float(distance.sum()) / moved < 2.0:
        ratio = float(distance.sum()) / moved
        ledger = ledger.add(
            "noted", f"the sum is {ratio:.3g} times speed × duration: check its unit", column="distance_m"
        )
    place = None
    if all(c in data for c in POSITION):
        place = metres(*(data[c] for c in POSITION))
        data = {c: x for c, x in data.items() if c not in POSITION}
        ledger = ledger.add("noted", "positions say which rows are of one road; they are no channel of the model",
                            count=int(np.isfinite(place[:, 0]).sum()), column=POSITION[0])  # fmt: skip
    channels: dict[str, Any] = {k: v for k, v in data.items() if k not in KINEMATICS and k not in measured}
    channels, ledger = repair(channels, trip, time, ledger)
    soc = channels.get("soc")
    if soc is not None and soc.max() > 1.5:  # a share cannot be: this is per cent
        channels["soc"] = soc / 100.0
        ledger = ledger.add("noted", f"up to {soc.max():.4g}, read as per cent", column="soc")
    channels, slope, ledger = _with_slope(channels, data, trip, distance, duration, place, ledger)
    segments = Segments(
        trip=trip.astype(np.int32),
        vehicle=rows.vehicle.astype(np.int32),
        time_s=time,
        duration_s=duration,
        distance_m=distance,
        speed_start_mps=v_start,
        speed_end_mps=v_end,
        channels=channels,
    )
    return Log(
        segments=segments,
        measured={c: data[c] for c in measured},
        trip_names=rows.trip_names,
        vehicle_names=rows.vehicle_names,
        ledger=ledger,
        columns=columns,
        sampled=sampled,
        files=files,
        started_s=_started(rows) if "time_s" in data else {},
        instruments=instruments_of(_read_values(read, (*measured, *channels)), slope),
    )


def _read_values(read: Mapping[str, np.ndarray], channels: Iterable[str]) -> dict[str, np.ndarray]:
    """Channels as they were read; the speeds at both ends of intervals are of one instrument."""
    found = {c: read[c] for c in ("speed_mps", *channels) if c in read}
    if "speed_mps" not in read:
        found["speed_mps"] = np.r_[read["speed_start_mps"], read["speed_end_mps"]]
    return found


def _with_speed(rows: Rows, sampled: bool) -> Rows:
    """Speeds that are read in coarse steps, smoothed: of samples, or at the ends of intervals."""
    made: dict[str, np.ndarray]
    if sampled:
        if "time_s" not in rows.data:
            return rows
        found = speed_of(rows.trip, rows.data["time_s"], rows.data["speed_mps"])
        if found is None:
            return rows
        speed, sd, step = found
        made = {"speed_mps": speed, ACCEL_SD: sd}
    else:
        ends = end_speeds(rows.trip, *_intervals(rows, sampled))
        if ends is None:
            return rows
        start, end, sd, step = ends
        made = {"speed_start_mps": start, "speed_end_mps": end, ACCEL_SD: sd}
    why, ledger = f"read in steps of {3.6 * step:.2g} km/h: smoothed, by at most half a step", rows.ledger
    for column in (c for c in made if c != ACCEL_SD):
        changed = int(np.sum(made[column] != rows.data[column]))
        ledger = ledger.add("derived", why, count=changed, column=column)
    return replace(rows, data={**rows.data, **made}, ledger=ledger)


def _with_slope(
    channels: dict[str, Any], data: Mapping[str, np.ndarray], trip: np.ndarray, distance: np.ndarray,
    duration: np.ndarray, place: np.ndarray | None, ledger: Ledger,
) -> tuple[dict[str, Any], tuple[str, Slope] | None, Ledger]:  # fmt: skip
    """The channels with the slope from altitudes, or smoothed where it was logged with noise, and its standard
    deviation where that matters."""
    source = next((c for c in ("grade_rad", "altitude_m") if c in channels), None)
    if source is None:
        level = "neither slope nor altitude in the log: taken as level"
        return channels, None, ledger.add("noted", level, column="grade_rad")
    slope = slope_of(trip, distance, duration, data[source], of_slope=source == "grade_rad", place=place)
    if slope is None:
        if source == "altitude_m":
            channels = {**channels, "grade_rad": np.zeros(len(trip))}
        return channels, None, ledger
    made = {"grade_rad": slope.grade_rad, **({GRADE_SD: slope.sd_rad} if slope.noisy else {})}
    (told,) = instruments_of({}, (source, slope))
    how = f"from {source}" if source == "altitude_m" else "smoothed"
    ledger = ledger.add("derived", f"{how} ({told.line()})", column="grade_rad")
    if (r := slope.repeated) is not None and r.disagree:
        apart = "a pass of 20 m of road that disagrees with most others by height: kept apart"
        ledger = ledger.add("noted", apart, count=r.disagree, column="grade_rad")
    if slope.jumps:
        ledger = ledger.add(
            "noted", f"{source} jumps: the slope begins anew there", count=slope.jumps, column="grade_rad"
        )
    return {**channels, **made}, (source, slope), ledger


def _started(rows: Rows) -> dict[str, float]:
    """When each trip began, where that is a date: in seconds since 1970."""
    at = np.flatnonzero(starts(rows.trip))
    began = {rows.trip_names[int(rows.trip[i])]: float(rows.origin_s[i]) for i in at}
    return {name: x for name, x in began.items() if FIRST_DATE_S <= x <= LAST_DATE_S}


def _intervals(rows: Rows, sampled: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    data, trip = rows.data, rows.trip
    given = data.get("duration_s")
    if "time_s" in data:
        time = data["time_s"] - rows.origin_s
    else:
        assert given is not None
        end = np.cumsum(given)
        edges = np.flatnonzero(starts(trip))
        time = end - given - np.repeat((end - given)[edges], np.diff(np.r_[edges, len(trip)]))
    if sampled:
        return sample_intervals(trip, time, data["speed_mps"], given)
    if given is None:
        step = np.r_[np.where(np.diff(trip) == 0, np.diff(time), np.nan), np.nan]
        given = np.where(np.isnan(step), trip_median(step, trip), step)
    return time, given, data["speed_start_mps"], data["speed_end_mps"]
