"""The kernel against `reference.py`, and properties of the chain on made-up logs."""

import dataclasses
from functools import cache
from typing import Any

import equinox as eqx
import jax
import numpy as np
import physics_rows as made
import pytest
import reference
from hypothesis import given, settings
from hypothesis import strategies as st

from hdev_jax.physics import LIBRARY, Vehicle
from hdev_jax.physics.effect import Grouped
from hdev_jax.segments import Segments

CAR = {
    "rotating": 1.05,
    "c_rr": 0.006,
    "cda_m2": 5.6,
    "efficiency": 0.91,
    "auxiliary_w": 700.0,
    "gear_ratios": made.GEARS,
    "final_drive": 4.5,
    "wheel_radius_m": 0.5,
    "motoring": 0.93,
    "regenerating": 0.88,
}
REFERENCED = (
    "grade_lag", "grade_noise", "grade_bias", "mass_scale", "speed_scale", "time_skew", "sampling_filter", "power_gain",
    "headwind", "rolling_temperature", "tyre_warmup", "road_surface", "cornering", "brake_drag",
    "driveline_drag", "gear_efficiency",
    "copper_loss", "iron_loss", "auxiliary_power", "hvac_power", "passenger_heat", "cabin_warmup", "friction_blending",
    "battery_resistance", "regen_limit", "rolling_linear", "grade_scale", "efficiency_scale", "regen_efficiency",
    "part_load",
)  # fmt: skip
SEEDS = st.integers(0, 10_000)
evaluate = eqx.filter_jit(lambda car, log: car.energy(log))  # of 18 rows in all tests: compiled once
pull = eqx.filter_jit(lambda car, log: car.force(log))


def as_rows(log: Segments) -> list[dict]:
    columns = {f.name: getattr(log, f.name) for f in dataclasses.fields(log) if f.name != "channels"} | log.channels
    return [{k: np.asarray(v)[i].item() for k, v in columns.items()} for i in range(len(log))]


def road_log(*lengths: int, **options: Any) -> Segments:
    return made.drives(*lengths, without=("motor_speed_radps", "motor_torque_nm", "traction_force_n"), **options)


def parameters(effect_id: str) -> dict[str, Any]:
    values = {f.name: getattr(made.typical(effect_id), f.name) for f in dataclasses.fields(LIBRARY[effect_id])}
    return {k: v.values.tolist() if isinstance(v, Grouped) else v.item() for k, v in values.items()}


@cache
def everything() -> Vehicle:
    return made.baseline(covers_machine=False).plus(*(made.typical(i) for i in REFERENCED))


@pytest.mark.parametrize(
    ("effect_id", "covers_machine"), [*((i, False) for i in (None, *REFERENCED, "all")), (None, True), ("all", True)]
)
def test_equals_the_loop(effect_id: str | None, covers_machine: bool) -> None:
    ids = REFERENCED if effect_id == "all" else [effect_id] if effect_id else []
    car = made.baseline(covers_machine=covers_machine).plus(*(made.typical(i) for i in ids))
    log = road_log(*made.LENGTHS, seed=11)
    expected = reference.energy_wh(
        as_rows(log), CAR | {"covers_machine": covers_machine}, {i: parameters(i) for i in ids}
    )
    np.testing.assert_allclose(car.energy(log), expected, rtol=1e-11, atol=1e-11)


