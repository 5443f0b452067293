"""Logs by distance against a plain loop and by hand: where rows are cut, what is conserved, what channels become."""

import math
from dataclasses import replace

import hypothesis.strategies as st
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from logs_helpers import read, samples

from hdev_jax.errors import InputError
from hdev_jax.logs import Log, by_distance
from hdev_jax.physics import Driveline, Machine, Vehicle
from hdev_jax.physics.road import Aero, Grade, Inertia, Rolling
from hdev_jax.segments import SPREAD, Segments, trip_slices


def make(speed, trip=None, dt=1.0, channels=None, power=None) -> Log:
    """A log of samples whose end speeds are means with their neighbours, as the reader makes them."""
    v = np.asarray(speed, float)
    trip = np.zeros(len(v), np.int32) if trip is None else np.asarray(trip, np.int32)
    first = np.r_[True, trip[1:] != trip[:-1]]
    last = np.r_[first[1:], True]
    duration = np.broadcast_to(np.asarray(dt, float), v.shape).copy()
    clock = np.cumsum(duration) - duration
    s = Segments(
        trip=trip,
        vehicle=np.zeros(len(v), np.int32),
        time_s=clock - np.repeat(clock[first], np.diff(np.r_[np.flatnonzero(first), len(v)])),
        duration_s=duration,
        distance_m=v * duration,
        speed_start_mps=np.where(first, v, 0.5 * (v + np.r_[0.0, v[:-1]])),
        speed_end_mps=np.where(last, v, 0.5 * (v + np.r_[v[1:], 0.0])),
        channels={k: np.asarray(x, float) for k, x in (channels or {}).items()},
    )
    power = 500.0 * v + 3000.0 if power is None else np.asarray(power, float)
    return Log(s, {"battery_power_w": power}, tuple(f"T{i}" for i in range(trip.max() + 1)), ("bus",), sampled=True)


def random_log(seed: int, trips: int, most: int) -> Log:
    """Trips of 1 to `most` samples that drive, creep and stand, with a channel of every kind."""
    rng = np.random.default_rng(seed)
    sizes = rng.integers(1, most + 1, trips)
    n = int(sizes.sum())
    speed = np.repeat(rng.choice([0.0, 0.0, 0.4, 9.0, 17.0, 130.0], n), rng.integers(1, 25, n))[:n]
    speed = speed * np.where(rng.random(n) < 0.5, 1.0, rng.uniform(0.5, 1.5, n))
    return make(
        speed,
        np.repeat(np.arange(trips), sizes),
        rng.choice([0.22, 0.5, 1.0, 3.0], n),
        {
            "ambient_temp_c": rng.normal(5, 10, n),
            "soc": np.full(n, 0.1 + 0.2),
            "grade_rad": rng.normal(0, 0.05, n),
            "mass_kg": 19500.0 + 70.0 * rng.integers(0, 80, n),
            "gear": rng.integers(0, 4, n),
            "door_open": rng.integers(0, 2, n),
            "heading_rad": rng.uniform(0, 2 * np.pi, n),
        },
        rng.normal(0, 1e5, n),
    )


def plain_loop(log: Log, length: float, halt_s: float) -> list[list[int]]:
    """Which samples each row holds, one sample after the other."""
    s, out = log.segments, []
    for _, rows in trip_slices(s.trip):
        still = [
            bool(s.distance_m[i] == 0 and s.speed_start_mps[i] == 0 and s.speed_end_mps[i] == 0)
            for i in range(rows.start, rows.stop)
        ]
        halt, i = [False] * len(still), 0
        while i < len(still):
            j = i
            while j < len(still) and still[j] and still[i]:
                j += 1
            if sum(s.duration_s[rows.start + i : rows.start + j]) >= halt_s - 1e-9:
                halt[i:j] = [True] * (j - i)
            i = max(j, i + 1)
        gone, before = 0.0, None
        for k, stands in enumerate(halt):
            kind = "halt" if stands else math.floor(gone / length + 1e-6)
            if kind != before:
                out.append([])
            out[-1].append(rows.start + k)
            before, gone = kind, gone + float(s.distance_m[rows.start + k])
    return out


