"""Swaps: a found effect that something else does more than in its place, now that the others are there."""

from dataclasses import replace

import numpy as np
import pytest
from planted import opened

from hdev_jax.diagnosis import search as searching
from hdev_jax.diagnosis.look import Found, Loop, Search, look
from hdev_jax.diagnosis.refit import refit
from hdev_jax.diagnosis.select import exchanged
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


@pytest.mark.parametrize("wrong", ["auxiliary_power", "cabin_warmup", "step_change"])
def test_what_does_more_takes_the_place_of_what_was_found(wrong, problem):
    loop, state = found_in_turn(problem, (wrong, "headwind"), LIKELY)
    said = []
    swapped = exchanged(loop, state, said.append)
    assert swapped is not None
    assert [f.id for f in swapped.found] == ["headwind", "standstill_load"]
    assert swapped.taken_out == (wrong,)
    assert not swapped.vehicle.has(wrong)
    assert not any(wrong in c.path for c in swapped.table.rows)
    assert swapped.fit.sigma < state.fit.sigma
    assert f"exchanged {wrong} for standstill_load" in said
    assert state.taken_out == (), "the state that was asked stays as it is"
    assert exchanged(loop, swapped, silent) is None, "no way back"


def test_what_does_most_stays_and_so_does_what_cannot_be_told_from_more(problem):
    loop, right = found_in_turn(problem, ("standstill_load", "headwind"), LIKELY)
    assert exchanged(loop, right, silent) is None
    loop, state = found_in_turn(problem, ("cabin_warmup", "headwind"), LIKELY)
    assert exchanged(loop, replace(state, taken_out=("standstill_load", "auxiliary_power")), silent) is None
    assert exchanged(loop, replace(state, found=state.found[::-1]), silent) is None, "the newest has just competed"
    for one in ("auxiliary_power", "power_gain"):
        loop, state = found_in_turn(problem, (one, "headwind"), ("headwind", "auxiliary_power", "power_gain"))
        assert exchanged(loop, state, silent) is None, "a constant load and an offset of the power are one column"


def test_a_swap_clears_every_bar(problem):
    loop, state = found_in_turn(problem, ("cabin_warmup", "headwind"), LIKELY)
    assert exchanged(replace(loop, fdr=0.0), state, silent) is None


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
