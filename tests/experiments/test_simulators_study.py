"""Truth from other simulators: how a log is scored, what is driven and written; the simulators where they are there."""

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from experiments.runner.config import resolve, typed
from experiments.simulators import scores as scores
from experiments.simulators.config import Config, Line
from experiments.simulators.drives import Drive, hills, micro_trips, random_drive
from experiments.simulators.logs import simulated_log
from experiments.simulators.plants import PLANTS
from experiments.simulators.refit import known_sheet
from experiments.simulators.study import tasks
from experiments.simulators.tables import change_row, confusion, headwind_note, rival_rows
from experiments.simulators.truth import SIMULATORS, make
from experiments.simulators.vehicles import GRAVITY_MPS2, Simulated, Vehicle, drawn, slope_with_force
from hdev_jax.inference.sheet import read_sheet
from hdev_jax.logs import by_distance, read_log
from hdev_jax.physics import LIBRARY
from hdev_jax.problem import prepare

STUDY = Path(__file__).parents[2] / "configs" / "studies" / "simulators.toml"
CAR = Vehicle("car", "sumo", 1500.0, 0.01, 0.7, 45.0, 300.0, 0.3, 0.9, 0.8)


def entry(*names: str, size: int = 0, **parameters: tuple[float, float]) -> dict[str, Any]:
    """What a log named: one effect or a class, with values and half-widths of their intervals."""
    sizes = {k: {"value": v, "sd": d, "interval_90": [v - d, v + d]} for k, (v, d) in parameters.items()}
    return {"id": names[0], "class": list(names), "class_size": size or len(names), "parameters": sizes}


def result(*named: dict[str, Any], **more: Any) -> dict[str, Any]:
    """A log's result that says no more than it is given."""
    return {
        "named": list(named), "unexplained": False, "missing": [], "two_efficiencies": False, "coefficients": {},
        "reasons": [],
        "truth": {"road.c_rr": 0.012}, "recovered": 0.4, "recovers": 0.8, "rivals": {},
        "test_rmse": {"before": 2.0, "after": 1.0}, "refit_rmse": 1.0, "seconds": 1.0, **more,
    }  # fmt: skip


def task(plant: str, simulator: str = "fastsim", rows: str = "intervals", **more: Any) -> dict[str, Any]:
    return {"plant": plant, "simulator": simulator, "rows": rows, "line": "a", "vehicle": "v", "seed": 0, **more}


def coefficient(value: float, sd: float, prior: float) -> dict[str, float]:
    return {"value": value, "sd": sd, "prior_value": prior, "prior_sd": 0.1 * prior}


GAIN, MASS = entry("power_gain", gain=(0.04, 0.01)), entry("mass_scale", scale=(0.1, 0.01))
LOSS, REGEN = entry("inverter_loss", per_nm_w=(0.1, 0.1)), entry("regen_efficiency", share=(0.5, 0.02))


@pytest.mark.parametrize(
    ("of", "said", "right", "false", "blamed"),
    [
        (task("nothing"), result(LOSS), True, [], []),
        (task("nothing"), result(), False, [], []),
        (task("nothing"), result(unexplained=True), True, [], []),
        (task("nothing"), result(two_efficiencies=True), True, [], []),
        (task("nothing"), result(LOSS, GAIN), False, ["power_gain"], ["power_gain"]),
        (task("nothing", "sumo"), result(LOSS), False, ["inverter_loss"], []),
        (task("nothing", "sumo"), result(REGEN), True, [], []),
        (task("nothing"), result(MASS), False, ["mass_scale"], ["mass_scale"]),
        (task("nothing", rows="samples"), result(REGEN, entry("time_skew"), entry("grade_lag")), True, [], []),
        (task("payload"), result(MASS, LOSS), True, [], []),
        (task("payload"), result(entry("power_gain", "mass_scale")), True, [], []),
        (task("payload"), result(entry("power_gain", "mass_scale", size=5)), False, ["power_gain"], ["power_gain"]),
        (task("payload"), result(GAIN), False, ["power_gain"], ["power_gain"]),
        (task("payload"), result(MASS, entry("crosswind")), True, ["crosswind"], []),
        (task("rolling"), result(coefficients={"road.c_rr": coefficient(0.012, 0.001, 0.01)}), True, [], []),
        (task("rolling"), result(coefficients={"road.c_rr": coefficient(0.011, 0.001, 0.01)}), False, [], []),
        (task("rolling"), result(coefficients={"road.c_rr": coefficient(0.0105, 0.0001, 0.01)}), False, [], []),
        (task("rolling"), result(coefficients={"road.c_rr": coefficient(0.008, 0.001, 0.01)}), False, [], []),
        (task("slope"), result(unexplained=True), True, [], []),
        (task("slope"), result(missing=["grade_rad"]), True, [], []),
        (task("slope"), result(MASS, unexplained=True), False, ["mass_scale"], ["mass_scale"]),
        (task("slope"), result(), False, [], []),
    ],
)  # fmt: skip
def test_a_log_is_right_where_it_says_the_change_and_no_instrument_is_blamed(of, said, right, false, blamed):
    assert scores.right(of, said) is right
    assert scores.false(of, said["named"]) == false
    assert scores.blamed(of, said["named"]) == blamed