MADE = st.tuples(st.integers(0, 10**6), st.integers(1, 5), st.integers(1, 150))  # of which a random log is made


@given(MADE, st.sampled_from([25.0, 100.0, 1000.0]), st.sampled_from([2.0, 10.0, math.inf]))
def test_equals_the_loop(made, length, halt_s):
    log = random_log(*made)
    s, q = log.segments, (out := by_distance(log, length, halt_s=halt_s)).segments
    rows = plain_loop(log, length, halt_s)
    assert len(out) == len(rows)
    for i, at in enumerate(rows):
        c = {k: v[at] for k, v in s.channels.items()}
        t, d = s.duration_s[at], s.distance_m[at]
        w = d if d.sum() > 0 else t
        np.testing.assert_array_equal(
            [q.trip[i], q.time_s[i], q.speed_start_mps[i], q.speed_end_mps[i]],
            [s.trip[at[0]], s.time_s[at[0]], s.speed_start_mps[at[0]], s.speed_end_mps[at[-1]]],
        )
        held = {g: t[c["gear"] == g].sum() for g in np.unique(c["gear"])}
        assert held[q.channels["gear"][i]] == pytest.approx(max(held.values()))
        assert q.channels["soc"][i] == 0.1 + 0.2  # constant to the last bit
        assert 0.0 <= q.channels["heading_rad"][i] <= 2 * np.pi
        ours = {k: v[i] for k, v in q.channels.items()} | {"power": out.measured["battery_power_w"][i]}
        expected = {
            "ambient_temp_c": np.average(c["ambient_temp_c"], weights=t),
            "door_open": np.average(c["door_open"], weights=t),
            "mass_kg": np.average(c["mass_kg"], weights=w),
            "grade_rad": np.arcsin(np.average(np.sin(c["grade_rad"]), weights=w)),
            "power": np.average(log.measured["battery_power_w"][at], weights=t),
        }
        for name, x in expected.items():
            assert ours[name] == pytest.approx(x, rel=1e-9, abs=1e-9), name


@given(MADE, st.sampled_from([25.0, 100.0, 1000.0]))
def test_every_trip_keeps_its_time_distance_energy_and_climb(made, length):
    log = random_log(*made)
    out = by_distance(log, length)
    assert not out.sampled
    assert out.trip_names == log.trip_names
    assert out.segments.trip.dtype == log.segments.trip.dtype

    def totals(a: Log) -> np.ndarray:
        s = a.segments
        climb, work = s.distance_m * np.sin(s.channels["grade_rad"]), s.distance_m * s.channels["mass_kg"]
        ways = (s.distance_m * s.accel_of_way_mps2, s.distance_m * s.square_speed_m2ps2)
        each = (s.duration_s, s.distance_m, a.target("energy_wh"), climb, work, *ways)
        return np.array([np.bincount(s.trip, x, len(a.trip_names)) for x in each])

    magnitude = np.abs(log.target("energy_wh")).sum() + 1e5 * log.segments.distance_m.sum() + 1.0
    np.testing.assert_allclose(totals(out), totals(log), rtol=1e-12, atol=1e-13 * magnitude)
    # a row begins at most one sample's way past a multiple of the length
    s = out.segments
    most = length + log.segments.distance_m.max() + 1e-3
    assert np.all(s.distance_m <= most)
    assert np.all(s.duration_s > 0)


