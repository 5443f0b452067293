"""Draws: the fleet's on statistics against a dense derivation and by ranks; NUTS against both; what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from inference_rows import C_RR, C_RR_SD, CDA, CDA_SD, driving, power_kw, tabular, truck
from scipy import optimize, stats

from experiments.calibration import ranks
from experiments.runner.config import CONFIGS, resolve, typed
from hdev_jax.fleet import synthetic_log
from hdev_jax.inference import Coefficient, Fit, ParameterTable, Rows, cluster_rows, linear_fit, padded
from hdev_jax.inference.calibrate import tabular as tabular_of
from hdev_jax.inference.clusters import Clusters
from hdev_jax.inference.linear import Prior, Statistics, posterior
from hdev_jax.inference.mass import loads, mass_posterior, with_sd
from hdev_jax.inference.posterior.draws import Draws
from hdev_jax.inference.posterior.hierarchy import Sums, drawn, fleet_draws, marginal, resembling
from hdev_jax.inference.posterior.methods import calibrated
from hdev_jax.inference.posterior.models import Model
from hdev_jax.inference.posterior.nuts import sampled
from hdev_jax.inference.sheet import read_sheet
from hdev_jax.logs import read_log
from hdev_jax.physics import Grouped
from hdev_jax.problem import prepare, split_trips
from hdev_jax.rundir import open_run


def world(rng: np.random.Generator, vehicles: int, rows: int, k: int = 2) -> tuple[Sums, dict, list]:
    """A fleet from the prior, and its statistics in the tables' units with a believed noise of 1."""
    spread = np.abs(stats.t.rvs(4, size=k, random_state=rng))
    mean = rng.standard_normal(k)
    theta = mean + spread * rng.standard_normal((vehicles, k))
    variance = stats.invgamma.rvs(2, scale=1.0, random_state=rng)
    data = []
    for t in theta:
        x = rng.standard_normal((rows, k)) + 0.3
        data.append((x, x @ t + np.sqrt(variance) * rng.standard_normal(rows)))
    gram, moment = np.stack([x.T @ x for x, _ in data]), np.stack([x.T @ y for x, y in data])
    sums = Sums(gram, moment, float(sum(y @ y for _, y in data)), float(vehicles * rows))
    return sums, {"mean": mean, "spread": spread, "theta": theta, "variance": variance}, data


def test_vehicles_that_resemble_are_the_dense_normals_mean_at_the_mode():
    """The mode by SciPy, the coefficients there by one big solve; what rows do not tell, the other vehicles do."""
    rng = np.random.default_rng(3)
    sums, _, _ = world(rng, 6, 40, k=3)
    gram, moment = sums.gram.copy(), sums.moment.copy()
    gram[5] = moment[5] = 0.0  # a vehicle without a row
    sums = Sums(gram, moment, sums.square, sums.rows)
    mean, spread, theta, converged = resembling(sums, np.zeros(4))
    assert converged
    best = optimize.minimize(lambda p: -marginal(p[None], sums)[0], np.zeros(4), method="BFGS").x
    np.testing.assert_allclose(np.log(spread), best[:3], atol=0.03)
    tight, variance = np.diag(spread**-2.0), float(np.exp(best[3]))
    whole, right = np.zeros((21, 21)), np.zeros(21)  # six vehicles, then the mean
    whole[18:, 18:] = np.eye(3)
    for v in range(6):
        at = slice(3 * v, 3 * v + 3)
        whole[at, at] += gram[v] / variance + tight
        whole[18:, 18:] += tight
        whole[at, 18:] -= tight
        whole[18:, at] -= tight
        right[at] = moment[v] / variance
    dense = np.linalg.solve(whole, right)
    np.testing.assert_allclose(theta, dense[:18].reshape(6, 3), rtol=0.01, atol=1e-3)
    np.testing.assert_allclose(mean, dense[18:], rtol=0.01, atol=1e-3)
    np.testing.assert_allclose(theta[5], mean, rtol=1e-9)


