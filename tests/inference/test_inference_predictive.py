"""What new rows and new trips may be off by: leaving trips out, the shape of a row's noise, how errors add up."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from inference_rows import driving, tabular, truck

from hdev_jax.inference import calibrate, cluster_rows, clusters_of, left_out, padded, spread_of, sums_of
from hdev_jax.inference.predictive import errors_left_out

TRIPS, ROWS = 6, 80
WORLDS, NEW = 75, 30  # the noise is estimated once in a world, and many new trips of it are compared


def trips(count: int, rows: int = ROWS):
    return clusters_of(np.repeat(np.arange(count), rows), np.full(count * rows, 5.0), few=2)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000), st.integers(2, 8))
def test_a_trip_left_out_is_a_fit_without_it(seed, count):
    """By another way: ridge regression again, without the trip."""
    rng = np.random.default_rng(seed)
    clusters, prior_sd, counted = trips(count), np.array([2.0, 0.5, 30.0]), rng.uniform(0.5, 2.0, count * ROWS)
    x = rng.standard_normal((count * ROWS, 3))
    y = x @ (prior_sd * rng.standard_normal(3)) + rng.standard_normal(len(x))

    def ridge(rows: np.ndarray) -> np.ndarray:
        weighed = counted[rows, None] * x[rows]
        return np.linalg.solve(weighed.T @ x[rows] + np.diag(prior_sd**-2.0), weighed.T @ y[rows])

    every = np.ones(len(x), dtype=bool)
    weight = rng.uniform(0.0, 3.0, len(x))
    found, open_sd = errors_left_out(x, y - x @ ridge(every), counted, weight, clusters, prior_sd)
    for k in range(count):
        own = clusters.ids == k
        np.testing.assert_allclose(found[own], (y - x @ ridge(~own))[own], rtol=1e-7, atol=1e-9)
        covariance = np.linalg.inv((counted[~own, None] * x[~own]).T @ x[~own] + np.diag(prior_sd**-2.0))
        along = weight[own] @ x[own]
        assert open_sd[k] == pytest.approx(np.sqrt(along @ covariance @ along), rel=1e-7)


def spread(error: np.ndarray, clusters, predicted=None, weight=None, open_sd=None, *, robust: bool = False):
    """Of errors beside which the coefficients leave nothing open, but for `open_sd` of the sums."""
    zero = np.zeros(len(error))
    return spread_of(
        error, zero if predicted is None else predicted, zero + 1.0 if weight is None else weight, clusters,
        np.zeros(clusters.count) if open_sd is None else open_sd, zero, row_s=5.0, robust=robust,
    )  # fmt: skip


def total(found, rows: int = ROWS, open_sd: float = 0.0) -> float:
    return found.total(0.9, open_sd, np.ones(rows), np.zeros(rows))


def autocorrelated(rng: np.random.Generator, count: int, rows: int, rho: float, last: float | None = None):
    """Of variance 1; after a row whose own is `last`, where there is one."""
    e = rng.standard_normal((count, rows)) * np.sqrt(1 - rho**2)
    e[:, 0] = e[:, 0] / np.sqrt(1 - rho**2) if last is None else e[:, 0] + rho * last
    for t in range(1, rows):
        e[:, t] += rho * e[:, t - 1]
    return e


@pytest.mark.parametrize("rho", [0.0, 0.5, 0.9])
def test_sums_are_as_wide_as_their_correlation_makes_them(rho):
    """(1 + ρ)/(1 − ρ) for long trips, less what a trip's ends lack."""
    count, rows = 240, 400
    e = autocorrelated(np.random.default_rng(1), count, rows, rho).ravel()
    found = spread(e, trips(count, rows))
    wanted = (1 + rho) / (1 - rho) - 2 * rho * (1 - rho**rows) / (rows * (1 - rho) ** 2)
    as_rows = (found.together + rows * found.level**2) * found.scale**2
    assert as_rows == pytest.approx(wanted, rel=0.15)
    assert rows * found.level**2 < 0.3 * found.together  # what goes from row to row is not taken for a level
    assert 0.4 * count < found.total_freedom <= count  # by chance some trips are a little louder


@pytest.mark.parametrize("levels", [0.0, 3.0])
@pytest.mark.parametrize("size", [0.0, 0.6])
def test_a_total_is_known_less_where_trips_differ_in_variance(size, levels):
    """Sizes exp(σ·z) by trip: squared coefficient of variation of their squares h = exp(4σ²) − 1; n squares of sums
    tell a variance to n/(1 + 1.5·h) degrees. Where levels are what a total is off by, to n, as if none differed. In the
    median of logs: trips tell badly by how much they differ."""
    count, rows, rho, found = 250, 300, 0.5, []
    for seed in range(7):
        rng = np.random.default_rng(seed)
        sizes = np.exp(size * rng.standard_normal((count, 1)))
        e = sizes * autocorrelated(rng, count, rows, rho) + levels * rng.standard_normal((count, 1))
        found.append(count / spread(e.ravel(), trips(count, rows)).total_freedom - 1.0)
    wanted = 0.0 if levels else 1.5 * np.expm1(4.0 * size**2)
    assert float(np.median(found)) == pytest.approx(wanted, rel=0.5, abs=0.05)


