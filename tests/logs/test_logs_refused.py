"""What contract §1 refuses: one line that names file, row, column and the remedy."""

import csv
import gzip
import io
import tempfile
from pathlib import Path

import hypothesis.strategies as st
import numpy as np
import pandas as pd
import pytest
import scipy.io
from hypothesis import given
from logs_helpers import intervals, read, samples, write

from hdev_jax.errors import InputError
from hdev_jax.logs import Adapter, read_log


def refused(call, *parts: str) -> str:
    with pytest.raises(InputError) as caught:
        call()
    message = str(caught.value)
    assert "\n" not in message
    for part in parts:
        assert part in message, message
    return message


@pytest.mark.parametrize(
    ("frame", "parts"),
    [
        (samples().rename(columns={"speed_mps": "sped_mps"}), ("speed_mps", "sped_mps")),
        (samples().rename(columns={"speed_mps": "Speed"}), ("speed_mps", "'Speed'", "rename")),
        (samples().rename(columns={"speed_mps": "x"}), ("speed_mps", "the file has", "adapter")),
        (samples().drop(columns="time_s"), ("time_s or duration_s",)),
        (samples().rename(columns={"time_s": "tme_s"}), ("time_s", "'tme_s'")),
        (intervals().rename(columns={"speed_end_mps": "speed_edn_mps"}), ("speed_end_mps", "speed_edn_mps")),
    ],
)
def test_needed_column_missing_or_misspelt(tmp_path, frame, parts):
    refused(lambda: read(tmp_path, frame), "log.csv", *parts)


@pytest.mark.parametrize(
    ("old", "new", "parts"),
    [
        ("speed_mps", "speed_furlong", ("speed_furlong", "speed_kmh")),
        ("battery_power_w", "battery_power_nm", ("battery_power_nm", "battery_power_kw")),
        ("ambient_temp_c", "ambient_temp_celsius", ("ambient_temp_celsius", "ambient_temp_c", "ambient_temp_k")),
    ],
)
def test_wrong_unit_suffix(tmp_path, old, new, parts):
    refused(lambda: read(tmp_path, samples().rename(columns={old: new})), "log.csv", *parts)


@pytest.mark.parametrize("column", ["speed_mps", "ambient_temp_c", "time_s", "battery_power_w"])
def test_text_in_a_numeric_column(tmp_path, column):
    frame = samples().astype({column: object})
    frame.loc[41, column] = "fast"
    refused(lambda: read(tmp_path, frame), "log.csv", "row 42", "line 43", column, "'fast'")


def test_text_in_a_column_that_is_otherwise_numeric(tmp_path):
    frame = samples().assign(wiper=1.0).astype({"wiper": object})
    frame.loc[3, "wiper"] = "2,5"
    refused(lambda: read(tmp_path, frame), "wiper", "'2,5'", "comma")


def test_a_message_holds_no_control_characters(tmp_path):
    frame = samples().astype({"speed_mps": object})
    frame.loc[1, "speed_mps"] = "1\x1b[31m2" + 100 * "x"
    assert len(refused(lambda: read(tmp_path, frame), "row 2")) < 150


def test_more_than_a_few_per_cent_bad_rows(tmp_path):
    frame = samples()
    frame.loc[10:25, "speed_mps"] = np.nan
    refused(lambda: read(tmp_path, frame), "log.csv", "16 of 300", "speed_mps missing", "row 11")


def test_times_that_stand_still(tmp_path):
    frame = samples()
    frame["time_s"] = np.floor(frame["time_s"] / 4)
    refused(lambda: read(tmp_path, frame), "same time_s", 'repeated_stamps = "spread"')


def test_time_running_backwards(tmp_path):
    frame = samples()
    frame.loc[100:, "time_s"] -= 50.0
    refused(lambda: read(tmp_path, frame), "row 101", "time_s", "backwards", "'A'")


def test_trip_that_goes_on_after_another(tmp_path):
    frame = samples()
    frame.loc[100:200, "trip_id"] = "B"
    refused(lambda: read(tmp_path, frame), "row 202", "'A'", "together")


def test_vehicle_changes_inside_a_trip(tmp_path):
    frame = samples().assign(vehicle_id=["x"] * 100 + ["y"] * 200)
    refused(lambda: read(tmp_path, frame), "row 101", "vehicle_id")


def test_speeds_above_60(tmp_path):
    frame = samples()
    frame["speed_mps"] *= 3.6 * 3
    refused(lambda: read(tmp_path, frame), "speed_mps", "60 m/s", "speed_kmh", "row ")


