"""What a row's noise comes from: planted instruments are found again, and those that add nothing are none."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from hdev_jax.inference.row_noise import INSTRUMENTS, believed, row_noise
from hdev_jax.inference.row_noise import shapes as shapes_of
from hdev_jax.physics import Driveline, EfficiencyMap, Machine, Vehicle
from hdev_jax.physics.road import Aero, Grade, Inertia, Rolling
from hdev_jax.segments import ACCEL_OF_WAY, Segments

MASS, ETA = 2e4, 0.8
MAP = EfficiencyMap(jnp.array([1.0]), jnp.array([0.0, 1e4]), jnp.array([-1e5, 1e5]), jnp.full((1, 2, 2), ETA))
CAR = Vehicle(
    (Inertia(jnp.asarray(1.0)), Grade(), Rolling(jnp.asarray(0.006)), Aero(jnp.asarray(5.5))),
    mass_kg=jnp.asarray(MASS),
    driveline=Driveline(MAP, jnp.array([1.0]), jnp.asarray(20.0), jnp.asarray(0.5)),
    machine=Machine(jnp.asarray(1.0), jnp.asarray(1.0)),
)


def shapes(rows, energy):
    return shapes_of(CAR, rows, energy)


def log(count: int) -> Segments:
    rng = np.random.default_rng(3)
    speed, duration = rng.uniform(1.0, 25.0, count), rng.uniform(4.0, 12.0, count)
    zero = np.zeros(count, int)
    return Segments(zero, zero, np.cumsum(duration), duration, speed * duration, speed, speed, {"gear": np.ones(count)})


def energies(rows: Segments) -> np.ndarray:
    return np.random.default_rng(4).normal(0.0, 150.0, len(rows))


@pytest.mark.parametrize(
    "sd", [(3.0, 0.0, 0.0, 0.0), (3.0, 0.03, 0.0, 0.0), (2.0, 0.0, 4e-4, 0.0), (2.0, 0.03, 4e-4, 0.03)]
)
def test_planted_instruments_are_found(sd):
    rows = log(40_000)
    shape = shapes(rows, energies(rows))
    each = np.sqrt(shape**2 @ np.square(sd))
    of_row, found = row_noise(each * np.random.default_rng(5).normal(size=len(rows)), shape, 0.0, 1e-9)
    np.testing.assert_allclose(of_row, each, rtol=0.06)
    share = np.mean((shape * found) ** 2, axis=0) / np.mean(each**2)
    np.testing.assert_allclose(share, np.mean((shape * np.array(sd)) ** 2, axis=0) / np.mean(each**2), atol=0.06)
    assert len(found) == len(INSTRUMENTS)


def test_a_slope_off_by_a_milliradian_is_the_climb_of_a_metre_in_a_kilometre():
    rows = log(2000)
    climb = shapes(rows, energies(rows))[:, INSTRUMENTS.index("grade_rad")]
    np.testing.assert_allclose(
        1e-3 * climb * 3600.0, MASS * 9.80665 * 1e-3 * np.asarray(rows.distance_m) / ETA, rtol=1e-6
    )


def test_a_change_of_speed_is_one_of_kinetic_energy():
    rows = log(2000)
    kick = shapes(rows, energies(rows))[:, INSTRUMENTS.index("speed_mps")] * 3600.0
    v = np.asarray(rows.speed_mps)
    np.testing.assert_allclose(1e-3 * kick, 0.5 * MASS * ((v + 5e-4) ** 2 - (v - 5e-4) ** 2) / ETA, rtol=1e-6)


def test_one_row_that_is_far_off_does_not_make_the_others_noisy():
    rows = log(2000)
    shape, noise = shapes(rows, energies(rows)), np.random.default_rng(7).normal(size=2000)
    noise[17] = 1e5
    of_row, _ = row_noise(noise, shape, 0.0, 1e-9)
    assert np.median(of_row) < 1.2


def test_what_parameters_took_of_the_residuals_is_given_back():
    rows = log(2000)
    shape, noise = shapes(rows, energies(rows)), np.random.default_rng(6).normal(size=2000)
    plain, given = (row_noise(noise, shape, used, 1e-9)[0] for used in (0.0, 1000.0))
    np.testing.assert_allclose(given, np.sqrt(2.0) * plain, rtol=1e-6)


def test_no_residuals_are_the_least_noise():
    rows = log(2000)
    of_row, found = row_noise(np.zeros(2000), shapes(rows, energies(rows)), 0.0, 1e-3)
    np.testing.assert_array_equal(of_row, 1e-3)
    np.testing.assert_array_equal(found, 0.0)


def readings(count: int) -> Segments:
    rng, rows = np.random.default_rng(8), log(count)
    change = rng.normal(0.2, 1.0, count)
    distance = np.where(np.arange(count) % 7 == 0, 0.0, rows.distance_m)
    slope = rng.normal(0.01, 0.02, count)
    ends = {"distance_m": distance, "speed_start_mps": 10.0 - 0.5 * change, "speed_end_mps": 10.0 + 0.5 * change}
    return replace(rows, **ends).with_channels(grade_rad=slope)


def test_what_was_read_is_believed_between_the_reading_and_the_mean():
    rows = readings(500)
    moves = np.asarray(rows.distance_m) > 0
    slope, change = (np.asarray(x) for x in (rows.channels["grade_rad"], rows.speed_end_mps - rows.speed_start_mps))
    errors = {"slope": 0.5 * slope[moves].std(), "change": 0.2 * change[moves].std()}
    given = [s * np.sqrt(1 - s**2 / x[moves].var()) for s, x in zip(errors.values(), (slope, change), strict=True)]
    logs = believed(rows, np.array([0.0, 0.0, *given]), moves)
    assert len(logs) == 4
    slopes = np.stack([x.channels["grade_rad"] for x in logs])
    changes = np.stack([x.speed_end_mps - x.speed_start_mps for x in logs])
    # Gaussian truths of variance v read with errors of variance s²: their mean and variance given the readings
    for truth, read, s in ((slopes, slope, errors["slope"]), (changes, change, errors["change"])):
        v, mean = read[moves].var() - s**2, read[moves].mean()
        np.testing.assert_allclose(truth.mean(0)[moves], ((v * read + s**2 * mean) / (v + s**2))[moves], atol=1e-12)
        np.testing.assert_allclose(truth.var(0)[moves], v * s**2 / (v + s**2), rtol=1e-9)
        np.testing.assert_array_equal(truth[:, ~moves], np.broadcast_to(read[~moves], truth[:, ~moves].shape))


def test_an_instrument_that_adds_nothing_moves_nothing():
    rows = readings(50)
    (same,) = believed(rows, np.array([1.0, 0.1, 0.0, 0.0]), np.ones(50, bool))
    np.testing.assert_array_equal(same.channels["grade_rad"], rows.channels["grade_rad"])
    np.testing.assert_array_equal(same.speed_end_mps, rows.speed_end_mps)


@pytest.mark.parametrize("told", [False, True])
def test_a_slope_that_is_the_same_everywhere_is_uncertain_about_that(told):
    rows = readings(50)
    rows = rows.with_channels(grade_rad=np.zeros(50)) if told else rows.without("grade_rad")
    up, down = believed(rows, np.array([0.0, 0.0, 1e-3, 0.0]), np.ones(50, bool))
    np.testing.assert_allclose(up.channels["grade_rad"], 1e-3)
    np.testing.assert_allclose(down.channels["grade_rad"], -1e-3)


def test_an_instrument_as_large_as_its_readings_spread_believes_half_of_them():
    rows = readings(50)
    read = np.asarray(rows.channels["grade_rad"])
    logs = believed(rows, np.array([0.0, 0.0, 2.0 * read.std(), 0.0]), np.ones(50, bool))
    half = np.mean([x.channels["grade_rad"] for x in logs], axis=0)
    np.testing.assert_allclose(half, 0.5 * (read + read.mean()), atol=1e-12)


@pytest.mark.parametrize("of_way", [False, True])
def test_a_change_of_speed_is_kinetic_energy_also_where_rows_have_their_own_mean_of_acceleration(of_way):
    rows = log(2000)
    rows = rows.with_channels(**{ACCEL_OF_WAY: np.full(len(rows), 0.3)}) if of_way else rows
    kick = shapes(rows, energies(rows))[:, INSTRUMENTS.index("speed_mps")]
    np.testing.assert_allclose(kick * 3600.0, MASS * np.asarray(rows.speed_mps) / ETA, rtol=0.02)
