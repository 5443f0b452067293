"""The whole method as one call: what it keeps and takes up again, what it refuses, odd logs, a user's effect."""

from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
from planted import FadingStart, breaches, declared, diagnosed, found_in_turn, named, opened

from hdev_jax.diagnosis.candidates.candidate import Candidate
from hdev_jax.diagnosis.candidates.unnamed import TERM, Factor, Term, describing
from hdev_jax.diagnosis.competition.state import Found, Verdict
from hdev_jax.diagnosis.gates.rejection import Kind, Rejection
from hdev_jax.diagnosis.result.checkpoint import from_plain, to_plain
from hdev_jax.diagnosis.result.stages import add_stages
from hdev_jax.diagnosis.scores.evidence import Score
from hdev_jax.diagnosis.settings import SETTINGS
from hdev_jax.errors import InputError
from hdev_jax.inference import effect_coefficients
from hdev_jax.physics import LIBRARY
from hdev_jax.problem import Problem, Split, prepare
from hdev_jax.rundir import open_run

FEW = {k: LIBRARY[k] for k in ("driveline_drag", "headwind", "standstill_load")}
# one of each way in which a candidate is sought
EACH = FEW | {
    k: LIBRARY[k] for k in ("power_gain", "regen_limit", "tyre_warmup", "step_change", "periodic_load", "mode_change",
                            "switching_load")
}  # fmt: skip


@pytest.fixture(scope="module")
def log(tmp_path_factory) -> tuple[Problem, Split]:
    """A log with drag by gear and a load at standstill."""
    options = {"effects": {"driveline_drag": {}, "standstill_load": {}}, "ratio": 1.5}
    return opened(tmp_path_factory.mktemp("log"), seed=71, trips=12, **options)[1:]


# --- kept, and taken up again ------------------------------------------------------------------------------------


class KilledError(Exception):
    pass


class Kept:
    """A run's folder that holds plain values, and a kill before the stage of one name."""

    def __init__(self, folder, killed_at: str = ""):
        self.run, self.killed_at, self.computed = folder, killed_at, []

    def __call__(self, name, compute):
        def here():
            if name == self.killed_at:
                raise KilledError
            self.computed.append(name)
            return compute()

        return self.run.checkpoint(name, here)


@pytest.fixture(scope="module")
def whole(log):
    return diagnosed(*log, FEW)


def test_a_run_that_is_killed_twice_goes_on_where_it_stood(log, whole, tmp_path):
    assert sorted(named(whole)) == ["driveline_drag", "standstill_load"]
    runs = []
    for at in ("step-2", "remainder", ""):
        with suppress(KilledError), open_run(tmp_path / "out", {"verb": "test"}) as run:
            runs.append(Kept(run, at))
            result = diagnosed(*log, FEW, checkpoint=runs[-1])
    assert [r.computed[0] for r in runs] == ["step-0", "step-2", "remainder"]
    assert result.summary == whole.summary
    np.testing.assert_array_equal(result.predicted_after, whole.predicted_after)


def test_a_state_is_kept_and_comes_back(log, whole, tmp_path):
    """With sizes by gear, a shape, a term without a name, and what was turned down and taken out; in memory and on
    disk."""
    problem, rows = log[0], whole.training
    state = found_in_turn(rows, problem, ["driveline_drag", "standstill_load"])
    assert any(g is not None for f in state.found for g in f.score.candidate.groups)
    term = Term((Factor("humidity_pct", above=70.0), Factor("speed_mps", 2)), 41.5)
    rows = rows.with_channel(TERM, term.column(rows.rows.segments)[: rows.rows.rows])
    verdict = Verdict("wet_road", 2.0, 0.4, Rejection(Kind.UNSTABLE, {"percent": 3.0}), needed=20, between=True)
    state = replace(
        state, terms=(term,), verdicts=(verdict, Verdict("part_load", None, 1.0, Rejection(Kind.REFIT))),
        refused=("headwind",), tested=("headwind,crosswind",), finished=True,
        removed={"step_change": Rejection(Kind.SUPERFLUOUS, {"beside": "headwind"})},
        absorbs={"road.c_rr": ["grade_bias"]}, trail={",".join(state.ids): [float(x) for x in state.fit.values]},
        fit=replace(state.fit, vehicle=state.fit.vehicle.plus(describing(problem.target)(np.asarray(1.0)))),
    )  # fmt: skip
    plain = to_plain(state)
    with open_run(tmp_path / "out", {"verb": "test"}) as run:
        run.checkpoint("step-1", lambda: plain)
        read = run.checkpoint("step-1", lambda: pytest.fail("computed again"))
    for kept in (plain, read):
        again = from_plain(kept, problem.vehicle, rows)
        for name in ("terms", "verdicts", "removed", "refused", "tested", "absorbs", "finished", "ids"):
            assert getattr(again, name) == getattr(state, name), name
        assert {k: list(v) for k, v in again.trail.items()} == dict(state.trail)
        assert again.fit.table == state.fit.table
        np.testing.assert_array_equal(again.fit.values, state.fit.values)
        segments = problem.segments.with_channels(**{TERM: term.column(problem.segments)})
        np.testing.assert_array_equal(
            problem.predict(again.fit.vehicle, segments), problem.predict(state.fit.vehicle, segments)
        )
        for one, other in zip(again.found, state.found, strict=True):
            assert one.score.candidate == other.score.candidate
            np.testing.assert_array_equal(one.score.beta, other.score.beta)
            assert replace(one, score=other.score) == other


