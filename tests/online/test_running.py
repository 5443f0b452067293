"""What a trip adds up, row by row, is what the kernel works out for whole trips."""

import json

import jax
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from hdev_jax.online.running import Running, running_channels
from hdev_jax.online.stream import Stream, channels_of
from hdev_jax.physics import LIBRARY
from hdev_jax.physics.across import (
    DISTANCE_SINCE_START,
    TIME_SINCE_BRAKING,
    distance_since_start,
    time_since_braking,
)
from hdev_jax.segments import Segments

ROW = st.tuples(st.booleans(), st.floats(0.1, 60.0), st.floats(0.0, 30.0), st.sampled_from([0.0, 1e3, 5e3, 4e5]))
# few lengths: each is compiled anew
DRIVES = st.sampled_from([1, 4, 16]).flatmap(lambda n: st.lists(ROW, min_size=n, max_size=n))
WHOLE = jax.jit(lambda segments: (distance_since_start(segments), time_since_braking(segments)))


def rows_of(drive):
    trip, time = 0, 0.0
    for opens, duration, speed, pressure in drive:
        if opens:
            trip, time = trip + 1, 0.0
        yield (
            trip,
            {"time_s": time, "duration_s": duration, "distance_m": speed * duration, "speed_start_mps": speed,
             "speed_end_mps": speed, "brake_pressure_pa": pressure},
        )  # fmt: skip
        time += duration


@given(DRIVES)
def test_row_by_row_is_the_whole_trip(drive):
    rows = [*rows_of(drive)]
    by = {k: np.array([r[k] for _, r in rows]) for k in rows[0][1]}
    segments = Segments.from_arrays(trip=np.array([t for t, _ in rows]) - rows[0][0], **by)
    each = [*Running.over(rows)]
    metres, seconds = WHOLE(segments)
    np.testing.assert_allclose([x[DISTANCE_SINCE_START] for x in each], metres, atol=1e-6)
    np.testing.assert_allclose([x[TIME_SINCE_BRAKING] for x in each], seconds, atol=1e-9)


def test_a_stream_that_begins_again_goes_on_with_its_trip():
    drive = [(k == 20, 5.0, 12.0, 5e3 if k % 9 == 4 else 0.0) for k in range(40)]
    rows = [(f"T{t}", dict(r)) for t, r in rows_of(drive)]
    whole = [row for _, row in Stream().intervals(rows)]
    first = Stream()
    head = [row for _, row in first.intervals(rows[:27])]
    again = Stream.again(json.loads(json.dumps(first.about())), first.rules)
    tail = [row for _, row in again.intervals(rows[27:])]
    assert head + tail == whole
    assert max(row[DISTANCE_SINCE_START] for row in whole) > 1000.0


def test_effects_that_need_no_more_act_on_each_row_alone():
    assert running_channels(["time_s"]) == (DISTANCE_SINCE_START,)
    here = channels_of(["time_s", "brake_pressure_pa"])
    across = {k for k, e in LIBRARY.items() if e.acts_across_rows()}
    assert {"brake_drag", "tyre_warmup"} <= across
    assert across - {k for k, e in LIBRARY.items() if e.acts_across_rows(here)} == {"brake_drag", "tyre_warmup"}
    assert LIBRARY["brake_drag"].acts_across_rows(channels_of(["time_s"]))
