"""One drive in generated ways to write it: read as it is, or refused with a line; never read as another."""

import csv
import gzip
import io
import tempfile
from pathlib import Path

import hypothesis.strategies as st
import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from logs_helpers import samples

from hdev_jax.errors import InputError
from hdev_jax.logs import Adapter, Log, read_log

FIFTEEN = settings(max_examples=15)
FRAME = (
    samples(120).drop(columns="trip_id").round(3).assign(battery_power_w=lambda f: 10.0 * f["battery_power_w"].round(1))
)


def read(data: bytes, adapter: dict | None = None, name: str = "log.csv") -> Log:
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / name).write_bytes(data)
        return read_log(Path(folder) / name, None if adapter is None else Adapter.from_dict(adapter))


def text(frame: pd.DataFrame, **options) -> str:
    return frame.to_csv(index=False, **options)


def said(data: bytes, adapter: dict | None = None) -> str:
    """The line with which a file is refused; an empty text where it is read."""
    try:
        read(data, adapter)
    except InputError as e:
        return str(e)
    return ""


def same(log: Log, frame: pd.DataFrame = FRAME) -> None:
    np.testing.assert_allclose(log.segments.time_s, FRAME["time_s"], atol=1e-6)
    np.testing.assert_allclose(log.segments.distance_m, frame["speed_mps"] * log.segments.duration_s, rtol=1e-9)
    np.testing.assert_allclose(log.measured["battery_power_w"], frame["battery_power_w"], rtol=1e-9)


@st.composite
def dialects(draw) -> tuple[bytes, int]:
    """A file, and how many of its lines hold no values."""
    separator = draw(st.sampled_from(",;\t|"))
    decimal = draw(st.sampled_from(".,"))
    quoting = draw(st.sampled_from([csv.QUOTE_MINIMAL, csv.QUOTE_ALL]))
    lines = text(FRAME, sep=separator, decimal=decimal, quoting=quoting).splitlines()
    header, extra = lines[0], 0
    for k in sorted(draw(st.sets(st.integers(2, 119), max_size=4)), reverse=True):
        what = draw(st.sampled_from(["# a remark, of two; parts", header, ""]))
        lines.insert(k, what)
        extra += bool(what)
    if draw(st.booleans()):
        lines = [f"{line}{separator}" if line and line[0] != "#" else line for line in lines]
    before = draw(st.sampled_from([[], ["Recorder 7"], ['"Logger; 3, a"', "", "started at 07:12"], ["# car: x, y"]]))
    lines = [*before, *lines]
    data = draw(st.sampled_from(["\n", "\r\n"])).join(lines) + draw(st.sampled_from(["", "\n", "\n\n"]))
    return data.encode(draw(st.sampled_from(["utf-8", "utf-8-sig", "cp1252"]))), extra


@settings(max_examples=25)
@given(dialects())
def test_every_dialect_is_the_same_drive(made):
    data, extra = made
    log = read(data)
    same(log)
    assert sum(e.count for e in log.ledger if "no values" in e.reason) == extra


@FIFTEEN
@given(st.integers(1, 118), st.sampled_from(";\t|"))
def test_decimals_that_begin_late(first, separator):
    frame = FRAME.assign(speed_mps=FRAME["speed_mps"].where(FRAME.index >= first, 7.0))
    cells = [frame[c].astype(str) for c in frame]
    cells = [c.where(~c.str.endswith(".0"), c.str[:-2]).str.replace(".", ",", regex=False) for c in cells]
    rows = [separator.join(row) for row in zip(*cells, strict=True)]
    same(read("\n".join([separator.join(frame), *rows]).encode()), frame)


@FIFTEEN
@given(st.sampled_from([(".", ",", ";"), (",", ".", ";"), ("'", ".", ","), (",", ".", ",")]), st.booleans())
def test_thousands_are_taken_out_where_they_are_certain_and_asked_about_where_not(marks, fraction):
    mark, decimal, separator = marks
    frame = FRAME.assign(battery_power_w=(FRAME["battery_power_w"] + 900.0).round())
    written = [f"{x:,.1f}" if fraction else f"{x:,.0f}" for x in frame["battery_power_w"]]
    swap = str.maketrans({",": mark, ".": decimal})
    shown = frame.astype(str).assign(battery_power_w=[w.translate(swap) for w in written])
    for c in ("time_s", "speed_mps", "ambient_temp_c"):
        shown[c] = shown[c].str.replace(".", decimal, regex=False)
    data = text(shown, sep=separator).encode()
    if line := said(data):
        assert "thousands" in line
        assert not fraction
    else:
        same(read(data), frame)
    same(read(data, {"thousands": mark, "decimal": decimal}), frame)