def test_sizes_are_compared_with_what_was_changed():
    assert scores.sized(task("payload"), result(MASS)) == pytest.approx(
        {"true": 0.1, "found": 0.1, "low": 0.09, "high": 0.11}
    )
    # of what the fitted 0.8 would recover, 0.4 was
    assert scores.sized(task("regeneration"), result(REGEN))["true"] == pytest.approx(0.5)  # pyright: ignore
    moved = result(coefficients={"road.c_rr": coefficient(0.0118, 0.0002, 0.01)})
    assert scores.sized(task("rolling"), moved)["true"] == 0.012  # pyright: ignore
    assert scores.sized(task("payload"), result(GAIN)) is None
    assert scores.sized(task("nothing"), result(LOSS)) is None


def test_coefficients_hold_the_truth_or_not():
    tight, wide = (result(coefficients={"road.c_rr": coefficient(0.01, sd, 0.01)}) for sd in (0.0005, 0.0015))
    assert (scores.covered(tight), scores.covered(wide), scores.covered(result())) == ([False], [True], [])


def test_a_size_that_no_vehicle_has_is_counted():
    assert scores.implausible(result(MASS, GAIN)) == []
    third = entry("mass_scale", scale=(-0.4, 0.001))
    assert scores.implausible(result(third)) == ["mass_scale.scale -0.4"]
    assert scores.implausible(result(coefficients={"road.cda_m2": coefficient(3.0, 0.1, 5.4)})) == ["road.cda_m2 3"]


def test_names_that_are_right_or_scored_are_in_the_library():
    known = {f"{k}.{p.name}" for k, effect in LIBRARY.items() for p in effect.parameters}
    assert set(scores.PLAUSIBLE) <= known
    assert all(p.names <= set(LIBRARY) for p in PLANTS.values())
    assert set(LIBRARY) >= scores.INSTRUMENTS


def test_the_table_shows_shares_and_what_is_short_of_its_target():
    config = typed(Config, resolve(STUDY), STUDY)
    group = [(task("payload"), result(MASS)), (task("payload"), result(GAIN))]
    row = change_row(config, "mass", group)
    assert (row["n"], row["right"], row["false_name"], row["blamed"], row["covered"]) == (2, 0.5, 0.5, 0.5, 1.0)
    assert "right 0.5, target 0.85" in row["short_of"]
    assert change_row(config, "mass", group[:1])["met"]


