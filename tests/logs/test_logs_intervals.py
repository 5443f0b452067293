"""Samples to intervals against a plain loop, slope from altitude, units, and what must hold for any log."""

import hypothesis.strategies as st
import numpy as np
import pandas as pd
import pytest
from hypothesis import HealthCheck, given, settings
from logs_helpers import intervals, read, samples, write

from hdev_jax.errors import InputError
from hdev_jax.logs import read_log
from hdev_jax.logs.intervals import trip_median
from hdev_jax.logs.repair import fill_forward, fill_linear, fill_nearest
from hdev_jax.segments import trip_slices
from hdev_jax.units import COLUMNS, accepted, conversion, parse_column, to_si


def plain_loop(t, v):
    """The contract's words, one sample after the other: `(start, duration, v_start, v_end)`."""
    out, n = [], len(t)

    def slope(rows, at):  # of the parabola of least squares through up to five samples
        return np.polynomial.Polynomial.fit(t[rows], v[rows], min(len(t[rows]) - 1, 2)).deriv()(at)

    for i in range(n):
        back = (t[i] - t[i - 1]) / 2 if i > 0 else (t[1] - t[0]) / 2
        ahead = (t[i + 1] - t[i]) / 2 if i < n - 1 else (t[i] - t[i - 1]) / 2
        v0 = (v[i - 1] + v[i]) / 2 if i > 0 else None
        v1 = (v[i] + v[i + 1]) / 2 if i < n - 1 else None
        v0 = max(v1 - slope(slice(0, 5), t[0]) * (back + ahead), 0.0) if v0 is None else v0
        v1 = max(v0 + slope(slice(max(n - 5, 0), n), t[-1]) * (back + ahead), 0.0) if v1 is None else v1
        out.append((t[i] - back + (t[1] - t[0]) / 2 - t[0], back + ahead, v0, v1))
    return np.array(out).T


def test_samples_stand_for_half_a_step_to_both_sides(tmp_path):
    rng = np.random.default_rng(3)
    parts = [samples(40, trip="A"), samples(2, trip="B"), samples(25, trip="C")]
    for p in parts:
        p["time_s"] = 7.0 + np.cumsum(rng.uniform(0.5, 1.5, len(p)))
    frame = pd.concat(parts)
    s = (log := read(tmp_path, frame)).segments
    assert log.sampled
    for (_, rows), p in zip(trip_slices(s.trip), parts, strict=True):
        t, v = p["time_s"].to_numpy(), p["speed_mps"].to_numpy()
        got = (s.time_s[rows], s.duration_s[rows], s.speed_start_mps[rows], s.speed_end_mps[rows])
        np.testing.assert_allclose(got, plain_loop(t, v), rtol=1e-9, atol=1e-9)
        np.testing.assert_array_equal(s.distance_m[rows], v * s.duration_s[rows])
    np.testing.assert_array_equal(log.measured["battery_power_w"], frame["battery_power_w"])
    np.testing.assert_array_equal(s.channels["ambient_temp_c"], frame["ambient_temp_c"])


@pytest.mark.parametrize(
    "drop",
    [
        ["time_s"],
        ["duration_s"],
        ["distance_m"],
        ["time_s", "distance_m"],
        ["duration_s", "distance_m"],
    ],
)
def test_every_way_to_give_an_interval(tmp_path, drop):
    whole, log = read(tmp_path, intervals()), read(tmp_path, intervals().drop(columns=drop))
    assert not log.sampled
    last = slice(None, -1) if "duration_s" in drop else slice(None)  # the last row's length is not in its time
    for name in ("time_s", "duration_s", "distance_m", "speed_start_mps", "speed_end_mps"):
        np.testing.assert_allclose(getattr(log.segments, name)[last], getattr(whole.segments, name)[last], rtol=1e-9)
    if "duration_s" in drop:
        assert log.segments.duration_s[-1] == pytest.approx(np.median(np.diff(whole.segments.time_s)))


