"""The gear as a surrogate: features by hand, classifiers with memory, one compiled function from features to energy."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.paper1.gear_tables import equation_1, macro_f1
from hdev_jax.errors import InputError
from hdev_jax.learn.gears.classifiers import alike, balanced_accuracy, route_folds, scored, search_classifier
from hdev_jax.learn.gears.gears import (
    EVERY,
    FEATURES,
    PLACE,
    Gearbox,
    Surrogate,
    chained,
    features,
    filtered,
    in_gears,
    markov,
    requested_torque,
)
from hdev_jax.learn.trees.arrays import oblivious
from hdev_jax.learn.trees.trees import Reading, Trees
from hdev_jax.physics import GEAR_PROBABILITY, Driveline, EfficiencyMap, Machine, Vehicle
from hdev_jax.physics.road import Aero, Grade, Inertia, Rolling
from hdev_jax.segments import Segments

RATIOS, FINAL, RADIUS = (6.0, 2.5, 1.0), 5.0, 0.5
BOX = Gearbox(RATIOS, FINAL, RADIUS, 200e3, 150.0)


def rows(count: int, seed: int = 0) -> Segments:
    rng = np.random.default_rng(seed)
    v = rng.uniform(1.0, 24.0, (count, 2))
    v[:, 1] = v[:, 0] + 0.1 * (v[:, 1] - v[:, 0])
    duration = rng.uniform(4.0, 9.0, count)
    trip = np.sort(rng.integers(0, 4, count))
    channels = {"mass_kg": rng.uniform(12e3, 25e3, count), "grade_rad": rng.normal(0, 0.02, count)}
    speeds = (v[:, 0], v[:, 1])
    return Segments(trip, np.zeros(count, int), np.zeros(count), duration, v.mean(axis=1) * duration, *speeds, channels)


def car() -> Vehicle:
    rng = np.random.default_rng(1)
    efficiency = EfficiencyMap(
        jnp.arange(1.0, 4.0), jnp.linspace(0.0, 800.0, 5), jnp.linspace(-3e3, 3e3, 7),
        jnp.asarray(rng.uniform(0.7, 0.95, (3, 5, 7))),
    )  # fmt: skip
    number = jnp.asarray
    road = (Inertia(number(1.0)), Grade(), Rolling(number(0.006)), Aero(number(5.5)))
    line = Driveline(efficiency, jnp.asarray(RATIOS), number(FINAL), number(RADIUS))
    return Vehicle(road, mass_kg=number(2e4), driveline=line, machine=Machine(number(1.0), number(1.0)))


def trees(classes: tuple[float, ...] = (1.0, 2.0, 3.0)) -> Trees:
    """Two questions of motor speed and power, and leaves with a gear each."""
    names = FEATURES["sheet"]
    place = names.index("motor_speed_over_rated_2"), names.index("power_over_rated")
    code = lambda x: int(np.float32(x).view(np.int32))  # noqa: E731
    leaves = np.random.default_rng(2).normal(size=(2, 4, len(classes))) * 2
    asked = [[(place[0], Reading.LOW, code(k)), (place[1], Reading.LOW, code(0.2))] for k in (0.7, 1.6)]
    forest, reading = oblivious(list(zip(asked, leaves, strict=True)))
    zero, one = jnp.zeros(len(classes), jnp.float32), jnp.ones((), jnp.float32)
    return Trees(reading, forest, zero, one, names, classes, "softmax")


def test_features_are_what_they_are_called():
    log = rows(40)
    torque = np.linspace(-5e3, 2e4, 40)
    x = eqx.filter_jit(lambda s: features(EVERY, BOX, s, jnp.asarray(torque)))(log)
    assert x.dtype == jnp.float32
    speed, turns = log.distance_m / log.duration_s, np.array(RATIOS) * FINAL / RADIUS
    reference = np.maximum(1, np.sum(speed[:, None] * turns >= 150, axis=1))
    expected = {
        "speed_mps": speed, "requested_torque_nm": torque, "mass_kg": log.channels["mass_kg"],
        "gears": np.full(40, 3.0), "reference_gear": reference, PLACE: np.log(speed * turns[reference - 1] / 150),
        "step_above": np.log(np.array([6 / 2.5, 2.5, 2.5]))[reference - 1],
        "step_below": np.log(np.array([6 / 2.5, 6 / 2.5, 2.5]))[reference - 1],
        "power_over_rated": torque / RADIUS * speed / 200e3, "motor_speed_over_rated_2": speed * 2.5 * 5 / 0.5 / 150,
        "motor_speed_over_rated_4": np.zeros(40), "grade_rad": log.channels["grade_rad"],
    }  # fmt: skip
    for name, column in expected.items():
        np.testing.assert_allclose(x[:, EVERY.index(name)], column, rtol=1e-6)


@eqx.filter_jit
def energy(told: Surrogate, vehicle: Vehicle, log: Segments, soft: bool):
    return vehicle.energy(told(vehicle, log, soft=soft))


def test_one_compiled_function_from_the_row_to_its_energy():
    log, vehicle, told = rows(300), car(), Surrogate.of(trees(), BOX)
    torque, force = eqx.filter_jit(lambda v, s: (requested_torque(v, s), v.force(s)))(vehicle, log)
    np.testing.assert_allclose(torque, np.asarray(force) * RADIUS)
    by_kernel = eqx.filter_jit(Vehicle.energy)
    p = np.asarray(eqx.filter_jit(Surrogate.probabilities)(told, log, torque))
    np.testing.assert_allclose(p.sum(axis=1), 1.0, rtol=1e-12)
    for soft in (True, False):
        alone = by_kernel(vehicle, in_gears(log, jnp.asarray(p), soft=soft))
        np.testing.assert_allclose(energy(told, vehicle, log, soft), alone, rtol=1e-6)
    by_row = jnp.asarray(1.0 + np.argmax(p, axis=1))
    np.testing.assert_array_equal(alone, by_kernel(vehicle, log.with_channels(gear=by_row)))
    assert in_gears(log, jnp.asarray(p), soft=True).has(GEAR_PROBABILITY)


def test_the_whole_vehicle_has_a_gradient():
    log, vehicle, told = rows(300), car(), Surrogate.of(trees(), BOX)

    def changed(c_rr, cda, values):
        where = lambda c: (c.effect("rolling").c_rr, c.effect("aero").cda_m2, c.driveline.efficiency.values)  # noqa: E731
        return eqx.tree_at(where, vehicle, (c_rr, cda, values))

    def mean(*given):
        return jnp.mean(energy(told, changed(*given), log, True))

    given = jnp.asarray(0.006), jnp.asarray(5.5), vehicle.driveline.efficiency.values
    rng, eps = np.random.default_rng(0), 1e-7
    along = jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape)), given)
    at = lambda step: mean(*jax.tree.map(lambda x, d: x + step * d, given, along))  # noqa: E731
    numerical = float(at(eps) - at(-eps)) / (2 * eps)

    @jax.jit
    def both(given):
        slope = jax.grad(mean, argnums=(0, 1, 2))(*given)
        return jax.jvp(mean, given, along)[1], sum(jnp.vdot(a, b) for a, b in zip(slope, along, strict=True))

    np.testing.assert_allclose(both(given), numerical, rtol=1e-3, atol=1e-3)
    assert abs(numerical) > 1.0


def test_a_gear_that_training_lacked_is_refused():
    with pytest.raises(InputError, match="gear 3 of the sheet's 3 was missing from training, which had 1, 2, 4"):
        Surrogate.of(trees((1.0, 2.0, 4.0)), BOX)
    odd = trees()
    renamed = Trees(odd.reading, odd.forest, odd.offset, odd.scale, ("rain", *odd.features[1:]), odd.classes, odd.link)
    with pytest.raises(InputError, match="'rain', which is no gear feature"):
        Surrogate.of(renamed, BOX)
    with pytest.raises(InputError, match="13 gears"):
        Gearbox((1.0,) * 13, 1.0, 0.5, 1e5, 100.0)
    x, gear = np.zeros((40, 1)), np.repeat([1, 3], 20)
    with pytest.raises(InputError, match="gear 2 is missing from the 40 rows"):
        search_classifier("knn", x, gear, gear, features=("a",), trials=1, folds=2, seed=0)
    with pytest.raises(InputError, match="one of decision_tree"):
        search_classifier("oracle", x, gear, gear, features=("a",), trials=1, folds=2, seed=0)


def test_filter_is_the_loop_by_hand_and_starts_anew_by_trip():
    rng = np.random.default_rng(0)
    p, trip = rng.dirichlet(np.ones(3), 30), np.repeat([0, 1, 2], 10)
    change, share = markov(rng.integers(1, 4, 30), trip, 3)
    np.testing.assert_allclose(change.sum(axis=1), 1.0)
    expected = np.zeros_like(p)
    for k in range(30):
        ahead = share if k % 10 == 0 else expected[k - 1] @ change
        expected[k] = ahead * p[k] / share
        expected[k] /= expected[k].sum()
    found = filtered(jnp.asarray(p), trip, change=jnp.asarray(change), share=jnp.asarray(share))
    np.testing.assert_allclose(found, expected, rtol=1e-10)


def test_trees_that_tell_the_distance_from_the_reference_gear():
    log, base = rows(60, seed=5), trees((0.0, 1.0, 2.0))
    names = (*FEATURES["relative"], *base.features[len(FEATURES["relative"]) :])[: len(base.features)]
    asked = Trees(base.reading, base.forest, base.offset, base.scale, names, base.classes, base.link)
    told = Surrogate.of(asked, BOX)
    torque = jnp.full(60, 900.0)
    p = np.asarray(eqx.filter_jit(Surrogate.probabilities)(told, log, torque))
    plain = eqx.filter_jit(lambda t, s: (t.probabilities(features(names, BOX, s, torque)), BOX.reference(s.speed_mps)))
    raw, (reference, *_) = jax.tree.map(np.asarray, plain(asked, log))
    expected = np.zeros((60, 3))
    for k in range(60):
        for away in range(3):
            expected[k, min(reference[k] + away, 3) - 1] += raw[k, away]
    np.testing.assert_allclose(p, expected, rtol=1e-5, atol=1e-7)
    assert len(np.unique(reference)) > 1


def test_chain_is_the_loop_by_hand():
    rng = np.random.default_rng(0)
    given, trip = rng.dirichlet(np.ones(3), (20, 3)), np.repeat([0, 1], 10)
    expected = np.zeros((20, 3))
    for k in range(20):
        expected[k] = (np.full(3, 1 / 3) if k % 10 == 0 else expected[k - 1]) @ given[k]
    np.testing.assert_allclose(chained(jnp.asarray(given), trip), expected, rtol=1e-10)


def test_folds_keep_routes_whole():
    route = np.repeat(np.arange(11), 5)
    folds = [*route_folds(route, 3, 0)]
    np.testing.assert_array_equal(np.sum(folds, axis=0), 1)
    assert all(len(set(route[f]) & set(route[~f])) == 0 for f in folds)


def test_accuracies_by_hand():
    table = np.array([[8, 2, 0], [1, 9, 0], [0, 4, 6]])
    assert equation_1(table) == pytest.approx(23 / (3 * 30)), "the accuracy over the number of classes"
    assert macro_f1(table) == pytest.approx(np.mean([16 / 19, 18 / 25, 12 / 16]))
    gear = np.repeat([1, 2, 3], 10)
    told = np.concatenate([np.repeat(np.arange(1, 4), r) for r in table])
    assert balanced_accuracy(gear, told) == pytest.approx(23 / 30)


def test_gears_of_a_few_rows_are_not_scored():
    gear, told = np.repeat([1, 2, 3], [60, 29, 30]), np.repeat([1, 1, 3], [60, 29, 30])
    assert balanced_accuracy(gear, told) == 1.0
    np.testing.assert_array_equal(scored(gear), gear != 2)
    assert balanced_accuracy(gear[50:70], told[50:70]) == 0.5, "no gear has enough rows"


def test_gears_taken_as_equally_common():
    p = np.array([[0.7, 0.3, 0.0], [0.95, 0.05, 0.0], [0.6, 0.0, 0.4]])
    np.testing.assert_array_equal(alike(p, np.array([0.9, 0.1, 0.0]), 0.0), [1, 0, 0])  # the third was never seen
    np.testing.assert_array_equal(alike(p, np.array([0.9, 0.1, 0.0]), 0.5), [0, 0, 0])
    by_row = np.array([[0.9, 0.1, 0.1], [0.9, 0.01, 0.1], [0.1, 0.1, 0.9]])
    np.testing.assert_array_equal(alike(p, by_row, 0.0), [1, 1, 0])


def test_gears_taken_as_equally_common_have_the_best_balanced_accuracy():
    """Where the probabilities are right, no other decision is better but by chance: Bayes' rule."""
    rng = np.random.default_rng(3)
    share = np.array([0.9, 0.08, 0.02])
    gear = rng.choice(3, 40_000, p=share)
    x = gear + rng.normal(size=len(gear))
    p = share * np.exp(-0.5 * (x[:, None] - np.arange(3)) ** 2)
    p /= p.sum(axis=1, keepdims=True)
    likeliest, best = balanced_accuracy(gear, np.argmax(p, axis=1)), balanced_accuracy(gear, alike(p, share, 0.0))
    # a row of each gear alone: Φ(½), 2Φ(½) − 1, Φ(½)
    assert best == pytest.approx((2 * 0.69146 + 0.38292) / 3, abs=0.02)
    assert best > likeliest + 0.1


@pytest.mark.parametrize("kind", ["decision_tree", "catboost", "lightgbm"])
def test_a_search_finds_gears_and_its_trees_are_the_library(kind):
    rng = np.random.default_rng(4)
    x = rng.uniform(0, 1, (900, 2)).astype(np.float32)
    gear = 1 + np.searchsorted([0.3, 0.7], x[:, 0] + 0.1 * x[:, 1])
    model = search_classifier(
        kind, x, gear, np.arange(900) // 30, features=("a", "b"), trials=1, folds=2, seed=0, search_rows=400
    )
    p = model.probabilities(x)
    assert np.mean(1 + np.argmax(p, axis=1) == gear) > 0.95
    if kind == "decision_tree":
        with pytest.raises(InputError, match="boosted trees"):
            model.trees()
    else:
        trees = model.trees()
        np.testing.assert_allclose(jax.jit(lambda z: trees.probabilities(z))(x), p, atol=1e-5)
        assert trees.classes == (1.0, 2.0, 3.0)
