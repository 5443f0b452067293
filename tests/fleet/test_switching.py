"""Loads that switch in synthetic logs: the share of time on is the one asked for, the energy adds up."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from hdev_jax.fleet import SyntheticLog, synthetic_log
from hdev_jax.fleet.switching import KINDS, Load, with_loads

TRIPS, ROWS = 12, 1200
MODES = [("samples", "shaft", "battery_power_kw"), ("segments", "road", "energy_wh")]


@cache
def made(mode: str = "samples", entry: str = "shaft", rows: int = ROWS, temp_c: float | None = 10.0) -> SyntheticLog:
    """A log whose outside temperature is the same throughout, or as it was drawn."""
    if temp_c is None:
        return synthetic_log(seed=5, trips=TRIPS, rows_per_trip=rows, mode=mode, entry=entry)
    log = made(mode, entry, rows, None)
    return replace(log, frame=log.frame.assign(ambient_temp_c=temp_c))


def seconds(log: SyntheticLog) -> np.ndarray:
    return np.asarray(log.drive.columns["duration_s"], dtype=float)


def share_on(log: SyntheticLog, load: Load, seed: int = 1) -> float:
    """Share of the log's time that the load is on."""
    return float(np.average(with_loads(log, [load], seed=seed).truth["on:0"], weights=seconds(log)))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("share", [0.2, 0.4, 0.7])
def test_the_share_of_time_on_is_the_one_asked_for(kind, share):
    log, load = made(), Load(5e3, kind=kind, share=share)
    total = np.sum(seconds(log))
    if kind == "chain":  # variance of a time average: 2·p·(1 − p)·memory / time, the memory being dwell·(1 − p)
        sd = np.sqrt(2.0 * share * (1.0 - share) * load.dwell_s * (1.0 - share) / total)
    else:  # a trip ends anywhere in a cycle of a few minutes: at most a quarter of it on or off too long
        cycle = load.dwell_s / share if kind == "timer" else 2.0 * 900.0 / 10.0 / (1.0 - share)
        sd = 0.25 * cycle * TRIPS / total / np.sqrt(TRIPS)
    assert share_on(log, load) == pytest.approx(share, abs=4.0 * sd)


@pytest.mark.parametrize(("mode", "entry", "target"), MODES)
@pytest.mark.parametrize("kind", KINDS)
def test_the_energy_adds_up(mode, entry, target, kind):
    log = made(mode, entry, rows=200, temp_c=None)
    loads = [Load(4e3, kind=kind), Load(11e3, kind="timer", share=0.3, dwell_s=200.0)]
    more = with_loads(log, loads, seed=3)
    hours = seconds(log) / 3600.0
    added = more.frame[target].to_numpy() - log.frame[target].to_numpy()
    added_wh = added if mode == "segments" else 1e3 * added * hours
    by_load = [x.power_w * more.truth[f"on:{k}"].to_numpy() * hours for k, x in enumerate(loads)]
    np.testing.assert_allclose(added_wh, np.sum(by_load, axis=0), rtol=1e-9, atol=1e-9)
    assert np.sum(added_wh) == pytest.approx(sum(float(np.sum(x)) for x in by_load), rel=1e-12)
    for k in range(len(loads)):
        on = more.truth[f"on:{k}"].to_numpy()
        assert np.all((on >= -1e-9) & (on <= 1.0 + 1e-9))
        assert 0.0 < np.mean(on) < 1.0
        if mode == "samples":  # each second is on or off
            assert set(on) == {0.0, 1.0}
    others = [c for c in log.frame if c != target]
    assert more.frame[others].equals(log.frame[others])


def test_the_same_seed_gives_the_same_log():
    log, loads = made(rows=200), [Load(5e3), Load(8e3, kind="thermostat")]
    before = log.frame.copy()
    one, again, other = (with_loads(log, loads, seed=s) for s in (1, 1, 2))
    assert one.frame.equals(again.frame)
    assert one.truth.equals(again.truth)
    assert not one.truth["on:0"].equals(other.truth["on:0"])
    assert log.frame.equals(before), "the log itself stays as it is"
    assert with_loads(log, loads[:1], seed=1).truth["on:0"].equals(one.truth["on:0"]), "a load more changes no other"


@pytest.mark.parametrize("load", [Load(5e3, kind="thermostat"), Load(5e3, by_temp=0.02)], ids=["thermostat", "chain"])
def test_a_heater_is_on_for_longer_in_the_cold(load):
    shares = [share_on(made(temp_c=c), load) for c in (0.0, 10.0, 18.0)]
    assert shares == sorted(shares, reverse=True)
    assert shares[0] > shares[1] + 0.1


def test_a_chain_stays_on_for_its_dwell_time():
    log = made()
    on = with_loads(log, [Load(5e3, dwell_s=60.0)], seed=1).truth["on:0"].to_numpy()
    trip = log.frame["trip_id"].to_numpy()
    starts = int(np.sum((np.diff(on) > 0) & (trip[1:] == trip[:-1]))) + int(np.sum(on[np.unique(trip, True)[1]] > 0))
    # exponential times: the mean of so many has an error of 1/√starts; trips cut off a little of each last one
    assert np.sum(on) / starts == pytest.approx(60.0, rel=4.0 / np.sqrt(starts))
