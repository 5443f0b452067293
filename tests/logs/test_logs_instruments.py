"""Noise and steps of instruments against what was put in, the slope against a road that is known."""

import numpy as np
import pandas as pd
import pytest
from logs_helpers import read

from hdev_jax.logs.instruments import slope_of, speed_of, step_of
from hdev_jax.logs.instruments.smoother import HEIGHT, Course, lanes_of, smoothed
from hdev_jax.segments import ACCEL_SD, GRADE_SD
from hdev_jax.verbs.check import check

ROWS = 2400


def road(seed: int = 0, trips: int = 3, *, standing: bool = True) -> pd.DataFrame:
    """Trips of samples over hills of known slope, with halts."""
    rng = np.random.default_rng(seed)
    frames = []
    for k in range(trips):
        t = np.arange(ROWS / trips)
        speed = 11.0 + 6.0 * np.sin(t / 40.0 + k)
        if standing:
            speed[(t % 200) < 25] = 0.0
        s = np.cumsum(speed) - 0.5 * speed
        waves = [(0.02, 900.0), (0.012, 420.0)]
        phase = rng.uniform(0, 2 * np.pi, 2)
        slope = sum(a * np.cos(2 * np.pi * s / b + p) for (a, b), p in zip(waves, phase, strict=True))
        height = sum(
            a * b / (2 * np.pi) * np.sin(2 * np.pi * s / b + p) for (a, b), p in zip(waves, phase, strict=True)
        )
        frame = {"trip_id": f"T{k}", "time_s": t, "speed_mps": speed, "altitude_m": 300.0 + height, "slope": slope}
        frames.append(pd.DataFrame(frame | {"battery_power_w": 500.0 * speed + rng.normal(0, 10.0, len(t))}))
    return pd.concat(frames, ignore_index=True)


def told(frame: pd.DataFrame, reading: np.ndarray, *, of_slope: bool = False):
    return slope_of(
        frame.trip_id.factorize()[0], frame.speed_mps.to_numpy(), np.ones(len(frame)), reading, of_slope=of_slope
    )  # fmt: skip


@pytest.mark.parametrize(("step", "factor"), [(0.5, 1.0), (1.0, 1 / 3.6), (0.01, 1.0)])
def test_a_step_is_seen_in_any_unit(step, factor):
    x = np.round(np.random.default_rng(1).normal(0, 20 * step, 3000) / step) * step * factor
    assert step_of(x) == pytest.approx(step * factor, rel=0.01)


@pytest.mark.parametrize("x", [np.random.default_rng(2).normal(size=2000), np.zeros(50), np.tile([0.0, 1.0], 50)])
def test_what_has_no_step_has_none(x):
    assert step_of(x) == 0.0
    assert step_of(np.round(x, 4)) == 0.0


@pytest.mark.parametrize(("noise", "step"), [(1.0, 0.0), (3.0, 1.0)])
def test_noise_is_estimated_and_the_slope_is_as_good_as_it_says(noise, step):
    frame = road()
    z = frame.altitude_m.to_numpy() + np.random.default_rng(3).normal(0, noise, len(frame))
    s = told(frame, np.round(z / step) * step if step else z)
    assert s is not None
    assert s.noisy
    assert s.course.white == pytest.approx(np.hypot(noise, step / np.sqrt(12)), rel=0.2)
    assert s.step == pytest.approx(step)
    moves = frame.speed_mps.to_numpy() > 0
    error = (np.tan(s.grade_rad) - frame.slope.to_numpy())[moves]
    assert 0.6 < np.sqrt(np.mean((error / s.sd_rad[moves]) ** 2)) < 1.3
    # unbiased as a regressor, which a slope with noise in it is not
    assert np.polyfit(np.tan(s.grade_rad)[moves], frame.slope[moves], 1)[0] == pytest.approx(1.0, abs=0.08)


def test_exact_altitudes_give_the_slope_and_no_error_that_matters(tmp_path):
    log = read(tmp_path, road().drop(columns="slope"))
    moves = log.segments.distance_m > 5.0
    np.testing.assert_allclose(np.tan(log.segments.channels["grade_rad"])[moves], road().slope[moves], atol=2e-3)
    assert not log.segments.has(GRADE_SD)


def test_a_constant_slope_is_found_and_trips_do_not_mix():
    distance = np.tile([100.0, 100.0, 0.0, 100.0], 50)
    trip = np.repeat([0, 1], 100)
    s = np.cumsum(distance) - distance / 2
    altitude = np.where(trip == 0, 0.05 * s, 3000.0 - 0.02 * s)
    found = slope_of(trip, distance, np.full(200, 10.0), altitude)
    assert found is not None
    np.testing.assert_allclose(found.grade_rad, np.where(trip == 0, np.arctan(0.05), -np.arctan(0.02)), rtol=1e-4)
    assert slope_of(trip, np.zeros(200), np.full(200, 10.0), altitude) is None
    assert slope_of(trip, distance, np.full(200, 10.0), np.full(200, np.nan)) is None


