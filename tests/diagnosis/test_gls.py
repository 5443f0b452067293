"""Generalised least squares: where candidates are scored from, and what the final model takes from it."""

from dataclasses import replace
from functools import cache

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from planted import declared, found_in_turn, opened, training
from scipy import optimize

from hdev_jax.diagnosis.competition.needed import model_without
from hdev_jax.diagnosis.competition.refit import as_reported
from hdev_jax.diagnosis.competition.state import State
from hdev_jax.diagnosis.scores.gls import generalised
from hdev_jax.diagnosis.scores.passes import distance_from_table, evidence_of
from hdev_jax.diagnosis.scores.scores import score_all, scored
from hdev_jax.diagnosis.training import Training
from hdev_jax.inference import jacobian

SEEDS = range(40, 43)


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory):
    """Of a seed and a kind of noise: a log that lacks nothing, its rows, the fit, and the truth's coefficients."""

    @cache
    def of(seed: int, noise: str = "ar1"):
        options = {"seed": seed, "trips": 10, "rows_per_trip": 120, "noise": noise, "noise_level": 0.1}
        synthetic, problem, _ = opened(tmp_path_factory.mktemp("log"), **options)
        rows = training(problem)
        fit = declared(rows, problem).fit
        true = np.array([getattr(synthetic.vehicle, c.path.rpartition(".")[2]) for c in fit.table.free])
        return rows, fit, true

    return of


def test_whitened_rows_know_coefficients_better_than_rows_of_equal_weight(calibrated):
    plain, white = [], []
    for seed in SEEDS:
        rows, fit, true = calibrated(seed)
        known, covariance = generalised(rows.baseline(fit))
        error = np.sqrt(np.diag(covariance))
        assert np.all(error < fit.sd)
        plain.append((fit.values - true) / true)
        white.append((known.values - true) / true)
        assert np.all(np.abs(known.values - true) < 5 * error + 1e-3 * np.abs(true))
    assert np.mean(np.square(white)) < 0.5 * np.mean(np.square(plain))


def test_the_final_model_takes_what_whitened_rows_know(calibrated):
    """Declared coefficients come as near to the truth as those of whitened rows, and the covariance says how near;
    where noise is white, equal weights know as much and nothing changes."""
    plain, known = [], []
    for seed in SEEDS:
        rows, fit, true = calibrated(seed)
        found = as_reported(rows, State(fit))
        assert all(c.known for c in found.table.free)
        assert np.all(found.sd < fit.sd)
        np.testing.assert_allclose(np.sqrt(np.diag(found.covariance)), found.sd)
        off = (found.values - true) - np.clip(found.values - true, -1e-3 * true, 1e-3 * true)  # what truth leaves out
        assert off @ np.linalg.solve(found.covariance, off) < 4.0**2
        plain.append((fit.values - true) / true)
        known.append((found.values - true) / true)
    assert np.mean(np.square(known)) < 0.5 * np.mean(np.square(plain))
    rows, fit, _ = calibrated(40, "white")
    assert as_reported(rows, State(fit)) is fit


@pytest.mark.parametrize("sds", [0.0, 6.0])
def test_equal_weights_keep_what_they_contradict(sds, calibrated):
    """Hausman's test: what is missing pulls both, but not to the same place."""
    rows, fit, _ = calibrated(40)
    values = fit.values + sds * fit.sd
    moved = replace(fit, values=values, vehicle=fit.table.insert(fit.vehicle, jnp.asarray(values)))
    assert (as_reported(rows, State(moved)) is moved) == (sds > 0)


def test_no_step_is_left_where_it_ends(calibrated):
    rows, fit, _ = calibrated(41)
    noise = rows.noise(fit)
    known, covariance = generalised(rows.baseline(fit))
    step, _ = evidence_of(rows.baseline(known, noise)).step()
    assert np.all(np.abs(step) < 0.05 * np.sqrt(np.diag(covariance)))


