"""A truth that the library holds in another form, and ways to have an effect that only look impossible."""

import pytest
from planted import run

LONG = {"ratio": 1.0, "trips": 24, "rows_per_trip": 250, "ar_coefficient": 0.97}
SHAFT = {"ratio": 0.5, "trips": 12, "rows_per_trip": 600, "ar_coefficient": 0.97, "entry": "shaft", "mode": "samples"}


def names(result) -> list[str]:
    return [e["id"] for e in result.summary["effects"]]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("truth", "nearest"),
    [("cold_battery_resistance", "battery_resistance"), ("fading_regen_cutoff", "regen_cutoff")],
)
def test_what_a_truth_in_another_form_leaves_gets_no_name(truth, nearest):
    _, result = run(90101, effects={truth: {}}, **LONG)
    assert names(result) == [nearest]
    said = [c["why_not"] for c in result.summary["candidates"]]
    assert any("in another form" in why for why in said)


@pytest.mark.slow
def test_a_second_cause_is_not_the_first_in_another_form():
    _, result = run(90201, effects={"battery_resistance": {}, "rolling_temperature": {}}, **LONG)
    assert sorted(names(result)) == ["battery_resistance", "rolling_temperature"]


@pytest.mark.slow
def test_a_loss_in_proportion_to_torque_is_named_beside_one_to_its_square():
    """It is the root of the other, and explains as much as any one other form of it does."""
    truth = {"copper_loss": {}, "inverter_loss": {"per_nm_w": 15.0}}
    _, result = run(90401, effects=truth, **{**SHAFT, "ratio": 1.0})
    assert sorted(names(result)) == ["copper_loss", "inverter_loss"]


@pytest.mark.slow
@pytest.mark.parametrize("effect", ["sampling_filter", "torque_offset"])
def test_instruments_of_the_shaft(effect):
    """A filter of half a second is far from the longest, not at an edge; an offset is seen beside an absorbed gain."""
    synthetic, result = run(90301, effects={effect: {}}, **SHAFT)
    assert names(result) == [effect]
    name = {"sampling_filter": "tau_s", "torque_offset": "offset_nm"}[effect]
    told = result.summary["effects"][0]["parameters"][name]
    assert abs(told["value"] - synthetic.vehicle.effects[effect][name]) < 4.0 * told["sd"]
