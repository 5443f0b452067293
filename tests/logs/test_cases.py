"""The cases beside the checkout: small logs in the layouts that people have, each with what is right for it."""

import os
from pathlib import Path

import numpy as np
import pytest

import hdev_jax
from hdev_jax.errors import InputError
from hdev_jax.inference.sheet import read_sheet
from hdev_jax.logs import Adapter, Log, read_log
from hdev_jax.logs.checks import suspicions
from hdev_jax.problem import implausible, prepare

CASES = Path(os.environ.get("HDEV_CASES") or Path(__file__).parents[2].parent / "shared" / "cases" / "logs")
pytestmark = pytest.mark.skipif(not CASES.is_dir(), reason=f"no cases in {CASES} (HDEV_CASES)")

DRIVE = (11.990, 1.3607)  # km and kWh of the one drive of text/, in whatever way it is written


def read(name: str, adapter: str | dict | None = None) -> Log:
    rules = Adapter.from_dict(adapter) if isinstance(adapter, dict) else adapter and CASES / adapter
    return read_log(CASES / name, rules)


def totals(log: Log) -> tuple[float, float]:
    return float(np.sum(log.segments.distance_m)) / 1e3, float(np.sum(log.target("energy_wh"))) / 1e3


def said(log: Log) -> str:
    return "\n".join(log.ledger.lines())


@pytest.mark.parametrize(
    ("name", "adapter", "noted"),
    [
        ("comments", None, "the header is line 3"),
        ("epoch_ms", "text/a_ms.toml", ""),
        ("epoch_ms", None, "since 1970"),
        ("iso_dst", None, ""),
        ("iso_dst_naive", None, "769 rows of timestamp"),
        ("iso_dst_naive", {"time_zone": "Europe/Zurich"}, ""),
        ("iso_minutes", {"repeated_stamps": "spread"}, "spread over the time to the next"),
        ("preamble", None, "the header is line 5"),
        ("quoted", None, ""),
        ("semi_cp1252", "text/a_de.toml", ""),
        ("semi_thousands", None, "'.' between thousands taken out"),
        ("semi_thousands_int", {"thousands": "."}, ""),
        ("serial", "text/a_serial.toml", ""),
        ("time_epoch_s", None, "since 1970"),
        ("units_row", {"columns": {"battery_power_w": "power"}}, "a row of units"),
        ("us_date", None, "the month first"),
    ],
)
def test_one_drive_in_every_way_to_write_it(name, adapter, noted):
    log = read(f"text/{name}.csv", adapter)
    assert totals(log) == pytest.approx(DRIVE, rel=2e-4)
    assert len(log) == 1368
    assert noted in said(log)


def test_a_power_that_no_name_says_is_of_the_battery_is_asked_about():
    log = read("text/units_row.csv")
    assert float(np.sum(log.segments.distance_m)) == pytest.approx(1e3 * DRIVE[0], rel=2e-4)
    with pytest.raises(InputError, match="whether 'power' is battery_power_w"):
        _ = log.default_target


def test_decimals_that_begin_late():
    """Of this file the first minute is zeros: its own sums, by hand."""
    rows = [line.replace(",", ".").split(";") for line in (CASES / "text" / "semi_late.csv").read_text().split()[1:]]
    speed, power = np.array(rows, float)[:, 1:].T
    assert totals(read("text/semi_late.csv")) == pytest.approx((speed.sum() / 3600.0, power.sum() / 3600.0))


@pytest.mark.parametrize(
    ("name", "parts"),
    [
        ("comma_comma", ("line 2 has 5 fields, the header 3", "quotes")),
        ("thousands", ("line 42 has 5 fields, the header 4", "quotes")),
        ("thousands_mid", ("line 303 has 5 fields, the header 4 (9 such lines)", "quotes")),
        ("semi_thousands_int", ("line 22, column 'battery_power_w': 4.272", 'thousands = "."')),
        ("iso_minutes", ("the same time_s", 'repeated_stamps = "spread"')),
    ],
)
def test_what_cannot_be_read_says_what_to_do(name, parts):
    with pytest.raises(InputError) as caught:
        read(f"text/{name}.csv")
    assert all(part in str(caught.value) for part in parts), str(caught.value)


def test_two_clocks_and_a_repeated_header():
    log = read("two_clocks_and_repeated_header.csv")
    km, kwh = totals(log)
    assert (km, kwh) == pytest.approx(DRIVE, rel=5e-3)  # 14 of 1368 speeds are missing; current in tenths of an ampere
    assert "noted 2 rows (two_clocks_and_repeated_header.csv): the header once more" in said(log)
    assert "voltage_v times current_a" in said(log)
    assert "preset" in said(log)


