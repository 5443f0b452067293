"""Wrong units, wrong signs, charging: suspected by name, cut, counted; never on a log that is right."""

import hypothesis.strategies as st
import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings

from hdev_jax.inference.sheet import Sheet
from hdev_jax.logs import Adapter, log_from_frame
from hdev_jax.logs.checks import suspicions
from hdev_jax.problem import implausible, prepare

GRAVITY, DENSITY = 9.80665, 1.225
CAR = {"mass": 1800.0, "c_rr": 0.011, "cda": 0.62, "efficiency": 0.88, "auxiliary": 600.0}
TRUCK = {"mass": 26000.0, "c_rr": 0.0065, "cda": 5.2, "efficiency": 0.9, "auxiliary": 3000.0}


def drive(vehicle: dict[str, float], seed: int, minutes: int = 15, hills: bool = True) -> pd.DataFrame:
    """Stop and go, country road and motorway at 1 Hz, and the power of a vehicle by the equation of motion."""
    rng = np.random.default_rng(seed)
    n = 60 * minutes
    wanted = np.repeat(rng.choice([0.0, 8.0, 14.0, 22.0, 30.0], n // 60 + 1), 60)[:n] * (vehicle["mass"] < 5e3 or 0.75)
    v = np.zeros(n)
    limit = 1.5 if vehicle["mass"] < 5e3 else 0.6
    for i in range(1, n):
        v[i] = max(v[i - 1] + np.clip(0.3 * (wanted[i] - v[i - 1]) + rng.normal(0, 0.1), -limit, limit), 0.0)
    v[v < 0.05] = 0.0
    a = np.gradient(v)
    grade = 0.025 * np.sin(np.cumsum(v) / 400.0) if hills else np.zeros(n)
    m = vehicle["mass"]
    force = m * a + m * GRAVITY * (np.sin(grade) + vehicle["c_rr"] * (v > 0)) + 0.5 * DENSITY * vehicle["cda"] * v**2
    wheel = force * v
    power = np.where(wheel > 0, wheel / vehicle["efficiency"], wheel * vehicle["efficiency"]) + vehicle["auxiliary"]
    power += rng.normal(0, 0.02 * np.std(power), n)
    frame = {"time_s": np.arange(n, dtype=float), "speed_mps": v, "battery_power_w": power}
    return pd.DataFrame(frame | ({"grade_tan": np.tan(grade)} if hills else {}))


def sheet(vehicle: dict[str, float]) -> Sheet:
    return Sheet(
        name="v",
        mass_kg=vehicle["mass"],
        road={"c_rr": (vehicle["c_rr"], 0.002), "cda_m2": (vehicle["cda"], 0.1 * vehicle["cda"])},
        driveline={"efficiency": (vehicle["efficiency"], 0.04)},
        battery={"auxiliary_w": (vehicle["auxiliary"], 500.0)},
    )


def found(frame: pd.DataFrame, vehicle: dict[str, float]) -> list[str]:
    return [s.what for s in implausible(prepare(log_from_frame(frame), sheet(vehicle), None))]


VEHICLES = st.sampled_from([CAR, TRUCK])


@settings(max_examples=50)
@given(VEHICLES, st.integers(0, 10**6), st.booleans(), st.floats(0.7, 1.4), st.floats(-0.3, 0.3))
def test_a_right_log_is_not_suspected_also_where_the_sheet_is_off(vehicle, seed, hills, laden, drag):
    """Another load and another drag are physics, to be found by the search."""
    off = vehicle | {"mass": vehicle["mass"] * laden, "cda": vehicle["cda"] * (1.0 + drag)}
    assert found(drive(off, seed, hills=hills), vehicle) == []


@settings(max_examples=15)
@given(VEHICLES, st.integers(0, 10**6), st.sampled_from(["mph as km/h", "km/h as mph"]), st.booleans())
def test_a_wrong_unit_of_speed_is_suspected(vehicle, seed, wrong, hills):
    frame = drive(vehicle, seed, hills=hills)
    mph = frame["speed_mps"] / 0.44704
    read = {"mph as km/h": ("speed_kmh", mph), "km/h as mph": ("speed_mph", frame["speed_mps"] * 3.6)}
    name, values = read[wrong]
    names = found(frame.drop(columns="speed_mps").assign(**{name: values}), vehicle)
    assert names in (["unit of speed_mps"], []), names
    if vehicle is CAR:  # a truck at twice its load looks the same where it hardly meets drag
        assert names == ["unit of speed_mps"]


SLOPES = {
    "per mille as per cent": ("grade_pct", 1000.0, "unit"),
    "per cent as per mille": ("grade_permille", 100.0, "unit"),
    "turned": ("grade_pct", -100.0, "sign"),
}


@settings(max_examples=15)
@given(VEHICLES, st.integers(0, 10**6), st.sampled_from(sorted(SLOPES)))
def test_a_wrong_unit_or_sign_of_slope_is_suspected(vehicle, seed, wrong):
    frame = drive(vehicle, seed)
    name, factor, what = SLOPES[wrong]
    frame[name] = factor * frame.pop("grade_tan")
    assert found(frame, vehicle) == [f"{what} of grade_rad"]


@settings(max_examples=15)
@given(VEHICLES, st.integers(0, 10**6), st.booleans(), st.booleans())
def test_a_turned_sign_of_power_or_current_is_suspected_and_mended(vehicle, seed, hills, amperes):
    frame = drive(vehicle, seed, hills=hills)
    frame["battery_power_w"] *= -1.0
    if amperes:
        frame = frame.assign(voltage_v=400.0, current_a=frame.pop("battery_power_w") / 400.0)
    (first,) = suspicions(log_from_frame(frame))
    assert first.what == "sign of battery_power_w"
    column, source = ("current_a", "current_a") if amperes else ("battery_power_w", "battery_power_w")
    turned = Adapter.from_dict({"columns": {column: {"source": source, "affine": [0, -1]}}})
    assert suspicions(log_from_frame(frame, adapter=turned)) == ()


@pytest.mark.parametrize(("factor", "what"), [(1.609344, "miles"), (1e-3, "metres and kilometres"), (3.6, "m/s")])
def test_a_distance_in_another_unit_than_the_speed(factor, what):
    frame = drive(CAR, 1).assign(distance_m=lambda f: f["speed_mps"] * factor)
    (one,) = suspicions(log_from_frame(frame))
    assert what in one.evidence


def test_a_counter_of_energy_is_suspected_and_its_key_reads_it():
    frame = drive(CAR, 3)
    added = frame.pop("battery_power_w") / 3600.0
    frame["energy_wh"] = 500.0 + np.cumsum(added)
    (one,) = suspicions(log_from_frame(frame))
    assert one.what == "energy_wh"
    assert "counter = true" in one.mend
    rules = {"energy_wh": {"source": "energy_wh", "counter": True}}
    log = log_from_frame(frame, adapter=Adapter.from_dict({"columns": rules}))
    assert suspicions(log) == ()
    np.testing.assert_allclose(np.sum(log.measured["energy_wh"]), added.sum(), rtol=0.01)


@pytest.mark.parametrize("factor", [1e-3, 1e3])
def test_a_power_in_another_unit(factor):
    frame = drive(CAR, 1)
    frame["battery_power_w"] *= factor if factor < 1 else 20.0
    frame = frame if factor < 1 else frame.assign(battery_power_w=frame["battery_power_w"] * 10.0)
    (one,) = suspicions(log_from_frame(frame))
    assert one.what == "unit of battery_power_w"


@settings(max_examples=15)
@given(st.integers(0, 10**6), st.integers(70, 600), st.floats(11.0, 150.0), st.booleans())
def test_charging_at_standstill_is_cut_and_counted_wherever_it_stands(seed, seconds, kilowatts, keep):
    frame = drive(CAR, seed, minutes=10)
    frame.loc[len(frame) - 20 :, ["speed_mps", "battery_power_w"]] = [0.0, 600.0]
    charge = pd.DataFrame(
        {"speed_mps": 0.0, "battery_power_w": -1e3 * kilowatts, "grade_tan": 0.0}, index=range(seconds)
    )
    both = pd.concat([frame, charge, frame], ignore_index=True).assign(time_s=lambda f: np.arange(len(f), dtype=float))
    adapter = Adapter.from_dict({"charging": "keep"}) if keep else None
    log = log_from_frame(both, adapter=adapter)
    (entry,) = [e for e in log.ledger if "charging at standstill" in e.reason]
    assert entry.count == seconds
    assert len(log) == len(both) - (0 if keep else seconds)
    assert entry.kind == ("noted" if keep else "dropped")


def test_noise_while_standing_is_no_charging():
    frame = pd.DataFrame(
        {"duration_s": 70.0, "distance_m": 0.0, "speed_start_mps": 0.0, "speed_end_mps": 0.0, "energy_wh": -40.0},
        index=range(3),
    )
    drives = frame.assign(distance_m=900.0, speed_start_mps=12.0, speed_end_mps=13.0, energy_wh=200.0)
    both = pd.concat([part for _ in range(9) for part in (drives, frame.iloc[:1])], ignore_index=True)
    assert len(log_from_frame(both)) == len(both)


def test_an_interval_that_stands_at_both_ends_and_drives_between_them_is_no_charging():
    frame = pd.DataFrame(
        {"duration_s": 70.0, "distance_m": 100.0, "speed_start_mps": 0.0, "speed_end_mps": 0.0, "energy_wh": -40.0},
        index=range(20),
    )
    assert len(log_from_frame(frame)) == 20


@pytest.mark.parametrize("name", ["battery_power_w", "traction_force_n"])
def test_a_target_that_never_changes_is_said_with_what_to_do(name):
    frame = drive(CAR, 4).rename(columns={"battery_power_w": name}).assign(**{name: 0.0})
    (one,) = suspicions(log_from_frame(frame))
    assert one.what == "constant target 0"
    assert "hdev roadload --coastdown" in one.mend
    (one,) = suspicions(log_from_frame(frame.assign(**{name: 700.0})))
    assert one.what == "constant target"
    assert f"in all {len(frame)} rows" in one.evidence


def test_state_of_charge_times_capacity_is_a_counter_of_energy():
    """64 kWh, in steps of 0.1 %: the sum is right to a step, and rows without a step are no counter themselves."""
    frame = drive(CAR, 6)
    drawn = np.cumsum(frame.pop("battery_power_w")) / 3600.0
    frame["SOC"] = np.round(80.0 - drawn / 640.0, 1)
    rule = {"energy_wh": {"source": "SOC", "affine": [0, -640], "counter": True}}
    log = log_from_frame(frame, adapter=Adapter.from_dict({"columns": rule}))
    assert abs(float(np.sum(log.target("energy_wh"))) - float(drawn.iloc[-1])) < 128.0
    assert suspicions(log) == ()
