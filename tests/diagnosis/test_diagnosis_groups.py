"""Sizes by gear: a gear in which an effect does nothing leaves with its column, the effect stays."""

from dataclasses import replace
from typing import Any, ClassVar

import jax
import numpy as np
import pytest
from planted import opened

from hdev_jax.diagnosis.candidates.candidate import Candidate, columns
from hdev_jax.diagnosis.competition import sharpen
from hdev_jax.diagnosis.competition.refit import refit
from hdev_jax.diagnosis.competition.select import _tried
from hdev_jax.diagnosis.diagnose import Diagnosis, diagnose
from hdev_jax.diagnosis.scores.evidence import Score
from hdev_jax.diagnosis.scores.look import Loop, Search, View, look
from hdev_jax.diagnosis.scores.ranking import inside, plausible, without_idle
from hdev_jax.inference import calibrate, cluster_rows, padded
from hdev_jax.physics import LIBRARY, Effect, Parameter
from hdev_jax.problem import Problem, Split

TOLD = (1e-9, 1e-9, 9.0, 0.5)  # p of the model and of clusters, gain on clusters left out, share left of the column
FEW = ("driveline_drag", "iron_loss", "gear_efficiency", "constant_headwind", "auxiliary_power", "rolling_speed")


def diagnosed(problem: Problem, split: Split) -> Diagnosis:
    return diagnose(problem, split, {k: LIBRARY[k] for k in FEW}, seed=0)


@pytest.mark.parametrize(
    ("seed", "torque"),
    [(3, {2: 25.0, 3: 25.0}), (4, {2: 25.0, 3: 25.0}), (1, {1: 40.0})],
    ids=["middle gears", "middle gears again", "first gear"],
)
def test_a_drag_of_some_gears_is_found_though_others_have_none(seed, torque, tmp_path):
    """An estimate of nothing is negative in half of the logs: that refuses its gear, not the drag of the others."""
    planted = {"driveline_drag": {f"torque_nm[{n}]": x for n, x in torque.items()}}
    synthetic, problem, split = opened(
        tmp_path, seed=seed, trips=12, rows_per_trip=200, effects=planted, ratio=1.0, ar_coefficient=0.9
    )
    summary = diagnosed(problem, split).summary
    assert [(e["id"], e["indistinguishable_from"]) for e in summary["effects"]] == [("driveline_drag", [])]
    sizes = summary["effects"][0]["parameters"]
    truth = synthetic.vehicle.effects["driveline_drag"]
    assert all(abs(p["value"] - truth.get(name, 0.0)) <= 3.0 * p["sd"] for name, p in sizes.items())
    assert {f"torque_nm[{n}]" for n in torque} <= set(sizes)
    assert all(p["value"] >= 0.0 for p in sizes.values())


def test_neutral_at_standstill_takes_no_effect_away(tmp_path):
    """Its column is nothing but zeros: there is no such gear to have a torque in."""
    _, problem, split = opened(tmp_path, seed=1, trips=12, rows_per_trip=200, effects={"driveline_drag": {}}, ratio=1.0)
    before = diagnosed(problem, split).summary["effects"]
    stands = np.asarray(problem.segments.distance_m) == 0
    assert stands.mean() > 0.02
    gear = np.where(stands, 0.0, problem.segments.channels["gear"])
    neutral = replace(problem, segments=problem.segments.with_channels(gear=gear))
    after = diagnosed(neutral, split).summary["effects"]
    assert [e["id"] for e in after] == [e["id"] for e in before] == ["driveline_drag"]
    assert set(after[0]["parameters"]) == {f"torque_nm[{n}]" for n in (1, 2, 3, 4)}
    for name, p in after[0]["parameters"].items():
        np.testing.assert_allclose(p["value"], before[0]["parameters"][name]["value"], rtol=1e-6)


def test_groups_may_go_one_by_one_and_other_sizes_all_together(tmp_path):
    _, problem, _ = opened(tmp_path, seed=1, trips=3)
    effects = [LIBRARY[k] for k in ("driveline_drag", "hvac_power")]
    every, _, _ = columns(problem.vehicle, effects, problem.segments, len(problem.measured), problem.target)
    drag = next(c for c in every if c.id == "driveline_drag")
    two = drag.only([False, True, True, False])
    assert two is not None
    assert (two.sizes, two.groups, two.columns) == (("torque_nm",) * 2, (2, 3), drag.columns[1:3])
    assert drag.only([True] * 4) is drag
    assert drag.only([False] * 4) is None
    both = next(c for c in every if len(c.sizes) == 2 and c.id == "hvac_power")
    assert both.only([True, True]) is both
    assert both.only([True, False]) is None, "heating without cooling is a way of its own, with its own shapes"


