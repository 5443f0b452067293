"""Closed-form regression: against a NumPy derivation, additive, row by row, and never without a finite answer."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from inference_rows import C_RR_SD, CDA, CDA_SD, PRIOR, PRIOR_SD, by_hand, driving, power_kw, tabular, truck
from scipy import stats

from hdev_jax.inference import (
    Coefficient,
    LinearFit,
    ParameterTable,
    Prior,
    Rows,
    Statistics,
    calibrate,
    caveats,
    cluster_rows,
    design,
    follow,
    least_squares,
    linear_fit,
    padded,
    statistics,
    update,
)  # fmt: skip
from hdev_jax.inference.linear import posterior
from hdev_jax.inference.posterior.methods import calibrated
from hdev_jax.segments import Segments

TRUTH = np.array([0.0068, 6.1])
NOISE = 2.0


def log(*lengths: int, seed: int = 1, noise: float = NOISE) -> tuple[Segments, np.ndarray]:
    s = driving(*lengths, seed=seed)
    return s, power_kw(s, TRUTH) + noise * np.random.default_rng(seed).standard_normal(len(s))


def fit(s: Segments, y: np.ndarray, **options) -> LinearFit:
    ids = np.zeros(len(s), dtype=int)
    return linear_fit(
        truck(), options.pop("table", tabular()), lambda: [Rows(padded(s, y), ids)], "battery_power_kw", **options
    )


def rows_of(n: int, seed: int = 0, k: int = 2) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    x = rng.standard_normal((n, k))
    return x, x @ rng.standard_normal(k) + 0.5 * rng.standard_normal(n)


def sums(x: np.ndarray, r: np.ndarray) -> Statistics:
    return statistics(x, r, r, np.ones(len(r)))


def test_it_is_bayes_rule_on_a_grid():
    """Prior times likelihood, integrated numerically over σ² and one coefficient."""
    x, r = rows_of(7, k=1)
    mean, sd, noise, rows = 0.3, 0.7, 0.8, 6.0
    post = posterior(Prior.of_table([mean], [sd], noise, rows), sums(x, r))
    a0, b0 = rows / 2, (rows / 2 - 1) * noise**2

    theta, variance = np.meshgrid(np.linspace(-3, 4, 801), np.geomspace(1e-3, 60.0, 801), indexing="ij")
    left = (r[:, None, None] - x[:, :1, None] * theta[None, :, :1]) ** 2
    log = stats.invgamma.logpdf(variance, a0, scale=b0) + np.log(variance)  # the grid is even in the logarithm
    log += stats.norm.logpdf(theta, mean, sd * np.sqrt(variance) / noise)
    log += -0.5 * np.sum(left, axis=0) / variance - 0.5 * len(r) * np.log(variance)
    density = np.exp(log - log.max())
    density /= density.sum()
    first = float(np.sum(density * theta))
    second = float(np.sum(density * theta**2))
    assert float(post.mean[0]) == pytest.approx(first, rel=1e-4)
    assert float(post.sd[0]) == pytest.approx(np.sqrt(second - first**2), rel=1e-3)


def test_the_kernel_gives_the_design_that_paper_and_pencil_give():
    s, y = log(80, 60)
    found = fit(s, y)
    columns, rest = by_hand(s)
    z, r = columns * PRIOR_SD, y - rest - columns @ PRIOR
    sigma = float(found.prior.noise)
    precision = z.T @ z + sigma**2 * np.eye(2)
    assert found.values == pytest.approx(PRIOR + PRIOR_SD * np.linalg.solve(precision, z.T @ r), rel=1e-9)
    assert found.converged
    assert found.passes == 2, "linear: the second pass only sees that nothing moves"
    assert np.all(np.abs(found.values - TRUTH) < 4 * found.sd)


def test_it_agrees_with_the_map():
    s, y = log(*[60] * 10)
    clusters = cluster_rows(s)
    rows = padded(s, y)
    found = linear_fit(
        truck(), tabular(), lambda: [Rows(rows, clusters.ids)], "battery_power_kw", clusters=clusters.count
    )
    other = calibrate(truck(), tabular(), rows, "battery_power_kw", clusters)
    assert found.inflation == pytest.approx(other.inflation, rel=0.01)
    assert np.all(np.abs(found.values - other.values) < 0.02 * found.sd)


@settings(max_examples=6)
@given(st.integers(0, 2**31), st.permutations([1, 7, 30]))
def test_statistics_add_up_in_any_cut(seed, lengths):
    x, r = rows_of(sum(lengths), seed)
    edges = np.r_[0, np.cumsum(lengths)]
    parts = [sums(x[a:b], r[a:b]) for a, b in itertools.pairwise(edges)]
    together = parts[0]
    for part in parts[1:]:
        together = together + part
    group = np.repeat(np.arange(len(lengths)), lengths)
    grouped = statistics(x, r, r, np.ones(len(r)), group, len(lengths)).total()
    for other in (together, grouped):
        for a, b in zip(jax.tree.leaves(sums(x, r)), jax.tree.leaves(other), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-11, atol=1e-12)


def test_a_log_in_chunks_is_the_log():
    s, y = log(70, 50, 60)
    whole = fit(s, y)
    pieces = [
        Rows(padded(s.take(s.trip == t), y[s.trip == t]), np.zeros(int((s.trip == t).sum()), int)) for t in range(3)
    ]
    cut = linear_fit(truck(), tabular(), lambda: pieces, "battery_power_kw")
    np.testing.assert_allclose(cut.values, whole.values, rtol=1e-12)
    np.testing.assert_allclose(cut.covariance, whole.covariance, rtol=1e-9)


@pytest.mark.parametrize("forgetting", [1.0, 0.97])
def test_row_by_row_is_the_batch(forgetting):
    x, r = rows_of(400)
    prior = Prior.of_table([0.0, 0.0], [1.0, 1.0], 0.5)
    last, (_, _, means) = jax.jit(follow)(prior, Statistics.zero(2), x, r, forgetting=forgetting)
    weight = forgetting ** np.arange(399, -1, -1)
    batch = statistics(x, r, r, weight)
    np.testing.assert_allclose(last.gram, batch.gram, rtol=1e-11)
    np.testing.assert_allclose(means[-1], posterior(prior, batch).mean, rtol=1e-10)


def test_what_is_forgotten_leads_back_to_the_table_and_no_further():
    """A thousand rows of standing still after a drive: nothing winds up, as a covariance that is divided would."""
    x, r = rows_of(200)
    prior = Prior.of_table([0.0, 0.0], [0.1, 0.1], 0.5)
    state, _ = follow(prior, Statistics.zero(2), x, r, forgetting=0.99)
    state, (_, wide, means) = follow(prior, state, np.zeros((3000, 2)), np.zeros(3000), forgetting=0.99)
    after = posterior(prior, state)
    assert np.all(np.isfinite(wide))
    np.testing.assert_allclose(np.sqrt(np.diag(np.linalg.inv(after.precision))) * 0.5, 0.1, rtol=1e-6)
    np.testing.assert_allclose(means[-1], 0.0, atol=1e-8)


def test_ten_million_updates_lose_no_digits_that_matter():
    """The information form on columns that are nearly one, a million times the noise in size."""
    rng = np.random.default_rng(0)
    x = np.stack([np.ones(20_000), 1.0 + 1e-4 * rng.standard_normal(20_000)], axis=1) * 1e3
    r = x @ np.array([2.0, -1.0]) + 1e-3 * rng.standard_normal(20_000)
    prior = Prior.of_table([0.0, 0.0], [10.0, 10.0], 1e-3)
    state, _ = jax.jit(follow)(prior, Statistics.zero(2), x, r)
    assert np.all(np.abs(np.asarray(posterior(prior, state).mean) - [2.0, -1.0]) < 1e-3)
    one = update(Statistics.zero(2), jnp.asarray(x[0]), r[0])
    np.testing.assert_allclose(one.gram, np.outer(x[0], x[0]))


def test_exact_draws_have_the_posteriors_moments():
    x, r = rows_of(30)
    post = posterior(Prior.of_table([0.0, 0.0], [1.0, 1.0], 0.5), sums(x, r))
    theta, sigma = post.draws(jax.random.key(0), 40_000)
    np.testing.assert_allclose(np.mean(theta, axis=0), post.mean, atol=5 * float(np.max(post.sd)) / 200)
    np.testing.assert_allclose(np.cov(np.asarray(theta).T), post.covariance, rtol=0.05, atol=2e-4)
    assert float(jnp.sqrt(jnp.mean(sigma**2))) == pytest.approx(float(post.sigma), rel=0.01)


def test_vehicles_are_one_program_and_one_without_rows_has_its_table():
    s, y = log(80, 70, 60, 90)
    vehicle = np.asarray(s.vehicle) * 2  # vehicles 0 and 2; 1 has no rows
    rows = Rows(padded(s, y), np.zeros(len(s), int), vehicle)
    found = linear_fit(truck(), tabular(), lambda: [rows], "battery_power_kw", groups=3, noise=NOISE)
    for v in (0, 2):
        own = s.take(vehicle == v)
        alone = fit(own, y[vehicle == v], noise=NOISE)
        np.testing.assert_allclose(found.values[v], alone.values, rtol=1e-9)
        np.testing.assert_allclose(found.sd[v], alone.sd, rtol=1e-9)
    np.testing.assert_allclose(found.values[1], PRIOR)
    np.testing.assert_allclose(found.sd[1], PRIOR_SD)
    assert caveats(found) == ["group 1: there are no rows: every coefficient comes from the table"]


def constant_speed() -> Segments:
    s = driving(100)
    flat = {"mass_kg": np.full(100, 24e3), "grade_rad": np.full(100, 0.015)}
    v = np.full(100, 20.0)
    return Segments(s.trip, s.vehicle, s.time_s, s.duration_s, v * s.duration_s, v, v, flat)


def case(name: str) -> tuple[Segments, np.ndarray]:
    rng = np.random.default_rng(0)
    s, y = log(100, 90)
    if name == "constant speed":
        s = constant_speed()
        return s, power_kw(s, TRUTH) + NOISE * rng.standard_normal(100)
    if name == "contradiction":
        return s, power_kw(s, np.array([0.0100, 3.0])) + NOISE * rng.standard_normal(len(s))
    if name == "two rows":
        return s.take(np.arange(2)), y[:2]
    if name == "outlier":
        y[7] += 100.0 * 3600 / 5.0  # 100 kWh in a row of 5 s
        return s, y
    if name == "regenerating":
        down = s.with_channels(grade_rad=-np.asarray(s.channels["grade_rad"]) * 3)
        columns, _ = by_hand(down)
        from inference_rows import EFFICIENCY  # eta once on the way out, once on the way back

        force = columns @ TRUTH * EFFICIENCY + by_hand(down)[1] * EFFICIENCY
        return down, force * EFFICIENCY + 0.1 * rng.standard_normal(len(s))
    raise AssertionError(name)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("constant speed", ["cannot separate road.c_rr and road.cda_m2"]),
        ("contradiction", ["road.c_rr: the log says ", "road.cda_m2: the log says"]),
        ("two rows", ["2 rows: the noise is mostly its prior"]),
        ("outlier", ["one row is", "student_t"]),
        ("regenerating", ["every row gives energy back", "does not identify the cost of driving"]),
    ],
)
@pytest.mark.parametrize("robust", [False, True])
def test_hard_logs_have_a_finite_answer_and_a_word(name, words, robust):
    s, y = case(name)
    found = fit(s, y, robust=robust)
    said = " | ".join(caveats(found))
    for array in (found.values, found.sd, found.covariance, np.asarray(found.posterior.sigma)):
        assert np.all(np.isfinite(array))
    assert np.all(found.sd > 0)
    if not (robust and name == "outlier"):
        assert all(w in said for w in words), said
    for a in least_squares(found.statistics):
        assert np.all(np.isfinite(a))


@pytest.mark.parametrize("noise", [0.1, 4.0])
def test_clusters_that_agree_about_nothing_are_no_knowledge(noise):
    """At constant speed the default method leaves c_rr and C_d·A as the closed form does, and their sum known."""
    s = constant_speed()
    y = power_kw(s, TRUTH) + noise * np.random.default_rng(0).standard_normal(100)
    rows, clusters = padded(s, y), cluster_rows(s)
    found = calibrate(truck(), tabular(), rows, "battery_power_kw", clusters)
    assert np.all(found.sd > 0.5 * np.array([C_RR_SD, CDA_SD]))
    columns, _ = by_hand(s)
    of_sum = float(np.sqrt(columns[0] @ found.covariance @ columns[0]))
    assert of_sum < 2.0 * noise / np.sqrt(100) + 0.02


def test_a_log_without_noise_tells_no_more_than_its_rows_do():
    """Computed to the last digit, at constant speed: the sum is known, how the two share it is the tables' word."""
    s = constant_speed()
    found = fit(s, power_kw(s, TRUTH))
    assert np.all(found.sd > 0.5 * np.array([C_RR_SD, CDA_SD]))
    assert "cannot separate" in " | ".join(caveats(found))
    columns, _ = by_hand(s)
    assert float(np.sqrt(columns[0] @ found.covariance @ columns[0])) < 1e-3


