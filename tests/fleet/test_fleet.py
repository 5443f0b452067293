"""The synthetic truck: its own physics by identities and against a plain loop, its sizes, its noise, its channels."""

import ast
import importlib.util
import io
import tomllib
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from hdev_jax.fleet import (
    NOISES,
    PLANTABLE,
    Drive,
    SyntheticLog,
    Truth,
    demo_log,
    plantable,
    power_w,
    size_effect,
    synthetic_log,
)

WAYS = [(entry, mode) for entry in ("road", "shaft", "wheel") for mode in ("segments", "samples")]
# each effect in one of the ways that can carry it, in turn, and two of them in every way
_ABLE = {effect: [way for way in WAYS if effect in plantable(*way)] for way in WAYS for effect in plantable(*way)}
_ONE = [(*ways[k % len(ways)], effect) for k, (effect, ways) in enumerate(sorted(_ABLE.items()))]
CASES = sorted({*_ONE, *((*way, effect) for way in WAYS for effect in ("auxiliary_power", "regen_limit"))})
SMALL = {"seed": 16, "trips": 6, "rows_per_trip": 120}


def hand_made(**columns) -> Drive:
    """A drive of rows written by hand: still air, flat, dry and straight unless told otherwise."""
    n = len(columns["duration_s"])
    zeros = ("wind_speed_mps", "wind_from_rad", "heading_rad", "curvature_1pm", "wet_road", "grade_rad", "trip",
             "brake_pressure_pa", "humidity_pct")  # fmt: skip
    c = {k: np.zeros(n) for k in zeros}
    c |= {"mass_kg": np.full(n, 30e3), "gear": np.full(n, 4.0), "voltage_v": np.full(n, 650.0)}
    c |= {"ambient_temp_c": np.full(n, 20.0), "air_density_kgpm3": np.full(n, 1.225)}
    c |= {k: np.asarray(v, dtype=float) for k, v in columns.items()}
    c["trip"] = c["trip"].astype(int)
    c.setdefault("time_s", np.cumsum(c["duration_s"]) - c["duration_s"])
    c["standstill_flag"] = (c["distance_m"] == 0).astype(float)
    return Drive(c, lambda _: c["grade_rad"], "segments", 1.0)


def cruise(n: int = 4, speed: float = 20.0, **columns) -> Drive:
    rows = {"duration_s": [5.0] * n, "distance_m": [5 * speed] * n}
    return hand_made(**rows, speed_start_mps=[speed] * n, speed_end_mps=[speed] * n, **columns)


def energy_wh(drive: Drive, truth: Truth, **kwargs) -> np.ndarray:
    return power_w(drive, truth, **kwargs) * drive.columns["duration_s"] / 3600


FREE = Truth(c_rr=0.0, cda_m2=0.0, efficiency=1.0)


def test_shares_no_code_with_the_physics():
    folder = Path(importlib.util.find_spec("hdev_jax.fleet").submodule_search_locations[0])
    for file in (
        "__init__",
        "driving",
        "log",
        "noise",
        "plants",
        "truth",
    ):  # the planted logs; the simulated fleet is the kernel's
        for node in ast.walk(ast.parse((folder / f"{file}.py").read_text())):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not [n for n in names if n.startswith("jax") or (n.startswith("hdev_jax") and "fleet" not in n)]


def test_accelerating_costs_the_kinetic_energy():
    drive = hand_made(
        duration_s=[10.0, 10.0], distance_m=[50.0, 150.0], speed_start_mps=[0.0, 10.0], speed_end_mps=[10.0, 20.0]
    )
    np.testing.assert_allclose(energy_wh(drive, FREE).sum() * 3600, 0.5 * 30e3 * 20.0**2, rtol=1e-12)


def test_up_and_down_a_hill_costs_only_the_losses():
    drive = cruise(2, grade_rad=[0.03, -0.03])
    np.testing.assert_allclose(energy_wh(drive, FREE).sum(), 0.0, atol=1e-9)
    climb = 30e3 * 9.80665 * 100 * np.sin(0.03) / 3600
    lossy = energy_wh(drive, replace(FREE, efficiency=0.9))
    np.testing.assert_allclose(lossy, [climb / 0.9, -climb * 0.9], rtol=1e-12)