def test_the_smoother_is_the_gaussian_conditional():
    """Against a dense conditional whose covariances are sums over a fine grid."""
    rng = np.random.default_rng(4)
    places = np.cumsum(rng.uniform(10.0, 40.0, 30))
    course = Course(0.02, 150.0, 1.5)
    grid = np.arange(places[0], places[-1] + 0.5, 0.5)
    lag = np.abs(grid[:, None] - grid[None]) / course.length_m
    of_slopes = course.slope**2 * (1.0 + lag) * np.exp(-lag)
    whole = np.tril(np.full((len(grid), len(grid)), 0.5), -1)[np.searchsorted(grid, places)]  # heights above the first
    of_heights = whole @ of_slopes @ whole.T + 1e6 + course.white**2 * np.eye(30)
    across = of_slopes[np.searchsorted(grid, places)] @ whole.T
    z = rng.normal(0, 3.0, 30)
    dense = across @ np.linalg.solve(of_heights, z - z[0])
    spread = course.slope**2 - np.sum(across * np.linalg.solve(of_heights, across.T).T, axis=1)
    lanes = lanes_of(np.zeros(30, int), places, places, z, np.ones(30), kind=HEIGHT)
    mean, sd = smoothed(lanes, course, HEIGHT)
    np.testing.assert_allclose(mean, dense, atol=3e-4)
    np.testing.assert_allclose(sd, np.sqrt(spread), rtol=0.02)


def test_long_trips_are_filtered_in_parts_that_fit():
    n = 900
    z = np.cumsum(np.random.default_rng(5).normal(0, 0.3, n))
    course = Course(0.02, 150.0, 1.0)
    place = 20.0 * np.arange(n)
    whole = smoothed(lanes_of(np.zeros(n, int), place, place, z, np.ones(n), kind=HEIGHT), course, HEIGHT)[0]
    part = slice(300, 500)
    alone = lanes_of(np.zeros(200, int), place[part], place[part], z[part], np.ones(200), kind=HEIGHT)
    np.testing.assert_allclose(smoothed(alone, course, HEIGHT)[0][70:-70], whole[part][70:-70], atol=1e-5)


def test_a_slope_logged_with_noise_is_smoothed_and_a_clean_one_is_kept(tmp_path):
    frame = road().drop(columns="altitude_m").rename(columns={"slope": "grade_tan"})
    clean = read(tmp_path, frame)
    np.testing.assert_allclose(np.tan(clean.segments.channels["grade_rad"]), frame.grade_tan, rtol=1e-9)
    noisy = frame.assign(grade_tan=frame.grade_tan + np.random.default_rng(6).normal(0, 0.02, len(frame)))
    log = read(tmp_path, noisy)
    moves = frame.speed_mps > 0
    error = np.std((np.tan(log.segments.channels["grade_rad"]) - frame.grade_tan)[moves])
    assert error < 0.4 * 0.02
    assert log.segments.has(GRADE_SD)
    assert any("smoothed" in e.reason and e.column == "grade_rad" for e in log.ledger)


