"""What differs from trip to trip: the phase of a cycle, the trips of a mode."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from planted import run
from scipy import stats

from hdev_jax.diagnosis.modes import BEATS, _p, _split
from hdev_jax.physics.loads import PeriodicLoad


@given(
    st.floats(0.0, 5000.0), st.floats(0.1, 900.0), st.floats(60.0, 1500.0), st.floats(0.05, 0.95), st.floats(-1.0, 1.0)
)
def test_a_cycle_is_the_mean_of_its_square_wave(start, duration, period, duty, phase):
    on = PeriodicLoad(power_w=1.0, period_s=period, duty=duty, phase=phase).on(start, duration)
    t = start + duration * (np.arange(20_000) + 0.5) / 20_000
    wave = np.cos(2 * np.pi * (t / period + phase)) > np.cos(np.pi * duty)
    edges = 2 * duration / period + 2
    assert float(on) == pytest.approx(np.mean(wave), abs=1e-6 + edges / 20_000)


def test_a_cycle_of_unknown_phase_is_its_mean():
    load = PeriodicLoad(power_w=1.0, period_s=300.0, duty=0.3, phase=np.nan)
    assert float(load.on(120.0, 5.0)) == pytest.approx(0.3)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_a_cycle_out_of_step_from_trip_to_trip_is_named(seed):
    synthetic, result = run(seed, effects={"periodic_load": {}}, ratio=0.5, trips=12, ar_coefficient=0.97)
    summary, true = result.summary, synthetic.vehicle.effects["periodic_load"]
    assert [e["id"] for e in summary["effects"]] == ["periodic_load"]
    found = summary["effects"][0]["parameters"]
    assert found["period_s"]["value"] == pytest.approx(true["period_s"], rel=0.005)
    assert found["duty"]["value"] == pytest.approx(true["duty"], abs=0.03)
    assert abs(found["power_w"]["value"] - true["power_w"]) < 3.0 * found["power_w"]["sd"]
    phases = np.asarray(result.after.effect("periodic_load").phase.values)
    train = [int(name[1:]) for name in summary["split"]["train_trips"]]
    ours = phases[: len(synthetic.vehicle.phase)]
    assert np.isnan(phases[-1])  # a trip that nobody has fitted
    middle = np.array(synthetic.vehicle.phase) - true["duty"] / 2  # the truth counts from where the load goes on
    apart = (ours - middle[: len(ours)] + 0.5) % 1.0 - 0.5
    assert np.count_nonzero(np.isfinite(apart)) == len(train)
    assert np.nanmax(np.abs(apart)) < 0.06


@pytest.mark.slow
def test_a_cycle_that_the_library_does_not_hold_is_not_named():
    """A saw-tooth in six trips of ten: neither it nor its mean in each trip is pinned on a cause."""
    _, result = run(3932, effects={"outside_thermal_cycle": {}}, ratio=1.0, rows_per_trip=700, ar_coefficient=0.97)
    summary = result.summary
    assert summary["effects"] == []
    assert summary["unexplained"]["significant"]
    assert "time_s" in summary["unexplained"]["depends_on"]


@pytest.mark.slow
def test_the_trips_of_a_mode_are_told():
    synthetic, result = run(3, effects={"mode_change": {}}, ratio=0.5, trips=12, ar_coefficient=0.97)
    summary = result.summary
    assert [e["id"] for e in summary["effects"]] == ["mode_change"]
    assert set(summary["effects"][0]["parameters"]) >= {"regeneration", "share"}
    found = np.asarray(result.after.effect("mode_change").in_mode.values)[: len(synthetic.vehicle.lottery)]
    true = np.array(synthetic.vehicle.lottery) < synthetic.vehicle.effects["mode_change"]["share"]
    known = np.isfinite(found)
    assert np.all(found[known] == true[: len(found)][known])


def _grams(rng, sizes, rows=400):
    """Normal equations by trip of [common column | mode's column | residual], white noise of variance 1."""
    out = []
    for size in sizes:
        common, own = rng.normal(size=(2, rows))
        block = np.stack([common, own, 0.3 * common + size * own + rng.normal(size=rows)], axis=1)
        out.append(block.T @ block)
    return np.stack(out)


def test_trips_are_split_where_their_sizes_differ():
    rng = np.random.default_rng(0)
    truth = np.array([0, 1, 0, 0, 1, 0, 0, 1, 0, 0.0])
    split = _split(_grams(rng, 0.5 * truth), np.zeros((1, 1)), np.zeros(1))
    assert split is not None
    gain, z, size, left, over_levels = split
    assert np.array_equal(z, truth)
    assert size == pytest.approx(0.5, abs=0.1)
    assert gain > 50 > 20 > left
    assert over_levels > BEATS


@pytest.mark.parametrize("trips", [8, 16, 40])
@pytest.mark.parametrize("sd", [0.07, 0.1, 0.15, 0.5])  # of the sizes; a trip knows its own to 0.05
def test_sizes_that_differ_at_random_are_not_two(trips, sd):
    rng = np.random.default_rng(1)
    splits = [_split(_grams(rng, rng.normal(0, sd, trips)), np.zeros((1, 1)), np.zeros(1)) for _ in range(25)]
    assert sum(s is not None and s[4] > BEATS for s in splits) <= 1


def test_ways_to_split_many_trips_are_counted():
    assert _p(5.0, 2, 1) == pytest.approx(2.0 * stats.chi2.sf(10.0, 1))
    assert _p(100.0, 5000, 4) == 1.0
    assert _p(5000.0, 5000, 4) < 1e-100