def test_a_limit_that_is_held_away_from_where_it_was_found_comes_back(log, whole):
    problem, _ = log
    rows = replace(whole.training, library={"hvac_power": LIBRARY["hvac_power"]})
    state, hvac = declared(rows, problem), LIBRARY["hvac_power"]
    effect = hvac(below_w_per_k=500.0, above_w_per_k=0.0, heat_c=20.0, cool_c=26.0)
    table = [replace(c, free=False) for c in effect_coefficients(effect, ("below_w_per_k",))]
    candidate = Candidate(hvac, ("below_w_per_k",), (None,), (("heat_c", 14.0),), "size", ())
    found = Found(hvac.id, Score(candidate, np.array([500.0]), 9.0, 0.0, 0.0, 9.0, 1.0), 0.0, 1.0, (), 9.0)
    fit = replace(state.fit, vehicle=state.fit.vehicle.plus(effect), table=state.fit.table.plus(*table))
    again = from_plain(to_plain(replace(state, fit=fit, found=(found,))), problem.vehicle, rows)
    assert float(again.fit.vehicle.effect("hvac_power").heat_c) == 20.0


# --- what comes out ----------------------------------------------------------------------------------------------


def test_the_summary_adds_up(log, whole):
    """The error before and after, the errors on the way between, one candidate a line and each with its kind."""
    problem, split = log
    summary = whole.summary
    test = problem.rows(split.test)
    for when, predicted in (("before", whole.predicted_before), ("after", whole.predicted_after)):
        rmse = np.sqrt(np.mean((problem.measured - predicted)[test] ** 2))
        assert summary[when]["test"]["rmse"] == pytest.approx(rmse)
    first, last = summary["effects"][0], summary["effects"][-1]
    assert first["test_rmse_before"] == summary["before"]["test"]["rmse"]
    assert first["test_rmse_after"] == last["test_rmse_before"]
    assert last["test_rmse_after"] == summary["after"]["test"]["rmse"]
    ids = [c["id"] for c in summary["candidates"]]
    assert len(set(ids)) == len(ids)
    assert set(ids) == set(FEW)
    assert {c["id"] for c in summary["candidates"] if c["kind"] == "found"} == set(named(whole))
    assert {c["kind"] for c in summary["candidates"]} <= {*Kind}
    assert summary["parameters_fitted"] >= len(whole.fit.table.free)
    np.testing.assert_allclose(problem.predict(whole.after), whole.predicted_after)
    assert breaches(whole) == []


def test_an_effect_of_the_sheet_is_declared(log):
    problem, split = log
    car = problem.vehicle.plus(LIBRARY["standstill_load"](power_w=np.asarray(500.0), by_door=np.asarray(0.0)))
    summary = diagnosed(replace(problem, vehicle=car), split, {"standstill_load": FEW["standstill_load"]}).summary
    assert {c["id"]: c["kind"] for c in summary["candidates"]}["standstill_load"] == "declared"
    assert "standstill_load" not in [e["id"] for e in summary["effects"]]


def test_nobody_looks_at_test_trips_before_the_end(log, whole):
    """Other numbers measured there change what is reported of the error, not what is found nor any coefficient."""
    problem, split = log
    test = problem.rows(split.test)
    noise = np.random.default_rng(0).normal(0.0, 50.0, len(test))
    other = diagnosed(replace(problem, measured=problem.measured + np.where(test, noise, 0.0)), split, FEW)
    assert named(other) == named(whole)
    keys = ("id", "q_value", "stability", "indistinguishable_from")
    assert [[e[k] for k in keys] for e in other.summary["effects"]] == [
        [e[k] for k in keys] for e in whole.summary["effects"]
    ]
    assert other.summary["after"]["test"]["rmse"] > 2 * whole.summary["after"]["test"]["rmse"]


# --- logs that are short, odd, or of one trip --------------------------------------------------------------------


def test_a_target_that_is_no_number_is_refused(log):
    problem, split = log
    measured = problem.measured.copy()
    measured[3] = np.nan
    with pytest.raises(InputError, match="missing or infinite values"):
        diagnosed(replace(problem, target="battery_power_kw", measured=measured), split, FEW)


