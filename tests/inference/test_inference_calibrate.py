"""Calibration against the closed form, by simulation, and where it has to say that it failed."""

import sys
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from inference_rows import C_RR_SD, PRIOR, PRIOR_SD, by_hand, closed_form, driving, power_kw, tabular, truck
from scipy import optimize

from hdev_jax.inference import Calibration, Coefficient, Fit, ParameterTable, calibrate, cluster_rows, padded
from hdev_jax.physics import Grouped
from hdev_jax.physics.road import Aero
from hdev_jax.segments import Segments

TARGET = "battery_power_kw"
TRUTH = PRIOR + np.array([0.8, -0.7]) * PRIOR_SD


def fitted(s: Segments, measured: np.ndarray, table: ParameterTable | None = None, **options) -> Calibration:
    return calibrate(truck(), table or tabular(), padded(s, measured), TARGET, cluster_rows(s), **options)


def measured(s: Segments, truth: Sequence[float] | np.ndarray, seed: int, sd: float, level: float = 0.0) -> np.ndarray:
    """White noise on every row and, where asked for, a level of its own on every trip."""
    rng = np.random.default_rng(seed)
    noise = sd * rng.normal(size=len(s)) + level * rng.normal(size=int(s.trip.max()) + 1)[s.trip]
    return power_kw(s, np.asarray(truth)) + noise


def test_the_kernel_and_the_second_derivation_agree():
    """On these rows: what the comparisons below rest on."""
    s = driving(40, 24)
    predicted = tabular().insert(truck(), TRUTH).predict(s, TARGET)
    np.testing.assert_allclose(predicted, power_kw(s, TRUTH), rtol=1e-12)
    assert np.min(predicted) > 0  # the switch is not crossed, so the model is linear


@pytest.mark.parametrize("level", [0.0, 4.0])
@pytest.mark.parametrize("scale", [0.1, 1.0, 10.0])
def test_equals_bayesian_linear_regression(scale, level):
    """Tight, tabular and wide priors, errors of rows and of trips: the closed form with its own jackknife."""
    s = driving(*(24,) * 10, seed=5)
    y = measured(s, TRUTH, seed=1, sd=4.0, level=level)
    fit = fitted(s, y, tabular(scale))
    columns, rest = by_hand(s)
    values, sd, sigma, inflation = closed_form(columns, y - rest, PRIOR, scale * PRIOR_SD, s.trip)
    assert fit.converged
    # the weights of the likelihood are taken as settled when they move the optimum by less than 0.01 sd
    assert np.all(np.abs(fit.values - values) < 0.03 * sd)
    # what is reported belongs to these values, so it is off by as little
    assert fit.sigma == pytest.approx(sigma, rel=1e-3)
    assert fit.inflation == pytest.approx(inflation, rel=1e-3)
    np.testing.assert_allclose(fit.sd, sd, rtol=1e-3)
    np.testing.assert_allclose(np.sqrt(np.diag(fit.covariance)), fit.sd)
    np.testing.assert_allclose(fit.predicted, columns @ fit.values + rest, rtol=1e-12)


def test_planted_values_are_covered():
    """Truth drawn from the prior, white noise: z-scores have variance 1 whatever the log weighs against the prior.

    48 z-scores, in pairs that are correlated: their root mean square has a standard error of about 0.12.
    """
    s = driving(*(24,) * 10, seed=2)
    z = []
    for seed in range(24):
        truth = PRIOR + PRIOR_SD * np.random.default_rng(100 + seed).normal(size=2)
        fit = fitted(s, measured(s, truth, seed, sd=8.0))
        assert fit.converged
        z.append((fit.values - truth) / fit.sd)
    assert 0.6 < np.sqrt(np.mean(np.square(z))) < 1.45
    assert np.max(np.abs(z)) < 5.0


def test_errors_by_trip_are_clustered():
    """With a level on every trip rows are not independent: naive errors are far too narrow, clustered ones cover.

    60 logs: the sd of their z-scores has a standard error near 0.1, and twelve clusters make tails of their own.
    """
    s = driving(*(20,) * 12, seed=3)
    columns, _ = by_hand(s)
    wide = 100.0  # the prior says nothing, so the least-squares errors are what there is to compare
    z, naive = [], []
    for seed in range(60):
        fit = fitted(s, measured(s, TRUTH, seed, sd=3.0, level=6.0), tabular(wide))
        error = fit.values - TRUTH
        plain = fit.sigma * np.sqrt(np.diag(np.linalg.inv(columns.T @ columns)))
        z.append(error / fit.sd)
        naive.append(error / plain)
    first = np.std(np.stack(z), axis=0)
    assert np.all(first > 0.7)
    assert np.all(first < 1.4)
    assert np.std(np.stack(naive)[:, 0]) > 1.5