@pytest.mark.parametrize("drop", [["time_s"], []])
def test_samples_with_a_duration(tmp_path, drop):
    frame = samples(50, dt=0.5).assign(duration_s=0.5)
    log, plain = read(tmp_path, frame.drop(columns=drop)), read(tmp_path, samples(50, dt=0.5))
    np.testing.assert_allclose(log.segments.time_s, plain.segments.time_s)
    np.testing.assert_allclose(log.segments.distance_m, plain.segments.distance_m)
    np.testing.assert_array_equal(log.segments.speed_end_mps, plain.segments.speed_end_mps)


def test_mean_speed_of_an_interval_gives_its_distance(tmp_path):
    frame = intervals().drop(columns="distance_m").assign(speed_mps=lambda f: 100.0 / f["duration_s"])
    log = read(tmp_path, frame)
    assert not log.sampled
    np.testing.assert_allclose(log.segments.distance_m, 100.0)


@pytest.mark.parametrize("dt", [1.0, 10.0])
def test_slope_from_altitude(tmp_path, dt):
    frame = samples(600, dt=dt)
    frame.loc[200:260, "speed_mps"] = 0.0
    s = np.cumsum(frame["speed_mps"] * dt) - frame["speed_mps"] * dt / 2
    frame["altitude_m"] = 400.0 + 20.0 * np.sin(s / 300.0)
    log = read(tmp_path, frame)
    true = np.arctan(20.0 / 300.0 * np.cos(s / 300.0))
    if dt == 1.0:
        assert np.abs(log.segments.channels["grade_rad"] - true)[20:-20].max() < 0.003
    assert np.isfinite(log.segments.channels["grade_rad"]).all()
    assert any(e.kind == "derived" and e.column == "grade_rad" for e in log.ledger)


@settings(max_examples=40)
@given(st.lists(st.tuples(st.integers(0, 3), st.none() | st.integers(-5, 5)), min_size=1, max_size=40))
def test_fills_against_a_plain_loop(cells):
    cells = sorted(cells, key=lambda c: c[0])
    trip = np.array([c[0] for c in cells])
    x = np.array([np.nan if c[1] is None else float(c[1]) for c in cells])
    forward, nearest, linear = fill_forward(x, trip), fill_nearest(x, trip), fill_linear(x, trip)
    for _, rows in trip_slices(trip):
        part, ok = x[rows], np.flatnonzero(~np.isnan(x[rows]))
        for i in range(len(part)):
            before = [k for k in ok if k <= i]
            np.testing.assert_array_equal(forward[rows][i], part[before[-1]] if before else np.nan)
            best = min(ok, key=lambda k: (abs(k - i), k), default=None)
            np.testing.assert_array_equal(nearest[rows][i], np.nan if best is None else part[best])
        expected = np.interp(np.arange(len(part)), ok, part[ok]) if len(ok) else np.full(len(part), np.nan)
        np.testing.assert_allclose(linear[rows], expected, atol=1e-12)
    medians = trip_median(x, trip)
    for _, rows in trip_slices(trip):
        values = x[rows][~np.isnan(x[rows])]
        np.testing.assert_allclose(medians[rows], np.median(values) if len(values) else np.nan)


@settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.integers(2, 12), min_size=1, max_size=5), st.integers(0, 2**16))
def test_splitting_a_log_in_files_changes_nothing(tmp_path_factory, sizes, seed):
    folder = tmp_path_factory.mktemp("split")
    parts = [samples(n, seed=seed + i, trip=f"T{i}") for i, n in enumerate(sizes)]
    whole = read_log(write(folder, pd.concat(parts), "whole.csv"))
    files = [write(folder, p, f"{i}.csv.gz") for i, p in enumerate(parts)]
    assert read_log(files).fingerprint() == whole.fingerprint()


