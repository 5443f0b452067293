"""Loads that switch, decoded from made-up residuals whose states are known."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import signal

from hdev_jax.inference.states import (
    StateRows,
    Switching,
    contrasts,
    decode,
    energy_draws,
    errors_alone,
    fit_switching,
    rows_of,
    shares_of,
    what_it_depends_on,
)
from hdev_jax.inference.states.chances import _Moves
from hdev_jax.physics.states import COVARIATES, SwitchingLoad, expected_share
from hdev_jax.segments import Segments

TRIPS, SECONDS, MORE = 6, 1000, 1800  # of a trip; more of two loads, or of long rows


def residual(powers, *, seconds=SECONDS, row_s=1.0, noise_w=1500.0, kept=0.5, base_w=-2000.0):
    """Rows with on/off loads: their residual, and the share of each row that each load is on."""
    rng, per, shares, dwell_s = np.random.default_rng(0), int(row_s), (0.3, 0.45), 90.0
    on = np.zeros((TRIPS * seconds, len(powers)))
    for trip in range(TRIPS):
        for k, share in zip(range(len(powers)), shares, strict=False):
            t, state = 0, rng.random() < share
            while t < seconds:
                length = max(1, round(rng.exponential(dwell_s if state else dwell_s * (1 - share) / share)))
                on[trip * seconds + t : trip * seconds + min(t + length, seconds), k] = state
                t, state = t + length, not state
    on = on.reshape(-1, per, len(powers)).mean(axis=1)
    n = len(on)
    error = signal.lfilter([np.sqrt(1 - kept**2)], [1.0, -kept], rng.normal(0.0, noise_w, n))
    trip = np.repeat(np.arange(TRIPS), n // TRIPS)
    rows = StateRows(
        base_w + on @ np.asarray(powers) + error, trip, np.full(n, row_s), np.full(n, 15.0), np.zeros(n, int),
        0.1 if row_s < 2 else 0.9,
    )  # fmt: skip
    return rows, on


def start(*powers, base_w=0.0):
    n = len(powers)
    return Switching(np.array(powers), base_w, np.full(2, 2000.0), np.full((n, 4), 0.4), np.full(n, 60.0))


@pytest.mark.parametrize(
    ("powers", "row_s", "seconds"),
    [((6000.0,), 1.0, SECONDS), ((8000.0, 20000.0), 1.0, MORE), ((8000.0,), 10.0, MORE)],
)
def test_powers_shares_and_states_come_back(powers, row_s, seconds):
    rows, on = residual(powers, row_s=row_s, seconds=seconds)
    model, decoded = fit_switching(start(*(0.7 * p for p in powers)), rows, 12)
    np.testing.assert_allclose(model.power_w, powers, rtol=0.08)
    np.testing.assert_allclose(model.base_w, -2000.0, atol=300.0)
    np.testing.assert_allclose(decoded.on.mean(axis=0), on.mean(axis=0), atol=0.03)
    assert np.mean((decoded.on > 0.5) == (on > 0.5)) > 0.93
    assert abs(np.mean(model.error_s) + row_s / np.log(0.5)) < 0.6 * row_s


def test_expectation_maximisation_never_loses_likelihood():
    rows, _ = residual((6000.0,))
    reached = [fit_switching(start(3000.0), rows, k)[1].log_likelihood for k in (0, 1, 2, 4, 8, 40)]
    assert np.all(np.diff(reached) >= 0.0)
    assert np.all(np.diff(reached)[:3] > 0.0), "rounds go on as long as they gain"
    assert reached[-1] > reached[0] + 100.0
    assert reached[-1] < reached[-2] + 5.0, "and end"


def test_a_long_row_holds_the_share_of_time_that_a_load_is_on():
    rows, on = residual((20000.0,), seconds=MORE, row_s=10.0, noise_w=300.0, kept=0.0)
    model, decoded = fit_switching(start(15000.0), rows, 8)
    partly = (on > 0.05) & (on < 0.95)
    assert partly.sum() > 50
    assert np.mean(np.abs(decoded.on - on)[partly]) < 0.1
    energy, true = (float(np.sum(x) * 10.0 / 3600.0) for x in (decoded.on @ model.power_w, on * 20000.0))
    assert abs(energy - true) < 0.02 * true


def test_one_step_ahead_uses_the_rows_before_alone():
    rows, _ = residual((6000.0,))
    model = start(6000.0, base_w=-2000.0)
    first = decode(model, rows)
    later = rows.residual_w.copy()
    later[500:1000] += 9000.0
    again = decode(model, replace(rows, residual_w=later))
    np.testing.assert_allclose(again.ahead[:501], first.ahead[:501], atol=1e-9)
    np.testing.assert_allclose(again.error_w[:501], first.error_w[:501], atol=1e-6)


def test_trips_are_sequences_of_their_own():
    rows, _ = residual((6000.0,))
    model = start(6000.0, base_w=-2000.0)
    whole = decode(model, rows)
    each = [decode(model, rows.take(rows.trip == t)) for t in range(TRIPS)]
    np.testing.assert_allclose(np.concatenate([d.on for d in each]), whole.on, atol=1e-9)
    assert abs(sum(d.log_likelihood for d in each) - whole.log_likelihood) < 1e-6 * abs(whole.log_likelihood)


def test_energy_drawn_is_about_the_energy_decoded():
    rows, _ = residual((6000.0, 15000.0), seconds=MORE)
    model, decoded = fit_switching(start(6000.0, 15000.0), rows, 6)
    drawn = energy_draws(model, rows, seed=0, draws=30)
    mean = np.stack([(decoded.on[rows.trip == t] * model.power_w).sum(axis=0) / 3600.0 for t in range(TRIPS)], axis=1)
    assert drawn.shape == (30, 2, TRIPS)
    assert np.all(np.abs(drawn.mean(axis=0) - mean) < 5 * drawn.std(axis=0) / np.sqrt(30) + 0.01 * mean + 5.0)


def test_the_share_on_falls_with_temperature_where_it_does():
    rng = np.random.default_rng(1)
    n = 40_000
    temp = np.repeat(rng.uniform(0.0, 30.0, 400), 100)
    on = (rng.random(n) < np.interp(temp, (0, 30), (0.8, 0.0))).astype(float)
    rows = StateRows(np.zeros(n), np.zeros(n, int), np.full(n, 1.0), temp, np.zeros(n, int))
    np.testing.assert_allclose(shares_of(rows, on), (0.8, 0.533, 0.267, 0.005), atol=0.05)


@settings(max_examples=30)
@given(seconds=st.floats(0.5, 60.0), seed=st.integers(0, 50))
def test_means_over_rows_keep_time_and_energy(seconds, seed):
    rng = np.random.default_rng(seed)
    n = 200
    trip = np.sort(rng.integers(0, 3, n))
    rows = StateRows(rng.normal(0, 1e3, n), trip, rng.uniform(0.2, 3.0, n), np.full(n, 15.0), np.zeros(n, int))
    coarse = rows.coarse(seconds)
    for t in np.unique(trip):
        a, b = rows.take(trip == t), coarse.take(coarse.trip == t)
        np.testing.assert_allclose(np.sum(b.duration_s), np.sum(a.duration_s))
        np.testing.assert_allclose(np.sum(b.duration_s * b.residual_w), np.sum(a.duration_s * a.residual_w))


def test_trips_of_one_row_give_numbers():
    rng = np.random.default_rng(0)
    rows = StateRows(
        rng.normal(0, 1e3, 200), np.arange(200), np.full(200, 7.0), np.full(200, 15.0), np.zeros(200, int), energy=True
    )
    model, decoded = fit_switching(start(1000.0), rows, 3)
    assert np.all(np.isfinite(decoded.on))
    assert np.isfinite(decoded.log_likelihood)
    assert np.all(np.isfinite(model.scale_w))


def test_an_energy_has_the_same_error_in_a_row_of_any_length():
    """The same energies as powers of rows as short and as long: their errors are as wide, and decoded alike."""
    rng = np.random.default_rng(3)
    n, seconds = 3600, rng.choice([4.0, 8.0, 16.0], 3600)
    on = (np.cumsum(rng.random(n) < 0.1) % 2).astype(float)
    power = 8000.0 * on + rng.normal(0.0, 2000.0, n) * 10.0 / seconds
    rows = StateRows(
        power, np.repeat(np.arange(TRIPS), n // TRIPS), seconds, np.full(n, 15.0), np.zeros(n, int), energy=True
    )
    right = []
    for each in (rows, replace(rows, energy=False)):
        model, decoded = fit_switching(start(6000.0), each, 6)
        right.append(np.mean((decoded.on[:, 0] > 0.5) == on))
        if each.energy:
            np.testing.assert_allclose(model.scale_w[0], 2000.0, rtol=0.15)
            np.testing.assert_allclose(model.power_w, 8000.0, rtol=0.05)
    assert right[0] > right[1] > 0.7


@pytest.mark.parametrize("value", [0.0, 5000.0])
def test_a_constant_residual_gives_numbers(value):
    n = 1000
    rows = StateRows(np.full(n, value), np.zeros(n, int), np.ones(n), np.full(n, 15.0), np.ones(n, int))
    model, decoded = fit_switching(start(1000.0), rows, 3)
    assert np.all(np.isfinite(decoded.on))
    assert np.all(np.isfinite(model.power_w))
    assert all(np.isfinite(errors_alone(rows)))


def with_covariates(seed, by, trips=10, n=1000):
    """Rows with a load whose log-odds of being on depend on standstill, the trip's start and the state of charge."""
    rng = np.random.default_rng(seed)
    standing = (np.cumsum(rng.random((trips, n)) < 1 / 60, axis=1) % 2).astype(float)
    clock = np.tile(np.arange(float(n)), (trips, 1))
    charge = np.linspace(0.4, -0.3, trips)[:, None] - 1e-5 * clock
    beside = np.stack([standing, np.exp(-clock / 600.0), charge, np.zeros_like(clock)], axis=-1)
    share = 1.0 / (1.0 + np.exp(0.85 - beside @ np.asarray(by)))
    keep, drawn, on = np.exp(-1 / 40.0), rng.random((trips, n)), np.zeros((trips, n))
    for t in range(1, n):
        on[:, t] = drawn[:, t] < keep * on[:, t - 1] + (1 - keep) * share[:, t]
    count = trips * n
    return StateRows(
        6000.0 * on.ravel() + rng.normal(0.0, 1500.0, count), np.repeat(np.arange(trips), n), np.ones(count),
        np.full(count, 15.0), standing.ravel().astype(int), 0.1, beside.reshape(count, -1),
    )  # fmt: skip