def test_doubling_the_mass_doubles_rolling_and_standing_costs_only_loads():
    rolling = replace(FREE, c_rr=0.006)
    one, two = (energy_wh(cruise(mass_kg=np.full(4, m)), rolling) for m in (2e4, 4e4))
    np.testing.assert_allclose(two, 2 * one, rtol=1e-12)
    still = hand_made(duration_s=[30.0], distance_m=[0.0], speed_start_mps=[0.0], speed_end_mps=[0.0])
    assert energy_wh(still, Truth())[0] == 0.0
    np.testing.assert_allclose(energy_wh(still, replace(Truth(), auxiliary_w=6000.0)), 50.0)


def test_baseline_is_equations_3_to_5_in_a_plain_loop():
    log = synthetic_log(**SMALL)
    v = log.vehicle
    expected = []
    for row in log.frame.itertuples():
        a = (row.speed_end_mps - row.speed_start_mps) / row.duration_s
        e = row.mass_kg * a * row.distance_m
        e += row.mass_kg * 9.80665 * row.distance_m * np.sin(row.grade_rad)
        e += row.mass_kg * 9.80665 * v.c_rr * row.distance_m * np.cos(row.grade_rad)
        e += 0.5 * v.cda_m2 * 1.225 * row.distance_m * (row.speed_start_mps**2 + row.speed_end_mps**2) / 2
        expected.append(e / 3600 / v.efficiency if e > 0 else e / 3600 * v.efficiency)
    np.testing.assert_allclose(log.truth["baseline"], expected, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(log.frame["energy_wh"], log.truth["noise_free"] + log.truth["noise"], rtol=1e-12)
    assert abs(v.c_rr - 0.006) <= 1.5 * 0.0008
    assert abs(v.cda_m2 - 5.6) <= 1.5 * 0.5


def beyond_over_noise(log, column):
    """RMS of a column after projecting off the baseline's Jacobian, over that of the noise."""
    names = ("c_rr", "cda_m2") if log.entry == "road" else ("motoring_efficiency", "regenerating_efficiency")
    unit = log.drive.columns["duration_s"] / 3600 if log.drive.mode == "segments" else 1e-3
    base, jacobian = log.truth["baseline"].to_numpy(), []
    for name in names:  # one-sided, with another step than the generator's own
        moved = replace(log.vehicle, **{name: getattr(log.vehicle, name) * 1.00001})
        jacobian.append(power_w(log.drive, moved, log.entry, {}) * unit - base)
    q, _ = np.linalg.qr(np.stack(jacobian, axis=1))
    beyond = column - q @ (q.T @ column)
    return np.sqrt(np.mean(beyond**2) / np.mean(log.truth["noise"].to_numpy() ** 2))


@pytest.mark.parametrize(
    "effects", [("mass_scale", "hvac_power"), ("headwind", "hvac_power"), ("headwind", "wet_road", "cornering")]
)
def test_each_of_several_has_the_asked_ratio(effects):
    """Whether the effects or the noise give way, and where the noise can be matched to one of them alone."""
    log = synthetic_log(**SMALL, effects={k: {} for k in effects}, ratio=0.5)
    for k in effects:
        np.testing.assert_allclose(beyond_over_noise(log, log.truth[f"effect:{k}"].to_numpy()), 0.5, rtol=2e-3)


def test_an_effect_that_jumps_is_no_weaker_than_asked():
    log = synthetic_log(**SMALL, effects={"rolling_speed": {}, "regen_cutoff": {}}, ratio=0.5)
    weak, strong = sorted(beyond_over_noise(log, log.truth[f"effect:{k}"].to_numpy()) for k in log.vehicle.effects)
    np.testing.assert_allclose(weak, 0.5, rtol=2e-3)
    assert strong > 0.55


@pytest.mark.parametrize(("entry", "mode", "effect"), CASES)
def test_size_is_the_asked_ratio_after_projection(entry, mode, effect):
    rows = 120 if mode == "segments" else 300
    log = synthetic_log(**SMALL | {"rows_per_trip": rows}, effects={effect: {}}, ratio=0.8, entry=entry, mode=mode)
    column = (log.truth["noise_free"] - log.truth["baseline"]).to_numpy()
    np.testing.assert_allclose(beyond_over_noise(log, column), 0.8, rtol=2e-3)
    np.testing.assert_allclose(log.ratio, 0.8, rtol=1e-6)
    np.testing.assert_allclose(column, log.truth[f"effect:{effect}"], atol=1e-9)


def test_wind_blows_from_where_it_says_and_drag_follows_the_air_speed():
    truth, wind = Truth(), {"headwind": {"scale": 1.0}}
    extra = []
    for source in (0.0, np.pi, np.pi / 2):
        drive = cruise(1, wind_speed_mps=[5.0], wind_from_rad=[source], heading_rad=[0.0])
        extra.append((energy_wh(drive, truth, effects=wind) - energy_wh(drive, truth, effects={}))[0])
    head, tail, side = extra
    scale = 0.5 * 1.225 * 5.6 * 100 / 3600 / 0.91
    np.testing.assert_allclose([head, tail], [scale * (25**2 - 20**2), scale * (15**2 - 20**2)], rtol=1e-9)
    assert abs(side) < 1e-9
    still = energy_wh(cruise(1), truth, effects={"constant_headwind": {"speed_mps": 5.0}})
    np.testing.assert_allclose(still - energy_wh(cruise(1), truth, effects={}), head, rtol=1e-9)


@pytest.mark.parametrize(
    ("effect", "parameters", "expected"),
    [
        ("rolling_speed", {"per_mps2": 1e-6}, 30e3 * 9.80665 * 1e-6 * 400),
        ("rolling_temperature", {"per_k": -1e-4}, 30e3 * 9.80665 * -1e-4 * -10),
        ("air_density", {"scale": 1.0}, 0.5 * 5.6 * 400 * (1.3 - 1.225)),
        (
            "wet_road",
            {"excess": 0.2, "spray": 0.1},
            0.5 * (30e3 * 9.80665 * 0.006 * 0.2 + 0.5 * 1.225 * 5.6 * 0.1 * 400),
        ),
        ("cornering", {"coefficient": 0.01}, 0.01 * 30e3 * 20**4 * 0.002**2),
        ("grade_bias", {"bias_rad": 1e-3}, 30e3 * 9.80665 * (np.sin(1e-3) + 0.006 * (np.cos(1e-3) - 1))),
        ("crosswind", {"drag_per_rad2": 2.0}, 0.5 * 1.225 * 5.6 * 400 * 2.0 * np.arctan2(4.0, 20.0) ** 2),
        ("linear_cornering", {"share": 0.1}, 0.1 * 30e3 * 20**2 * 0.002),
        ("hyperbolic_tyre_warmup", {"excess": 0.5, "distance_m": 50.0}, 30e3 * 9.80665 * 0.006 * 0.5 / 4),
        (
            "curved_rolling_temperature",
            {"share": 0.1, "per_k": 0.05},
            30e3 * 9.80665 * 0.006 * 0.1 * (np.exp(0.5) - 1),
        ),
    ],
)
def test_force_of_an_effect_by_hand(effect, parameters, expected):
    drive = cruise(1, ambient_temp_c=[10.0], air_density_kgpm3=[1.3], wet_road=[0.5], curvature_1pm=[-0.002],
                   wind_speed_mps=[4.0], wind_from_rad=[np.pi / 2])  # fmt: skip
    truth = replace(Truth(), efficiency=1.0)
    extra = power_w(drive, truth, effects={effect: parameters}) - power_w(drive, truth, effects={})
    np.testing.assert_allclose(extra / 20.0, expected, rtol=1e-9)


def test_battery_side_effects_by_hand():
    drive = cruise(3, grade_rad=[0.0, -0.04, -0.04], brake_pressure_pa=[0.0, 1e5, 0.0])
    base = power_w(drive, Truth(), effects={})
    assert base[1] < -1e5

    def with_(effect, **parameters):
        return power_w(drive, Truth(), effects={effect: parameters})

    np.testing.assert_allclose(with_("regen_limit", power_w=1e5), np.maximum(base, -1e5))
    np.testing.assert_allclose(with_("regen_cutoff", speed_mps=21.0), np.maximum(base, 0))
    np.testing.assert_allclose(with_("regen_cutoff", speed_mps=19.0), base)
    np.testing.assert_allclose(with_("friction_blending", share=0.25), base * [1, 0.75, 1])
    np.testing.assert_allclose(with_("battery_resistance", resistance_ohm=0.1), base + 0.1 * (base / 650) ** 2)
    half = with_("fading_regen_cutoff", none_below_mps=15.0, speed_mps=25.0)
    np.testing.assert_allclose(half, np.where(base < 0, 0.5 * base, base))
    np.testing.assert_allclose(with_("squared_hvac_power", w_per_k2=10.0, at_c=17.0), base + 10.0 * 3.0**2)
    drive.columns["battery_temp_c"] = np.full(3, 10.0)
    cold = with_("cold_battery_resistance", resistance_ohm=0.1, per_k=0.04)
    np.testing.assert_allclose(cold, base + 0.1 * np.exp(0.4) * (base / 650) ** 2)
    np.testing.assert_allclose(with_("power_gain", gain=0.02, offset_w=50.0), 1.02 * base + 50)
    np.testing.assert_allclose(with_("auxiliary_power", power_w=3e3), base + 3e3)
    fade = with_("brake_drag", force_n=1e3, tau_s=30.0) - base
    np.testing.assert_allclose(fade, [0, 0, 1e3 * np.exp(-2.5 / 30) * 20 * 0.91])


def test_cycles_keep_their_duty_and_filters_keep_the_energy():
    drive, truth = cruise(600), replace(FREE, phase=(0.3,))
    load = power_w(drive, truth, effects={"periodic_load": {"power_w": 6e3, "period_s": 300.0, "duty": 0.4}})
    np.testing.assert_allclose(load.mean(), 0.4 * 6e3)
    log = synthetic_log(seed=2, trips=2, rows_per_trip=900, mode="samples", effects={"sampling_filter": {"tau_s": 2.0}})
    free, measured = log.truth["baseline"].to_numpy(), log.truth["noise_free"].to_numpy()
    assert abs(free.sum() - measured.sum()) < 0.01 * np.abs(free).sum()
    assert np.std(np.diff(measured)) < 0.7 * np.std(np.diff(free))


@pytest.mark.parametrize("skew", [0.4, -0.4, 1.0])
def test_a_positive_skew_makes_the_target_late(skew):
    log = synthetic_log(
        seed=2, trips=1, rows_per_trip=600, mode="samples", entry="wheel", effects={"time_skew": {"skew_s": skew}}
    )
    t, free = log.frame["time_s"].to_numpy(), log.truth["baseline"].to_numpy()
    np.testing.assert_allclose(log.truth["noise_free"], np.interp(t - skew, t, free), atol=1e-9)


def test_the_lagging_slope_is_what_the_truck_met_before():
    log = synthetic_log(seed=4, trips=3, mode="samples")
    logged = log.frame["grade_rad"].to_numpy()
    first = (log.frame["trip_id"] == "T01").to_numpy()
    np.testing.assert_allclose(log.drive.grade_at(2.0)[first][:-2], logged[first][2:], atol=1e-12)
    rows = synthetic_log(seed=4, trips=1)
    c = rows.drive.columns
    mid = c["time_s"] + c["duration_s"] / 2
    later, inner = np.interp(mid + 3, mid, c["grade_rad"]), (c["distance_m"] > 0) & (mid < mid[-1] - 30)
    assert np.corrcoef(later[inner], rows.drive.grade_at(3.0)[inner])[0, 1] > 0.98


def lag_one(log) -> float:
    x, y = [], []
    for _, noise in log.truth.groupby("trip_id")["noise"]:
        x.append(noise.to_numpy()[:-1])
        y.append(noise.to_numpy()[1:])
    x, y = np.concatenate(x), np.concatenate(y)
    return float(x @ y / np.sqrt((x @ x) * (y @ y)))


@pytest.mark.parametrize(("kind", "coefficient", "expected"), [
    ("white", 0.9, 0.0), ("ar1", 0.7, 0.7), ("ar1", 0.97, 0.97), ("ar1_white", 0.9, 0.72), ("trip_levels", 0.8, 0.9),
    ("student_t", 0.8, 0.8), ("trip_variance", 0.8, 0.8),
])  # fmt: skip
def test_noise_has_the_asked_size_and_colour(kind, coefficient, expected):
    log = synthetic_log(seed=5, trips=48, rows_per_trip=80, noise=kind, ar_coefficient=coefficient, noise_rms=9.0)
    np.testing.assert_allclose(np.sqrt(np.mean(log.truth["noise"] ** 2)), 9.0, rtol=1e-9)
    assert lag_one(log) == pytest.approx(expected, abs=0.06)  # 48 levels or sizes: some 14 % of their variance
    assert kind in NOISES


def test_same_seed_same_bytes_and_streams_are_independent():
    def text(log):
        out = io.StringIO()
        log.frame.to_csv(out)
        return out.getvalue()

    plain, again, other = (synthetic_log(**SMALL | {"seed": s}) for s in (16, 16, 17))
    assert text(plain) == text(again)
    assert text(plain) != text(other)
    planted = synthetic_log(**SMALL, effects={"crosswind": {}})
    pd.testing.assert_frame_equal(plain.frame.drop(columns="energy_wh"), planted.frame.drop(columns="energy_wh"))
    np.testing.assert_array_equal(plain.truth["noise"], planted.truth["noise"])


def test_a_channel_that_is_held_is_one_number_of_each_trip_and_nothing_else_of_the_road_changes():
    moving, held = (synthetic_log(**SMALL, held=h, effects={"hvac_power": {}}) for h in ((), ("ambient_temp_c",)))
    by_trip = held.frame.groupby("trip_id")["ambient_temp_c"]
    assert (by_trip.nunique() == 1).all()
    np.testing.assert_allclose(by_trip.mean(), moving.frame.groupby("trip_id")["ambient_temp_c"].mean(), rtol=1e-12)
    assert (moving.frame.groupby("trip_id")["ambient_temp_c"].nunique() > 1).all()
    follows = ["ambient_temp_c", "battery_temp_c", "energy_wh"]
    pd.testing.assert_frame_equal(held.frame.drop(columns=follows), moving.frame.drop(columns=follows))
    watts = held.truth["effect:hvac_power"] / held.frame["duration_s"] * 3600  # what happened follows what is written
    expected = 350 * np.maximum(14 - held.frame["ambient_temp_c"], 0)
    expected += 250 * np.maximum(held.frame["ambient_temp_c"] - 20, 0)
    np.testing.assert_allclose(watts, expected, atol=1e-6)


def test_a_sheet_that_knows_more_has_a_truth_nearer_to_it():
    usual, sure = (synthetic_log(**SMALL, entry="shaft", table_sd=sd) for sd in ({}, {"motoring_efficiency": 0.01}))
    sd = [tomllib.loads(x.sheet)["machine"]["motoring_efficiency"]["sd"] for x in (usual, sure)]
    assert sd == [0.05, 0.01]
    assert abs(sure.vehicle.motoring_efficiency - 0.93) <= 0.015 + 1e-9
    np.testing.assert_allclose(sure.vehicle.regenerating_efficiency, usual.vehicle.regenerating_efficiency)


def test_what_declared_coefficients_take_up_can_be_planted_and_has_no_size():
    log = synthetic_log(**SMALL, entry="shaft", effects={"power_gain": {"gain": 0.05}})
    assert log.ratio < 1e-9
    np.testing.assert_allclose(log.truth["noise_free"], 1.05 * log.truth["baseline"], rtol=1e-12)
    assert "power_gain" not in plantable("shaft")


def test_what_stands_for_another_form_is_an_effect_of_the_library():
    from hdev_jax.physics import LIBRARY

    near = {k: p.like for k, p in PLANTABLE.items() if p.like}
    assert len(near) >= 6
    assert set(near.values()) <= set(LIBRARY)
    assert not any(PLANTABLE[k].in_library or k in LIBRARY for k in near)


@pytest.mark.parametrize("mode", ["segments", "samples"])
@pytest.mark.parametrize("entry", ["road", "shaft", "wheel"])
def test_files_parse_as_the_contract_says(tmp_path, entry, mode):
    log = synthetic_log(**SMALL, entry=entry, mode=mode, effects={"auxiliary_power": {"power_w": 4e3}})
    paths = log.write(tmp_path)
    frame = pd.read_csv(paths["log"])
    assert len(frame) == len(log.truth) == SMALL["trips"] * SMALL["rows_per_trip"]
    numbers = frame.drop(columns=["trip_id", "vehicle_id"])
    assert all(np.issubdtype(t, np.number) for t in numbers.dtypes)
    assert np.isfinite(numbers.to_numpy()).all()
    assert {"mass_kg", "grade_rad", "wind_speed_mps", "wind_from_rad", "heading_rad", "ambient_temp_c"} <= set(frame)
    assert {"humidity_pct", "gps_hdop", "cloud_cover", "tyre_pressure_kpa_display"} <= set(frame)
    assert ("motor_torque_nm" in frame) == (entry == "shaft")
    assert ("traction_force_n" in frame) == (entry == "wheel")
    assert ("energy_wh" in frame) == (mode == "segments")
    assert ("battery_power_kw" in frame) == (mode == "samples")
    for _, trip in frame.groupby("trip_id"):
        assert (np.diff(trip["time_s"]) > 0).all()
    sheet = tomllib.loads(paths["sheet"].read_text())
    assert "synthetic" in sheet["name"]
    assert "effects" not in sheet
    assert sheet["battery"] == {"auxiliary_w": 0.0}
    assert ("road" in sheet) == (entry == "road")
    assert paths["truth"].parent != tmp_path
    assert log.frame.attrs["synthetic"]


@cache
def usual(seed: int) -> SyntheticLog:
    return synthetic_log(seed=seed)


@pytest.mark.parametrize("seed", range(2))
def test_a_truck_that_could_be_real(seed):
    log = usual(seed)
    f = log.frame
    per_km = f["energy_wh"].sum() / f["distance_m"].sum()
    assert 0.8 < per_km < 2.5
    by_trip = f.groupby("trip_id")
    assert (by_trip["energy_wh"].sum() / by_trip["distance_m"].sum()).between(0.3, 2.8).all()
    assert f["speed_end_mps"].between(0, 27).all()
    accel = (f["speed_end_mps"] - f["speed_start_mps"]) / f["duration_s"]
    assert accel.between(-1.5, 1.2).all()
    assert f["grade_rad"].abs().max() < 0.06
    assert (f["energy_wh"] / f["duration_s"] * 3.6).abs().max() < 560  # kW
    standing = f["distance_m"] == 0
    assert 0.03 < standing.mean() < 0.15
    assert f.loc[standing, "duration_s"].between(9, 36).all()
    assert (f.loc[standing, ["speed_start_mps", "speed_end_mps"]] == 0).all(axis=None)
    assert f["mass_kg"].between(15e3, 40e3).all()
    assert "air_density_kgpm3" not in f  # which the declared drag would use; what is planted is what it lacks
    assert f["soc"].between(0.05, 1).all()
    for _, trip in by_trip:
        end = (trip["time_s"] + trip["duration_s"]).to_numpy()
        np.testing.assert_allclose(end[:-1], trip["time_s"].to_numpy()[1:], atol=1e-6)
        np.testing.assert_array_equal(trip["speed_end_mps"].to_numpy()[:-1], trip["speed_start_mps"].to_numpy()[1:])
        climbed = (np.sin(trip["grade_rad"]) * trip["distance_m"]).sum()
        assert climbed == pytest.approx(trip["altitude_m"].iloc[-1] - trip["altitude_m"].iloc[0], abs=6.0)


def test_speed_and_slope_are_correlated_in_the_driving():
    f = usual(0).frame
    moving = f[f["distance_m"] > 0]
    speed = moving["distance_m"] / moving["duration_s"]
    assert np.corrcoef(speed[:-1], speed[1:])[0, 1] > 0.7
    assert moving["grade_rad"].autocorr(1) > 0.7
    heavy_hill = (moving["grade_rad"].abs() > 0.03) & (moving["mass_kg"] > 3e4)
    assert speed[heavy_hill].mean() < speed[~heavy_hill].mean()


def test_the_demo_hides_one_effect_of_moderate_size():
    log = demo_log()
    assert list(log.vehicle.effects) == ["headwind"]
    assert 0.7 < log.ratio < 3
    assert 12 <= log.frame["trip_id"].nunique() <= 16
    assert 2000 <= len(log.frame) <= 5000
    assert "wind" not in log.sheet


@pytest.mark.parametrize(("kwargs", "words"), [
    ({"effects": {"headwnd": {}}}, "headwnd.*known: auxiliary_power"),
    ({"effects": {"headwind": {"speed": 1.0}}}, "headwind: unknown speed; known: scale"),
    ({"effects": {"copper_loss": {}}}, "copper_loss needs entry shaft"),
    ({"noise": "pink"}, "noise: expected one of white"),
    ({"effects": {"step_change": {"auxiliary_w": 1e3, "trip": 99}}}, "changes nothing in this log"),
    ({"trips": 0}, "at least 1 trip"),
    ({"held": ["heading_rad"]}, "held: unknown heading_rad; known: ambient_temp_c"),
    ({"table_sd": {"mass_kg": 1.0}}, "table_sd: unknown mass_kg; known: c_rr"),
])  # fmt: skip
def test_says_what_cannot_be_planted(kwargs, words):
    with pytest.raises(ValueError, match=words):
        synthetic_log(**{"seed": 0, "trips": 3, "rows_per_trip": 60, **kwargs})


def test_a_size_out_of_reach_is_an_error():
    log = synthetic_log(**SMALL)
    with pytest.raises(ValueError, match="out of reach"):
        size_effect(log.drive, log.vehicle, "friction_blending", {"share": 1e-9}, rms=1e3)
    assert set(PLANTABLE) >= {"headwind", "outside_thermal_cycle", "outside_humidity_load"}
