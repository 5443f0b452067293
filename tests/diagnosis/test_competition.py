"""Effects join, leave and give way: a second size, what others made superfluous, an exchange, gears one by one."""

from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from planted import declared, found_in_turn, opened, training

from hdev_jax.diagnosis.candidates.candidate import Candidate
from hdev_jax.diagnosis.candidates.plan import columns
from hdev_jax.diagnosis.competition.compete import compete
from hdev_jax.diagnosis.competition.exchange import one_exchanged, two_exchanged
from hdev_jax.diagnosis.competition.forward import Round, forward
from hdev_jax.diagnosis.competition.grid import sharpened
from hdev_jax.diagnosis.competition.needed import backward, classes
from hdev_jax.diagnosis.competition.refit import _crossed, as_reported, fitted, joined, refit, widened, without
from hdev_jax.diagnosis.competition.state import Found, State
from hdev_jax.diagnosis.diagnose import training_of
from hdev_jax.diagnosis.gates.rejection import Kind, Rejection
from hdev_jax.diagnosis.scores.evidence import Score
from hdev_jax.diagnosis.scores.scores import score_all
from hdev_jax.diagnosis.training import Training
from hdev_jax.inference import Calibration, effect_coefficients
from hdev_jax.physics import LIBRARY, Shape, Size
from hdev_jax.problem import Problem


def round_of(rows: Training, state: State) -> Round:
    return Round(rows, state, score_all(rows, state.fit), np.random.default_rng(0))


# --- a second size ---------------------------------------------------------------------------------------------------

HVAC = {"below_w_per_k": 900.0, "heat_c": 14.0, "cool_c": 20.0}


@cache
def heating_found(above_w_per_k: float) -> tuple[Problem, Training, State]:
    """A log with heating and so much cooling, and a state in which the heating alone was found."""
    effects = {"hvac_power": {**HVAC, "above_w_per_k": above_w_per_k}}
    options = {"effects": effects, "noise_level": 0.02, "ar_coefficient": 0.9}
    with TemporaryDirectory() as folder:
        _, problem, _ = opened(Path(folder), seed=4, trips=20, rows_per_trip=80, **options)
    rows = training(problem, ["hvac_power"])
    scores = score_all(rows, declared(rows, problem).fit)
    heating = [c for c in scores.source.candidates if c.sizes == ("below_w_per_k",)]
    best = max(scores.white.scores(heating), key=lambda s: s.gain)
    return problem, rows, found_in_turn(rows, problem, ["hvac_power"], hvac_power=best.candidate)


def test_cooling_joins_the_heating_that_was_found():
    _, rows, state = heating_found(700.0)
    wider = widened(rows, state)
    assert wider is not None
    assert wider.found[0].score.candidate.sizes == ("below_w_per_k", "above_w_per_k")
    size = {c.name: (v, s) for c, v, s in zip(wider.fit.table.free, wider.fit.values, wider.fit.sd, strict=True)}
    for name, true in (("below_w_per_k", 900.0), ("above_w_per_k", 700.0), ("heat_c", 14.0), ("cool_c", 20.0)):
        value, sd = size[f"effects.hvac_power.{name}"]
        assert abs(value - true) < 3 * sd, f"{name}: {value:.3g} ± {sd:.2g}, planted {true}"
    assert wider.fit.sigma < state.fit.sigma
    assert widened(rows, wider) is None


def test_nothing_joins_where_nothing_is():
    _, rows, state = heating_found(0.0)
    assert widened(rows, state) is None


# --- out again -------------------------------------------------------------------------------------------------------


def test_the_newest_effect_is_asked_only_where_told_so():
    """A size that is nothing stays right after it was added, since it has just passed every gate, and no longer."""
    _, rows, state = heating_found(0.0)
    effect = LIBRARY["standstill_load"](power_w=jnp.asarray(1.0), by_door=jnp.asarray(0.0))
    table = state.fit.table.plus(*effect_coefficients(effect, ("power_w",), shapes=False))
    fit = rows.calibrate(state.fit.vehicle.plus(effect), table)
    heating = state.found[0]
    candidate = replace(heating.score.candidate, effect=type(effect), sizes=("power_w",), shapes=())
    nothing = replace(heating, id=effect.id, score=replace(heating.score, candidate=candidate))
    both = replace(state, fit=fit, found=(heating, nothing))
    assert backward(rows, both).ids == (heating.id, nothing.id)
    left = backward(rows, both, newest=True)
    assert left.ids == (heating.id,)
    assert left.removed[nothing.id].kind is Kind.SUPERFLUOUS
    assert not left.fit.vehicle.has(nothing.id)
    assert backward(rows, replace(both, found=(nothing, heating))).ids == (heating.id,)
    assert backward(rows, state, newest=True).ids == (heating.id,)