def test_speed_in_steps_is_smoothed_within_half_a_step(tmp_path):
    frame = road(standing=False)
    true = frame.speed_mps.to_numpy()
    read_ = np.round(true * 3.6) / 3.6
    found = speed_of(np.repeat(np.arange(3), ROWS // 3), frame.time_s.to_numpy(), read_)
    assert found is not None
    speed, _, step = found
    assert step == pytest.approx(1 / 3.6)
    assert np.abs(speed - read_).max() <= 0.5 * step + 1e-12
    inner = np.arange(ROWS)[1:-1] % (ROWS // 3)
    inner = (inner > 0) & (inner < ROWS // 3 - 1)
    rough, smooth = (np.std((x[2:] - x[:-2] - true[2:] + true[:-2])[inner]) for x in (read_, speed))
    assert smooth < 0.6 * rough
    log = read(tmp_path, frame.drop(columns=["slope", "altitude_m"]).assign(speed_mps=read_))
    assert any(e.kind == "derived" and e.column == "speed_mps" and e.count for e in log.ledger)
    np.testing.assert_allclose(log.segments.distance_m, speed)


def segments_in_steps(rng, trips=6, rows=200, length_s=5.0):
    """Segments of about one length whose speed wanders gently, joined end to start within a trip; the true end
    speeds, and those in steps of 1 km/h."""
    parts = []
    for k in range(trips):
        duration = rng.uniform(0.6, 1.6, rows) * length_s
        fine = np.convolve(rng.normal(0, 1.0, 60_000), np.ones(25) / 5.0, mode="same")  # of 1 s, over 25 s
        course = np.clip(18.0 + np.cumsum(0.05 * fine), 5.0, 30.0)
        time = np.r_[0.0, np.cumsum(duration)]
        speed = np.interp(time, np.arange(len(course)), course)
        parts.append(pd.DataFrame({
            "trip_id": f"t{k}", "time_s": time[:-1], "duration_s": duration, "speed_start_mps": speed[:-1],
            "speed_end_mps": speed[1:], "energy_wh": 100.0,
        }))  # fmt: skip
    true = pd.concat(parts, ignore_index=True)
    coarse = {c: np.round(true[c] * 3.6) / 3.6 for c in ("speed_start_mps", "speed_end_mps")}
    return true, true.assign(**coarse)


@pytest.mark.parametrize("length_s", [5.0, 9.0])
def test_end_speeds_of_segments_in_steps_are_smoothed_and_stay_joined(tmp_path, length_s):
    true, coarse = segments_in_steps(np.random.default_rng(8), length_s=length_s)
    log = read(tmp_path, coarse)
    s = log.segments
    same = coarse.trip_id.eq(coarse.trip_id.shift(-1))[:-1]
    np.testing.assert_array_equal(s.speed_end_mps[:-1][same], s.speed_start_mps[1:][same])
    for side in ("speed_start_mps", "speed_end_mps"):
        assert np.abs(getattr(s, side) - coarse[side]).max() <= 0.5 / 3.6 + 1e-12
    change, truth, rough = (x.speed_end_mps - x.speed_start_mps for x in (s, true, coarse))
    attenuated = np.sum(truth * rough) / np.sum(rough**2)
    assert attenuated < 0.97
    assert np.sum(truth * change) / np.sum(change**2) == pytest.approx(1.0, abs=0.03)
    z = (change - truth) / (s.channels[ACCEL_SD] * s.duration_s)
    assert 0.7 < np.std(z) < 1.2  # errors of the two ends count as independent
    assert any(i.channel == "speed_mps" and i.step == pytest.approx(1 / 3.6) for i in log.instruments)


@pytest.mark.parametrize(("column", "digits"), [("time_s", 0), ("duration_s", 1)])
def test_ends_stay_joined_however_the_clock_is_rounded(tmp_path, column, digits):
    _, coarse = segments_in_steps(np.random.default_rng(8))
    coarse["speed_start_mps"] = coarse.speed_start_mps.astype(np.float32)
    s = read(tmp_path, coarse.assign(**{column: coarse[column].round(digits)})).segments
    same = coarse.trip_id.eq(coarse.trip_id.shift(-1))[:-1]
    assert np.any(s.speed_end_mps != coarse.speed_end_mps)
    np.testing.assert_array_equal(s.speed_end_mps[:-1][same], s.speed_start_mps[1:][same])


def test_rows_so_short_that_readings_repeat_are_left(tmp_path):
    _, coarse = segments_in_steps(np.random.default_rng(8), length_s=0.2, rows=1000)
    assert not read(tmp_path, coarse).segments.has(ACCEL_SD)


def test_steps_that_are_small_beside_rolling_resistance_are_left(tmp_path):
    frame = road(standing=False).drop(columns=["slope", "altitude_m"])
    steady = np.where(np.arange(len(frame)) % 200 < 150, 20.0, np.round(frame.speed_mps, 2))  # cruise control
    log = read(tmp_path, frame.assign(speed_mps=np.round(steady, 2)))
    assert not log.segments.has(ACCEL_SD)


def test_rows_that_are_not_joined_are_smoothed_by_themselves(tmp_path):
    _, coarse = segments_in_steps(np.random.default_rng(9))
    coarse.loc[100, "speed_start_mps"] += 3.0  # the row before ends at another speed
    s = read(tmp_path, coarse).segments
    assert abs(s.speed_start_mps[100] - s.speed_end_mps[99] - 3.0) <= 1.0 / 3.6 + 1e-9


def test_check_shows_the_instruments(tmp_path):
    frame = road().drop(columns="slope")
    rng = np.random.default_rng(7)
    frame["altitude_m"] = np.round(frame.altitude_m + rng.normal(0, 3.0, len(frame)))
    log = read(tmp_path, frame)
    lines = check(log).splitlines()
    line = next(x for x in lines if x.startswith("  altitude: "))
    assert [w for w in ("noise", "step 1 m", "slope smoothed over", "its error", "%") if w not in line] == []
    assert any("from altitude_m" in e.reason for e in log.ledger)
