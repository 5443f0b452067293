"""Loads that switch: planted in a log they are named with their power, share and energy; noise has none."""

import json
from pathlib import Path

import numpy as np
import pytest
from planted import breaches, declared, diagnosed, named, training

import hdev_jax
from hdev_jax.diagnosis.competition.levels import level_test
from hdev_jax.diagnosis.competition.switching import _unlike, add_switching
from hdev_jax.diagnosis.result.checkpoint import from_plain, to_plain
from hdev_jax.diagnosis.settings import SETTINGS
from hdev_jax.errors import InputError
from hdev_jax.fleet import synthetic_log
from hdev_jax.fleet.switching import Load, with_loads
from hdev_jax.inference.clusters import clusters_of
from hdev_jax.inference.sheet import read_sheet
from hdev_jax.inference.states import StateRows, Switching, decode, rows_of
from hdev_jax.logs import Log, read_log
from hdev_jax.physics import LIBRARY
from hdev_jax.problem import prepare, split_trips
from hdev_jax.report.build import answer_text, of_diagnosis
from hdev_jax.report.page import write_report

FEW = {k: LIBRARY[k] for k in ("auxiliary_power", "hvac_power", "switching_load", "second_switching_load", "headwind")}
LOAD = Load(12e3, share=0.35, by_temp=0.01)


def log_with(folder: Path, *loads: Load, seed: int = 3, trips: int = 9, rows: int = 900):
    """A log of samples with these loads, read as a user's would be, with its truth."""
    synthetic = synthetic_log(seed=seed, trips=trips, rows_per_trip=rows, entry="shaft", mode="samples", effects={})
    synthetic = with_loads(synthetic, loads, seed=seed) if loads else synthetic
    files = synthetic.write(folder, truth=False)
    log = read_log([files["log"]])
    split = split_trips(log)
    return synthetic, prepare(split.log, read_sheet(files["sheet"])), split


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """One load in a log, and what is made of it; each state of the competition as it is kept."""
    synthetic, problem, split = log_with(tmp_path_factory.mktemp("switching"), LOAD)
    kept = {}

    def checkpoint(name, compute):
        kept[name] = compute()
        return kept[name]

    return synthetic, problem, split, diagnosed(problem, split, FEW, checkpoint=checkpoint), kept


@pytest.fixture(scope="module")
def some(tmp_path_factory):
    """Any training rows: the test of levels reads the settings and the kind of clusters of them."""
    _, problem, _ = log_with(tmp_path_factory.mktemp("some"), trips=5, rows=200)
    return training(problem, ("auxiliary_power",))


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    """A short log with a load, as a table, and its sheet."""
    synthetic = synthetic_log(seed=3, trips=5, rows_per_trip=200, entry="shaft", mode="samples", effects={})
    synthetic = with_loads(synthetic, [LOAD], seed=3)
    files = synthetic.write(tmp_path_factory.mktemp("short"), truth=False)
    return synthetic.frame, read_sheet(files["sheet"])


def test_it_is_named_with_its_power_and_its_share(found):
    synthetic, _, _, result, _ = found
    assert named(result) == ["switching_load"]
    assert breaches(result) == []
    (effect,) = result.summary["effects"]
    power = effect["parameters"]["power_w"]
    assert abs(power["value"] - LOAD.power_w) < 0.1 * LOAD.power_w
    assert power["interval_90"][0] - 600.0 < LOAD.power_w < power["interval_90"][1] + 600.0
    train = np.isin(synthetic.frame["trip_id"], result.summary["split"]["train_trips"])
    assert abs(effect["state"]["mean_share_on"] - synthetic.truth["on:0"][train].mean()) < 0.03
    assert 0.4 * LOAD.dwell_s < effect["state"]["dwell_on_s"] < 2.0 * LOAD.dwell_s
    assert result.summary["unexplained"]["significant"] is False


