"""What acts across rows, against plain loops, SciPy and analytic shifts; and never from one trip into another."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import physics_rows as made
import pytest
from scipy.signal import lfilter

from hdev_jax.physics import across
from hdev_jax.physics.across import less_noise
from hdev_jax.physics.library import derived
from hdev_jax.segments import Segments

TRIPS = (7, 6, 1, 5)
shifted, later_slope = jax.jit(across.shifted), jax.jit(across.later_slope)


def even(column: np.ndarray, lengths: tuple[int, ...], dt: float = 0.5) -> tuple[np.ndarray, Segments]:
    """Trips of equal durations around a column."""
    trip = np.repeat(np.arange(len(lengths)), lengths)
    n = len(trip)
    clock = np.concatenate([dt * np.arange(k) for k in lengths])
    return column, Segments(trip, 0 * trip, clock, np.full(n, dt), np.ones(n), np.ones(n), np.ones(n), {})


def noise(lengths: tuple[int, ...] = TRIPS, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=sum(lengths))


def by_trip(f: Any, column: Any, segments: Segments) -> np.ndarray:
    parts = [np.asarray(column)[segments.trip == k] for k in dict.fromkeys(segments.trip.tolist())]
    return np.concatenate([f(x) for x in parts])


def both_modes(f: Any) -> Any:
    """A function's value and its slope, in reverse and forward, as one program."""
    return jax.jit(lambda t: (*jax.value_and_grad(f)(t), jax.jvp(f, (t,), (1.0,))[1]))


def test_trip_bounds() -> None:
    """First and last row of the trip, in whatever order the ids come."""
    _, segments = even(noise((2, 1, 3)), (2, 1, 3))
    renamed = Segments(**{**vars(segments), "trip": np.array([3, 3, 0, 7, 7, 7])})
    first, last = across.trip_bounds(renamed)
    assert first.tolist() == [0, 0, 2, 3, 3, 3]
    assert last.tolist() == [1, 1, 2, 5, 5, 5]


def test_what_is_worked_out_before_changes_nothing() -> None:
    log = made.drives(*made.LENGTHS)
    ids = ("tyre_warmup", "brake_drag", "time_skew")  # all that is worked out: distances, braking, bounds of trips
    car = made.baseline().plus(*(made.typical(i) for i in ids))
    once = derived(log)
    assert set(log.channels) < set(once.channels)
    np.testing.assert_array_equal(car.energy(once), car.energy(log))


# --- shifts --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("cubic", [0.0, 1.0])
@pytest.mark.parametrize("rows", [-9, -2, -1, 0, 1, 3, 9])
def test_a_shift_by_whole_rows_is_a_shifted_column(rows: int, cubic: float) -> None:
    """The first value of a trip holds before it and the last one after it; no other trip is seen."""
    column, segments = even(noise(), TRIPS)
    expected = by_trip(lambda x: x[np.clip(np.arange(len(x)) - rows, 0, len(x) - 1)], column, segments)
    np.testing.assert_allclose(shifted(column, segments, rows * 0.5, cubic), expected, rtol=1e-12, atol=1e-12)


def test_time_skew_shifts_the_power() -> None:
    column, segments = even(noise(), TRIPS)
    segments = segments.with_channels(traction_force_n=1e4 * column)
    car = made.baseline("wheel")
    late = car.plus(type(made.null("time_skew"))(made.arr(1.0), made.arr(0.0)))
    expected = by_trip(lambda x: x[np.clip(np.arange(len(x)) - 2, 0, None)], car.power(segments), segments)
    np.testing.assert_allclose(late.power(segments), expected, rtol=1e-12)


@pytest.mark.parametrize(("cubic", "order", "factor"), [(0.0, 2, 1 / 8), (1.0, 4, 3 / 128)])
def test_a_fraction_of_a_row_on_a_sine(cubic: float, order: int, factor: float) -> None:
    """Inside the trip the error is that of the interpolation: factor·(ω·dt)^order, less by 2^order at half the step."""
    worst = []
    for dt in (0.2, 0.1, 0.05):
        column, segments = even(np.sin(2.0 * dt * np.arange(200)), (200,), dt)
        error = 0.0
        for share in (0.1, 0.5, 0.8, 2.3, -1.4):
            seen = shifted(column, segments, share * dt, cubic)
            analytic = np.sin(2.0 * dt * (np.arange(200) - share))
            error = max(error, float(np.max(np.abs(seen - analytic)[5:-5])))
        assert error < 1.05 * factor * (2.0 * dt) ** order
        worst.append(error)
    np.testing.assert_allclose(np.divide(worst[:-1], worst[1:]), 2.0**order, rtol=0.1)


