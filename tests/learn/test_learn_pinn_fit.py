"""Fitting a physics-informed network: what is planted is found, what is given is kept, what diverges says so."""

import dataclasses
import shutil

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from learn_models import AUXILIARY, PLAIN, by_hand, recipe, two_trucks
from learn_trucks import TABLE, energy_by_hand, road, truck_rows

from hdev_jax.errors import InputError
from hdev_jax.learn.pinn.fit import PAPER_WEIGHTS, Member, Sizes, fit
from hdev_jax.learn.pinn.rows import concatenated
from hdev_jax.learn.train import DivergedError, Plan


@pytest.fixture(scope="module")
def rows():
    return two_trucks()


def test_planted_coefficients_of_each_vehicle_are_found_and_an_unseen_one_lies_between():
    planted = ((0.0084, 4.3, 1500.0), (0.0070, 5.3, 3000.0))  # on one side of the table, 0.006 and 6 m²
    rng, parts = np.random.default_rng(1), []
    for k, (c_rr, cda, watts) in enumerate(planted):
        s = road(480, 12, seed=10 + k)
        s = dataclasses.replace(s, trip=np.asarray(s.trip) + 12 * k)
        y = energy_by_hand(s, {**TABLE, "c_rr": c_rr, "cda_m2": cda, "auxiliary_w": 2000.0 + watts})
        parts.append(truck_rows(s, y + rng.normal(0, 1.0 + 0.01 * np.abs(y)), number=k))
    rows = concatenated(parts)
    held = np.asarray(rows.segments.trip) % 6 == 5
    made = fit(
        recipe(coefficients="free", by_vehicle=True, loss="likelihood", energy_head=False, stretch=4),
        rows.take(~held), rows.take(held), vehicles=2, members=[Member(0, (1.0, 0.1, 1.0))],
        plan=Plan(epochs=60, batch=160, patience=5), rate=0.03, effects=(AUXILIARY,),
    )  # fmt: skip
    (p,) = made.predict(rows)
    unseen = eqx.tree_at(lambda r: r.vehicle, rows, np.full(len(rows), 2, np.int32))
    (new,) = made.predict(unseen)
    moving = np.asarray(rows.segments.distance_m) > 0
    for name, low, high in (("c_rr", 0.0070, 0.0084), ("cda_m2", 4.3, 5.3)):
        middle = np.median(getattr(new, name)[moving])
        assert middle == pytest.approx(np.sqrt(low * high), rel=0.03), "the mean of those that were trained on"
        assert low < middle < high
    common, own = (np.asarray(m["auxiliary_power.power_w"])[0] for m in (made.model.sizes, made.model.own_sizes))
    sizes = common + own - own.mean()
    assert 1000.0 * float(common) == pytest.approx(2250.0, rel=0.1)
    for k, (c_rr, cda, watts) in enumerate(planted):
        of = (np.asarray(rows.vehicle) == k) & (np.asarray(rows.segments.distance_m) > 0)
        assert np.median(p.c_rr[of]) == pytest.approx(c_rr, rel=0.03)
        assert np.median(p.cda_m2[of]) == pytest.approx(cda, rel=0.03)
        assert 1000.0 * float(sizes[k]) == pytest.approx(watts, rel=0.1)
    # and the noise that was added
    error = rows.energy_wh - p.energy_wh
    assert np.std(error / p.sd_wh) == pytest.approx(1.0, abs=0.15)


def test_in_use_there_is_no_dropout_the_means_run_and_each_row_is_alone(rows):
    one = recipe(units=(8,), normalised=True, dropout=0.3)
    held = rows.take(np.arange(0, 80, 4))
    made = fit(
        one, rows, held, vehicles=2, members=[Member(0), Member(1, (1.0, 0.0, 0.0))], plan=Plan(epochs=3, batch=16)
    )
    first, second = made.predict(rows)
    assert np.abs(first.residual_wh - second.residual_wh).max() > 1e-2
    # the network in NumPy, with the means that ran
    model = jax.tree.map(lambda x: x[1] if eqx.is_array(x) else x, made.model)
    memory = jax.tree.map(lambda x: x[1], made.memory)
    x = made.scale.apply(rows.features)
    for layer, normal in zip(model.network.layers, model.network.norms, strict=True):
        mean, var, scale, shift, w, b = (
            np.asarray(z, float)
            for z in (*memory.get(normal.batch_state_index), normal.weight, normal.bias, layer.weight, layer.bias)
        )
        # what runs began at nothing: so much of it has come in by now
        come = 1.0 - normal.momentum ** int(memory.get(normal.batch_counter))
        mean, var = mean / come, var / come
        x = (np.maximum(x @ w.T + b, 0) - mean) / np.sqrt(var + normal.eps) * scale + shift
    out = x @ np.asarray(model.network.head.weight, float).T + np.asarray(model.network.head.bias, float)
    np.testing.assert_allclose(second.residual_wh, model.scale_wh * rows.unit * out[:, 0], rtol=1e-3, atol=1e-3)
    # whatever stands beside it
    some = np.array([70, 3, 3])
    for all_of, few in zip((first, second), made.predict(rows.take(some)), strict=True):
        np.testing.assert_allclose(few.energy_wh, all_of.energy_wh[some], rtol=1e-6)
        np.testing.assert_allclose(few.c_rr, all_of.c_rr[some], rtol=1e-6)
    np.testing.assert_allclose(made.mean(rows).energy_wh, (first.energy_wh + second.energy_wh) / 2, rtol=1e-5)