# standard errors of log-odds p: 1/√(n·p·(1 − p)), n the time at each over twice the memory
@pytest.mark.parametrize(
    ("by", "error"),
    [((0.0, 0, 0, 0), 0.0), ((3.0, 0, 0, 0), 0.42), ((0, 0, 7.0, 0), 0.8)],
    ids=["nothing", "standstill", "charge"],
)
def test_what_the_chances_depend_on_is_found_and_nothing_else(by, error):
    rows = with_covariates(1, by)
    bare, decoded = fit_switching(start(5000.0), rows, 4)
    model = what_it_depends_on(bare, rows, decoded, rows.trip, cost=3.0, level=0.05)
    assert [bool(b) for b in model.by[0]] == [bool(b) for b in by]
    again, after = fit_switching(model, rows, 2)
    np.testing.assert_allclose(again.by[0], by, atol=3.0 * error)
    np.testing.assert_allclose(again.share[0], 0.3, atol=0.14)
    plain, before = fit_switching(replace(model, by=np.zeros_like(model.by)), rows, 2)
    said = contrasts(again, rows, 0)
    if any(by):
        # as much at least as the moves said
        assert decode(model, rows).log_likelihood > decoded.log_likelihood + 3.0
        assert after.log_likelihood > before.log_likelihood + 3.0
        assert said[0]["share_high"] > said[0]["share_low"] + 0.2
    else:
        assert said == []
    assert np.all(plain.by == 0)


