"""The recursive estimate: the batch posterior by another way, and what a stream does to it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from online_rows import CHANNELS, NOISE_KW, begun, dense, drive, sheet, vectors

from hdev_jax.errors import InputError
from hdev_jax.inference.linear import Prior, posterior, statistics
from hdev_jax.online import packed, scan, stacked, start, update
from hdev_jax.online.update import expected

LENGTHS = (40, 30, 30)  # every test has logs of these lengths: one compiled scan
STEP = jax.jit(update)


@pytest.fixture(scope="module")
def log():
    return drive(*LENGTHS)


@pytest.fixture(scope="module")
def plain():
    return begun()


def columns(state, rows):
    """x and r of every row at the tabular values, by the kernel."""
    y = rows[:, state.form.columns.index("measured")]
    base, x = jax.jit(jax.vmap(lambda row: expected(state, jnp.zeros(state.form.size), row)))(rows)
    return np.asarray(x), y - np.asarray(base)


def test_without_forgetting_it_is_the_batch_posterior(log, plain):
    segments, y = log
    rows = vectors(plain.form, segments, y)
    end, now = scan(plain, rows)
    x, r = columns(plain, rows)
    batch = posterior(Prior.of_table(np.zeros(2), np.ones(2), NOISE_KW), statistics(x, r, y, np.ones(len(y))))
    mean, covariance = end.steps
    np.testing.assert_allclose(mean, batch.mean, rtol=1e-9)
    np.testing.assert_allclose(covariance, NOISE_KW**2 * np.linalg.inv(batch.precision), rtol=1e-8)
    np.testing.assert_allclose(now.values[-1], end.values)
    assert end.counted() == {"rows": 100, "used": 100, "trips": 3}


def test_rows_one_by_one_are_the_scan_and_one_program_serves_all(log, plain):
    segments, y = log
    rows = vectors(plain.form, segments, y)
    rows[17, plain.form.columns.index("grade_rad")] = np.nan
    rows[50] = np.nan
    end, now = scan(plain, rows)
    STEP.clear_cache()
    state, told = plain, []
    for row in rows:
        state, at = STEP(state, row)
        told.append(at.predicted)
    np.testing.assert_allclose(np.array(told), now.predicted, rtol=1e-12)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-12), state, end)
    assert STEP._cache_size() == 1


def test_correlated_errors_and_what_each_trip_has_anew_are_one_large_least_squares():
    """Against a dense covariance of AR(1) errors, with a column of its own for each trip's load."""
    rho = 0.8
    of = sheet(battery={"auxiliary_w": (0.0, 3000.0)})
    state = begun(sheet=of, memories=(rho,), by_trip=("battery.auxiliary_w",))
    segments, y = drive(*LENGTHS, rho=rho)
    trip = np.asarray(segments.trip)
    y = y + np.array([2.0, -3.0, 1.0])[trip]  # kW
    rows = vectors(state.form, segments, y)
    end, _ = scan(state, rows)
    x, r = columns(state, rows)
    load = state.form.names.index("battery.auxiliary_w")
    rest = [k for k in range(3) if k != load]
    wide = np.concatenate([x[:, rest], x[:, [load]] * (trip[:, None] == np.arange(3))], axis=1)
    apart = np.abs(np.subtract.outer(np.arange(len(y)), np.arange(len(y))))
    errors = np.where(trip[:, None] == trip[None, :], rho**apart, 0.0) * NOISE_KW**2 / (1 - rho**2)
    mean, covariance = dense(wide, r, np.ones(5), errors)
    got, spread = end.steps
    np.testing.assert_allclose(got[jnp.array(rest)], mean[:2], rtol=1e-7)
    np.testing.assert_allclose(got[load], mean[4], rtol=1e-7)  # of the trip that goes on
    np.testing.assert_allclose(np.sqrt(np.diag(spread))[rest], np.sqrt(np.diag(covariance))[:2], rtol=1e-7)


