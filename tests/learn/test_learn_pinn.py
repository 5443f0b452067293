"""The physics-informed network: equation 7 and the likelihood by hand, bounds, vehicles."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from jax.flatten_util import ravel_pytree
from learn_models import AUXILIARY, KEY, by_hand, made, recipe, two_trucks
from learn_trucks import FEATURES
from scipy.linalg import helmert
from scipy.special import expit, logit
from scipy.stats import multivariate_t, norm

from hdev_jax.learn.pinn.fit import PAPER_WEIGHTS, stretches
from hdev_jax.learn.pinn.heads import Heads, _kept
from hdev_jax.learn.pinn.loss import Objective
from hdev_jax.learn.pinn.model import predict, ready

ROWS = None


@pytest.fixture(scope="module")
def rows():
    return two_trucks()


def said(model: Any, rows: Any) -> tuple[np.ndarray, np.ndarray]:
    """The plain network's two heads in NumPy."""
    n = model.network
    w, b, v, c = (np.asarray(x, float) for x in (n.layers[0].weight, n.layers[0].bias, n.head.weight, n.head.bias))
    out = np.maximum(np.asarray(rows.features, float) @ w.T + b, 0) @ v.T + c
    return out[:, 0], out[:, 1:]


@pytest.mark.parametrize("coefficients", ["bounded", "free"])
def test_an_untrained_model_says_what_the_sheet_says(rows, coefficients):
    model, memory = made(recipe(coefficients=coefficients, normalised=True, dropout=0.1), seed=None)
    p = predict(model, memory, rows)
    expected = by_hand(rows, rows.c_rr, rows.cda_m2)
    np.testing.assert_allclose(p.energy_wh, expected, rtol=1e-5, atol=2e-3)
    np.testing.assert_array_equal(p.energy_wh, p.physics_wh)
    np.testing.assert_allclose(p.c_rr, rows.c_rr, rtol=1e-5)
    np.testing.assert_allclose(p.cda_m2, rows.cda_m2, rtol=1e-6)
    np.testing.assert_array_equal(p.residual_wh, 0)


def test_a_model_that_is_ready_says_the_same_of_a_row(rows):
    model, memory = made(recipe(coefficients="free", by_vehicle=True, loss="likelihood"), effects=(AUXILIARY,))
    say = ready(model, memory, rows.take(np.array([0])))
    expected = predict(model, memory, rows)
    for k in (0, 7, 70):
        one = say(rows.take(np.array([k])))
        for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(a[0], b[k], rtol=1e-5, atol=1e-4)
    doubles = jax.tree.map(lambda x: x.astype(float) if x.dtype.kind == "f" else x.astype(np.int64), rows)
    np.testing.assert_array_equal(say(doubles.take(np.array([7]))).energy_wh, say(rows.take(np.array([7]))).energy_wh)
    with pytest.raises(ValueError, match="made ready for are expected"):
        say(rows.take(np.array([7, 8])))


