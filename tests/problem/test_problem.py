"""What a log, a sheet and a target come to: what the target would leak, and a trip that is trained on and tested."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from hdev_jax.diagnosis.candidates.facts import facts_of
from hdev_jax.diagnosis.candidates.plan import columns
from hdev_jax.diagnosis.diagnose import Outcome, training_of
from hdev_jax.fleet import synthetic_log
from hdev_jax.inference import calibrate, cluster_rows, padded, predict
from hdev_jax.inference.sheet import Sheet, read_sheet
from hdev_jax.logs import Log, read_log
from hdev_jax.physics import LIBRARY
from hdev_jax.physics.brakes import BrakeDrag
from hdev_jax.physics.sensors import SamplingFilter
from hdev_jax.physics.tyres import TyreWarmup
from hdev_jax.problem import prepare, split_trips
from hdev_jax.report.build import of_diagnosis


def read(folder: Path, change: Callable[[pd.DataFrame], None] = lambda _: None, **options) -> tuple[Log, Sheet]:
    """A synthetic log and its sheet as they are read from files, the table changed before it is written."""
    made = synthetic_log(seed=3, rows_per_trip=90, **options)
    change(made.frame)
    files = made.write(folder, truth=False)
    return read_log([files["log"]]), read_sheet(files["sheet"])


@pytest.mark.parametrize(("factor", "odd"), [(1.0, False), (1e-3, True), (40.0, True)])
@pytest.mark.parametrize("target", ["energy_wh", "battery_power_kw"])
def test_a_consumption_that_no_vehicle_has_is_told(target, factor, odd, tmp_path):
    """kWh under the name of Wh, or forty times as much: the log is read, and a note says so."""

    def scaled(frame: pd.DataFrame) -> None:
        frame["energy_wh"] *= factor

    log, sheet = read(tmp_path, scaled, trips=2)
    told = [n for n in prepare(log, sheet, target).notes if "check the unit of column energy_wh" in n]
    assert len(told) == odd
    short = log.take(np.flatnonzero(np.cumsum(log.segments.distance_m) < 900.0))
    assert not [n for n in prepare(short, sheet, target).notes if "check the unit" in n], "too short to tell"


def test_the_target_is_asked_and_not_what_is_measured_beside_it(tmp_path):
    """Power in kW under the name of W, energy beside it as it should be; and the column is called as the file does."""

    def with_power(frame: pd.DataFrame) -> None:
        frame["battery_power_kw"] = frame.energy_wh * 3.6 / frame.duration_s / 1000.0

    log, sheet = read(tmp_path, with_power, trips=2)
    told = {t: [n for n in prepare(log, sheet, t).notes if "check the unit" in n] for t in log.targets[:2]}
    assert {t: len(n) for t, n in told.items()} == {"energy_wh": 0, "battery_power_kw": 1}
    assert "battery_power_kw" in told["battery_power_kw"][0]


# --- what the target would leak --------------------------------------------------------------------------------------


def with_current(frame: pd.DataFrame) -> None:
    frame["current_a"] = frame.energy_wh * 3600.0 / frame.duration_s / frame.voltage_v


@pytest.mark.parametrize("target", ["energy_wh", "battery_power_kw"])
def test_the_batterys_current_is_no_input(target, tmp_path):
    """It is the measured power over the voltage, noise and all: whatever may read it explains everything."""
    log, sheet = read(tmp_path, with_current, trips=2)
    assert log.segments.has("current_a")
    problem = prepare(log, sheet, target)
    assert set(log.segments.channels) - set(problem.segments.channels) == {"current_a"}
    assert [n for n in problem.notes if "current_a" in n and target in n]


def test_a_log_without_current_is_as_it_was(tmp_path):
    log, sheet = read(tmp_path, trips=2)
    problem = prepare(log, sheet)
    assert set(problem.segments.channels) == set(log.segments.channels)
    assert not [n for n in problem.notes if "current_a" in n]


def test_a_traction_force_is_where_the_chain_to_a_torque_begins(tmp_path):
    """It lies before the torque: it is no leak but the model's input. The torque itself and the current are."""
    log, sheet = read(tmp_path, trips=2)
    n = len(log)
    here = {"motor_torque_nm": np.ones(n), "traction_force_n": np.ones(n), "current_a": np.ones(n)}
    sheet.gear_ratios, sheet.wheel_radius_m = (5.0,), 0.5
    problem = prepare(replace(log, segments=log.segments.with_channels(**here)), sheet, "motor_torque_nm")
    assert problem.vehicle.entry == "wheel"
    assert {k for k in here if problem.segments.has(k)} == {"traction_force_n"}


