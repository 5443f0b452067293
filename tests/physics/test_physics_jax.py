"""What JAX does with the kernel: jit, vmap, both modes, compilations; the map and grouped coefficients; imports."""

import subprocess
import sys
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import physics_rows as made
import pytest
from map_reference import map_by_scipy
from scipy.interpolate import PchipInterpolator

from hdev_jax.physics import EfficiencyMap, Grouped, Vehicle

THETA = np.array([0.006, 5.6, 0.91, 1.05])
WITH = ("headwind", "tyre_warmup", "time_skew")  # of a row, of what goes before in a trip, across rows


def car_at(theta: Any) -> Vehicle:
    car = made.baseline(c_rr=theta[0], cda_m2=theta[1], efficiency=theta[2], rotating=theta[3])
    return car.plus(*(made.typical(i) for i in WITH))


def energy(theta: Any, log: Any) -> Any:
    return car_at(theta).energy(log)


# --- transformations -----------------------------------------------------------------------------------------------


def test_jit_vmap_and_both_modes() -> None:
    log = made.drives(*made.LENGTHS)
    plain, compiled = energy(THETA, log), jax.jit(energy)
    np.testing.assert_allclose(compiled(THETA, log), plain, rtol=1e-12)

    many = THETA * np.linspace(0.9, 1.1, 5)[:, None]
    batch = jax.jit(jax.vmap(energy, in_axes=(0, None)))(many, log)
    assert batch.shape == (5, len(log))
    np.testing.assert_allclose(batch[2], plain, rtol=1e-12)
    np.testing.assert_allclose(batch[4], compiled(many[4], log), rtol=1e-12)

    forward, reverse = jax.jit(lambda *x: (jax.jacfwd(energy)(*x), jax.jacrev(energy)(*x)))(THETA, log)
    assert forward.shape == (len(log), 4)
    np.testing.assert_allclose(forward, reverse, rtol=1e-9, atol=1e-9)
    step = 1e-5 * np.array([1e-3, 0.5, 0.05, 0.02])
    difference = compiled(THETA + step, log) - compiled(THETA - step, log)
    np.testing.assert_allclose(2 * forward @ step, difference, rtol=1e-5, atol=1e-9)


def test_over_logs_of_one_shape() -> None:
    """vmap over a stack of logs, as over a fleet."""
    logs = [made.drives(7, 7, seed=s) for s in range(3)]
    stack = jax.tree.map(lambda *x: np.stack(x), *logs)
    evaluate = jax.jit(lambda log: energy(THETA, log))
    together = jax.vmap(evaluate)(stack)
    for one, log in zip(together, logs, strict=True):
        np.testing.assert_allclose(one, evaluate(log), rtol=1e-11, atol=1e-11)


def test_linear_in_what_is_linear() -> None:
    """The second derivative in (c_rr, cda) is zero away from the switch: equation 4 is linear in them."""
    log = made.drives(*made.LENGTHS)
    hessian = jax.jit(jax.hessian(lambda t: jnp.sum(made.baseline(c_rr=t[0], cda_m2=t[1]).energy(log))))
    np.testing.assert_array_equal(hessian(THETA[:2]), 0.0)


@pytest.mark.parametrize("entry", ["road", "wheel", "shaft"])
def test_one_compilation_for_many_values_and_one_a_shape(entry: str) -> None:
    traced = eqx.debug.assert_max_traces(lambda car, log: car.energy(log), max_traces=2)
    evaluate = eqx.filter_jit(traced)
    car = made.baseline(entry).plus(made.typical("battery_resistance"), made.typical("regen_limit"))
    for k in range(5):
        longer = jax.tree.map(lambda x, k=k: jnp.asarray(x) * (1 + 0.01 * k), car)
        evaluate(longer, made.drives(6, 6, seed=k))
        evaluate(car, made.drives(6, 6, seed=k))
    assert eqx.debug.get_num_traces(traced) == 1
    evaluate(car, made.drives(6, 7))
    assert eqx.debug.get_num_traces(traced) == 2


def test_a_vehicle_is_data() -> None:
    """Equal structure whatever the numbers, so that jit sees one vehicle; every number is a leaf."""
    one, two = made.baseline(), made.baseline(c_rr=0.008, cda_m2=4.0)
    assert jax.tree.structure(one) == jax.tree.structure(two)
    assert jax.tree.structure(one) != jax.tree.structure(made.baseline("wheel"))
    assert all(isinstance(x, np.ndarray | jax.Array) for x in jax.tree.leaves(one))


def test_effects_are_named_in_profiles() -> None:
    car, log = made.baseline().plus(made.typical("headwind")), made.drives(*made.LENGTHS)
    text = jax.jit(lambda c, s: c.energy(s)).lower(car, log).as_text(debug_info=True)
    for effect in ("rolling", "aero", "headwind", "auxiliary"):
        assert effect in text


