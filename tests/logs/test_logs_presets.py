"""Presets, expressions, tables with a row a value, the skeleton: what an adapter may say, and what needs none."""

import hypothesis.strategies as st
import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from logs_helpers import samples, write

from hdev_jax.errors import InputError
from hdev_jax.logs import Adapter, log_from_frame, read_log, write_adapter_skeleton
from hdev_jax.logs.expression import check_expression
from hdev_jax.logs.guesses import guess
from hdev_jax.logs.presets import PRESETS

BASE = samples(60).drop(columns="trip_id")
V, P = BASE["speed_mps"].to_numpy(), BASE["battery_power_w"].to_numpy()
STAMP = pd.Timestamp("2026-03-04 08:00:00") + pd.to_timedelta(BASE["time_s"], unit="s")


def columns(**given) -> pd.DataFrame:
    return pd.DataFrame({k.replace("__", " "): v for k, v in given.items()})


def _long() -> pd.DataFrame:
    channels = {
        "Vehicle speed": (V * 3.6, "km/h"),
        "HV battery power": (P / 1e3, "kW"),
        "Ambient temperature": (V, "℃"),
    }
    rows = [(30000.0 + i, n, x[i], u) for i in range(60) for n, (x, u) in channels.items()]
    return pd.DataFrame(rows, columns=["SECONDS", "PID", "VALUE", "UNITS"])


def _scanned() -> pd.DataFrame:
    """A row for each message, with the values of that message alone."""
    t = 1000 * BASE["time_s"].to_numpy()
    power = pd.DataFrame({"Time": t, "Battery voltage": 380.0, "Battery current": P / 380.0, "Battery power": P / 1e3})
    speed = pd.DataFrame({"Time": np.r_[t, t[:-1] + 500.0], "Speed": 3.6 * np.r_[V, 0.5 * (V[1:] + V[:-1])]})
    other = pd.DataFrame({"Time": t[::7], "Outside temp": 12.5})
    return pd.concat([power, speed, other]).sort_values("Time", kind="stable").astype({"Time": int})


# the same drive as each tool writes it; what it does not write of the power is None
WRITTEN = {
    "carscanner": (_long(), {"sep": ";", "quoting": 1}, P),
    "fastsim": (columns(cycSecs=BASE["time_s"], cycMps=V, cycGrade=0.0), {}, None),
    "leafspy": (
        pd.DataFrame(
            {"Date/Time": STAMP.dt.strftime("%m/%d/%Y %H:%M:%S"), "Lat": "51 0.0", "Elv": 100, "Speed": V * 3.6}
            | {"Gids": 250, "Pack Volts": 360.0, "Pack Amps": P / 360.0}
        ),
        {},
        P,
    ),
    "scanmytesla": (_scanned(), {}, P),
    "teslamate": (columns(drive_id=7, date=STAMP, speed=V * 3.6, power=P / 1e3, battery_level=70), {}, P),
    "torque": (
        pd.DataFrame(
            {"GPS Time": STAMP.dt.strftime("%a %b %d %H:%M:%S GMT+01:00 %Y")}
            | {" Device Time": STAMP.dt.strftime("%d-%b-%Y %H:%M:%S.%f"), " Longitude": 8.5, " Altitude": 400.0}
            | {"Speed (OBD)(km/h)": V * 3.6, "HV Battery Voltage(V)": 350.0, "HV Battery Current(A)": P / 350.0}
        ),
        {},
        P,
    ),
    "vecto": (
        pd.DataFrame({"time [s]": BASE["time_s"], "dt [s]": 1.0, "v_act [km/h]": V * 3.6, "grad [%]": 1.0}),
        {},
        None,
    ),
    "ved": (
        pd.DataFrame(
            {"DayNum": 2.5, "VehId": 455, "Trip": 700, "Timestamp(ms)": 1000 * BASE["time_s"].astype(int)}
            | {"Vehicle Speed[km/h]": V * 3.6, "HV Battery Current[A]": -P / 380.0, "HV Battery Voltage[V]": 380.0}
        ),
        {},
        P,
    ),
}  # fmt: skip


NO_TABLES = {"fms", "sumo"}  # recordings and XML: tests of their own


def test_every_preset_has_a_file():
    assert set(WRITTEN) | NO_TABLES == set(PRESETS)


