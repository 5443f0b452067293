"""Sizes whose thresholds few trips tell: what is said of them has room for every threshold that the log allows."""

from types import SimpleNamespace
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
import pytest
from bare import bare
from hypothesis import given
from hypothesis import strategies as st
from planted import run
from scipy import stats

from hdev_jax.diagnosis.candidates.candidate import Candidate, finer
from hdev_jax.diagnosis.diagnose import diagnose
from hdev_jax.diagnosis.result import shapes
from hdev_jax.diagnosis.result.shapes import Open, _wide, other_size, shapes_of
from hdev_jax.diagnosis.result.summary import _opened
from hdev_jax.diagnosis.scores.evidence import Score
from hdev_jax.diagnosis.scores.look import Loop, Search
from hdev_jax.fleet import synthetic_log
from hdev_jax.inference import Calibration
from hdev_jax.inference.sheet import read_sheet
from hdev_jax.logs import read_log
from hdev_jax.physics import LIBRARY, Effect, Parameter
from hdev_jax.problem import prepare, split_trips


def parameters(result):
    return next(e for e in result.summary["effects"] if e["id"] == "hvac_power")["parameters"]


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


def test_a_limit_anywhere_between_two_temperatures_leaves_the_slope_open():
    """Three cold trips near 4 °C, no other below 20: 2290 W/K below 14 °C and 1200 below 23 cost about the same."""
    synthetic, result = run(4186, effects={"hvac_power": {}}, ratio=4.0, trips=6, ar_coefficient=0.97)
    told, planted = parameters(result), synthetic.vehicle.effects["hvac_power"]
    for name in ("below_w_per_k", "heat_c", "cool_c"):
        assert abs(told[name]["value"] - planted[name]) < 2.0 * told[name]["sd"], name
    assert told["heat_c"]["sd"] > 2.0
    assert told["below_w_per_k"]["interval_90"][0] > 0.0
    sheet = result.found["hvac_power"]  # numbers that belong together: the limits as they are, slopes beside them
    assert sheet["heat_c"][1] == sheet["cool_c"][1] == 0.0
    assert 0.0 < sheet["below_w_per_k"][1] < 0.3 * told["below_w_per_k"]["sd"]
    assert told["below_w_per_k"]["sd"] > 0.2 * told["below_w_per_k"]["value"]
    low, high = told["below_w_per_k"]["interval_90"]
    assert low < planted["below_w_per_k"] < high


@pytest.mark.slow
def test_trips_at_all_temperatures_leave_little_open():
    synthetic, result = run(4175, effects={"hvac_power": {}}, ratio=4.0, trips=48, ar_coefficient=0.97)
    told, planted = parameters(result), synthetic.vehicle.effects["hvac_power"]
    for name in ("below_w_per_k", "above_w_per_k"):
        assert told[name]["sd"] < 0.1 * told[name]["value"]
        assert abs(told[name]["value"] - planted[name]) < 4.0 * told[name]["sd"], name


class Unbounded(Effect):
    """A user's own, without bounds: a time constant below 0 would make a column that no number holds."""

    id: ClassVar = "fading_start"
    stage: ClassVar = "battery"
    equation: ClassVar = "P·exp(−t/τ)"
    parameters: ClassVar = (
        Parameter("power_w", "W", 0.0, 1e4),
        Parameter("tau_s", "s", 100.0, 100.0, kind="shape", grid=(20.0, 100.0, 400.0)),
    )
    power_w: Any
    tau_s: Any

    def power(self, row, car, point):
        """Power [W]."""
        return self.power_w * jnp.exp(-row.time_s / self.tau_s)


def test_a_time_constant_without_bounds_stays_positive():
    c = Candidate(Unbounded, ("power_w",), (None,), (("tau_s", 20.0),), "size", (0,))
    for grid in (finer(c, 10.0, reach=1.0)["tau_s"], _wide(c, "tau_s", 25.0, 10.0)):
        assert min(grid) > 0.0
        assert min(grid) < 20.0
    assert max(_wide(c, "tau_s", 25.0, 10.0)) > 400.0


@pytest.mark.slow
def test_a_users_effect_without_bounds_goes_through_the_loop(tmp_path):
    made = synthetic_log(seed=3, trips=10, rows_per_trip=120, ar_coefficient=0.97)
    frame = made.frame
    fading = np.exp(-frame["time_s"] / 100.0) * frame["duration_s"] / 3600.0
    frame["energy_wh"] += 6e4 * fading
    files = made.write(tmp_path, truth=False)
    log = read_log([files["log"]])
    result = diagnose(prepare(log, read_sheet(files["sheet"])), split_trips(log), {**LIBRARY, Unbounded.id: Unbounded})
    told = next(e for e in result.summary["effects"] if e["id"] == Unbounded.id)["parameters"]
    assert abs(told["power_w"]["value"] / 6e4 - 1.0) < 0.15
    low, high = told["tau_s"]["interval_90"]
    assert 0.0 < low < 100.0 < high


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


