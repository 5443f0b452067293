"""Loads that switch: planted in a log they are named with their power, share and energy; noise has none."""

import json
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from planted import breaches, declared, diagnosed, training

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
from hdev_jax.report.page import write_report
from hdev_jax.report.switching import on_column, switching_loads

FEW = ("auxiliary_power", "hvac_power", "switching_load", "second_switching_load")
LOAD = Load(12e3, share=0.35, by_temp=0.01)
FEWER = replace(SETTINGS, shifts=5)  # noise of the residual's colour: so many are enough for what is clear


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """One load in a log, with the vehicle's sheet and what is made of both."""
    synthetic = synthetic_log(seed=3, trips=6, rows_per_trip=500, entry="shaft", mode="samples", effects={})
    synthetic = with_loads(synthetic, [LOAD], seed=3)
    files = synthetic.write(tmp_path_factory.mktemp("switching"), truth=False)
    return synthetic, str(files["sheet"]), hdev_jax.diagnose(files["log"], files["sheet"], only=FEW)


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    """A short log with a load, as a table, with its sheet; and the same as a problem and its training rows."""
    synthetic = synthetic_log(seed=3, trips=12, rows_per_trip=190, entry="shaft", mode="samples", effects={})
    synthetic = with_loads(synthetic, [LOAD], seed=3)
    files = synthetic.write(tmp_path_factory.mktemp("short"), truth=False)
    frame, sheet = synthetic.frame, read_sheet(files["sheet"])
    problem = prepare(Log.from_frame(frame), sheet)
    return frame, sheet, problem, training(problem, ("switching_load", "second_switching_load"))


def test_it_is_named_with_its_power_and_its_share(found):
    synthetic, _, result = found
    (effect,) = result.summary["effects"]
    assert effect["id"] == "switching_load"
    assert breaches(result) == []
    power = effect["parameters"]["power_w"]
    assert abs(power["value"] - LOAD.power_w) < 0.1 * LOAD.power_w
    assert power["interval_90"][0] - 600.0 < LOAD.power_w < power["interval_90"][1] + 600.0
    train = np.isin(synthetic.frame["trip_id"], result.summary["split"]["train_trips"])
    assert abs(effect["state"]["mean_share_on"] - synthetic.truth["on:0"][train].mean()) < 0.03
    assert 0.4 * LOAD.dwell_s < effect["state"]["dwell_on_s"] < 2.0 * LOAD.dwell_s
    assert result.summary["unexplained"]["significant"] is False


def test_the_states_and_the_energy_of_held_out_trips_are_right(found):
    synthetic, _, result = found
    rows = result.data.rows
    true = synthetic.truth["on:0"].to_numpy()
    assert np.mean((rows[on_column("switching_load")] > 0.5) == (true > 0.5), where=rows["test"]) > 0.95
    kwh = result.summary["effects"][0]["state"]["kwh_by_trip"]
    for k, trip in enumerate(result.data.trip_names):
        energy = LOAD.power_w * float(np.sum((true * rows["duration_s"])[rows["trip"] == k])) / 3.6e6
        value, low, high = kwh[trip]
        assert low <= value <= high
        assert abs(value - energy) < 0.15 * energy + 0.02


def test_three_errors_are_kept_apart(found):
    synthetic, _, result = found
    after = result.summary["after"]
    assert after["given_states"]["rmse"] < 0.8 * after["test"]["rmse"]
    assert after["one_step"]["rmse"] < 0.8 * after["test"]["rmse"]
    # the headline is the free run, which knows no measured power
    free = hdev_jax.predict(synthetic.frame, result).rows["predicted"].to_numpy()
    error = (result.data.rows["measured"] - free)[result.data.rows["test"]]
    assert after["test"]["rmse"] == pytest.approx(float(np.sqrt(np.mean(error**2))))
    assert after["test"]["rmse"] < result.summary["before"]["test"]["rmse"]


def test_the_page_and_the_answer_say_it(found, tmp_path):
    _, _, result = found
    write_report(result.data, tmp_path)
    page = (tmp_path / "report.html").read_text()
    assert (tmp_path / "figures" / "switching_loads.png").stat().st_size > 10_000
    canvas = FigureCanvasAgg(switching_loads(result.data))  # of the page's figures, this one is drawn
    canvas.draw()
    assert np.ptp(np.asarray(canvas.buffer_rgba())) == 255
    assert "Loads that switch" in page
    assert "% of the time at" in str(result)
    assert "given the states" in str(result)
    breakdown = result.data.breakdown["after"]["switching_load"]
    kwh = result.summary["effects"][0]["state"]["kwh_by_trip"]
    test = sum(kwh[t][0] for t in result.summary["split"]["test_trips"])
    assert breakdown == pytest.approx(test, rel=0.03)
    json.dumps(result.summary, allow_nan=False)


