"""Where energy goes, what a change costs and saved: identities, and intervals that hold planted truth."""

from dataclasses import replace

import numpy as np
import pytest

from hdev_jax.energy.causes import by_cause
from hdev_jax.energy.change import changed, idle, parse_changes
from hdev_jax.energy.compare import compare_sheets, compare_trips
from hdev_jax.energy.fitted import Fitted, calibrated_on, forgotten
from hdev_jax.energy.ledger import TOTAL, TRACTION_REST, UNEXPLAINED, ledger_of
from hdev_jax.energy.saved import circumstances, saving, trips_of
from hdev_jax.errors import InputError
from hdev_jax.fleet import synthetic_log
from hdev_jax.inference.sheet import sheet_of_sections
from hdev_jax.logs import Log
from hdev_jax.problem import Problem, prepare

TRIPS, ROWS = 9, 80
SHEET = {
    "name": "truck (synthetic)",
    "mass_kg": 29e3,
    "road": {"c_rr": (0.0060, 0.0008), "cda_m2": (5.6, 0.5)},
    "driveline": {"efficiency": 0.91},
    "battery": {"auxiliary_w": (2500.0, 1500.0)},
}
TRUE_AUXILIARY_W = 3000.0


def made(seed: int, *, trips: int = TRIPS, noise: float = 0.03):
    """A log with an auxiliary load, and what was true."""
    planted = {"auxiliary_power": {"power_w": TRUE_AUXILIARY_W}}
    log = synthetic_log(seed=seed, trips=trips, rows_per_trip=ROWS, effects=planted, noise_level=noise)
    return log, prepare(Log.from_frame(log.frame), sheet_of_sections(SHEET))


@pytest.fixture(scope="module")
def fitted() -> Fitted:
    return calibrated_on(made(3)[1])


@pytest.fixture(scope="module")
def ledger(fitted):
    return ledger_of(fitted, price=0.5)


# --- ledger ----------------------------------------------------------------------------------------------------------


def test_every_block_of_the_ledger_adds_up_to_what_was_measured(fitted, ledger):
    measured = float(np.sum(fitted.problem.measured)) / 1e3
    for _, block in ledger.rows.groupby(["level", "name"]):
        by = block.set_index("cause")["kwh"]
        np.testing.assert_allclose(by.drop(TOTAL).sum(), by[TOTAL], rtol=1e-9, atol=1e-9)
    totals = ledger.rows[ledger.rows["cause"] == TOTAL].groupby("level")["kwh"].sum()
    np.testing.assert_allclose([totals["all"], totals["trip"]], measured, rtol=1e-9)


def test_what_is_unexplained_is_measured_less_predicted(fitted, ledger):
    left = ledger.rows[(ledger.rows["level"] == "trip") & (ledger.rows["cause"] == UNEXPLAINED)]["kwh"].to_numpy()
    off = np.bincount(fitted.problem.log.trip, weights=fitted.problem.measured - fitted.predicted) / 1e3
    np.testing.assert_allclose(left, off, rtol=1e-6, atol=1e-9)


def test_shares_and_cost_follow_the_energy(ledger):
    whole = ledger.rows[ledger.rows["level"] == "all"]
    np.testing.assert_allclose(whole["cost"], 0.5 * whole["kwh"])
    np.testing.assert_allclose(whole["share_percent"].iloc[:-1].sum(), 100.0)
    known = whole[whole["cause"].isin(["grade", "inertia"])]  # nothing in them is estimated
    np.testing.assert_allclose(known["lower"], known["upper"], rtol=1e-12)


def test_a_load_of_so_many_watts_takes_so_many_hours_of_it(fitted, ledger):
    hours = float(np.sum(np.asarray(fitted.problem.segments.duration_s))) / 3600
    row = ledger.rows[(ledger.rows["level"] == "all") & (ledger.rows["cause"] == "auxiliary")].iloc[0]
    auxiliary = float(fitted.vehicle.effect("auxiliary").auxiliary_w)
    np.testing.assert_allclose(row["kwh"], auxiliary * hours / 1e3, rtol=1e-9)
    assert ledger.about["auxiliary_kwh"].iloc[0] == pytest.approx(row["kwh"])


