"""What differs from trip to trip: the phase of a cycle, the trips of a mode."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from planted import declared, opened, training
from scipy import stats

from hdev_jax.diagnosis.candidates.candidate import Candidate
from hdev_jax.diagnosis.competition import cycle
from hdev_jax.diagnosis.competition.cycle import _fitted, _left_out_gain, _Rows, add_cycle
from hdev_jax.diagnosis.competition.mode import LASTING, _against, _p, _split, _stability, add_mode
from hdev_jax.diagnosis.gates.rejection import Kind
from hdev_jax.diagnosis.noise.noise import Noise
from hdev_jax.diagnosis.result.modes import mode_block
from hdev_jax.diagnosis.scores.evidence import Evidence, Score
from hdev_jax.diagnosis.settings import SETTINGS
from hdev_jax.physics.battery import ModeChange
from hdev_jax.physics.loads import PeriodicLoad


@settings(max_examples=40)
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


NOTHING = np.zeros((1, 1)), np.zeros(1)


def _grams(rng, sizes, rows=400):
    """Normal equations by trip of [common column | mode's column | residual], white noise of variance 1."""
    out = []
    for size in sizes:
        common, own = rng.normal(size=(2, rows))
        block = np.stack([common, own, 0.3 * common + size * own + rng.normal(size=rows)], axis=1)
        out.append(block.T @ block)
    return np.stack(out)


def _score(grams, z) -> Score:
    """The mode's column in the trips `z` as a candidate."""
    d = grams.shape[-1]
    nothing = np.zeros((0, d)), np.zeros(0), np.zeros(0, dtype=int), np.zeros(1)
    evidence = Evidence(grams, *nothing, d - 2, np.zeros(d - 2), np.zeros(d - 2))
    return evidence.within(z).score(Candidate(ModeChange, ("regeneration",), (None,), (), "size", (0,)))


def test_trips_are_split_where_their_sizes_differ():
    rng = np.random.default_rng(0)
    truth = np.array([0, 1, 0, 0, 1, 0, 0, 1, 0, 0.0])
    split = _split(_grams(rng, 0.5 * truth), np.zeros((1, 1)), np.zeros(1), SETTINGS)
    assert split is not None
    gain, z, size, left, over_levels = split
    assert np.array_equal(z, truth)
    assert size == pytest.approx(0.5, abs=0.1)
    assert gain > 50 > 20 > left
    assert over_levels > SETTINGS.ahead


def test_trips_that_follow_each_other_are_a_mode_where_nothing_else_says_it():
    """From one trip on: a change that stays, of what may change for good; of what may not, a mode like any other."""
    rng = np.random.default_rng(0)
    last, mixed = np.r_[np.zeros(7), 1.0, 1.0, 1.0], np.array([0, 1, 0, 0, 1, 0, 0, 1, 0, 0.0])
    for truth, lasting, why in (
        (last, True, "permanent"),
        (last, False, None),
        (mixed, True, None),
        (mixed, False, None),
    ):
        split = _split(_grams(rng, 0.5 * truth), *NOTHING, SETTINGS)
        assert split is not None
        said = _against(split, lasting, 3, 0.01, SETTINGS)
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
    split = _split(own, *NOTHING, SETTINGS)
    assert split is not None
    assert np.array_equal(split[1], truth)
    assert _score(own, truth).gain == pytest.approx(split[0])
    assert (_score(power, truth).gain < split[0] - SETTINGS.ahead) is ahead


# sd of the sizes; a trip knows its own to 0.05
@pytest.mark.parametrize(("trips", "sd"), [(8, 0.07), (8, 0.5), (16, 0.1), (16, 0.15), (40, 0.15)])
def test_sizes_that_differ_at_random_are_not_two(trips, sd):
    rng = np.random.default_rng(1)
    splits = [_split(_grams(rng, rng.normal(0, sd, trips)), np.zeros((1, 1)), np.zeros(1), SETTINGS) for _ in range(25)]
    assert sum(s is not None and s[4] > SETTINGS.ahead for s in splits) <= 1


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
    ("sizes", "confirmed"), [(np.ones(8), True), (np.zeros(8), False)], ids=["in every trip", "noise"]
)
def test_a_cycle_is_confirmed_on_trips_left_out(sizes, confirmed):
    for seed in range(2):
        rows = _noisy(seed, sizes)
        assert (_left_out_gain(rows, _fitted(rows, 80.0)[1], SETTINGS) > SETTINGS.ahead) is confirmed


def test_the_gain_of_a_cycle_on_a_trip_left_out_is_that_of_the_others_size():
    rows = _noisy(1, np.ones(4))
    column = _fitted(rows, 80.0)[1]
    total = 0.0
    for k, s in enumerate(rows.slices):
        others = np.concatenate([np.arange(o.start, o.stop) for i, o in enumerate(rows.slices) if i != k])
        size = float(np.linalg.lstsq(column[others, None], rows.white[others], rcond=None)[0][0])
        before, after = (0.5 * np.sum((rows.white[s] - x * column[s]) ** 2) for x in (0.0, size))
        total += before - after - SETTINGS.size_cost
    assert _left_out_gain(rows, column, SETTINGS) == pytest.approx(total)