def test_clustered_errors_are_wider_where_trips_differ():
    s = driving(*(20,) * 12, seed=3)
    plain, levels = (fitted(s, measured(s, TRUTH, 0, sd=3.0, level=x), tabular(100.0)) for x in (0.0, 6.0))
    assert plain.inflation < 3.0
    assert levels.inflation > 2 * plain.inflation
    assert levels.sd[0] > 2 * plain.sd[0]


def test_five_rows_leave_the_table_as_it_is():
    """And a long log speaks for itself: its answer is that of a prior a hundred times wider."""
    few = driving(5)
    fit = fitted(few, measured(few, TRUTH, 0, sd=40.0))
    assert np.all(np.abs(fit.prior_z()) < 0.5)
    np.testing.assert_allclose(fit.sd, PRIOR_SD, rtol=0.35)


def test_fifty_thousand_rows_speak_for_themselves():
    many = driving(*(5000,) * 10, seed=4)
    y = measured(many, TRUTH, 0, sd=4.0)
    tabled, wide = fitted(many, y), fitted(many, y, tabular(100.0))
    assert np.all(tabled.sd < 0.05 * PRIOR_SD)
    # a prior of 1 sd pulls by (sd/prior sd)² of the way to it: 0.05² of a tabular sd, so 0.05 of the log's own
    assert np.all(np.abs(tabled.values - wide.values) < 0.1 * tabled.sd)
    assert np.all(np.abs(tabled.values - TRUTH) < 4 * tabled.sd)


def test_outliers_are_weighed_down():
    """2 % of the rows off by up to 60 sd, one way: over four logs the t-distribution is nearer the truth."""
    s = driving(*(24,) * 10, seed=6)
    off = {"normal": 0.0, "student_t": 0.0}
    for seed in range(4):
        rng = np.random.default_rng(50 + seed)
        y = measured(s, TRUTH, seed, sd=2.0)
        y = y + np.where(rng.random(len(s)) < 0.02, rng.uniform(60.0, 120.0, len(s)), 0.0)
        for noise in off:
            fit = fitted(s, y, noise=noise)
            assert fit.converged
            off[noise] += float(np.sum(((fit.values - TRUTH) / PRIOR_SD) ** 2))
    assert off["student_t"] < 0.5 * off["normal"]


def test_without_outliers_both_agree():
    s = driving(*(24,) * 10, seed=6)
    y = measured(s, TRUTH, 0, sd=2.0)
    normal, robust = fitted(s, y), fitted(s, y, noise="student_t")
    # a t with 4 degrees of freedom has 5/7 of a normal's efficiency at worst: they differ by a fraction of an sd
    assert np.all(np.abs(normal.values - robust.values) < normal.sd + robust.sd)


@pytest.mark.parametrize("extra", [1, 128])
def test_padding_changes_nothing(extra):
    """Rows past the log have weight 0: the same values whatever the shape they were padded to."""
    s = driving(30, 41, 20)
    y = measured(s, TRUTH, 0, sd=4.0)
    fit = padded(s, y)
    more = jax.tree.map(lambda x: np.r_[x, np.full(extra, x[-1], x.dtype)] if np.ndim(x) else x, fit)
    assert more.weight.shape[0] == fit.weight.shape[0] + extra
    one, other = (calibrate(truck(), tabular(), f, TARGET, cluster_rows(s)) for f in (fit, more))
    for name in ("values", "sd", "covariance", "predicted"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=1e-8, err_msg=name)
    assert one.predicted.shape == y.shape


@pytest.mark.parametrize("n", [1, 63, 64, 65, 511, 513, 1000, 4097])
def test_padded_shapes_are_few_and_their_rows_idle(n):
    """Short logs share a shape; all are finite, at standstill, in a trip of their own and of weight 0."""
    s = driving(n)
    fit = padded(s, np.ones(n))
    size = len(fit.segments)
    assert size == 1024 if n <= 1024 else n <= size <= n + n / 4
    assert fit.rows == n
    np.testing.assert_array_equal(fit.weight, np.arange(size) < n)
    np.testing.assert_array_equal(fit.segments.trip, np.arange(size) >= n)
    assert np.all(fit.segments.distance_m[n:] == 0)
    np.testing.assert_array_equal(fit.segments.distance_m[:n], s.distance_m)
    if size == 1024:  # of one shape
        assert np.all(np.isfinite(truck().predict(fit.segments, TARGET)))