@pytest.mark.parametrize("name", sorted(WRITTEN))
def test_a_preset_is_recognised_by_its_header_and_said(tmp_path, name):
    frame, options, power = WRITTEN[name]
    path = write(tmp_path, frame, "x.csv", **options)
    log = read_log(path)
    np.testing.assert_allclose(log.segments.distance_m, V * log.segments.duration_s, rtol=1e-9)
    assert any("preset of that name" in e.reason and name in e.reason for e in log.ledger)
    if power is None:
        assert log.measured == {}
    else:
        np.testing.assert_allclose(log.measured["battery_power_w"], power, rtol=1e-9)
    assert read_log(path, name).fingerprint() == log.fingerprint(), "named in the place of an adapter"
    (tmp_path / "a.toml").write_text(f'preset = "{name}"\n')
    assert read_log(path, tmp_path / "a.toml").fingerprint() == log.fingerprint()


def test_rules_of_an_adapter_go_before_those_of_its_preset(tmp_path):
    frame = WRITTEN["leafspy"][0].assign(Speed=V / 0.44704)
    (tmp_path / "a.toml").write_text('preset = "leafspy"\n[columns]\nspeed_mph = "Speed"\n')
    log = read_log(write(tmp_path, frame), tmp_path / "a.toml")
    np.testing.assert_allclose(log.segments.distance_m, V)
    (tmp_path / "b.toml").write_text('preset = "leafspie"\n')
    with pytest.raises(InputError, match="'leafspy'"):
        read_log(tmp_path / "log.csv", tmp_path / "b.toml")


def made(frame: pd.DataFrame, **rules):
    return log_from_frame(frame, adapter=Adapter.from_dict({"columns": rules}))


def test_expressions_know_their_units():
    frame = BASE.drop(columns="battery_power_w").rename(columns={"speed_mps": "v"})
    frame = frame.assign(volts=0.4, **{"HV amps [A]": P / 400.0, "aux [kW]": 0.5})
    rules = {"speed_mps": "v", "voltage_v": {"source": "volts", "unit": "kV"}}
    log = made(frame, **rules, battery_power_w={"expr": "voltage_v * 'HV amps [A]' + 'aux [kW]'"})
    np.testing.assert_allclose(log.measured["battery_power_w"], P + 500.0)
    log = made(frame, **rules, battery_power_w={"expr": "-(volts * 'HV amps [A]')", "unit": "kW"})
    np.testing.assert_allclose(log.measured["battery_power_w"], -P)


@pytest.mark.parametrize(
    ("expr", "part"),
    [
        ("voltage_v + 'HV amps [A]'", "do not go together"),
        ("voltage_v * voltage_v", "its unit is V², watt is expected"),
        ("volts * 'HV amps [A]'", "'volts' says no unit"),
        ("voltage_v * amps", "'amps'"),
    ],
)
def test_expressions_whose_units_do_not_fit(expr, part):
    frame = BASE.drop(columns="battery_power_w").assign(volts=0.4, **{"HV amps [A]": 1.0})
    rules = {"voltage_v": {"source": "volts", "unit": "kV"}, "battery_power_w": {"expr": expr}}
    with pytest.raises(InputError) as caught:
        log = made(frame, **rules)
        raise InputError("; ".join(log.ledger.lines()))  # an optional column that is absent is noted
    assert part in str(caught.value)


@given(
    st.sampled_from(
        [
            "__import__('os')",
            "a.b",
            "a[0]",
            "a ** 9",
            "f(a)",
            "a if b else c",
            "1 + 2",
            "a; b",
            "(",
            "lambda: a",
            "a @ b",
            "a < b",
            "[a]",
            "f'{a}'",
            "a := 1",
            "9" * 500,
        ]
    )
)
def test_expressions_are_never_run_as_code(text):
    with pytest.raises(InputError, match=r"a\.toml"):
        check_expression("a.toml", text)


def test_rows_are_kept_where_a_channel_was_measured_and_what_is_filled_is_no_measurement():
    power = BASE["battery_power_w"].where(BASE.index % 3 == 0)
    frame = BASE.assign(battery_power_w=power, speed_mps=BASE["speed_mps"].where(BASE.index % 2 == 0))
    rules = {"speed_mps": {"source": "speed_mps", "fill": "linear"}}
    log = log_from_frame(frame, adapter=Adapter.from_dict({"rows": "battery_power_w", "columns": rules}))
    np.testing.assert_array_equal(log.measured["battery_power_w"], power.dropna())
    assert log.ledger.count("dropped", "battery_power_w") == 40
    filled = {"battery_power_w": {"source": "battery_power_w", "fill": "linear"}}
    also = log_from_frame(frame, adapter=Adapter.from_dict({"columns": rules | filled}))
    np.testing.assert_array_equal(also.measured["battery_power_w"], power.dropna())
    assert any("67% of the rows" in e.reason for e in also.ledger)


