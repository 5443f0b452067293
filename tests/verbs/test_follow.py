"""`hdev follow`: rows as they arrive, from a pipe, in anybody's columns; a stop costs nothing."""

import contextlib
import gzip
import io
import json
import os
import subprocess
import sys

import numpy as np
import pandas as pd
import pytest

from hdev_jax import cli
from hdev_jax.errors import InputError
from hdev_jax.fleet import synthetic_log
from hdev_jax.inference.sheet import Sheet, augmented_sheet
from hdev_jax.logs import log_from_frame
from hdev_jax.logs.adapter import Adapter
from hdev_jax.online import Watch
from hdev_jax.online.stream import Stream
from hdev_jax.physics import LIBRARY
from hdev_jax.verbs.live.follow import follow

SHEET = {"mass_kg": 29e3, "road": {"c_rr": (0.006, 0.0008), "cda_m2": (5.6, 0.5)}, "driveline": {"efficiency": 0.91}}
KEPT = ["trip_id", "time_s", "duration_s", "distance_m", "speed_start_mps", "speed_end_mps", "mass_kg", "grade_rad",
        "energy_wh"]  # fmt: skip


@pytest.fixture(scope="module")
def frame():
    return synthetic_log(seed=5, trips=2, rows_per_trip=60).frame[KEPT]


def text(frame) -> str:
    return frame.to_csv(index=False)


def told(rows, **options):
    """Lines of JSON, parsed; `rows` a text as it would come from a pipe, or records."""
    given = io.BytesIO(rows.encode()) if isinstance(rows, str) else rows
    with contextlib.redirect_stdout(io.StringIO()) as out:
        assert follow(SHEET, given, json=True, watch=False, **options) is None
    return [json.loads(line) for line in out.getvalue().splitlines()]


def summed_up(rows, **options) -> str:
    """What is said at the end."""
    with contextlib.redirect_stdout(io.StringIO()):
        said = follow(SHEET, rows, watch=False, **options)
    assert said is not None
    return said


def test_rows_in_csv_json_and_memory_are_the_same(frame):
    one = told(text(frame))
    assert len(one) == 120
    assert one == told("\n".join(json.dumps(r) for r in frame.to_dict("records")))
    assert one == told(frame.to_dict("records"))
    assert one[0].keys() >= {"trip_id", "time_s", "measured", "predicted", "lower", "upper", "values", "weight"}
    assert set(one[-1]["values"]) == {"road.c_rr", "road.cda_m2"}
    inside = [r["lower"] <= r["measured"] <= r["upper"] for r in one[20:]]
    assert np.mean(inside) > 0.8
    said = summed_up(frame.to_dict("records"))
    assert "120 rows, 120 used, 2 trips" in said


def test_units_are_those_of_the_header(frame):
    other = frame.assign(energy_kwh=frame.energy_wh / 1e3, grade_pct=100 * np.tan(frame.grade_rad))
    other = other.drop(columns=["energy_wh", "grade_rad"]).rename(columns={"speed_start_mps": "speed_start_kmh"})
    other["speed_start_kmh"] *= 3.6
    one, two = told(text(frame)), told(text(other))
    np.testing.assert_allclose([r["predicted"] for r in one], [r["predicted"] for r in two], rtol=1e-6, atol=1e-6)


def test_an_adapter_names_foreign_columns(frame, tmp_path):
    path = tmp_path / "a.toml"
    path.write_text('[columns]\nenergy_wh = { source = "E", unit = "kWh", fill = "forward" }\n')
    foreign = frame.rename(columns={"energy_wh": "E"}).assign(E=frame.energy_wh / 1e3)
    np.testing.assert_allclose(
        [r["predicted"] for r in told(text(foreign), adapter=path)],
        [r["predicted"] for r in told(text(frame))],
        rtol=1e-6,
    )
    path.write_text('[columns]\nenergy_wh = { source = "E", counter = true }\n')
    with pytest.raises(InputError, match="counter is for files; send what each row added"):
        told(text(foreign), adapter=path)


