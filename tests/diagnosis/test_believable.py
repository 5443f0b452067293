"""Names that an engineer believes: a cause in the vehicle before an instrument's fault, one class of what no log can
distinguish, coefficients that stay in their tables, and held-out trips that have the last word.

The logs are synthetic ones with nothing planted; the kernel changes their energy as a vehicle with the effect would.
"""

from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from planted import SHORT, declared, diagnosed, found_in_turn, named, opened, training

from hdev_jax.diagnosis.candidates.candidate import Candidate
from hdev_jax.diagnosis.competition.compete import compete, no_instrument_named
from hdev_jax.diagnosis.competition.forward import Round, forward
from hdev_jax.diagnosis.competition.needed import (
    backward,
    needed,
    without_idle_switches,
    without_unclear,
)
from hdev_jax.diagnosis.competition.refit import refit
from hdev_jax.diagnosis.competition.state import Found, State
from hdev_jax.diagnosis.gates.held_out import held_out_gain
from hdev_jax.diagnosis.gates.rejection import Kind
from hdev_jax.diagnosis.scores.evidence import Score
from hdev_jax.diagnosis.scores.passes import evidence_of
from hdev_jax.diagnosis.scores.scores import score_all
from hdev_jax.diagnosis.settings import SETTINGS
from hdev_jax.fleet import synthetic_log
from hdev_jax.inference import effect_coefficients
from hdev_jax.inference.sheet import read_sheet
from hdev_jax.logs import read_log
from hdev_jax.physics import LIBRARY, Effect, PartLoad, RegenEfficiency, Rolling
from hdev_jax.physics.sensors import MassScale
from hdev_jax.problem import Problem, Split, prepare, split_trips

ESTIMATED = "efficiency = { value = 0.91, sd = 0.03 }"
DRIVE = (
    "regen_efficiency", "part_load", "mass_scale", "power_gain", "auxiliary_power", "battery_resistance", "speed_scale",
    "time_skew",
)  # fmt: skip


@cache
def nothing(c_rr_sd: float = 0.0008) -> tuple[Problem, Split]:
    """A log with nothing planted, and a sheet whose one efficiency is to be estimated."""
    with TemporaryDirectory() as folder:
        files = synthetic_log(seed=7301, **SHORT).write(Path(folder), truth=False)
        text = files["sheet"].read_text()
        assert "efficiency = 0.91" in text
        text = text.replace("efficiency = 0.91", ESTIMATED).replace("sd = 0.0008", f"sd = {c_rr_sd}")
        files["sheet"].write_text(text)
        log = read_log([files["log"]])
        split = split_trips(log)
        return prepare(split.log, read_sheet(files["sheet"]), None), split


def changed(problem: Problem, effect: Effect, rows: np.ndarray | bool = True) -> Problem:
    """The log as this effect would have made it, in some of its rows."""
    more = problem.predict(problem.vehicle.plus(effect)) - problem.predict(problem.vehicle)
    return replace(problem, measured=problem.measured + np.where(rows, more, 0.0))


def without_noise(problem: Problem) -> Problem:
    """A hundredth of the noise: what is left then is the form of the effects, not chance."""
    exact = problem.predict(problem.vehicle)
    return replace(problem, measured=exact + 0.01 * (problem.measured - exact))


def found(problem: Problem, *ids: str) -> State:
    """Where the competition of these effects over the whole log ends."""
    return compete(training(problem, ids), problem.vehicle, problem.table, seed=0)


def sizes(state: State) -> dict[str, float]:
    """What was estimated of the effects that were found, as `effect.size`."""
    each = zip(state.fit.table.free, state.fit.values, strict=True)
    return {c.path.removeprefix("effects."): float(v) for c, v in each if c.path.startswith("effects.")}


def test_regeneration_is_named_before_payload_and_gain_which_are_its_class():
    """With one efficiency estimated for both directions, (1 + g)² = η_braking/η_driving, so that all three fit."""
    state = found(changed(nothing()[0], RegenEfficiency(0.15)), *DRIVE)
    (f,) = state.found
    assert f.id == "regen_efficiency"
    assert {"mass_scale", "power_gain"} & {*f.alike}
    assert sizes(state)["regen_efficiency.share"] == pytest.approx(0.15, abs=0.04)


def test_payload_is_named_before_a_gain_where_regeneration_would_beat_driving():
    assert found(changed(nothing()[0], MassScale(0.1)), *DRIVE).ids == ("mass_scale",)


def test_a_constant_load_beside_a_gain_is_a_load_and_an_offset_below_zero_is_the_instruments():
    problem, reads = nothing()[0], LIBRARY["power_gain"]
    told = sizes(found(changed(problem, reads(-0.06, 4000.0)), "power_gain", "auxiliary_power"))
    assert told["auxiliary_power.power_w"] == pytest.approx(4000.0, abs=400.0)
    assert "power_gain.offset_w" not in told
    told = sizes(found(changed(problem, reads(-0.06, -4000.0)), "power_gain", "auxiliary_power"))
    assert told["power_gain.offset_w"] == pytest.approx(-4000.0, abs=400.0)