@pytest.mark.parametrize(("shape", "dropout"), [((400, 300), 0.1), ((301, 255), 0.5), ((1, 3), 0.0)])
def test_dropout_leaves_out_its_share_of_every_unit_by_chance(shape, dropout):
    kept = np.asarray(_kept(jax.random.key(3), 1 - dropout, shape), float)
    assert kept.shape == shape
    sd = np.sqrt(dropout * (1 - dropout))
    for axis in (None, 0, 1):  # of all, of a unit, of a row
        mean = kept.mean(axis)
        assert np.all(np.abs(mean - (1 - dropout)) <= 5 * sd / np.sqrt(kept.size / mean.size))
    if dropout:  # units of one word, and words that are drawn together, know nothing of each other
        about = kept - kept.mean()
        for by, axis in ((1, None), (kept.size // 2, None), (-(-shape[1] // 2), 1)):
            assert abs(np.mean(about * np.roll(about, by, axis))) / sd**2 < 5 / np.sqrt(kept.size)
        assert np.any(kept != np.asarray(_kept(jax.random.key(4), 1 - dropout, shape)))


@settings(max_examples=30)
@example(3e38, -3e38, 0.9)
@example(-3e38, 0.0, 0.05)
@given(
    st.floats(allow_nan=False, allow_infinity=False, width=32),
    st.floats(allow_nan=False, allow_infinity=False, width=32),
    st.floats(0.05, 0.9),
)
def test_the_bounds_are_never_left(first, second, clamp):
    rows = _two_rows()
    model, _ = made(recipe(clamp=clamp), seed=None)
    heads = Heads(jnp.zeros(2, jnp.float32), jnp.array([[first, second], [second, first]], jnp.float32))
    c_rr, cda = (np.asarray(x, float) for x in model.coefficients(heads, rows))
    assert np.all((c_rr >= 0) & (c_rr <= 0.02 * (1 + 1e-6)))
    assert np.all(np.abs(cda / rows.cda_m2 - 1) <= clamp * (1 + 1e-5))


def _two_rows() -> Any:
    global ROWS
    ROWS = two_trucks().take(np.array([0, 60])) if ROWS is None else ROWS
    return ROWS


@pytest.mark.parametrize(
    ("predicted", "physics", "coefficient_loss"),
    [("residual", "battery", "relative"), ("alone", "wheel", "absolute"), ("table", "wheel", "relative")],
)
def test_equation_7_by_hand(rows, predicted, physics, coefficient_loss):
    model, memory = made(recipe(predicted=predicted, physics=physics, coefficient_loss=coefficient_loss))
    weight = np.where(np.arange(len(rows)) % 5 == 0, 0, 1).astype(np.float32)
    rows = eqx.tree_at(lambda r: r.weight, rows, weight)
    static = eqx.partition(model, eqx.is_inexact_array)
    objective = Objective(static[1], len(rows))
    loss = lambda *w: objective.loss(  # noqa: E731
        static[0], memory, stretches(rows, 1), KEY, jnp.asarray(w, jnp.float32)
    )[0]
    energy, coefficients = said(model, rows)
    c_rr = 0.02 * expit(logit(np.asarray(rows.c_rr, float) / 0.02) + coefficients[:, 0])
    cda = rows.cda_m2 * np.clip(1 + coefficients[:, 1], 0.5, 1.5)
    law = by_hand(rows, c_rr, cda, wheel=physics == "wheel")
    heavy = np.asarray(rows.segments.channels["mass_kg"], float) / 20e3  # no feature tells the mass
    base = {"residual": law, "alone": 30.0 * heavy, "table": by_hand(rows, rows.c_rr, rows.cda_m2)}[predicted]
    kept = weight > 0
    unit = (rows.c_rr, rows.cda_m2) if coefficient_loss == "relative" else (1.0, 1.0)
    mean = lambda x: np.mean(np.square(x)[kept])  # noqa: E731
    terms = (
        mean(rows.energy_wh - base - 50.0 * heavy * energy), mean(rows.energy_wh - law),
        mean((c_rr - rows.c_rr) / unit[0]) + mean((cda - rows.cda_m2) / unit[1]),
    )  # fmt: skip
    assert min(terms) > 1e-9
    for weights in ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), PAPER_WEIGHTS):
        np.testing.assert_allclose(loss(*weights), np.dot(weights, terms), rtol=2e-4)
    np.testing.assert_allclose(objective.score(static[0], memory, stretches(rows, 1), None), terms[0], rtol=1e-4)


def test_the_likelihood_and_its_stretches_by_hand(rows):
    """Rows, sums of stretches of one trip each, priors; what only fills a stretch moves neither value nor slope."""
    model, memory = made(
        recipe(coefficients="free", by_vehicle=True, loss="likelihood", stretch=7), effects=(AUXILIARY,)
    )
    weights, static = eqx.partition(model, eqx.is_inexact_array)
    objective = Objective(static, 1000)
    batch = stretches(rows, 7)
    for trip in batch.segments.trip:
        assert len(set(trip)) == 1
    assert batch.weight.shape == (12, 7)  # three of seven rows in each of four trips of twenty
    assert batch.weight.sum() == len(rows)
    lam = (1.0, 0.3, 0.5)
    value = eqx.filter_jit(
        jax.value_and_grad(lambda w, b: objective.loss(w, memory, b, KEY, jnp.asarray(lam, jnp.float32))[0])
    )
    found, slope = value(weights, batch)

    energy, coefficients = said(model, rows)
    about_mean = lambda x: np.asarray(x) - np.mean(np.asarray(x), axis=0)  # noqa: E731
    log = np.asarray(model.common) + about_mean(model.own)[rows.vehicle] + 0.5 * coefficients
    own_sizes = about_mean(model.own_sizes["auxiliary_power.power_w"])
    watts = 1000.0 * (np.asarray(model.sizes["auxiliary_power.power_w"]) + own_sizes)
    law = by_hand(rows, rows.c_rr * np.exp(log[:, 0]), rows.cda_m2 * np.exp(log[:, 1]))
    law = law + watts[rows.vehicle] * rows.segments.duration_s / 3600
    floor, share = np.exp(np.asarray(model.noise[::2], float)) * 50.0, np.exp(np.asarray(model.noise[1::2], float))
    sd, loose = (np.sqrt(a**2 + (b * law) ** 2) for a, b in zip(floor, share, strict=True))
    heavy = np.asarray(rows.segments.channels["mass_kg"], float) / 20e3
    error, off = rows.energy_wh - law - 50.0 * heavy * energy, rows.energy_wh - law
    minus = lambda x, s: -norm.logpdf(x, scale=s) - 0.5 * np.log(2 * np.pi)  # noqa: E731
    data = minus(error, sd).sum()
    for trip in range(4):
        at = np.flatnonzero(np.asarray(rows.segments.trip) == trip)
        for first in range(0, len(at), 7):
            part = at[first : first + 7]
            off_by = np.exp(float(model.drift)) * law[part].sum()
            data += minus(error[part].sum(), np.sqrt((sd[part] ** 2).sum() + off_by**2))
    square = lambda x: float(np.sum(np.square(x)))  # noqa: E731
    prior = 0.5 * square(model.common) / 0.3**2 + 0.5 * square(model.sizes["auxiliary_power.power_w"])
    owns = (*np.asarray(model.own).T, model.own_sizes["auxiliary_power.power_w"])
    for own, usual in zip(owns, (0.3, 0.3, 1.0), strict=True):
        contrasts = helmert(len(own)) @ np.asarray(own)
        student = multivariate_t(shape=usual**2 * np.eye(len(contrasts)), df=0.1)
        prior += student.logpdf(0 * contrasts) - student.logpdf(contrasts)
    terms = (data / 80, minus(off, loose).sum() / 80, prior / 1000 + 0.01 * square(coefficients) / 80)
    np.testing.assert_allclose(found, np.dot(lam, terms), rtol=1e-4)

    fills = batch.weight == 0
    spoilt = eqx.tree_at(
        lambda r: (r.energy_wh, r.features), batch,
        (np.where(fills, np.float32(1e4), batch.energy_wh), np.where(fills[..., None], np.float32(9), batch.features)),
    )  # fmt: skip
    again, other = value(weights, spoilt)
    np.testing.assert_allclose(again, found, rtol=1e-6)
    np.testing.assert_allclose(ravel_pytree(other)[0], ravel_pytree(slope)[0], rtol=1e-4, atol=1e-6)