def test_nothing_free():
    """A sheet of known values is predicted, not fitted."""
    s = driving(30, 20)
    y = measured(s, TRUTH, 0, sd=4.0)
    fit = fitted(s, y, tabular().with_free(**{"road.c_rr": False, "road.cda_m2": False}))
    assert fit.converged
    assert fit.message == "nothing to estimate"
    assert fit.values.shape == (0,)
    np.testing.assert_allclose(fit.predicted, power_kw(s, PRIOR), rtol=1e-12)
    assert fit.sigma == pytest.approx(np.sqrt(np.mean((y - power_kw(s, PRIOR)) ** 2)))


def test_what_is_held_stays():
    s = driving(*(24,) * 10)
    fit = fitted(s, measured(s, TRUTH, 0, sd=4.0), tabular().with_free(**{"road.cda_m2": False}))
    assert float(fit.vehicle.effect("aero").cda_m2) == PRIOR[1]
    assert float(fit.vehicle.effect("rolling").c_rr) == fit.values[0] != PRIOR[0]


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_prior_z_has_the_sign_of_the_move(sign):
    s = driving(*(24,) * 10)
    truth = PRIOR + sign * np.array([2.0, -2.0]) * PRIOR_SD
    z = fitted(s, measured(s, truth, 0, sd=2.0)).prior_z()
    # the truth is 2 tabular sd away and the log knows it to a fraction of that
    np.testing.assert_allclose(z, sign * np.array([2.0, -2.0]), atol=0.8)


def test_prior_z_of_what_has_no_table():
    s = driving(*(24,) * 10)
    table = ParameterTable((Coefficient("road.c_rr", "1", PRIOR[0], None, C_RR_SD),))
    fit = fitted(s, measured(s, (TRUTH[0], PRIOR[1]), 0, sd=2.0), table)
    assert np.isnan(fit.prior_z()).all()
    assert abs(fit.values[0] - TRUTH[0]) < 4 * fit.sd[0]


@pytest.mark.parametrize("support", [{"lower": 0.0}, {"lower": 0.0, "upper": 20.0}])
def test_support_is_kept(support):
    """Inside it the answer is that of the open line; a log that pulls beyond it ends at its edge, finite."""
    s = driving(*(24,) * 10)
    y = measured(s, TRUTH, 0, sd=2.0)
    np.testing.assert_allclose(fitted(s, y, tabular(**support)).values, fitted(s, y).values, rtol=1e-3)
    beyond = fitted(s, measured(s, (-5e-3, 5.0), 0, sd=2.0), tabular(10.0, **support))
    assert 0.0 <= beyond.values[0] < 5e-4
    assert np.all(np.isfinite(beyond.sd))


@pytest.mark.parametrize("truth", [-0.5, 0.5])
@pytest.mark.parametrize(("lower", "upper"), [(0.0, 0.02), (-0.01, 0.02), (0.0055, 0.0065)])
def test_a_round_that_ends_at_a_bound_is_followed_by_one_that_can_leave_it(lower, upper, truth):
    """The log pulls far beyond it; then its rows weigh less, for all that they miss, and the table pulls back."""
    s = driving(*(24,) * 10)
    fit = fitted(s, measured(s, (truth, PRIOR[1]), 0, sd=1.0), tabular(lower=lower, upper=upper))
    assert fit.converged
    assert lower <= fit.values[0] <= upper
    assert (fit.values[0] - PRIOR[0]) * truth > 0
    assert np.all(np.isfinite(fit.sd))


def test_a_coefficient_of_each_vehicle():
    """Two vehicles on the same roads, each with its own rolling resistance: both come out, each with its sd."""
    s = driving(*(24,) * 10, seed=8)
    own = np.array([5e-3, 7e-3])
    columns, rest = by_hand(s)
    noise = 2.0 * np.random.default_rng(0).normal(size=len(s))
    y = columns[:, 0] * own[s.vehicle] + columns[:, 1] * PRIOR[1] + rest + noise
    car = truck(c_rr=Grouped(jnp.full(2, PRIOR[0]), "vehicle"))
    rows = tuple(Coefficient("road.c_rr", "1", PRIOR[0], C_RR_SD, C_RR_SD, group=k, label=str(k)) for k in (0, 1))
    fit = calibrate(car, ParameterTable(rows), padded(s, y), TARGET, cluster_rows(s))
    assert fit.converged
    assert np.all(np.abs(fit.values - own) < 4 * fit.sd)
    np.testing.assert_array_equal(fit.vehicle.effect("rolling").c_rr.values, fit.values)


# --- a fit that fails says so ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_log_that_holds_no_numbers(bad):
    """What the border should have refused: no exception, and no success either."""
    s = driving(*(24,) * 10)
    y = measured(s, TRUTH, 0, sd=4.0)
    y[7] = bad
    fit = fitted(s, y)
    assert not fit.converged
    assert fit.message not in ("", "converged")


