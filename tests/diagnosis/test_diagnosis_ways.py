"""Every look at the same rows counts: a finer grid, and a formula that the round before has chosen."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hdev_jax.diagnosis.candidates import expression
from hdev_jax.diagnosis.candidates.candidate import Candidate
from hdev_jax.diagnosis.candidates.expression import Described, Factor, find_expression
from hdev_jax.diagnosis.competition import sharpen
from hdev_jax.diagnosis.scores.evidence import Evidence, Score
from hdev_jax.diagnosis.scores.look import Loop, Search, View
from hdev_jax.diagnosis.scores.sums import Ground
from hdev_jax.inference import Calibration, ParameterTable
from hdev_jax.physics import LIBRARY, Vehicle
from hdev_jax.segments import Segments


def bare(cls: type, **values: Any) -> Any:
    """An object of the class that has these attributes alone."""
    made = object.__new__(cls)
    for name, value in values.items():
        object.__setattr__(made, name, value)
    return made


def score(effect: type, p: float, *, p_model: float = 1e-20) -> Score:
    c = Candidate(effect, ("k",), (None,), (("shape", 1.0),), "size", (0,))
    return Score(c, np.ones(1), 50.0, p_model, p / 2.0, 40.0, 1.0)  # p is twice the larger of the two


def view(best: dict[str, Score], ways: dict[str, float]) -> View:
    source: Any = SimpleNamespace(candidates=(), left_out={}, width=1, write=lambda out, segments, at=None: None)
    looks = bare(Evidence), bare(Evidence), bare(Ground), source
    return View(*looks, np.zeros(1, bool), best, ways, {}, {}, {})


@pytest.mark.parametrize(("finer_p", "q"), [(1e-5, 1e-5 * 3 * 4 * 2), (0.0099, 0.01 * 3 * 2)])
def test_a_finer_grid_is_more_ways(monkeypatch, finer_p, q):
    """p of the best of four finer ways counts four times; where that is no better, the first look stands."""
    doubted, other = score(LIBRARY["regen_cutoff"], 0.01), score(LIBRARY["headwind"], 0.9, p_model=0.4)
    seen = view({"regen_cutoff": doubted, "headwind": other}, {"regen_cutoff": 3.0, "headwind": 1.0})
    assert seen.q["regen_cutoff"] == pytest.approx(0.06)
    monkeypatch.setattr(sharpen, "refined", lambda *_: (replace(doubted, p_cluster=finer_p / 2.0), 4.0))
    sharp = sharpen.sharpened(bare(Loop, fdr=0.05), seen)
    assert sharp.q["regen_cutoff"] == pytest.approx(q)
    assert sharp.q["headwind"] == pytest.approx(0.9)


@pytest.mark.parametrize(("ways", "q"), [(1.0, 1e-4), (70.0, 7e-3)])
def test_a_formula_of_the_round_before_counts_the_ways_it_was_sought_in(monkeypatch, ways, q):
    one = view({"expression": score(Described, 1e-4)}, {"expression": 1.0})
    asked = []
    monkeypatch.setattr(expression, "_best", lambda *_: ("best", one))

    def chosen(start, problem, best, seen, *_):
        asked.append(seen.q["expression"])
        raise StopIteration

    monkeypatch.setattr(expression, "_chosen", chosen)
    state = Search(bare(Vehicle), bare(ParameterTable), bare(Calibration))
    first = (Factor("humidity_pct", above=70.0),)
    with pytest.raises(StopIteration):
        find_expression(state, bare(Loop), bare(Segments), predict=lambda *_: np.zeros(0), first=first, ways=ways)
    assert asked == [pytest.approx(q)]
