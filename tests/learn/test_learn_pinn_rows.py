"""Rows of a physics-informed network: the sheet's physics by row, features without units, coefficients that hold."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from learn_trucks import FEATURES as SOME
from learn_trucks import TABLE, energy_by_hand, road, truck, truck_rows

from hdev_jax.errors import InputError
from hdev_jax.fleet import simulate
from hdev_jax.learn.pinn import rows as pinn_rows
from hdev_jax.learn.pinn.rows import (
    FEATURES,
    PHYSICAL,
    concatenated,
    energy,
    row_wise,
    rows_of,
    wheel_energy,
)
from hdev_jax.physics import LIBRARY, Grouped, at_null, coefficients_that_hold
from hdev_jax.physics.across import DISTANCE_SINCE_START
from hdev_jax.physics.tyres import RoadSurface

# Without errors of the instruments and of the payload the log is what was driven.
EXACT = {
    "truth": {"payload_bias": 0.0, "payload_sd": 0.0},
    "log": {"energy_noise_wh": 0.0, "energy_noise_share": 0.0, "speed_noise_mps": 0.0, "grade_noise_rad": 0.0,
            "clock_skew_s": 0.0, "dropout_share": 0.0},
}  # fmt: skip


@pytest.fixture(scope="module")
def fleet():
    """Two variants, of twelve gears and of one, of different numbers of rows."""
    return simulate({"seed": 3, "routes": 5, "segments_per_route": 30, "variants": ["A", "bus_12m_1speed"], **EXACT})


@pytest.fixture(scope="module")
def of_fleet(fleet):
    return [rows_of(v.tabular, v.segments, v.energy_wh, number=k) for k, v in enumerate(fleet.vehicles)]


said, at_wheel = eqx.filter_jit(energy), eqx.filter_jit(wheel_energy)


def held_by(rows):
    return eqx.filter_jit(jax.vmap(coefficients_that_hold))(rows.car, jax.tree.map(jnp.asarray, rows.segments))


def close(found, expected, share=1e-5):
    np.testing.assert_allclose(found, expected, rtol=share, atol=share * np.abs(expected).max())


def test_rows_hold_the_sheets_prediction_to_rounding(fleet, of_fleet):
    together = concatenated(of_fleet)
    assert {x.dtype for x in jax.tree.leaves(together)} == {np.dtype("float32"), np.dtype("int32")}
    column = lambda name: np.concatenate([v.truth[name] for v in fleet.vehicles])  # noqa: E731
    close(said(together.car, together.segments), column("tabular_wh"))
    close(at_wheel(together.car, together.segments), column("tabular_wheel_wh"))
    moving = np.asarray(together.segments.distance_m) > 0
    assert np.ptp(together.car.driveline.efficiency[moving]) > 0.01  # it is that of the map, row by row
    np.testing.assert_array_equal(together.energy_wh, np.float32(column("energy_shown_wh")))


def test_concatenated_keeps_the_order_and_the_channels_that_all_have(fleet, of_fleet):
    first, second = of_fleet
    less = eqx.tree_at(lambda r: r.segments, second, second.segments.without("wet_road"))
    both = concatenated([first, less])
    assert len(both) == len(first) + len(second) == len(fleet)
    assert not both.segments.has("wet_road")
    assert set(both.segments.channels) == set(first.segments.channels) - {"wet_road"}
    np.testing.assert_array_equal(both.vehicle, np.repeat([0, 1], [len(first), len(second)]))
    for part, at in ((first, slice(0, len(first))), (second, slice(len(first), None))):
        np.testing.assert_array_equal(both.features[at], part.features)
        np.testing.assert_array_equal(both.energy_wh[at], part.energy_wh)
        np.testing.assert_array_equal(both.c_rr[at], part.c_rr)
        np.testing.assert_array_equal(both.segments.time_s[at], part.segments.time_s)
    some = both.take(np.array([len(first), 0]))
    np.testing.assert_array_equal(some.vehicle, [1, 0])
    np.testing.assert_array_equal(some.cda_m2, [second.cda_m2[0], first.cda_m2[0]])


def test_coefficients_that_hold_are_those_of_the_truth(fleet):
    """Of the vehicle that was driven, with all its effects, each row with a vehicle of its own, in float32."""
    v = fleet.vehicles[0]
    assert all(row_wise(e) for e in v.true.effects)
    rows = rows_of(v.true, v.segments, v.energy_wh, number=0, effects=v.true.effects)
    c_rr, cda = held_by(rows)
    s = v.segments
    square = 0.5 * (np.asarray(s.speed_start_mps) ** 2 + np.asarray(s.speed_end_mps) ** 2)
    moving = (np.asarray(s.distance_m) > 0) & (square > 1.0)
    assert np.asarray(s.channels["wet_road"])[moving].max() > 0
    np.testing.assert_allclose(np.asarray(c_rr)[moving], v.truth["c_rr"][moving], rtol=1e-4)
    np.testing.assert_allclose(np.asarray(cda)[moving], v.truth["cda_m2"][moving], rtol=1e-4)
    close(said(rows.car, rows.segments), v.truth["energy_true_wh"], 2e-5)


def test_a_sheet_without_a_map_is_equations_3_to_5():
    s = road()
    rows = truck_rows(s, np.zeros(60))
    close(said(rows.car, rows.segments), energy_by_hand(s))
    close(at_wheel(rows.car, rows.segments), energy_by_hand(s, wheel=True))


def test_a_declared_effect_by_group_holds_in_every_row():
    """As many rows as groups; not as many are those of the fleet above."""
    count = 4
    s = road(56).take(np.arange(20, 20 + count))
    excess = np.array([0.0, 0.1, 0.2, 0.4])
    car = truck().plus(RoadSurface(Grouped(jnp.asarray(excess), "road_surface")))
    rows = rows_of(car, s, np.zeros(count), number=0, features=SOME)
    c_rr = TABLE["c_rr"] * (1 + excess[np.asarray(s.channels["road_surface"]).astype(int)])
    close(said(rows.car, rows.segments), energy_by_hand(s, {**TABLE, "c_rr": c_rr}))
    moving = np.asarray(s.distance_m) > 0
    np.testing.assert_allclose(held_by(rows)[0], np.where(moving, c_rr, TABLE["c_rr"]), rtol=1e-5)


@settings(max_examples=10)
@given(st.floats(0.2, 5.0), st.integers(0, 100))
def test_features_without_units_do_not_change_with_the_size_of_the_world(length, seed):
    """Lengths by L, times by √L and masses by L³ leave gravity and the density of air as they are (Froude's scaling).
    Of the reference lengths the warmth's is fixed."""
    s = road(24, 2, seed)
    time, mass = np.sqrt(length), length**3
    large = dataclasses.replace(
        s, time_s=time * s.time_s, duration_s=time * s.duration_s, distance_m=length * s.distance_m,
        speed_start_mps=length / time * s.speed_start_mps, speed_end_mps=length / time * s.speed_end_mps,
        channels={**s.channels, "mass_kg": mass * s.channels["mass_kg"],
                  "wind_speed_mps": length / time * s.channels["wind_speed_mps"],
                  "curvature_1pm": s.channels["curvature_1pm"] / length},
    )  # fmt: skip
    table = {**TABLE, "cda_m2": TABLE["cda_m2"] * length**2,
             "auxiliary_w": TABLE["auxiliary_w"] * mass * length**2 / time**3}  # fmt: skip
    car = eqx.tree_at(lambda c: c.mass_kg, truck(table, 0.5 * length), jnp.asarray(30e3 * mass))
    names = tuple(n for n in FEATURES["unitless"] if n != "warmth")
    one = rows_of(truck(), s, np.zeros(24), number=0, features=names).features
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pinn_rows, "_REFERENCE_M", 100.0 * length)
        other = rows_of(car, large, np.zeros(24), number=0, features=names).features
    np.testing.assert_allclose(other, one, rtol=2e-5, atol=1e-6)
    assert np.ptp(one[:, names.index("specific_energy")]) > 1e-3