def test_the_confusion_shows_what_was_named_instead():
    c_rr = result(coefficients={"road.c_rr": coefficient(0.012, 0.001, 0.01)})
    group = [(task("nothing"), result()), (task("nothing"), result(GAIN)), (task("payload"), result(MASS)),
             (task("payload"), result(entry("power_gain", "mass_scale"))), (task("rolling"), c_rr),
             (task("headwind"), result()), (task("slope"), result(unexplained=True))]  # fmt: skip
    rows, columns, share, right = confusion(group)
    assert rows[:3] == ["nothing (2)", "mass +10 % (2)", "c_rr +20 % (1)"]
    assert "constant_headwind" in columns, "what was changed has a column, named or not"
    assert "regen_efficiency" in right[0]
    assert "nothing" not in right[0], "a sheet of one efficiency lacks its form"
    assert right[1:3] == [["mass_scale"], ["road.c_rr"]]
    assert sorted(map(tuple, right[3:])) == [("constant_headwind",), ("unexplained",)]
    shown = {(r, c): share[i, k] for i, r in enumerate(rows) for k, c in enumerate(columns)}
    assert shown["nothing (2)", "nothing"] == shown["nothing (2)", "power_gain"] == 50.0
    assert shown["mass +10 % (2)", "mass_scale"] == shown["c_rr +20 % (1)", "road.c_rr"] == 100.0


def test_a_headwind_as_the_reason_of_a_coefficient_is_said_and_does_not_count():
    moved = result(reasons=["constant_headwind", "rolling_linear"])
    (note,) = headwind_note([(task("headwind"), moved), (task("headwind"), result()), (task("payload"), moved)])
    assert "In 1 of 2 logs" in note
    assert "in 1 of the 1 others" in note
    assert not scores.right(task("headwind"), moved)
    assert headwind_note([(task("payload"), moved)]) == []


def test_rivals_are_scored_by_the_same_rule():
    config = typed(Config, resolve(STUDY, ['rivals=["stlsq","lightgbm"]']), STUDY)
    theirs = {"stlsq": {"named": ["mass_scale", "crosswind"], "test_rmse": 1.5, "seconds": 0.1},
              "lightgbm": {"named": [], "test_rmse": 1.2, "seconds": 0.2}}  # fmt: skip
    ours, stlsq, boosted = rival_rows(config, [(task("payload"), result(MASS, rivals=theirs))])
    assert (ours["named"], ours["false_name"]) == (1.0, 0.0)
    assert (stlsq["named"], stlsq["false_name"], stlsq["error_over_refit"]) == (1.0, 1.0, 1.5)
    assert boosted["named"] is None


def test_every_log_has_a_seed_of_its_own_and_what_cannot_act_is_refused():
    every = list(tasks(typed(Config, resolve(STUDY), STUDY)))
    assert len({t["seed"] for t in every}) == len(every) > 400
    with pytest.raises(ValueError, match="drag changes nothing where force is measured"):
        Line(simulator="fastsim", vehicles=["zoe"], plants=["drag"], measured="force")
    with pytest.raises(ValueError, match="torque comes from FASTSim"):
        Line(simulator="sumo", vehicles=["car"], plants=["nothing"], measured="torque")


# --- what is driven and written ---------------------------------------------------------------------------------------


def simulated(seconds: int = 400) -> Simulated:
    """A trip whose powers are those of the equations, of a vehicle with 0.9 and 0.8 to and from the wheel."""
    rng = np.random.default_rng(3)
    cycle = np.r_[
        np.zeros(3), 12 * np.sin(np.linspace(0, np.pi, 60)), np.zeros(8), 6 * np.sin(np.linspace(0, np.pi, 40))
    ]
    drive = random_drive(rng, [np.r_[cycle, np.zeros(4)]], seconds)
    v0, v1 = drive.speed_mps[:-1], drive.speed_mps[1:]
    mean, grade = 0.5 * (v0 + v1), np.arctan(drive.grade[1:])
    wheel = 0.5 * (CAR.mass_kg + CAR.rotating_kg) * (v1**2 - v0**2) + mean * (
        CAR.mass_kg * GRAVITY_MPS2 * (np.sin(grade) + CAR.c_rr * np.cos(grade)) + 0.6125 * CAR.cda_m2 * mean**2
    )
    battery = CAR.auxiliary_w + np.where(wheel > 0, wheel / CAR.driving, wheel * CAR.regenerating)
    return Simulated(v0, v1, mean, grade, wheel, np.full(len(v0), np.nan), battery, 1.225)