def test_stops_regeneration_and_weeks_by_hand():
    day = 86_400
    speed = [10.0] * 4 + [0.0] * 8 + [10.0] * 4
    power = [40.0] * 2 + [-10.0] * 2 + [3.0] * 8 + [20.0] * 4
    frame = {"trip_id": ["a"] * 16 + ["b"] * 16, "speed_mps": speed * 2, "battery_power_kw": power * 2}
    start = np.datetime64("2024-01-05T10:00:00")  # a Friday
    first = start + (np.arange(16) * 60).astype("timedelta64[s]")
    frame["time"] = np.concatenate([first, first + np.timedelta64(3 * day, "s")])
    log = Log.from_frame(frame)
    ledger = ledger_of(calibrated_on(prepare(log, sheet_of_sections(SHEET))))
    one = ledger.about[ledger.about["name"] == "a"].iloc[0]
    assert one["regenerated_percent"] == pytest.approx(100 * 2 * 10 / (2 * 40 + 8 * 3 + 4 * 20))
    assert one["parked_kwh"] == pytest.approx(8 * 3 / 60, rel=0.2)  # the samples at its ends are partly driving
    assert list(ledger.about[ledger.about["level"] == "week"]["name"]) == ["2024-W01", "2024-W02"]
    assert ledger.undated == 0


def test_intervals_of_causes_hold_what_was_planted():
    inside = []
    for seed in range(25):
        log, problem = made(100 + seed)
        found = calibrated_on(problem)
        true = {
            "road.c_rr": log.vehicle.c_rr,
            "road.cda_m2": log.vehicle.cda_m2,
            "battery.auxiliary_w": TRUE_AUXILIARY_W,
        }
        theta = np.array([true[c.name] for c in problem.table.free])
        truth = by_cause(found, theta[None]).value.sum(axis=0)
        rows = ledger_of(found).rows
        rows = rows[rows["level"] == "all"].iloc[: len(truth)]
        open_ = (rows["lower"] < rows["upper"]).to_numpy()
        inside += list(((rows["lower"] <= truth) & (truth <= rows["upper"])).to_numpy()[open_])
    assert len(inside) == 100
    assert 0.78 <= np.mean(inside) <= 0.98  # 90 %, give or take the chance of 25 logs


def test_measured_traction_is_told_by_road_forces_and_the_sum_stays():
    log = synthetic_log(seed=5, trips=TRIPS, rows_per_trip=ROWS, entry="wheel", noise_level=0.02)
    machine = {"motoring_efficiency": (0.93, 0.05), "regenerating_efficiency": (0.93, 0.05)}
    sheet = sheet_of_sections({"mass_kg": 29e3, "road": SHEET["road"], "machine": machine})
    frame = Log.from_frame(log.frame)
    fitted = calibrated_on(prepare(frame, sheet))
    road = calibrated_on(prepare(frame, sheet, "traction_force_n"))
    one, two = (ledger_of(fitted, road=r).rows.query("level == 'all'").set_index("cause") for r in (None, road))
    assert "rolling" not in one.index
    assert {"rolling", "aero", "grade", "inertia", TRACTION_REST} <= {*two.index}
    told = two["kwh"][["rolling", "aero", "grade", "inertia", TRACTION_REST]].sum()
    assert told == pytest.approx(one.loc["traction", "kwh"])
    assert abs(two.loc[TRACTION_REST, "kwh"]) < 0.02 * told  # the force of this log is what the road asks for
    hours = np.asarray(frame.segments.duration_s) / 3600
    rolling = log.vehicle.c_rr * 9.80665 * np.asarray(frame.segments.channels["mass_kg"])
    kwh = float(np.sum(rolling * np.asarray(frame.segments.speed_mps) * hours)) / 1e3
    assert two.loc["rolling", "kwh"] == pytest.approx(kwh, rel=0.02)


def test_each_vehicle_of_a_log_has_a_block(fitted):
    log = fitted.problem.log
    second = (log.trip >= 4).astype(np.int32)
    segments = replace(log.segments, vehicle=second)
    two = replace(log, segments=segments, vehicle_names=("one", "two"))
    problem = replace(fitted.problem, log=two, segments=replace(fitted.problem.segments, vehicle=second))
    rows = ledger_of(replace(fitted, problem=problem)).rows
    by = rows[rows["cause"] == TOTAL].set_index(["level", "name"])["kwh"]
    assert by["vehicle", "one"] + by["vehicle", "two"] == pytest.approx(by["all", "all"])
    assert by["vehicle", "one"] == pytest.approx(sum(by["trip", f"T0{k}"] for k in (1, 2, 3, 4)))


def test_a_ledger_is_of_battery_energy(fitted):
    force = replace(fitted, problem=replace(fitted.problem, target="traction_force_n"))
    with pytest.raises(InputError, match="battery energy or power"):
        ledger_of(force)


# --- what if ---------------------------------------------------------------------------------------------------------


def energy(problem: Problem, fitted: Fitted, sheet: dict) -> float:
    """kWh of the trips by another sheet at the same estimates."""
    return float(np.sum(problem.predict(prepare(problem.log, sheet_of_sections(sheet)).vehicle))) / 1e3