def test_slope_of_a_shift_from_both_sides() -> None:
    """At a whole row the slope is that of the later side: one row back for linear, the four points for the cubic."""
    column, segments = even(noise((9,)), (9,))
    slope = jax.jit(jax.grad(lambda s, c: across.shifted(column, segments, s, c)[4]))
    x = column
    np.testing.assert_allclose(slope(0.0, 0.0), (x[3] - x[4]) / 0.5)
    np.testing.assert_allclose(slope(1e-6, 0.0), (x[3] - x[4]) / 0.5)
    np.testing.assert_allclose(slope(-1e-6, 0.0), (x[4] - x[5]) / 0.5)
    later = (-x[5] / 3 - x[4] / 2 + x[3] - x[2] / 6) / 0.5
    earlier = (x[6] / 6 - x[5] + x[4] / 2 + x[3] / 3) / 0.5
    np.testing.assert_allclose(slope(0.0, 1.0), later, rtol=1e-10)
    np.testing.assert_allclose(slope(1e-7, 1.0), later, rtol=1e-5)
    np.testing.assert_allclose(slope(-1e-7, 1.0), earlier, rtol=1e-5)


def test_neighbours() -> None:
    column, segments = even(noise(), TRIPS)
    for j in (1, 2):

        def bend(x: np.ndarray, j: int = j) -> np.ndarray:
            held = np.r_[[x[0]] * j, x, [x[-1]] * j]
            return held[: len(x)] + held[2 * j :] - 2 * x

        expected = by_trip(bend, column, segments)
        np.testing.assert_allclose(across.neighbours(column, segments, j), expected, rtol=1e-12, atol=1e-12)


def test_sampling_taps() -> None:
    """The taps are a symmetric filter: inside a trip a convolution, and a constant passes unchanged."""
    column, segments = even(noise((12,)), (12,))
    effect = made.typical("sampling_filter")
    taps = type(effect)(made.arr(0.1), made.arr(-0.05), None)
    kernel = [-0.05, 0.1, 1 - 2 * 0.1 + 2 * 0.05, 0.1, -0.05]
    seen = taps.observe(jnp.asarray(column), segments)
    np.testing.assert_allclose(seen[2:-2], np.convolve(column, kernel, "valid"), rtol=1e-12)
    np.testing.assert_allclose(taps.observe(jnp.full(12, 3.0), segments), 3.0, rtol=1e-15)


# --- filters -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("tau", [0.05, 0.7, 30.0])
def test_low_pass_is_the_recursion_of_scipy(tau: float) -> None:
    column, segments = even(noise(), TRIPS)
    keep = np.exp(-0.5 / tau)
    expected = by_trip(lambda x: lfilter([1 - keep], [1, -keep], x, zi=[keep * x[0]])[0], column, segments)
    np.testing.assert_allclose(across.low_pass(column, segments, tau), expected, rtol=1e-11, atol=1e-13)


def test_low_pass_at_zero_is_the_column_with_a_slope_of_zero() -> None:
    column, segments = even(noise(), TRIPS)
    np.testing.assert_array_equal(across.low_pass(column, segments, 0.0), column)
    weight = noise(seed=1)
    told = both_modes(lambda t: jnp.sum(across.low_pass(column, segments, t) * weight))
    _, reverse, forward = told(0.0)
    assert reverse == forward == 0.0
    for tau in (1e-3, 0.7):
        _, reverse, forward = told(tau)
        np.testing.assert_allclose(reverse, forward, atol=1e-14)
    np.testing.assert_allclose(reverse, (told(0.7 + 1e-5)[0] - told(0.7 - 1e-5)[0]) / 2e-5, rtol=1e-7)