def test_what_is_too_small_to_matter_is_not_named_however_significant():
    problem, load = without_noise(without_noise(nothing()[0])), LIBRARY["standstill_load"]
    for watts, names in ((60.0, ()), (140.0, ("standstill_load",))):
        rows = training(changed(problem, load(watts, 0.0)), ["standstill_load"])
        start = declared(rows, problem)
        new = forward(Round(rows, start, score_all(rows, start.fit), np.random.default_rng(0)))
        assert (() if new is None else new.ids) == names


def test_what_has_become_too_small_goes_and_the_reason_says_so():
    problem, _ = nothing()
    start = without_noise(without_noise(problem))
    rows = training(changed(start, MassScale(0.02)), ["mass_scale"])
    state = found_in_turn(rows, start, ["mass_scale"])
    assert backward(rows, state, newest=True).ids == ("mass_scale",)
    smaller = training(changed(start, MassScale(0.003)), ["mass_scale"])
    kept = backward(smaller, replace(state, fit=smaller.calibrate(state.fit.vehicle, state.fit.table)))
    assert kept.ids == ()
    assert "too small to matter" in str(kept.removed["mass_scale"])
    assert kept.barred == frozenset(), "it competes again"


def test_one_efficiency_does_not_compete_before_another_loss_in_the_vehicle():
    """`part_load` is mistaken for it, and here explains nearly as much."""
    assert found(changed(nothing()[0], LIBRARY["battery_resistance"](0.15)), *DRIVE).ids == ("battery_resistance",)


def test_an_offset_is_a_load_only_above_nothing_and_only_of_power():
    gain = Candidate(LIBRARY["power_gain"], ("gain", "offset_w"), (None, None), (), "size", (0, 1))
    assert gain.is_constant_load({"gain": -0.02, "offset_w": 500.0})
    assert not gain.is_constant_load({"gain": 0.02, "offset_w": -500.0})
    load = Candidate(LIBRARY["auxiliary_power"], ("power_w",), (None,), (), "size", (0,))
    assert not load.is_constant_load({"power_w": 500.0})


def test_an_efficiency_by_load_and_direction_blames_no_instrument():
    """The form is not quite any effect's here: noise is a hundredth, and nothing is too small to be significant."""
    problem = changed(changed(without_noise(nothing()[0]), RegenEfficiency(0.12)), PartLoad(2500.0, 0.0, 8000.0))
    names = found(problem, *DRIVE).ids
    assert "regen_efficiency" in names
    assert not [k for k in names if LIBRARY[k].instrument]


@pytest.mark.parametrize(("sd", "is_named"), [(0.0008, True), (0.0001, False)])
def test_no_effect_drives_a_coefficient_out_of_its_table(sd, is_named):
    """A mass that is wrong for hills and starts alone: with the mass scaled, c_rr has to make up for its weight."""
    problem = without_noise(nothing(sd)[0])
    car, scale = problem.vehicle, 0.12
    lighter = Rolling(car.effect("rolling").c_rr / (1.0 + scale))
    heavier = car.minus("rolling").plus(lighter, MassScale(scale))
    problem = replace(problem, measured=problem.measured + problem.predict(heavier) - problem.predict(car))
    state = found(problem, "mass_scale")
    assert state.ids == (("mass_scale",) if is_named else ())
    assert [v.rejection.kind for v in state.verdicts] == ([] if is_named else [Kind.FAR])


def test_what_held_out_trips_contradict_is_not_named():
    """A payload error of the training trips alone; the others have the opposite one."""
    problem, split = nothing()
    train = problem.rows(split.train)
    problem = changed(changed(problem, MassScale(0.15), train), MassScale(-0.15), ~train)
    result = diagnosed(problem, split, {"mass_scale": MassScale})
    assert named(result) == []
    assert {c["id"]: c["kind"] for c in result.summary["candidates"]} == {"mass_scale": Kind.NOT_HELD_OUT}
    np.testing.assert_array_equal(result.predicted_after, result.predicted_before)


def test_no_instrument_is_named_while_most_of_what_is_left_is_structure():
    problem, _ = nothing()
    rows = training(changed(problem, LIBRARY["power_gain"](0.08, 0.0)), ["power_gain"])
    state = found_in_turn(rows, problem, ["power_gain"])
    less = no_instrument_named(rows, state, 0.7)
    assert less.ids == ()
    (verdict,) = [v for v in less.verdicts if v.id == "power_gain"]
    assert verdict.rejection.kind is Kind.INSTRUMENT
    assert "70 %" in str(verdict.rejection)
    assert no_instrument_named(rows, less, 0.7) is less


