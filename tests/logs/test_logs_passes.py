"""Passes of one road put together: against a road that is known, and where there is nothing to put together."""

import numpy as np
import pandas as pd
import pytest
from logs_helpers import read

from hdev_jax.logs.guesses import guess
from hdev_jax.logs.instruments import Slope, slope_of, smoother
from hdev_jax.logs.instruments.places import metres, places_of
from hdev_jax.verbs.check import check

LENGTH_M = 4000.0
GRID_M = np.arange(0.0, LENGTH_M + 1.0, 4.0)
NOISE_M = 3.0


def _slow(at: np.ndarray, sd: float, scale: float, rng: np.random.Generator) -> np.ndarray:
    """A Matérn-3/2 course, by the square root of its covariance."""
    lag = np.abs(np.subtract.outer(at, at)) / scale
    return np.linalg.cholesky(sd**2 * (1 + lag) * np.exp(-lag) + 1e-9 * np.eye(len(at))) @ rng.normal(size=len(at))


def passes(
    count: int = 10, *, seed: int = 0, noise: float = NOISE_M, drift: float = 0.0, position: float = 4.0
) -> pd.DataFrame:  # fmt: skip
    """Trips along a bent road at 1 Hz, every other one back; each altimeter is off by a level of its own."""
    rng = np.random.default_rng(seed)
    slope = _slow(GRID_M, 0.02, 150.0, rng)
    height = 300.0 + np.r_[0.0, np.cumsum(0.5 * (slope[1:] + slope[:-1]) * np.diff(GRID_M))]
    frames = []
    for k in range(count):
        speed = 10.0 + 4.0 * np.sin(np.arange(700) / 37.0 + rng.uniform(0, 6))
        way = np.cumsum(speed) - 0.5 * speed
        speed, way = speed[way < LENGTH_M], way[way < LENGTH_M]
        x = LENGTH_M - way if k % 2 else way
        turn = x / 800.0  # a curve of 800 m radius
        east, north = 800.0 * np.sin(turn), 800.0 * (1.0 - np.cos(turn))
        n = len(x)
        w = _slow(np.arange(n), drift, 60.0, rng) if drift else np.zeros(n)
        frames.append(
            pd.DataFrame(
                {
                    "trip_id": f"T{k}", "x": x, "time_s": np.arange(n), "speed_mps": speed,
                    "slope": np.interp(x, GRID_M, slope) * (-1.0 if k % 2 else 1.0), "battery_power_w": 500.0 * speed,
                    "altitude_m": np.interp(x, GRID_M, height) + rng.normal(0, 10.0) + w + rng.normal(0, noise, n),
                    "latitude_deg": 47.0 + np.degrees((north + rng.normal(0, position, n)) / 6_371_008.8),
                    "longitude_deg": 8.0
                    + np.degrees((east + rng.normal(0, position, n)) / 6_371_008.8 / np.cos(np.radians(47.0))),
                }
            )
        )  # fmt: skip
    return pd.concat(frames, ignore_index=True)


def told(frame: pd.DataFrame, *, place: bool = True) -> Slope:
    where = metres(frame.latitude_deg.to_numpy(), frame.longitude_deg.to_numpy()) if place else None
    found = slope_of(
        frame.trip_id.factorize()[0], frame.speed_mps.to_numpy(), np.ones(len(frame)), frame.altitude_m.to_numpy(),
        place=where,
    )  # fmt: skip
    assert found is not None
    return found


def errors(found: Slope, frame: pd.DataFrame) -> tuple[float, float]:
    """RMS of the slope's error, and of the error over its standard deviation."""
    e = np.tan(found.grade_rad) - frame.slope.to_numpy()
    return float(np.sqrt(np.mean(e**2))), float(np.sqrt(np.mean((e / found.sd_rad) ** 2)))


def test_ten_passes_halve_the_slopes_error_and_its_sd_says_so_and_without_a_place_twice_nothing_changes(monkeypatch):
    monkeypatch.undo()  # as many lanes as in use
    frame = passes()
    alone, every = told(frame, place=False), told(frame)
    assert every.repeated is not None
    assert every.repeated.cells > 0.9 * every.repeated.of
    assert every.repeated.passes == 10
    assert every.repeated.together_rad < every.repeated.alone_rad
    assert every.course.white == pytest.approx(NOISE_M, rel=0.1)
    one, (rms, z) = errors(alone, frame)[0], errors(every, frame)
    # of white noise the smoothed slope's variance goes with the root of the noise's: 10^(-1/4) = 0.56 of the error
    assert rms < 0.7 * one
    assert 0.8 < z < 1.25
    # each pass on a road of its own, and some trips without a position
    trip = frame.trip_id.str[1].astype(int)
    apart = frame.assign(latitude_deg=frame.latitude_deg + trip)
    apart.loc[trip > 7, ["latitude_deg", "longitude_deg"]] = 0.0
    same = told(apart)
    np.testing.assert_array_equal(same.grade_rad, alone.grade_rad)
    np.testing.assert_array_equal(same.sd_rad, alone.sd_rad)


def test_a_drift_that_one_pass_hides_is_found_by_many():
    frame = passes(noise=1.0, drift=4.0)
    one, every = told(frame, place=False), told(frame)
    assert errors(one, frame)[1] > 1.5  # taken for hills
    assert 2.0 < every.course.drift < 4.5
    assert errors(every, frame)[0] < 0.7 * errors(one, frame)[0]
    assert 0.8 < errors(every, frame)[1] < 1.25