def test_slopes_that_no_road_has(tmp_path):
    """Per cent under the name of radians; a few wild values are missing ones, counted."""
    frame = intervals()
    frame["grade_rad"] *= 100.0
    refused(lambda: read(tmp_path, frame), "slope", "0.8 rad (103%)", "grade_pct", "row ")
    few = frame.grade_rad.where(np.arange(len(frame)) % 50 == 0)  # most rows have none: of those that have, many
    refused(lambda: read(tmp_path, frame.assign(grade_rad=few)), "slope", "of 6 rows")
    frame = intervals()
    frame.loc[[7, 8], "grade_rad"] = [0.9, -3.0]
    frame.loc[9, "grade_rad"] = -0.54  # a test track's
    log = read(tmp_path, frame)
    grade = log.segments.channels["grade_rad"]
    np.testing.assert_allclose(grade[7:10], np.interp([7, 8, 9], [6, 9], frame.grade_rad[[6, 9]]), atol=0.01)
    assert [(e.kind, e.count) for e in log.ledger if e.column == "grade_rad"] == [("noted", 2), ("filled", 2)]


def test_slopes_at_rest_are_noise_and_no_other_unit(tmp_path):
    frame = samples()
    frame["grade_rad"] = 0.01
    frame.loc[20:79, ["speed_mps", "grade_rad"]] = [0.01, 1.3]
    log = read(tmp_path, frame)
    np.testing.assert_allclose(log.segments.channels["grade_rad"], 0.01)
    assert log.ledger.count("noted", "grade_rad") == 60


def test_an_altitude_that_jumps_is_no_cliff(tmp_path):
    frame = samples()
    frame["altitude_m"] = 400.0 + 0.01 * np.cumsum(frame.speed_mps)
    frame.loc[150:, "altitude_m"] += 1000.0
    log = read(tmp_path, frame)
    assert np.abs(log.segments.channels["grade_rad"]).max() < 0.8
    assert any("altitude_m jumps" in e.reason and e.count for e in log.ledger)


def test_cumulative_distance(tmp_path):
    frame = intervals()
    frame["distance_m"] = frame["distance_m"].cumsum()
    refused(lambda: read(tmp_path, frame), "distance_m", "cumulative")


def test_no_usable_trip(tmp_path):
    refused(lambda: read(tmp_path, samples(1)), "no usable trip")
    refused(lambda: read(tmp_path, samples(), {"edge_trim_s": 200.0}), "no usable trip", "edge_trim_s")


def test_same_trip_in_two_files(tmp_path):
    a, b = write(tmp_path, samples(), "a.csv"), write(tmp_path, samples(), "b.csv")
    refused(lambda: read_log([a, b]), "'A'", "a.csv", "b.csv")
    refused(lambda: read_log([a, a]), "given twice")


@pytest.mark.parametrize("twice", [["speed_mps"], ["speed_kmh"]])
def test_two_columns_that_are_one(tmp_path, twice):
    frame = samples()
    frame = pd.concat([frame, frame[["speed_mps"]].set_axis(twice, axis=1)], axis=1)
    refused(lambda: read(tmp_path, frame), "speed_mps", "remove one")


def _parquet(path) -> bytes:
    samples().to_parquet(path)
    return path.read_bytes()


def _content(kind: str, folder) -> bytes:
    csv = samples().to_csv(index=False).encode()
    match kind:
        case "empty":
            return b""
        case "blank":
            return b"\n\n"
        case "header":
            return csv.splitlines()[0] + b"\n"
        case "numbers":
            return b"\n".join(csv.splitlines()[1:]).replace(b"A,", b"1,")
        case "cut csv":
            return csv[: csv.rfind(b",")]
        case "wide":
            return csv + b"A,300,1,2,3,4,5\n"
        case "gzip":
            return gzip.compress(csv)
        case "cut gzip":
            return gzip.compress(csv)[:-500]
        case "empty gzip":
            return gzip.compress(b"")
        case "csv":
            return csv
        case "utf-16":
            return csv.decode().encode("utf-16")
        case "zip":
            return b"PK\x03\x04" + bytes(100)
        case "hdf5":
            return b"\x89HDF\r\n\x1a\n" + bytes(1000)
        case "mat 7.3":
            return b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(512, b"\0") + b"\x89HDF\r\n\x1a\n"
        case "parquet":
            return _parquet(folder / "source.parquet")
        case "cut parquet":
            return _parquet(folder / "source.parquet")[:-300]
        case "mat":
            scipy.io.savemat(folder / "source.mat", {"speed_mps": np.ones(9)})
            return (folder / "source.mat").read_bytes()
        case "cut mat":
            scipy.io.savemat(folder / "source.mat", {"speed_mps": np.ones(900)})
            return (folder / "source.mat").read_bytes()[:500]
    raise AssertionError(kind)