@FIFTEEN
@given(st.integers(100, 900), st.integers(0, 2**16), st.sampled_from([",", ";"]))
def test_decimals_of_one_length_are_no_groups_of_thousands(volts, seed, separator):
    """A voltage as `%.3f` has 380.000 beside 379.512."""
    voltage = np.round(volts + np.random.default_rng(seed).normal(0.0, 3.0, 120), 3)
    voltage[5] = volts
    log = read(text(FRAME.assign(voltage_v=voltage), sep=separator, float_format="%.3f").encode())
    np.testing.assert_allclose(log.segments.channels["voltage_v"], voltage)


@FIFTEEN
@given(st.lists(st.integers(2, 119), min_size=1, max_size=30, unique=True), st.sampled_from(",;"))
def test_lines_with_a_field_too_few_are_left_out_or_refused_and_never_shifted(lines, separator):
    rows = text(FRAME, sep=separator).splitlines()
    for k in lines:
        rows[k] = separator.join(rows[k].split(separator)[1:])
    data = "\n".join(rows).encode()
    if line := said(data):
        assert "fields" in line
        return
    log = read(data)
    assert len(lines) <= 6
    keep = np.setdiff1d(np.arange(120), np.array(lines) - 1)
    np.testing.assert_allclose(log.measured["battery_power_w"], FRAME["battery_power_w"].iloc[keep])
    assert log.ledger.count("dropped") == len(lines)


STAMPS = {
    "%Y-%m-%dT%H:%M:%S": True,
    "%Y-%m-%d %H:%M:%S.%f": True,
    "%Y/%m/%d %H:%M:%S": True,
    "%d.%m.%Y %H:%M:%S": True,
    "%d/%m/%Y %H:%M:%S": False,  # where no day is beyond the 12th and there are two: it is asked
    "%m/%d/%Y %I:%M:%S %p": False,
    "%d-%b-%Y %H:%M:%S.%f": True,
    "%a %b %d %H:%M:%S GMT+02:00 %Y": True,
    "%H:%M:%S": True,
}


@pytest.mark.parametrize("start", ["2016-11-05 23:59:03", "2023-07-27 09:30:17"])
@pytest.mark.parametrize("form", STAMPS)
def test_every_clock_is_the_same_drive_also_over_midnight(form, start):
    stamp = pd.Timestamp(start) + pd.to_timedelta(FRAME["time_s"], unit="s")
    frame = FRAME.drop(columns="time_s").assign(timestamp=stamp.dt.strftime(form))
    data = text(frame).encode()
    if line := said(data):
        assert not STAMPS[form]
        assert "format" in line
    else:
        same(read(data))
    same(read(data, {"columns": {"time_s": {"source": "timestamp", "format": form}}}))
    if form.startswith("%H"):
        two = frame.rename(columns={"timestamp": "Time"}).assign(Date=stamp.dt.strftime("%Y-%m-%d"))
        same(read(text(two).encode()))


@FIFTEEN
@given(st.integers(1, 118), st.booleans())
def test_local_time_over_the_end_of_summer_time(row, zone):
    """At `row` it is three in the morning, and two again."""
    utc = pd.Timestamp("2024-10-27T01:00:00Z") + pd.to_timedelta(FRAME["time_s"] - row, unit="s")
    local = utc.dt.tz_convert("Europe/Zurich").dt.strftime("%Y-%m-%d %H:%M:%S")
    frame = FRAME.drop(columns="time_s").assign(timestamp=local)
    same(read(text(frame).encode(), {"time_zone": "Europe/Zurich"} if zone else None))


@FIFTEEN
@given(st.integers(1, 118))
def test_seconds_of_the_day_over_midnight(row):
    frame = FRAME.assign(time_s=(86400.0 - row + FRAME["time_s"]) % 86400.0)
    log = read(text(frame).encode())
    same(log)
    assert any("midnight" in e.reason and e.count == 120 - row for e in log.ledger)


@FIFTEEN
@given(
    st.sampled_from([1.0, 1e3, 1e6]), st.integers(1_100_000_000, 2_000_000_000), st.sampled_from(["time", "Timestamp"])
)
def test_times_since_1970_by_their_size(scale, start, name):
    stamp = ((FRAME["time_s"] + start) * scale).astype("int64")
    log = read(text(FRAME.drop(columns="time_s").assign(**{name: stamp})).encode())
    same(log)
    assert any("since 1970" in e.reason for e in log.ledger)