def test_a_change_is_what_another_sheet_predicts(fitted):
    problem = fitted.problem
    as_fitted = {
        **SHEET,
        "road": {"c_rr": float(fitted.vehicle.rolling()), "cda_m2": float(fitted.vehicle.effect("aero").cda_m2)},
        "battery": {"auxiliary_w": float(fitted.vehicle.effect("auxiliary").auxiliary_w)},
    }
    other = {**as_fitted, "road": {**as_fitted["road"], "c_rr": 0.9 * as_fitted["road"]["c_rr"]}}
    found = changed(fitted, parse_changes(problem, ["road.c_rr=-10%"]))
    np.testing.assert_allclose(
        found.by.value.sum(), energy(problem, fitted, other) - energy(problem, fitted, as_fitted), rtol=1e-6
    )
    np.testing.assert_allclose(found.after.value.sum(), energy(problem, fitted, other), rtol=1e-9)


def test_mass_of_the_log_and_weather_can_change(fitted):
    problem = fitted.problem
    steps = parse_changes(problem, ["mass_kg=+500", "ambient_temp_c=-10", "battery.auxiliary_w=1e3"])
    found = changed(fitted, steps)
    heavier = problem.segments.with_channels(mass_kg=np.asarray(problem.segments.channels["mass_kg"]) + 500.0)
    rolling = fitted.vehicle.breakdown(heavier)["rolling"].sum() / 1e3
    by = dict(zip(found.after.causes, found.after.value.sum(axis=0), strict=True))
    np.testing.assert_allclose(by["rolling"], rolling, rtol=1e-9)
    hours = np.sum(np.asarray(problem.segments.duration_s)) / 3600
    np.testing.assert_allclose(by["auxiliary"], hours, rtol=1e-9)
    spread = found.after.drawn[..., found.after.causes.index("auxiliary")].sum(axis=1).std()
    assert spread == pytest.approx(0.0, abs=1e-9)  # a new value is certain


def test_a_channel_that_no_effect_needs_changes_nothing_and_is_found(fitted):
    steps = parse_changes(fitted.problem, ["ambient_temp_c=-10", "mass_kg=+500", "road.c_rr=-10%"])
    assert [s.key for s in idle(fitted, steps)] == ["ambient_temp_c"]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("road.crr=-10%", "did you mean 'road.c_rr'"),
        ("road.c_rr=10%", "has a sign"),
        ("road.c_rr=5", "up to 0.5"),
        ("road.c_rr", "KEY=VALUE is expected"),
        ("speed_start_mps=+1", "stay as driven"),
        ("machine.motoring_efficiency=0.9", "is not in use here"),
        ("mass_kg=-100%", "above 0"),
        ("grade_rad=3", "-0.8 or more and up to 0.8"),
        ("ambient_temp_c=-300", "-90 or more"),
    ],
)
def test_what_is_no_change_is_refused(fitted, text, said):
    with pytest.raises(InputError, match=said) as caught:
        parse_changes(fitted.problem, [text])
    assert "\n" not in str(caught.value)


# --- saved -----------------------------------------------------------------------------------------------------------


def test_a_planted_saving_is_found_and_where_nothing_changed_none_is():
    found = {share: [] for share in (0.0, 0.06)}
    for seed in range(20):
        log, problem = made(300 + seed, trips=12, noise=0.01)
        before = calibrated_on(problem, range(6))  # what is saved later is none of its business
        half = problem.log.trip >= 6
        for share, results in found.items():
            measured = problem.measured - np.where(half, share * log.truth["noise_free"], 0.0)
            results.append(saving(replace(before, problem=replace(problem, measured=measured)), tuple(range(6, 12))))
    held = {share: [s.lower <= share <= s.upper for s in results] for share, results in found.items()}
    assert sum(held[0.0]) >= 15
    assert sum(held[0.06]) >= 15
    assert sum(s.shown for s in found[0.06]) >= 15
    assert np.mean([s.share for s in found[0.06]]) == pytest.approx(0.06, abs=0.012)


def test_what_would_settle_it_shrinks_with_what_is_saved(fitted):
    later = (6, 7, 8)
    before = calibrated_on(fitted.problem, range(6))
    small = saving(before, later)
    table = small.trips
    np.testing.assert_allclose(table["expected_kwh"] - table["measured_kwh"], table["saved_kwh"])
    assert small.expected_kwh == pytest.approx(table["expected_kwh"].sum())
    less = replace(fitted.problem, measured=0.99 * fitted.problem.measured)
    more = saving(replace(before, problem=less), later)
    assert more.share == pytest.approx(small.share + 0.01 * (1 - small.share), abs=1e-6)
    with pytest.raises(InputError, match="at least 2"):
        saving(before, (6,))