def test_the_states_and_the_energy_of_held_out_trips_are_right(found):
    synthetic, problem, split, result, _ = found
    on = np.asarray(result.given.segments.channels["derived:switching_load"])
    true = synthetic.truth["on:0"].to_numpy()
    test = problem.rows(split.test)
    assert np.mean((on > 0.5) == (true > 0.5), where=test) > 0.95
    kwh = result.summary["effects"][0]["state"]["kwh_by_trip"]
    seconds = np.asarray(problem.segments.duration_s)
    for k, trip in enumerate(problem.log.trip_names):
        rows = problem.rows([k])
        energy = LOAD.power_w * float(np.sum((true * seconds)[rows])) / 3.6e6
        value, low, high = kwh[trip]
        assert low <= value <= high
        assert abs(value - energy) < 0.15 * energy + 0.05


def test_three_errors_are_kept_apart(found):
    *_, result, _ = found
    after = result.summary["after"]
    assert after["given_states"]["rmse"] < 0.8 * after["test"]["rmse"]
    assert after["one_step"]["rmse"] < 0.8 * after["test"]["rmse"]
    # the headline is the free run, which knows no measured power
    free = result.problem.predict(result.after)
    test = result.problem.rows(result.split.test)
    error = (result.problem.measured - free)[test]
    assert after["test"]["rmse"] == pytest.approx(float(np.sqrt(np.mean(error**2))))
    assert after["test"]["rmse"] < result.summary["before"]["test"]["rmse"]


def test_a_kept_state_is_the_same_again(found):
    _, problem, *_, kept = found
    steps = [v for k, v in kept.items() if k.startswith("step-")]
    plain = next(p for p in steps if p["hidden"] is not None)
    again = to_plain(from_plain(plain, problem.vehicle, training(problem, FEW)))
    assert again["hidden"]["ids"] == plain["hidden"]["ids"]
    np.testing.assert_array_equal(again["hidden"]["on"], plain["hidden"]["on"])
    np.testing.assert_array_equal(again["hidden"]["model"]["power_w"], plain["hidden"]["model"]["power_w"])
    assert again["hidden"]["model"]["freedom"] == plain["hidden"]["model"]["freedom"]


@pytest.mark.drawn
def test_the_page_and_the_answer_say_it(found, tmp_path):
    *_, result, _ = found
    data = of_diagnosis(result, "hdev diagnose", 0.0)
    write_report(data, tmp_path)
    page = (tmp_path / "report.html").read_text()
    assert (tmp_path / "figures" / "switching_loads.png").stat().st_size > 10_000
    assert "Loads that switch" in page
    assert "% of the time at" in answer_text(data)
    assert "given the states" in answer_text(data)
    breakdown = data.breakdown["after"]["switching_load"]
    kwh = result.summary["effects"][0]["state"]["kwh_by_trip"]
    test = sum(kwh[t][0] for t in result.summary["split"]["test_trips"])
    assert breakdown == pytest.approx(test, rel=0.03)
    json.dumps(result.summary, allow_nan=False)


@pytest.mark.parametrize("noise", ["white", "ar1", "walk", "student_t"])
def test_noise_has_no_levels(noise, some):
    rng = np.random.default_rng(1)
    trips, n = 6, 700
    steps = rng.standard_t(3, (trips, n)) if noise == "student_t" else rng.standard_normal((trips, n))
    kept = {"white": 0.0, "ar1": 0.95, "walk": 0.9999, "student_t": 0.9}[noise]
    x = np.zeros((trips, n))
    for t in range(1, n):
        x[:, t] = kept * x[:, t - 1] + steps[:, t]
    rows = StateRows(
        2e3 * (x / x.std()).ravel(), np.repeat(np.arange(trips), n), np.ones(trips * n), np.full(trips * n, 15.0),
        np.zeros(trips * n, int), 0.1,
    )  # fmt: skip
    result = level_test(rows, some, rng)
    assert result is None or result.p * len(LIBRARY) > 0.05


def test_a_power_that_is_missing_constant_or_short_gives_no_load(some):
    rng = np.random.default_rng(0)
    for residual in (np.zeros(500), np.full(500, 3e3), np.array([1.0, 2.0]), np.r_[np.nan, np.ones(499)]):
        n = len(residual)
        rows = StateRows(residual, np.zeros(n, int), np.ones(n), np.full(n, 15.0), np.ones(n, int))
        assert level_test(rows, some, rng) is None