def test_the_marginal_is_the_dense_normals():
    """All rows of all vehicles as one normal, whose covariance is written out."""
    rng = np.random.default_rng(0)
    sums, _, data = world(rng, 3, 5)
    x = np.concatenate([x for x, _ in data])
    y = np.concatenate([y for _, y in data])
    own = np.repeat(np.arange(3), 5)
    phi = rng.normal(0, 0.7, (6, 3))
    dense = []
    for p in phi:
        spread, variance = np.exp(p[:2]), np.exp(p[2])
        same = (own[:, None] == own[None, :]).astype(float)
        cov = x @ x.T + same * ((x * spread**2) @ x.T) + variance * np.eye(15)
        value = stats.multivariate_normal.logpdf(y, np.zeros(15), cov)
        value += np.sum(stats.t.logpdf(spread, 4) + p[:2]) + stats.invgamma.logpdf(variance, 2, scale=1.0) + p[2]
        dense.append(value)
    found = marginal(phi, sums)
    np.testing.assert_allclose(found - found[0], np.array(dense) - dense[0], rtol=1e-9, atol=1e-9)


def test_ranks_of_a_fleets_truth_are_uniform():
    """Simulation-based calibration of the fleet model."""
    ranks: dict[str, list[int]] = {"mean": [], "spread": [], "theta": [], "variance": []}
    for seed in range(300):
        rng = np.random.default_rng([5, seed])
        sums, truth, _ = world(rng, 5, 8)
        made = drawn(sums, np.zeros(3), rng, chains=19, draws=30)
        for name, values in ranks.items():
            column = made[name].reshape(19, 30, -1)[:, -1, 0]  # the last of each chain: 19 that are independent
            values.append(int(np.sum(column < np.ravel(truth[name])[0])))
    for name, values in ranks.items():
        counts = np.bincount(values, minlength=20)
        assert stats.chisquare(counts).pvalue > 1e-3, (name, counts)


def fleet(vehicles: int, rows: int, noise: float = 4.0) -> tuple:
    s = driving(*[rows] * vehicles, seed=2)
    rng = np.random.default_rng(3)
    theta = np.array([C_RR, CDA]) + np.array([C_RR_SD, CDA_SD]) * (0.5 + 0.6 * rng.standard_normal((vehicles, 2)))
    car = truck(*(Grouped(jnp.asarray(theta[:, k]), "trip") for k in (0, 1)))
    y = np.asarray(car.predict(s, "battery_power_kw")) + noise * rng.standard_normal(len(s))
    return padded(s, y, len(s)), np.asarray(s.trip), theta


@pytest.mark.slow
def test_nuts_through_the_kernel_agrees_with_the_statistics():
    """The same model, drawn on every row and on sums: means apart by no more than Monte-Carlo error."""
    fit, own, _ = fleet(4, 60)
    line = linear_fit(truck(), tabular(), lambda: [Rows(fit, own, own)], "battery_power_kw", groups=4)
    noise = float(np.median(np.asarray(line.prior.noise)))
    model = Model.of(
        truck(), tabular(), fit, "battery_power_kw", noise=noise, group=own, groups=4, student=False, grows=False
    )
    long = sampled(model, line.values, key=jax.random.key(0), chains=2, draws=400, warm_up=200, noise=noise)
    short = fleet_draws(line, key=jax.random.key(1), chains=4, draws=5000)
    assert short.faults() == []
    assert "sufficient statistics" in short.how
    assert "full likelihood" in long.how
    assert long.quality()["r_hat"] < 1.05
    assert long.divergent == 0
    for name in ("mean", "spread", "theta", "variance"):
        a, b = long.flat(name), short.flat(name)
        error = np.std(a, axis=0) / np.sqrt(150)
        assert np.all(np.abs(a.mean(0) - b.mean(0)) < 4.5 * error), name
        np.testing.assert_allclose(np.std(a, axis=0), np.std(b, axis=0), rtol=0.25)


def test_a_bad_fit_is_not_called_good():
    rng = np.random.default_rng(0)
    good = rng.standard_normal((4, 1000, 1))
    labels = {"coefficient": ["road.c_rr"]}

    def faults(values: np.ndarray, **more) -> str:
        return " | ".join(Draws({"theta": values}, "by hand", {"theta": ("coefficient",)}, labels, **more).faults())

    assert faults(good) == ""
    assert "chains disagree" in faults(good + np.arange(4)[:, None, None])
    assert "too few effective draws" in faults(np.cumsum(good, axis=1) * 0.02 + good * 1e-3)
    assert "diverged" in faults(good, diverging=np.arange(4000).reshape(4, 1000) < 100)
    assert "one chain" in faults(good[:1])
    assert "finite" in faults(np.where(good > 3, np.nan, good))