@FIFTEEN
@given(st.integers(2, 30), st.integers(0, 29))
def test_stamps_of_a_coarse_clock_are_refused_or_spread(each, phase):
    frame = FRAME.assign(time_s=np.floor((np.arange(120) + phase) / each) * each)
    with pytest.raises(InputError, match="repeated_stamps"):
        read(text(frame).encode())
    log = read(text(frame).encode(), {"repeated_stamps": "spread"})
    assert len(log) == 120
    np.testing.assert_allclose(np.diff(log.segments.time_s)[1:-1], 1.0, rtol=0.5 if each < 4 else 0.2, atol=0.2)


def test_a_clock_that_begins_anew_begins_a_trip():
    frame = pd.concat([FRAME.iloc[:50], FRAME.iloc[:70]], ignore_index=True)
    frame.loc[50:, "battery_power_w"] += 1.0
    log = read(text(frame).encode())
    assert log.trip_names == ("log", "log/2")
    assert [e.kind for e in log.ledger if "begins anew" in e.reason] == ["split"]


def test_vehicles_interleaved_by_time_are_sorted_apart():
    frame = pd.concat([FRAME.assign(vehicle_id=v) for v in "ab"]).sort_values(["time_s", "vehicle_id"])
    log = read(text(frame).encode())
    assert log.trip_names == log.vehicle_names == ("a", "b")
    np.testing.assert_allclose(log.measured["battery_power_w"], np.tile(FRAME["battery_power_w"], 2))
    assert any("interleaved" in e.reason and e.count == 240 for e in log.ledger)


def test_trip_ids_of_several_columns():
    frame = FRAME.assign(day=np.repeat([1, 2], 60), run=np.tile(np.repeat([1, 2], 30), 2))
    log = read(text(frame).encode(), {"columns": {"trip_id": ["day", "run"]}})
    assert log.trip_names == ("1-1", "1-2", "2-1", "2-2")


def as_bytes(kind: str) -> bytes:
    buffer = io.BytesIO()
    match kind:
        case "feather":
            FRAME.to_feather(buffer)
        case "parquet":
            FRAME.to_parquet(buffer)
        case "jsonl":
            FRAME.to_json(buffer, orient="records", lines=True)
        case "xlsx":
            pytest.importorskip("openpyxl")
            FRAME.to_excel(buffer, index=False)
        case _:
            return text(FRAME).encode()
    return buffer.getvalue()


@pytest.mark.parametrize("zipped", [False, True])
@pytest.mark.parametrize("kind", ["csv", "txt", "tsv", "feather", "parquet", "jsonl", "xlsx"])
def test_every_format_also_gzipped(kind, zipped):
    data = as_bytes(kind)
    same(read(gzip.compress(data) if zipped else data, name=f"log.{kind}" + (".gz" if zipped else "")))
    for cut in (data[:-200], data[: len(data) // 2]):
        if kind in ("feather", "parquet", "xlsx"):
            with pytest.raises(InputError, match="damaged"):
                read(cut, name=f"log.{kind}")


def test_in_a_folder_of_logs_texts_are_left_out_and_said(tmp_path):
    (tmp_path / "a.csv").write_text(text(FRAME))
    (tmp_path / "notes.txt").write_text("tyres changed")
    log = read_log(tmp_path)
    assert any("notes.txt" in line and "left out" in line for line in log.ledger.lines())


@pytest.mark.parametrize(
    ("header", "column"),
    [("Speed [km/h]", "speed_mps"), ("SPEED (mph)", "speed_mps"), ("Ambient temp [°F]", "ambient_temp_c")],
)
def test_a_unit_in_brackets_is_read(header, column):
    log = read(text(FRAME.rename(columns={column: header})).encode())
    factor = {"Speed [km/h]": 1 / 3.6, "SPEED (mph)": 0.44704}.get(header)
    if factor:
        np.testing.assert_allclose(log.segments.distance_m, FRAME["speed_mps"] * factor)
    else:
        np.testing.assert_allclose(log.segments.channels[column], (FRAME[column] - 32) / 1.8)


def test_a_unit_that_the_file_says_is_not_overlooked_by_an_adapter():
    frame = FRAME.rename(columns={"speed_mps": "v [km/h]"})
    log = read(text(frame).encode(), {"columns": {"speed_mps": "v [km/h]"}})
    np.testing.assert_allclose(log.segments.distance_m, FRAME["speed_mps"] / 3.6)
    with pytest.raises(InputError, match="unit or affine"):
        read(text(FRAME.rename(columns={"speed_mps": "v [kW]"})).encode(), {"columns": {"speed_mps": "v [kW]"}})


def test_a_row_of_units_that_contradicts_a_name_is_refused():
    lines = text(FRAME.rename(columns={"speed_mps": "speed_kmh"})).splitlines()
    lines.insert(1, "s,m/s,degC,W")
    with pytest.raises(InputError, match=r"speed_kmh.*row of units says m/s"):
        read("\n".join(lines).encode())