@pytest.mark.parametrize("share", [1.3, 1.6])
def test_beside_a_coefficient_at_its_bound_the_others_are_where_they_are_best(share, calibrated):
    """More than all of the rolling resistance taken off the target: c_rr ends at 0, and drag goes where a search along
    it alone ends."""
    rows, fit, _ = calibrated(42)
    rolling = np.asarray(jacobian(fit.vehicle, fit.table, rows.rows.segments, rows.target)[:, 0]) * fit.values[0]
    rows = replace(rows, rows=eqx.tree_at(lambda r: r.measured, rows.rows, rows.rows.measured - share * rolling))
    start = rows.calibrate(fit.vehicle, fit.table)
    baseline = rows.baseline(start)
    known, covariance = generalised(baseline)
    assert np.all(np.isfinite(covariance))
    assert abs(known.values[0]) < 1e-4

    def cost(drag: float) -> float:
        values = np.array([known.values[0], drag])
        here = replace(start, values=values, vehicle=start.table.insert(start.vehicle, jnp.asarray(values)))
        moved, sd = distance_from_table(here)
        return evidence_of(replace(baseline, fit=here)).misfit() + 0.5 * float(np.sum((moved / sd) ** 2))

    error = float(np.sqrt(covariance[1, 1]))
    best = optimize.minimize_scalar(cost, bracket=(known.values[1] - error, known.values[1] + error)).x
    assert abs(known.values[1] - best) < 0.1 * error


def test_a_fit_of_nothing_stays_as_it_is(calibrated):
    rows, fit, _ = calibrated(41)
    table = fit.table.with_free(**{c.name: False for c in fit.table.free})
    held = replace(fit, table=table, values=np.zeros(0), sd=np.zeros(0), covariance=np.zeros((0, 0)))
    known, covariance = generalised(rows.baseline(held, rows.noise(fit)))
    assert known is held
    assert covariance.shape == (0, 0)


def test_the_noise_of_a_fit_is_estimated_once(calibrated):
    """The last fit's is kept; another fit has its own, and the first one's comes to the same numbers again."""
    rows, fit, _ = calibrated(40)
    other = replace(fit, predicted=fit.predicted + 100.0)
    first = rows.noise(fit)
    assert rows.noise(fit) is first
    assert rows.noise(other).scales[0] > first.scales[0]
    np.testing.assert_array_equal(rows.noise(fit).scales, first.scales)


LIKELY = ("standstill_load", "rotating_mass", "headwind", "auxiliary_power")


PLANTED = ("standstill_load", "rotating_mass")


@pytest.fixture(scope="module")
def both(tmp_path_factory) -> tuple[Training, State]:
    """A log with a load at standstill and a rotating mass, and the state in which both were found."""
    options = {"effects": {k: {} for k in PLANTED}, "ratio": 1.5}
    _, problem, _ = opened(tmp_path_factory.mktemp("log"), seed=45, trips=10, **options)
    rows = training(problem, LIKELY)
    return rows, found_in_turn(rows, problem, PLANTED)


@pytest.mark.parametrize("out", PLANTED)
def test_a_model_without_an_effect_scores_as_one_that_never_had_it(out, both):
    """Columns moved and put back against a fresh pass over the rows of the model that lacks it. Both effects are linear
    in their sizes but for rows where the machine turns from motoring to generating; one noise for both."""
    rows, state = both
    baseline, f = rows.baseline(state.fit), next(f for f in state.found if f.id == out)
    asked = model_without(evidence_of(baseline), state.fit, f)
    kept = np.array([not c.path.startswith(f"effects.{out}.") for c in state.fit.table.free])
    never = replace(
        state.fit, vehicle=state.fit.vehicle.minus(out), table=state.fit.table.minus(out),
        values=state.fit.values[kept], sd=state.fit.sd[kept], covariance=state.fit.covariance[np.ix_(kept, kept)],
    )  # fmt: skip
    source = score_all(rows, never).source
    fresh = scored(replace(baseline, fit=never), source, rows.settings).white
    own = next(c for c in source.candidates if c.id == out and c.sizes == asked.own.sizes)
    one, other = asked.evidence.score(asked.own), fresh.score(own)
    np.testing.assert_allclose(one.beta, other.beta, rtol=2e-3)
    assert one.gain == pytest.approx(other.gain, rel=2e-3)
    assert one.left_out_gain == pytest.approx(other.left_out_gain, rel=5e-3)
    assert one.p_cluster == pytest.approx(other.p_cluster, rel=2e-2)
    assert one.left == pytest.approx(other.left, rel=2e-3)
