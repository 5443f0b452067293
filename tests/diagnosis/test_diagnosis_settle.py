"""Where candidates are scored from, what is known of a size, and how many trips would tell."""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import optimize, stats

from hdev_jax.diagnosis.competition.refit import _contradicted, as_known
from hdev_jax.diagnosis.remainder.unexplained import Remainder
from hdev_jax.diagnosis.result.summary import _not_decidable, _sized
from hdev_jax.diagnosis.scores import look as looks
from hdev_jax.diagnosis.scores.look import Verdict
from hdev_jax.diagnosis.scores.settle import settle
from hdev_jax.diagnosis.scores.significance import clusters_needed, clusters_to_tell, effective_number, ruled_out
from hdev_jax.diagnosis.scores.sums import Sums, distance_from_table, evidence_of
from hdev_jax.fleet import synthetic_log
from hdev_jax.inference import calibrate, cluster_rows, jacobian, padded
from hdev_jax.inference.sheet import read_sheet
from hdev_jax.logs import read_log
from hdev_jax.physics import LIBRARY
from hdev_jax.problem import prepare


def calibrated(folder, seed: int, noise: str = "ar1"):
    """A log with slow noise and nothing missing, its loop, and the truth's values of what is calibrated."""
    log = synthetic_log(seed=seed, trips=10, rows_per_trip=120, noise=noise, ar_coefficient=0.97, noise_level=0.1)
    files = log.write(folder / f"{noise}{seed}", truth=False)
    problem = prepare(read_log([files["log"]]), read_sheet(files["sheet"]))
    rows, clusters = padded(problem.segments, problem.measured), cluster_rows(problem.segments)
    fit = calibrate(problem.vehicle, problem.table, rows, problem.target, clusters)
    loop = looks.Loop(rows, problem.target, clusters, (), 0.05, np.random.default_rng(0), 4)
    true = np.array([getattr(log.vehicle, c.path.rpartition(".")[2]) for c in fit.table.free])
    return loop, fit, true


def test_whitened_rows_know_coefficients_better_than_plain_ones(tmp_path):
    plain, white = [], []
    for seed in range(6):
        loop, fit, true = calibrated(tmp_path, seed)
        settled, covariance = settle(loop.ground(fit, loop.noise(fit)))
        error = np.sqrt(np.diag(covariance))
        assert np.all(error < fit.sd)
        plain.append((fit.values - true) / true)
        white.append((settled.values - true) / true)
        assert np.all(np.abs(settled.values - true) < 5 * error + 1e-3 * np.abs(true))
    assert np.mean(np.square(white)) < 0.5 * np.mean(np.square(plain))


def ended(loop, fit):
    """Where a search ends that has found nothing."""
    return looks.Search(fit.vehicle, fit.table, fit, finished=True)


def test_the_final_model_takes_what_whitened_rows_know(tmp_path):
    """Declared coefficients come as near to the truth as those of whitened rows, and the covariance says how near;
    where noise is white, equal weights know as much and nothing changes."""
    plain, known = [], []
    for seed in range(6):
        loop, fit, true = calibrated(tmp_path, seed)
        found = as_known(loop, ended(loop, fit))
        assert all(c.told for c in found.table.free)
        assert np.all(found.sd < 0.5 * fit.sd)
        np.testing.assert_allclose(np.sqrt(np.diag(found.covariance)), found.sd)
        off = (found.values - true) - 1e-3 * np.clip((found.values - true) / 1e-3, -true, true)  # what truth leaves out
        assert off @ np.linalg.solve(found.covariance, off) < 4.0**2
        plain.append((fit.values - true) / true)
        known.append((found.values - true) / true)
    assert np.mean(np.square(known)) < 0.25 * np.mean(np.square(plain))
    loop, fit, _ = calibrated(tmp_path, 0, noise="white")
    assert as_known(loop, ended(loop, fit)) is fit


@pytest.mark.parametrize("sds", [0.0, 6.0])
def test_equal_weights_keep_what_they_contradict(tmp_path, sds):
    """A specification test: what is missing pulls both, but not to the same place."""
    loop, fit, _ = calibrated(tmp_path, 0)
    values = fit.values + sds * fit.sd
    moved = replace(fit, values=values, vehicle=fit.table.insert(fit.vehicle, jnp.asarray(values)))
    assert (as_known(loop, ended(loop, moved)) is moved) == (sds > 0)


def test_where_it_settles_no_step_is_left(tmp_path):
    loop, fit, _ = calibrated(tmp_path, 1)
    noise = loop.noise(fit)
    settled, covariance = settle(loop.ground(fit, noise))
    step, _ = evidence_of(loop.ground(settled, noise)).step()
    assert np.all(np.abs(step) < 0.05 * np.sqrt(np.diag(covariance)))
    assert np.all(np.isfinite(settled.predicted))


