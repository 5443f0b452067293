"""Drives that would tell two causes apart: what is asked for is enough, less is not; what no drive tells is said so."""

import numpy as np
import pytest
from planted import found_in_turn, opened, training

from hdev_jax.diagnosis.result.next_drive import DRIVES, SEPARATED, _information, _prior, _relative_sd, advise, simulate
from hdev_jax.inference import padded
from hdev_jax.physics import LIBRARY


@pytest.fixture(scope="module")
def known(tmp_path_factory):
    """A log with a constant load in it, and a vehicle that has it."""
    effects = {"auxiliary_power": {"power_w": 3000.0}}
    options = {"effects": effects, "noise": "white", "noise_level": 0.05}
    _, problem, _ = opened(tmp_path_factory.mktemp("log"), seed=5, trips=4, rows_per_trip=60, **options)
    rows = training(problem, ["auxiliary_power"])
    return problem, found_in_turn(rows, problem, ["auxiliary_power"]), rows.rows


def test_a_drive_is_rows_like_the_logs(known):
    problem, _, _ = known
    for name, parts in DRIVES.items():
        drive = simulate(parts, problem)
        assert set(drive.channels) >= set(problem.segments.channels), name
        assert all(np.all(np.isfinite(v)) for v in drive.channels.values()), name
        assert np.sum(drive.duration_s) == pytest.approx(sum(p.seconds for p in parts), rel=0.2), name
        assert np.max(drive.speed_mps) <= 25.0, name


def test_what_is_advised_is_enough_and_less_is_not(known):
    problem, state, rows = known
    given = advise(problem, state, rows, [("auxiliary_power", LIBRARY["cabin_warmup"])], best=3)
    assert given
    assert [a.hours for a in given] == sorted(a.hours for a in given)
    at = np.array([k for k, c in enumerate(state.fit.table.free) if c.path == "effects.auxiliary_power.power_w"])
    logged = _information(problem, state, rows, [LIBRARY["cabin_warmup"]])["cabin_warmup"]
    for a in (a for a in given if a.drive):
        drive = simulate(DRIVES[a.drive], problem)
        there = padded(drive, np.zeros(len(drive)))
        extra = _information(problem, state, there, [LIBRARY["cabin_warmup"]])["cabin_warmup"]
        times = a.hours / (float(np.sum(drive.duration_s)) / 3600)
        assert times == pytest.approx(round(times))
        size = np.asarray(state.fit.values)[at]
        worst = max(range(len(logged)), key=lambda k: _relative_sd(logged[k] + _prior(state), size, at))
        base = logged[worst] + _prior(state)
        assert _relative_sd(base + times * extra[worst], size, at) <= 1 / SEPARATED
        if times > 1:
            assert _relative_sd(base + (times - 1) * extra[worst], size, at) > 1 / SEPARATED


def test_each_pair_has_the_advice_that_it_has_alone(known):
    problem, state, rows = known
    pairs = [("auxiliary_power", LIBRARY[k]) for k in ("cabin_warmup", "standstill_load")]
    together = advise(problem, state, rows, pairs)
    alone = [a for pair in pairs for a in advise(problem, state, rows, [pair])]
    assert [(a.rival, a.drive, a.hours) for a in together] == [(a.rival, a.drive, a.hours) for a in alone]
    assert {a.rival for a in together} == {"cabin_warmup", "standstill_load"}
    np.testing.assert_allclose([a.sd_after for a in together], [a.sd_after for a in alone], rtol=1e-6)


def test_what_no_drive_tells_is_said_to_be(tmp_path):
    """Another mass is a gain of the power and another drag area, in every drive."""
    options = {"effects": {"mass_scale": {}}, "noise": "white", "noise_level": 0.05}
    _, problem, _ = opened(tmp_path, seed=5, trips=4, rows_per_trip=60, **options)
    rows = training(problem, ["mass_scale"])
    state = found_in_turn(rows, problem, ["mass_scale"])
    (only,) = advise(problem, state, rows.rows, [("mass_scale", LIBRARY["power_gain"])])
    assert only.drive == ""
    assert only.sd_now > 1.0


def test_a_size_that_no_row_tells_anything_of_is_infinitely_badly_known():
    blind = np.diag([4.0, 0.0])
    size, at = np.array([2.0]), np.array([1])
    assert _relative_sd(blind, size, at) == np.inf
    assert _relative_sd(blind, size, np.array([0])) == pytest.approx(0.25), "0.5, the root of 1/4, over a size of 2"
