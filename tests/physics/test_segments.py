"""Rows made from arrays."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hdev_jax.physics import Aero, Driveline, Grade, Inertia, Rolling, Vehicle
from hdev_jax.segments import Segments


def test_what_is_left_out_follows_from_the_rest():
    s = Segments.from_arrays(
        duration_s=[1.0, 2.0, 4.0], speed_start_mps=10.0, speed_end_mps=[10.0, 12.0, 10.0], trip=[0, 0, 1], mass_kg=2e4
    )
    np.testing.assert_allclose(s.distance_m, [10.0, 22.0, 40.0])
    np.testing.assert_allclose(s.time_s, [0.0, 1.0, 0.0])
    np.testing.assert_allclose(s.channels["mass_kg"], 2e4)
    assert len(s) == 3


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"grade_rad": np.zeros(2)}, "one length"),
        ({"duration_s": [1.0, 0.0, 1.0]}, "longer than 0 s"),
        ({"distance_m": [1.0]}, "3 values, one a row"),
        ({"trip": [0, 0]}, "3 values, one a row"),
    ],
)
def test_arrays_that_do_not_go_together(changed, words):
    given = {"duration_s": np.ones(3), "speed_start_mps": 5.0, "speed_end_mps": np.full(3, 5.0)} | changed
    with pytest.raises(ValueError, match=words):
        Segments.from_arrays(**given)


def test_the_gradient_of_a_trips_energy_in_five_lines():
    rows = Segments.from_arrays(duration_s=np.full(5, 10.0), speed_start_mps=15.0, speed_end_mps=15.0, grade_rad=0.0)

    def energy(c_rr):
        terms = [Inertia(1.03), Grade(), Rolling(c_rr), Aero(5.6)]
        return Vehicle(terms, mass_kg=18e3, driveline=Driveline(0.91)).energy(rows).sum()

    # on the flat at constant speed: m·g·v·t / η, in Wh
    expected = 18e3 * 9.80665 * 15.0 * 50.0 / 0.91 / 3600.0
    assert jax.grad(energy)(jnp.asarray(0.006)) == pytest.approx(expected)