def test_what_was_told_beside_an_effect_is_estimated_again_without_it(tmp_path):
    """A size that whitened rows told beside another is not held where it was once the other is gone."""
    effects = {"rotating_mass": {"factor": 0.08}, "mass_scale": {"scale": 0.06}}
    _, problem, _ = opened(tmp_path, seed=6, trips=12, rows_per_trip=100, effects=effects)
    rows = training(problem)
    start = declared(rows, problem)
    noise = rows.noise(start.fit)

    def score(id_: str, size: float) -> Score:
        return Score(Candidate(LIBRARY[id_], (effects_size[id_],), (None,), (), "size", (0,)), np.array([size]), 50.0,
                     1e-9, 1e-6, 8.0, 0.7)  # fmt: skip

    effects_size = {"mass_scale": "scale", "rotating_mass": "factor"}
    alone = joined(rows, start, score("mass_scale", 0.05), noise)
    assert alone is not None
    both = joined(rows, replace(start, fit=alone), score("rotating_mass", 0.08), noise)
    assert both is not None
    assert {bool(c.known) for c in both.table.free if c.path.startswith("effects.")} == {True}
    back = without(rows, replace(start, fit=both), "rotating_mass").fit
    np.testing.assert_allclose(back.values, alone.values, rtol=0.05)
    moved, own = (f.values[[c.path for c in f.table.free].index("effects.mass_scale.scale")] for f in (both, alone))
    assert abs(moved - own) > 0.2 * abs(own), "the two do not meet: nothing would show"


# --- exchanged -------------------------------------------------------------------------------------------------------

PLANTED = ("headwind", "standstill_load")
LIKELY = (*PLANTED, "auxiliary_power", "cabin_warmup", "step_change", "rolling_speed")


@pytest.fixture(scope="module")
def two(tmp_path_factory) -> tuple[Problem, Training]:
    """A log with a headwind and a load at standstill."""
    options = {"effects": {k: {} for k in PLANTED}, "ratio": 1.5}
    _, problem, _ = opened(tmp_path_factory.mktemp("log"), seed=5, trips=12, rows_per_trip=150, **options)
    return problem, training(problem, LIKELY)


@pytest.fixture(scope="module")
def wrongly(two) -> State:
    """The state in which a load that is not there was found first."""
    problem, rows = two
    return found_in_turn(rows, problem, ("cabin_warmup", "headwind"))


def test_what_does_more_takes_the_place_of_what_was_found(two, wrongly):
    _, rows = two
    wrong, state = "cabin_warmup", replace(wrongly, refused=("rolling_speed",))
    new = one_exchanged(round_of(rows, state))
    assert new is not None
    assert new.ids == ("headwind", "standstill_load")
    assert new.removed[wrong].numbers["beside"] == "standstill_load"
    assert wrong in new.barred
    assert new.refused == ("rolling_speed",)
    assert not any(wrong in c.path for c in new.fit.table.rows)
    assert not new.fit.vehicle.has(wrong)
    assert new.fit.sigma < state.fit.sigma
    assert one_exchanged(round_of(rows, replace(new, found=new.found[::-1]))) is None, "what does most stays"


@pytest.mark.parametrize("why", ["newest", "told by trips", "out already", "at no level"])
def test_what_may_not_be_exchanged_is_not(why, two, wrongly):
    (_, rows), state = two, wrongly
    first = state.found[0]
    if why == "newest":
        state = replace(state, found=state.found[::-1])
    if why == "told by trips":
        state = replace(state, found=(replace(first, score=replace(first.score, plain=True)), *state.found[1:]))
    if why == "out already":
        state = replace(state, refused=("standstill_load", "auxiliary_power", "step_change", "rolling_speed"))
    if why == "at no level":
        rows = replace(rows, settings=replace(rows.settings, fdr=0.0))
    assert one_exchanged(round_of(rows, state)) is None


