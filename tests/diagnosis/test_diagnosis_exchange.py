"""Swaps: a found effect that something else does more than in its place, now that the others are there."""

from dataclasses import replace

import numpy as np
import pytest
from planted import opened

from hdev_jax.diagnosis.competition import exchange, select
from hdev_jax.diagnosis.competition import search as searching
from hdev_jax.diagnosis.competition.exchange import exchanged
from hdev_jax.diagnosis.competition.refit import refit
from hdev_jax.diagnosis.result.memory import from_plain, to_plain
from hdev_jax.diagnosis.scores.look import Found, Loop, Search, View, look
from hdev_jax.inference import calibrate, cluster_rows, padded
from hdev_jax.physics import LIBRARY

PLANTED = ("headwind", "standstill_load")


def silent(_: str) -> None:
    return None


def found_in_turn(problem, ids, library) -> tuple[Loop, Search]:
    """The loop and its state as if these had been found one after the other."""
    rows, clusters = padded(problem.segments, problem.measured), cluster_rows(problem.segments)
    effects = [LIBRARY[k] for k in library]
    loop = Loop(rows, problem.target, clusters, effects, 0.05, np.random.default_rng(0), 4)
    fit = calibrate(problem.vehicle, problem.table, rows, problem.target, clusters)
    state = Search(problem.vehicle, problem.table, fit)
    for id_ in ids:
        view = look(loop, state)
        tried = refit(loop, state, view.best[id_], view)
        assert isinstance(tried, tuple), id_
        state, gain, score = tried
        state.found = [*state.found, Found(id_, score, 1e-9, 1.0, (), gain)]
    return loop, state


@pytest.fixture(scope="module")
def problem(tmp_path_factory):
    folder = tmp_path_factory.mktemp("log")
    _, problem, _ = opened(folder, seed=5, trips=12, rows_per_trip=150, effects={k: {} for k in PLANTED}, ratio=1.5)
    return problem


LIKELY = (*PLANTED, "auxiliary_power", "cabin_warmup", "step_change", "rolling_speed")


def seen(loop: Loop, state: Search, *in_other_forms: str) -> View:
    view = look(loop, state)
    view.in_other_forms.update(in_other_forms)
    return view


@pytest.fixture(scope="module")
def stood_in(problem):
    """Warm-up of the cabin in the place of a load at standstill, then the headwind."""
    loop, state = found_in_turn(problem, ("cabin_warmup", "headwind"), LIKELY)
    return loop, state, seen(loop, state)


@pytest.mark.parametrize("wrong", ["auxiliary_power", "cabin_warmup", "step_change"])
def test_what_does_more_takes_the_place_of_what_was_found(wrong, problem):
    loop, state = found_in_turn(problem, (wrong, "headwind"), LIKELY)
    state = replace(state, refused=("rolling_speed",))
    said = []
    swapped = exchanged(loop, state, seen(loop, state), said.append)
    assert swapped is not None
    assert [f.id for f in swapped.found] == ["headwind", "standstill_load"]
    assert (swapped.exchanged, swapped.taken_out, swapped.refused) == ((wrong,), (), ("rolling_speed",))
    assert not swapped.vehicle.has(wrong)
    assert not any(wrong in c.path for c in swapped.table.rows)
    assert swapped.fit.sigma < state.fit.sigma
    assert f"exchanged {wrong} for standstill_load" in said
    assert state.exchanged == (), "the state that was asked stays as it is"
    back = replace(swapped, found=swapped.found[::-1])
    assert exchanged(loop, back, seen(loop, back), silent) is None
    again = from_plain(to_plain(swapped), problem.vehicle, LIBRARY, 4)
    assert again.exchanged == swapped.exchanged
    np.testing.assert_array_equal(problem.predict(again.fit.vehicle), problem.predict(swapped.fit.vehicle))


def test_what_does_most_stays_and_so_does_one_of_a_class(problem):
    loop, right = found_in_turn(problem, ("standstill_load", "headwind"), LIKELY)
    assert exchanged(loop, right, seen(loop, right), silent) is None
    for one in ("auxiliary_power", "power_gain"):
        loop, state = found_in_turn(problem, (one, "headwind"), ("headwind", "auxiliary_power", "power_gain"))
        view = seen(loop, state)
        assert exchanged(loop, state, view, silent) is None, "a constant load and an offset of the power are one column"


def test_the_newest_is_not_asked_nor_what_trips_alone_tell_of_rows(stood_in):
    loop, state, view = stood_in
    assert exchanged(loop, replace(state, found=state.found[::-1]), view, silent) is None
    first = state.found[0]
    by_trips = replace(first, score=replace(first.score, plain=True))
    assert exchanged(loop, replace(state, found=[by_trips, *state.found[1:]]), view, silent) is None


ABLE = ("standstill_load", "auxiliary_power", "step_change")


@pytest.mark.parametrize("bar", ["taken_out", "exchanged"])
def test_what_has_left_takes_no_place(bar, stood_in):
    loop, state, view = stood_in
    assert exchanged(loop, replace(state, **{bar: ABLE}), view, silent) is None


def test_another_form_of_what_was_found_takes_no_place(stood_in):
    loop, state, _ = stood_in
    assert exchanged(loop, state, seen(loop, state, *ABLE), silent) is None


def test_a_swap_clears_every_bar(stood_in, monkeypatch):
    loop, state, view = stood_in
    assert exchanged(replace(loop, fdr=0.0), state, view, silent) is None
    monkeypatch.setattr(select, "_placebo", lambda *_: "a placebo does as well")
    assert exchanged(loop, state, view, silent) is None


def test_the_joint_refits_decide(stood_in, monkeypatch):
    """What looks better by the first linear step, and is not well ahead once both are fitted, takes no place."""
    loop, state, view = stood_in
    monkeypatch.setattr(exchange, "gained", lambda *_: 1e6)
    assert exchanged(loop, state, view, silent) is None


@pytest.mark.parametrize(
    ("one", "other", "ahead"), [(100.0, 84.0, True), (100.0, 86.0, False), (9.0, 5.5, True), (5.0, 2.5, False)]
)
def test_well_ahead_is_by_a_share_and_by_more_than_chance(one, other, ahead):
    assert exchange._well_ahead(one, other) is ahead


def test_the_search_swaps_once_nothing_is_left_to_add(monkeypatch, problem):
    """With one of the two planted never added, what stands in for it is found, and the loop still ends with the two."""
    choose, asked = searching.choose, []

    def wrong_first(problem, state, view, tell, *, skip):
        asked.append([f.id for f in state.found])
        return choose(problem, state, view, tell, skip=[*skip, "standstill_load"])

    monkeypatch.setattr(searching, "choose", wrong_first)
    library = [LIBRARY[k] for k in (*PLANTED, "cabin_warmup")]
    rows, said = padded(problem.segments, problem.measured), []
    state = searching.search(
        problem.vehicle, problem.table, rows, problem.target, library, fdr=0.05, seed=0, gears=4, tell=said.append
    )
    assert ["cabin_warmup", "headwind"] in asked, "the test needs the wrong one first"
    assert state.finished
    assert [f.id for f in state.found] == ["headwind", "standstill_load"], said
    assert state.trail["headwind,standstill_load"] == [float(x) for x in state.fit.values]