@pytest.mark.parametrize("sampled", [False, True], ids=["intervals", "samples"])
def test_a_stop_costs_nothing(frame, tmp_path, sampled):
    """Stopped twice, begun again with rows that had been sent: as never having stopped."""
    if sampled:
        frame = pd.DataFrame({"trip_id": frame.trip_id, "time_s": 5.0 * np.arange(len(frame)),
                              "speed_mps": frame.speed_start_mps, "grade_rad": frame.grade_rad,
                              "mass_kg": frame.mass_kg, "energy_wh": frame.energy_wh})  # fmt: skip
    whole = told(text(frame), state=tmp_path / "whole.state")
    parts = []
    for rows in (frame[:37], frame[25:75], frame[:120]):
        parts += told(text(rows), state=tmp_path / "parts.state")
    assert parts == whole
    assert [p.name for p in tmp_path.iterdir() if p.name.startswith(".")] == []
    said = summed_up(frame.to_dict("records"), state=tmp_path / "parts.state")
    assert "repeated" in said
    with pytest.raises(InputError, match="of another sheet; name another file, or delete it"):
        follow(SHEET | {"mass_kg": 20e3}, [], state=tmp_path / "parts.state", watch=False)
    with pytest.raises(InputError, match="of a run whose target is energy_wh; name another file, or delete it"):
        told(text(frame), state=tmp_path / "parts.state", target="battery_power_kw")
    for about, said in (("[1]", "no file of hdev follow"), ('{"schema": "hdev-follow/1"}', "of another version")):
        with (tmp_path / "other.state").open("wb") as file:
            np.savez(file, numbers=np.zeros(3), about=np.array(about))
        with pytest.raises(InputError, match=said):
            told(text(frame), state=tmp_path / "other.state")
    (tmp_path / "parts.state").write_text("no")
    with pytest.raises(InputError, match="no file of hdev follow; name another, or delete it"):
        told(text(frame), state=tmp_path / "parts.state")


def test_samples_are_the_intervals_of_a_log(frame):
    """Those that a log makes of them, but at the ends of a trip, where it looks at five samples."""
    speed = np.asarray(frame.speed_start_mps)
    samples = pd.DataFrame({"trip_id": frame.trip_id, "time_s": np.arange(120.0),
                            "speed_mps": speed, "battery_power_kw": 50.0})  # fmt: skip
    log = log_from_frame(samples).segments
    stream = Stream()
    rows = [row for _, row in stream.intervals(stream.read(samples.to_dict("records")))]
    rows += [row for _, row in stream.flush()]
    assert len(rows) == 120
    other = np.flatnonzero(frame.trip_id.to_numpy()[1:] != frame.trip_id.to_numpy()[:-1])
    inner = np.setdiff1d(np.arange(1, 119), np.r_[other, other + 1])
    for name in ("duration_s", "speed_start_mps", "speed_end_mps", "distance_m", "time_s"):
        np.testing.assert_allclose([rows[i][name] for i in inner], np.asarray(getattr(log, name))[inner], atol=1e-9)


def test_a_last_line_cut_short_is_no_reading_where_it_will_be_sent_again(frame, tmp_path):
    whole = text(frame[:30])
    cut = told(whole[:-4], state=tmp_path / "cut.state")
    again = told(whole, state=tmp_path / "cut.state")
    assert (len(cut), len(again)) == (29, 1)
    assert cut + again == told(whole)
    assert len(told(whole.rstrip())) == 30  # a file that ends without a line's end


@pytest.mark.parametrize(
    ("column", "value", "counted"),
    [
        ("energy_wh", 1e308, "1 unmeasured"),
        ("mass_kg", 1e300, "1 held mass_kg"),
        ("mass_kg", -5.0, "1 held mass_kg"),
        ("grade_rad", 5.0, "1 held grade_rad"),
    ],
)
def test_a_number_of_no_vehicle_is_no_reading(frame, column, value, counted):
    """As where it is missing, and never NaN in what is known."""
    few = frame[:60]
    at = np.arange(60) == 30
    rows, missing = (few.assign(**{column: np.where(at, x, few[column])}) for x in (value, np.nan))
    said = summed_up(rows.to_dict("records"))
    assert counted in said
    assert "nan" not in said
    assert said == summed_up(missing.to_dict("records"))