def test_a_row_a_value():
    log = read("long_seconds_name_value.csv")
    assert len(log) == 208
    assert log.default_target == "battery_power_kw"
    assert {"ambient_temp_c"} <= set(log.segments.channels)
    own = {"columns": {"speed_mps": "Vehicle speed", "battery_power_w": "HV battery power"}}
    named = {"layout": "long", "long": {"time": "SECONDS", "name": "PID", "value": "VALUE", "unit": "UNITS"}}
    by_speed = read(
        "long_seconds_name_value.csv", own | named
    )  # at the times of the speed, power where it was measured
    assert len(by_speed) <= 208
    assert totals(by_speed) == pytest.approx(totals(log), rel=0.01)


@pytest.mark.parametrize("adapter", [None, "trip_numbers_adapter.toml"])
def test_trip_numbers_that_begin_anew_for_each_vehicle(adapter):
    log = read("trip_numbers_per_vehicle.csv", adapter)
    assert log.trip_names == ("455-700", "541-700", "455-701", "541-701", "455-702")
    assert log.vehicle_names == ("455", "541")
    product = log.segments.channels["voltage_v"] * log.segments.channels["current_a"]
    np.testing.assert_array_equal(log.measured["battery_power_w"], product)
    assert totals(log)[1] > 0
    assert "725 rows" in said(log), "the trips of a car without a battery are left out, and counted"


@pytest.mark.parametrize("name", ["intervals", "log", "nonoise"])
def test_a_coast_down_from_samples_as_from_intervals(name):
    found = hdev_jax.calibrate(CASES / f"coastdown_{name}.csv", CASES / "coastdown_sheet.toml").coefficients
    for path, true, near in (("road.c_rr", 0.012, 2e-3), ("road.cda_m2", 0.65, 5e-4)):
        p = found.loc[path]
        assert abs(p["value"] - true) < max(2.0 * p["sd"], near * true if name == "nonoise" else 0.0), (path, p)


def problem(name: str, adapter: str | None, sheet: str):
    return prepare(read(name, adapter), read_sheet(CASES / sheet), None)


@pytest.mark.parametrize(
    ("name", "adapter", "sheet", "what", "mend"),
    [
        ("slope_millis_as_pct.csv", None, "slope_sheet.toml", "unit of grade_rad", 'unit = "permille"'),
        ("speed_mph_as_kmh.csv.gz", "speed_adapter.toml", "speed_sheet.toml", "unit of speed_mps", 'unit = "mph"'),
        ("power_discharge_negative.csv.gz", "speed_adapter.toml", "speed_sheet.toml", "sign of", "affine = [0, -1]"),
    ],
)
def test_a_wrong_unit_or_sign_is_suspected_by_name(name, adapter, sheet, what, mend):
    (found,) = implausible(problem(name, adapter, sheet))
    assert found.what.startswith(what)
    assert mend in found.mend


@pytest.mark.parametrize(
    ("name", "adapter", "sheet"),
    [
        ("slope_right.csv", None, "slope_sheet.toml"),
        ("speed_right.csv.gz", "speed_adapter.toml", "speed_sheet.toml"),
        ("charging_inside_a_drive.csv.gz", "charging_adapter.toml", "charging_sheet.toml"),
    ],
)
def test_a_right_log_is_not_suspected(name, adapter, sheet):
    assert implausible(problem(name, adapter, sheet)) == ()


def test_what_mends_the_suspected_unit_mends_it():
    rules = {"trip_id": "drive_id", "time_s": "date", "battery_power_w": {"source": "power", "unit": "kW"}}
    speed = {"speed_mps": {"source": "speed", "unit": "mph"}}
    log = read("speed_mph_as_kmh.csv.gz", {"columns": rules | speed})
    assert implausible(prepare(log, read_sheet(CASES / "speed_sheet.toml"), None)) == ()
    turned = {"battery_power_w": {"source": "power", "affine": [0, -1], "unit": "kW"}}
    speed = {"speed_mps": {"source": "speed", "unit": "km/h"}}
    log = read("power_discharge_negative.csv.gz", {"columns": rules | speed | turned})
    assert suspicions(log) == ()
    assert totals(log) == pytest.approx(totals(read("speed_right.csv.gz", "speed_adapter.toml")))


def test_charging_inside_a_drive_is_cut_and_counted():
    log = read("charging_inside_a_drive.csv.gz", "charging_adapter.toml")
    right = read("speed_right.csv.gz", "speed_adapter.toml")
    assert totals(log)[0] == pytest.approx(totals(right)[0], rel=1e-4)
    assert totals(log)[1] == pytest.approx(totals(right)[1], rel=0.02)
    assert "dropped 1800 rows: charging at standstill, 30 min" in said(log)