def test_two_that_together_stand_for_two_others_are_exchanged_at_once(tmp_path):
    """Efficiency and grade together look like a rotating mass with friction brakes: none of these is better alone."""
    planted, proxies = ("rotating_mass", "friction_blending"), ("efficiency_scale", "grade_scale")
    options = {"effects": {k: {} for k in planted}, "ratio": 0.5, "ar_coefficient": 0.97}
    _, problem, _ = opened(tmp_path, seed=750126, trips=12, **options)
    rows = training(problem, [*planted, *proxies])
    state = found_in_turn(rows, problem, proxies)
    assert one_exchanged(round_of(rows, state)) is None
    new = two_exchanged(round_of(rows, state))
    assert new is not None
    assert sorted(new.ids) == sorted(planted)
    assert new.barred >= {*proxies}
    assert all(f.q_value < rows.settings.fdr for f in new.found)
    assert two_exchanged(round_of(rows, new)) is None


def test_the_competition_ends_with_what_is_there(two):
    """From the declared model: both, in the order of what they explain, each with its class, all others with a
    verdict, and the fits on the way."""
    problem, rows = two
    steps = []
    state = compete(rows, problem.vehicle, problem.table, seed=0, remember=lambda k, f: steps.append(f()) or steps[-1])
    assert state.finished
    assert sorted(state.ids) == sorted(PLANTED)
    assert [s.ids for s in steps] == [(), state.ids[:1], state.ids, state.ids]
    assert state.trail[",".join(state.ids)] == [float(x) for x in state.fit.values]
    assert {v.id for v in state.verdicts} == {*LIKELY} - {*PLANTED}
    assert {v.rejection.kind for v in state.verdicts} <= {*Kind} - {Kind.FOUND, Kind.DECLARED}
    assert [f.alike for f in classes(score_all(rows, state.fit), state)] == [f.alike for f in state.found]


def test_what_takes_no_place_any_more_is_no_rival_of_another(two):
    """In resampled sets of trips stronger ones come first: the other waits, unless they were taken out twice."""
    problem, rows = two
    state = declared(rows, problem)
    best = round_of(rows, state).scores.best
    other = min(PLANTED, key=lambda k: best[k].gain)
    round_ = round_of(rows, state)
    assert forward(round_, only={other}) is None
    assert round_.reasons[other].kind is Kind.UNSTABLE
    twice = Rejection(Kind.SUPERFLUOUS, {"beside": other, "times": 2})
    out = replace(state, removed=dict.fromkeys({*best} - {other}, twice))
    round_ = round_of(rows, out)
    new = forward(round_, only={other})
    assert new is not None, round_.reasons
    assert new.ids == (other,)


# --- a joint refit ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("power_w", "joins"), [(60.0, False), (400.0, True)])
def test_a_size_that_is_sure_but_too_small_to_name_does_not_join(tmp_path, power_w, joins):
    """A load of less than 100 W at standstill is not worth a name, however little noise there is."""
    options = {"effects": {"standstill_load": {"power_w": power_w}}, "noise_level": 1e-5, "ar_coefficient": 0.0}
    _, problem, _ = opened(tmp_path, seed=1, trips=8, rows_per_trip=80, **options)
    rows = training(problem, ["standstill_load"])
    state = declared(rows, problem)
    scores = score_all(rows, state.fit)
    every = next(c for c in scores.source.candidates if c.id == "standstill_load")
    score = scores.white.score(every)
    assert score.p < 1e-6
    assert score.beta[0] == pytest.approx(power_w, rel=0.1)
    assert (refit(rows, state, score, scores).fit is not None) == joins


# --- gears -----------------------------------------------------------------------------------------------------------