def _open(monkeypatch, *, other: float, error: float, traded: float, told: bool = True, nothing_left: bool = False):
    """What 5 ± 0.3 W·s/rad leave open, where rows say that the loss by the square is `other` ± `error`."""
    ways = [Candidate(LIBRARY["iron_loss"], v, (None,) * len(v), (), "size", (0, 1)[: len(v)]) for v in
            (("w_per_radps",), ("w_per_radps", "w_per_radps2"))]  # fmt: skip
    answers = {1: (np.array([5.0]), np.array([0.3])), 2: (np.array([4.0, other]), np.array([1.0, error]))}
    evidence = SimpleNamespace(
        count=9, left=lambda _: 0.0 if nothing_left else 1.0, traded=lambda own, column: np.array([traded]),
        estimate=lambda k: answers[len(k.columns)],
    )  # fmt: skip
    looks = (evidence, None) if told else (None, evidence)
    monkeypatch.setattr(shapes, "_apart", lambda *_: (SimpleNamespace(candidates=ways), *looks))
    row = SimpleNamespace(path="effects.iron_loss.w_per_radps", told=(5.0, 0.3) if told else None)
    reported = bare(Calibration, table=SimpleNamespace(free=[row]))
    s = Score(ways[0], np.array([5.0]), 9.0, 0.0, 0.0, 9.0, 1.0)
    return shapes._other_open(bare(Loop), bare(Search), s, "w_per_radps2", reported)


@pytest.mark.parametrize("told", [False, True])
def test_room_for_another_size_is_as_wide_as_rows_leave_it(told, monkeypatch):
    """Plausible values of the other, and those with which the own one stays plausible."""
    wide = _open(monkeypatch, other=0.01, error=0.002, traded=-100.0, told=told)["w_per_radps"]
    mean, sd = np.sum(wide.share * wide.away), np.sqrt(np.cov(wide.away, aweights=wide.share, ddof=0))
    assert mean == pytest.approx(-1.0, abs=0.01)
    assert sd == pytest.approx(0.2 * np.sqrt(8 / 6), rel=0.1)  # Student's t of eight degrees, cut off at four errors
    assert wide.inside == 0.3
    at_bound = _open(monkeypatch, other=0.0, error=0.002, traded=-100.0, told=told)["w_per_radps"]
    assert np.all(at_bound.away <= 0.0)  # no loss is negative
    free = _open(monkeypatch, other=0.0, error=10.0, traded=-100.0, told=told)["w_per_radps"]
    assert np.all(free.away >= -5.0)  # nor is this one


def test_no_room_where_nothing_is_known_of_the_other_size(monkeypatch):
    assert _open(monkeypatch, other=0.01, error=0.002, traded=-100.0, nothing_left=True) == {}
    assert _open(monkeypatch, other=np.nan, error=0.002, traded=-100.0) == {}
    assert _open(monkeypatch, other=0.0, error=0.0, traded=-100.0) == {}


def test_what_is_left_open_never_narrows_what_a_fit_says():
    told = {"value": 5.0, "sd": 0.34, "interval_90": [4.44, 5.56]}
    p = LIBRARY["iron_loss"].parameters[0]
    one_sided = Open(np.array([-2.0, -1.0]), np.array([0.5, 0.5]), 0.3)
    low, high = _opened(told, p, one_sided, 0.3, 9)["interval_90"]
    assert low < 3.5
    assert high == 5.56


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 4])
def test_a_size_found_alone_leaves_room_for_the_one_beside_it(seed):
    """Losses that grow with the speed and with its square look alike in twelve trips; one alone is found."""
    shaft = {"entry": "shaft", "mode": "samples", "rows_per_trip": 600}
    synthetic, result = run(
        seed, effects={"iron_loss": {}}, ratio=0.5, trips=12, ar_coefficient=0.97, **shaft
    )  # fmt: skip
    found = next(e for e in result.summary["effects"] if e["id"] == "iron_loss")["parameters"]
    assert len(found) == 1
    ((name, told),) = found.items()
    low, high = told["interval_90"]
    assert 0.0 <= low <= synthetic.vehicle.effects["iron_loss"][name] <= high
    assert high - low > 0.2 * told["value"]