@pytest.mark.parametrize("share", [1.3, 1.6])
def test_beside_a_coefficient_at_its_bound_the_others_settle(tmp_path, share):
    """More than all of the rolling resistance taken off the target: c_rr ends at 0, and drag goes where it is best
    beside that, as a search along it alone finds."""
    loop, fit, _ = calibrated(tmp_path, 2)
    rolling = np.asarray(jacobian(fit.vehicle, fit.table, loop.rows.segments, loop.target)[:, 0]) * fit.values[0]
    rows = eqx.tree_at(lambda r: r.measured, loop.rows, loop.rows.measured - share * rolling)
    loop = replace(loop, rows=rows)
    start = calibrate(fit.vehicle, fit.table, rows, loop.target, loop.clusters)
    ground = loop.ground(start, loop.noise(start))
    settled, covariance = settle(ground)
    assert np.all(np.isfinite(covariance))
    assert abs(settled.values[0]) < 1e-4

    def cost(drag: float) -> float:
        values = np.array([settled.values[0], drag])
        here = replace(start, values=values, vehicle=start.table.insert(start.vehicle, jnp.asarray(values)))
        moved, sd = distance_from_table(here)
        return evidence_of(replace(ground, fit=here)).misfit() + 0.5 * float(np.sum((moved / sd) ** 2))

    error = float(np.sqrt(covariance[1, 1]))
    best = optimize.minimize_scalar(cost, bracket=(settled.values[1] - error, settled.values[1] + error)).x
    assert abs(settled.values[1] - best) < 0.1 * error


def test_evidence_from_elsewhere_and_with_some_held():
    """Against the rows themselves."""
    rng = np.random.default_rng(0)
    ids, x, y = np.repeat(np.arange(8), 50), rng.normal(size=(400, 3)), rng.normal(size=400)
    level, at, sd = rng.normal(size=400), np.array([0.5, -2.0, 0.0]), np.array([1.0, 2.0, 3.0])
    slices = [slice(50 * k, 50 * k + 50) for k in range(8)]

    def evidence(x, y, moved, sd):
        sums = Sums(x.shape[1] + 1, 8, 8)
        sums.add(np.c_[x, y], ids)
        sums.add_levels(np.c_[x, y], level, ids, slices)
        return sums.evidence(x.shape[1], moved=moved, prior_sd=sd, level_sd=0.7)

    base = evidence(x, y, np.array([0.1, 0.2, 0.3]), sd)
    there = evidence(x, y - x @ at, np.array([0.1, 0.2, 0.3]) + at, sd)
    for name in ("grams", "levels", "pull"):
        np.testing.assert_allclose(getattr(base.moved(at), name), getattr(there, name), rtol=1e-9, atol=1e-9)
    held = np.array([False, True, False])
    fewer = evidence(x[:, ~held], y, np.array([0.1, 0.3]), sd[~held])
    for got, expected in zip(base.holding(held).step(), fewer.step(), strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-9)


def test_a_fit_of_nothing_settles_as_it_is(tmp_path):
    loop, fit, _ = calibrated(tmp_path, 1)
    table = fit.table.with_free(**{c.name: False for c in fit.table.free})
    held = replace(fit, table=table, values=np.zeros(0), sd=np.zeros(0), covariance=np.zeros((0, 0)))
    settled, covariance = settle(loop.ground(held, loop.noise(fit)))
    assert settled is held
    assert covariance.shape == (0, 0)


def test_what_one_cluster_tells_is_no_better_known_than_its_rows_allow():
    """The jackknife sees no spread where all clusters but one are silent about a column."""
    rng = np.random.default_rng(0)
    ids = np.repeat(np.arange(8), 50)
    column = np.where(ids == 3, rng.normal(size=400), 1e-9 * rng.normal(size=400))
    sums = Sums(2, 8, 8)
    sums.add(np.c_[column, 2.0 * column + rng.normal(size=400)], ids)
    _, covariance = sums.evidence(1, moved=np.zeros(1), prior_sd=np.array([1e3])).step()
    assert covariance[0, 0] >= 0.98 / np.sum(column**2)


@pytest.mark.parametrize("k", [1, 2])
@pytest.mark.parametrize("p", [0.2, 0.01])
def test_as_many_clusters_as_are_needed_and_no_more(k, p):
    n = clusters_needed(p, k, 9, 1e-3)
    assert n is not None
    assert n > 9
    statistic = stats.f.isf(p, k, 9 - k)

    def at(m: int) -> float:
        return float(stats.f.sf(statistic * m / 9, k, m - k))

    assert at(n) <= 1e-3 < at(n - 1)


def test_what_nothing_hints_at_is_out_of_reach():
    assert clusters_needed(0.9, 1, 9, 1e-3) is None
    assert clusters_needed(0.01, 2, 3, 1e-3) is None


@pytest.mark.parametrize("clusters", [4, 8, 24])
def test_the_interval_covers_what_it_says(clusters):
    rng = np.random.default_rng(clusters)
    hits = 0
    for _ in range(2000):
        x = rng.normal(size=clusters)
        low, high = _sized(float(np.mean(x)), float(np.std(x, ddof=1) / np.sqrt(clusters)), clusters)["interval_90"]
        hits += low <= 0.0 <= high
    assert hits / 2000 == pytest.approx(0.90, abs=0.02)