# --- the efficiency map --------------------------------------------------------------------------------------------


@pytest.fixture
def surface() -> EfficiencyMap:
    rng = np.random.default_rng(5)
    return EfficiencyMap(
        jnp.array([1.0, 2.0, 4.0]),
        jnp.array([50.0, 100.0, 180.0, 300.0]),
        jnp.array([-400.0, -50.0, 0.0, 90.0, 500.0]),
        jnp.asarray(rng.uniform(0.7, 0.97, (3, 4, 5))),
    )


@jax.jit
def _seen(surface: EfficiencyMap, points: Any) -> Any:
    return jax.vmap(surface)(*points)


def at(surface: EfficiencyMap, gear: Any, speed: Any, torque: Any) -> np.ndarray:
    """The map at some points, at most 300, by one program for all tests."""
    points = np.stack(np.broadcast_arrays(gear, speed, torque)).astype(float).reshape(3, -1)
    n = points.shape[1]
    return np.asarray(_seen(surface, np.pad(points, ((0, 0), (0, 300 - n)), mode="edge")))[:n]


def test_map_is_exact_at_its_nodes(surface: EfficiencyMap) -> None:
    g, s, t = jnp.meshgrid(surface.gears, surface.speeds_radps, surface.torques_nm, indexing="ij")
    found = at(surface, g, s, t)
    np.testing.assert_allclose(found, surface.values.ravel(), rtol=1e-15)


def test_map_is_the_monotone_cubic_along_its_lines_and_clamped_outside(surface: EfficiencyMap) -> None:
    z, axes = np.asarray(surface.values), (np.asarray(surface.speeds_radps), np.asarray(surface.torques_nm))
    x, y = np.linspace(50, 300, 41), np.linspace(-400, 500, 41)
    for k, torque in enumerate(axes[1]):
        expected = PchipInterpolator(axes[0], z[1, :, k])(x)
        np.testing.assert_allclose(at(surface, 2.0, x, torque), expected, rtol=1e-12)
    for k, speed in enumerate(axes[0]):
        expected = PchipInterpolator(axes[1], z[2, k])(y)
        np.testing.assert_allclose(at(surface, 4.0, speed, y), expected, rtol=1e-12)
    for speed, torque, corner in [(0.0, -1e6, (0, 0)), (1e6, -1e6, (3, 0)), (0.0, 1e6, (0, 4)), (1e6, 1e6, (3, 4))]:
        np.testing.assert_allclose(at(surface, 1.0, speed, torque), z[0][corner], rtol=1e-15)
    points = np.random.default_rng(3).uniform((40.0, -450.0), (320.0, 550.0), (60, 2))
    expected = [map_by_scipy(axes[0], axes[1], z[1], w, t) for w, t in points]
    np.testing.assert_allclose(at(surface, 2.0, *points.T), expected, rtol=1e-12)
    # one coordinate outside: the edge
    np.testing.assert_allclose(at(surface, 1.0, 400.0, 45.0), at(surface, 1.0, 300.0, 45.0), rtol=1e-14)
    rng = np.random.default_rng(0)
    many = at(surface, rng.uniform(0, 6, 300), rng.uniform(-50, 500, 300), rng.uniform(-900, 900, 300))
    span = np.max(z) - np.min(z)
    assert np.min(z) - 0.05 * span <= np.min(many), "off the lines it may pass its nodes a little"
    assert np.max(many) <= np.max(z) + 0.05 * span


def test_map_of_a_plane_is_the_plane(surface: EfficiencyMap) -> None:
    speeds, torques = jnp.linspace(0.0, 300.0, 4), jnp.linspace(-400.0, 400.0, 5)
    plane = 0.9 - 2e-4 * speeds[:, None] + 1e-4 * torques[None, :]
    flat = EfficiencyMap(jnp.array([1.0, 2.0, 4.0]), speeds, torques, jnp.stack([plane] * 3))
    s, t = np.random.default_rng(1).uniform(0, 300, 50), np.random.default_rng(2).uniform(-400, 400, 50)
    np.testing.assert_allclose(at(flat, 1.0, s, t), 0.9 - 2e-4 * s + 1e-4 * t, rtol=1e-12)


def test_map_takes_the_nearest_gear(surface: EfficiencyMap) -> None:
    for gear, nearest in [(0.0, 1.0), (1.2, 1.0), (3.4, 4.0), (9.0, 4.0)]:
        assert at(surface, gear, 120.0, 30.0) == at(surface, nearest, 120.0, 30.0)