# --- ids below 0 -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("channel", ["gear", "road_surface"])
def test_a_group_below_0_is_told_and_counts_as_0(channel, tmp_path):
    """A reverse gear of −1, a surface that is not known: no group of its own, and no column for one."""
    kinds = np.where(np.arange(180) % 3 == 0, -1.0, np.where(np.arange(180) % 3 == 1, 1.0, 2.0))
    log, sheet = read(tmp_path, lambda f: f.__setitem__(channel, kinds), trips=2)
    problem = prepare(log, sheet)
    assert [n for n in problem.notes if n.startswith(f"{channel} is below 0 in 60 rows")]
    facts = facts_of(problem.segments)
    assert facts.seen(channel) == [0, 1, 2]
    effect = {"gear": "gear_efficiency", "road_surface": "road_surface"}[channel]
    rows = padded(problem.segments, problem.measured)
    candidates, made, _ = columns(problem.vehicle, [LIBRARY[effect]], rows.segments, rows.rows, problem.target)
    at = {g: k for c in candidates for g, k in zip(c.groups, c.columns, strict=True)}
    assert set(at) == {1, 2}  # against 0, the first of the commonest
    assert not np.any(made[kinds < 0][:, list(at.values())])


# --- one trip --------------------------------------------------------------------------------------------------------

ACROSS_ROWS = (
    TyreWarmup(excess=0.4, distance_m=1e4),  # the distance since the start
    BrakeDrag(force_n=300.0, tau_s=60.0),  # the time since the brake was released
    SamplingFilter(tap_1=0.1, tap_2=0.0, tau_s=30.0),  # neighbours, and a lag from the first row on
)


def test_one_trip_goes_on_where_its_test_part_begins(tmp_path):
    """Tyres do not cool down there, nor do filters begin again: every row is predicted as in the trip undivided."""
    log, sheet = read(tmp_path, trips=1)
    split, whole = split_trips(log), prepare(log, sheet)
    parts = prepare(split.log, sheet)
    car = whole.vehicle.plus(*ACROSS_ROWS)
    expected = whole.predict(car)
    np.testing.assert_array_equal(parts.predict(car), expected)
    train, test = parts.rows(split.train), parts.rows(split.test)
    assert train.sum() > test.sum() > 0
    np.testing.assert_array_equal(train, ~test)
    # what is fitted sees the first part alone
    rows = padded(parts.segments.take(train), parts.measured[train])
    alone = np.asarray(predict(car, rows.segments, parts.target))[: rows.rows]
    np.testing.assert_allclose(alone[:-1], expected[train][:-1], rtol=1e-12)


def test_the_page_shows_the_test_part_as_a_part_of_its_trip(tmp_path):
    """Its breakdown adds up to its prediction, and the distance since the start is the trip's."""
    log, sheet = read(tmp_path, trips=1)
    split = split_trips(log)
    problem = prepare(split.log, sheet)
    train, test = problem.rows(split.train), problem.rows(split.test)
    segments = problem.segments.take(train)
    rows = padded(segments, problem.measured[train])
    fit = calibrate(problem.vehicle, problem.table, rows, problem.target, cluster_rows(segments))
    car, (training, _) = fit.vehicle.plus(*ACROSS_ROWS), training_of(problem, split, {})
    predicted = problem.predict(car)
    result = Outcome(problem, split, {"target": problem.target}, car, car, fit, predicted, predicted, {}, training)
    data = of_diagnosis(result, "", 0.0)
    assert sum(data.breakdown["after"].values()) == pytest.approx(np.sum(predicted[test]) / 1e3, rel=1e-9)
    since = data.row("distance_since_start_m")
    assert np.all(np.diff(since) >= 0)
    assert since[-1] == pytest.approx(np.sum(log.segments.distance_m) - 0.5 * log.segments.distance_m[-1])
    assert {data.trip_names[i] for i in data.row("trip")[test]} == set(split.names(split.test))
