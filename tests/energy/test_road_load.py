"""A, B and C: of a vehicle exactly, from driving, and from coast-downs with wind and slope."""

from dataclasses import replace

import numpy as np
import pytest

from hdev_jax.energy.coastdown import coast_down, directions_of, is_coast_down
from hdev_jax.energy.fitted import Fitted, calibrated_on
from hdev_jax.energy.road_load import SHOWN_KMH, in_service, open_sheet
from hdev_jax.errors import InputError
from hdev_jax.fleet import synthetic_log
from hdev_jax.inference.sheet import sheet_of_sections
from hdev_jax.logs import Log
from hdev_jax.problem import prepare
from hdev_jax.segments import WITHIN_ROWS, Segments

SHEET = {
    "mass_kg": 29e3,
    "road": {"c_rr": (0.0060, 0.0008), "cda_m2": (5.6, 0.5)},
    "driveline": {"efficiency": 0.91},
    "battery": {"auxiliary_w": 0.0},
}
TRUE = np.array([180.0, 1.5, 0.42])  # N, N/(m/s), N/(m/s)²: a car
MASS_KG, ROTATING = 1600.0, 1.03
G, RHO = 9.80665, 1.225


def runs(seed: int, *, sets: int = 1, wind: float = 2.0, gust: float = 0.3, slope: float = 0.002) -> list[Log]:
    """So many coast-downs of eight runs both ways, 1 Hz, speeds with noise of 0.05 m/s; integrated all at once."""
    rng = np.random.default_rng(seed)
    way = np.where(np.arange(8) % 2 == 0, 1.0, -1.0)
    along = way * (wind + gust * rng.normal(size=(sets, 8)))
    v, kept = np.full((sets, 8), 34.0), [np.full((sets, 8), 34.0)]
    for step in range(1, 10 * 140):
        air = v + along
        force = TRUE[0] + TRUE[1] * v + TRUE[2] * air * np.abs(air) + MASS_KG * G * np.sin(way * slope)
        v = np.maximum(v - 0.1 * force / (MASS_KG * ROTATING), 0.0)
        if step % 10 == 0:
            kept.append(v)
    speed = np.stack(kept, axis=2)
    speed = np.maximum(speed + 0.05 * rng.normal(size=speed.shape), 0.0)
    n = speed.shape[2] - 1
    heading = np.repeat(np.where(way > 0, 0.3, 0.3 + np.pi), n)
    out = []
    for one in speed:
        ends = one[:, :-1].ravel(), one[:, 1:].ravel()
        rows = Segments.from_arrays(
            duration_s=np.ones(8 * n), speed_start_mps=ends[0], speed_end_mps=ends[1], trip=np.repeat(np.arange(8), n),
            heading_rad=heading,
        )  # fmt: skip
        out.append(Log(rows, {}, tuple(f"run {k}" for k in range(8)), ("car",)))
    return out


def test_coast_downs_with_wind_and_slope_are_covered():
    inside, off = [], []
    for log in runs(0, sets=100):
        load = coast_down(log, MASS_KG, ROTATING)
        inside.append((load.lower <= TRUE) & (load.upper >= TRUE))
        off.append(load.abc - TRUE)
    assert np.all(np.abs(np.mean(inside, axis=0) - 0.9) < 0.055)  # 90 %, give or take the chance of 100
    bias = np.mean(off, axis=0) / np.std(off, axis=0)
    assert np.all(np.abs(bias) < 0.35)


def test_a_run_the_other_way_takes_wind_and_slope_off():
    (one_way,) = runs(1)
    only = one_way.take(one_way.trip % 2 == 0)
    both, alone = coast_down(one_way, MASS_KG, ROTATING), coast_down(only, MASS_KG, ROTATING)
    assert abs(both.abc[0] - TRUE[0]) < 3.0
    assert alone.abc[0] - TRUE[0] > 20.0  # the slope is in it
    assert any("one way" in note for note in alone.notes)


def test_weather_that_is_logged_is_corrected():
    (calm,) = runs(2, wind=0.0, gust=0.0, slope=0.0)
    s = calm.segments
    n = len(s)
    warm = Log(
        s.with_channels(ambient_temp_c=np.full(n, 30.0), air_density_kgpm3=np.full(n, 1.1)),
        {},
        calm.trip_names,
        ("car",),
    )
    plain, corrected = coast_down(calm, MASS_KG, ROTATING), coast_down(warm, MASS_KG, ROTATING)
    np.testing.assert_allclose(corrected.abc[:2] / plain.abc[:2], 1.0 + 8.6e-3 * 10.0, rtol=1e-6)
    np.testing.assert_allclose(corrected.abc[2] / plain.abc[2], RHO / 1.1, rtol=1e-6)


