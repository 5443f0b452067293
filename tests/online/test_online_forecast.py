"""The rest of the way: one large Gaussian says the same, intervals hold what comes, batteries run out."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from online_rows import CHANNELS, NOISE_KW, begun, drive, sheet, vectors
from test_online_update import columns

from hdev_jax.fleet import synthetic_log
from hdev_jax.online import Forecast, forecast, scan, start
from hdev_jax.online.form import COUNTS

SIZES = np.array([8.0, 3.0])  # of levels: kW, 100 N
TAU_S = 300.0


def given(y, columns_all, covariance, past, weight):
    """Mean and variance of the weighed sum of the rows after `past`, by conditioning one Gaussian over all rows."""
    whole = columns_all @ columns_all.T + covariance
    seen, ahead = whole[:past, :past], weight @ whole[past:, :past]
    gain = np.linalg.solve(seen, ahead)
    return gain @ y[:past], weight @ whole[past:, past:] @ weight - gain @ ahead


@pytest.mark.parametrize("kind", ["correlated rows", "levels"])
def test_it_is_what_one_gaussian_over_all_rows_says(kind):
    segments, y = drive(100, rho=0.8)
    hours = np.asarray(segments.duration_s) / 3600.0
    if kind == "levels":  # of sizes that are known: as after a great many trips
        state = begun(memories=(0.0,), levels=True, lasting_s=(TAU_S,))
        many = state.counts.at[COUNTS.index("trips")].set(1e9)
        state = eqx.tree_at(lambda s: (s.counts, s.level_squares), state, (many, jnp.asarray(SIZES**2 * 1e9)))
    else:
        state = begun(memories=(0.8,))
    rows = vectors(state.form, segments, y)
    x, r = columns(state, rows)
    apart = np.abs(np.subtract.outer(np.arange(100), np.arange(100)))
    if kind == "levels":
        levels, x = x[:, 2:] * SIZES, x[:, :2]
        covariance = NOISE_KW**2 * np.eye(100) + levels @ levels.T * np.exp(-5.0 * apart / TAU_S)
    else:
        covariance = NOISE_KW**2 / (1 - 0.64) * 0.8**apart
    base = np.sum((y - r)[60:] * hours[60:]) * 1e3
    mean, variance = given(r, x, covariance, 60, hours[60:] * 1e3)
    told = forecast(scan(state, rows[:60])[0], rows[60:])
    assert told.energy_wh == pytest.approx(base + mean, rel=1e-6)
    assert told.scale == pytest.approx(np.sqrt(variance), rel=1e-4 if kind == "levels" else 1e-6)


def test_half_trip_forecasts_of_a_fleet_hold_what_comes():
    """Three vehicles with unknown coefficients, correlated noise and an error that each trip has of its own."""
    inside, scales = [], []
    for seed in range(3):
        made = synthetic_log(seed=seed, trips=20, rows_per_trip=80, noise="trip_levels", ar_coefficient=0.8)
        frame = made.frame
        of = sheet(mass_kg=29e3)
        state = start(of, CHANNELS)[0]
        named = {"measured": frame["energy_wh"], "trip": frame["trip_id"].str[1:].astype(float)}
        rows = np.stack([np.asarray(named.get(c, frame.get(c)), float) for c in state.form.columns], axis=1)
        for trip in np.unique(rows[:, 0]):
            own = rows[rows[:, 0] == trip]
            half = len(own) // 2
            first, second = own[:half], own[half:]
            state = scan(state, _padded(first))[0]
            told = forecast(state, second)
            quarter = forecast(state, second[len(second) // 2 :])
            low, high = told.interval_wh
            inside.append(low <= second[:, 6].sum() <= high)
            scales.append(told.scale > quarter.scale)
            state = scan(state, _padded(second))[0]
    assert 0.85 <= np.mean(inside) <= 0.97, np.mean(inside)
    assert np.mean(scales) > 0.9  # it narrows as the trip goes on


def _padded(rows):
    """Rows that cannot be used behind them, so that all have one length."""
    out = np.full((64, rows.shape[1]), np.nan)
    out[: len(rows)] = rows
    return out


def test_state_of_charge_at_the_end_and_the_chance_of_arriving():
    told = Forecast(30e3, 2e3, 8.0, 0.9, {}, soc=0.4, capacity_wh=100e3)
    value, low, high = told.soc_at_end
    assert value == pytest.approx(0.1)
    assert low < value < high
    assert told.chance_of_arriving() > 0.999
    assert told.chance_of_arriving(reserve=0.1) == pytest.approx(0.5)
    assert Forecast(30e3, 2e3, 8.0, 0.9, {}).soc_at_end is None
    assert Forecast(30e3, 2e3, 8.0, 0.9, {}).chance_of_arriving() is None


def test_rows_ahead_take_the_last_channels_and_need_their_speeds():
    segments, y = drive(100)
    state = begun(memories=(0.8,))  # and as many rows as above: the same programs
    rows = vectors(state.form, segments, y)
    state = scan(state, rows[:60])[0]
    ahead = rows[60:].copy()
    ahead[:, state.form.columns.index("mass_kg")] = np.nan
    same = forecast(state, ahead)
    ahead[:, state.form.columns.index("mass_kg")] = rows[59, state.form.columns.index("mass_kg")]
    assert same == forecast(state, ahead)
    assert forecast(state, ahead, same_trip=False).scale > 0
    ahead[3, state.form.columns.index("speed_end_mps")] = np.nan
    with pytest.raises(ValueError, match="the speeds at both ends; found one that has not"):
        forecast(state, ahead)
    with pytest.raises(ValueError, match="rows of the columns trip, time_s"):
        forecast(state, ahead[:, :3])


def test_a_sheet_may_say_what_the_battery_holds():
    assert sheet(battery={"capacity_wh": 450e3}).capacity_wh == 450e3