def test_neither_payload_nor_an_instrument_is_named_where_the_log_lacks_the_slope_that_the_rest_behaves_like():
    problem, _ = nothing()
    both = changed(changed(problem, MassScale(0.15)), LIBRARY["auxiliary_power"](9000.0))
    rows = training(both, ["mass_scale", "auxiliary_power"])
    state = found_in_turn(rows, both, ["mass_scale", "auxiliary_power"])
    less = no_instrument_named(rows, state, 0.6, ["grade_rad"])
    assert less.ids == ("auxiliary_power",)
    (verdict,) = [v for v in less.verdicts if v.id == "mass_scale"]
    assert verdict.rejection.kind is Kind.MISSING_CHANNEL
    assert "60 % of the remaining variance behaves like a channel that the log lacks (grade_rad)" in str(
        verdict.rejection
    )
    assert no_instrument_named(rows, state, 0.7) is state, "structure alone takes out instruments, not the payload"


def twisted(back: float) -> Problem:
    """A log in which cornering would cost energy from trip to trip, and give some `back` inside trips."""
    problem = without_noise(nothing()[0])
    bends = changed(problem, LIBRARY["cornering"](0.02)).measured - problem.measured
    trip = np.asarray(problem.segments.trip)
    mean = (np.bincount(trip, bends) / np.bincount(trip))[trip]
    return replace(problem, measured=problem.measured + 6.0 * mean - back * (bends - mean))


def test_what_has_one_sign_from_trip_to_trip_and_the_other_inside_them_is_no_effect():
    problem = twisted(0.1)
    rows = training(problem, ["cornering"])
    state = declared(rows, problem)
    scores = score_all(rows, state.fit)
    s = scores.best["cornering"]
    plain, white = scores.plain.estimate(s.candidate), scores.white.estimate(s.candidate)
    assert plain[0][0] > SETTINGS.stands * plain[1][0]
    assert white[0][0] < -SETTINGS.stands * white[1][0]
    came = refit(rows, state, s, scores)
    assert (came.fit, came.kind) == (None, Kind.OPPOSITE)


def test_an_effect_goes_whose_fitted_size_has_the_other_sign_than_its_test():
    problem = twisted(0.3)
    rows = training(problem, ["cornering"])
    state = declared(rows, problem)
    s = score_all(rows, state.fit).best["cornering"]
    bends = LIBRARY["cornering"](0.02)
    table = state.fit.table.plus(*effect_coefficients(bends, ("coefficient",)))
    fit = rows.calibrate(state.fit.vehicle.plus(bends), table)
    assert fit.values[-1] > 0
    found_once = Found("cornering", replace(s, plain=False), 0.0, 1.0, (), 9.0)
    own = needed(evidence_of(rows.baseline(fit)), fit, found_once)
    assert own.beta[0] < 0
    assert own.p < SETTINGS.stays
    assert own.left_out_gain > 0
    less = backward(rows, replace(state, fit=fit, found=(found_once,)), newest=True)
    assert less.ids == ()
    assert less.removed["cornering"].kind is Kind.OPPOSITE


def test_a_constant_load_that_ordinary_least_squares_alone_show_is_asked_before_a_load_that_begins():
    problem = changed(nothing()[0], LIBRARY["auxiliary_power"](3000.0))
    rows = training(problem, ["auxiliary_power", "step_change"])
    state = declared(rows, problem)
    scores = score_all(rows, state.fit)
    constant, begins = scores.best["auxiliary_power"], scores.best["step_change"]
    (seen,) = scores.plain.plain_scores([constant.candidate])
    assert seen.plain
    assert not begins.plain
    for p, p_begins, first in (
        (1e-6, 1e-5, "auxiliary_power"),
        (1e-3, 1e-5, "step_change"),
        (1e-15, begins.p, "step_change"),  # of which these rows are certain
    ):
        scores.replaced(replace(seen, p_model=p, p_cluster=p))
        scores.replaced(replace(begins, p_model=p_begins, p_cluster=p_begins))
        new = forward(Round(rows, state, scores, np.random.default_rng(0)))
        assert new is not None
        assert new.ids == (first,)


