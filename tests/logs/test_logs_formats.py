"""Every format and layout, every feature of an adapter."""

import gzip
import io
import tomllib

import numpy as np
import pandas as pd
import pytest
import scipy.io
from logs_helpers import intervals, read, samples, write

from hdev_jax.errors import InputError
from hdev_jax.logs import Adapter, read_log, write_adapter_skeleton

FRAME = samples(120)


def _text(**options) -> bytes:
    return FRAME.to_csv(index=False, **options).encode()


@pytest.mark.parametrize(
    ("name", "data"),
    [
        ("a.csv", _text()),
        ("b.csv", _text(sep=";")),
        ("c.csv", _text(sep=";", decimal=",")),
        ("d.csv", b"\xef\xbb\xbf" + _text()),
        ("e.csv", _text(lineterminator="\r\n")),
        ("f.csv", _text(quoting=1)),
        ("g.csv", _text().rstrip(b"\n")),
        ("h.csv", b"\n" + _text() + b"\n\n"),
        ("i.csv", _text().replace(b"\n", b",\n")),
        ("j.csv", b"".join([b"  , ".join(line.split(b",")) + b"\n" for line in _text().splitlines()])),
        ("k.csv.gz", gzip.compress(_text())),
        ("l.csv.gz", gzip.compress(_text(sep=";"))),
        ("m.csv", FRAME.to_csv().encode()),
        ("n.csv", _text(sep="\t")),
        ("o.csv", FRAME.assign(note="müde").to_csv(index=False).encode("cp1252")),
    ],
)
def test_csv(tmp_path, name, data):
    path = tmp_path / name
    path.write_bytes(data)
    assert read_log(path).fingerprint() == read(tmp_path, FRAME).fingerprint()


def test_parquet(tmp_path):
    expected = read(tmp_path, FRAME).fingerprint()
    assert read(tmp_path, FRAME, name="x.parquet").fingerprint() == expected
    typed = FRAME.astype({"trip_id": "category", "speed_mps": "Float64"})
    assert read(tmp_path, typed, name="y.parquet").fingerprint() == expected
    stamped = FRAME.assign(time_s=pd.Timestamp("2024-01-01", tz="UTC") + pd.to_timedelta(FRAME["time_s"], unit="s"))
    assert read(tmp_path, stamped, name="z.parquet").fingerprint() == expected


def test_mat_table(tmp_path):
    columns = {c: FRAME[c].to_numpy() for c in FRAME if c != "trip_id"}
    scipy.io.savemat(tmp_path / "A.mat", {**columns, "sheet": "text"})
    assert read_log(tmp_path / "A.mat").fingerprint() == read(tmp_path, FRAME).fingerprint()
    scipy.io.savemat(tmp_path / "B.mat", {**columns, "gear": np.ones(5)})
    with pytest.raises(InputError, match="different length"):
        read_log(tmp_path / "B.mat")


TIME_VALUE = {
    "format": "mat",
    "layout": "time_value",
    "trip_id": "Run(\\d+)_",
    "variable": "^Run\\d+_(.+)_f$",
    "columns": {"speed_mps": {"source": "V", "unit": "km/h"}, "battery_power_w": {"source": "P", "unit": "kW"}},
}


def test_mat_time_value(tmp_path):
    t = np.arange(100) * 0.5
    v = 10.0 + np.sin(t)
    run = {f"Run{k}_V_f": np.c_[t, 3.6 * v] for k in (1, 2)} | {f"Run{k}_P_f": np.c_[t, k * v] for k in (1, 2)}
    scipy.io.savemat(tmp_path / "x.mat", run)
    log = read_log(tmp_path / "x.mat", Adapter.from_dict(TIME_VALUE))
    assert log.trip_names == ("1", "2")
    np.testing.assert_allclose(log.segments.distance_m[100:], v * 0.5)
    np.testing.assert_allclose(log.measured["battery_power_w"], np.r_[1000 * v, 2000 * v])
    # without an expression for the channel the trip's part is cut out of the variable's name
    plain = {**TIME_VALUE, "columns": {"speed_kmh": {"source": "V_f"}, "battery_power_kw": "P_f"}}
    del plain["variable"]
    np.testing.assert_array_equal(
        read_log(tmp_path / "x.mat", Adapter.from_dict(plain)).target("energy_wh"), log.target("energy_wh")
    )


