"""What differs from trip to trip: the phase of a cycle, the trips of a mode."""

import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from planted import run
from scipy import stats

from hdev_jax.diagnosis.candidates.cycles import COST, _fitted, _profile, _Rows
from hdev_jax.diagnosis.candidates.modes import BEATS, LASTING, _against, _gain, _left_out, _p, _split, _stability
from hdev_jax.diagnosis.diagnose import diagnose
from hdev_jax.diagnosis.noise.model import Noise
from hdev_jax.diagnosis.scores.ranking import LEFT_OUT
from hdev_jax.fleet import synthetic_log
from hdev_jax.inference.sheet import read_sheet
from hdev_jax.logs import read_log
from hdev_jax.physics import LIBRARY
from hdev_jax.physics.battery import ModeChange
from hdev_jax.physics.loads import PeriodicLoad
from hdev_jax.problem import prepare, split_trips


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
@pytest.mark.parametrize(("seed", "stood_in"), [(93344, "mode_change"), (93347, "cooling_power")])
def test_what_took_a_cycle_out_of_sight_is_not_named(seed, stood_in):
    """A cycle of a tenth of the variance in eight trips: beside what was named of it, its peak was no longer told."""
    _, result = run(
        seed, effects={"outside_thermal_cycle": {}}, ratio=0.35, trips=12, rows_per_trip=700, ar_coefficient=0.97
    )
    summary = result.summary
    assert summary["effects"] == []
    assert "the cycle that it covered" in next(c["why_not"] for c in summary["candidates"] if c["id"] == stood_in)
    assert summary["unexplained"]["significant"]
    assert re.search(r"a 2[456]-minute cycle", summary["unexplained"]["signature"])


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


NOTHING = np.zeros((1, 1)), np.zeros(1)


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


def test_trips_that_follow_each_other_are_a_mode_where_nothing_else_says_it():
    """From one trip on: a change that stays, of what may change for good; of what may not, a mode like any other."""
    rng = np.random.default_rng(0)
    last, mixed = np.r_[np.zeros(7), 1.0, 1.0, 1.0], np.array([0, 1, 0, 0, 1, 0, 0, 1, 0, 0.0])
    for truth, lasting, why in ((last, True, "stays"), (last, False, None), (mixed, True, None), (mixed, False, None)):
        split = _split(_grams(rng, 0.5 * truth), *NOTHING)
        assert split is not None
        said = _against(split, lasting, 3, 0.01)
        assert said is None if why is None else why in str(said)


def test_what_may_change_for_good():
    """The names that both effects have in common, and no more: regeneration has no lasting change of its own."""
    assert {n for sizes in ModeChange.variants for n in sizes} - LASTING == {"regeneration"}


def _gains_by_power(rng, sizes, of_mode: float):
    """Normal equations by trip of a mode's column and of the power, that differ in every other row; the residual
    follows the mode's column for so much, and for the rest the power."""
    own, power = [], []
    for size in sizes:
        p = rng.normal(size=400)
        recovered = np.maximum(-p, 0.0)
        residual = size * (of_mode * recovered + (1.0 - of_mode) * p) + rng.normal(size=400)
        for out, column in ((own, recovered), (power, p)):
            block = np.stack([np.ones(400), column, residual], axis=1)
            out.append(block.T @ block)
    return np.stack(own), np.stack(power)


@pytest.mark.parametrize(("of_mode", "ahead"), [(1.0, True), (0.0, False)])
def test_what_the_whole_power_says_is_no_second_value_of_a_coefficient(of_mode, ahead):
    truth = np.array([0, 1, 0, 0, 1, 0, 0, 1, 0, 1.0])
    own, power = _gains_by_power(np.random.default_rng(0), 0.5 * truth, of_mode)
    split = _split(own, *NOTHING)
    assert split is not None
    assert np.array_equal(split[1], truth)
    assert _gain(own, *NOTHING, truth) == pytest.approx(split[0])
    assert (_gain(power, *NOTHING, truth) < split[0] - BEATS) is ahead


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "first"), [(11, 9), (13, 9), (11, 7)])
def test_a_gain_of_the_last_trips_is_no_weak_regeneration(seed, first, tmp_path):
    """Six per cent more from a trip on, recovered or not: a sensor's gain, another mass."""
    made = synthetic_log(seed=seed, trips=12, ar_coefficient=0.97)
    names = sorted(made.frame["trip_id"].unique())
    made.frame.loc[made.frame["trip_id"].isin(names[first:]), "energy_wh"] *= 1.06
    files = made.write(tmp_path, truth=False)
    log, sheet = read_log([files["log"]]), read_sheet(files["sheet"])
    summary = diagnose(prepare(log, sheet), split_trips(log), LIBRARY).summary
    assert "mode_change" not in [e["id"] for e in summary["effects"]]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [2474, 2478])
def test_weak_regeneration_of_the_last_trips_is_a_mode(seed):
    """No lasting change of the library's is one of regeneration; beside it, what stood in for it goes."""
    summary = run(seed, effects={"mode_change": {}}, ratio=0.5, trips=12, ar_coefficient=0.97)[1].summary
    assert [e["id"] for e in summary["effects"]] == ["mode_change"]


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