def test_only_a_group_beyond_a_null_that_bounds_it_goes(tmp_path):
    """A torque below nothing is a gear without drag; one of 300 Nm, or a delta of half, says the effect is another."""
    _, problem, _ = opened(tmp_path, seed=1, trips=3)
    effects = [LIBRARY[k] for k in ("driveline_drag", "gear_efficiency", "hvac_power")]
    every, _, _ = columns(problem.vehicle, effects, problem.segments, len(problem.measured), problem.target)
    drag, efficiency = (next(c for c in every if c.id == k) for k in ("driveline_drag", "gear_efficiency"))
    both = next(c for c in every if len(c.sizes) == 2 and c.id == "hvac_power")
    fewer = without_idle(drag, np.array([9.0, -0.5, -2.0, 8.0]))
    assert fewer is not None
    assert fewer.groups == (1, 2, 4), "the furthest goes first"
    assert without_idle(drag, np.array([9.0, 2.5, 7.0, 300.0])) is None
    assert without_idle(efficiency, np.full(len(efficiency.sizes), -0.5)) is None
    assert without_idle(both, np.array([-9.0, 0.5])) is None, "heating without cooling is a way of its own"

    def scores(candidates):
        return [Score(c, np.array([9.0, -0.1, 0.0, 300.0])[np.array(c.groups) - 1], 50.0, *TOLD) for c in candidates]

    left = inside(scores([drag])[0], scores)
    assert left.candidate.groups == (1, 3, 4)
    assert not plausible(left), "300 Nm are no drag"


def looked(problem: Problem, effect: type[Effect]) -> tuple[Loop, Search, View]:
    """A loop over the whole log with one candidate, at its declared model."""
    rows, clusters = padded(problem.segments, problem.measured), cluster_rows(problem.segments)
    loop = Loop(rows, problem.target, clusters, [effect], 0.05, np.random.default_rng(0), 4)
    fit = calibrate(problem.vehicle, problem.table, rows, problem.target, clusters)
    state = Search(problem.vehicle, problem.table, fit)
    return loop, state, look(loop, state)


@pytest.mark.parametrize("plain", [False, True], ids=["whitened", "by clusters"])
def test_a_gear_that_the_joint_refit_puts_below_nothing_leaves_and_the_others_are_tested_anew(plain, tmp_path):
    torque = {"torque_nm[1]": 40.0, "torque_nm[2]": 40.0, "torque_nm[3]": 40.0, "torque_nm[4]": -40.0}
    _, problem, _ = opened(tmp_path, seed=1, trips=12, effects={"driveline_drag": torque}, ratio=0.5)
    loop, state, view = looked(problem, LIBRARY["driveline_drag"])
    assert view.best["driveline_drag"].candidate.groups == (1, 2, 3), "the scores show it already"
    every = next(c for c in view.source.candidates if len(c.groups) == 4)
    s = view.plain.plain_score(every) if plain else view.evidence.score(every)
    tried = refit(loop, state, s, view)
    assert isinstance(tried, Candidate)
    assert tried.groups == (1, 2, 3)
    taken = _tried(loop, state, s, view, lambda _: None)
    assert not isinstance(taken, str)
    again, (joint, _, _) = taken
    assert again.candidate == tried
    assert again.plain is plain
    assert again is view.best["driveline_drag"]
    assert again.gain < s.gain, "what the fourth gear explained is not counted"
    assert {c.name for c in joint.table.free if c.path.startswith("effects.")} == {
        f"effects.driveline_drag.torque_nm[{n}]" for n in (1, 2, 3)
    }
    hard = replace(loop, fdr=0.0)
    assert "do not clear" in _tried(hard, state, s, view, lambda _: None)


def test_a_gear_of_test_trips_alone_has_no_torque(tmp_path):
    """As in the sheet that is written, which says nothing of it; not the torque of the gear before it."""
    _, problem, split = opened(tmp_path, seed=1, trips=12, rows_per_trip=200, effects={"driveline_drag": {}}, ratio=1.0)
    gear = np.asarray(problem.segments.channels["gear"]).copy()
    tested = problem.rows(split.test)
    gear[tested] = np.where(gear[tested] == 4, 5, gear[tested])
    after = diagnosed(replace(problem, segments=problem.segments.with_channels(gear=gear)), split).after
    values = np.asarray(after.effect("driveline_drag").torque_nm.values)
    assert np.all(values[[1, 2, 3, 4]] > 0)
    assert values[5] == 0