SURE = ParameterTable((Coefficient("road.c_rr", "1", 0.020, 0.0002, 0.0002, 0.0, 0.1),
                       Coefficient("road.cda_m2", "m²", CDA, CDA_SD, CDA_SD, 0.0, 100.0)))  # fmt: skip


def two_trips(truth: tuple[float, float]) -> tuple[Fit, Clusters]:
    s = driving(150, 140, seed=1)
    y = power_kw(s, np.array(truth)) + 2.0 * np.random.default_rng(1).standard_normal(len(s))
    return padded(s, y, len(s)), cluster_rows(s)


def test_nuts_agrees_with_the_closed_form_of_one_vehicle(tmp_path):
    """Means and spreads of coefficients and noise, apart by no more than Monte-Carlo error.

    The closed form's table is as wide as the noise turns out; its draws are weighed to the model's, which is not. The
    noise of rows of no size does not grow.
    """
    fit, _ = two_trips((0.0203, 5.2))
    line = linear_fit(truck(), SURE, lambda: [Rows(fit, np.zeros(fit.rows, dtype=int))], "battery_power_kw")
    noise = float(line.prior.noise)
    model = Model.of(truck(), SURE, fit, "battery_power_kw", noise=noise, size=np.zeros(fit.rows), student=False)
    long = sampled(model, line.values, key=jax.random.key(0), chains=2, draws=500, noise=noise)
    assert long.faults() == []
    theta, sigma = line.draws(jax.random.key(1), 40_000)
    value, sd = tabular_of(SURE)
    away = np.sum(((theta - value) / sd) ** 2, axis=1)
    log_weight = -0.5 * away * (1.0 - (noise / sigma) ** 2) + theta.shape[1] * np.log(sigma / noise)
    weight = np.exp(log_weight - np.max(log_weight))
    pairs = [*zip(long.flat("theta").T, theta.T, strict=True), (np.sqrt(long.flat("variance")), sigma)]
    for ours, exact in pairs:
        mean = np.average(exact, weights=weight)
        sd = np.sqrt(np.average((exact - mean) ** 2, weights=weight))
        assert abs(np.mean(ours) - mean) < 4.0 * sd / np.sqrt(long.quality()["ess"])
        assert np.std(ours) == pytest.approx(sd, rel=0.1)
    long.write(tmp_path / "posterior.nc")
    assert long.idata().sample_stats["diverging"].shape == (2, 500)


def test_draws_under_a_table_that_is_sure_and_wrong_are_no_good_fit():
    """c_rr held at three times its value drives C_d·A below zero: told, kept in range, not called good."""
    fit, clusters = two_trips((0.0068, 6.1))
    found = calibrated(truck(), SURE, fit, "battery_power_kw", clusters, "nuts", chains=2, draws=500)
    assert np.all(found.fit.values > 0)
    said = " | ".join(found.notes)
    assert "road.c_rr: the log says" in said
    assert "full likelihood" in said, "draws of the closed form would lie outside the range"
    assert not found.good, "at the edge of the range, too, draws are held against what makes them an answer"


DRIFT = {
    "rolling_temperature": {"per_k": (-6e-5, -5e-5, 5e-5)},
    "tyre_warmup": {"excess": (0.4, 0.3, 0.3), "distance_m": (7000.0, 5000.0, 3000.0)},
}  # planted, and the sheet's value and sd


@pytest.mark.slow
def test_rolling_that_drifts_along_the_route_is_held_by_its_posterior(tmp_path):
    """By temperature and as tyres warm up, sampled through the kernel under Student-t noise: what was planted within
    three sds, and a smaller error on trips that were not fitted than of one number for the whole route."""
    planted = {k: {n: v[0] for n, v in p.items()} for k, p in DRIFT.items()}
    log = synthetic_log(seed=11, trips=10, rows_per_trip=100, effects=planted, noise="white", noise_level=0.05)
    files = log.write(tmp_path, truth=False)
    effects = [
        line for k, p in DRIFT.items()
        for line in (f"[effects.{k}]", *(f"{n} = {{ value = {v}, sd = {sd} }}" for n, (_, v, sd) in p.items()))
    ]  # fmt: skip
    drifting = tmp_path / "drifting.toml"
    drifting.write_text("\n".join([files["sheet"].read_text(), *effects, ""]))
    read = read_log([files["log"]])
    split = split_trips(read)
    rmse = {}
    for name, sheet, method in (("constant", files["sheet"], "map"), ("drifting", drifting, "nuts")):
        problem = prepare(split.log, read_sheet(sheet), None)
        train, test = problem.rows(split.train), problem.rows(split.test)
        rows = problem.segments.take(train)
        found = calibrated(
            problem.vehicle, problem.table, padded(rows, problem.measured[train], len(rows)), problem.target,
            cluster_rows(rows), method, noise="student_t", chains=2, draws=150,
        ).fit  # fmt: skip
        off = problem.measured[test] - problem.predict(found.vehicle)[test]
        rmse[name] = float(np.sqrt(np.mean(off**2)))
    told = {c.name: (value, sd) for c, value, sd in zip(found.table.free, found.values, found.sd, strict=True)}
    true = {f"effects.{k}.{n}": v for k, p in planted.items() for n, v in p.items()}
    for name, value in (true | {"road.c_rr": log.vehicle.c_rr}).items():
        assert abs(told[name][0] - value) < 3 * told[name][1]
    assert told["effects.rolling_temperature.per_k"][1] < 0.2 * 5e-5  # the log speaks, not the table
    assert rmse["drifting"] < 0.9 * rmse["constant"]