def test_a_table_that_is_sure_and_wrong_is_no_good_fit():
    """c_rr held at three times its value drives C_d·A below zero: told, kept in range, not called good."""
    s, y = log(150, 140)
    wrong = ParameterTable((Coefficient("road.c_rr", "1", 0.020, 0.0002, 0.0002, 0.0, 0.1),
                            Coefficient("road.cda_m2", "m²", CDA, CDA_SD, CDA_SD, 0.0, 100.0)))  # fmt: skip
    found = calibrated(truck(), wrong, padded(s, y), "battery_power_kw", cluster_rows(s), "linear")
    assert np.all(found.fit.values > 0)
    said = " | ".join(found.notes)
    assert "road.c_rr: the log says" in said
    assert not found.good
    assert "road.cda_m2: the closed form, which has no bounds" in said


def test_collinear_coefficients_keep_what_is_known_of_their_sum():
    s = constant_speed()
    found = fit(s, power_kw(s, TRUTH) + 0.1 * np.random.default_rng(0).standard_normal(100))
    columns, rest = by_hand(s)
    assert float(columns[0] @ found.values + rest[0]) == pytest.approx(power_kw(s, TRUTH)[0], abs=0.1)
    assert np.all(found.sd > 0.5 * np.array([C_RR_SD, CDA_SD])), "each alone is hardly better known than before"