def test_features_are_what_their_names_say():
    s = road().with_channels(gear=np.arange(60) % 3 + 1.0)
    names = tuple(dict.fromkeys(n for f in FEATURES.values() for n in f))
    x = dict(zip(names, rows_of(truck(), s, np.zeros(60), number=0, features=names).features.T, strict=True))
    g, mass, theta = 9.80665, s.channels["mass_kg"], s.channels["grade_rad"]
    square = 0.5 * (s.speed_start_mps**2 + s.speed_end_mps**2)
    trip, distance = np.asarray(s.trip), np.asarray(s.distance_m)
    gone = np.concatenate([np.cumsum(distance[trip == k]) for k in range(3)]) - 0.5 * distance  # to the row's middle
    delta = s.channels["wind_from_rad"] - s.channels["heading_rad"]
    expected = {
        "speed_mps": s.speed_mps, "mass_kg": mass, "grade_rad": theta, "accel_mps2": s.accel_mps2,
        "c_rr_table": np.full(60, 0.006), "cda_table": np.full(60, 6.0), "slope": np.sin(theta),
        "drag_over_weight": 0.5 * 1.225 * 6.0 * square / (mass * g), "mass_of_sheet": mass / 30e3,
        "specific_energy": 3600 * energy_by_hand(s) / (mass * g * 100), "efficiency": np.full(60, 0.85),
        "halt": distance == 0, "surface_2": s.channels["road_surface"] == 2, "warmth": np.exp(-gone / 6000),
        "wind_across": (s.channels["wind_speed_mps"] * np.sin(delta)) ** 2 / (g * 100),
        "duration_s": s.duration_s, "distance_m": distance, "ambient_temp_c": s.channels["ambient_temp_c"],
        "mass_table_kg": np.full(60, 30e3), "auxiliary_table_w": np.full(60, 2000.0), "wind_cosine": np.cos(delta),
        DISTANCE_SINCE_START: gone, "gear": s.channels["gear"], "time_s": s.time_s,
    }  # fmt: skip
    for name, column in expected.items():
        np.testing.assert_allclose(x[name], column, rtol=2e-5, atol=1e-6, err_msg=name)
    assert set(PHYSICAL) <= set(FEATURES["unitless"])