def test_a_model_that_leaves_the_finite_numbers():
    s = driving(*(24,) * 10)
    fit = padded(s, measured(s, TRUTH, 0, sd=4.0))
    broken = eqx.tree_at(lambda f: f.segments.speed_end_mps, fit, np.full(len(fit.segments), np.nan))
    result = calibrate(truck(), tabular(), broken, TARGET, cluster_rows(s))
    assert not result.converged
    assert result.message not in ("", "converged")


def test_fits_share_one_compilation():
    """Priors, data and weights are numbers: a second log of the same shape is not traced again."""
    traces = []

    class CountedAero(Aero):
        def force(self, row, car):
            traces.append(1)
            return super().force(row, car)

    s = driving(*(24,) * 10)
    car = truck().minus("aero").plus(CountedAero(np.asarray(5.6)))
    calibrate(car, tabular(), padded(s, measured(s, TRUTH, 0, sd=4.0)), TARGET, cluster_rows(s))
    before = len(traces)
    assert before > 0
    calibrate(car, tabular(3.0), padded(s, measured(s, PRIOR, 1, sd=2.0)), TARGET, cluster_rows(s))
    assert len(traces) == before


def test_fit_is_a_pytree_of_one_shape():
    """`Fit` can be given weights of its own with `tree_at`, as calibrate does."""
    fit = padded(driving(10), np.ones(10))
    heavier = eqx.tree_at(lambda f: f.weight, fit, 2 * np.asarray(fit.weight))
    assert isinstance(heavier, Fit)
    assert heavier.rows == 10


@pytest.mark.parametrize(
    ("start", "apart", "hinge"),
    [((0.3, 2.0), 0.03, 3.0), ((0.3, 0.3), 0.003, 0.0), ((2.0, 2.0), 0.003, 0.0), ((1.5, 0.2), 0.003, 0.0)],
)
def test_a_fit_ends_at_the_optimum(start, apart, hinge):
    """Two coefficients that hardly differ, in a model that bends, without and with a kink: whole steps overshoot, and
    shorter ones gain little long before the optimum."""
    s = driving(*(24,) * 10, seed=5)
    rng = np.random.default_rng(3)
    u = np.linspace(0.5, 2.0, len(s))
    v = u + apart * rng.standard_normal(len(s))

    def model(theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        a, b = theta / PRIOR
        above = a * u > 1.2
        value = np.exp(a * u) + np.exp(b * v) + hinge * np.where(above, a * u - 1.2, 0.0)
        slopes = np.stack([u * np.exp(a * u) + hinge * above * u, v * np.exp(b * v)], axis=1)
        return value, slopes / PRIOR

    def linearise(vehicle, table, segments, target, theta=None) -> tuple[np.ndarray, np.ndarray]:
        value, slopes = model(np.asarray(table.values(vehicle) if theta is None else theta))
        more = len(segments) - len(value)
        return np.r_[value, np.zeros(more)], np.r_[slopes, np.zeros((more, 2))]

    y = model(PRIOR)[0] + 0.5 * rng.standard_normal(len(s))
    vehicle = tabular().insert(truck(), jnp.asarray(np.array(start) * PRIOR))
    fit = calibrate(vehicle, tabular(30.0), padded(s, y), TARGET, cluster_rows(s), linearise=linearise)
    assert fit.converged

    def residuals(x: np.ndarray) -> np.ndarray:
        theta = x * PRIOR
        rows = (y - model(theta)[0]) / (fit.sigma * np.sqrt(fit.inflation))
        return np.r_[rows, (theta - PRIOR) / (30.0 * PRIOR_SD)]

    tight = {"xtol": 1e-14, "ftol": 1e-14, "gtol": 1e-14}
    starts = [fit.values / PRIOR, *([np.ones(2)] if not hinge else [])]  # at the kink there is an optimum too
    best = min(optimize.least_squares(residuals, x, **tight).cost for x in starts)
    # 0.03 standard errors: less than a step of Levenberg-Marquardt may gain without another one being made
    assert 0.5 * np.sum(residuals(fit.values / PRIOR) ** 2) - best < 5e-4


def test_a_fit_that_runs_out_of_steps(monkeypatch):
    """Reaching the most steps is not success."""
    monkeypatch.setattr(sys.modules["hdev_jax.inference.calibrate"], "MOST_STEPS", 1)
    s = driving(*(24,) * 10)
    fit = fitted(s, measured(s, PRIOR + 3 * PRIOR_SD, 0, sd=0.1), tabular(lower=0.0))
    assert not fit.converged
    assert "steps" in fit.message
    assert np.all(np.isfinite(fit.values))