def test_by_hand():
    # 40 m/s for 3 s, braking, 12 s at rest with 2 s more in which it comes to rest and starts, then 40 m/s again
    speed = [40, 40, 40, 20, *[0] * 14, 20, 40, 40]
    n = len(speed)
    log = make(
        speed,
        channels={
            "gear": [3, 3, 2, 2, *[0] * 14, 1, 2, 2],
            "grade_rad": [0.02, 0.04, 0.04, 0, *[0.09] * 14, 0, 0, 0],
            "ambient_temp_c": np.arange(n),
            "heading_rad": np.deg2rad([350, 20, 10, 10, *[90] * 14, 10, 10, 10]),
        },
        power=[1e3, 2e3, 3e3, 4e3, *[500] * 14, 5e3, 6e3, 7e3],
    )
    out = by_distance(log, 100.0)
    s = out.segments
    # samples begin at 0, 40, 80 | 120, 140 (at rest) | the halt | 140 … 160 | 200
    np.testing.assert_array_equal(s.distance_m, [120, 20, 0, 60, 40])
    np.testing.assert_array_equal(s.duration_s, [3, 2, 12, 3, 1])
    np.testing.assert_array_equal(s.time_s, [0, 3, 5, 17, 20])
    np.testing.assert_array_equal(s.speed_start_mps, [40, 30, 0, 0, 40])
    np.testing.assert_array_equal(s.speed_end_mps, [30, 0, 0, 40, 40])
    np.testing.assert_allclose(out.measured["battery_power_w"], [2e3, 2250, 500, 11500 / 3, 7e3])
    np.testing.assert_allclose(out.target("energy_wh"), np.array([6e3, 4500, 6e3, 11500, 7e3]) / 3600)
    np.testing.assert_array_equal(s.channels["gear"], [3, 0, 0, 0, 2])  # of values held equally long the lower
    climb = np.sin(0.02) + 2 * np.sin(0.04)
    np.testing.assert_allclose(s.channels["grade_rad"], [np.arcsin(climb / 3), 0, 0.09, 0, 0], rtol=1e-14)
    np.testing.assert_allclose(s.channels["ambient_temp_c"], [1, 3.5, 10.5, 18, 20])
    circle = np.angle(np.exp(1j * (s.channels["heading_rad"] - np.deg2rad([20 / 3, 50, 90, 0, 10]))))
    np.testing.assert_allclose(circle[[1, 2, 4]], 0, atol=1e-12)
    assert abs(circle[0]) < np.deg2rad(0.2)
    lines = "\n".join(out.ledger.lines())
    assert "derived 5 rows: 100 m of road each, or a halt, from 21 rows" in lines
    assert "derived 1 row: halts of 10 s or longer, apart from the road" in lines
    assert "noted 2 rows: under half of 100 m" in lines
    assert "derived of gear: the value held longest in each row" in lines
    # without halts apart only the road cuts
    np.testing.assert_array_equal(by_distance(log, 100.0, halt_s=math.inf).segments.distance_m, [120, 80, 40])


def test_multiples_are_met_where_binary_sums_miss_them():
    log = make(np.full(3000, 0.1), dt=0.1)  # 0.01 m each: 300 of them are 3 m
    np.testing.assert_allclose(by_distance(log, 3.0).segments.distance_m, 3.0)
    log = make(np.full(120, 0.0), dt=0.1)
    assert by_distance(log, 3.0, halt_s=12.0).ledger.count("derived") == 2


def test_stretches_are_left_as_they_are(tmp_path):
    log = read(tmp_path, samples(3000).assign(gear=2.0))
    once = by_distance(log)
    twice = by_distance(once)
    assert len(once) == len(twice)
    for name in ("time_s", "duration_s", "distance_m", "speed_start_mps", "speed_end_mps"):
        np.testing.assert_array_equal(getattr(twice.segments, name), getattr(once.segments, name))
    # the reader's words stay in front of the ledger
    assert once.ledger.entries[: len(log.ledger)] == log.ledger.entries


def test_energy_that_the_log_measures_is_summed():
    log = make(np.full(50, 10.0))
    log = Log(log.segments, {"energy_wh": np.arange(50.0)}, log.trip_names, log.vehicle_names)
    out = by_distance(log, 100.0)
    np.testing.assert_array_equal(out.measured["energy_wh"], np.arange(50.0).reshape(5, 10).sum(axis=1))
    assert out.default_target == "energy_wh"


