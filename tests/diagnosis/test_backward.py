"""What stays beside a term without a name, and beside a cycle: an effect that the level of entry would turn away."""

from dataclasses import replace

import numpy as np
import pytest
from planted import FadingStart, found_in_turn, opened, training

from hdev_jax.diagnosis.candidates.unnamed import Factor, Term
from hdev_jax.diagnosis.competition.cycle import add_cycle
from hdev_jax.diagnosis.competition.needed import backward, needed
from hdev_jax.diagnosis.competition.state import State
from hdev_jax.diagnosis.scores.passes import evidence_of
from hdev_jax.diagnosis.training import Training
from hdev_jax.physics import unavailable

HUMIDITY = Term((Factor("humidity_pct"),), 1.0)


def among_many(rows: Training) -> Training:
    """The rows with so many effects tried as the library has: the others are a user's own, which no shared program
    holds, so that none of them has to be compiled."""
    others = {f"own_{k}": type(f"Own{k}", (FadingStart,), {"id": f"own_{k}"}) for k in range(50)}
    return replace(rows, library={**rows.library, **others})


def shows_something(rows: Training, state: State, id_: str) -> None:
    """Its p beside all others lies between the level of entry and that of staying."""
    (found,) = (f for f in state.found if f.id == id_)
    p = needed(evidence_of(rows.baseline(state.fit)), state.fit, found).p
    car, row = state.fit.vehicle, rows.facts.sample
    tried = [c for c in rows.library.values() if not unavailable(c, row, car.entry, car.stands_in)]
    assert len(tried) > 50
    assert rows.settings.fdr / len(tried) < p < rows.settings.stays, f"p = {p:.2g} shows nothing"


@pytest.mark.parametrize(
    ("id_", "power_w", "seed", "stays"), [("auxiliary_power", 900.0, 12, True), ("cabin_warmup", 1700.0, 11, False)]
)
def test_a_constant_load_stays_beside_a_term_without_a_name_and_others_do_not(id_, power_w, seed, stays, tmp_path):
    options = {"trips": 12, "rows_per_trip": 80, "effects": {id_: {"power_w": power_w}}, "noise_rms": 30.0}
    _, problem, _ = opened(tmp_path, seed=seed, **options)
    rows = training(problem, [id_])
    state = found_in_turn(rows, problem, [id_])
    rows = among_many(rows)
    shows_something(rows, state, id_)
    assert backward(rows, state, newest=True).ids == (id_,), "alone it is needed"
    assert backward(rows, replace(state, terms=(HUMIDITY,))).ids == ((id_,) if stays else ())


def test_a_constant_load_beside_a_cycle_has_to_be_as_sure_as_when_it_came(tmp_path):
    """The mean of a load that switches is as uncertain as its duty."""
    effects = {"periodic_load": {"power_w": 9000.0}, "auxiliary_power": {"power_w": 650.0}}
    _, problem, _ = opened(tmp_path, seed=12, trips=12, rows_per_trip=160, effects=effects, noise_rms=30.0)
    rows = training(problem, ["periodic_load", "auxiliary_power"])
    state = found_in_turn(rows, problem, ["auxiliary_power"])
    with_it, verdict = add_cycle(rows, state, np.random.default_rng(0))
    assert with_it is not None, verdict
    rows = among_many(rows)
    shows_something(rows, with_it, "auxiliary_power")
    assert backward(rows, with_it).ids == ("periodic_load",)
