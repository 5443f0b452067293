"""Sizes whose thresholds few trips tell: what is said of them has room for every threshold that the log allows."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from planted import SHORT, FadingStart, declared, found_in_turn, opened, training
from scipy import stats

from hdev_jax.diagnosis.candidates.candidate import Candidate, finer
from hdev_jax.diagnosis.candidates.plan import columns
from hdev_jax.diagnosis.competition.compete import compete
from hdev_jax.diagnosis.competition.refit import as_reported
from hdev_jax.diagnosis.diagnose import training_of
from hdev_jax.diagnosis.result.intervals import Open, _wide, left_open, other_size, shapes_of
from hdev_jax.diagnosis.result.summary import _opened, _sized, parameters_of
from hdev_jax.inference import jacobian
from hdev_jax.physics import LIBRARY


def test_what_is_open_adds_to_a_size_at_held_shapes_and_stands_by_itself_for_shapes():
    spread = Open(np.array([-3.0, 3.0]), np.array([0.5, 0.5]), 4.0)
    np.testing.assert_allclose([spread.error(), spread.error(0.0)], [5.0, 3.0])
    assert Open(np.zeros(1), np.ones(1), 2.0).error() == 2.0


def test_an_interval_of_one_set_of_shapes_is_students():
    low, high = Open(np.zeros(1), np.ones(1), 2.0).interval(0.9, 7)
    np.testing.assert_allclose([low, high], [2 * stats.t.ppf(0.05, 7), 2 * stats.t.ppf(0.95, 7)], rtol=1e-9)


def test_a_size_without_an_error_is_where_it_is_at_any_scale():
    np.testing.assert_allclose(Open(np.array([1e-3]), np.ones(1), 0.0).interval(0.9, 7), 1e-3, rtol=1e-6)
    assert Open(np.zeros(1), np.ones(1), np.inf).interval(0.9, 7) == (-np.inf, np.inf)
    large = np.array(Open(np.array([-3.0, 5.0]), np.array([0.4, 0.6]), 2.0).interval(0.9, 7))
    small = Open(np.array([-3e-9, 5e-9]), np.array([0.4, 0.6]), 2e-9).interval(0.9, 7)
    np.testing.assert_allclose(small, 1e-9 * large, rtol=1e-6)


@settings(max_examples=40)
@given(
    st.lists(st.floats(-50.0, 50.0), min_size=1, max_size=6), st.floats(0.1, 20.0), st.integers(1, 40),
    st.integers(0, 2**31),
)  # fmt: skip
def test_an_interval_of_mixed_shapes_holds_what_draws_of_them_do(away, inside, freedom, seed):
    rng = np.random.default_rng(seed)
    share = rng.dirichlet(np.ones(len(away)))
    low, high = Open(np.array(away), share, inside).interval(0.9, freedom)
    drawn = rng.choice(away, 20_000, p=share) + inside * rng.standard_t(freedom, 20_000)
    assert np.mean(drawn < low) == pytest.approx(0.05, abs=0.012)
    assert np.mean(drawn > high) == pytest.approx(0.05, abs=0.012)


def test_a_time_constant_without_bounds_stays_positive():
    c = Candidate(FadingStart, ("power_w",), (None,), (("tau_s", 20.0),), "size", (0,))
    for grid in (finer(c, 10.0, reach=1.0)["tau_s"], _wide(c, "tau_s", 25.0, 10.0)):
        assert min(grid) > 0.0
        assert min(grid) < 20.0
    assert max(_wide(c, "tau_s", 25.0, 10.0)) > 400.0


@pytest.mark.parametrize(
    ("effect", "sizes", "groups", "shapes", "kind", "expected"),
    [
        ("headwind", ("scale",), (None,), (), "size", []),
        ("regen_cutoff", ("speed_mps",), (None,), (("speed_mps", 6.0),), "limit", []),
        ("road_surface", ("excess",), (1,), (), "size", []),
        ("periodic_load", ("power_w",), (None,), (("period_s", 300.0), ("phase[0]", 0.2)), "size", []),
        ("cabin_warmup", ("power_w",), (None,), (("tau_s", 900.0),), "size", ["tau_s"]),
    ],
)
def test_shapes_that_lie_on_a_grid_beside_sizes(effect, sizes, groups, shapes, kind, expected):
    c = Candidate(LIBRARY[effect], sizes, groups, shapes, kind, tuple(range(len(sizes))))
    assert shapes_of(c) == expected


@pytest.mark.parametrize(
    ("effect", "sizes", "groups", "kind", "expected"),
    [
        ("iron_loss", ("w_per_radps",), (None,), "size", "w_per_radps2"),
        ("iron_loss", ("w_per_radps", "w_per_radps2"), (None, None), "size", None),
        ("wet_road", ("spray",), (None,), "size", "excess"),
        ("sampling_filter", ("tau_s",), (None,), "size", None),
        ("mode_change", ("loss",), (None,), "size", None),
        ("headwind", ("scale",), (None,), "size", None),
        ("hvac_power", ("below_w_per_k",), (None,), "size", None),
        ("wet_road", ("spray",), (None,), "limit", None),
    ],
)
def test_the_other_size_that_an_effect_may_have(effect, sizes, groups, kind, expected):
    c = Candidate(LIBRARY[effect], sizes, groups, (), kind, tuple(range(len(sizes))))
    assert other_size(c) == expected


def test_what_is_left_open_never_narrows_what_a_fit_says():
    told = {"value": 5.0, "sd": 0.34, "interval_90": [4.44, 5.56]}
    p = LIBRARY["iron_loss"].parameters[0]
    one_sided = Open(np.array([-2.0, -1.0]), np.array([0.5, 0.5]), 0.3)
    low, high = _opened(told, p, one_sided, 0.3, 9)["interval_90"]
    assert low < 3.5
    assert high == 5.56


@pytest.mark.parametrize("clusters", [4, 24])
def test_an_interval_covers_what_it_says(clusters):
    rng = np.random.default_rng(clusters)
    hits = 0
    for _ in range(2000):
        x = rng.normal(size=clusters)
        low, high = _sized(float(np.mean(x)), float(np.std(x, ddof=1) / np.sqrt(clusters)), clusters)["interval_90"]
        hits += low <= 0.0 <= high
    assert hits / 2000 == pytest.approx(0.90, abs=0.02)


def test_what_a_time_constant_leaves_open_is_what_refits_at_others_come_to(tmp_path):
    """Trips much shorter than the time constant: at another one the size is that of least squares with that column,
    the declared coefficients beside it. Noise is white, so rows of equal weight say the same as whitened ones."""
    options = {"noise": "white", "noise_level": 0.02, "effects": {"cabin_warmup": {}}}
    _, problem, _ = opened(tmp_path, seed=52, trips=8, rows_per_trip=100, ratio=0.7, **options)
    rows = training(problem, ["cabin_warmup"])
    state = found_in_turn(rows, problem, ["cabin_warmup"])
    told = left_open(rows, state, state.found[0].score, state.fit)
    assert set(told) == {"power_w", "tau_s"}
    assert np.sum(told["tau_s"].share) == pytest.approx(1.0)
    assert len(told["tau_s"].share) > 2, "the log leaves some open"
    base = declared(rows, problem).fit
    here = float(state.fit.vehicle.effect("cabin_warmup").tau_s)
    grid = here + told["tau_s"].away
    effects = [LIBRARY["cabin_warmup"]]
    found, made, _ = columns(base.vehicle, effects, rows.rows.segments, rows.rows.rows, problem.target,
                             {"tau_s": tuple(float(x) for x in grid)})  # fmt: skip
    slopes = np.asarray(jacobian(base.vehicle, base.table, rows.rows.segments, problem.target))[: rows.rows.rows]
    size = {}
    for c in found:
        x = np.c_[slopes, made[:, c.columns[0]]]
        size[dict(c.shapes)["tau_s"]] = np.linalg.lstsq(x, rows.residual(base), rcond=None)[0][-1]
    expected = np.array([size[float(x)] for x in grid])
    spread = told["power_w"].away - told["power_w"].away[0]
    np.testing.assert_allclose(spread, expected - expected[0], atol=0.1 * np.ptp(expected) + 0.01 * np.mean(expected))


def test_a_limit_anywhere_between_two_temperatures_leaves_the_slope_open(tmp_path):
    """Six trips, most of them cold: the slope and the limit of heating trade against each other."""
    made = SHORT | {"effects": {"hvac_power": {}}, "ratio": 4.0, "trips": 6, "seed": 4186}
    synthetic, problem, split = opened(tmp_path, **made)
    rows, _ = training_of(problem, split, {"hvac_power": LIBRARY["hvac_power"]})
    state = compete(rows, problem.vehicle, problem.table, seed=0)
    (f,), planted = state.found, synthetic.vehicle.effects["hvac_power"]
    known = as_reported(rows, state)
    told = parameters_of(f, known, left_open(rows, state, f.score, known), rows.clusters.count)
    sheet = parameters_of(f, known, {}, rows.clusters.count)  # numbers that belong together
    assert {"heat_c", "cool_c"} <= set(told)
    for name, p in told.items():
        low, high = p["interval_90"]
        assert low < planted[name] < high, name
        assert sheet[name]["sd"] <= p["sd"], name
