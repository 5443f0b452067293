"""Errors as the contract counts them, and which trips they are counted on."""

import numpy as np
import pytest

from hdev_jax.errors import InputError
from hdev_jax.logs import Log
from hdev_jax.problem import metrics, split_trips, sum_weight
from hdev_jax.segments import Segments

# --- metrics ---------------------------------------------------------------------------------------------------------


def test_metrics_of_a_few_rows():
    """By hand: errors 1, −1, 3 of 10, 20, 30."""
    m = metrics(np.array([10.0, 20.0, 30.0]), np.array([11.0, 19.0, 33.0]), np.ones(3))
    assert m["mse"] == pytest.approx(11 / 3)
    assert m["rmse"] == pytest.approx(np.sqrt(11 / 3))
    assert m["bias"] == pytest.approx(1.0)  # predicted − measured
    assert m["pe_percent"] == pytest.approx(100 * 3 / 60)
    assert m["fit_percent"] == pytest.approx(100 * (1 - np.sqrt(11 / 200)))
    assert m["n"] == 3
    assert type(m["n"]) is int
    assert all(isinstance(v, float) for k, v in m.items() if k != "n")


def test_a_perfect_prediction():
    y = np.array([1.0, -2.0, 4.0])
    m = metrics(y, y, np.ones(3))
    assert (m["rmse"], m["bias"], m["pe_percent"], m["fit_percent"]) == (0.0, 0.0, 0.0, 100.0)


@pytest.mark.parametrize(
    ("sum_", "has"), [(0.0, False), (4.9, False), (-4.9, False), (5.1, True), (-5.1, True), (100.0, True)]
)
def test_a_round_trip_has_no_percentage(sum_, has):
    """`pe_percent` is null where |Σ measured| is under 5 % of Σ|measured|, here 100."""
    y = np.array([50 + sum_ / 2, -50 + sum_ / 2])
    pe = metrics(y, y + 1, np.ones(2))["pe_percent"]
    assert (pe is not None) is has
    if has:
        assert pe == pytest.approx(200 / sum_)


def test_the_weights_decide_about_the_percentage():
    """Power that cancels by rows but not by time has one; all zero has none."""
    y = np.array([10.0, -10.0])
    assert metrics(y, y, np.ones(2))["pe_percent"] is None
    assert metrics(y, y + 1, np.array([3.0, 1.0]))["pe_percent"] == pytest.approx(100 * 4 / 20)
    assert metrics(np.zeros(2), np.ones(2), np.ones(2))["pe_percent"] is None


def test_weights_act_on_sums_alone():
    y, p = np.array([10.0, 20.0]), np.array([12.0, 20.0])
    light, heavy = metrics(y, p, np.ones(2)), metrics(y, p, np.array([9.0, 1.0]))
    for name in ("rmse", "mse", "bias", "fit_percent"):
        assert light[name] == heavy[name]
    assert heavy["pe_percent"] == pytest.approx(100 * 18 / 110)


@pytest.mark.parametrize("y", [np.full(5, 3.0), np.array([3.0])])
def test_a_constant_target_has_no_fit(y):
    m = metrics(y, y + 0.5, np.ones(len(y)))
    assert m["fit_percent"] is None
    assert m["rmse"] == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("target", "which"),
    [("energy_wh", "one"), ("battery_power_kw", "duration"), ("traction_force_n", "distance"),
     ("motor_torque_nm", "distance")],
)  # fmt: skip
def test_what_a_row_weighs(target, which):
    """Power by duration makes energy, force by distance makes work; energy is a sum already."""
    duration, distance = np.array([1.0, 2.0]), np.array([30.0, 0.0])
    expected = {"one": np.ones(2), "duration": duration, "distance": distance}[which]
    np.testing.assert_array_equal(sum_weight(target, duration, distance), expected)


# --- splits ----------------------------------------------------------------------------------------------------------