def test_too_few_runs_are_refused_and_a_drive_is_no_coast_down():
    (log,) = runs(3)
    with pytest.raises(InputError, match="runs by direction: 2 and 1"):
        coast_down(log.take(log.trip < 3), MASS_KG, ROTATING)
    with pytest.raises(InputError, match="usable coast-down runs"):
        coast_down(log.take(log.trip < 1), MASS_KG, ROTATING)
    assert is_coast_down(log)
    driven = synthetic_log(seed=2, trips=8, rows_per_trip=60).frame
    assert not is_coast_down(Log.from_frame(driven))
    with pytest.raises(
        InputError, match=r"trip 'T01' is not a coast-down: it gains .* m/s beyond what the slope gives"
    ):
        coast_down(Log.from_frame(driven.drop(columns=["energy_wh"])), 29e3, 1.0)


def test_a_drive_whose_mean_force_holds_it_back_is_no_coast_down():
    (log,) = runs(4)
    s = log.segments
    t = np.asarray(s.time_s)
    start, end = (np.asarray(v) + np.where((log.trip == 1) & (t + k > 20), 4.0, 0.0)  # somebody steps on it once
                  for k, v in ((0, s.speed_start_mps), (1, s.speed_end_mps)))  # fmt: skip
    pushed = Segments.from_arrays(
        duration_s=np.ones(len(t)), speed_start_mps=start, speed_end_mps=end, trip=log.trip, **s.channels
    )
    with pytest.raises(InputError, match=f"trip '{log.trip_names[1]}' is not a coast-down: it gains"):
        coast_down(Log(pushed, {}, log.trip_names, log.vehicle_names), MASS_KG, ROTATING)


def test_directions_without_a_heading_alternate():
    signs, how = directions_of(runs(0)[0].segments.without("heading_rad"))
    assert list(signs[:4]) == [1.0, -1.0, 1.0, -1.0]
    assert "every other run" in how


# --- from driving ----------------------------------------------------------------------------------------------------


def problem_of(seed: int, sheet: dict):
    log = synthetic_log(seed=seed, trips=9, rows_per_trip=80, noise_level=0.02)
    opened, _ = open_sheet(sheet_of_sections(sheet), 25e3)
    return log, prepare(Log.from_frame(log.frame), opened)


@pytest.mark.parametrize("by_distance", [False, True])
def test_the_load_of_a_vehicle_is_its_coefficients(by_distance):
    """At a steady speed, whatever varied inside rows that were put together by distance."""
    _, problem = problem_of(3, {**SHEET, "road": {**SHEET["road"], "b_n_per_mps": 12.0}})
    if by_distance:
        inside = {k: np.linspace(1.0, 200.0, len(problem.segments)) for k in WITHIN_ROWS}
        problem = replace(problem, segments=problem.segments.with_channels(**inside))
    known = Fitted(problem, problem.vehicle, 1e-18 * np.eye(len(problem.table.free)), 200.0, None, "known")
    load = in_service(known, 20e3)
    np.testing.assert_allclose(load.abc, [0.006 * 20e3 * G, 12.0, 0.5 * RHO * 5.6], rtol=1e-9)
    k = list(load.speeds_kmh).index(50.0)
    np.testing.assert_allclose(load.force[k], load.abc @ (50 / 3.6) ** np.arange(3), rtol=1e-9)


def test_driving_tells_the_force_within_its_interval():
    off, inside = [], []
    for seed in range(12):
        log, problem = problem_of(40 + seed, SHEET)
        load = in_service(calibrated_on(problem), 25e3)
        true = [log.vehicle.c_rr * 25e3 * G, 0.0, 0.5 * RHO * log.vehicle.cda_m2]
        for kmh in SHOWN_KMH:
            k, force = list(load.speeds_kmh).index(kmh), np.dot(true, (kmh / 3.6) ** np.arange(3))
            off.append(abs(load.force[k] / force - 1.0))
            inside.append(load.force_lower[k] <= force <= load.force_upper[k])
    assert np.median(off) < 0.03
    assert np.mean(inside) > 0.75
    assert any("driveline.efficiency is not estimated" in note for note in load.notes)


def test_what_a_table_says_of_the_load_is_opened_and_it_is_said():
    opened, notes = open_sheet(sheet_of_sections({**SHEET, "road": {"c_rr": 0.006, "cda_m2": (5.6, 0.5)}}), 20e3)
    assert opened.declared["road.c_rr"].sd == pytest.approx(0.003)
    assert opened.declared["road.cda_m2"].sd == pytest.approx(2.8)
    assert any("road.c_rr is estimated from this log, as 0.006 ± 0.003" in note for note in notes)
    assert opened.declared["battery.auxiliary_w"].sd > 0
    with pytest.raises(InputError, match=r"road.cda_m2 is missing"):
        open_sheet(sheet_of_sections({**SHEET, "road": {"c_rr": 0.006}}), 20e3)