def test_one_trip_is_cut_into_stretches_of_driving(tmp_path):
    """It gives its last third to the test, and the rest in blocks to the training."""
    options = {"effects": {"headwind": {}}, "ratio": 2.0, "ar_coefficient": 0.5}
    _, problem, split = opened(tmp_path, seed=72, trips=1, rows_per_trip=400, **options)
    result = diagnosed(problem, split, FEW)
    assert result.summary["clusters"]["kind"] == "block"
    assert result.summary["clusters"]["count"] >= 8
    assert set(named(result)) <= {"headwind"}
    assert breaches(result) == []


def test_a_log_too_short_says_so_of_each_candidate(tmp_path):
    _, problem, split = opened(tmp_path, seed=73, trips=1, rows_per_trip=60)
    result = diagnosed(problem, split, EACH)
    assert named(result) == []
    assert result.summary["verdict"] in ("nothing_missing", "unexplained_structure")
    kinds = {c["kind"] for c in result.summary["candidates"]}
    assert kinds <= {*Kind} - {Kind.FOUND, Kind.DECLARED}
    if result.summary["clusters"]["count"] < 3:
        assert Kind.TOO_FEW_CLUSTERS in kinds
    assert breaches(result) == []


def test_a_log_that_is_met_exactly_lacks_nothing(log):
    problem, split = log
    exact = replace(problem, measured=problem.predict(problem.vehicle))
    result = diagnosed(exact, split, FEW)
    assert named(result) == []
    assert result.summary["verdict"] == "nothing_missing"


# --- a user's own effect -----------------------------------------------------------------------------------------


def test_a_users_effect_competes_like_any_other(tmp_path):
    def fading(frame) -> None:
        frame["energy_wh"] += 6e4 * np.exp(-frame["time_s"] / 100.0) * frame["duration_s"] / 3600.0

    _, problem, split = opened(tmp_path, seed=74, trips=12, change=fading)
    result = diagnosed(problem, split, {**FEW, FadingStart.id: FadingStart})
    assert named(result) == [FadingStart.id]
    told = result.summary["effects"][0]["parameters"]
    assert abs(told["power_w"]["value"] / 6e4 - 1.0) < 0.15
    low, high = told["tau_s"]["interval_90"]
    assert 0.0 < low < 100.0 < high
    assert breaches(result) == []


# --- two sides of a chain that is measured in between --------------------------------------------------------------


@pytest.fixture(scope="module")
def sides(tmp_path_factory) -> tuple[Problem, Problem, Split]:
    """A log with the force at the wheels, with a sheet of the machine's side alone and with one of both sides."""
    options = {"entry": "shaft", "mode": "samples", "effects": {"copper_loss": {}}, "ratio": 2.0}
    opening = {"seed": 75, "trips": 9, "rows_per_trip": 110, "ar_coefficient": 0.9} | options
    _, alone, _ = opened(tmp_path_factory.mktemp("alone"), **opening)
    _, problem, split = opened(tmp_path_factory.mktemp("both"), road_side=True, **opening)
    return alone, problem, split


def test_each_side_is_diagnosed_apart(sides):
    alone, problem, split = sides
    library = {k: LIBRARY[k] for k in ("copper_loss", "iron_loss", "rolling_speed")}
    result = diagnosed(problem, split, library)
    add_stages(replace(result, problem=alone), library, settings=SETTINGS, seed=0)
    assert "stages" not in result.summary, "the sheet says nothing of the road"
    add_stages(result, library, settings=SETTINGS, seed=0)
    stages = result.summary["stages"]
    assert named(result) == stages["machine"]["effects"] == ["copper_loss"]
    assert stages["machine"]["after"] == result.summary["after"]["test"]
    assert stages["road"]["unit"] == "N"
    assert "copper_loss" not in stages["road"]["effects"]
    assert stages["road"]["before"]["n"] == result.summary["before"]["test"]["n"]
    assert any("between the road and the wheels" in note for note in result.summary["notes"])
    assert breaches(result) == []


def test_what_lies_behind_a_force_is_excluded_with_a_reason(sides):
    _, problem, split = sides
    force = prepare(split.log, problem.sheet, "traction_force_n")
    library = {k: LIBRARY[k] for k in ("power_gain", "periodic_load", "mode_change", "rolling_speed")}
    result = diagnosed(force, split, library)
    assert [e["id"] for e in result.summary["excluded"]] == ["power_gain"]
    kinds = {c["id"]: c["kind"] for c in result.summary["candidates"]}
    assert "power_gain" not in kinds
    assert kinds["periodic_load"] == kinds["mode_change"] == "unavailable"
    assert breaches(result) == []
