"""The mode of each trip by a chain from trip to trip."""

import numpy as np

from hdev_jax.inference.states import probability_of_modes


def fits(values, sure=6.0):
    """Log-likelihoods of trips that speak for a mode by so much; 0 speaks for none."""
    x = sure * np.asarray(values, dtype=float)
    return np.stack([-0.5 * x, 0.5 * x], axis=1)


def test_trips_that_say_it_are_in_their_mode():
    truth = np.r_[-np.ones(8), np.ones(5), -np.ones(3)]
    p = probability_of_modes(fits(truth), np.zeros(16, int))
    np.testing.assert_array_equal(p > 0.5, truth > 0)
    assert np.all(np.abs(p - 0.5) > 0.45)


def test_a_trip_that_says_nothing_is_in_the_mode_of_those_beside_it():
    truth = np.r_[-np.ones(8), np.ones(8)]
    silent = truth.copy()
    silent[[3, 12]] = 0.0
    p = probability_of_modes(fits(silent), np.zeros(16, int))
    assert p[3] < 0.1
    assert p[12] > 0.9
    doubtful = truth.copy()
    doubtful[12] = -0.3
    assert probability_of_modes(fits(doubtful), np.zeros(16, int))[12] > 0.5


def test_vehicles_do_not_tell_each_other_their_mode():
    both = np.r_[np.ones(7), 0.0, 0.0, -np.ones(7)]
    one = probability_of_modes(fits(both), np.zeros(16, int))
    two = probability_of_modes(fits(both), np.repeat([0, 1], 8))
    assert one[7] < two[7]  # in one vehicle neighbours pull each other
    assert one[8] > two[8]
    assert two[7] > 0.8
    assert two[8] < 0.2


def test_modes_that_alternate_are_followed():
    truth = np.tile([1.0, -1.0], 8)
    p = probability_of_modes(fits(truth, sure=3.0), np.zeros(16, int))
    np.testing.assert_array_equal(p > 0.5, truth > 0)