@pytest.mark.parametrize("noise", ["white", "ar1", "walk", "student_t"])
def test_noise_has_no_levels(noise, short):
    rng = np.random.default_rng(1)
    trips, n = 8, 500
    steps = rng.standard_t(3, (trips, n)) if noise == "student_t" else rng.standard_normal((trips, n))
    kept = {"white": 0.0, "ar1": 0.95, "walk": 0.9999, "student_t": 0.9}[noise]
    x = np.zeros((trips, n))
    for t in range(1, n):
        x[:, t] = kept * x[:, t - 1] + steps[:, t]
    rows = StateRows(
        2e3 * (x / x.std()).ravel(), np.repeat(np.arange(trips), n), np.ones(trips * n), np.full(trips * n, 15.0),
        np.zeros(trips * n, int), 0.1,
    )  # fmt: skip
    result = level_test(rows, short[-1], rng)
    assert result is None or result.p * len(LIBRARY) > 0.05


@pytest.mark.parametrize("load_w", [6e3, 0.0])
def test_a_clear_answer_needs_few_surrogates(short, load_w):
    """A load that is far from noise, and noise: six in place of nineteen, and the answer is as clear."""

    class Counting(np.random.Generator):
        drawn = 0

        def choice(self, *args, **options):
            self.drawn += 1
            return super().choice(*args, **options)

    trips, n = 8, 400
    rng = np.random.default_rng(2)
    on = (np.arange(trips * n) // 45 % 2).astype(float)
    rows = StateRows(
        load_w * on + 500.0 * rng.standard_normal(trips * n), np.repeat(np.arange(trips), n), np.ones(trips * n),
        np.full(trips * n, 15.0), np.zeros(trips * n, int), 0.1,
    )  # fmt: skip
    counting = Counting(np.random.PCG64(0))
    result = level_test(rows, short[-1], counting)
    assert result is not None
    assert (result.p * len(LIBRARY) < 0.01) == (load_w > 0)
    assert 0 < counting.drawn <= 6 * trips


def test_a_power_that_is_missing_constant_or_short_gives_no_load(short):
    rng = np.random.default_rng(0)
    for residual in (np.zeros(500), np.full(500, 3e3), np.array([1.0, 2.0]), np.r_[np.nan, np.ones(499)]):
        n = len(residual)
        rows = StateRows(residual, np.zeros(n, int), np.ones(n), np.full(n, 15.0), np.ones(n, int))
        assert level_test(rows, short[-1], rng) is None


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


@pytest.mark.slow
def test_a_warm_up_beside_a_load_is_no_second_load(tmp_path):
    bare = synthetic_log(
        seed=525001, trips=12, rows_per_trip=190, mode="segments", entry="road", effects={"cabin_warmup": {}},
        ratio=1.0, noise="ar1",
    )  # fmt: skip
    files = with_loads(bare, [Load(20.9e3, kind="chain", share=0.4, dwell_s=90.0)], seed=525001).write(
        tmp_path, truth=False
    )
    split = split_trips(read_log([files["log"]]))
    library = {k: LIBRARY[k] for k in ("switching_load", "second_switching_load", "cabin_warmup")}
    problem = prepare(split.log, read_sheet(files["sheet"]))
    found = diagnosed(problem, split, library, seed=525001, settings=FEWER)
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


def test_a_load_of_standstill_alone_is_no_load_that_switches():
    rng, trips, n = np.random.default_rng(0), 10, 1200
    on = np.tile(np.arange(n) % 300 < 120, trips)
    model = Switching(np.array([6e3]), 0.0, np.full(2, 1e3), np.full((1, 4), 0.4), np.full(1, 120.0))
    said = []
    for standing in (on, np.tile(np.arange(n) % 200 < 80, trips)):
        rows = StateRows(
            6e3 * on + rng.normal(0, 1e3, trips * n), np.repeat(np.arange(trips), n), np.ones(trips * n),
            np.full(trips * n, 15.0), standing.astype(int), 0.1,
        )  # fmt: skip
        said.append(_unlike(rows, model, decode(model, rows), 0, clusters_of(rows.trip, rows.duration_s), SETTINGS))
    assert said == ["it does not switch at standstill", None]


def _clipped(power):
    return np.minimum(power, np.quantile(power, 0.7))


def _held(power):
    return np.where(np.arange(len(power)) // 200 == 1, power[199], power)  # a trip's length stands still


def test_a_load_that_was_decoded_is_kept_with_its_states(short):
    _, _, problem, rows = short
    state, _ = add_switching(replace(rows, settings=FEWER), declared(rows, problem), np.random.default_rng(0))
    assert state is not None
    plain = to_plain(state)
    again = to_plain(from_plain(plain, problem.vehicle, rows))
    assert again["hidden"]["ids"] == plain["hidden"]["ids"] == ("switching_load",)
    np.testing.assert_array_equal(again["hidden"]["on"], plain["hidden"]["on"])
    np.testing.assert_array_equal(again["hidden"]["model"]["power_w"], plain["hidden"]["model"]["power_w"])
    assert again["hidden"]["model"]["freedom"] == plain["hidden"]["model"]["freedom"]


@pytest.mark.parametrize(
    "spoilt", [lambda p: np.full_like(p, 5.0), _clipped, _held], ids=["constant", "clipped", "held"]
)
def test_a_power_that_is_no_measurement_gives_no_load(spoilt, short):
    frame, sheet, *_ = short
    spoilt_too = frame.assign(battery_power_kw=spoilt(frame["battery_power_kw"].to_numpy()))
    log = Log.from_frame(spoilt_too)
    problem = prepare(log, sheet)
    rows = training(problem, ("switching_load", "second_switching_load"))
    state, verdict = add_switching(rows, declared(rows, problem), np.random.default_rng(0))
    assert state is None
    assert np.isfinite(verdict.q_value)
    assert "nan" not in str(verdict.rejection)


def test_power_that_is_missing_for_minutes_is_refused_in_one_line_or_dropped(short):
    frame, *_ = short
    power = frame["battery_power_kw"].to_numpy().copy()
    power[240:360] = np.nan
    with pytest.raises(InputError, match="120 with battery_power_w missing") as error:
        Log.from_frame(frame.assign(battery_power_kw=power))
    assert "\n" not in str(error.value)
    power[280:360] = frame["battery_power_kw"].to_numpy()[280:360]  # 2 % of the rows are dropped: a gap in a trip
    log = Log.from_frame(frame.assign(battery_power_kw=power))
    assert len(log) == len(frame) - 40
    assert len(log.trip_names) == 13  # the rows after the gap are a trip of their own
    rows = rows_of(log.segments, log.measured["battery_power_w"], samples=True)
    decoded = decode(Switching(np.array([9e3]), 0.0, np.full(2, 4e3), np.full((1, 4), 0.4), np.full(1, 60.0)), rows)
    assert np.all(np.isfinite(decoded.on))
    assert np.isfinite(decoded.log_likelihood)


def test_two_rows_at_standstill_have_no_load(short):
    frame, sheet, *_ = short
    two = frame.iloc[:2].assign(**{c: 0.0 for c in frame if c.startswith(("speed", "motor", "distance"))})
    problem = prepare(Log.from_frame(two), sheet)
    rows = training(problem, ("switching_load", "second_switching_load"))
    state, verdict = add_switching(rows, declared(rows, problem), np.random.default_rng(0))
    assert state is None
    assert verdict is None or "nan" not in str(verdict.rejection)


def test_predicting_online_filters_along_the_log(found):
    synthetic, sheet, result = found
    assert result.predictive["states"]["ids"] == ["switching_load"]
    frame = synthetic.frame
    free, online = (hdev_jax.predict(frame, result, online=x) for x in (False, True))
    measured = frame["battery_power_kw"] if "battery_power_kw" in frame else frame["battery_power_w"] / 1e3
    error = {k: measured.to_numpy() - p.rows["predicted"].to_numpy() for k, p in (("free", free), ("online", online))}
    assert np.std(error["online"]) < 0.8 * np.std(error["free"])
    inside = (measured >= online.rows["lower"]) & (measured <= online.rows["upper"])
    assert 0.8 < inside.mean() < 0.97
    assert "one step ahead" in str(online)
    # what comes later changes nothing
    cut = frame[frame["trip_id"] == frame["trip_id"].iloc[0]].iloc[:200]
    part = hdev_jax.predict(cut, result, online=True).rows["predicted"].to_numpy()
    np.testing.assert_allclose(part[:-1], online.rows["predicted"].to_numpy()[:199], atol=1e-6)
    with pytest.raises(InputError, match="no load that switches"):
        hdev_jax.predict(frame, sheet, online=True)
    without = frame.drop(columns=[c for c in frame if c.startswith(("battery_power", "energy"))])
    with pytest.raises(InputError, match="does not measure"):
        hdev_jax.predict(without, result, target="battery_power_kw", online=True)
