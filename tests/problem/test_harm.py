"""Slopes with an error: coefficients stay right where they help, and they are left out where they do harm."""

import numpy as np
import pandas as pd
import pytest

from hdev_jax.fleet import SyntheticLog, synthetic_log
from hdev_jax.inference import calibrate, cluster_rows, padded
from hdev_jax.inference.sheet import Sheet, read_sheet
from hdev_jax.logs import log_from_frame
from hdev_jax.problem import Problem, Split, prepare, split_trips, without_harmful_slope
from hdev_jax.segments import ACCEL_SD, GRADE_SD


@pytest.fixture(scope="module")
def made() -> SyntheticLog:
    return synthetic_log(seed=207, trips=12, rows_per_trip=300, mode="samples")


@pytest.fixture(scope="module")
def sheet(made, tmp_path_factory) -> Sheet:
    path = tmp_path_factory.mktemp("sheet") / "truck.toml"
    path.write_text(made.sheet)
    return read_sheet(path)


def read_as(made: SyntheticLog, altitude_m: np.ndarray, step_kmh: float) -> pd.DataFrame:
    """The log with this altitude in the place of its slope, and speeds in steps."""
    frame = made.frame.drop(columns="grade_rad").assign(altitude_m=altitude_m)
    frame["speed_mps"] = np.round(frame.speed_mps * 3.6 / step_kmh) * step_kmh / 3.6
    return frame.drop(columns=["speed_start_mps", "speed_end_mps"], errors="ignore")


def problem_of(frame: pd.DataFrame, sheet: Sheet) -> tuple[Problem, Split]:
    split = split_trips(log_from_frame(frame))
    return prepare(split.log, sheet), split


@pytest.fixture(scope="module")
def noisy(made, sheet) -> tuple[Problem, Split]:
    """The log with a noisy altimeter and speeds in steps."""
    altitude = made.frame.altitude_m + np.random.default_rng(1).normal(0, 3.0, len(made.frame))
    return problem_of(read_as(made, altitude, step_kmh=1.0), sheet)


def test_coefficients_stay_right_with_a_noisy_altimeter_and_speeds_in_steps(made, noisy):
    problem, split = noisy
    assert problem.segments.has(GRADE_SD, ACCEL_SD)
    rows = problem.rows(split.train)
    segments = problem.segments.take(rows)
    fit = padded(segments, problem.measured[rows])
    found = calibrate(problem.vehicle, problem.table, fit, problem.target, cluster_rows(segments))
    at = [c.path.rpartition(".")[2] for c in found.table.free].index("c_rr")
    true = made.vehicle.c_rr
    assert abs(found.values[at] - true) < 0.02 * true + 2.0 * found.sd[at]


def test_a_slope_that_helps_is_kept(noisy):
    problem, split = noisy
    assert without_harmful_slope(problem, split) is problem


def test_a_slope_that_does_harm_is_left_out_and_said(made, sheet):
    """Another drive's altitude: hills that are none of this road's."""
    other = made.frame.altitude_m.to_numpy()[::-1] + np.random.default_rng(3).normal(0, 3.0, len(made.frame))
    problem, split = problem_of(read_as(made, other, step_kmh=1.0), sheet)
    left = without_harmful_slope(problem, split)
    assert not left.segments.has("grade_rad")
    assert not left.segments.has(GRADE_SD)
    told = next(n for n in left.notes if "the slope makes it worse" in n)
    with_it, without = (float(told.split(mark)[1].split()[0]) for mark in ("error ", "with it, "))
    assert with_it > without
    assert any(e.reason == told and e.count == len(left.log) for e in left.log.ledger)
