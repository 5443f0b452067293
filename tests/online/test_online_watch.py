"""Effects that the declared model lacks: named while one drives, and not where there are none."""

import jax
import numpy as np
import pytest
from online_rows import sheet

from hdev_jax.fleet import synthetic_log
from hdev_jax.fleet.noise import noise_of_one
from hdev_jax.online import Watch, scan, start
from hdev_jax.online.watch import evidence
from hdev_jax.physics import LIBRARY

WEATHER = ("mass_kg", "grade_rad", "ambient_temp_c", "wind_speed_mps", "wind_from_rad", "heading_rad")
IDS = ("headwind", "standstill_load", "rotating_mass", "regen_limit", "wet_road", "tyre_warmup")


@pytest.fixture(scope="module")
def watching():
    of = sheet(mass_kg=29e3)
    watch = Watch.of(start(of, WEATHER)[0], {k: LIBRARY[k] for k in IDS})
    return watch, start(of, WEATHER, candidates=watch.candidates, memories=(0.75, 0.87))[0]


def stream(state, seed, effects=None, **options):
    """600 rows of six trips; of `effects` each is half of the noise."""
    usual = {"trips": 6, "rows_per_trip": 100, "ar_coefficient": 0.8, "ratio": 0.5 if effects else None}
    return vectors_of(state, synthetic_log(seed=seed, effects=effects, **usual | options))


def vectors_of(state, made):
    frame = made.frame
    named = {"measured": frame["energy_wh"], "trip": frame["trip_id"].str[1:].astype(float)}
    return np.stack([np.asarray(named.get(c, frame.get(c)), float) for c in state.form.columns], axis=1)


def test_nothing_planted_raises_no_alarm_in_many_streams(watching):
    """Six vehicles on their roads, each with the noise of four streams; all models of the noise, not the true one's
    neighbours alone."""
    watch, _ = watching
    state = start(sheet(mass_kg=29e3), WEATHER, candidates=watch.candidates)[0]
    rng = np.random.default_rng(0)
    for seed in range(6):
        made = synthetic_log(seed=seed, trips=6, rows_per_trip=100)
        rows = vectors_of(state, made)
        columns, lengths = watch.columns(rows), np.unique(rows[:, 0], return_counts=True)[1]
        for _ in range(4):
            noise = made.noise_rms * noise_of_one(rng, lengths, "ar1", 0.8)
            rows[:, state.form.columns.index("measured")] = made.truth["noise_free"] + noise
            end, _ = scan(state, rows, columns)
            assert not np.asarray(end.alarm_at).any()
            assert watch.alarm(end) is None


@pytest.mark.parametrize("effect", ["headwind", "standstill_load"])
def test_a_planted_effect_of_half_the_noise_is_named(watching, effect):
    watch, state = watching
    rows = stream(state, 3, {effect: {}})
    end, _ = scan(state, rows, watch.columns(rows))
    alarm = watch.alarm(end)
    assert alarm is not None
    assert alarm.effect == effect
    assert effect not in alarm.instead
    assert 400 < alarm.certain_row <= 600
    assert alarm.since_row < alarm.certain_row
    assert alarm.sd > 0
    assert f"{effect}: {alarm.name} = " in alarm.line()
    assert alarm.line().endswith(" kWh in 9 h of driving")


def test_an_effect_that_begins_later_is_dated(watching):
    """The same load, from the middle of the stream on."""
    watch, state = watching
    without, with_it = (
        stream(state, 3, noise_rms=3.0),
        stream(state, 3, {"standstill_load": {}}, ratio=None, noise_rms=3.0),
    )
    rows = np.where(np.arange(600)[:, None] < 300, without, with_it)
    alarm = watch.alarm(scan(state, rows, watch.columns(rows))[0])
    assert alarm is not None
    assert alarm.effect == "standstill_load"
    assert 250 <= alarm.since_row <= 450  # when it next stands


def test_what_cannot_be_watched_row_by_row_is_said(watching):
    watch, state = watching
    assert watch.left_out == {
        "wet_road": "needs a channel that the log lacks: wet_road",
        "tyre_warmup": "acts across rows",
    }
    assert set(watch.candidates) == set(IDS) - set(watch.left_out)
    rows = stream(state, 1)[:50]
    rows[3, state.form.columns.index("wind_speed_mps")] = np.nan
    columns = watch.columns(rows)
    assert np.all(np.isfinite(columns))
    assert np.all(columns[3, np.array(watch.candidates) == "headwind"] == 0.0)


def test_a_candidate_is_a_coefficient_more(watching):
    """Size and its sd: those of the same coefficient, if it were declared with that prior."""
    watch, state = watching
    rows = stream(state, 3, {"rotating_mass": {}})
    plain = {"robust": False, "levels": False, "memories": (0.8,), "noise": 10.0}
    lacking = start(sheet(mass_kg=29e3), WEATHER, candidates=("rotating_mass",), **plain)[0]
    end, _ = scan(lacking, rows, watch.columns(rows)[:, [watch.candidates.index("rotating_mass")]])
    _, size, sd = (float(x[0]) for x in jax.jit(evidence)(end))
    declared = start(sheet(mass_kg=29e3, effects={"rotating_mass": {"factor": (1e-9, 0.05)}}), WEATHER, **plain)[0]
    fitted, _ = scan(declared, rows)
    assert 0.05 * size == pytest.approx(float(fitted.values[2]), rel=1e-2)  # braking is another slope
    assert 0.05 * sd == pytest.approx(float(fitted.sd[2]), rel=1e-2)
