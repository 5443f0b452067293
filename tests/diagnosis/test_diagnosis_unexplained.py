"""What is left: cycles are found with their period and size whatever their phase, noise has none; levels; formulas."""

import numpy as np
import pytest

from hdev_jax.diagnosis.expression import Factor, _power_unit, monomials
from hdev_jax.diagnosis.problem import prepare
from hdev_jax.diagnosis.unexplained import Rows, _levels, _period
from hdev_jax.diagnosis.whiten import estimate_noise
from hdev_jax.fleet import synthetic_log
from hdev_jax.inference import Clusters
from hdev_jax.inference.sheet import read_sheet
from hdev_jax.logs import read_log
from hdev_jax.units import _SUFFIXES


def residual(rng, trips: int, rows: int, *, rho: float = 0.0, cycles: float = 0.0, size: float = 0.0) -> Rows:
    """AR(1) noise of variance 1 with a sine of RMS `size` of a phase of its own in each trip; rows of 2 s."""
    noise = rng.standard_normal((trips, rows))
    for k in range(1, rows):
        noise[:, k] = rho * noise[:, k - 1] + np.sqrt(1 - rho**2) * noise[:, k]
    clock = np.arange(rows) / rows
    wave = np.sqrt(2) * np.sin(2 * np.pi * (cycles * clock + rng.random((trips, 1))))
    trip = np.repeat(np.arange(trips), rows)
    clusters = Clusters(trip, trips, "trip")
    n = trips * rows
    return Rows(np.zeros((n, 1)), (noise + size * wave).ravel(), clusters, trip, np.full(n, 2.0), np.ones(n), "kW")


def _without_levels(rows):
    return estimate_noise(rows.residual, rows.trip, rows.duration_s, levels=False)


def cycle_of(rows):
    return _period(rows, _without_levels(rows))


@pytest.mark.parametrize("rho", [0.0, 0.97])
@pytest.mark.parametrize(("trips", "cycles", "size"), [(3, 5, 3.0), (3, 8.5, 3.0), (8, 4, 3.0), (12, 3, 3.0)])
def test_a_cycle_is_found_with_its_period_and_size(rho, trips, cycles, size):
    found = cycle_of(residual(np.random.default_rng(1), trips, 300, rho=rho, cycles=cycles, size=size))
    assert found is not None
    assert found.period_s == pytest.approx(600.0 / cycles, rel=0.03)
    assert found.amplitude == pytest.approx(np.sqrt(2) * size, rel=0.12)


def test_a_single_trip_is_its_own_repetition():
    found = cycle_of(residual(np.random.default_rng(2), 1, 3000, cycles=40, size=1.0))
    assert found is not None
    assert found.period_s == pytest.approx(150.0, rel=0.02)


@pytest.mark.parametrize("rho", [0.0, 0.9, 0.97])
@pytest.mark.parametrize("trips", [1, 2, 3, 12])
def test_noise_has_no_cycle(rho, trips):
    rng = np.random.default_rng(3)
    assert sum(cycle_of(residual(rng, trips, 300, rho=rho)) is not None for _ in range(40)) <= 1


@pytest.mark.parametrize("rho", [0.0, 0.9, 0.97])
@pytest.mark.parametrize("trips", [9, 24])
def test_slow_noise_has_no_levels_of_trips(rho, trips):
    rng = np.random.default_rng(5)
    logs = [residual(rng, trips, 250, rho=rho) for _ in range(20)]
    assert all(_levels(rows, _without_levels(rows)) is None for rows in logs)


def test_a_trip_of_a_few_rows_does_not_hide_the_levels_of_the_others():
    rng = np.random.default_rng(4)
    rows = residual(rng, 8, 200)
    level = np.repeat(rng.normal(0, 2.0, 8), 200)
    trip, values = np.r_[rows.trip, 8, 8, 8], np.r_[rows.residual + level, 0.1, 0.0, -0.1]
    short = Rows(np.zeros((1603, 1)), values, Clusters(trip, 9, "trip"), trip, np.full(1603, 2.0), np.ones(1603), "kW")
    found = _levels(short, _without_levels(short))
    assert found is not None
    assert found[2] == pytest.approx(np.std(level), rel=0.3)


@pytest.mark.parametrize("suffix", [s for kind in _SUFFIXES.values() for s in kind])
def test_every_suffix_gives_a_coefficient_its_unit(suffix):
    assert _power_unit((Factor(f"something_{suffix}"), Factor("speed_mps", 2)))


def test_monomials_carry_units_that_make_a_power(tmp_path):
    files = synthetic_log(seed=3, trips=6, rows_per_trip=60).write(tmp_path, truth=False)
    problem = prepare(read_log([files["log"]]), read_sheet(files["sheet"]))
    sets = monomials(problem.segments, len(problem.segments))
    assert len(set(sets)) == len(sets)
    assert any({f.name for f in s} == {"humidity_pct", "cloud_cover"} for s in sets)
    square = Factor("ambient_temp_c", 2, 12.5)
    assert square.words() == "(ambient_temp_c − 12.5)²"
    np.testing.assert_allclose(square(problem.segments), (problem.segments.channels["ambient_temp_c"] - 12.5) ** 2)
    above = Factor("humidity_pct", above=70.0)
    assert above.words() == "[humidity_pct > 70]"
    np.testing.assert_array_equal(above(problem.segments), problem.segments.channels["humidity_pct"] > 70.0)