def test_noise_and_its_correlation_are_estimated():
    segments, y = drive(400, 300, 300, rho=0.9, noise=2.0, seed=2)
    state = start(sheet(), CHANNELS, "battery_power_kw")[0]
    end, now = scan(state, vectors(state.form, segments, y))
    assert 0.85 <= float(end.memory) <= 0.95
    assert float(end.sigma) == pytest.approx(2.0 / np.sqrt(1 - 0.81), rel=0.3)
    inside = (np.asarray(now.lower) <= y) & (y <= np.asarray(now.upper))
    assert 0.87 <= np.mean(inside[20:]) <= 0.97
    assert np.all(np.abs((np.asarray(end.values) - [0.0068, 5.2]) / np.asarray(end.sd)) < 3.0)


def test_faults_of_a_stream_are_survived_and_counted(log):
    segments, y = log
    state = begun(robust=True)
    good = vectors(state.form, segments, y)
    at = {c: i for i, c in enumerate(state.form.columns)}
    rows = good.copy()
    rows[10, at["measured"]] = np.nan
    rows[12, at["mass_kg"]] = np.nan
    rows[14, at["speed_end_mps"]] = np.nan
    rows[16, at["speed_end_mps"]] = 400.0
    rows[18, at["distance_m"]] = np.nan
    rows[20, at["measured"]] = 1.9e4
    rows[22:40, at["time_s"]] += 3600.0
    rows[30:40, at["time_s"]] -= 7200.0
    rows[45, at["trip"]] = np.nan
    end, now = scan(state, rows)
    assert end.counted() == {
        "rows": 100, "used": 96, "unusable": 3, "unmeasured": 1, "outliers": 1, "gaps": 1, "clock_jumps": 1, "trips": 3,
        "held mass_kg": 1, "held distance_m": 1,
    }  # fmt: skip
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves((end.sums, end.mean, end.covariance, end.last)))
    assert np.flatnonzero(np.isnan(now.predicted)).tolist() == [14, 16, 45]
    assert float(now.weight[20]) < 1e-6
    clean = scan(state, good)[0]
    assert np.all(np.abs(np.asarray(end.values - clean.values) / np.asarray(clean.sd)) < 0.5)


@pytest.mark.parametrize("first", [0, 60])
def test_charging_is_no_drive(log, first):
    """Half an hour at a charger, before the first drive or between two stretches: it changes nothing and is counted."""
    segments, y = log
    state = begun(robust=True, noise=None)
    good = vectors(state.form, segments, y)[:70]
    at = {c: i for i, c in enumerate(state.form.columns)}
    stands = np.repeat(good[first : first + 1], 30, axis=0)
    stands[:, [at["speed_start_mps"], at["speed_end_mps"], at["distance_m"]]] = 0.0
    stands[:, at["measured"]] = -60.0 + np.random.default_rng(0).normal(size=30)
    loads = stands.copy()
    loads[:, at["measured"]] = NOISE_KW * np.random.default_rng(1).normal(size=30)  # some of it is negative
    rows = [np.concatenate([good[:first], s, good[first:]]) for s in (stands, loads)]
    nothing = np.full_like(stands, np.nan)  # so that all have one length
    end, clean = (scan(state, r)[0] for r in (rows[0], np.concatenate([good, nothing])))
    assert (end.counted()["charging"], end.counted()["used"]) == (30, len(good))
    np.testing.assert_allclose(end.values, clean.values, rtol=1e-5)  # the noise is iterated at every row
    assert float(end.driven_s) == float(clean.driven_s)
    if first:  # once the noise is known
        assert "charging" not in scan(state, rows[1])[0].counted()