def test_what_goes_against_one_gear_takes_that_gear_away_and_not_the_drag(tmp_path):
    torque = {"torque_nm[1]": 40.0, "torque_nm[2]": 40.0, "torque_nm[3]": 40.0, "torque_nm[4]": -40.0}
    options = {"effects": {"driveline_drag": torque}, "ratio": 0.5}
    _, problem, _ = opened(tmp_path, seed=1, trips=12, **options)
    rows = training(problem, ["driveline_drag"])
    round_ = round_of(rows, declared(rows, problem))
    scores = round_.scores
    assert scores.best["driveline_drag"].candidate.groups == (1, 2, 3), "the scores show it already"
    every = next(c for c in scores.source.candidates if len(c.groups) == 4)
    came = refit(rows, round_.state, scores.white.score(every), scores)
    assert came.fit is None
    assert came.fewer is not None
    assert came.fewer.groups == (1, 2, 3)
    taken = forward(round_)
    assert taken is not None
    assert {c.name for c in taken.fit.table.free if c.path.startswith("effects.")} == {
        f"effects.driveline_drag.torque_nm[{n}]" for n in (1, 2, 3)
    }


def test_a_gear_of_test_trips_alone_has_no_torque(tmp_path):
    """As in the sheet that is written, which says nothing of it; not the torque of the gear before it. And neutral at
    standstill, whose column is nothing but zeros, changes nothing."""
    options = {"effects": {"driveline_drag": {}}, "ratio": 1.0}
    _, problem, split = opened(tmp_path, seed=1, trips=12, rows_per_trip=150, **options)
    gear = np.asarray(problem.segments.channels["gear"])
    other = np.where(problem.rows(split.test) & (gear == 4), 5.0, gear)
    other = np.where(np.asarray(problem.segments.distance_m) == 0, 0.0, other)

    def reported(problem: Problem) -> Calibration:
        rows, _ = training_of(problem, split, {"driveline_drag": LIBRARY["driveline_drag"]})
        state = compete(rows, problem.vehicle, problem.table, seed=0)
        assert state.ids == ("driveline_drag",)
        return as_reported(rows, state)

    one, both = reported(problem), reported(replace(problem, segments=problem.segments.with_channels(gear=other)))
    assert [c.name for c in both.table.free] == [c.name for c in one.table.free]
    np.testing.assert_allclose(both.values, one.values, rtol=1e-5)
    assert float(both.vehicle.effect("driveline_drag").torque_nm.values[5]) == 0.0


class DragAboveSpeed(LIBRARY["driveline_drag"]):
    """A drag by gear that sets in at a speed: sizes by gear with a shape, which the library has not."""

    id: ClassVar = "drag_above_speed"
    parameters: ClassVar = (
        *LIBRARY["driveline_drag"].parameters,
        Shape("above_mps", "m/s", 8.0, 4.0, 0.0, 30.0, grid=(2.0, 6.0, 10.0, 14.0)),
    )
    above_mps: Any

    def drive(self, row, car, point):
        """The drag where the speed is above."""
        return jax.nn.sigmoid(row.speed_mps - self.above_mps) * super().drive(row, car, point)


def test_a_shape_beside_sizes_by_gear_is_sought_for_the_gears_that_are_left(tmp_path):
    planted = {"driveline_drag": {"torque_nm[2]": 40.0, "torque_nm[3]": -30.0, "torque_nm[4]": 40.0}}
    _, problem, _ = opened(tmp_path, seed=3, trips=12, rows_per_trip=150, effects=planted, ratio=1.0)
    rows = replace(training(problem), library={DragAboveSpeed.id: DragAboveSpeed})
    state = forward(round_of(rows, declared(rows, problem)))
    assert state is not None
    assert state.ids == (DragAboveSpeed.id,)
    names = {c.name.rpartition(".")[2] for c in state.fit.table.free if c.path.startswith("effects.")}
    gears = {n.removeprefix("torque_nm[").removesuffix("]") for n in names if n.startswith("torque")}
    assert {"2", "4"} <= gears <= {"1", "2", "4"}
    assert "above_mps" in names