@pytest.mark.parametrize("count", [4, 40])
def test_totals_of_trips_that_differ_in_variance_are_held(count):
    """Nine in ten of new trips, whose variance is as much by chance as those that the noise was told from."""
    rng, rows, held = np.random.default_rng(count), 40, []
    for _ in range(WORLDS):
        sizes = np.exp(0.6 * rng.standard_normal((count + NEW, 1)))
        e = sizes * rng.standard_normal((count + NEW, rows))
        half = total(spread(e[:count].ravel(), trips(count, rows)), rows)
        held.append(np.mean(np.abs(e[count:].sum(axis=1)) <= half))
    assert 0.86 <= np.mean(held) <= 0.95


def test_the_noise_of_a_row_has_its_size_growth_and_tails():
    rng = np.random.default_rng(2)
    size = rng.uniform(0.0, 200.0, 40_000)
    e = np.sqrt(3.0**2 + (0.05 * size) ** 2) * rng.standard_t(4.0, len(size))
    found = spread(e, trips(40, 1000), size)
    assert found.scale == pytest.approx(3.0, rel=0.1)
    assert found.growth == pytest.approx(0.05, rel=0.1)
    assert found.freedom == pytest.approx(4.0, rel=0.25)
    for level in (0.5, 0.9, 0.99):
        assert np.mean(np.abs(e) < found.rows(level, np.zeros(len(e)), size)) == pytest.approx(level, abs=0.01)


@pytest.mark.parametrize("count", [3, 12])
@pytest.mark.parametrize("rho", [0.0, 0.9])
def test_totals_of_new_trips_are_held(count, rho):
    """Worlds of one unknown coefficient: 90 % of totals that no fit has seen, however few trips there were."""
    rng = np.random.default_rng(3)
    held, rows = [], 60
    prior_sd = np.array([1.0])
    for _ in range(WORLDS):
        x = 1.0 + 0.5 * rng.standard_normal((count + NEW, rows)) + 0.5 * rng.standard_normal((count + NEW, 1))
        y = x * rng.standard_normal() + autocorrelated(rng, count + NEW, rows, rho)
        old, ys = x[:count].reshape(-1, 1), y[:count].ravel()
        worth = (1 - rho) / (1 + rho)
        information = worth * float(np.sum(old**2)) + 1.0
        theta = worth * float(old[:, 0] @ ys) / information
        clusters = trips(count, rows)
        left = ys - old[:, 0] * theta
        error, open_sd = errors_left_out(old, left, np.full(len(ys), worth), np.ones(len(ys)), clusters, prior_sd)
        found = spread(error, clusters, open_sd=open_sd)
        for new_x, new_y in zip(x[count:], y[count:], strict=True):
            half = total(found, rows, abs(float(np.sum(new_x))) / np.sqrt(information))
            held.append(abs(float(np.sum(new_y - theta * new_x))) <= half)
    assert 0.855 <= np.mean(held) <= 0.945


def test_one_trip_is_judged_by_its_blocks_and_two_by_themselves():
    assert (sums_of(driving(400)).kind, sums_of(driving(400)).count > 1) == ("block", True)
    assert (sums_of(driving(60, 60)).kind, sums_of(driving(60, 60)).count) == ("trip", 2)


@pytest.mark.parametrize("white", [0.0, 1.0])
def test_the_second_half_of_a_single_drive_is_held(white):
    """Errors that last as long as a tenth of the drive, alone and under as much noise of single rows."""
    rng = np.random.default_rng(5)
    held, rows = [], 250
    clusters = clusters_of(np.zeros(rows, dtype=int), np.full(rows, 12.0), few=2)
    assert clusters.kind == "block"
    for _ in range(WORLDS):
        first = autocorrelated(rng, 1, rows, 0.92)[0]
        seconds = autocorrelated(rng, NEW, rows, 0.92, first[-1]) + white * rng.standard_normal((NEW, rows))
        half = total(spread(first + white * rng.standard_normal(rows), clusters), rows)
        held.append(np.mean(np.abs(seconds.sum(axis=1)) <= half))
    assert 0.855 <= np.mean(held) <= 0.945


def test_new_trips_may_be_shorter_and_longer():
    """What all rows of a trip share grows with the trip, what each has of its own with its root."""
    rng, count, usual = np.random.default_rng(6), 12, 60
    held: dict[int, list[float]] = {12: [], 360: []}

    def driven(many: int, n: int) -> np.ndarray:
        return 0.5 * rng.standard_normal((many, 1)) + rng.standard_normal((many, n))

    for _ in range(WORLDS):
        found = spread(driven(count, usual).ravel(), trips(count, usual))
        for rows, shares in held.items():
            shares.append(np.mean(np.abs(driven(NEW, rows).sum(axis=1)) <= total(found, rows)))
    assert all(0.85 <= np.mean(shares) <= 0.95 for shares in held.values())