@pytest.mark.parametrize(
    ("kind", "name", "parts"),
    [
        ("empty", "x.csv", ("empty",)),
        ("empty", "x.parquet", ("empty",)),
        ("empty", "x.mat", ("empty",)),
        ("blank", "x.csv", ("empty",)),
        ("header", "x.csv", ("no rows",)),
        ("numbers", "x.csv", ("line 1", "name the columns")),
        ("cut csv", "x.csv", ("last line", "truncated")),
        ("wide", "x.csv", ("line", "fields")),
        ("gzip", "x.csv", ("ending", "gzip")),
        ("csv", "x.csv.gz", ("ending", "text")),
        ("cut gzip", "x.csv.gz", ("truncated",)),
        ("empty gzip", "x.csv.gz", ("empty",)),
        ("utf-16", "x.csv", ("UTF-8",)),
        ("zip", "x.csv", ("zip",)),
        ("parquet", "x.csv", ("Parquet",)),
        ("csv", "x.parquet", ("ending", "text")),
        ("cut parquet", "x.parquet", ("damaged",)),
        ("hdf5", "x.mat", ("damaged MATLAB 7.3 file",)),
        ("mat 7.3", "x.mat", ("damaged MATLAB 7.3 file",)),
        ("csv", "x.mat", ("ending", "text")),
        ("cut mat", "x.mat", ("truncated",)),
        ("mat", "x.csv", ("MATLAB",)),
        ("csv", "x.xlsx", ("ending", "text")),
        ("csv", "x.doc", ("ending", ".csv")),
    ],
)
def test_file_is_not_what_it_should_be(tmp_path, kind, name, parts):
    path = tmp_path / name
    path.write_bytes(_content(kind, tmp_path))
    refused(lambda: read_log(path), name, *parts)


def _matlab() -> bytes:
    buffer = io.BytesIO()
    scipy.io.savemat(buffer, {c: x.to_numpy() for c, x in samples(20).items() if c != "trip_id"})
    return buffer.getvalue()


@given(st.integers(0, len(_matlab()) - 1), st.integers(0, 255), st.booleans())
def test_a_damaged_matlab_file_never_gets_further_than_one_line(tmp_path_factory, place, byte, cut):
    path = tmp_path_factory.getbasetemp() / "damaged.mat"
    data = bytearray(_matlab())
    data[place] = byte
    path.write_bytes(bytes(data[:place] if cut else data))
    try:  # anything but these two, a warning included, fails the test
        said = str(read_log(path))
    except InputError as e:
        said = str(e)
    assert said
    assert "\n" not in said


def test_files_that_are_not_there(tmp_path):
    write(tmp_path, samples(), "monday.csv")
    refused(lambda: read_log(tmp_path / "munday.csv"), "no such file", "'monday.csv'")
    refused(lambda: read_log([]), "no log")
    (tmp_path / "empty").mkdir()
    refused(lambda: read_log(tmp_path / "empty"), "no log in this folder")


@pytest.mark.parametrize(
    ("table", "parts"),
    [
        ({"edge_trim": 1.0}, ("'edge_trim'", "'edge_trim_s'")),
        ({"format": "doc"}, ("format", "csv, parquet", "mat")),
        ({"trip_id": "("}, ("trip_id", "regular expression")),
        ({"edge_trim_s": -1.0}, ("edge_trim_s", "negative")),
        ({"edge_trim_s": "5"}, ("edge_trim_s", "number")),
        ({"companion": {"suffix": ".g.csv"}}, ("companion", "'on'")),
        ({"companion": {"sufix": ".g.csv", "on": "t"}}, ("'sufix'", "'suffix'")),
        ({"columns": {"speed_mps": {"sauce": "v"}}}, ("columns.speed_mps", "'sauce'", "'source'")),
        ({"columns": {"speed_mps": {"unit": "m/s"}}}, ("columns.speed_mps", "'source'")),
        ({"columns": {"speed_mps": {"source": "v", "unit": "kg"}}}, ("columns.speed_mps.unit", "'kg'", "km/h")),
        ({"columns": {"speed_mps": {"source": "v", "fill": "up"}}}, ("fill", "forward, nearest, linear")),
        ({"columns": {"speed_mps": {"source": "v", "affine": [1.0]}}}, ("affine", "[a, b]")),
        ({"columns": {"speed_mps": {"source": "v", "valid": [2.0, 1.0]}}}, ("valid", "low < high")),
        ({"columns": {"speed_mps": {"source": "v", "initial": 0}}}, ("initial", "fill")),
        ({"columns": {"sped_mps": {"source": "v"}, "speeds": {"source": "v"}}}, ("columns.speeds", "did you mean")),
        ({"columns": {"speed_mps": {"source": "v"}, "speed_kmh": {"source": "w"}}}, ("second rule", "speed_mps")),
        ({"columns": {"aa_kg": {"source": "bb_kg"}, "bb_kg": {"source": "aa_kg"}}}, ("leads back",)),
        ({"columns": 5}, ("columns", "table")),
    ],
)
def test_adapter_is_checked(table, parts):
    refused(lambda: Adapter.from_dict(table, where="a.toml"), "a.toml", *parts)


