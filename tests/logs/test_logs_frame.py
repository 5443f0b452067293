"""A log from a table in memory is the log of the same table in a file."""

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest

from hdev_jax.errors import InputError
from hdev_jax.logs import Log, read_log

N = 40


@pytest.fixture
def frame() -> pd.DataFrame:
    rng = np.random.default_rng(4)
    return pd.DataFrame(
        {
            "trip_id": np.repeat(["a", "b"], N // 2),
            "time_s": np.tile(np.arange(N // 2, dtype=float), 2),
            "speed_kmh": 30.0 + 10.0 * rng.random(N),
            "grade_pct": rng.normal(size=N),
            "battery_power_kw": 20.0 * rng.random(N),
        }
    )


@pytest.mark.parametrize(
    "made",
    [lambda f: f, pa.Table.from_pandas, lambda f: f.to_dict("list"), dict],
    ids=["pandas", "arrow", "lists", "columns"],
)
def test_a_table_is_read_as_its_file(made, frame, tmp_path):
    frame.to_csv(tmp_path / "log.csv", index=False)
    from_file, from_memory = read_log(tmp_path / "log.csv"), Log.from_frame(made(frame))
    assert from_memory.fingerprint() == from_file.fingerprint()
    assert [c.name for c in from_memory.columns] == [c.name for c in from_file.columns]


def test_when_trips_began_is_known_where_the_clock_has_a_date(frame):
    assert Log.from_frame(frame).started_s == {}
    of_trip = np.repeat(["2022-01-06T05:02:00", "2022-03-09T05:25:00"], N // 2)
    stamps = pd.to_datetime(of_trip) + pd.to_timedelta(frame["time_s"].to_numpy(), unit="s")
    unix = (stamps - pd.Timestamp(0)).total_seconds()
    began = {"a": pd.Timestamp("2022-01-06T05:02:00").timestamp(), "b": pd.Timestamp("2022-03-09T05:25:00").timestamp()}
    bare = frame.drop(columns="time_s")
    for clock in ({"timestamp": stamps}, {"timestamp": stamps.strftime("%Y-%m-%dT%H:%M:%S")}, {"time_unix": unix}):
        log = Log.from_frame(bare.assign(**clock))
        assert log.started_s == pytest.approx(began)
        np.testing.assert_allclose(log.segments.time_s[: N // 2], np.arange(N // 2), atol=1e-6)


def test_an_index_is_no_row_number(frame):
    shuffled = frame.set_index(np.arange(100, 100 + N))
    assert Log.from_frame(shuffled).fingerprint() == Log.from_frame(frame).fingerprint()


def test_without_a_trip_the_name_is_one(frame):
    one = frame.iloc[: N // 2].drop(columns="trip_id")
    assert Log.from_frame(one, name="Monday").trip_names == ("Monday",)


@pytest.mark.parametrize(
    ("spoilt", "words"),
    [
        (lambda f: f.rename(columns={"speed_kmh": "sped_kmh"}), r"Monday: no column speed_mps.*sped_kmh.* is near"),
        (lambda f: f.iloc[:0], "Monday: no rows"),
        (lambda f: {**f.to_dict("list"), "grade_pct": [1.0]}, "Monday: columns of different lengths"),
        (lambda f: f.assign(speed_kmh="fast"), "Monday: .*speed_kmh"),
    ],
    ids=["misspelt", "empty", "lengths", "text"],
)
def test_what_a_file_is_refused_for(spoilt, words, frame):
    with pytest.raises(InputError, match=words):
        Log.from_frame(spoilt(frame), name="Monday")


def test_it_says_what_it_is(frame):
    assert repr(Log.from_frame(frame)) == (
        "Log(40 rows, 2 trips, 1 vehicles; measured: battery_power_w; channels: grade_rad)"
    )