def written(tmp_path: Path, rows: Any, measured: Any) -> Any:
    """The problem that is read from a log of two such trips."""
    made = simulated_log(CAR, [simulated()] * 2, np.random.default_rng(1), rows=rows, measured=measured, noise=0.01,
                         ar_coefficient=0.9)  # fmt: skip
    made.frame.to_parquet(tmp_path / "log.parquet")
    (tmp_path / "car.toml").write_text(made.sheet, encoding="utf-8")
    log = read_log([tmp_path / "log.parquet"])
    return made, prepare(by_distance(log) if rows == "segments" else log, read_sheet(tmp_path / "car.toml"))


def test_micro_trips_begin_and_end_at_rest():
    cycle = np.r_[np.zeros(5), np.full(9, 8.0), np.zeros(4), np.full(6, 5.0), np.zeros(3)]
    parts = micro_trips(cycle)
    assert [(p[0], p[-1], p.max()) for p in parts] == [(0.0, 0.0, 8.0), (0.0, 0.0, 5.0)]
    drive = random_drive(np.random.default_rng(0), [cycle], 200.0, stretch=2.0, top_mps=4.0, steepest=0.03)
    assert len(drive.speed_mps) >= 200
    assert drive.speed_mps.max() == pytest.approx(4.0)
    assert np.abs(np.diff(drive.speed_mps)).max() <= 2.0 + 1e-9  # half of what the scaled cycle has in a second
    assert np.abs(drive.grade).max() <= 0.03
    assert np.ptp(hills(np.random.default_rng(0), np.arange(0.0, 5000.0, 10.0), 0.03)) > 0.02


@pytest.mark.parametrize("rows", ["intervals", "segments"])
def test_the_log_says_what_was_simulated(rows, tmp_path):
    """The kernel with the sheet's one efficiency is what was simulated, but for the efficiency and the noise."""
    made, problem = written(tmp_path, rows, "none")
    assert problem.target == ("energy_wh" if rows == "segments" else "battery_power_kw")
    truth = simulated()
    total = 2 * float(np.sum(truth.battery_w)) / (3600.0 if rows == "segments" else 1e3)
    assert np.sum(problem.measured) == pytest.approx(total, rel=0.02)
    off = problem.measured - problem.predict(problem.vehicle)
    assert np.sqrt(np.mean(off**2)) < 0.15 * np.sqrt(np.mean(problem.measured**2))
    assert made.recovered == pytest.approx(CAR.regenerating)


def test_force_is_what_the_wheels_have(tmp_path):
    made, problem = written(tmp_path, "intervals", "force")
    truth = simulated()
    np.testing.assert_allclose(made.frame["traction_force_n"][: len(truth.wheel_w)] * truth.distance_m, truth.wheel_w,
                               rtol=1e-9, atol=60.0)  # fmt: skip
    assert {c.name for c in problem.table.free} == {"machine.motoring_efficiency", "machine.regenerating_efficiency"}


def test_a_force_is_a_slope():
    slope = slope_with_force(np.array([0.0, 0.02]), np.array([150.0, 150.0]), 1500.0)
    np.testing.assert_allclose(1500.0 * GRAVITY_MPS2 * (np.sin(slope) - np.sin([0.0, 0.02])), 150.0)


@pytest.mark.parametrize("simulator", ["fastsim", "sumo"])
@pytest.mark.parametrize("plant", list(PLANTS))
def test_the_sheet_of_the_refit_can_be_read(plant, simulator, tmp_path):
    true = CAR.planted(plant, PLANTS[plant].size)
    assert (true == CAR) == (plant in ("nothing", "slope"))
    (tmp_path / "car.toml").write_text(known_sheet(task(plant, simulator, "samples", measured="none"), true))
    read_sheet(tmp_path / "car.toml")


# --- the simulators themselves: extra `truth` -------------------------------------------------------------------------


@cache
def drives(simulator: str, name: str) -> tuple[Vehicle, list[Drive]]:
    """A vehicle and one trip of its simulator, which is skipped where it is not installed."""
    pytest.importorskip(simulator, reason=f"{simulator} is in the extra truth")
    vehicle = SIMULATORS[simulator].VEHICLES[name]()
    return vehicle, SIMULATORS[simulator].drives(vehicle, np.random.default_rng(5), 1, 90.0)


def driven(simulator: str, name: str, plant: str) -> tuple[Vehicle, Simulated]:
    vehicle, some = drives(simulator, name)
    true = vehicle.planted(plant, PLANTS[plant].size)
    return true, SIMULATORS[simulator].simulate(true, some)[0]