def test_mass_by_trip_is_the_one_that_was_driven():
    """Trips of known mass on hills, the log's own mass unknown; and by stop where passengers change."""
    s = driving(*[150] * 6, seed=4)
    true = np.array([18e3, 22e3, 25e3, 29e3, 33e3, 20e3])
    s = s.with_channels(
        mass_kg=true[s.trip], grade_rad=np.random.default_rng(0).uniform(-0.03, 0.03, len(s)),
        passengers=np.repeat(np.arange(12.0) % 5, 75),
    )  # fmt: skip
    y = np.asarray(truck().predict(s, "battery_power_kw")) + 2.0 * np.random.default_rng(1).standard_normal(len(s))
    options = {"mass_kg": 24e3, "sd_kg": 6e3}
    found = mass_posterior(truck(), tabular(), s, y, "battery_power_kw", **options)
    assert np.median(np.abs(found.mass_kg / true - 1)) < 0.02
    assert np.all(np.abs(found.mass_kg - true) < 4 * found.sd_kg)
    assert found.notes == []
    assert loads(s).max() == 11
    half = s.take(s.trip < 3)  # as many groups
    by_stop = mass_posterior(truck(), tabular(), half, y[:450], "battery_power_kw", group=loads(half), **options)
    assert np.all(np.abs(by_stop.mass_kg - np.repeat(true[:3], 2)) < 4 * by_stop.sd_kg)
    known = with_sd(tabular(), [C_RR, CDA], [1e-5, 1e-2])
    assert np.all(mass_posterior(truck(), known, s, y, "battery_power_kw", **options).sd_kg < found.sd_kg)


def test_ranks_that_are_not_uniform_are_told(tmp_path):
    """The study's verdict on made-up ranks: even ones pass, those of intervals that are too narrow do not."""
    raw = resolve(CONFIGS / "studies" / "ranks.toml")
    config = typed(ranks.Config, raw, "ranks.toml")
    task = {"kind": "NUTS"}
    even = [int(k) for k in np.random.default_rng(0).integers(0, 20, 300)]
    narrow = [0 if k < 7 else 19 if k > 12 else k for k in even]
    for values, met in ((even, True), (narrow, False)):
        with open_run(tmp_path / str(met), {"a": 1}) as run:
            found = ranks.collect(config, [(task, {"c_rr": values})], run)
        assert (not found["missed"]) is met
        assert found["rows"][0]["ours"]["worlds"] == 300


def test_worlds_are_drawn_from_the_closed_forms_prior():
    """The generator's noise and coefficients against draws of the posterior of no rows."""
    table = ranks.paper_table(ranks.C_RR, ranks.CDA)
    rng = np.random.default_rng(0)
    worlds = [ranks._world(rng, table, conjugate=True) for _ in range(4000)]
    value, sd = tabular_of(table)
    nothing = posterior(Prior.of_table(np.zeros(2), np.ones(2), ranks.NOISE_WH), Statistics.zero(2))
    theta, sigma = nothing.draws(jax.random.key(0), 40_000)
    made = np.array([(w - value) / sd for w, _ in worlds])
    assert stats.ks_2samp(np.sqrt([v for _, v in worlds]), np.asarray(sigma)).pvalue > 0.001
    for k in range(2):
        assert stats.ks_2samp(made[:, k], np.asarray(theta)[:, k]).pvalue > 0.001
