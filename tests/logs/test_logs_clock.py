"""Columns with rates of their own on one clock: means of powers, states as they were, lines between; every value is
accounted for."""

import hypothesis.strategies as st
import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings

from hdev_jax.errors import InputError
from hdev_jax.logs import Adapter, Log, log_from_frame

N = 120


def speed(t: np.ndarray) -> np.ndarray:
    return 15.0 + 5.0 * np.sin(t / 9.0)


def power(t: np.ndarray) -> np.ndarray:
    return 40.0 + 30.0 * np.sin(t / 5.0)


def uneven(rates: dict[str, float], seed: int = 0, jitter: float = 0.0) -> pd.DataFrame:
    """A row for each value of each channel, as loggers of a bus write them."""
    rng = np.random.default_rng(seed)
    parts = []
    for name, step in rates.items():
        t = np.arange(0.0, N, step)
        t = np.round(t + jitter * step * rng.uniform(-1.0, 1.0, len(t)), 4)
        x = {"speed_mps": speed, "battery_power_kw": power, "gear": lambda t: 1.0 + (t > N / 2)}[name](t)
        parts.append(pd.DataFrame({"time_s": t, name: x}))
    return pd.concat(parts).sort_values("time_s", kind="stable").reset_index(drop=True)


def read(frame: pd.DataFrame, **adapter) -> Log:
    return log_from_frame(frame, adapter=Adapter.from_dict(adapter))


@settings(max_examples=50)
@given(
    st.sampled_from([0.1, 0.25, 0.5, 1.0, 2.0]),
    st.sampled_from([0.1, 0.2, 1.0, 3.0]),
    st.sampled_from(["speed_mps", "battery_power_kw", 1.0]),
    st.sampled_from([0.0, 0.2]),
    st.integers(0, 99),
)
def test_energy_and_way_are_those_of_the_drive(v_step, p_step, clock, jitter, seed):
    """Whatever the rates: of the rows that are left, speed times duration is the way, power times it the energy."""
    log = read(uneven({"speed_mps": v_step, "battery_power_kw": p_step}, seed, jitter), clock=clock)
    t = np.asarray(log.segments.time_s) + 0.5 * np.asarray(log.segments.duration_s)
    d = np.asarray(log.segments.duration_s)
    np.testing.assert_allclose(np.sum(log.segments.distance_m), np.sum(speed(t) * d), rtol=0.01)
    np.testing.assert_allclose(np.sum(log.target("energy_wh")), np.sum(power(t) * d) / 3.6, rtol=0.03)
    assert np.sum(d) > 0.9 * N - 2.0 * max(v_step, p_step)
    moved = [e for e in log.ledger if e.column == "battery_power_kw" and e.kind == "derived"]
    assert all(e.reason.startswith(f"{len(np.arange(0.0, N, p_step))} values") for e in moved)
    assert moved or clock in ("battery_power_kw", p_step) or v_step == p_step


def test_each_kind_has_its_way():
    frame = uneven({"speed_mps": 1.0, "battery_power_kw": 0.1, "gear": 5.0})
    log = read(frame, clock="speed_mps")
    assert set(log.segments.channels["gear"]) == {1.0, 2.0}
    t = np.arange(N)
    means = np.array([np.trapezoid(power(k + 0.1 * np.arange(-5, 6)), dx=0.1) for k in t[1:-1]])  # ends count half
    np.testing.assert_allclose(log.measured["battery_power_w"][1:-1], 1e3 * means, rtol=1e-9)
    rule = {"battery_power_kw": {"source": "battery_power_kw", "unit": "kW"}}
    line = {"my_kw": {"source": "aux", "unit": "kW", "resample": "last"}}
    extra = pd.DataFrame({"time_s": [0.0, 50.0, 100.0, 150.0], "aux": [1.0, 2.0, 3.0, 4.0]})
    frame = pd.concat([frame, extra]).sort_values("time_s", kind="stable")
    log = read(frame, clock="speed_mps", columns=rule | line)
    assert set(log.segments.channels["my_kw"]) == {1.0, 2.0, 3.0}