def test_adapter_file(tmp_path):
    refused(lambda: Adapter.load(tmp_path / "a.toml"), "a.toml", "no such file")
    (tmp_path / "a.toml").write_text("format = csv")
    refused(lambda: Adapter.load(tmp_path / "a.toml"), "a.toml", "TOML")


@pytest.mark.parametrize(
    ("source", "parts"),
    [("sped", ("'sped'", "'speed_mps'")), ("ambient_temp", ("'ambient_temp'", "'ambient_temp_c'"))],
)
def test_adapter_names_a_column_that_is_not_there(tmp_path, source, parts):
    column = "speed_mps" if source == "sped" else "battery_temp_c"
    refused(lambda: read(tmp_path, samples(), {"columns": {column: {"source": source}}}), "log.csv", *parts)


def test_adapter_that_does_not_match(tmp_path):
    refused(lambda: read(tmp_path, samples(), {"trip_id": "Trip_(\\d)"}), "log.csv", "does not match")
    refused(lambda: read(tmp_path, samples(), {"vehicle_id": "B(\\d)"}), "log.csv", "does not match")
    refused(lambda: read(tmp_path, samples(), {"format": "mat"}), "log.csv", "mat")


def test_targets(tmp_path):
    log = read(tmp_path, samples())
    refused(lambda: log.target("traction_force_n"), "log.csv", "traction_force_n", "battery_power_kw")
    refused(lambda: log.target("energy_kwh"), "energy_kwh", "'energy_wh'")
    refused(lambda: log.trip_id("B"), "'B'", "A")
    frame = samples().rename(columns={"battery_power_w": "batery_power_w"})
    refused(lambda: read(tmp_path, frame).default_target, "batery_power_w", "'battery_power_w'")


@given(st.sets(st.integers(2, 58), min_size=1, max_size=20), st.sampled_from([",", ";", "\t"]))
def test_a_line_with_a_field_too_many_is_refused_wherever_it_is(lines, separator):
    """What follows the surplus would be another column: an unquoted thousands separator."""
    text = samples(60).to_csv(index=False, sep=separator).splitlines()
    for k in lines:
        first, rest = text[k].split(separator, 1)
        text[k] = separator.join([first, "1", rest])
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.csv"
        path.write_text("\n".join(text) + "\n")
        with pytest.raises(InputError, match=rf"line {min(lines) + 1} has 6 fields, the header 5"):
            read_log(path)


def test_a_separator_at_the_end_of_lines_and_one_in_quotes_are_no_field_too_many(tmp_path):
    frame = samples(60).assign(place='Z\u00fcrich, "HB"')
    text = frame.to_csv(index=False, quoting=csv.QUOTE_NONNUMERIC).splitlines()
    (tmp_path / "log.csv").write_text("\n".join([text[0], *(f"{line}," for line in text[1:])]) + "\n", encoding="utf-8")
    assert len(read_log(tmp_path / "log.csv")) == 60


@given(st.integers(0, 59), st.integers(1000, 999999))
def test_thousands_in_a_file_with_decimal_commas_are_asked_about(row, watts):
    """14.288 W are fourteen thousand in such a file, and fourteen to a reader of points."""
    frame = samples(60).round(3)
    frame["battery_power_w"] = frame["battery_power_w"].astype(int).astype(str)
    frame.loc[row, "battery_power_w"] = f"{watts:,}".replace(",", ".")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.csv"
        frame.to_csv(path, index=False, sep=";", decimal=",")
        with pytest.raises(InputError, match=rf"line {row + 2}, column 'battery_power_w': .*thousands separator"):
            read_log(path)


def test_a_quoted_text_may_hold_separators_and_line_breaks(tmp_path):
    frame = samples(60).assign(note='stop\nat "HB", then\na,b,c,d,e,f,g,h,i\nend')
    frame.to_csv(tmp_path / "log.csv", index=False)
    assert len(read_log(tmp_path / "log.csv")) == 60


def test_a_carriage_return_within_a_line_is_named(tmp_path):
    path = tmp_path / "m.csv"
    path.write_bytes(b"time_s,speed_mps,battery_power_w\n0,1,2\n1,4\r.5,9\n2,3,4\n")
    with pytest.raises(InputError, match=r"m\.csv, line 3: a carriage return within the line"):
        read_log([path])