def test_a_fit_keeps_the_sizes_that_it_is_given_and_goes_on_from_its_checkpoint(rows, tmp_path):
    effects = (AUXILIARY,)
    sizes = {"auxiliary_power.power_w": np.float64(0.7)}
    start = Sizes(np.array([0.1, -0.2]), np.array([[0.05, 0.1], [-0.05, -0.1]]), sizes, {
        "auxiliary_power.power_w": np.array([0.2, -0.2])})  # fmt: skip
    given = {"vehicles": 2, "members": [Member(0), Member(1)], "effects": effects, "sizes": start}
    one = recipe(coefficients="free", coefficient_inputs="physical", by_vehicle=True, loss="likelihood", stretch=4)
    kept, half = tmp_path / "whole", tmp_path / "half"

    def copy(epoch: int, loss: float, score: float) -> None:
        """What a run that is cut off in its sixth epoch leaves."""
        if epoch == 5:
            shutil.copy(kept, half)

    plan = Plan(epochs=7, batch=16)
    still = fit(one, rows, rows, **given, plan=plan, checkpoint=kept, tell=copy)
    assert np.ptp(still.predict(rows)[0].residual_wh) > 0.1, "all else is trained"
    head = lambda m: (m.coefficient_network.head, m.network.head)  # noqa: E731
    model = eqx.tree_at(head, still.model, jax.tree.map(jnp.zeros_like, head(still.model)))
    (p, _) = dataclasses.replace(still, model=model).predict(rows)
    own = np.asarray(start.own)[np.asarray(rows.vehicle)]
    np.testing.assert_allclose(p.c_rr, rows.c_rr * np.exp(0.1 + own[:, 0]), rtol=1e-5)
    np.testing.assert_allclose(p.cda_m2, rows.cda_m2 * np.exp(-0.2 + own[:, 1]), rtol=1e-5)
    watts = 1000.0 * (0.7 + np.array([0.2, -0.2]))[np.asarray(rows.vehicle)]
    law = by_hand(rows, p.c_rr, p.cda_m2) + watts * rows.segments.duration_s / 3600
    np.testing.assert_allclose(p.energy_wh, law, rtol=1e-4, atol=1e-2)

    told = []
    again = fit(one, rows, rows, **given, plan=plan, checkpoint=half, tell=lambda epoch, *_: told.append(epoch))
    assert told == [5, 6]
    for a, b in zip(still.predict(rows), again.predict(rows), strict=True):
        np.testing.assert_array_equal(a.energy_wh, b.energy_wh)

    with pytest.raises(ValueError, match=r"\(2, 2\) numbers are expected, found \(3, 2\)"):
        fit(one, rows, rows, **{**given, "sizes": start._replace(own=np.zeros((3, 2)))}, plan=Plan(epochs=1))


def test_a_fit_of_which_nothing_is_left_says_so(rows):
    with pytest.raises(DivergedError, match="finite score"):
        fit(PLAIN, rows, rows, vehicles=2, members=[Member(0), Member(1)], plan=Plan(epochs=3), rate=1e30)


def test_what_cannot_be_built_is_said_in_one_line(rows):
    start = {"vehicles": 2, "members": [Member(0, PAPER_WEIGHTS)], "plan": Plan(epochs=1)}
    much = eqx.tree_at(lambda r: r.car.effect("rolling").c_rr, rows, np.full(len(rows), 0.021, np.float32))
    cases = (
        (PLAIN, much, "c_rr is 0.021"),
        (PLAIN, rows.take(np.arange(0)), "0 rows"),
        (recipe(features=("slope",), coefficients="free", coefficient_inputs="physical"), rows, "physical"),
    )
    for wrong, data, words in cases:
        with pytest.raises(InputError, match=words) as e:
            fit(wrong, data, rows, **start)
        assert "\n" not in str(e.value)