def test_what_a_log_told_is_forgotten_before_a_calibration_on_part_of_it():
    from_log = {"value": 0.0061, "sd": 0.0001, "estimated": True}
    sheet = sheet_of_sections({**SHEET, "road": {"c_rr": from_log, "cda_m2": (5.6, 0.5)}})
    opened, (note,) = forgotten(sheet)
    assert opened.declared["road.c_rr"].sd == pytest.approx(0.5 * 0.0061)
    assert opened.declared["road.cda_m2"] == sheet.declared["road.cda_m2"]
    assert "road.c_rr of the sheet came from a log" in note
    assert forgotten(opened_table := sheet_of_sections(SHEET)) == (opened_table, [])


def test_what_else_changed_is_in_standard_deviations_of_trips(fitted):
    problem = fitted.problem
    warm = np.where(problem.log.trip >= 5, 10.0, 0.0) + problem.log.trip
    problem = replace(problem, segments=problem.segments.with_channels(ambient_temp_c=warm))
    rows = circumstances(problem, (0, 1, 2), (5, 6, 7)).set_index("what")
    assert rows.loc["outside temperature", "difference_sd"] == pytest.approx(15.0)
    assert rows.loc["outside temperature", "differs"]


def test_trips_by_names_order_and_dates(fitted):
    log = fitted.problem.log
    assert trips_of(log, "T02,T04", "--after") == (1, 3)
    assert trips_of(log, "T02..T04", "--after") == (1, 2, 3)
    assert trips_of(log, "..T02", "--after") == (0, 1)
    assert trips_of(log, "T08..", "--after") == (7, 8)
    dated = replace(log, started_s={name: 86_400.0 * k for k, name in enumerate(log.trip_names)})
    assert trips_of(dated, "1970-01-02..1970-01-03", "--after") == (1, 2)
    assert trips_of(dated, "1970-01-08..", "--after") == (7, 8)
    for text, said in (("T2..T04", "T02"), ("2024-01-01..", "no date"), ("T04..T02", "no trip of the log")):
        with pytest.raises(InputError, match=said):
            trips_of(log, text, "--after")
    for text, said in (
        ("1970-01-02..T05", "T05 is a trip and 1970-01-02 a day; two of a kind are expected"),
        ("..1970-01-03T12:00", "no trip of the log and no day; 2024-03-31 is expected"),
        ("..03.01.1970", "no trip of the log and no day"),
    ):
        with pytest.raises(InputError, match=said):
            trips_of(dated, text, "--after")


# --- compare ---------------------------------------------------------------------------------------------------------


def test_differences_of_two_trips_add_up_and_turn_around(fitted):
    table = compare_trips(fitted, (0,), (4,)).set_index("cause")
    np.testing.assert_allclose(table["difference"].drop(TOTAL).sum(), table["difference"][TOTAL], rtol=1e-9)
    back = compare_trips(fitted, (4,), (0,)).set_index("cause")
    np.testing.assert_allclose(back["difference"], -table["difference"], rtol=1e-12)
    np.testing.assert_allclose(table["a"][TOTAL], back["b"][TOTAL])


def test_two_sheets_differ_where_they_differ(fitted):
    thick = {**SHEET, "road": {**SHEET["road"], "cda_m2": (6.6, 0.5)}}
    sheets = []
    for sections in (SHEET, thick):
        problem = prepare(fitted.problem.log, sheet_of_sections(sections))
        sds = np.diag([c.sd**2 for c in problem.table.free])
        sheets.append(Fitted(problem, problem.vehicle, sds, 200.0, None, "as the sheet says"))
    table = compare_sheets(*sheets).set_index("cause")
    moved = table.index[table["difference"].abs() > 1e-9]
    assert set(moved) == {"aero", "driveline", UNEXPLAINED}
    np.testing.assert_allclose(table["difference"].drop(TOTAL).sum(), 0.0, atol=1e-9)
    assert table.loc["aero", "b"] / table.loc["aero", "a"] == pytest.approx(6.6 / 5.6)
    assert table.loc["rolling", "lower"] == table.loc["rolling", "upper"] == 0.0, "what both know alike is the same"
    assert table.loc["aero", "lower"] < table.loc["aero", "difference"] < table.loc["aero", "upper"]
    itself = compare_sheets(sheets[0], sheets[0])[["difference", "lower", "upper"]]
    assert np.all(itself == 0.0)
