"""What the study of planted effects compares with: a fit that knows the cause, what nobody could tell, rivals."""

import numpy as np
import pytest
from planted import library_of, opened

from experiments.planted import rivals
from experiments.planted.oracle import confusable, noise_rmse, oracle_rmse
from experiments.planted.study import acts_in
from hdev_jax.inference import calibrate, cluster_rows, padded

# A part of the library: with few effects it compiles in a fraction of the time.
pytestmark = pytest.mark.slow
ROAD = (
    "air_density", "auxiliary_power", "constant_headwind", "cornering", "crosswind", "grade_bias", "headwind",
    "hvac_power", "mass_scale", "mode_change", "periodic_load", "power_gain", "rolling_speed",
)  # fmt: skip


@pytest.mark.parametrize(
    "effect", ["friction_blending", "voltage_dependence", "step_change", "mode_change", "periodic_load"]
)
def test_the_oracle_has_the_true_shapes(effect, tmp_path):
    """Without noise it meets the training trips, and the test trips where nothing about them has to be guessed."""
    options = {"trip": 2} if effect == "step_change" else {}
    parameters = {"auxiliary_w": 5000.0, **options} if options else {}
    synthetic, problem, split = opened(tmp_path, seed=3, effects={effect: parameters}, noise_level=1e-6)
    size = np.sqrt(np.mean(synthetic.truth[f"effect:{effect}"].to_numpy()[problem.rows(split.test)] ** 2))
    error = oracle_rmse(synthetic, problem, split)
    assert error < (0.9 if effect in ("mode_change", "periodic_load") else 0.01) * size


def test_the_oracle_of_slow_noise_is_better_than_rows_of_equal_weight(tmp_path):
    ratios = []
    for seed in range(3):
        synthetic, problem, split = opened(tmp_path / str(seed), seed=seed, effects={"hvac_power": {}}, noise_level=0.1)
        train, test = problem.rows(split.train), problem.rows(split.test)
        real = problem.segments.take(train)
        rows = padded(real, problem.measured[train])
        plain = calibrate(problem.vehicle, problem.table, rows, problem.target, cluster_rows(real))
        before = np.sqrt(np.mean((problem.measured - problem.predict(plain.vehicle))[test] ** 2))
        oracle, noise = oracle_rmse(synthetic, problem, split), noise_rmse(synthetic, problem, split)
        assert oracle < before
        ratios.append(oracle / noise)
    assert np.mean(ratios) < 1.05


def test_what_one_column_cannot_tell_apart_is_one_class(tmp_path):
    effects = {"mass_scale": {"scale": 0.05}}
    synthetic, problem, split = opened(tmp_path, seed=2, effects=effects, noise="white", noise_level=0.02)
    with library_of(ROAD):
        assert "power_gain" in confusable(["mass_scale"], synthetic, problem, split)["mass_scale"]


def test_trips_that_hold_an_effect_are_counted(tmp_path):
    """An effect that no training trip meets acts in none."""
    synthetic, problem, split = opened(tmp_path, seed=2, effects={"headwind": {}}, noise_level=0.02)
    assert acts_in(synthetic, problem, split, "headwind") >= 2
    for trips, expected in (((), 0), (split.train[:1], 1), (split.train[:3], 3)):
        synthetic.truth["effect:headwind"] = 1.0 * np.isin(problem.log.trip, [*trips, *split.test])
        assert acts_in(synthetic, problem, split, "headwind") == expected


def test_what_nobody_could_tell_apart_depends_on_how_loud_the_noise_is(tmp_path):
    some = []
    for level in (0.02, 5.0):
        effects = {"crosswind": {}}
        opening = {"seed": 2, "effects": effects, "noise": "white", "noise_level": level}
        synthetic, problem, split = opened(tmp_path / str(level), **opening)
        with library_of(ROAD):
            some.append(confusable(["crosswind"], synthetic, problem, split)["crosswind"])
    assert not some[0]
    assert some[1]


def test_rivals_are_given_every_size_and_nothing_that_is_absorbed(tmp_path, monkeypatch):
    seen = []

    def all_of_them(x, y, trip):
        seen.append(x)
        return np.arange(x.shape[1])

    monkeypatch.setitem(rivals.SELECTORS, "forward_bic", all_of_them)
    effects = {"hvac_power": {"below_w_per_k": 900.0, "above_w_per_k": 900.0}}
    _, problem, split = opened(tmp_path, seed=2, effects=effects, noise="white", noise_level=0.02)
    with library_of(ROAD):
        named = rivals.run_rivals(["forward_bic"], problem, split)["forward_bic"]["named"]
    assert {"hvac_power", "headwind", "auxiliary_power", "power_gain"} <= set(named)
    assert not {"grade_bias", "periodic_load", "mode_change"} & set(named)
    assert seen[0].shape[1] > len(named), "heating and cooling are two columns of one effect"