def test_an_interval_without_its_length_ends_where_the_next_begins(frame):
    few = frame[:30]
    rows = few.assign(duration_s=np.where(np.arange(30) == 10, np.nan, few["duration_s"]))
    assert "30 rows, 30 used" in summed_up(rows.to_dict("records"))


def test_rows_at_the_start_of_a_trip_are_trimmed_as_the_adapter_says(frame, tmp_path):
    path = tmp_path / "a.toml"
    path.write_text("edge_trim_s = 30.0\n")
    since = frame.time_s - frame.groupby("trip_id").time_s.transform("first")
    assert 0 < (since < 30.0).sum() < len(frame)
    rows = told(text(frame), adapter=path)
    assert [r["time_s"] for r in rows] == pytest.approx(since[since >= 30.0].tolist())
    with contextlib.redirect_stdout(io.StringIO()) as out:
        said = follow(SHEET, frame.to_dict("records"), watch=False, adapter=path)
    assert f"{(since < 30.0).sum()} trimmed" in (said or "")
    assert "note: edge_trim_s: 30 s at the start" in out.getvalue()


def test_where_no_row_has_a_time_the_trim_counts_durations(frame, tmp_path):
    path = tmp_path / "a.toml"
    path.write_text("edge_trim_s = 30.0\n")
    timeless = frame.drop(columns="time_s")
    since = timeless.groupby("trip_id").duration_s.cumsum() - timeless.duration_s
    assert len(told(text(timeless), adapter=path)) == (since >= 30.0).sum()


def test_a_clock_that_starts_anew_within_a_trip_loses_no_row(frame):
    half = len(frame) // 4
    time = np.where(np.arange(len(frame)) < half, 86_000.0 + frame.time_s, frame.time_s)
    said = summed_up(frame.assign(time_s=time, trip_id="one").to_dict("records"))
    assert f"{len(frame)} rows, {len(frame)} used, 2 clock_jumps, 1 trips" in said
    assert "trimmed" not in said


@pytest.mark.parametrize("batches", [1, 12])
def test_a_blank_trip_belongs_to_the_trip_before(frame, batches):
    blank = frame.assign(trip_id=frame.trip_id.where(np.arange(len(frame)) % 7 != 3, ""))
    stream = Stream()
    rows = blank.to_dict("records")
    trips = []
    for part in np.array_split(np.arange(len(rows)), batches):
        read = stream.read([rows[i] for i in part])
        trips += [t for t, _ in read]
        list(stream.intervals(read))
    assert trips == frame.trip_id.tolist()


def test_a_state_of_before_a_count_was_kept_goes_on():
    about = Stream().about()
    for later in ("trimmed", "alone", "gone_s"):
        about.pop(later)
    assert Stream.again(about | {"so_far": [0.0, 0.0]}, Adapter()).trimmed == 0


def _samples(frame) -> list[dict]:
    rows = frame.assign(speed_mps=frame.speed_start_mps).drop(columns=["speed_start_mps", "speed_end_mps"])
    return rows.drop(columns=["duration_s", "distance_m"]).to_dict("records")


def test_samples_before_a_whole_row_are_used(frame):
    stream = Stream()
    rows = stream.read(_samples(frame.head(2))) + stream.read(frame[2:4].to_dict("records"))
    assert len(list(stream.intervals(rows))) == 4


def test_a_sample_without_a_neighbour_is_counted(frame):
    rows = _samples(frame)
    lone = {**rows[0], "trip_id": "lone"}
    assert "alone" not in summed_up(rows)
    assert "1 alone" in summed_up([*rows, lone])
    assert "1 alone" in summed_up([lone, *rows])


def test_what_does_not_read_is_counted_and_the_rest_used(frame):
    lines = text(frame).splitlines()
    lines[30] = lines[30].replace(lines[30].split(",")[6], "n/a")
    lines[40] = lines[40].replace(lines[40].split(",")[4], "broken")
    lines[50] = "half a li"
    lines.insert(60, lines[0])  # a logger that began again
    said = summed_up(io.BytesIO("\n".join(lines).encode()))
    assert "118 rows, 118 used, 2 trips, 1 held mass_kg, 2 unreadable" in said
    hostile = ["x" * 200_000, '{"a":' + "[" * 20_000 + "]" * 20_000 + "}"]
    said = summed_up(io.BytesIO("\r".join([*text(frame).splitlines(), *hostile]).encode()))
    assert "120 rows, 120 used, 2 trips, 2 unreadable" in said