# --- without some of the trips ----------------------------------------------------------------------------------------


def _noisy(seed, sizes, rows=200):
    """Rows of 2 s with white noise of variance 1 and a load of so much in each trip, on for 30 % of 80 s, of a phase of
    its own in each."""
    rng, trips = np.random.default_rng(seed), len(sizes)
    trip, clock = np.repeat(np.arange(trips), rows), np.tile(np.arange(rows) * 2.0 + 1.0, trips)
    n = trips * rows
    noise = Noise(np.zeros((2, 1)), np.ones(2), 0.0, np.ones(trips), 0.0)
    made = _Rows(clock, np.full(n, 2.0), trip, np.ones(n), noise, white=np.zeros(n))
    wave = (np.mod(clock / 80.0 + rng.random(trips)[trip], 1.0) < 0.3).astype(float)
    residual = np.repeat(sizes, rows) * wave + rng.standard_normal(n)
    return replace(made, white=made.whitened(residual[:, None])[:, 0])


@pytest.mark.parametrize(
    ("sizes", "borne_out", "again"),
    [(np.ones(8), True, 1.0), (np.zeros(8), False, 0.0), (np.r_[4.0, np.zeros(7)], False, 0.0)],
    ids=["in every trip", "noise", "in one trip"],
)
def test_trips_left_out_bear_a_cycle_out(sizes, borne_out, again):
    """The gain on trips left out and the share of resamples in which it is chosen are of trips, not of the best fit."""
    for seed in range(3):
        rows = _noisy(seed, sizes)
        profile = _profile(rows, _fitted(rows, 80.0)[0])
        assert (profile.left_out_gain() > LEFT_OUT) is borne_out
        stable = profile.stability(COST * (len(sizes) + 3), np.random.default_rng(0))
        assert stable == pytest.approx(again, abs=0.05)


def test_the_gain_of_a_cycle_on_a_trip_left_out_is_that_of_the_others_size():
    """The mean likelihood over phases, which are 1/40 of a period apart, with the size of the other trips."""
    rows = _noisy(1, np.ones(4))
    profile = _profile(rows, _fitted(rows, 80.0)[0])
    one = replace(profile, cross=profile.cross[:1], square=profile.square[:1])
    cross, square = one.own
    total = 0.0
    for t in range(4):
        others = np.arange(4) != t
        size = np.sum(cross[0, others]) / np.sum(square[0, others])
        likelihood = np.exp(size * one.cross[0, t] - 0.5 * size**2 * one.square[0, t])
        total += np.log(np.sum(likelihood) / 40.0)
    assert one.left_out_gain() == pytest.approx(total)


def test_trips_left_out_bear_a_mode_out():
    rng = np.random.default_rng(0)
    truth = np.array([0, 1, 0, 0, 1, 0, 0, 1, 0, 1, 0, 1.0])
    grams = _grams(rng, 0.5 * truth)
    split = _split(grams, *NOTHING)
    assert split is not None
    gain, p_cluster = _left_out(grams, *NOTHING, truth)
    assert 20.0 < gain < split[0]
    assert p_cluster < 1e-4
    assert 0.8 < _stability(grams[None], [True], *NOTHING, 0.05, np.random.default_rng(0)) <= 1.0


def test_resampled_trips_are_held_to_the_rule_of_the_coefficient_that_is_chosen():
    """Trips that follow each other, of the second coefficient: no mode where that one's change may be for good."""
    rng = np.random.default_rng(0)
    truth = np.r_[np.zeros(8), np.ones(4)]
    every = np.stack([_grams(rng, np.zeros(12)), _grams(rng, 0.8 * truth)])
    again = [
        _stability(every, lasting, *NOTHING, 0.05, np.random.default_rng(0))
        for lasting in ([True, False], [False, True])
    ]
    assert again[0] > 0.8
    assert again[1] == 0.0


def test_noise_has_a_split_that_gains_and_none_that_holds():
    """Where trips differ by chance alone the best split gains much of what it was chosen by; left out, it loses."""
    rng = np.random.default_rng(2)
    inside, outside, again = [], [], []
    for _ in range(15):
        grams = _grams(rng, np.zeros(12))
        split = _split(grams, *NOTHING)
        assert split is not None
        inside.append(split[0])
        outside.append(_left_out(grams, *NOTHING, split[1])[0])
        again.append(_stability(grams[None], [False], *NOTHING, 0.05 / 30, np.random.default_rng(0)))
    assert np.median(inside) > LEFT_OUT > max(outside)
    assert np.mean(again) < 0.1


def test_one_odd_trip_is_no_mode_of_resampled_trips():
    """Drawn twice it is still one trip: a mode has two of them at least."""
    grams = _grams(np.random.default_rng(3), np.r_[2.0, np.zeros(11)])
    assert _stability(grams[None], [True], *NOTHING, 0.05, np.random.default_rng(0)) < 0.1