def test_map_has_a_continuous_gradient(surface: EfficiencyMap) -> None:
    f = lambda m, x: m(2.0, x[0], x[1])  # noqa: E731
    inside = np.array([[130.0, 60.0], [60.0, -300.0], [299.0, 499.0]])
    # over the lines of the grid, along both axes
    lines = np.array([[100.0, 45.0], [180.0, -200.0], [130.0, 90.0], [260.0, 0.0]])
    over = [point + k * 1e-7 * step for point in lines for step in np.eye(2) for k in (-1, 0, 1)]
    points = np.array([*inside, [400.0, 45.0], *over])
    slopes = lambda m, x: (*jax.grad(f, (0, 1), allow_int=True)(m, x), jax.jacfwd(f, 1)(m, x))  # noqa: E731
    grown, reverse, forward = jax.jit(jax.vmap(slopes, (None, 0)))(surface, points)
    np.testing.assert_allclose(reverse, forward, rtol=1e-9, atol=1e-12)
    for axis, step in enumerate(1e-4 * np.eye(2)):
        more, less = (at(surface, 2.0, *(inside + x).T) for x in (step, -step))
        np.testing.assert_allclose(reverse[:3, axis], (more - less) / 2e-4, rtol=1e-6, atol=1e-9)
    # past an edge the slope across it is zero and the one along it stays
    across, along = reverse[3]
    assert across == 0.0
    assert along != 0.0
    left, here, right = np.moveaxis(np.reshape(reverse[4:], (-1, 3, 2)), 1, 0)
    np.testing.assert_allclose(left, here, atol=1e-8)
    np.testing.assert_allclose(right, here, atol=1e-8)
    # the map's own values take a gradient: it can be fitted
    np.testing.assert_allclose(np.sum(grown.values, axis=(1, 2, 3))[0], 1.0)


def test_map_under_strict_promotion(surface: EfficiencyMap) -> None:
    log = made.drives(*made.LENGTHS)
    with jax.numpy_dtype_promotion("strict"):
        assert np.all(np.isfinite(made.baseline(efficiency=surface).energy(log)))


# --- one value a group ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("by", ["vehicle", "trip", "gear"])
def test_grouped_is_each_group_by_itself(by: str) -> None:
    log = made.drives(*made.LENGTHS)
    ids = np.asarray({"vehicle": log.vehicle, "trip": log.trip, "gear": log.channels["gear"]}[by]).astype(int)
    values = np.array([0.004, 0.006, 0.008, 0.010, 0.012])
    found = np.asarray(made.baseline(c_rr=Grouped(jnp.asarray(values), by)).energy(log))
    for k in np.unique(ids):
        alone = np.asarray(made.baseline(c_rr=values[k]).energy(log))
        np.testing.assert_allclose(found[ids == k], alone[ids == k], rtol=1e-14)
    jacobian = jax.jacfwd(lambda c: made.baseline(c_rr=Grouped(c, by)).energy(log))(jnp.asarray(values))
    assert np.all((np.asarray(jacobian) == 0) | (ids[:, None] == np.arange(5)))


def test_an_id_past_the_end_takes_the_last_value() -> None:
    log = made.drives(4, 4, 4)
    short = made.baseline(c_rr=Grouped(jnp.array([0.004, 0.009]), "trip")).energy(log)
    full = made.baseline(c_rr=Grouped(jnp.array([0.004, 0.009, 0.009]), "trip")).energy(log)
    np.testing.assert_array_equal(short, full)


def test_effects_that_read_a_grouped_coefficient_get_the_rows_own() -> None:
    """The headwind scales with the drag area of the row's vehicle."""
    log = made.drives(*made.LENGTHS)
    areas = np.array([4.0, 7.0])
    wind = lambda cda: np.asarray(made.baseline(cda_m2=cda).plus(made.typical("headwind")).breakdown(log)["headwind"])  # noqa: E731
    found = wind(Grouped(jnp.asarray(areas), "vehicle"))
    for k in range(2):
        np.testing.assert_allclose(found[log.vehicle == k], wind(areas[k])[log.vehicle == k], rtol=1e-13)


# --- imports -------------------------------------------------------------------------------------------------------


def test_physics_imports_nothing_heavy() -> None:
    """Importing the kernel loads JAX, Equinox, jaxtyping and NumPy with what they load, and nothing else; no x64."""
    code = """
import sys
import equinox, jax, jax.numpy, jaxtyping, numpy
before = {name.partition(".")[0] for name in sys.modules} | set(sys.stdlib_module_names)
import hdev_jax.physics
after = {name.partition(".")[0] for name in sys.modules}
print(sorted(n for n in after - before if not n.startswith("_")), jax.config.jax_enable_x64)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "['hdev_jax'] False"