def test_the_effect_expects_what_the_chain_expects():
    effect = SwitchingLoad(1.0, 0.8, 0.5, 0.2, 0.1, 60.0, by_standstill=1.5, by_start=0.0, by_soc=-2.0, by_door=0.0)
    rng = np.random.default_rng(0)
    n = 50
    segments = Segments.from_arrays(
        duration_s=np.ones(n), speed_start_mps=np.where(rng.random(n) < 0.5, 0.0, 9.0),
        speed_end_mps=np.where(rng.random(n) < 0.5, 0.0, 9.0), ambient_temp_c=rng.uniform(-5, 35, n), soc=rng.random(n),
    )  # fmt: skip
    rows = rows_of(segments, np.zeros(n), samples=True)
    by = np.array([[1.5, 0.0, -2.0, 0.0]])
    model = replace(start(1.0), share=np.asarray(effect.shares())[None], by=by)
    power = jax.jit(jax.vmap(lambda row: effect.power(row, None, None)))(jax.tree.map(np.asarray, segments))
    np.testing.assert_allclose(power, model.expected(rows)[:, 0], rtol=1e-6)
    np.testing.assert_allclose(
        replace(model, by=0.0 * by).expected(rows)[:, 0], expected_share(rows.temp_c, model.share[0])
    )


def test_the_gradient_of_the_moves_is_that_of_their_likelihood():
    """By central differences, and as the sum of the rows' own."""
    rng, n = np.random.default_rng(0), 300
    rows = StateRows(
        np.zeros(n), np.repeat(np.arange(3), 100), rng.uniform(1.0, 40.0, n), rng.uniform(-10.0, 30.0, n),
        np.zeros(n, int), 0.1, rng.normal(size=(n, len(COVARIATES))),
    )  # fmt: skip
    decoded = decode(start(5000.0), rows)._replace(moves=rng.dirichlet(np.ones(4), n).reshape(n, 1, 2, 2))
    moves, columns = _Moves(start(5000.0), rows, decoded, 0), (0, 2)
    theta = np.r_[moves.start, 0.3, -0.2]

    def log_likelihood(x):
        on = moves._chance(x, columns).on
        return np.sum(moves.moved[:, :, 1] * np.log(on) + moves.moved[:, :, 0] * np.log1p(-on))

    chance, h = moves._chance(theta, columns), 1e-6
    numeric = [(log_likelihood(theta + h * e) - log_likelihood(theta - h * e)) / (2 * h) for e in np.eye(len(theta))]
    np.testing.assert_allclose(moves._gradient(chance), numeric, rtol=1e-5, atol=1e-5)
    each = np.einsum("rb,rbk->k", moves._scores(chance), moves._jacobian(chance))
    np.testing.assert_allclose(moves._gradient(chance), each, rtol=1e-9)
