"""What drifts is named by where it is large: everywhere, with the speed, with the power."""

import numpy as np
import pytest
from scipy import signal

from hdev_jax.diagnosis.remainder.drift import Slow, drift_of
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
    steps = np.sqrt(1 - kept**2) * rng.standard_normal((TRIPS, SECONDS))
    steps[:, 0] = rng.standard_normal(TRIPS)
    return signal.lfilter([1.0], [1.0, -kept], steps, axis=1).ravel()


@pytest.mark.parametrize(
    ("like", "size"), [("load", 3000.0), ("force", 400.0), ("gain", 0.1)], ids=["load", "force", "gain"]
)
def test_it_is_called_what_it_is_with_its_size_and_memory(like, size):
    trip, speed, power, seconds, rng = drive(1)
    by = {"load": np.ones(len(trip)), "force": speed, "gain": power}[like]
    residual = size * by * wandering(rng, 300.0) + 1500.0 * rng.standard_normal(len(trip))
    found = drift_of(Slow.of(residual, power, speed, seconds, trip), SETTINGS)
    assert found.like == like
    assert 0.7 * size < found.sd < 1.4 * size
    assert 120.0 <= found.memory_s <= 720.0
    assert like in found.words
    assert "e+" not in found.words


@pytest.mark.parametrize("seed", range(5))
def test_white_noise_does_not_drift(seed):
    trip, speed, power, seconds, rng = drive(seed)
    found = drift_of(Slow.of(3000.0 * rng.standard_normal(len(trip)), power, speed, seconds, trip), SETTINGS)
    assert (found.like, found.memory_s, found.words) == ("none", 0.0, "")
    assert found.course(Slow.of(power, power, speed, seconds, trip), "abcdefgh", [0]) is None


def test_a_short_log_says_nothing():
    found = drift_of(Slow.of(*[np.ones(50)] * 4, np.zeros(50, int)), SETTINGS)
    assert found.memory_s == 0.0


@pytest.mark.parametrize("like", ["load", "gain"])
def test_its_energy_in_a_trip_lies_in_its_interval(like):
    held = []
    for seed in range(4):
        trip, speed, power, seconds, rng = drive(seed)
        drifting = {"load": 3000.0, "gain": 0.1 * power}[like] * wandering(rng, 300.0)
        slow = Slow.of(drifting + 1500.0 * rng.standard_normal(len(trip)), power, speed, seconds, trip)
        found = drift_of(slow, SETTINGS).course(slow, "abcdefgh", [2, 5])
        assert found is not None
        for t, (_, low, high) in enumerate(found["kwh_by_trip"].values()):
            held.append(low <= np.sum(drifting[trip == t]) / 3.6e6 <= high)
        assert found["trip"] in "cf"
        true = drifting[trip == "abcdefgh".index(found["trip"])].reshape(-1, 60).mean(axis=1)
        assert np.corrcoef(true, found["power_w"])[0, 1] > 0.9
        assert np.mean((true >= found["lower_w"]) & (true <= found["upper_w"])) > 0.75
    assert np.mean(held) > 0.75  # 90 % of 32, less three standard errors
