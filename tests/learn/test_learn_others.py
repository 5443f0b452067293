"""Recursive least squares, recurrent networks and searched models."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from learn_rows import drive

from hdev_jax.errors import InputError
from hdev_jax.learn.baselines.classical import CLASSICAL, search_classical
from hdev_jax.learn.baselines.recurrent import train_recurrent
from hdev_jax.learn.narx.online import follow, recursive, update


def rows(n=200, columns=3, seed=0):
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(n, columns))
    return x, x @ np.arange(1.0, columns + 1) + 0.1 * rng.normal(size=n)


@settings(max_examples=30)
@given(st.integers(0, 1000), st.sampled_from((1, 4)))
def test_recursive_without_forgetting_is_least_squares(seed, columns):
    x, y = rows(120, columns, seed)
    state, _ = follow(recursive(np.zeros(columns), prior=1e9), x, y, forgetting=1.0)
    np.testing.assert_allclose(state.beta, np.linalg.lstsq(x, y, rcond=None)[0], rtol=1e-5, atol=1e-6)


def test_forgetting_weighs_rows_by_age():
    x, y = rows()
    factor = 0.97
    state, _ = follow(recursive(np.zeros(3), prior=1e9), x, y, forgetting=factor)
    w = factor ** np.arange(len(y))[::-1]
    expected = np.linalg.solve((x * w[:, None]).T @ x, (x * w[:, None]).T @ y)
    np.testing.assert_allclose(state.beta, expected, rtol=1e-5)


def test_an_update_is_a_weighted_row_of_information():
    """P⁻¹ ← λ·P⁻¹ + w·x·xᵀ, P⁻¹·β ← λ·P⁻¹·β + w·x·y, with Huber's weight of the error before the row; JAX as NumPy."""
    (x, y), corner, factor = rows(300), 0.15, 0.98
    y[::7] += 3.0
    state = recursive(np.zeros(3), np.eye(3))
    information, target, weights = np.linalg.inv(state.covariance), np.zeros(3), []
    followed, told = follow(state, x, y, forgetting=factor, corner=corner)
    for k in range(len(y)):
        error = y[k] - x[k] @ np.linalg.solve(information, target)
        weights.append(min(1.0, corner / abs(error)))
        information = factor * information + weights[-1] * np.outer(x[k], x[k])
        target = factor * target + weights[-1] * x[k] * y[k]
        state, predicted = update(state, x[k], y[k], factor, corner, xp=np)
        assert predicted == pytest.approx(told[k], rel=1e-9, abs=1e-9)
    assert min(weights) < 0.1 < 1.0 == max(weights)
    np.testing.assert_allclose(state.beta, np.linalg.solve(information, target), rtol=1e-8)
    np.testing.assert_allclose(state.covariance, np.linalg.inv(information), rtol=1e-8, atol=1e-15)
    np.testing.assert_allclose(followed.beta, state.beta, rtol=1e-9)


def test_many_memories_after_the_start_it_still_follows():
    x, y = rows(12_000, 6)
    state, predicted = follow(recursive(np.zeros(6), x[:50]), x, y, forgetting=0.99)
    np.testing.assert_array_equal(state.covariance, state.covariance.T)
    assert np.std(predicted[-2000:] - y[-2000:]) < 0.12


def test_a_change_is_followed():
    x, y = rows(2000)
    y[1000:] += 0.5 * x[1000:, 0]
    state, _ = follow(recursive(np.zeros(3)), x, y, forgetting=0.99)
    assert state.beta[0] == pytest.approx(1.5, abs=0.05)


def test_a_row_that_tells_nothing_does_not_wind_up():
    state, _ = follow(
        recursive(np.ones(2), np.eye(2)), np.zeros((5000, 2)), np.zeros(5000), forgetting=0.99, ceiling=10.0
    )
    assert np.trace(state.covariance) < 10.0


def test_forgetting_outside_its_range_is_one_line():
    with pytest.raises(InputError, match="above 0 and at most 1"):
        follow(recursive(np.zeros(3)), *rows(), forgetting=1.5)


RECURRENT = {"units": 4, "steps": 150, "batch": 16, "length": 32, "burn_in": 8}


def unexplained(model, trip):
    """Share of the target's variance."""
    return np.mean((model.predict(trip) - model.measured(trip)) ** 2) / np.var(trip.target)


def test_recurrent_network_learns():
    """From two starts, from each in its own way."""
    trip = drive(600)
    models = train_recurrent("lstm", trip, keys=jax.random.split(jax.random.key(0), 2), **RECURRENT)
    for model in models:
        assert unexplained(model, trip) < 0.3
        assert model.parameters == sum(x.size for x in jax.tree.leaves(model.network) if hasattr(x, "size"))
    assert np.abs(models[0].predict(trip) - models[1].predict(trip)).max() > 1e-3


def test_recurrent_network_learns_nothing_of_rows_that_are_left_out_nor_of_the_start_beside_it():
    trip, keys = drive(600), jax.random.split(jax.random.key(0), 2)
    without = (np.arange(600) >= 200) & (np.arange(600) < 350)
    options = {**RECURRENT, "without": without}
    changed = dataclasses.replace(trip, target=np.where(without, 77.0, trip.target))
    first = train_recurrent("gru", trip, keys=keys, **options)
    for model in first:
        assert unexplained(model, trip) < 0.3
        assert model.parameters == sum(x.size for x in jax.tree.leaves(model.network) if hasattr(x, "size"))
    assert np.abs(first[0].predict(trip) - first[1].predict(trip)).max() > 1e-3
    others = jax.random.split(jax.random.key(1), 2)
    again = train_recurrent("gru", changed, keys=jnp.stack([others[0], keys[0]]), **options)
    np.testing.assert_array_equal(first[0].predict(trip), again[1].predict(trip))
    with pytest.raises(InputError, match="30 rows to train on"):
        train_recurrent("gru", trip, keys=keys, **{**options, "without": np.arange(600) >= 30})


def test_recurrent_refuses_in_one_line():
    with pytest.raises(InputError, match="one of lstm, gru"):
        train_recurrent("rnn", drive(300), keys=jax.random.split(jax.random.key(0), 1))
    with pytest.raises(InputError, match="a window has"):
        train_recurrent("lstm", drive(100), keys=jax.random.split(jax.random.key(0), 1))


@pytest.mark.parametrize("kind", CLASSICAL)
def test_searched_models_beat_the_mean(kind):
    pytest.importorskip("optuna")
    trip = drive(600)
    model = search_classical(kind, trip, trials=2, seed=0)
    error = model.predict(trip) - model.measured(trip)
    assert np.mean(error**2) < np.var(trip.target)
    assert model.parameters > 0


@pytest.mark.parametrize("kind", CLASSICAL)
def test_searched_models_bear_a_constant_input(kind):
    pytest.importorskip("optuna")
    trip = drive(300)
    trip = dataclasses.replace(trip, inputs={**trip.inputs, "speed_mps": np.full(300, 10.0)})
    assert np.all(np.isfinite(search_classical(kind, trip, trials=1, seed=0).predict(trip)))


def test_unknown_model_is_one_line():
    pytest.importorskip("optuna")
    with pytest.raises(InputError, match="one of tree"):
        search_classical("forest", drive(100), trials=1, seed=0)