@pytest.mark.parametrize(("simulator", "name"), [("fastsim", "zoe"), ("fastsim", "truck 26 t"), ("sumo", "bus")])
def test_its_power_at_the_wheels_is_the_road_load_by_hand(simulator, name):
    true, t = driven(simulator, name, "nothing")
    mean = 0.5 * (t.speed_start_mps + t.speed_end_mps)
    np.testing.assert_allclose(t.distance_m, mean)
    by_hand = 0.5 * (true.mass_kg + true.rotating_kg) * (t.speed_end_mps**2 - t.speed_start_mps**2) + mean * (
        true.mass_kg * GRAVITY_MPS2 * (np.sin(t.grade_rad) + true.c_rr * np.cos(t.grade_rad))
        + 0.5 * t.density_kgpm3 * true.cda_m2 * mean**2
    )
    assert np.sqrt(np.mean((t.wheel_w - by_hand) ** 2)) < 2e-3 * np.sqrt(np.mean(by_hand**2))
    stands = np.maximum(t.speed_start_mps, t.speed_end_mps) == 0
    np.testing.assert_allclose(t.battery_w[stands], true.auxiliary_w, rtol=1e-6)
    pulls = t.wheel_w > 0.05 * t.wheel_w.max()
    assert 0.75 < np.sum(t.wheel_w[pulls]) / np.sum(t.battery_w[pulls] - true.auxiliary_w) < 0.95


@pytest.mark.parametrize(("simulator", "name"), [("fastsim", "zoe"), ("sumo", "bus")])
def test_a_change_is_what_it_says(simulator, name):
    vehicle, was = driven(simulator, name, "nothing")
    mean, brakes = was.distance_m, was.wheel_w < -0.05 * was.wheel_w.max()
    _, now = driven(simulator, name, "auxiliaries")
    np.testing.assert_allclose(now.battery_w - was.battery_w, 1500.0, rtol=1e-3)
    _, now = driven(simulator, name, "regeneration")
    kept = np.sum(now.battery_w[brakes] - vehicle.auxiliary_w) / np.sum(was.battery_w[brakes] - vehicle.auxiliary_w)
    assert kept == pytest.approx(0.5, abs=0.01)
    _, now = driven(simulator, name, "cutoff")
    assert np.min(now.battery_w[was.speed_start_mps < 3.5]) >= 0.0
    np.testing.assert_allclose(now.battery_w[mean > 5.5], was.battery_w[mean > 5.5], rtol=1e-6)
    _, now = driven(simulator, name, "headwind")
    extra = 0.5 * was.density_kgpm3 * vehicle.cda_m2 * ((mean + 4) ** 2 - mean**2) * mean
    assert np.sum(now.wheel_w - was.wheel_w) == pytest.approx(np.sum(extra), rel=0.01)
    _, now = driven(simulator, name, "payload")
    assert now.wheel_w[brakes].sum() / was.wheel_w[brakes].sum() == pytest.approx(1.1, abs=0.02)


def test_a_seed_draws_the_same_log():
    pytest.importorskip("fastsim", reason="fastsim is in the extra truth")
    asked = {"simulator": "fastsim", "vehicle": "zoe", "rows": "intervals", "measured": "torque", "seed": 5, "trips": 1,
             "seconds": 90.0, "noise": 0.02, "ar_coefficient": 0.9}  # fmt: skip
    first, again, other = (make({**asked, "plant": k})[0] for k in ("nothing", "nothing", "auxiliaries"))
    assert first.frame.equals(again.frame)
    same = ["time_s", "speed_end_mps", "grade_rad", "motor_speed_radps"]
    assert other.frame[same].equals(first.frame[same])
    assert not other.frame["battery_power_kw"].equals(first.frame["battery_power_kw"])


def test_another_draw_is_another_vehicle_of_the_kind():
    other = drawn(np.random.default_rng(0), CAR)
    assert other != CAR
    assert abs(other.mass_kg / CAR.mass_kg - 1) < 0.1
    assert set(SIMULATORS) == {"fastsim", "sumo"}