def test_a_state_that_is_sent_once_holds_and_the_rows_are_counted():
    frame = uneven({"speed_mps": 1.0, "battery_power_kw": 1.0})
    sent = pd.DataFrame({"time_s": [3.0, 4.0, 5.0], "mass_kg": [15e3, 15e3, 18e3]})
    log = read(pd.concat([frame, sent]).sort_values("time_s", kind="stable"), clock="speed_mps")
    mass, time = log.segments.channels["mass_kg"], np.asarray(log.segments.time_s)
    assert set(mass[time >= 5.0]) == {18e3}
    (said,) = [e.reason for e in log.ledger if e.column == "mass_kg" and "held for more than ten" in e.reason]
    assert f"in {np.sum(time > 15.0)} rows" in said


def test_energies_by_row_are_summed_and_never_shared_out():
    """On a faster clock a row would have the energy of many; a counter has a value at every time."""
    frame = uneven({"speed_mps": 1.0, "battery_power_kw": 0.25}).rename(columns={"battery_power_kw": "energy_wh"})
    frame["energy_wh"] *= 0.25 / 3.6
    log = read(frame, clock="speed_mps")
    np.testing.assert_allclose(
        np.sum(log.target("energy_wh")), np.sum(power(np.arange(0.0, 119.25, 0.25))) / 14.4, rtol=0.01
    )
    slow = uneven({"speed_mps": 0.1, "battery_power_kw": 2.0}).rename(columns={"battery_power_kw": "energy_wh"})
    with pytest.raises(InputError, match=r"'energy_wh' is a sum over each 2 s, slower than the clock of 0\.1 s"):
        read(slow, clock="speed_mps")
    assert len(read(slow, clock="energy_wh")) == 60
    counts = slow.assign(energy_wh=1e4 + 5.0 * slow["time_s"].where(slow["energy_wh"].notna()))
    log = read(counts, clock="speed_mps", columns={"energy_wh": {"source": "energy_wh", "counter": True}})
    np.testing.assert_allclose(np.sum(log.target("energy_wh")), 5.0 * float(np.sum(log.segments.duration_s)), rtol=0.01)


def test_trips_are_apart():
    one = uneven({"speed_mps": 1.0, "battery_power_kw": 0.5})
    both = pd.concat([one.assign(trip_id="A"), one.assign(trip_id="B")])
    log = read(both, clock="speed_mps")
    assert log.trip_names == ("A", "B")
    alone = read(one, clock="speed_mps")
    np.testing.assert_allclose(log.segments.distance_m[len(alone) :], alone.segments.distance_m)
    with pytest.raises(InputError, match=r"row 361, column time_s: time runs backwards"):
        read(pd.concat([one, one]).reset_index(drop=True), clock="speed_mps")


def test_what_is_wrong_with_a_clock_is_said():
    frame = uneven({"speed_mps": 1.0, "battery_power_kw": 0.5})
    with pytest.raises(InputError, match="names the one of battery_power_w"):
        read(frame)
    with pytest.raises(InputError, match=r"no channel 'sped_mps' \(clock of adapter\), did you mean 'speed_mps'"):
        read(frame, clock="sped_mps")
    with pytest.raises(InputError, match="a step above 0 s"):
        read(frame, clock=-1.0)
    with pytest.raises(InputError, match="accepted: mean, sum, last, linear"):
        read(frame, clock=1.0, columns={"gear": {"source": "gear", "resample": "median"}})
    late = frame[frame["speed_mps"].isna() | (frame["time_s"] > 200.0)]
    apart = pd.concat([late, pd.DataFrame({"time_s": [300.0, 301.0], "speed_mps": [1.0, 2.0]})])
    with pytest.raises(InputError, match="have no time in common"):
        read(apart, clock="speed_mps")