def test_what_goes_against_one_gear_takes_that_gear_away_and_not_the_drag(tmp_path):
    """Something slow goes against the fourth gear: whitened rows still show it, rows of equal weight refuse it."""
    _, problem, split = opened(tmp_path, seed=1, trips=24, rows_per_trip=200, effects={"driveline_drag": {}}, ratio=1.0)
    every, column, _ = columns(
        problem.vehicle, [LIBRARY["driveline_drag"]], problem.segments, len(problem.measured), problem.target
    )
    (drag,) = [c for c in every if 4 in c.groups]
    trip, fourth = np.asarray(problem.segments.trip), column[:, drag.columns[drag.groups.index(4)]]
    slow = np.zeros_like(fourth)
    for t in np.unique(trip):
        slow[trip == t] = np.convolve(fourth[trip == t], np.full(81, 1 / 81), "same")
    summary = diagnosed(replace(problem, measured=problem.measured - 110.0 * slow), split).summary
    assert [e["id"] for e in summary["effects"]] == ["driveline_drag"]
    assert set(summary["effects"][0]["parameters"]) == {f"torque_nm[{n}]" for n in (1, 2, 3)}
    assert summary["verdict"] == "effects_found_and_unexplained_structure"


class DragAboveSpeed(LIBRARY["driveline_drag"]):
    """A drag by gear that sets in at a speed: sizes by gear with a shape, which the library has not."""

    id: ClassVar = "drag_above_speed"
    parameters: ClassVar = (
        *LIBRARY["driveline_drag"].parameters,
        Parameter("above_mps", "m/s", 8.0, 4.0, 0.0, 30.0, kind="shape", grid=(2.0, 6.0, 10.0, 14.0)),
    )
    above_mps: Any

    def drive(self, row, car, point):
        return jax.nn.sigmoid(row.speed_mps - self.above_mps) * super().drive(row, car, point)


@pytest.mark.parametrize("torque", [{2: 25.0, 3: 25.0}, {2: 40.0, 3: -30.0, 4: 40.0}], ids=["some gears", "one below"])
def test_a_shape_beside_sizes_by_gear_is_sought_for_the_gears_that_are_left(torque, tmp_path):
    planted = {"driveline_drag": {f"torque_nm[{n}]": x for n, x in torque.items()}}
    _, problem, split = opened(tmp_path, seed=3, trips=12, rows_per_trip=200, effects=planted, ratio=1.0)
    kept = {}

    def checkpoint(name, compute):
        return kept.setdefault(name, compute())

    library = {DragAboveSpeed.id: DragAboveSpeed}
    result = diagnose(problem, split, library, seed=0, checkpoint=checkpoint)
    (found,) = result.summary["effects"]
    gears = {n.removeprefix("torque_nm[").removesuffix("]") for n in found["parameters"] if n.startswith("torque")}
    assert {str(n) for n, x in torque.items() if x > 0} <= gears
    assert gears <= {str(n) for n in range(1, 5) if torque.get(n, 0.0) >= 0}
    again = diagnose(problem, split, library, seed=0, checkpoint=checkpoint)
    np.testing.assert_array_equal(again.predicted_after, result.predicted_after)


@pytest.mark.parametrize("loses", [False, True], ids=["as many gears", "a gear less"])
def test_a_finer_shape_is_one_of_the_same_gears(loses, monkeypatch, tmp_path):
    """Where the finest grid would lose a gear it is another candidate, which this refit was not asked for."""
    _, problem, _ = opened(tmp_path, seed=1, trips=6, effects={"driveline_drag": {}}, ratio=1.0)
    loop, _, view = looked(problem, DragAboveSpeed)
    every = next(c for c in view.source.candidates if len(c.groups) == 4)
    s = view.evidence.score(every.only([True, False, True, True]))
    asked = []

    def best_of(evidence, plain, same, slow):
        asked.extend(c.groups for c in same)
        best = same[0].only([True, not loses, True])
        return {s.candidate.id: replace(evidence.score(best), gain=s.gain + 1.0)}, {s.candidate.id: 2.0}

    monkeypatch.setattr(sharpen, "best_of", best_of)
    finest, ways = sharpen.refined(loop, s, view)
    assert set(asked) == {(1, 3, 4)}, "the gear that is out stays out"
    assert len(asked) > 1
    assert (finest is s, ways) == (loses, 1.0 if loses else 2.0)
    assert finest.candidate.groups == (1, 3, 4)
