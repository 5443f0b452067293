"""Sizes whose thresholds few trips tell: what is said of them has room for every threshold that the log allows."""

import numpy as np
import pytest
from planted import run

from hdev_jax.diagnosis.candidates import Candidate
from hdev_jax.diagnosis.shapes import Open, shapes_of
from hdev_jax.physics import LIBRARY


def parameters(result):
    return next(e for e in result.summary["effects"] if e["id"] == "hvac_power")["parameters"]


def test_what_is_open_adds_to_a_size_at_held_shapes_and_stands_by_itself_for_shapes():
    np.testing.assert_allclose(Open(3.0).error(4.0), 5.0)
    np.testing.assert_allclose(Open(5.0, 12.0).error(None), 13.0)
    assert Open(0.0).error(2.0) == 2.0


def test_a_limit_anywhere_between_two_temperatures_leaves_the_slope_open():
    """Three cold trips near 4 °C, no other below 20: 2290 W/K below 14 °C and 1200 below 23 cost about the same."""
    synthetic, result = run(4186, effects={"hvac_power": {}}, ratio=4.0, trips=6, ar_coefficient=0.97)
    told, planted = parameters(result), synthetic.vehicle.effects["hvac_power"]
    for name in ("below_w_per_k", "heat_c", "cool_c"):
        assert abs(told[name]["value"] - planted[name]) < 2.0 * told[name]["sd"], name
    assert told["heat_c"]["sd"] > 2.0
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