@settings(max_examples=10)
@given(
    seed=SEEDS,
    dt=st.sampled_from([0.22, 1.0, 8.0]),
    skew=st.floats(-20.0, 20.0),
    lag=st.floats(-20.0, 20.0),
    efficiency=st.floats(0.5, 1.0),
    mass_scale=st.floats(-0.5, 0.5),
)
def test_equals_the_loop_on_random_segments(
    seed: int, dt: float, skew: float, lag: float, efficiency: float, mass_scale: float
) -> None:
    changed = {"time_skew": {"skew_s": skew}, "grade_lag": {"lag_s": lag}, "mass_scale": {"scale": mass_scale}}
    car = eqx.tree_at(lambda c: c.driveline.efficiency, everything(), np.asarray(efficiency))
    effects = {i: parameters(i) | changed.get(i, {}) for i in REFERENCED}
    for i, values in changed.items():
        effect = dataclasses.replace(car.effect(i), **{k: np.asarray(v) for k, v in values.items()})
        car = car.minus(i).plus(effect)
    log = road_log(8, 3, 6, 1, seed=seed, dt=dt)
    sheet = CAR | {"covers_machine": False, "efficiency": efficiency}
    expected = np.array(reference.energy_wh(as_rows(log), sheet, effects))
    # rows far apart in size meet in the filter and in the cubic
    np.testing.assert_allclose(evaluate(car, log), expected, rtol=1e-9, atol=1e-10 * np.max(np.abs(expected)))


# --- properties ----------------------------------------------------------------------------------------------------


@settings(max_examples=8)
@given(seed=SEEDS, share=st.floats(0.0, 1.0), ends=st.tuples(st.floats(0.002, 0.02), st.floats(0.002, 0.02)))
def test_linear_in_c_rr_away_from_the_switch(seed: int, share: float, ends: tuple[float, float]) -> None:
    log = road_log(12, seed=seed)
    at = lambda c: np.asarray(evaluate(made.baseline(c_rr=c), log))  # noqa: E731
    force = lambda c: np.asarray(pull(made.baseline(c_rr=c), log))  # noqa: E731
    same_side = force(ends[0]) * force(ends[1]) > 0
    mixed = at((1 - share) * ends[0] + share * ends[1])
    expected = (1 - share) * at(ends[0]) + share * at(ends[1])
    np.testing.assert_allclose(mixed[same_side], expected[same_side], rtol=1e-9, atol=1e-9)
    assert np.sum(same_side) > 5


@settings(max_examples=5)
@given(seed=SEEDS)
def test_additive_over_trips(seed: int) -> None:
    """A trip has the same energies before one trip and after another: nothing leaks from one into the other."""
    car, one, two, three = everything(), *(road_log(9, seed=seed + k) for k in range(3))
    before, after = (np.asarray(evaluate(car, made.join(*logs))) for logs in ((one, two), (three, one)))
    np.testing.assert_allclose(before[:9], after[9:], rtol=1e-11, atol=1e-11)


@settings(max_examples=6)
@given(seed=SEEDS, order=st.permutations(range(3)))
def test_permuting_trips_permutes_energies(seed: int, order: list[int]) -> None:
    """Whole trips in another order, with the ids they had or with new ones."""
    car, log = everything(), road_log(6, 6, 6, seed=seed)
    index = np.concatenate([np.arange(6 * k, 6 * k + 6) for k in order])
    moved = log.take(index)
    expected = np.asarray(evaluate(car, log))[index]
    np.testing.assert_allclose(evaluate(car, moved), expected, rtol=1e-11, atol=1e-11)
    renamed = eqx.tree_at(lambda s: s.trip, moved, np.repeat(np.arange(3), 6))
    np.testing.assert_allclose(evaluate(car, renamed), expected, rtol=1e-11, atol=1e-11)


@settings(max_examples=5)
@given(seed=SEEDS, fill=st.floats(-1e3, 1e3))
def test_padding_changes_no_other_row(seed: int, fill: float) -> None:
    """Rows past the log, in a trip of their own, with anything in their channels."""
    car, log = everything(), road_log(6, 3, seed=seed)
    padded = jax.tree.map(lambda x: np.r_[x, np.repeat(x[-1:], 9)], log)
    padded = padded.with_channels(**{k: np.r_[v[:9], np.full(9, fill)] for k, v in padded.channels.items()})
    padded = eqx.tree_at(
        lambda s: (s.trip, s.distance_m), padded, (np.r_[log.trip, np.full(9, 2)], np.r_[log.distance_m, np.zeros(9)])
    )
    followed = evaluate(car, made.join(log, road_log(9, seed=seed + 1)))
    np.testing.assert_allclose(evaluate(car, padded)[:9], followed[:9], rtol=1e-11, atol=1e-11)