def test_mat_time_value_puts_channels_on_one_clock(tmp_path):
    """That of the power, which is the slower one: between two measurements there is none."""
    t, slow = np.arange(101) * 0.5, np.arange(11) * 5.0
    scipy.io.savemat(tmp_path / "x.mat", {"Run1_V_f": np.c_[t, 30 + t], "Run1_P_f": np.c_[slow, 2.0 * slow]})
    log = read_log(tmp_path / "x.mat", Adapter.from_dict(TIME_VALUE))
    np.testing.assert_allclose(log.measured["battery_power_w"], 2000.0 * slow)
    np.testing.assert_allclose(log.segments.distance_m, (30.0 + slow) / 3.6 * 5.0)
    fast = read_log(tmp_path / "x.mat", Adapter.from_dict({**TIME_VALUE, "clock": "V"}))
    np.testing.assert_allclose(fast.measured["battery_power_w"], 2000.0 * slow)
    scipy.io.savemat(tmp_path / "x.mat", {"Run1_V_f": np.c_[t[::-1], 30 + t], "Run1_P_f": np.c_[slow, 2.0 * slow]})
    with pytest.raises(InputError, match="the time of 'V' in trip 1 does not run forward"):
        read_log(tmp_path / "x.mat", Adapter.from_dict(TIME_VALUE))


def _adapted(tmp_path, frame, **adapter):
    return read(tmp_path, frame, adapter)


def test_units_affine_fill_and_valid(tmp_path):
    frame = FRAME.rename(columns={"speed_mps": "v"}).assign(slope=0.05, riders=np.nan, t=300.0)
    frame["v"] *= 3.6
    frame.loc[30, "riders"] = 4.0
    frame.loc[60, "riders"] = 6.0
    frame.loc[10, "slope"] = 0.5
    columns = {
        "mass_kg": {"source": "passengers", "affine": [1000.0, 70.0]},
        "speed_mps": {"source": "v", "unit": "km/h"},
        "passengers": {"source": "riders", "fill": "forward", "initial": 1},
        "grade_rad": {"source": "slope", "unit": "tan", "valid": [-0.12, 0.12]},
        "battery_temp_c": {"source": "t", "unit": "K"},
    }
    log = _adapted(tmp_path, frame, columns=columns)
    c = log.segments.channels
    np.testing.assert_array_equal(c["passengers"], np.repeat([1.0, 4.0, 6.0], [30, 30, 60]))
    np.testing.assert_array_equal(c["mass_kg"], 1000.0 + 70.0 * c["passengers"])
    np.testing.assert_allclose(c["grade_rad"], np.arctan(0.05))
    np.testing.assert_allclose(c["battery_temp_c"], 26.85)
    np.testing.assert_allclose(log.segments.distance_m, FRAME["speed_mps"])
    assert log.ledger.count("clipped", "grade_rad") == 1
    assert log.ledger.count("filled", "passengers") == 118
    assert "riders" not in c


def test_fill_stays_inside_a_trip(tmp_path):
    frame = pd.concat([samples(50, trip="A"), samples(50, trip="B")]).assign(riders=np.nan).reset_index(drop=True)
    frame.loc[10, "riders"] = 9.0
    columns = {"passengers": {"source": "riders", "fill": "forward", "initial": 0}}
    log = _adapted(tmp_path, frame, columns=columns)
    np.testing.assert_array_equal(log.segments.channels["passengers"], np.repeat([0.0, 9.0, 0.0], [10, 40, 50]))