@pytest.mark.parametrize("vehicles", [1, 4])
def test_coefficients_of_each_vehicle_are_not_counted_twice(vehicles):
    """A vehicle whose one trip is left out is known by its table alone; the others' noise does not take that on."""
    rng = np.random.default_rng(7)
    clusters, own = trips(4, 60), np.eye(vehicles)[np.arange(240) // 60 % vehicles]
    x = own * (1.0 + 0.3 * rng.standard_normal((240, 1)))
    y = x @ (5.0 * rng.standard_normal(vehicles)) + rng.standard_normal(240)
    precision = x.T @ x + np.eye(vehicles) / 25.0
    left = y - x @ np.linalg.solve(precision, x.T @ y)
    error, open_sd = errors_left_out(x, left, np.ones(240), np.ones(240), clusters, np.full(vehicles, 5.0))
    found = spread_of(
        error, np.zeros(240), np.ones(240), clusters, open_sd, np.sqrt(np.sum(x**2, axis=1)) * 5.0 * (vehicles > 1),
        row_s=5.0,
    )  # fmt: skip
    assert found.together + 60 * found.level**2 < 12.0


def test_an_instruments_fault_is_no_energy():
    """A row of 100 kWh in one trip: with heavy tails it does not make every total uncertain by 100 kWh."""
    e = np.random.default_rng(4).standard_normal(8 * ROWS)
    e[17] = 1e5
    plain, robust = (total(spread(e, trips(8), robust=r)) for r in (False, True))
    assert plain > 1e4
    assert robust < 100.0


def test_a_log_without_any_error_has_an_interval_of_nothing():
    found = spread(np.zeros(4 * ROWS), trips(4), np.full(4 * ROWS, 50.0))
    assert np.all(np.isfinite(found.rows(0.9, np.zeros(3), np.full(3, 50.0))))
    assert 0.0 <= found.total(0.9, 0.0, np.ones(ROWS), np.full(ROWS, 50.0)) < 1e-3


@pytest.mark.parametrize("share", [0.6, 1.0])
def test_rows_that_stand_do_not_make_the_noise_grow_without_bound(share):
    """Most rows, or all, are predicted as 0: what grows with a row's energy is told by the others, or by none."""
    rng = np.random.default_rng(8)
    predicted = np.where(rng.uniform(size=8 * ROWS) < share, 0.0, 100.0)
    found = spread(rng.standard_normal(8 * ROWS), trips(8), predicted)
    assert found.growth < 0.02
    assert total(found) < 60.0


def test_a_trip_without_weight_tells_nothing_of_sums():
    """A trip that stood has no work: the others' sums are as wide as without it."""
    rng = np.random.default_rng(9)
    e = (rng.standard_normal((9, 1)) + 0.2 * rng.standard_normal((9, ROWS))).ravel()
    weight = np.r_[np.zeros(ROWS), np.ones(8 * ROWS)]
    found = spread(e, trips(9), weight=weight)
    assert found.total_freedom == 8
    assert total(found) == pytest.approx(total(spread(e[ROWS:], trips(8))), rel=0.2)
    assert np.isfinite(total(spread(e, trips(9), weight=np.zeros(9 * ROWS))))


def test_a_calibrations_own_spread():
    """Of the kernel: as many sums as trips, a row's noise as it was drawn; with nothing free there is nothing open."""
    s = driving(*[60] * TRIPS, seed=3)
    rng = np.random.default_rng(0)
    clean = np.asarray(truck().predict(padded(s, np.zeros(len(s))).segments, "battery_power_kw"))[: len(s)]
    rows = padded(s, clean + 2.0 * rng.standard_normal(len(s)))
    for table in (tabular(), tabular().with_free(**{c.name: False for c in tabular().rows})):
        fit = calibrate(truck(), table, rows, "battery_power_kw", cluster_rows(s))
        found, clusters = left_out(fit, rows, "battery_power_kw", np.full(len(s), 5.0))
        assert (found.total_freedom, clusters.kind) == (TRIPS, "trip")
        assert found.scale == pytest.approx(2.0, rel=0.15)


@pytest.mark.parametrize(("rho", "low", "high"), [(0.0, 1.0, 1.5), (0.97, 2.0, np.inf)])
def test_coefficients_of_a_single_drive_are_as_open_as_its_errors_last(rho, low, high):
    """Blocks of the drive that are no longer than its errors last agree with each other by more than they know."""
    s, rng = driving(400, seed=3), np.random.default_rng(1)
    clean = np.asarray(truck().predict(padded(s, np.zeros(len(s))).segments, "battery_power_kw"))[: len(s)]
    rows = padded(s, clean + 4.0 * autocorrelated(rng, 1, len(s), rho)[0])
    fit = calibrate(truck(), tabular(), rows, "battery_power_kw", cluster_rows(s))
    found, clusters = left_out(fit, rows, "battery_power_kw", np.full(len(s), 5.0))
    assert clusters.kind == "block"
    assert low <= found.open_times <= high
    x = np.full(3, 2.0)
    assert np.all(found.rows(0.9, x, x) >= 1.6 * np.sqrt(found.open_times) * x)