def test_ways_that_are_alike_are_one_test():
    rng = np.random.default_rng(0)
    apart = rng.normal(size=(4000, 6))
    alike = apart[:, :1] + 0.01 * rng.normal(size=(4000, 6))
    assert effective_number(apart.T @ apart) == pytest.approx(6.0, abs=0.1)
    assert effective_number(alike.T @ alike) == pytest.approx(1.0, abs=0.1)
    assert 3.0 < effective_number((half := np.c_[apart[:, :3], alike[:, :3]]).T @ half) < 5.0
    assert effective_number(np.ones((1, 1))) == 1.0


@pytest.mark.parametrize(("white", "against"), [(-0.01, True), (0.01, True), (0.08, False), (0.3, False)])
def test_a_slow_size_of_which_the_rows_rule_out_a_quarter_is_contradicted(white, against):
    assert _contradicted(np.array([0.34]), np.array([white]), np.array([0.009])) is against
    assert not _contradicted(np.array([0.34]), np.array([-0.01]), np.array([0.1]))  # they could not have seen it


def test_enough_clusters_tell_half_of_what_they_differ_by():
    """By simulation: as many as are said find it in about half of the logs (the median F), far fewer do not."""
    n = clusters_to_tell(0.5, 1, 1e-3)
    assert n is not None
    rng = np.random.default_rng(0)

    def found(count: int) -> float:
        x, e = rng.standard_normal((2, 4000, count))
        r = np.array([np.corrcoef(a, a + b)[0, 1] for a, b in zip(x, e, strict=True)])
        return float(np.mean(stats.f.sf(r**2 / (1 - r**2) * (count - 2), 1, count - 2) <= 1e-3))

    assert found(n) == pytest.approx(0.5, abs=0.1)
    assert found(n // 2) < 0.25
    assert clusters_to_tell(0.5, 1, 1e-6) > n
    assert clusters_to_tell(1e-6, 1, 1e-3) is None


def test_what_would_show_by_now_is_ruled_out():
    """By simulation: of logs in which it holds half of what trips differ by, one in twenty says that it does not."""
    rng, count, n = np.random.default_rng(1), 8, 2000
    x, e = rng.standard_normal((2, n, count))
    r = np.array([np.corrcoef(a, a + b)[0, 1] for a, b in zip(x, e, strict=True)])
    p = stats.f.sf(r**2 / (1 - r**2) * (count - 2), 1, count - 2)
    out = float(np.mean([ruled_out(0.5, float(v), 1, count) for v in p]))
    assert 0.02 < out < 0.09
    assert ruled_out(0.5, 0.5, 1, 40)
    assert not ruled_out(0.5, 0.5, 1, 6)
    assert not ruled_out(0.5, 0.9, 2, 3)


@pytest.mark.parametrize("kind", ["trip", "block"])
def test_only_trips_tell_what_lives_between_them(tmp_path, kind):
    """A load that a log of few trips with levels of their own neither shows nor rules out; stretches of a trip, which
    share its level, are no trips."""
    loop, fit, _ = calibrated(tmp_path, 3, noise="trip_levels")
    loop = replace(
        loop, effects=[LIBRARY["hvac_power"], LIBRARY["headwind"]], clusters=replace(loop.clusters, kind=kind)
    )
    view = looks.look(loop, ended(loop, fit))
    score = replace(view.best["hvac_power"], p_model=0.3, p_cluster=0.3)
    score = replace(score, beta=np.full(len(score.beta), 300.0))
    view.best["hvac_power"] = score
    view.q["hvac_power"] = 1.0
    view.slow = np.ones_like(view.slow)
    needed = view._needed(score, 0.05)
    assert (needed is None) == (kind == "block")
    assert kind == "block" or needed > loop.clusters.count
    assert view._needed(replace(score, beta=-score.beta), 0.05) is None
    view.slow = np.zeros_like(view.slow)
    assert view._needed(score, 0.05) is None


def test_between_trips_a_log_knows_no_more_than_it_has_trips():
    left = Remainder(False, 0.1, 1.0, (), "", 0.0, np.zeros(3), trips_differ=True)  # suspected is enough
    hinted = Verdict("hvac_power", 2.0, 1.0, "not significant", needed=40, between=True)
    inside = Verdict("headwind", 2.0, 1.0, "not significant", needed=30)
    strong = Verdict("wet_road", 20.0, 0.2, "too few trips", needed=50)
    rows_alone = Verdict("regen_limit", 90.0, 1.0, "too few trips", needed=110, by_rows=True)
    others = [Verdict(f"effect_{k}", 0.1, 1.0, "not significant", needed=45 + k, between=True) for k in range(4)]
    every = [inside, *others, rows_alone, strong, hinted]
    said = [(s["id"], s["clusters_needed"]) for s in _not_decidable(every, left)]
    assert said == [
        ("wet_road", 50),
        ("regen_limit", 110),
        ("hvac_power", 40),
        *((f"effect_{k}", 45 + k) for k in range(4)),
    ]
    assert [s["id"] for s in _not_decidable(every, replace(left, trips_differ=False))] == ["wet_road", "regen_limit"]