def test_what_is_on_once_at_the_start_of_each_trip_is_no_load_that_switches():
    rng, trips, n = np.random.default_rng(0), 10, 1200
    clock = np.tile(np.arange(n), trips)
    model = Switching(np.array([6e3]), 0.0, np.full(2, 1e3), np.full((1, 4), 0.4), np.full(1, 60.0))
    said = []
    for on in (clock < 300, clock % 300 < 120):
        rows = StateRows(
            6e3 * on + rng.normal(0, 1e3, trips * n), np.repeat(np.arange(trips), n), np.ones(trips * n),
            np.full(trips * n, 15.0), np.zeros(trips * n, int), 0.1,
        )  # fmt: skip
        said.append(_unlike(rows, model, decode(model, rows), 0, clusters_of(rows.trip, rows.duration_s), SETTINGS))
    assert "once in a trip" in str(said[0])
    assert said[1] is None


def test_a_warm_up_beside_a_load_is_no_second_load(tmp_path):
    bare = synthetic_log(
        seed=525001, trips=12, rows_per_trip=250, mode="segments", entry="road", effects={"cabin_warmup": {}},
        ratio=1.0, noise="ar1",
    )  # fmt: skip
    files = with_loads(bare, [Load(20.9e3, kind="chain", share=0.4, dwell_s=90.0)], seed=525001).write(
        tmp_path, truth=False
    )
    split = split_trips(read_log([files["log"]]))
    library = FEW | {"cabin_warmup": LIBRARY["cabin_warmup"]}
    found = diagnosed(prepare(split.log, read_sheet(files["sheet"])), split, library, seed=525001)
    assert {e["id"] for e in found.summary["effects"]} == {"switching_load", "cabin_warmup"}
    load = next(e for e in found.summary["effects"] if e["id"] == "switching_load")
    assert load["parameters"]["power_w"]["value"] == pytest.approx(20.9e3, rel=0.1)


def test_a_load_whose_states_drown_in_noise_is_not_named():
    rng, trips, n = np.random.default_rng(0), 10, 1200
    on = np.tile(np.arange(n) % 300 < 120, trips)
    said = []
    for noise in (0.5, 2.0, 12.0):  # times the power
        rows = StateRows(
            1e3 * on + rng.normal(0, noise * 1e3, trips * n), np.repeat(np.arange(trips), n), np.ones(trips * n),
            np.full(trips * n, 15.0), np.zeros(trips * n, int), 0.1,
        )  # fmt: skip
        model = Switching(np.array([1e3]), 0.0, np.full(2, 800.0 * noise), np.full((1, 4), 0.4), np.full(1, 120.0))
        clusters = clusters_of(rows.trip, rows.duration_s)
        said.append(_unlike(rows, model, decode(model, rows), 0, clusters, SETTINGS))
    assert said[0] is None
    assert said[1] is None, "white noise averages out while it is on"
    assert "decoded with a probability of 0." in str(said[2])


def test_a_saw_tooth_is_no_load_that_switches():
    rng, trips, n = np.random.default_rng(0), 10, 1200
    tooth = np.tile(np.arange(n) % 300 / 300.0, trips)
    said = []
    for power in (10e3 * tooth, 2.5e3 + 5e3 * (tooth > 0.5)):  # of the same medians
        rows = StateRows(
            power + rng.normal(0, 1e3, trips * n), np.repeat(np.arange(trips), n), np.ones(trips * n),
            np.full(trips * n, 15.0), np.zeros(trips * n, int), 0.1,
        )  # fmt: skip
        model = Switching(np.array([5e3]), 2.5e3, np.full(2, 1e3), np.full((1, 4), 0.5), np.full(1, 75.0))
        said.append(_unlike(rows, model, decode(model, rows), 0, clusters_of(rows.trip, rows.duration_s), SETTINGS))
    assert "rises by 9" in str(said[0])  # 5 kW of 5 kW, less what the states at its ends make of the noise
    assert said[1] is None


def _clipped(power):
    return np.minimum(power, np.quantile(power, 0.7))


