"""What contract §1 repairs: done, counted in the ledger, and fine."""

import numpy as np
import pandas as pd
import pytest
from logs_helpers import intervals, read, samples, write

from hdev_jax.logs import read_log


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_missing_in_a_channel_that_is_not_needed_is_interpolated(tmp_path, value):
    frame = samples()
    frame.loc[10:12, "ambient_temp_c"] = value
    log = read(tmp_path, frame)
    a, b = frame["ambient_temp_c"][9], frame["ambient_temp_c"][13]
    np.testing.assert_allclose(log.segments.channels["ambient_temp_c"][10:13], a + (b - a) * np.array([1, 2, 3]) / 4)
    assert log.ledger.count("filled", "ambient_temp_c") == 3
    assert len(log) == len(frame)


def test_whole_numbers_are_held_and_angles_take_the_nearest(tmp_path):
    frame = samples().assign(gear=2.0, heading_rad=6.2)
    frame.loc[20:, "gear"] = 3.0
    frame.loc[20:, "heading_rad"] = 0.1
    frame.loc[16:21, ["gear", "heading_rad"]] = np.nan
    log = read(tmp_path, frame)
    np.testing.assert_array_equal(log.segments.channels["gear"][15:23], [2, 2, 2, 2, 2, 2, 2, 3])
    np.testing.assert_array_equal(log.segments.channels["heading_rad"][15:23], [6.2, 6.2, 6.2, 6.2, 0.1, 0.1, 0.1, 0.1])


def test_an_empty_channel_is_absent(tmp_path):
    log = read(tmp_path, samples().assign(ambient_temp_c=np.nan))
    assert not log.segments.has("ambient_temp_c")
    assert any(e.column == "ambient_temp_c" and "absent" in e.reason for e in log.ledger)


@pytest.mark.parametrize(("trips", "kept"), [(20, True), (3, False)])
def test_a_channel_empty_in_a_whole_trip(tmp_path, trips, kept):
    frame = pd.concat([samples(30, trip=f"T{i}") for i in range(trips)])
    frame.loc[frame["trip_id"] == "T1", "ambient_temp_c"] = np.nan
    log = read(tmp_path, frame)
    assert log.segments.has("ambient_temp_c") == kept
    assert any(e.column == "ambient_temp_c" and ("median" in e.reason or "left out" in e.reason) for e in log.ledger)


@pytest.mark.parametrize(
    ("column", "value"),
    [("speed_mps", np.nan), ("speed_mps", -3.0), ("time_s", np.nan), ("battery_power_w", np.nan), ("trip_id", None)],
)
def test_bad_rows_up_to_one_per_cent_are_dropped(tmp_path, column, value):
    frame = samples()
    frame.loc[[50, 51, 200], column] = value
    log = read(tmp_path, frame)
    assert len(log) == len(frame) - 3
    assert log.ledger.count("dropped") == 3
    # the neighbours of a dropped sample take over its time
    np.testing.assert_allclose(log.segments.duration_s.sum(), len(frame))
    np.testing.assert_allclose(
        log.segments.time_s + log.segments.duration_s, np.r_[log.segments.time_s[1:], len(frame)]
    )


@pytest.mark.parametrize("column", ["speed_start_mps", "duration_s"])
def test_bad_rows_of_an_interval_log(tmp_path, column):
    frame = intervals().drop(columns="time_s")
    frame.loc[7, column] = -5.0
    log = read(tmp_path, frame)
    assert len(log) == len(frame) - 1
    assert log.ledger.count("dropped") == 1


@pytest.mark.parametrize(("frame", "column"), [(samples(), "battery_power_w"), (intervals(), "energy_wh")])
def test_a_power_that_no_vehicle_has_is_dropped_and_its_row_is_named(tmp_path, frame, column):
    frame.loc[7, column] = 4e8
    log = read(tmp_path, frame)
    assert len(log) == len(frame) - 1
    assert any("20 MW" in e.reason and "row 8" in e.reason for e in log.ledger)


def test_missing_distance_and_duration_are_made_from_the_rest(tmp_path):
    frame = intervals()
    whole = read(tmp_path, frame)
    frame.loc[5, "distance_m"] = np.nan
    frame.loc[9, "duration_s"] = np.nan
    log = read(tmp_path, frame)
    np.testing.assert_allclose(log.segments.distance_m, whole.segments.distance_m)
    np.testing.assert_allclose(log.segments.duration_s, whole.segments.duration_s)
    assert log.ledger.count("filled", "distance_m") == log.ledger.count("filled", "duration_s") == 1


def test_duplicate_rows(tmp_path):
    frame = samples()
    log = read(tmp_path, pd.concat([frame, frame]))
    assert len(log) == len(frame)
    assert log.ledger.count("dropped") == len(frame)


def test_equal_rows_without_a_clock_are_steady_driving(tmp_path):
    frame = pd.DataFrame({"duration_s": 1.0, "speed_mps": 10.0, "battery_power_w": 5e3}, index=range(50))
    log = read(tmp_path, frame)
    assert len(log) == 50
    np.testing.assert_allclose(log.segments.time_s, np.arange(50.0))