def test_a_bridge_is_not_mixed_with_the_road_under_it(monkeypatch):
    monkeypatch.setattr(smoother, "SOME", 12)  # a lane for each pass
    over = passes(6, seed=4, position=2.0)
    under = passes(6, seed=4, position=2.0)
    under["trip_id"] = under.trip_id + "u"
    # down into an underpass of 7 m and up again
    off = under.x - 2000.0
    dip = 7.0 * np.exp(-0.5 * (off / 100.0) ** 2)
    back = np.where(under.trip_id.str[1].astype(int) % 2, -1.0, 1.0)
    under["altitude_m"] = under.altitude_m - dip + np.random.default_rng(5).normal(0, 1.0, len(under))
    under["slope"] = under.slope + back * dip * off / 100.0**2
    frame = pd.concat([over, under], ignore_index=True)
    one, every = told(frame, place=False), told(frame)
    assert every.repeated is not None
    assert every.repeated.disagree > 30
    near = (np.abs(frame.x - 2000.0) < 250.0).to_numpy()

    def error(s: Slope) -> float:
        return float(np.sqrt(np.mean((np.tan(s.grade_rad) - frame.slope)[near] ** 2)))

    assert error(every) < 0.75 * error(one)


def test_exact_altitudes_stay_each_passes_own():
    """Positions are wrong by more than the altitude is: what another pass reads is worse than its own."""
    frame = passes(4, noise=0.01)
    found = told(frame)
    np.testing.assert_array_equal(found.grade_rad, told(frame, place=False).grade_rad)


def test_check_shows_the_passes(tmp_path):
    frame = passes(6).drop(columns=["x", "slope"])
    log = read(tmp_path, frame.rename(columns={"latitude_deg": "latitude", "longitude_deg": "longitude"}))
    line = next(x for x in check(log).splitlines() if x.startswith("  altitude: "))
    assert "more than once, 6 times in the median" in line
    assert "% from one pass" in line
    assert any("passed more than once" in e.reason and e.column == "grade_rad" for e in log.ledger)
    # positions are no channel of the model
    assert not log.segments.has("latitude_deg")
    assert any("positions" in e.reason for e in log.ledger)


def test_laps_of_one_trip_are_passes():
    way = np.arange(0.0, 3 * 1200.0, 15.0)
    turn = 2 * np.pi * way / 1200.0
    ring = 1200.0 / (2 * np.pi) * np.c_[np.sin(turn), 1.0 - np.cos(turn)]
    found = places_of(np.zeros(len(way), int), way, ring + np.random.default_rng(0).normal(0, 1.0, ring.shape), 20.0)
    assert found is not None
    assert found.sd_m == pytest.approx(1.0, rel=0.3)
    assert np.all(found.place >= 0)
    assert np.all(np.bincount(found.place) >= 3)
    assert np.all(np.abs(found.ahead_m) <= 20.0)
    once = slice(0, 80)
    assert places_of(np.zeros(80, int), way[once], 5.0 * ring[once], 20.0) is None
    assert places_of(np.zeros(len(way), int), way, metres(0.0 * way, 0.0 * way), 20.0) is None


def test_positions_that_are_none_are_none():
    place = metres(np.array([47.0, 0.0, np.nan, 47.001, 91.0]), np.array([8.0, 0.0, 8.0, 8.0, 8.0]))
    np.testing.assert_array_equal(np.isfinite(place[:, 0]), [True, False, False, True, False])
    assert place[3, 1] - place[0, 1] == pytest.approx(111.195, abs=0.01)  # a thousandth of a degree of latitude
    both = metres(np.array([0.5, 0.5]), np.array([179.9999, -179.9999]))
    assert abs(both[1, 0] - both[0, 0]) < 30.0


@pytest.mark.parametrize("header", ["Latitude", "lat", "GPS Latitude", "Latitude[deg]", "latitude_rad", "Lat (deg)"])
def test_headers_of_positions_are_guessed(header):
    found = guess(header)
    assert found is not None
    assert found.name == "latitude_deg"
    assert found.unit == ("rad" if "rad" in header else "deg")
    other = guess(header.replace("Lat", "Long").replace("lat", "long"))
    assert other is not None
    assert other.name == "longitude_deg"


@pytest.mark.parametrize("header", ["lat_accel", "Long Acceleration", "long"])
def test_what_is_along_or_across_the_vehicle_is_no_position(header):
    found = guess(header)
    assert (found is not None and found.name == "longitude_deg") == (header == "long")


def test_two_passes_help_each_other():
    frame = passes(2, seed=1)
    alone, both = told(frame, place=False), told(frame)
    assert both.repeated is not None
    assert both.repeated.disagree < 0.05 * both.repeated.cells
    assert errors(both, frame)[0] < 0.9 * errors(alone, frame)[0]


@pytest.mark.parametrize("kind", ["one trip six times", "a map's errors"])
def test_what_all_passes_are_off_by_is_not_taken_for_road(kind):
    """Passes that differ by nothing are no better than one."""
    if kind == "one trip six times":
        once = passes(1, seed=1)
        frame = pd.concat([once.assign(trip_id=f"T{k}") for k in range(6)], ignore_index=True)
    else:
        frame = passes(6, seed=1, noise=0.0)
        at = np.arange(0.0, LENGTH_M + 1.0, 30.0)
        frame["altitude_m"] += np.interp(frame.x, at, np.random.default_rng(4).normal(0, 1.0, len(at)))
    alone, together = told(frame, place=False), told(frame)
    assert errors(together, frame)[0] < 1.2 * errors(alone, frame)[0]
    assert errors(together, frame)[1] < 1.5 * errors(alone, frame)[1]