def _held(power):
    return np.where(np.arange(len(power)) // 200 == 1, power[199], power)  # one trip of five stands still


@pytest.mark.parametrize(
    "spoilt", [lambda p: np.full_like(p, 5.0), _clipped, _held], ids=["constant", "clipped", "held"]
)
def test_a_power_that_is_no_measurement_gives_no_load(spoilt, short):
    frame, sheet = short
    spoilt_too = frame.assign(battery_power_kw=spoilt(frame["battery_power_kw"].to_numpy()))
    log = Log.from_frame(spoilt_too)
    problem = prepare(log, sheet)
    rows = training(problem, ("switching_load", "second_switching_load"))
    state, verdict = add_switching(rows, declared(rows, problem), np.random.default_rng(0))
    assert state is None
    assert np.isfinite(verdict.q_value)
    assert "nan" not in str(verdict.rejection)


def test_power_that_is_missing_for_minutes_is_refused_in_one_line_or_dropped(short):
    frame, _ = short
    power = frame["battery_power_kw"].to_numpy().copy()
    power[240:360] = np.nan
    with pytest.raises(InputError, match="120 with battery_power_w missing") as error:
        Log.from_frame(frame.assign(battery_power_kw=power))
    assert "\n" not in str(error.value)
    power[280:360] = frame["battery_power_kw"].to_numpy()[280:360]  # 4 % of the rows are dropped: a gap in a trip
    log = Log.from_frame(frame.assign(battery_power_kw=power))
    assert len(log) == len(frame) - 40
    assert len(log.trip_names) == 6  # the rows after the gap are a trip of their own
    rows = rows_of(log.segments, log.measured["battery_power_w"], samples=True)
    decoded = decode(Switching(np.array([9e3]), 0.0, np.full(2, 4e3), np.full((1, 4), 0.4), np.full(1, 60.0)), rows)
    assert np.all(np.isfinite(decoded.on))
    assert np.isfinite(decoded.log_likelihood)


def test_two_rows_at_standstill_have_no_load(short):
    frame, sheet = short
    two = frame.iloc[:2].assign(**{c: 0.0 for c in frame if c.startswith(("speed", "motor", "distance"))})
    problem = prepare(Log.from_frame(two), sheet)
    rows = training(problem, ("switching_load", "second_switching_load"))
    state, verdict = add_switching(rows, declared(rows, problem), np.random.default_rng(0))
    assert state is None
    assert verdict is None or "nan" not in str(verdict.rejection)


def test_predicting_online_filters_along_the_log(tmp_path):
    synthetic, *_ = log_with(tmp_path, LOAD, trips=6, rows=500)
    files = {k: str(tmp_path / f"synthetic_truck.{k}") for k in ("csv", "toml")}
    found = hdev_jax.diagnose(files["csv"], files["toml"], only=[*FEW])
    assert found.predictive["states"]["ids"] == ["switching_load"]
    frame = synthetic.frame
    free, online = (hdev_jax.predict(frame, found, online=x) for x in (False, True))
    measured = frame["battery_power_kw"] if "battery_power_kw" in frame else frame["battery_power_w"] / 1e3
    error = {k: measured.to_numpy() - p.rows["predicted"].to_numpy() for k, p in (("free", free), ("online", online))}
    assert np.std(error["online"]) < 0.8 * np.std(error["free"])
    inside = (measured >= online.rows["lower"]) & (measured <= online.rows["upper"])
    assert 0.8 < inside.mean() < 0.97
    assert "one step ahead" in str(online)
    # what comes later changes nothing
    cut = frame[frame["trip_id"] == frame["trip_id"].iloc[0]].iloc[:300]
    part = hdev_jax.predict(cut, found, online=True).rows["predicted"].to_numpy()
    np.testing.assert_allclose(part[:-1], online.rows["predicted"].to_numpy()[:299], atol=1e-6)
    with pytest.raises(InputError, match="no load that switches"):
        hdev_jax.predict(frame, files["toml"], online=True)
    without = frame.drop(columns=[c for c in frame if c.startswith(("battery_power", "energy"))])
    with pytest.raises(InputError, match="does not measure"):
        hdev_jax.predict(without, found, target="battery_power_kw", online=True)