# --- times ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("ahead", [-7.0, -1.3, 0.0, 0.4, 2.0, 5.0])
def test_a_later_slope_is_exact_where_the_road_bends_evenly(ahead: float) -> None:
    """Slope in proportion to the way, at a speed that grows evenly: rows of unequal duration, trips in any order."""
    rng, lengths = np.random.default_rng(4), (30, 25, 28)
    trip = np.repeat([2, 0, 1], lengths)
    span = rng.uniform(0.5, 1.5, len(trip))
    clock = by_trip(lambda x: np.cumsum(x) - x, span, Segments(trip, trip, span, span, span, span, span, {}))

    def way(t: np.ndarray) -> np.ndarray:
        return 4.0 * t + 0.15 * t**2

    def mean_slope(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return 0.01 - 5e-5 * (way(a) + way(b)) / 2

    theta, d = mean_slope(clock, clock + span), way(clock + span) - way(clock)
    log = Segments(trip, 0 * trip, clock, span, d, 4.0 + 0.3 * clock, 4.0 + 0.3 * (clock + span), {"grade_rad": theta})
    first, last = (np.asarray(x) for x in across.trip_bounds(log))
    # a row or more from the edges, where the slope's own slope is not known on both sides
    inside = (clock + ahead > (clock + span)[first]) & (clock + span + ahead < clock[last])
    expected = mean_slope(clock + ahead, clock + span + ahead)
    assert inside.sum() > 40
    np.testing.assert_allclose(later_slope(log, ahead)[inside], expected[inside], rtol=1e-11)
    assert ahead or np.allclose(later_slope(log, ahead), theta, rtol=1e-11)


def test_a_later_slope_has_the_slope_of_its_differences() -> None:
    log, weight = made.drives(*TRIPS), noise(seed=1)
    told = both_modes(lambda t: jnp.sum(across.later_slope(log, t) * weight))
    for lag in (-2.1, 1e-3, 0.3, 1.9):
        _, reverse, forward = told(lag)
        np.testing.assert_allclose(reverse, forward, rtol=1e-9)
        np.testing.assert_allclose(reverse, (told(lag + 1e-6)[0] - told(lag - 1e-6)[0]) / 2e-6, rtol=1e-6)
    assert told(0.0)[1] != 0.0


def test_a_later_slope_on_a_clock_that_float32_can_just_hold() -> None:
    """A long trip after many: neither clock nor way runs on over the trips, so single precision is enough."""
    lengths = (*(400,) * 20, 400)
    column, segments = even(0.02 * noise(lengths), lengths, 1.0)
    segments = segments.with_channels(grade_rad=column)
    single = jax.tree.map(lambda x: x.astype(np.float32) if made.is_real(x) else x, segments)
    seen = np.asarray(later_slope(single, np.float32(0.25)))
    np.testing.assert_allclose(seen, later_slope(segments, 0.25), atol=1e-5)


def test_grade_lag_takes_the_slope_of_later() -> None:
    """A slope that comes 2 s late is found 2 s later in the log; a place where the vehicle stands has its own."""
    theta, segments = even(0.02 * noise(), TRIPS)
    segments = segments.with_channels(grade_rad=theta)
    act = jax.jit(lambda s: type(made.null("grade_lag"))(made.arr(1.0)).across(s))
    lagged = act(segments)
    expected = by_trip(lambda x: x[np.clip(np.arange(len(x)) + 2, None, len(x) - 1)], theta, segments)
    np.testing.assert_allclose(lagged.channels["grade_rad"], expected, rtol=1e-12)
    stands = eqx.tree_at(
        lambda s: (s.distance_m, s.speed_start_mps, s.speed_end_mps),
        segments,
        tuple(x * (np.arange(len(theta)) != 3) for x in (np.ones(len(theta)),) * 3),
    )
    assert act(stands).channels["grade_rad"][1] == theta[3]


def test_distance_since_start() -> None:
    log = made.drives(*TRIPS)
    expected, gone, trip = [], 0.0, None
    for k in range(len(log)):
        if log.trip[k] != trip:
            trip, gone = log.trip[k], 0.0
        expected.append(gone + log.distance_m[k] / 2)
        gone += log.distance_m[k]
    np.testing.assert_allclose(across.distance_since_start(log), expected, rtol=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_time_since_braking(seed: int) -> None:
    log = made.drives(*TRIPS, seed=seed)
    expected, released, trip = [], None, None
    for k in range(len(log)):
        if log.trip[k] != trip:
            trip, released = log.trip[k], None
        if log.channels["brake_pressure_pa"][k] > 2e4:
            released = log.time_s[k] + log.duration_s[k]
            expected.append(0.0)
        else:
            expected.append(0.0 if released is None else log.time_s[k] + log.duration_s[k] / 2 - released)
    np.testing.assert_allclose(across.time_since_braking(log), expected, rtol=1e-12, atol=1e-12)
    assert np.max(expected) > 0


@pytest.mark.parametrize("length_m", [5.0, 100.0, 400.0])
def test_a_slope_less_its_noise_is_what_the_road_is_expected_to_be(length_m: float) -> None:
    """Regressed on the corrected slope, the true one has a slope of 1; on what was read, less."""
    rng = np.random.default_rng(3)
    near = np.exp(-length_m / 150.0)  # of an AR(1) road that forgets itself within 150 m
    truth = lfilter([0.015 * np.sqrt(1.0 - near**2)], [1.0, -near], rng.normal(0, 1, 8000))
    read = truth + rng.normal(0, 0.008, 8000)
    speed = np.full(8000, 15.0)
    log = Segments.from_arrays(trip=np.repeat(np.arange(40), 200), duration_s=length_m / speed, speed_start_mps=speed,
                               speed_end_mps=speed)  # fmt: skip
    corrected = np.asarray(jax.jit(less_noise)(read, log, 0.008))

    def told_by(x: np.ndarray) -> float:
        x = x - np.mean(x)
        return float(np.sum(x * (truth - np.mean(truth))) / np.sum(x**2))

    assert told_by(read) < 0.85
    assert told_by(corrected) == pytest.approx(1.0, abs=0.04)
    assert np.std(corrected - truth) < np.std(read - truth)


def test_less_noise_has_finite_gradients_in_single_precision() -> None:
    """Of trips of one row to 30."""
    slopes = jax.jit(jax.grad(lambda x, log, s: jnp.sum(less_noise(x, log, s) ** 2), argnums=(0, 2)))
    slope = jnp.asarray(np.random.default_rng(4).normal(0, 0.02, 30), jnp.float32)
    speed = np.full(30, 10.0, np.float32)
    for rows in (1, 2, 3, 30):
        trip = np.repeat(np.arange(30 // rows), rows)
        log = Segments.from_arrays(trip=trip, duration_s=np.ones(30, np.float32), speed_start_mps=speed,
                                   speed_end_mps=speed)  # fmt: skip
        for sd in (0.0, 1e-4, 0.01):
            assert all(bool(jnp.all(jnp.isfinite(g))) for g in slopes(slope, log, jnp.float32(sd)))