def test_a_column_of_the_library_is_what_its_effect_adds(two):
    """What is found by a column and what is then in the vehicle are one thing: a linear size by its first step."""
    problem, rows = two
    made = columns(problem.vehicle, [LIBRARY["standstill_load"]], rows.rows.segments, rows.rows.rows, rows.target)
    c = next(c for c in made[0] if c.sizes == ("power_w",))
    state = found_in_turn(rows, problem, ["standstill_load"], standstill_load=c)
    added = problem.predict(state.fit.vehicle) - problem.predict(state.fit.vehicle.minus("standstill_load"))
    size = float(np.asarray(state.fit.vehicle.effect("standstill_load").power_w))
    np.testing.assert_allclose(added, size * made[1][:, c.columns[0]], rtol=1e-9, atol=1e-9)
    assert isinstance(state.found[0], Found)
    assert isinstance(LIBRARY["standstill_load"].parameters[0], Size)


# --- steps and limits ------------------------------------------------------------------------------------------------


def test_a_step_lies_between_trips_of_one_vehicle(two):
    facts = two[1].facts
    assert replace(facts, trips=np.arange(12), vehicles=np.zeros(12, int)).steps == tuple(map(float, range(3, 10)))
    assert replace(facts, trips=np.arange(12), vehicles=np.repeat([0, 1], 6)).steps == (9.0,)
    assert replace(facts, trips=np.arange(12), vehicles=np.arange(12) % 2).steps == ()
    assert replace(facts, trips=np.arange(5), vehicles=np.zeros(5, int)).steps == ()


def test_limits_that_end_out_of_order_are_told_by_path(two):
    problem, rows = two
    state, hvac = declared(rows, problem), LIBRARY["hvac_power"]
    for heat, cool, crossed in ((14.0, 20.0, set()), (20.0, 14.0, {"heat_c", "cool_c"})):
        effect = hvac(below_w_per_k=500.0, above_w_per_k=300.0, heat_c=heat, cool_c=cool)
        table = state.fit.table.plus(*effect_coefficients(effect, ("below_w_per_k", "above_w_per_k")))
        vehicle = state.fit.vehicle.plus(effect)
        n = len(table.free)
        fit = replace(
            state.fit, vehicle=vehicle, table=table, values=table.values(vehicle), sd=np.ones(n), covariance=np.eye(n)
        )
        assert _crossed(fit) == {f"effects.hvac_power.{n}" for n in crossed}


def test_limits_stay_in_order_in_every_refit(tmp_path):
    """Heating below and cooling above limits that cross are a constant load together, which is what this log has."""
    _, problem, _ = opened(tmp_path, seed=4, effects={"auxiliary_power": {"power_w": 9000.0}}, noise_level=0.01)
    rows = training(problem, ["hvac_power"])
    start = declared(rows, problem).fit
    effect = LIBRARY["hvac_power"](below_w_per_k=300.0, above_w_per_k=300.0, heat_c=15.0, cool_c=16.0)
    table = start.table.plus(*effect_coefficients(effect, ("below_w_per_k", "above_w_per_k")))
    vehicle = start.vehicle.plus(effect)
    assert _crossed(rows.calibrate(vehicle, table)), "nothing tempts it: nothing would show"
    hvac = fitted(rows, start, vehicle, table).vehicle.effect("hvac_power")
    assert float(hvac.heat_c) < float(hvac.cool_c)


def test_a_shape_between_two_points_of_its_grid_is_looked_at_before_trips_decide(tmp_path):
    """The limit lies between the grid's: rows are sure of it there too, but what trips show of it differs."""
    _, problem, _ = opened(tmp_path, seed=1, trips=12, effects={"regen_limit": {}}, ratio=0.5, rows_per_trip=100)
    rows = training(problem, ["regen_limit"])
    strict = replace(rows, settings=replace(rows.settings, fdr=1e-4))
    fit = declared(rows, problem).fit
    before = score_all(strict, fit)
    p, q, shapes = before.best["regen_limit"].p, before.q["regen_limit"], before.best["regen_limit"].candidate.shapes
    after = sharpened(strict, before)
    assert p > 1e-5
    assert after.best["regen_limit"].p < 1e-10
    assert after.q["regen_limit"] < strict.settings.fdr < q
    assert after.best["regen_limit"].candidate.shapes == shapes, "the refit chooses finer ones again"
    assert sharpened(rows, score_all(rows, fit)).best["regen_limit"].p == p, "not where trips are sure already"
