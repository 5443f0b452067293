"""c_rr and C_d·A that hold in a row: with them alone a vehicle has the force that all its effects have."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import physics_rows as made
import pytest

from hdev_jax.physics import LIBRARY, Vehicle, coefficients_that_hold, derived
from hdev_jax.segments import Segments


def held(car: Vehicle, log: Segments) -> tuple[np.ndarray, np.ndarray]:
    of = eqx.filter_jit(jax.vmap(lambda row: coefficients_that_hold(car, row)))
    c_rr, cda = of(jax.tree.map(jnp.asarray, derived(log)))
    return np.asarray(c_rr), np.asarray(cda)


def test_they_have_the_force_of_all_the_effects_in_the_kernel() -> None:
    added = [i for i, c in LIBRARY.items() if c.goes_with]
    plain = made.baseline()
    car = plain.plus(*(made.typical(i) for i in added))
    log = made.drives(*made.LENGTHS)
    c_rr, cda = held(car, log)
    moving = log.distance_m > 0
    assert moving.sum() > 10

    each = lambda c, a, row: made.baseline(c_rr=c, cda_m2=a).force(jax.tree.map(lambda x: x[None], row))[0]  # noqa: E731
    alone = jax.vmap(each)(c_rr, cda, jax.tree.map(jnp.asarray, log))
    expected = np.asarray(car.force(log))
    np.testing.assert_allclose(np.asarray(alone)[moving], expected[moving], rtol=1e-10)
    assert np.abs(expected - plain.force(log))[moving].min() > 1.0
    np.testing.assert_array_equal(c_rr[~moving], 0.006)
    np.testing.assert_array_equal(cda[~moving], 5.6)


def test_water_on_the_road_is_rolling_by_its_excess_and_drag_area_by_its_spray() -> None:
    """At any weight and speed: the two are told apart by what they go with."""
    log = made.drives(*made.LENGTHS)
    log = dataclasses.replace(log, channels={**log.channels, "wet_road": np.linspace(0.1, 1.0, len(log))})
    c_rr, cda = held(made.baseline().plus(made.typical("wet_road")), log)
    moving, wet = log.distance_m > 0, log.channels["wet_road"]
    np.testing.assert_allclose(c_rr[moving], (0.006 * (1 + 0.3 * wet))[moving], rtol=1e-12)
    np.testing.assert_allclose(cda[moving], (5.6 * (1 + 0.2 * wet))[moving], rtol=1e-12)


def test_a_vehicle_without_drag_has_no_such_coefficients() -> None:
    with pytest.raises(KeyError, match="aero"):
        held(made.baseline().minus("aero"), made.drives(3))
