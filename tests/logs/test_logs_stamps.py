"""Where in its time a row's stamp is: said where the measured power shows it, and read so by an adapter's key."""

import numpy as np
import pandas as pd
import pytest

from hdev_jax.errors import InputError
from hdev_jax.logs import Adapter, Log

FINE = 20  # instants a second
MASS_KG = 2000.0


def driven(stamp, seed=0, seconds=900, noise_w=200.0):
    """Three trips: speed at whole seconds; mean power over the second before or after, or that of the instant."""
    rng = np.random.default_rng(seed)
    tables = []
    for trip in "ABC":
        knots = np.cumsum(rng.normal(0.0, 0.8, seconds + 3))
        smooth = np.convolve(np.interp(np.arange(seconds * FINE + FINE) / FINE, np.arange(len(knots)), knots),
                             np.ones(2 * FINE) / (2 * FINE), "same")  # fmt: skip
        v = np.abs(12.0 + smooth)
        power = MASS_KG * v * np.gradient(v, 1.0 / FINE) + 150.0 * v + 0.5 * v**3 + 800.0
        at = np.arange(1, seconds) * FINE
        # the exact mean over a second, by its kinetic energy and by fine sums
        sums = np.r_[0.0, np.cumsum(0.5 * (power[:-1] + power[1:]))] / FINE
        watts = {"middle": power[at], "end": sums[at] - sums[at - FINE], "start": sums[at + FINE] - sums[at]}[stamp]
        tables.append(pd.DataFrame({
            "trip_id": trip, "time_s": at / FINE, "speed_mps": v[at],
            "battery_power_w": watts + rng.normal(0.0, noise_w, len(at)),
        }))  # fmt: skip
    return pd.concat(tables, ignore_index=True)


def notes(log):
    return [e.reason for e in log.ledger if "time stamp" in e.reason]


def mass_of(log):
    s = log.segments
    v0, v1, dt = (np.asarray(x) for x in (s.speed_start_mps, s.speed_end_mps, s.duration_s))
    v = 0.5 * (v0 + v1)
    x = np.column_stack([np.ones(len(v)), v, v**3, 0.5 * (v1**2 - v0**2) / dt])
    return np.linalg.lstsq(x, log.measured["battery_power_w"], rcond=None)[0][-1]


@pytest.mark.parametrize("stamp", ["end", "start"])
def test_means_are_said_and_read_as_such_they_give_the_mass(stamp):
    frame = driven(stamp)
    as_samples = Log.from_frame(frame)
    (said,) = notes(as_samples)
    assert f'stamp = "{stamp}"' in said
    assert "3 of 3 trips" in said
    read = Log.from_frame(frame, adapter=Adapter.from_dict({"stamp": stamp}))
    assert not notes(read)
    assert not read.sampled
    assert len(read) == len(as_samples) - 3  # a row of each trip has no other end
    assert sum(e.count for e in read.ledger if e.kind == "dropped") == 3
    assert abs(mass_of(read) / MASS_KG - 1.0) < 0.01 < abs(mass_of(as_samples) / MASS_KG - 1.0)
    np.testing.assert_allclose(np.asarray(read.segments.duration_s), 1.0)


def test_nothing_is_said_of_samples():
    assert not notes(Log.from_frame(driven("middle")))


@pytest.mark.parametrize("seed", range(5))
def test_nothing_is_said_of_a_power_that_does_not_follow_the_speed(seed):
    frame = driven("end", seed)
    frame["battery_power_w"] = np.random.default_rng(seed).normal(5e3, 2e3, len(frame))
    assert not notes(Log.from_frame(frame))


def test_trips_that_differ_say_nothing():
    frame = pd.concat([driven("end").query("trip_id == 'A'"), driven("start").query("trip_id == 'B'")])
    assert not notes(Log.from_frame(frame))


def test_durations_alone_have_no_stamps():
    frame = driven("end").drop(columns="time_s").assign(duration_s=1.0)
    with pytest.raises(InputError, match="stamp = 'end' needs time_s"):
        Log.from_frame(frame, adapter=Adapter.from_dict({"stamp": "end"}))
    with pytest.raises(InputError, match="stamp"):
        Adapter.from_dict({"stamp": "beginning"})