def test_a_vehicle_that_was_not_trained_on_has_what_the_fleet_has_in_common(rows):
    model, memory = made(
        recipe(coefficients="free", coefficient_inputs="physical", by_vehicle=True), vehicles=5, effects=(AUXILIARY,)
    )
    for number in (0, 4, 5):
        some = eqx.tree_at(lambda r: r.vehicle, rows, np.full(len(rows), number, np.int32))
        apart = np.asarray(model.own)
        apart = apart - apart.mean(axis=0)
        own = np.median(apart, axis=0) if number == 5 else apart[number]
        heads = Heads(jnp.zeros(len(rows), jnp.float32), jnp.zeros((len(rows), 2), jnp.float32))
        c_rr, cda = model.coefficients(heads, some)
        factor = np.exp(np.asarray(model.common) + own)
        np.testing.assert_allclose(c_rr, rows.c_rr * factor[0], rtol=1e-5)
        np.testing.assert_allclose(cda, rows.cda_m2 * factor[1], rtol=1e-5)
        size, own_size = (m["auxiliary_power.power_w"] for m in (model.sizes, model.own_sizes))
        size = size + (np.median(own_size) if number == 5 else own_size[number]) - np.mean(own_size)
        np.testing.assert_allclose(model.effects_of(some)[0].power_w, 1000.0 * float(size) * np.ones(80), rtol=1e-5)
    # and its coefficients do not depend on the power that is asked for
    steeper = np.array(rows.features)
    steeper[:, FEATURES.index("slope")] += 1.0
    model = eqx.tree_at(lambda m: m.coefficient_network.head.weight, model, jnp.ones((3, 32), jnp.float32))
    one, other = (model(eqx.tree_at(lambda r: r.features, rows, x), memory)[0] for x in (rows.features, steeper))
    np.testing.assert_array_equal(one.c_rr, other.c_rr)
    assert np.ptp(one.c_rr / rows.c_rr) > 1e-3
    assert np.abs(one.residual_wh - other.residual_wh).max() > 0.1


def test_a_constant_on_all_own_parts_changes_no_prediction(rows):
    model, memory = made(recipe(coefficients="free", by_vehicle=True, loss="likelihood"), effects=(AUXILIARY,))
    more = eqx.tree_at(
        lambda m: (m.own, m.own_sizes), model, jax.tree.map(lambda x: x + 0.5, (model.own, model.own_sizes))
    )
    every = eqx.tree_at(lambda r: r.vehicle, rows, np.arange(len(rows), dtype=np.int32) % 3)  # an unseen one among them
    one, other = (predict(m, memory, every) for m in (model, more))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=2e-5, atol=1e-3), one, other)
    assert np.abs(one.energy_wh - predict(model, memory, rows).energy_wh).max() > 1.0