def test_a_mode_is_confirmed_on_trips_left_out():
    rng = np.random.default_rng(0)
    truth = np.array([0, 1, 0, 0, 1, 0, 0, 1, 0, 1, 0, 1.0])
    grams = _grams(rng, 0.5 * truth)
    split = _split(grams, *NOTHING, SETTINGS)
    assert split is not None
    score = _score(grams, truth)
    assert 20.0 < score.left_out_gain - len(truth) * np.log(2.0) < split[0]
    assert score.p_cluster < 1e-4
    assert 0.8 < _stability(grams[None], [True], *NOTHING, 0.05, np.random.default_rng(0), SETTINGS) <= 1.0


def test_resampled_trips_are_held_to_the_rule_of_the_coefficient_that_is_chosen():
    """Trips that follow each other, of the second coefficient: no mode where that one's change may be for good."""
    rng = np.random.default_rng(0)
    truth = np.r_[np.zeros(8), np.ones(4)]
    every = np.stack([_grams(rng, np.zeros(12)), _grams(rng, 0.8 * truth)])
    again = [
        _stability(every, lasting, *NOTHING, 0.05, np.random.default_rng(0), SETTINGS)
        for lasting in ([True, False], [False, True])
    ]
    assert again[0] > 0.8
    assert again[1] == 0.0


def test_noise_has_a_split_that_gains_and_none_that_holds():
    """Where trips differ by chance alone the best split gains much of what it was chosen by; left out, it loses."""
    rng = np.random.default_rng(2)
    inside, outside, again = [], [], []
    for _ in range(4):
        grams = _grams(rng, np.zeros(12))
        split = _split(grams, *NOTHING, SETTINGS)
        assert split is not None
        inside.append(split[0])
        outside.append(_score(grams, split[1]).left_out_gain - 12 * np.log(2.0))
        again.append(_stability(grams[None], [False], *NOTHING, 0.05 / 30, np.random.default_rng(0), SETTINGS))
    assert np.median(inside) > SETTINGS.ahead > max(outside)
    assert np.mean(again) < 0.1


def test_one_odd_trip_is_no_mode_of_resampled_trips():
    """Drawn twice it is still one trip: a mode has two of them at least."""
    grams = _grams(np.random.default_rng(3), np.r_[2.0, np.zeros(11)])
    assert _stability(grams[None], [True], *NOTHING, 0.05, np.random.default_rng(0), SETTINGS) < 0.1


def _dated(problem, state):
    """The modes of all trips, those of the fit as they were found; each change has the start of its first trip."""
    found = state.found[0].score.candidate.by_trip["in_mode"]
    started = {name: 1.7e9 + 86400.0 * k for k, name in enumerate(problem.log.trip_names)}
    modes = mode_block(replace(problem, log=replace(problem.log, started_s=started)), state.fit)
    names = problem.log.trip_names
    assert list(modes["probability"]) == list(names)
    assert {t: float(modes["probability"][names[t]] > 0.5) for t in found} == found
    high = [x > 0.5 for x in modes["probability"].values()]
    first = [k for k in range(1, len(high)) if high[k] != high[k - 1]]
    assert [(c["trip"], c["to"]) for c in modes["changes"]] == [(names[k], ("first", "second")[high[k]]) for k in first]
    assert all(
        c["start"].startswith(f"2023-{11 + (14 + k) // 31}-") for c, k in zip(modes["changes"], first, strict=True)
    )
    assert all(c["start"] is None for c in mode_block(problem, state.fit)["changes"])


@pytest.mark.parametrize(("effect", "rows", "add"), [("mode_change", 80, add_mode), ("periodic_load", 160, add_cycle)])
def test_what_trips_left_out_do_not_confirm_is_not_added(effect, rows, add, tmp_path, monkeypatch):
    options = {"effects": {effect: {}}, "ratio": 1.0}
    _, problem, _ = opened(tmp_path, seed=7102, trips=12, rows_per_trip=rows, **options)
    log = training(problem, [effect])
    start = declared(log, problem)
    for left_out in (1.0, 200.0) if effect == "mode_change" else (1.0,):
        monkeypatch.setattr(Evidence, "left_out_gain_of_mode", lambda *_, x=left_out: x)
        monkeypatch.setattr(cycle, "_left_out_gain", lambda *_, x=left_out: x)
        state, verdict = add(log, start, np.random.default_rng(0))
        if left_out > SETTINGS.ahead:
            assert state is not None, verdict
            assert state.ids == (effect,)
            _dated(problem, state)
        else:
            assert verdict is not None
            assert verdict.rejection.kind is Kind.NOT_CONFIRMED