@pytest.mark.parametrize(("slope", "swing", "efficiency"), [(-0.05, 0.0, 0.9), (0.03, 0.0, 0.9), (0.01, 8.0, 1.0)])
def test_the_kernel_asks_the_same_energy_of_samples_and_stretches(slope, swing, efficiency):
    """A steady speed, and one that varies inside the stretches where nothing is lost when power turns round."""
    n = 1000
    channels = {"grade_rad": np.full(n, slope), "mass_kg": np.full(n, 2e4)}
    log = make(11.0 + swing * np.sin(np.arange(n) / 3.0), np.arange(n) // 400, channels=channels)
    out = by_distance(log)
    assert len(out) < len(log) / 8
    car = Vehicle(
        (Inertia(1.0), Grade(), Rolling(0.008), Aero(6.0)),
        mass_kg=jnp.asarray(0.0),
        driveline=Driveline(0.95 if efficiency < 1.0 else 1.0),
        machine=Machine(efficiency, 0.8 if efficiency < 1.0 else 1.0),
    )
    parts, whole = car.breakdown(log.segments), car.breakdown(out.segments)
    assert parts.keys() == whole.keys()
    for name, x in parts.items():
        each = np.bincount(log.segments.trip, np.asarray(x)), np.bincount(out.segments.trip, np.asarray(whole[name]))
        np.testing.assert_allclose(each[1], each[0], rtol=1e-11, atol=1e-9)


def test_a_stretch_that_is_driven_and_braked_has_losses_in_both_directions():
    """Of a stretch whose ends have one speed the mean force is small; what its samples lose is not."""
    n = 2000
    log = make(11.0 + 3.0 * np.sin(np.arange(n) / 2.0), channels={"mass_kg": np.full(n, 2e4)})
    car = Vehicle(
        (Inertia(1.0), Rolling(0.006), Aero(6.0)), mass_kg=jnp.asarray(0.0), driveline=Driveline(0.9),
        machine=Machine(0.9, 0.8),
    )  # fmt: skip
    stretches = by_distance(log).segments
    samples, rows, without = (
        float(np.sum(car.predict(s, "energy_wh"))) for s in (log.segments, stretches, stretches.without(SPREAD))
    )
    assert abs(rows / samples - 1.0) < 0.1 < 0.3 < abs(without / samples - 1.0)
    # put together once more it is what it would have been at once
    twice, at_once = by_distance(by_distance(log, 100.0), 500.0).segments, by_distance(log, 500.0).segments
    inside = [float(np.sqrt(np.average(s.channels[SPREAD] ** 2, weights=s.distance_m))) for s in (twice, at_once)]
    assert inside[0] == pytest.approx(inside[1], rel=0.02)


def test_stretches_of_a_faster_log_are_the_faster_stretches():
    log = make(11.0 + 8.0 * np.sin(np.arange(300) / 3.0))
    made = by_distance(replace(log, segments=log.segments.faster(1.25)), 125.0).segments
    scaled = by_distance(log, 100.0).segments.faster(1.25)
    np.testing.assert_allclose(made.channels[SPREAD], scaled.channels[SPREAD], rtol=1e-12)
    for name in ("distance_m", "speed_start_mps", "speed_end_mps", "accel_of_way_mps2", "square_speed_m2ps2"):
        np.testing.assert_allclose(getattr(made, name), getattr(scaled, name), rtol=1e-12, atol=1e-12)
    assert not np.allclose(scaled.accel_of_way_mps2, scaled.accel_mps2, atol=0.1)


@pytest.mark.parametrize("length", [0.0, -100.0, math.nan, math.inf])
def test_a_wrong_length_is_refused(length):
    with pytest.raises(InputError, match=r"^length_m: a positive length in metres is expected, found [^\n]+$"):
        by_distance(make([1.0, 2.0]), length)


@pytest.mark.parametrize("halt_s", [0.0, -1.0, math.nan])
def test_a_wrong_halt_is_refused(halt_s):
    with pytest.raises(InputError, match=r"^halt_s: a positive time in seconds is expected[^\n]+$"):
        by_distance(make([1.0, 2.0]), halt_s=halt_s)


def test_no_rows_are_refused():
    with pytest.raises(InputError, match="without rows"):
        by_distance(make([1.0, 2.0]).take(np.zeros(2, bool)))