def test_what_a_steady_drive_does_not_excite_stays_while_the_rest_is_followed(log):
    """An hour and a half at constant speed after a mixed drive, with coefficients that wander: openpilot's drift."""
    state = begun(drift={"road.c_rr": 5e-4, "road.cda_m2": 0.3})
    segments, y = log
    mixed, _ = scan(state, vectors(state.form, segments, y))
    steady = np.tile(vectors(state.form, segments, y)[-1], (100, 1))
    at = {c: i for i, c in enumerate(state.form.columns)}
    steady[:, at["trip"]], steady[:, at["grade_rad"]] = 7.0, 0.015
    steady[:, at["duration_s"]] = 54.0
    steady[:, at["speed_start_mps"]] = steady[:, at["speed_end_mps"]] = 22.0
    steady[:, at["distance_m"]] = 22.0 * 54.0
    steady[:, at["time_s"]] = 54.0 * np.arange(100)
    base, x = jax.jit(expected)(mixed, jnp.zeros(2), jnp.asarray(steady[0]))
    x, q = np.asarray(x), np.asarray(state.drift) ** 2
    unseen = np.array([q[1] * x[1], -q[0] * x[0]])  # v·Qx = 0
    rng = np.random.default_rng(3)
    # the road has become rougher than it was: the drive sees that something changed, and not which of the two
    steady[:, at["measured"]] = float(base) + 2.0 * NOISE_KW + NOISE_KW * rng.normal(size=100)
    end, _ = scan(mixed, steady)

    def of(state, v):
        mean, covariance = state.steps
        return float(v @ mean), float(np.sqrt(v @ np.asarray(covariance) @ v))

    (seen, _), (other, before), (still, after) = of(end, x), of(mixed, unseen), of(end, unseen)
    assert seen == pytest.approx(2.0 * NOISE_KW, abs=0.25 * NOISE_KW)
    assert after <= 1.02 * before
    assert abs(still - other) < before
    walked = begun()
    frozen, _ = scan(scan(walked, vectors(state.form, segments, y))[0], steady)
    assert abs(of(frozen, x)[0] - 2.0 * NOISE_KW) > 2.0 * abs(seen - 2.0 * NOISE_KW)  # without drift it lags behind


def test_many_vehicles_at_once_are_each_alone(log, plain):
    segments, y = log
    rows = vectors(plain.form, segments, y)[:3]
    states = stacked([plain, scan(plain, vectors(plain.form, segments, y))[0]])
    both, now = jax.jit(jax.vmap(update))(states, jnp.asarray(rows[:2]))
    for k in range(2):
        alone, at = STEP(jax.tree.map(lambda leaf, k=k: leaf[k], states), rows[k])
        np.testing.assert_allclose(both.mean[k], alone.mean, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(now.predicted[k], at.predicted, rtol=1e-12)
    with pytest.raises(ValueError, match="one form"):
        stacked([plain, begun(memories=(0.5,))])


def test_what_cannot_be_followed_is_said():
    with pytest.raises(InputError, match="nothing to estimate; give a coefficient in use a value with an sd"):
        start(sheet(road={"c_rr": 0.006, "cda_m2": 5.6}), CHANNELS)
    with pytest.raises(InputError, match=r"drift: road\.crr is no coefficient that is estimated; accepted: road\.c_rr"):
        start(sheet(), CHANNELS, drift={"road.crr": 1e-4})
    with pytest.raises(ValueError, match="memories"):
        start(sheet(), CHANNELS, memories=(1.0,))
    with pytest.raises(ValueError, match="level"):
        start(sheet(), CHANNELS, level=90.0)
    with jax.enable_x64(False), pytest.raises(InputError, match="need double precision: call jax"):
        start(sheet(), CHANNELS)
    with pytest.raises(InputError, match=r"unknown column 'speed'; accepted: trip, time_s"):
        packed(begun().form, {"speed": 3.0})
    _, notes = start(sheet(effects={"time_skew": {"skew_s": 0.3}}), CHANNELS)
    assert any("time_skew of the sheet is skipped: it acts across rows" in n for n in notes)
