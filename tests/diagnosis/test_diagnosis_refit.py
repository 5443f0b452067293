"""A second size joins an effect that was found with one; and a state that has grown is kept like any other."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from hdev_jax.diagnosis.candidates.candidate import Candidate, columns
from hdev_jax.diagnosis.competition.refit import grow, joined, refit, without
from hdev_jax.diagnosis.competition.select import prune
from hdev_jax.diagnosis.result.memory import from_plain, to_plain
from hdev_jax.diagnosis.scores import look as looks
from hdev_jax.diagnosis.scores.evidence import Score
from hdev_jax.fleet import synthetic_log
from hdev_jax.inference import calibrate, cluster_rows, effect_coefficients, padded
from hdev_jax.inference.sheet import read_sheet
from hdev_jax.logs import read_log
from hdev_jax.physics import LIBRARY
from hdev_jax.problem import prepare

HVAC = {"below_w_per_k": 900.0, "heat_c": 14.0, "cool_c": 20.0}


def silent(_: str) -> None:
    return None


def heating_found(folder, above_w_per_k: float):
    """A log with heating and so much cooling, and the state of a loop that has found the heating alone."""
    effects = {"hvac_power": {**HVAC, "above_w_per_k": above_w_per_k}}
    files = synthetic_log(seed=4, trips=20, rows_per_trip=80, effects=effects, noise_level=0.02).write(folder)
    problem = prepare(read_log([files["log"]]), read_sheet(files["sheet"]))
    rows = padded(problem.segments, problem.measured)
    clusters = cluster_rows(problem.segments)
    library = [LIBRARY["hvac_power"]]
    loop = looks.Loop(rows, problem.target, clusters, library, 0.05, np.random.default_rng(0), 4)
    declared = looks.Search(
        problem.vehicle, problem.table, calibrate(problem.vehicle, problem.table, rows, problem.target, clusters)
    )
    view = looks.look(loop, declared)
    found, _, _ = columns(problem.vehicle, library, rows.segments, rows.rows, problem.target)
    heating = [c for c in found if c.sizes == ("below_w_per_k",)]
    total = view.evidence.totals()
    best = max(heating, key=lambda c: view.evidence.gain(total, c.columns)[0])
    score = view.evidence.score(best)
    tried = refit(loop, declared, score, view)
    assert isinstance(tried, tuple)
    state, gain, score = tried
    state.found = [looks.Found("hvac_power", score, 1e-9, 1.0, (), gain)]
    return problem, loop, state


def test_cooling_joins_the_heating_that_was_found(tmp_path):
    problem, loop, state = heating_found(tmp_path, 700.0)
    grown = grow(loop, state, silent)
    assert grown is not None
    candidate = grown.found[0].score.candidate
    assert candidate.sizes == ("below_w_per_k", "above_w_per_k")
    size = {c.name: (v, s) for c, v, s in zip(grown.table.free, grown.fit.values, grown.fit.sd, strict=True)}
    for name, true in (("below_w_per_k", 900.0), ("above_w_per_k", 700.0), ("heat_c", 14.0), ("cool_c", 20.0)):
        value, sd = size[f"effects.hvac_power.{name}"]
        assert abs(value - true) < 3 * sd, f"{name}: {value:.3g} ± {sd:.2g}, planted {true}"
    assert grown.fit.sigma < state.fit.sigma
    assert grow(loop, grown, silent) is None
    again = from_plain(to_plain(grown), problem.vehicle, LIBRARY, 4)
    np.testing.assert_array_equal(problem.predict(again.fit.vehicle), problem.predict(grown.fit.vehicle))
    np.testing.assert_array_equal(again.table.values(again.fit.vehicle), jnp.asarray(grown.fit.values))


def test_what_is_told_beside_an_effect_is_told_anew_without_it(tmp_path):
    """A size that whitened rows told beside another is not held where it was once the other is gone."""
    effects = {"rotating_mass": {"factor": 0.08}, "mass_scale": {"scale": 0.06}}
    files = synthetic_log(seed=6, trips=12, rows_per_trip=100, effects=effects, ar_coefficient=0.97).write(tmp_path)
    problem = prepare(read_log([files["log"]]), read_sheet(files["sheet"]))
    rows, clusters = padded(problem.segments, problem.measured), cluster_rows(problem.segments)
    loop = looks.Loop(rows, problem.target, clusters, (), 0.05, np.random.default_rng(0), 4)
    fit = calibrate(problem.vehicle, problem.table, rows, problem.target, clusters)
    declared = looks.Search(problem.vehicle, problem.table, fit)
    noise = loop.noise(fit)

    def score(id_: str, size: float) -> Score:
        kind = LIBRARY[id_]
        sizes = tuple(p.name for p in kind.parameters if p.kind == "size")
        shapes = tuple((p.name, p.null) for p in kind.parameters if p.kind != "size")
        candidate = Candidate(kind, sizes, (None,) * len(sizes), shapes, "size", tuple(range(len(sizes))))
        return Score(candidate, np.full(len(sizes), size), 50.0, 1e-9, 1e-6, 8.0, 0.7)

    alone = joined(loop, declared, score("mass_scale", 0.05), noise)
    both = joined(loop, alone, score("rotating_mass", 0.08), noise)
    assert all(c.told for c in both.table.free if c.path.startswith("effects."))
    assert not any(c.told for c in both.table.free if not c.path.startswith("effects."))
    back = without(loop, replace(both, found=[]), "rotating_mass")
    np.testing.assert_allclose(back.fit.values, alone.fit.values, rtol=0.05)
    moved = both.fit.values[[c.path.startswith("effects.mass") for c in both.table.free]]
    own = alone.fit.values[[c.path.startswith("effects.mass") for c in alone.table.free]]
    assert abs(moved - own) > 0.2 * abs(own), "the two do not meet: nothing would show"


def test_nothing_joins_where_nothing_is(tmp_path):
    _, loop, state = heating_found(tmp_path, 0.0)
    assert grow(loop, state, silent) is None


def test_the_newest_effect_is_asked_only_where_told_so(tmp_path):
    """A size that is nothing stays right after it was added, since it has just cleared every bar, and no longer."""
    _, loop, state = heating_found(tmp_path, 0.0)
    effect = LIBRARY["standstill_load"](power_w=jnp.asarray(1.0), by_door=jnp.asarray(0.0))
    rows = effect_coefficients(effect, ("power_w",), shapes=False)
    vehicle, table = state.fit.vehicle.plus(effect), state.table.plus(*rows)
    fit = calibrate(vehicle, table, loop.rows, loop.target, loop.clusters)
    heating = state.found[0]
    candidate = replace(heating.score.candidate, effect=type(effect), sizes=("power_w",))
    nothing = replace(heating, id=effect.id, score=replace(heating.score, candidate=candidate))
    both = replace(state, vehicle=fit.vehicle, table=table, fit=fit, found=[heating, nothing])
    assert [f.id for f in prune(loop, both, silent).found] == [heating.id, nothing.id]
    assert [f.id for f in prune(loop, both, silent, newest=True).found] == [heating.id]
    turned = replace(both, found=[nothing, heating])
    assert [f.id for f in prune(loop, turned, silent).found] == [heating.id]
    assert [f.id for f in prune(loop, state, silent, newest=True).found] == [heating.id]


@pytest.mark.parametrize(("lag_s", "stays"), [(0.0, False), (3.0, True)])
def test_a_lag_is_asked_as_a_size_is_and_a_switch_is_not(lag_s, stays, tmp_path):
    effects = {"grade_lag": {"lag_s": lag_s}} if lag_s else {}
    files = synthetic_log(seed=5, trips=20, rows_per_trip=80, effects=effects, noise_level=0.02).write(tmp_path)
    problem = prepare(read_log([files["log"]]), read_sheet(files["sheet"]))
    rows, clusters = padded(problem.segments, problem.measured), cluster_rows(problem.segments)
    loop = looks.Loop(rows, problem.target, clusters, (), 0.05, np.random.default_rng(0), 4)
    vehicle, table, found = problem.vehicle, problem.table, []
    for id_, size, value in (("grade_lag", "lag_s", 1.0), ("traction_limit", "power_w", 1e5)):
        effect = LIBRARY[id_](**{p.name: jnp.asarray(value) for p in LIBRARY[id_].parameters})
        vehicle, table = vehicle.plus(effect), table.plus(*effect_coefficients(effect, (size,), shapes=False))
        candidate = Candidate(LIBRARY[id_], (size,), (None,), ((size, value),), "limit", (0,))
        score = Score(candidate, np.ones(1), 9.0, 1e-6, 1e-6, 9.0, 1.0)
        found.append(looks.Found(id_, score, 1e-6, 1.0, (), 9.0))
    fit = calibrate(vehicle, table, rows, problem.target, clusters)
    state = looks.Search(fit.vehicle, fit.table, fit, found=found)
    left = prune(loop, state, silent, newest=True)
    assert [f.id for f in left.found] == ["grade_lag"] * stays + ["traction_limit"]