@pytest.mark.parametrize("others", ["keep", "drop"])
def test_columns_that_no_rule_names(tmp_path, others):
    frame = FRAME.assign(extra=1.0)
    log = _adapted(tmp_path, frame, others=others, columns={"speed_mps": {"source": "speed_mps"}})
    assert log.segments.has("extra", "ambient_temp_c") == (others == "keep")


def test_trip_and_vehicle_from_the_name_or_a_column(tmp_path):
    frame = FRAME.drop(columns="trip_id")
    adapter = {"trip_id": "(B\\d+_\\d+)", "vehicle_id": "(B\\d+)_"}
    log = read(tmp_path, frame, adapter, name="B12_7.csv")
    assert (log.trip_names, log.vehicle_names) == (("B12_7",), ("B12",))
    two = pd.concat([samples(30, trip="A"), samples(30, trip="B")]).rename(columns={"trip_id": "journey"})
    log = read(tmp_path, two, {"columns": {"trip_id": {"source": "journey"}}})
    assert log.trip_names == ("A", "B")
    log = read(tmp_path, pd.concat([samples(9, trip=t).assign(vehicle_id=v) for t, v in ("ax", "by", "cx")]))
    assert log.vehicle_names == ("x", "y")
    np.testing.assert_array_equal(log.segments.vehicle, np.repeat([0, 1, 0], 9))


def test_edges_are_trimmed(tmp_path):
    log = _adapted(tmp_path, FRAME, edge_trim_s=5.0)
    assert len(log) == len(FRAME) - 10
    assert log.segments.time_s[0] == 5.0
    assert log.ledger.count("trimmed") == 10


class TestCompanion:
    adapter = Adapter.from_dict(
        {
            "companion": {"suffix": ".grade.csv.gz", "on": "time_s"},
            "columns": {"grade_rad": {"source": "slope", "unit": "%"}},
        }
    )

    def files(self, folder, suffix=".grade.csv.gz"):
        frame = FRAME.drop(columns="trip_id")
        log = write(folder, frame, "a.csv")
        beside = write(folder, frame[["time_s"]].assign(slope=1.0).sample(frac=1, random_state=0), f"a{suffix}")
        return log, beside

    def test_is_joined_by_its_key_and_is_no_log(self, tmp_path):
        log, beside = self.files(tmp_path)
        alone = read_log(log, self.adapter)
        assert read_log([log, beside], self.adapter).fingerprint() == alone.fingerprint()
        assert read_log(tmp_path, self.adapter).fingerprint() == alone.fingerprint()
        np.testing.assert_allclose(alone.segments.channels["grade_rad"], np.arctan(0.01))
        with pytest.raises(InputError, match="companion"):
            read_log(beside, self.adapter)

    def test_missing(self, tmp_path):
        log, beside = self.files(tmp_path)
        beside.unlink()
        with pytest.raises(InputError, match=r"a\.grade\.csv\.gz is not beside it"):
            read_log(log, self.adapter)
        table = {"companion": {"suffix": ".grade.csv.gz", "on": "time_s", "optional": True}}
        columns = {"grade_rad": {"source": "slope", "unit": "%"}}
        found = read_log(log, Adapter.from_dict({**table, "columns": columns}))
        assert not found.segments.has("grade_rad")

    def test_key_missing_or_twice(self, tmp_path):
        log, beside = self.files(tmp_path)
        write(tmp_path, pd.DataFrame({"time": [1.0], "slope": [1.0]}), beside.name)
        with pytest.raises(InputError, match="'time_s' to join"):
            read_log(log, self.adapter)
        write(tmp_path, pd.DataFrame({"time_s": [1.0, 1.0], "slope": [1.0, 2.0]}), beside.name)
        with pytest.raises(InputError, match="appears twice"):
            read_log(log, self.adapter)


def test_adapter_from_toml(tmp_path):
    (tmp_path / "a.toml").write_text('edge_trim_s = 2\n[columns]\nspeed_kmh = "v"\n')
    log = read_log(write(tmp_path, FRAME.rename(columns={"speed_mps": "v"})), tmp_path / "a.toml")
    np.testing.assert_allclose(log.segments.distance_m, FRAME["speed_mps"][2:-2] / 3.6)