def test_fill_linear_is_linear_over_time():
    time = np.cumsum(np.tile([1.0, 3.0], 30))
    frame = BASE.assign(time_s=time, ambient_temp_c=np.where(np.arange(60) % 4 == 0, time, np.nan))
    log = made(frame, ambient_temp_c={"source": "ambient_temp_c", "fill": "linear"})
    np.testing.assert_allclose(log.segments.channels["ambient_temp_c"][:57], time[:57])


def test_of_alternatives_the_first_that_is_there():
    frame = BASE.rename(columns={"speed_mps": "v2"})
    log = made(frame, speed_mps={"source": "v0", "or": ["v1", "v2"]})
    np.testing.assert_array_equal(log.segments.distance_m, V)


@settings(max_examples=15)
@given(st.integers(2, 9), st.integers(0, 2**16))
def test_a_row_a_value_at_the_times_of_its_clock(every, seed):
    """Channels at rates of their own: what is not measured at the clock's times is linear between two values, never the
    power."""
    rng = np.random.default_rng(seed)
    t = np.arange(60.0)
    rows = [(t[i], "v", V[i], "m/s") for i in range(60)] + [(t[i], "P", P[i], "W") for i in range(0, 60, every)]
    rows += [(t[i], "T", 2.0 * t[i], "degC") for i in sorted({0, 59, *rng.choice(60, 30, replace=False).tolist()})]
    frame = pd.DataFrame(rows, columns=["t", "what", "x", "unit"]).sample(frac=1.0, random_state=seed)
    adapter = {"layout": "long", "long": {"time": "t", "name": "what", "value": "x", "unit": "unit", "clock": "v"}}
    rules = {"speed_mps": "v", "battery_power_w": "P", "ambient_temp_c": "T"}
    log = log_from_frame(frame, adapter=Adapter.from_dict(adapter | {"columns": rules}))
    np.testing.assert_array_equal(log.measured["battery_power_w"], P[::every])
    np.testing.assert_allclose(log.segments.channels["ambient_temp_c"], 2.0 * t[::every])
    assert log.ledger.count("dropped") == 60 - len(P[::every])


def test_a_channel_of_two_units_is_refused():
    rows = [(0.0, "v", 1.0, "m/s"), (1.0, "v", 1.0, "km/h")]
    frame = pd.DataFrame(rows, columns=["t", "what", "x", "unit"])
    adapter = {"layout": "long", "long": {"time": "t", "name": "what", "value": "x", "unit": "unit"}}
    with pytest.raises(InputError, match="'v' has values in m/s and in km/h"):
        log_from_frame(frame, adapter=Adapter.from_dict(adapter))


def test_the_line_of_the_header_can_be_told(tmp_path):
    text = "a,b,c\nthis,is,text\n" + BASE[["time_s", "speed_mps", "battery_power_w"]].to_csv(index=False)
    (tmp_path / "x.csv").write_text(text)
    with pytest.raises(InputError):
        read_log(tmp_path / "x.csv")
    assert len(read_log(tmp_path / "x.csv", Adapter.from_dict({"header_line": 3}))) == 60


@pytest.mark.parametrize(
    ("header", "name", "unit"),
    [
        ("Vehicle Speed [km/h]", "speed_mps", "km/h"),
        ("_time_ms", "time_s", "ms"),
        ("Timestamp(ms)", "time_s", "ms"),
        ("HV Battery Voltage(V)", "voltage_v", "V"),
        ("packCurrent_A", "current_a", "a"),
        ("Elevation", "altitude_m", "m"),
        ("Trip", "trip_id", None),
    ],
)
def test_guesses_read_units_and_whole_words(header, name, unit):
    found = guess(header)
    assert found is not None
    assert (found.name, found.unit) == (name, unit)


@pytest.mark.parametrize(
    "header", ["State of health", "Alternator", "Torque demand", "Odometer (km)", "speed [V]", "health"]
)
def test_no_guess_from_three_letters(header):
    assert guess(header) is None


def test_a_refused_file_gets_a_skeleton_that_says_why(tmp_path):
    (tmp_path / "x.csv").write_text("Zeit [s],Speed [km/h],Power [kW]\n1,2,3\n1,2,3,4\n")
    text = write_adapter_skeleton(tmp_path / "x.csv")
    assert "line 3 has 4 fields" in text
    assert '# battery_power_w = { source = "Power [kW]", unit = "kW" }' in text
    assert "# header_line" in text