@pytest.mark.parametrize(("limit_w", "stays"), [(9e5, False), (3e4, True)])
def test_a_limit_that_is_never_reached_any_more_is_taken_out(limit_w, stays):
    problem, _ = nothing()
    limit = LIBRARY["regen_limit"](limit_w, 1.0)
    rows = training(changed(problem, limit), ["regen_limit"])
    state = declared(rows, problem)
    table = [replace(c, free=False) for c in effect_coefficients(limit, ("power_w",))]
    candidate = Candidate(type(limit), ("power_w",), (None,), (("share", 1.0), ("power_w", limit_w)), "limit", ())
    there = Found(limit.id, Score(candidate, np.array([1.0]), 9.0, 0.0, 0.0, 9.0, 1.0), 0.0, 1.0, (), 9.0)
    fit = rows.calibrate(state.fit.vehicle.plus(limit), state.fit.table.plus(*table))
    state = replace(state, fit=fit, found=(there,))
    left = without_idle_switches(rows, state, score_all(rows, state.fit))
    assert ("regen_limit" in left.ids) is stays
    assert left.fit.vehicle.has("regen_limit") is stays


def test_gain_on_held_out_trips_is_that_of_the_better_prediction():
    problem, split = nothing()
    right, wrong = problem.predict(problem.vehicle), problem.predict(problem.vehicle.plus(MassScale(0.1)))
    assert held_out_gain(problem, split, wrong, right, levels=True) > 3.0
    assert held_out_gain(problem, split, right, wrong, levels=True) < -3.0
    assert held_out_gain(problem, split, right, right, levels=True) == 0.0


def test_a_slope_that_the_log_lacks_is_the_first_suspect(tmp_path):
    def change(frame):
        del frame["grade_rad"], frame["altitude_m"]

    options = {"seed": 7302, "mode": "samples", "rows_per_trip": 200, "trips": 9}
    _, problem, split = opened(tmp_path, change=change, **options)
    summary = diagnosed(problem, split, {}).summary
    assert summary["missing_channels"] == ["grade_rad"]
    assert "slope" in summary["unexplained"]["signature"]
    assert summary["verdict"] == "unexplained_structure"
    (tmp_path / "whole").mkdir()
    summary = diagnosed(*opened(tmp_path / "whole", **options)[1:], {}).summary
    assert summary["missing_channels"] == []
    assert "slope" not in summary["unexplained"]["signature"]
    assert summary["verdict"] == "nothing_missing"


def test_a_coefficient_that_ends_far_from_its_table_is_said_with_what_it_may_stand_for():
    """A slope that is always read too low looks like rolling resistance, whatever effect is found beside it."""
    problem, split = nothing()
    steep = changed(changed(problem, LIBRARY["grade_bias"](0.004)), LIBRARY["auxiliary_power"](6000.0))
    library = {k: LIBRARY[k] for k in ("grade_bias", "auxiliary_power")}
    summary = diagnosed(steep, split, library).summary
    ends = summary["coefficients"]
    assert ends["road.c_rr"]["prior_z"] > SETTINGS.far
    assert ends["road.c_rr"]["absorbs"] == ["grade_bias"]
    assert ends["road.cda_m2"]["absorbs"] == []
    (note,) = [n for n in summary["notes"] if n.startswith("road.c_rr moved")]
    assert "in the model with the effects" in note
    assert "cannot be distinguished from grade_bias" in note
    calm = diagnosed(changed(problem, LIBRARY["auxiliary_power"](6000.0)), split, library).summary
    assert not any(p["absorbs"] for p in calm["coefficients"].values())
    assert not [n for n in calm["notes"] if "moved" in n]


def test_no_name_stays_whose_size_may_be_nothing_as_it_is_fitted():
    problem, _ = nothing()
    both = changed(changed(problem, MassScale(0.1)), LIBRARY["auxiliary_power"](6000.0))
    rows = training(both, ["mass_scale", "auxiliary_power"])
    state = found_in_turn(rows, both, ["mass_scale", "auxiliary_power"])
    assert without_unclear(rows, state) is state
    alone = training(changed(problem, LIBRARY["auxiliary_power"](6000.0)), ["mass_scale", "auxiliary_power"])
    less = without_unclear(alone, replace(state, fit=alone.calibrate(state.fit.vehicle, state.fit.table)))
    assert less.ids == ("auxiliary_power",)
    assert not less.fit.vehicle.has("mass_scale")
    assert "mass_scale" in less.barred


def test_a_payload_is_not_named_from_a_log_without_slope_and_is_with_it(tmp_path):
    def change(frame):
        del frame["grade_rad"], frame["altitude_m"]

    options = {"seed": 7302, "mode": "samples", "rows_per_trip": 200, "trips": 9}
    library = {"mass_scale": MassScale, "auxiliary_power": LIBRARY["auxiliary_power"]}
    for name, kept, names in (("without", change, []), ("whole", lambda frame: None, ["mass_scale"])):
        (tmp_path / name).mkdir()
        _, problem, split = opened(tmp_path / name, change=kept, **options)
        result = diagnosed(changed(problem, MassScale(0.3)), split, library)
        kinds = {c["id"]: c["kind"] for c in result.summary["candidates"]}
        assert named(result) == names
        assert kinds["mass_scale"] == (Kind.FOUND if names else Kind.MISSING_CHANNEL)