@pytest.mark.parametrize(
    ("rows", "what"),
    [
        ("", "no rows; a header and rows of CSV, or JSON lines, are expected"),
        ("time_s,speed_mps\n0,3\n1,3\n", "no target: energy_wh, battery_power_w"),
        ("time_s,speed_mps,energy_wh\n0,three,1\n", "a number is expected, found 'three'"),
    ],
    ids=["nothing", "no target", "text"],
)
def test_rows_that_cannot_be_followed_are_one_line(rows, what, tmp_path):
    with pytest.raises(InputError, match=f"^standard input.*{what}"):
        summed_up(io.BytesIO(rows.encode()))
    (tmp_path / "rows.csv").write_text(rows)
    with pytest.raises(InputError, match=f"rows.csv.*{what}"):
        summed_up(tmp_path / "rows.csv")


def test_means_and_compressed_rows_are_refused(tmp_path):
    (tmp_path / "a.toml").write_text('stamp = "end"\n')
    with pytest.raises(InputError, match=r'a\.toml: stamp = "end" is for files'):
        summed_up([], adapter=tmp_path / "a.toml")
    (tmp_path / "b.toml").write_text('rows = "battery_power_w"\n')
    with pytest.raises(InputError, match=r"b\.toml: rows and repeated_stamps are for files"):
        summed_up([], adapter=tmp_path / "b.toml")
    with pytest.raises(InputError, match="compressed by gzip; text is expected"):
        summed_up(io.BytesIO(gzip.compress(b"time_s,speed_mps,energy_wh\n")))


def test_an_effect_that_the_sheet_lacks_is_told_once(monkeypatch, capsys):
    few = {k: LIBRARY[k] for k in ("standstill_load", "rotating_mass")}  # the whole library takes long to compile
    monkeypatch.setattr(Watch, "of", staticmethod(lambda state, _: Watch.beside(state.vehicle, state.form, few)))
    planted = {"standstill_load": {"power_w": 9e3}}
    made = synthetic_log(seed=3, trips=5, rows_per_trip=100, effects=planted, noise_rms=3.0).frame[KEPT]
    said = follow(SHEET, made.to_dict("records"))
    lines = capsys.readouterr().out.splitlines()
    assert sum(line.startswith("T0") for line in lines) == 500
    assert sum(line.startswith("ALARM standstill_load: power_w = ") for line in lines) == 1
    assert said is not None
    assert "\nALARM standstill_load: power_w = " in said
    follow(SHEET, made.to_dict("records"), json=True)
    alarms = [json.loads(line) for line in capsys.readouterr().out.splitlines() if line.startswith('{"alarm"')]
    assert [a["alarm"]["effect"] for a in alarms] == ["standstill_load"]


@pytest.mark.slow
def test_a_process_of_its_own_follows_as_this_one(frame, tmp_path):
    sheet = tmp_path / "truck.toml"
    sheet.write_text(augmented_sheet(Sheet(**SHEET), {}, {}))
    command = [sys.executable, "-m", "hdev_jax.cli", "follow", "--vehicle", str(sheet), "--no-watch"]
    done = subprocess.run(command, input=text(frame.head(5)), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "5 rows, 5 used, 1 trip" in done.stdout


def test_from_a_pipe(frame, tmp_path, monkeypatch, capsys):
    sheet = tmp_path / "truck.toml"
    sheet.write_text(augmented_sheet(Sheet(**SHEET), {}, {}))
    read, write = os.pipe()
    with open(read) as ours:
        with open(write, "w") as theirs:
            theirs.write(text(frame))  # it holds as much
        monkeypatch.setattr(sys, "stdin", ours)
        assert cli.main(["follow", "--vehicle", str(sheet), "--no-watch"]) == 0
    said = capsys.readouterr().out
    assert sum(line.startswith("T0") for line in said.splitlines()) == 120
    assert "120 rows, 120 used, 2 trips" in said
    with pytest.raises(InputError, match="--target traction_force_n: the rows do not measure it; they have "):
        told(text(frame), target="traction_force_n")