@pytest.mark.parametrize("kind", ["csv", "parquet", "mat", "time_value"])
def test_skeleton_is_an_adapter(tmp_path, kind):
    frame = FRAME.rename(columns={"speed_mps": "VehSpeed", "time_s": "Time", "battery_power_w": "Power"})
    if kind == "mat":
        path = tmp_path / "x.mat"
        scipy.io.savemat(path, {c: frame[c].to_numpy() for c in frame if c != "trip_id"})
    elif kind == "time_value":
        path = tmp_path / "x.mat"
        t = np.arange(50.0)
        scipy.io.savemat(path, {f"Run1_{n}_f": np.c_[t, t / 10] for n in ("VehSpeed", "Power")})
    else:
        path = write(tmp_path, frame, f"x.{kind}")
    text = write_adapter_skeleton(path)
    Adapter.from_dict(tomllib.loads(text))
    guessed = "\n".join(x[2:] if x.startswith("# ") and "# a guess" in x else x for x in text.splitlines())
    log = read_log(path, Adapter.from_dict(tomllib.loads(guessed)))
    assert log.default_target == "battery_power_kw"
    assert len(log.segments) in (len(frame), 50)


def test_targets(tmp_path):
    log = read(tmp_path, samples(60, dt=0.5))
    assert log.default_target == "battery_power_kw"
    np.testing.assert_allclose(log.target("battery_power_kw"), log.measured["battery_power_w"] / 1e3)
    np.testing.assert_allclose(log.target("energy_wh"), log.measured["battery_power_w"] * 0.5 / 3600)
    log = read(tmp_path, intervals(60).assign(motor_torque_nm=5.0))
    assert log.default_target == "energy_wh"
    np.testing.assert_allclose(
        log.target("battery_power_kw") * log.segments.duration_s / 3.6, log.target("energy_wh"), rtol=1e-12
    )
    assert (log.target("motor_torque_nm") == 5.0).all()
    log = read(tmp_path, intervals(60).drop(columns="energy_wh").assign(traction_force_n=1.0))
    assert log.default_target == "traction_force_n"
    assert "energy_wh" not in log.segments.channels


def test_select_keeps_ids(tmp_path):
    log = read(tmp_path, pd.concat([samples(20, trip=t) for t in "abc"]))
    part = log.select([2, 0])
    assert part.trip_names == log.trip_names
    np.testing.assert_array_equal(part.segments.trip, np.repeat([0, 2], 20))
    assert len(part.measured["battery_power_w"]) == len(part) == 40
    assert log.trip_id("c") == 2


def test_columns_for_the_report(tmp_path):
    frame = FRAME.rename(columns={"speed_mps": "speed_kmh"})
    found = {c.source: (c.unit, c.name) for c in read(tmp_path, frame).columns}
    assert found["speed_kmh"] == ("kmh", "speed_mps")
    buffer = io.StringIO()
    print(*found, file=buffer)
    assert "trip_id" not in buffer.getvalue()


def test_of_a_folder_files_whose_name_is_no_trips_are_left_out_and_said(tmp_path):
    """A named file is never left out: its name is at fault."""
    adapter = Adapter.from_dict({"trip_id": r"(B\d+)"})
    frame = FRAME.drop(columns="trip_id")
    for name in ("B1.csv", "B2.csv"):
        write(tmp_path, frame, name)
    other = write(tmp_path, pd.DataFrame({"note": ["not a log"]}), "metaData.csv")
    log = read_log(tmp_path, adapter)
    assert log.trip_names == ("B1", "B2")
    assert any("metaData.csv" in line and "left out" in line for line in log.ledger.lines())
    with pytest.raises(InputError, match="does not match the file's name"):
        read_log(other, adapter)
    alone = tmp_path / "alone"
    alone.mkdir()
    write(alone, frame, "drive.csv")
    with pytest.raises(InputError, match="does not match the file's name"):
        read_log(alone, adapter)
