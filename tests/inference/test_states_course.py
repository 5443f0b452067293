"""The smoothed course of what wanders against the conditional of one dense Gaussian."""

import numpy as np
import pytest

from hdev_jax.inference.states import course

LENGTHS = (9, 1, 14, 6)
SD, MEMORY_S = 2500.0, 240.0


@pytest.fixture(scope="module")
def rows():
    rng = np.random.default_rng(4)
    n = sum(LENGTHS)
    trip = np.repeat(np.arange(len(LENGTHS)), LENGTHS)
    seconds = rng.uniform(20.0, 120.0, n)
    return {
        "y": rng.normal(0.0, 3e3, n), "g": rng.uniform(0.0, 2.0, n), "noise_sd": rng.uniform(500.0, 2e3, n),
        "amount": seconds / 3.6e6 * rng.uniform(0.5, 1.5, n), "duration_s": seconds, "trip": trip,
    }  # fmt: skip


def dense(rows):
    """Mean and covariance of x given y, by the covariance matrix of all rows."""
    centre = np.cumsum(rows["duration_s"]) - 0.5 * rows["duration_s"]
    same = rows["trip"][:, None] == rows["trip"]
    prior = np.where(same, SD**2 * np.exp(-np.abs(centre[:, None] - centre) / MEMORY_S), 0.0)
    g = np.diag(rows["g"])
    gain = prior @ g @ np.linalg.inv(g @ prior @ g + np.diag(rows["noise_sd"] ** 2))
    return gain @ rows["y"], prior - gain @ g @ prior


def test_it_is_the_conditional_of_one_gaussian(rows):
    mean, covariance = dense(rows)
    found = course(**rows, sd=SD, memory_s=MEMORY_S)
    np.testing.assert_allclose(found.mean, mean, rtol=1e-8, atol=1e-6)
    np.testing.assert_allclose(found.sd, np.sqrt(np.diag(covariance)), rtol=1e-8)
    amounts = np.stack([np.where(rows["trip"] == t, rows["amount"], 0.0) for t in range(len(LENGTHS))])
    np.testing.assert_allclose(found.total, amounts @ mean, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(found.total_sd, np.sqrt(np.diag(amounts @ covariance @ amounts.T)), rtol=1e-7)


def test_a_row_that_measures_nothing_leaves_the_others_as_they_are(rows):
    silent = {**rows, "g": np.where(np.arange(len(rows["g"])) % 5 == 2, 0.0, rows["g"])}
    loud = {**silent, "y": np.where(silent["g"] == 0, 1e6, rows["y"])}
    np.testing.assert_allclose(*(course(**x, sd=SD, memory_s=MEMORY_S).mean for x in (silent, loud)), atol=1e-6)


def test_trips_are_sequences_of_their_own(rows):
    whole = course(**rows, sd=SD, memory_s=MEMORY_S)
    at = rows["trip"] == 2
    alone = course(**{k: v[at] for k, v in rows.items()}, sd=SD, memory_s=MEMORY_S)
    np.testing.assert_allclose(alone.mean, whole.mean[at], atol=1e-8)
    np.testing.assert_allclose(alone.total, whole.total[2:3], atol=1e-12)
