"""What rows follow where trips are too few for a formula: a channel by its threshold, and nothing by chance."""

from dataclasses import replace

import numpy as np
import pytest

from hdev_jax.diagnosis.remainder.hint import find_hint, of_others
from hdev_jax.diagnosis.scores.look import Loop, Search
from hdev_jax.fleet import synthetic_log
from hdev_jax.inference import calibrate, cluster_rows, padded
from hdev_jax.inference.sheet import read_sheet
from hdev_jax.logs import read_log
from hdev_jax.problem import prepare, split_trips


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """The declared model calibrated on the training trips of a log that lacks nothing: the loop and where it stands."""
    made = synthetic_log(seed=31, trips=12, noise="ar1", ar_coefficient=0.97)
    files = made.write(tmp_path_factory.mktemp("hint"), truth=False)
    whole, sheet = read_log([files["log"]]), read_sheet(files["sheet"])
    split = split_trips(whole)
    problem = prepare(split.log, sheet)
    train = problem.rows(split.train)
    real = problem.segments.take(train)
    rows, clusters = padded(real, problem.measured[train]), cluster_rows(real)
    fit = calibrate(problem.vehicle, problem.table, rows, problem.target, clusters)
    return Loop(rows, problem.target, clusters, [], 0.05, np.random.default_rng(0), 1), Search(
        fit.vehicle, problem.table, fit
    )


def with_load(loop: Loop, state: Search, load_w: np.ndarray) -> tuple[Loop, Search]:
    """The same with a load that nobody declared, and calibrated again."""
    measured = np.array(loop.rows.measured)
    measured[: loop.rows.rows] += load_w * loop.seconds / 3600.0
    loop = replace(loop, rows=replace(loop.rows, measured=measured))
    fit = calibrate(state.vehicle, state.table, loop.rows, loop.target, loop.clusters)
    return loop, replace(state, vehicle=fit.vehicle, fit=fit)


def channel(loop: Loop, name: str) -> np.ndarray:
    return np.asarray(loop.rows.segments.channels[name], dtype=float)[: loop.rows.rows]


def test_rows_follow_a_load_of_one_channel_by_its_threshold(log):
    loop, state = with_load(*log, 2500.0 * (channel(log[0], "humidity_pct") > 70.0))
    hint = find_hint(state, loop)
    assert hint is not None
    (factor,) = hint.factors
    assert factor.name == "humidity_pct"
    assert factor.above == pytest.approx(70.0, abs=1.0)
    assert set(np.unique(hint.column[: loop.rows.rows])) == {0.0, 1.0}


def test_a_column_without_its_loudest_trip():
    """Against the definition: the gain of the others' rows alone."""
    rng = np.random.default_rng(3)
    slices = [slice(0, 40), slice(40, 70), slice(70, 100)]
    column, noise = rng.standard_normal(100), 0.1 * rng.standard_normal(100)
    left = noise + np.r_[np.zeros(40), 5.0 * column[40:70], np.zeros(30)]
    rest = np.r_[0:40, 70:100]
    alone = 0.5 * (column[rest] @ left[rest]) ** 2 / (column[rest] @ column[rest])
    assert of_others(column, left, slices) == pytest.approx(alone)
    assert of_others(column, -left, slices) == pytest.approx(alone)
    assert of_others(column[:40], left[:40], slices[:1]) == 0.0


@pytest.mark.parametrize("goes_with", [None, "duration", "energy"])
def test_rows_of_a_log_that_lacks_nothing_follow_nothing(log, goes_with):
    """Residuals of coloured noise with levels of the trips, of one size or as large as rows are long: of a thousandth
    each, none is expected."""
    loop, state = log
    rng, found = np.random.default_rng(2), 0
    predicted = np.asarray(state.fit.predicted)
    size = {None: np.ones(len(predicted)), "duration": loop.seconds, "energy": np.abs(predicted)}[goes_with]
    for _ in range(12):
        noise = size / np.mean(size) * rng.standard_normal(loop.rows.rows)
        for k in range(1, len(noise)):
            noise[k] += 0.9 * noise[k - 1] * (loop.trip[k] == loop.trip[k - 1])
        noise += 2.0 * rng.standard_normal(int(loop.trip.max()) + 1)[loop.trip]
        measured = np.array(loop.rows.measured)
        measured[: loop.rows.rows] = predicted + 5.0 * noise
        found += find_hint(state, replace(loop, rows=replace(loop.rows, measured=measured))) is not None
    assert found <= 1