BACK = {
    "speed_kmh": 3.6,
    "battery_power_kw": 1e-3,
    "energy_kwh": 1e-3,
    "energy_j": 3600.0,
    "motor_speed_rpm": 30.0 / np.pi,
    "mass_t": 1e-3,
    "distance_km": 1e-3,
    "time_ms": 1e3,
    "brake_pressure_bar": 1e-5,
    "heading_deg": 180.0 / np.pi,
    "soc_pct": 100.0,
    "accel_g": 1.0 / 9.80665,
    "voltage_kv": 1e-3,
    "traction_force_kn": 1e-3,
    "curvature_1pkm": 1e3,
}


@given(st.sampled_from(sorted(BACK)), st.floats(-1e6, 1e6))
def test_suffixes_round_trip(header, x):
    np.testing.assert_allclose(to_si(x * BACK[header], header), x, rtol=1e-11, atol=1e-12)


@given(st.floats(-80.0, 80.0))
def test_temperature_and_slope(x):
    np.testing.assert_allclose(to_si(x + 273.15, "ambient_temp_k"), x, atol=1e-9)
    np.testing.assert_allclose(to_si(1.8 * x + 32.0, "battery_temp_f"), x, atol=1e-9)
    np.testing.assert_allclose(np.tan(to_si(x, "grade_pct")), x / 100.0, atol=1e-12)
    np.testing.assert_allclose(to_si(x / 100.0, "grade_tan"), to_si(x, "grade_pct"), atol=1e-15)


@pytest.mark.parametrize("name", sorted(COLUMNS))
def test_the_contracts_own_names_are_not_touched(name):
    parsed = parse_column(name)
    assert (parsed.name, parsed.known) == (name, True)
    np.testing.assert_array_equal(parsed.conversion.call(np.array([0.1, 7.0])), [0.1, 7.0])
    assert all(parse_column(other).name == name for other in accepted(COLUMNS[name]))


@pytest.mark.parametrize(
    ("name", "unit", "value", "expected"),
    [
        ("speed_mps", "km/h", 36.0, 10.0),
        ("speed_mps", "mph", 1.0, 0.44704),
        ("motor_speed_radps", "rpm", 60.0, 2 * np.pi),
        ("motor_speed_radps", "1/min", 60.0, 2 * np.pi),
        ("motor_torque_nm", "Nm", 5.0, 5.0),
        ("ambient_temp_c", "K", 273.15, 0.0),
        ("ambient_temp_c", "°C", 5.0, 5.0),
        ("grade_rad", "tan", 1.0, np.pi / 4),
        ("grade_rad", "%", 100.0, np.pi / 4),
        ("grade_rad", "deg", 45.0, np.pi / 4),
        ("battery_power_w", "kW", 1.0, 1000.0),
        ("energy_wh", "kWh", 1.0, 1000.0),
        ("soc", "%", 50.0, 0.5),
        ("steering_angle_rad", "deg", 180.0, np.pi),
        ("wheel_speed_mps", "km/h", 36.0, 10.0),
        ("accel_mps2", "m/s^2", 2.0, 2.0),
    ],
)
def test_units_of_adapters(name, unit, value, expected):
    assert conversion(name, unit, where="a.toml").call(np.asarray(value)) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize(("name", "unit"), [("speed_mps", "kg"), ("speed_mps", "blub"), ("foo", "km"), ("gear", "m")])
def test_wrong_units_of_adapters(name, unit):
    with pytest.raises(InputError, match=r"a\.toml"):
        conversion(name, unit, where="a.toml")


@pytest.mark.parametrize(
    "header", ["speed_limit", "time_unix", "gear_ratio", "speed", "current_lane", "speed_limit_mps"]
)
def test_other_peoples_columns_are_kept(header):
    assert not parse_column(header).known


@pytest.mark.parametrize(
    "header", ["speed_furlong", "battery_power_nm", "mass_n", "speed_mpss", "ambient_temp_celcius"]
)
def test_wrong_suffixes(header):
    with pytest.raises(InputError, match=f"'{header}'.*accepted"):
        parse_column(header)
