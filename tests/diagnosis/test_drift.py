"""What drifts is named by where it is large: everywhere, with the speed, with the power."""

import numpy as np
import pytest

from hdev_jax.diagnosis.remainder.drift import drift_of
from hdev_jax.diagnosis.settings import SETTINGS

TRIPS, SECONDS = 8, 3600


def drive(seed):
    rng = np.random.default_rng(seed)
    n = TRIPS * SECONDS
    trip = np.repeat(np.arange(TRIPS), SECONDS)
    speed = np.repeat(rng.choice([0.0, 4.0, 10.0, 20.0], n // 120), 120)
    power = 1e3 + 3e3 * speed * np.repeat(rng.choice([0.2, 1.0, 2.0], n // 60), 60)
    return trip, speed, power, np.ones(n), rng


def wandering(rng, memory_s):
    kept = np.exp(-1.0 / memory_s)
    out = np.empty((TRIPS, SECONDS))
    for k in range(TRIPS):
        x = rng.standard_normal()
        for t in range(SECONDS):
            x = kept * x + np.sqrt(1 - kept**2) * rng.standard_normal()
            out[k, t] = x
    return out.ravel()


@pytest.mark.parametrize(
    ("like", "size"), [("load", 3000.0), ("force", 400.0), ("gain", 0.1)], ids=["load", "force", "gain"]
)
def test_it_is_called_what_it_is_with_its_size_and_memory(like, size):
    trip, speed, power, seconds, rng = drive(1)
    by = {"load": np.ones(len(trip)), "force": speed, "gain": power}[like]
    residual = size * by * wandering(rng, 300.0) + 1500.0 * rng.standard_normal(len(trip))
    found = drift_of(residual, power, speed, seconds, trip, SETTINGS)
    assert found.like == like
    assert 0.7 * size < found.sd < 1.4 * size
    assert 120.0 <= found.memory_s <= 720.0
    assert like in found.words


@pytest.mark.parametrize("seed", range(5))
def test_white_noise_does_not_drift(seed):
    trip, speed, power, seconds, rng = drive(seed)
    found = drift_of(3000.0 * rng.standard_normal(len(trip)), power, speed, seconds, trip, SETTINGS)
    assert (found.like, found.memory_s, found.words) == ("none", 0.0, "")


def test_a_short_log_says_nothing():
    found = drift_of(np.ones(50), np.ones(50), np.ones(50), np.ones(50), np.zeros(50, int), SETTINGS)
    assert found.memory_s == 0.0
