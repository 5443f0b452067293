"""The NARX against a loop in NumPy; its normal equations against autodiff; its fits against SciPy."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from learn_rows import drive, narx_loop
from scipy.optimize import least_squares

from hdev_jax.errors import InputError
from hdev_jax.learn import (
    Channels,
    KernelTerms,
    Structure,
    fit_prediction,
    fit_simulation,
    prepared,
    starts,
    with_theta,
)
from hdev_jax.learn.narx.network import output
from hdev_jax.learn.narx.normal import one_step, rows_of, simulated, windows_of
from hdev_jax.learn.narx.selection import edge, folds, validated
from hdev_jax.learn.sequences import Scale, blocks, energy_kwh, lagged, trips_of

STRUCTURES = {
    "inputs": Structure(units=3),
    "all": Structure(units=2, seen="all"),
    "no feedback": Structure(outputs=0, lags=(0, 2), units=2),
    "linear": Structure(units=0),
    "kernel": Structure(KernelTerms(2), 2, (0, 1), units=0),
}


def random_model(structure, trip, seed=0, scale=0.1):
    rng = np.random.default_rng(seed)
    theta = scale * rng.normal(size=structure.shape.size)
    return with_theta(prepared(structure, trip), theta)


@pytest.mark.parametrize("free", [False, True], ids=["prediction", "free run"])
@pytest.mark.parametrize("name", STRUCTURES)
def test_model_is_the_loop(name, free):
    s, trip = STRUCTURES[name], drive(200)
    model = random_model(s, trip)
    y = model.output.apply(trip.target)
    u = model.inputs.apply(s.source(trip))
    seen_from = 0 if s.seen == "all" else s.outputs
    expected = narx_loop(model.theta, y, u, s.outputs, s.lags, s.units, seen_from, free)
    got = model.simulate(trip) if free else model.predict(trip)
    np.testing.assert_allclose(model.output.apply(got), expected, rtol=1e-9, atol=1e-9)
    if not free:
        x, _ = model.regressors(trip)
        assert model.step(x[7]) == pytest.approx(got[7], rel=1e-9)


@pytest.mark.parametrize("name", ["inputs", "all", "linear"])
def test_equations_of_one_step_are_those_of_autodiff(name):
    s, trip = STRUCTURES[name], drive(300)
    model = random_model(s, trip)
    x, y = model.regressors(trip)
    theta, corner = jnp.asarray(model.theta), 0.3

    def loss(theta):
        r = output(s.shape, theta, jnp.asarray(x)) - y
        size = jnp.abs(r)
        return 0.5 * jnp.sum(jnp.where(size <= corner, r**2, corner * (2 * size - corner)))

    ours = jax.jit(lambda theta, corner: one_step(s.shape, theta, rows_of(x, y, chunk=128), corner))
    got, squares = ours(theta, corner), ours(theta, jnp.inf)
    jac_of = jax.jacfwd(lambda t: output(s.shape, t, jnp.asarray(x)))
    (value, slope), jac = jax.jit(lambda theta: (jax.value_and_grad(loss)(theta), jac_of(theta)))(theta)
    np.testing.assert_allclose(got[0], value, rtol=1e-10)
    np.testing.assert_allclose(got[1], slope, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(squares[2], jac.T @ jac, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("name", ["inputs", "all"])
def test_windows_in_parallel_are_the_plain_free_run(name):
    from hdev_jax.learn.narx.network import free_run

    s, trip = STRUCTURES[name], drive(500)
    model = random_model(s, trip, scale=0.05)
    x, y = model.regressors(trip)
    back, theta = s.outputs, jnp.asarray(model.theta)

    def run(theta):
        return free_run(s.shape, theta, jnp.asarray(x[0, :back]), jnp.asarray(x[:, back:]))

    windows = windows_of(x, y, back, length=64, burn_in=64, group=4)
    # the first window holds its start, which the trip has not; the others have forgotten theirs
    windows = eqx.tree_at(lambda w: w.weight, windows, windows.weight.at[0, :, 0].set(0.0))
    got = jax.jit(lambda theta: simulated(s.shape, theta, windows, jnp.asarray(jnp.inf)))(theta)
    free, jac = jax.jit(lambda theta: (run(theta), jax.jacfwd(run)(theta)))(theta)
    r, jac = np.asarray(free - y)[64:], np.asarray(jac)[64:]
    assert float(got[0]) == pytest.approx(0.5 * float(r @ r), rel=1e-12)
    for ours, expected in zip(got[1:], (jac.T @ r, jac.T @ jac), strict=True):
        np.testing.assert_allclose(ours, expected, rtol=0, atol=1e-12 * float(jnp.abs(expected).max()))


def test_fit_reaches_scipys_cost_from_the_same_start():
    s, trip = Structure(outputs=1, lags=(0, 1), units=1), drive(400)
    model = prepared(s, trip)
    begin = starts(model, trip, keys=jax.random.split(jax.random.key(0), 3), steps=20)
    fit = fit_prediction(model, trip, begin, max_steps=500, rtol=1e-10)
    x, y = model.regressors(trip)
    said = jax.jit(lambda theta: output(s.shape, theta, jnp.asarray(x)))

    def residual(theta):
        return np.asarray(said(jnp.asarray(theta))) - y

    for k in range(3):
        theirs = least_squares(residual, np.asarray(begin[k]), method="lm", max_nfev=2000)
        assert float(fit.loss[k]) <= theirs.cost * 1.02
    assert not bool(fit_prediction(model, trip, begin, max_steps=2, rtol=1e-12).converged.any()), "out of steps"


def test_simulation_fit_lowers_the_error_of_the_free_run():
    s, trip = Structure(units=0), drive(800, noise=0.5)
    model = prepared(s, trip)
    fit = fit_prediction(model, trip, jnp.zeros((1, s.shape.size)))
    assert bool(fit.converged[0])
    after = fit_simulation(model, trip, fit.theta, length=100, max_steps=60)
    measured = model.measured(trip)

    def mse(theta):
        return np.mean((with_theta(model, theta).simulate(trip) - measured) ** 2)

    assert mse(after.theta[0]) < mse(fit.theta[0])


def test_weights_leave_rows_out():
    trip = drive(400)
    model = prepared(Structure(units=0), trip)
    rows = len(trip) - model.structure.first
    weights = np.stack([np.ones(rows), np.r_[np.ones(rows // 2), np.zeros(rows - rows // 2)]])
    fit = fit_prediction(model, trip, jnp.zeros((2, model.parameters)), weights=weights)
    half = drive(400)
    x, y = model.regressors(half)
    z = np.c_[np.ones(rows // 2), x[: rows // 2]]
    np.testing.assert_allclose(fit.theta[1], np.linalg.lstsq(z, y[: rows // 2], rcond=None)[0], rtol=2e-3, atol=1e-5)


def test_kernel_terms_are_the_machine_stage():
    trip = drive(100)
    torque, turning = trip.inputs["motor_torque_nm"], trip.inputs["motor_speed_radps"]
    got = KernelTerms(1)(trip)
    power = torque * turning / 1000
    expected = [-np.maximum(power, 0), np.minimum(power, 0), torque**2 / 1000, np.abs(turning) / 1000,
                turning**2 / 1000, np.abs(torque) / 1000]  # fmt: skip
    np.testing.assert_allclose(got, np.stack(expected, axis=1), rtol=1e-9, atol=1e-12)
    assert len(KernelTerms(2).names) == KernelTerms(2)(trip).shape[1]


@settings(max_examples=30)
@given(st.integers(1, 50), st.integers(1, 4), st.floats(0.1, 100.0))
def test_scale_round_trip(rows, columns, spread):
    x = spread * np.random.default_rng(rows).normal(size=(rows, columns)) + 7
    scale = Scale.of(x)
    np.testing.assert_allclose(scale.undo(scale.apply(x)), x, rtol=1e-9, atol=1e-9)


@given(st.integers(1, 30), st.lists(st.integers(-3, 5), min_size=1, max_size=4, unique=True))
def test_lags_hold_the_edges(rows, lags):
    x = np.arange(rows, dtype=float)
    got = lagged(x[:, None], lags)
    for j, lag in enumerate(lags):
        for k in range(rows):
            assert got[k, j] == min(max(k - lag, 0), rows - 1)


@given(st.integers(2, 200), st.integers(2, 10))
def test_blocks_are_contiguous_and_cover_every_row(rows, count):
    if count > rows:
        with pytest.raises(InputError, match="blocks of"):
            blocks(rows, count)
        return
    number = blocks(rows, count)
    assert set(number) == set(range(count))
    assert np.all(np.diff(number) >= 0)


def test_energy_of_a_trip_splits_by_sign():
    total, positive, negative = energy_kwh(np.array([3600.0, -1800.0]), 1.0)
    assert (total, positive, negative) == (0.5, 1.0, -0.5)


def test_folds_are_blocks_and_the_edge():
    y = np.random.default_rng(0).normal(size=1000)
    left_out = folds(y, 3)
    assert np.array_equal(sum(f.astype(int) for f in left_out[:3]), np.ones(1000))
    assert left_out[3].sum() == edge(y).sum() == 20


def test_validation_prefers_the_true_orders():
    trip = drive(900)
    common = {
        "key": jax.random.key(0),
        "count": 1,
        "huber": np.inf,
        "ridge": {"size": 1e-6, "slope": 1e-3},
        "steps": 30,
    }
    right = validated(Structure(KernelTerms(1), 0, (0, 1), units=0), trip, **common)
    short = validated(Structure(KernelTerms(1), 0, (0,), units=0), trip, **common)
    assert right.blocks < short.blocks


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        (lambda t: Structure(outputs=-1), "orders of a NARX"),
        (lambda t: Structure(lags=()), "orders of a NARX"),
        (lambda t: Channels(("no_such",))(t), "no input 'no_such'"),
        (lambda t: prepared(Structure(), t).predict(t.part(0, 2)), "needs 4"),
        (lambda t: KernelTerms()(drive_without_torque(t)), "need motor_torque_nm"),
        (lambda t: trips_of(uneven(t), t.target, ["1"]), "resample"),
    ],
)
def test_bad_input_is_one_line(wrong, says):
    with pytest.raises(InputError, match=says) as e:
        wrong(drive(50))
    assert "\n" not in str(e.value)


def drive_without_torque(trip):
    import dataclasses

    return dataclasses.replace(trip, segments=trip.segments.without("motor_torque_nm"))


def uneven(trip):
    return eqx.tree_at(lambda s: s.duration_s, trip.segments, np.linspace(0.1, 0.3, len(trip)))