def test_standstill_reverse_creep_and_constant_channels(tmp_path):
    frame = samples().assign(mass_kg=1800.0)
    frame.loc[:99, "speed_mps"] = 0.0
    frame.loc[100:103, "speed_mps"] = [-0.5, -0.1, 0.0, 0.2]
    log = read(tmp_path, frame)
    assert log.segments.speed_start_mps.min() == 0.0
    assert (log.segments.distance_m[:100] == 0.0).all()
    assert log.ledger.count("clipped", "speed_mps") == 2
    assert (log.segments.channels["mass_kg"] == 1800.0).all()


def test_one_row_trips_where_others_remain(tmp_path):
    log = read(tmp_path, pd.concat([samples(1, trip="B"), samples(), samples(1, trip="C")]))
    assert log.trip_names == ("A",)
    assert (log.segments.trip == 0).all()
    assert log.ledger.count("dropped") == 2


@pytest.mark.parametrize(("step", "parts"), [(10.0, 1), (11.0, 2), (5000.0, 2)])
def test_a_gap_longer_than_ten_samples_starts_a_trip(tmp_path, step, parts):
    frame = samples()
    frame.loc[100:, "time_s"] += step - 1.0
    log = read(tmp_path, frame)
    assert log.trip_names == ("A", "A/2")[:parts]
    if parts == 2:
        assert log.segments.time_s[100] == 0.0
        np.testing.assert_allclose(log.segments.duration_s, 1.0)
        assert [e.trip for e in log.ledger if e.kind == "split"] == ["A"]


def test_a_long_interval_is_no_gap(tmp_path):
    frame = intervals()
    frame.loc[50, "duration_s"] += 600.0
    frame.loc[51:, "time_s"] += 600.0
    assert read(tmp_path, frame).trip_names == ("A",)


def test_text_and_unknown_columns(tmp_path):
    frame = samples().assign(driver="Ann", lights=True, wiper=2.5, heated="yes")
    log = read(tmp_path, frame)
    assert set(log.segments.channels) == {"ambient_temp_c", "lights", "wiper", "heated"}
    assert (log.segments.channels["lights"] == 1.0).all()
    assert any(e.column == "driver" and "text" in e.reason for e in log.ledger)
    assert any(e.column == "wiper" and "own name" in e.reason for e in log.ledger)


def test_no_slope_is_noted(tmp_path):
    assert any(e.column == "grade_rad" for e in read(tmp_path, samples()).ledger)


def test_soc_in_per_cent(tmp_path):
    log = read(tmp_path, samples().assign(soc=80.5))
    assert log.segments.channels["soc"][0] == pytest.approx(0.805)


@pytest.mark.parametrize("header", ["time_iso", "time_s", "timestamp"])
def test_iso_times(tmp_path, header):
    frame = samples()
    stamp = pd.Timestamp("2023-05-01T23:59:50Z") + pd.to_timedelta(frame["time_s"], unit="s")
    other = frame.drop(columns="time_s").assign(**{header: stamp.dt.strftime("%Y-%m-%dT%H:%M:%S+00:00")})
    np.testing.assert_array_equal(read(tmp_path, other).segments.time_s, read(tmp_path, frame).segments.time_s)


@pytest.mark.parametrize("start", [0.0, 1.7e9])
def test_absolute_times_count_from_the_first_row(tmp_path, start):
    frame = samples().rename(columns={"time_s": "time_unix"})
    frame["time_unix"] += start
    log = read(tmp_path, frame)
    np.testing.assert_allclose(log.segments.time_s, np.arange(len(frame)))


def test_several_files_and_folders_are_one_log(tmp_path):
    frame = pd.concat([samples(trip="A"), samples(trip="B", seed=1)])
    whole = read_log(write(tmp_path, frame, "all.csv"))
    folder = tmp_path / "parts"
    folder.mkdir()
    for trip, part in frame.groupby("trip_id"):
        write(folder, part, f"{trip}.csv")
    parts = read_log(folder)
    assert parts.fingerprint() == whole.fingerprint()
    assert read_log([folder / "A.csv", folder / "B.csv"]).fingerprint() == whole.fingerprint()
    assert read_log(folder / "A.csv").fingerprint() != whole.fingerprint()


def test_the_stem_names_a_trip(tmp_path):
    assert read(tmp_path, samples().drop(columns="trip_id"), name="Monday.csv").trip_names == ("Monday",)
    assert read(tmp_path, samples().assign(trip_id=7)).trip_names == ("7",)


def test_a_channel_that_some_files_lack_is_left_out(tmp_path):
    a = write(tmp_path, samples(), "a.csv")
    b = write(tmp_path, samples(trip="B").drop(columns="ambient_temp_c"), "b.csv")
    log = read_log([a, b])
    assert not log.segments.has("ambient_temp_c")
    assert any(e.column == "ambient_temp_c" and "b.csv" in e.reason for e in log.ledger)


def test_ledger_merges_files(tmp_path):
    frame = samples()
    frame.loc[3, "ambient_temp_c"] = np.nan
    log = read(tmp_path, frame)
    assert any(line.startswith("filled 1 row of ambient_temp_c") for line in log.ledger.lines())
    assert {"kind", "reason", "count", "file", "trip", "column"} == set(log.ledger.to_dicts()[0])
    double = log.ledger + log.ledger
    assert len(double.merged()) == len(log.ledger.merged())
    with pytest.raises(ValueError, match="ledger kind"):
        log.ledger.add("lost", "no such kind")