def test_what_a_black_box_without_a_kernel_is_given_does_not_depend_on_the_kernels_energy():
    s = road().with_channels(gear=np.ones(60))
    calibrated = truck({**TABLE, "c_rr": 0.012, "cda_m2": 9.0, "auxiliary_w": 9e3})

    def features(name, of):
        return rows_of(truck(), s, np.zeros(60), number=0, features=FEATURES[name], calibrated=of).features

    np.testing.assert_array_equal(features("raw", None), features("raw", calibrated))
    assert np.abs(features("unitless", None) - features("unitless", calibrated)).max() > 0.01


def test_bad_input_is_one_line():
    s, y = road(), np.zeros(60)

    def says(words, car=None, log=s, **more):
        with pytest.raises(InputError, match=words) as e:
            rows_of(car or truck(), log, y, number=0, **{"features": SOME, **more})
        assert "\n" not in str(e.value)

    for name in ("sped_mps", "surface_x", "surface_9", "surface_"):
        says(f"no feature '{name}'; they are speed_mps, ", features=(name,))
    says("temperature.*ambient_temp_c", log=s.without("ambient_temp_c"))
    says("rolling and aero", car=truck().minus("aero"))
    skew = at_null(LIBRARY["time_skew"])
    says("time_skew acts across rows", car=truck().plus(skew))
    says("time_skew acts across rows", effects=(skew,))