def log_of(*names: str, rows: int = 9, durations: np.ndarray | None = None) -> Log:
    n = rows * len(names)
    trip = np.repeat(np.arange(len(names)), rows)
    duration = np.ones(n) if durations is None else durations
    return Log(
        Segments(trip, np.zeros(n, int), np.tile(np.arange(rows) * 1.0, len(names)), duration, np.ones(n), np.ones(n),
                 np.ones(n), {}),
        {"energy_wh": np.ones(n)}, tuple(names), ("v",),
    )  # fmt: skip


SIX = ("a", "b", "c", "d", "e", "f")


@pytest.mark.parametrize(
    ("names", "train", "test", "expected"),
    [
        (SIX, None, None, ("abde", "cf", "")),  # the 3rd, the 6th …
        (SIX[:5], None, None, ("abde", "c", "")),
        (SIX[:3], None, None, ("ab", "c", "")),
        (SIX[:2], None, None, ("a", "b", "")),  # of two the second
        (SIX, ["a", "f"], None, ("af", "bcde", "")),  # only train: all others test
        (SIX, None, ["b"], ("acdef", "b", "")),  # only test: all others train
        (SIX, ["a", "d"], ["f", "b"], ("ad", "fb", "ce")),  # both: the rest is unused
        (SIX, ["d", "a", "d"], ["f"], ("da", "f", "bce")),  # named twice counts once
        (SIX[:2], ["b"], None, ("b", "a", "")),
    ],
)
def test_splits(names, train, test, expected):
    log = log_of(*names)
    split = split_trips(log, train, test)
    assert split.log is log
    assert tuple("".join(split.names(ids)) for ids in (split.train, split.test, split.unused)) == expected


def test_one_trip_gives_its_last_third_by_time():
    """By time, not by rows: rows at the end are shorter here."""
    durations = np.r_[np.full(12, 10.0), np.full(60, 1.0)]
    log = log_of("only", rows=72, durations=durations)
    split = split_trips(log)
    assert (split.train, split.test, split.unused) == ((0,), (1,), ())
    assert split.log.trip_names[0] != split.log.trip_names[1]
    assert all("only" in name for name in split.log.trip_names)
    test = split.log.trip == 1
    assert durations[test].sum() == pytest.approx(180 / 3)
    assert np.all(np.diff(split.log.trip) >= 0)  # the last third, not the first
    np.testing.assert_array_equal(log.trip, 0)  # the log that was given is as it was
    np.testing.assert_array_equal(split.log.segments.trip, 0)  # and the trip stays one
    assert len(split.log.select([1])) == test.sum()
    assert log.fingerprint() != split.log.fingerprint()
    np.testing.assert_array_equal(split.log.segments.time_s, log.segments.time_s)


@pytest.mark.parametrize(
    ("names", "train", "test", "words"),
    [
        (SIX, ["a", "zz"], None, ["--train-trips", "'zz'", "a, b"]),
        (SIX, None, ["A"], ["--test-trips", "'A'"]),
        (SIX, ["a", "b"], ["b", "c"], ["'b'", "--train-trips", "--test-trips"]),
        (SIX, list(SIX), None, ["no test trip"]),
        (SIX, None, list(SIX), ["no training trip"]),
        (("a",), ["a"], None, ["no test trip"]),
        (("a",), None, ["a"], ["no training trip"]),
        (tuple(f"t{k}" for k in range(30)), ["u"], None, ["t11", "…"]),  # a long log is not listed in full
    ],
)
def test_splits_refused(names, train, test, words):
    with pytest.raises(InputError) as e:
        split_trips(log_of(*names), train, test)
    assert all(w in str(e.value) for w in words), str(e.value)
    assert "\n" not in str(e.value)


@pytest.mark.parametrize("rows", [1])
def test_a_trip_too_short_to_split(rows):
    with pytest.raises(InputError, match="too short"):
        split_trips(log_of("a", rows=rows))