def test_an_outlier_of_100_kwh_is_set_aside_by_heavy_tails():
    s, y = case("outlier")
    clean, _ = log(100, 90)[1], None
    assert np.all(np.abs(fit(s, y, robust=True).values - fit(s, clean).values) < 0.5 * fit(s, clean).sd)
    assert not np.all(np.abs(fit(s, y).values - fit(s, clean).values) < 3 * fit(s, clean).sd)


def test_nothing_missing_nothing_said():
    assert caveats(fit(*log(150, 140))) == []


@settings(max_examples=20)
@given(st.integers(0, 2**31))
def test_least_squares_is_numpys(seed):
    x, r = rows_of(25, seed)
    step, covariance, sigma = least_squares(sums(x, r))
    other, left, _, _ = np.linalg.lstsq(x, r, rcond=None)
    np.testing.assert_allclose(step, other, rtol=1e-8, atol=1e-10)
    assert float(sigma) == pytest.approx(np.sqrt(left[0] / 23), rel=1e-8)
    np.testing.assert_allclose(covariance, left[0] / 23 * np.linalg.inv(x.T @ x), rtol=1e-7)


def truths(prior: Prior, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients and noise drawn from the prior: the posterior of no rows."""
    theta, sigma = posterior(prior, Statistics.zero(2)).draws(jax.random.key(seed), 40_000)
    return np.asarray(theta)[:count], np.asarray(sigma)[:count]


def test_ranks_of_the_truth_are_uniform():
    """Simulation-based calibration (Talts et al. 2018, arXiv:1804.06788): among 99 draws, in 2000 worlds of 12 rows."""
    prior = Prior.of_table([0.1, -0.2], [0.5, 1.0], 0.8, 8.0)
    rng, (theta, sigma) = np.random.default_rng(1), truths(prior, 2000, 1)
    x = rng.standard_normal((2000, 12, 2)) * [1.0, 0.6] + [0.5, 0.0]
    r = np.einsum("wnk,wk->wn", x, theta) + sigma[:, None] * rng.standard_normal((2000, 12))

    def drawn(key: jax.Array, x: jax.Array, r: jax.Array) -> tuple[jax.Array, jax.Array]:
        return posterior(prior, statistics(x, r, r, jnp.ones(12))).draws(key, 99)

    draws, sigmas = jax.jit(jax.vmap(drawn))(jax.random.split(jax.random.key(1), 2000), x, r)
    ranks = [*np.sum(np.asarray(draws) < theta[:, None], axis=1).T, np.sum(np.asarray(sigmas) < sigma[:, None], axis=1)]
    for column in ranks:
        counts = np.histogram(column, bins=20, range=(0, 100))[0]
        assert stats.chisquare(counts).pvalue > 1e-3


def test_intervals_of_the_second_half_hold_in_nine_of_ten_trips():
    """500 truths drawn from the prior, on the kernel's own design: the total of the second half from the first."""
    s = driving(*[60] * 17, seed=9)
    x, _ = design(truck(), tabular(), padded(s, np.zeros(len(s))).segments, "battery_power_kw", PRIOR)
    x = np.tile((np.asarray(x)[: len(s)] * PRIOR_SD).reshape(17, 60, 2), (30, 1, 1))[:500]
    prior = Prior.of_table([0.0, 0.0], [1.0, 1.0], 3.0, 8.0)
    theta, sigma = truths(prior, 500, 4)
    y = np.einsum("tnk,tk->tn", x, theta) + sigma[:, None] * np.random.default_rng(4).standard_normal((500, 60))

    def trip(x: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
        first = posterior(prior, statistics(x[:30], y[:30], y[:30], jnp.ones(30)))
        mean, scale = first.total(x[30:], jnp.ones(30))
        return (jnp.sum(y[30:]) - mean) / scale, first.freedom

    off, freedom = jax.jit(jax.vmap(trip))(x, y)
    inside = np.abs(np.asarray(off)) < stats.t.ppf(0.95, np.asarray(freedom))
    assert 0.87 <= np.mean(inside) <= 0.93


def test_a_free_efficiency_is_iterated_to_the_map():
    """Energy is no line in an efficiency: the point of linearisation has to move."""
    from hdev_jax.inference import Coefficient

    table = tabular().plus(Coefficient("driveline.efficiency", "1", 0.88, 0.03, 0.03, 0.0, np.inf))
    s, y = log(150, 150, noise=0.5)
    found = fit(s, y, table=table)
    other = calibrate(truck(), table, padded(s, y), "battery_power_kw", cluster_rows(s))
    assert found.converged
    assert 2 < found.passes <= 6
    assert np.all(np.abs(found.values - other.values) < 0.05 * found.sd)
