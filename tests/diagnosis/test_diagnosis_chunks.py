"""Scores of a log taken in chunks of whole trips are those of the log taken at once; so are those of a stream."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from hdev_jax.diagnosis.candidates.facts import MOST_STEPS, facts_of, merged
from hdev_jax.diagnosis.noise.model import Noise, whiten
from hdev_jax.diagnosis.scores import look as looks
from hdev_jax.diagnosis.scores.chunks import Shapes, chunks_of, cut
from hdev_jax.diagnosis.scores.stream import look_through
from hdev_jax.diagnosis.scores.sums import written_by_chunk
from hdev_jax.fleet import synthetic_log
from hdev_jax.inference import calibrate, cluster_rows, clusters_of, padded
from hdev_jax.inference.clusters import MOST_CLUSTERS
from hdev_jax.inference.sheet import read_sheet
from hdev_jax.logs import read_log
from hdev_jax.physics import LIBRARY, most_group
from hdev_jax.problem import Problem, prepare
from hdev_jax.segments import trip_slices

# groups, sums and shifts across rows, switches, steps from a trip on, and a few of one row
EFFECTS = (
    "headwind", "gear_efficiency", "tyre_warmup", "brake_drag", "grade_lag", "time_skew", "sampling_filter",
    "regen_limit", "step_change", "power_gain",
)  # fmt: skip
LOGS = {
    "levels": {"seed": 4, "trips": 12, "rows_per_trip": 70, "noise": "trip_levels"},  # trips are clusters
    "blocks": {"seed": 5, "trips": 5, "rows_per_trip": 260, "noise": "ar1"},  # blocks of trips are
}


def prepared(folder, **options) -> Problem:
    files = synthetic_log(**options).write(folder, truth=False)
    return prepare(read_log([files["log"]]), read_sheet(files["sheet"]))


def looked(problem: Problem, chunk_rows: int, block_sd: float = 0.0) -> looks.View:
    rows, clusters = padded(problem.segments, problem.measured), cluster_rows(problem.segments)
    fit = calibrate(problem.vehicle, problem.table, rows, problem.target, clusters)
    effects = [LIBRARY[k] for k in EFFECTS]
    rng, gears = np.random.default_rng(0), most_group(problem.segments)
    loop = looks.Loop(rows, problem.target, clusters, effects, 0.05, rng, gears, chunk_rows)
    state = looks.Search(problem.vehicle, problem.table, fit)
    view = looks.look(loop, state)
    ground = replace(view.ground, noise=replace(view.ground.noise, block_sd=block_sd))
    return looks.scored(ground, view.source) if block_sd else view


def same(one: looks.View, other: looks.View) -> None:
    """Gram matrices to rounding of their own size, and every score that comes from them."""
    assert one.source.candidates == other.source.candidates
    for a, b in ((one.evidence, other.evidence), (one.plain, other.plain)):
        size = np.sqrt(np.einsum("gii->i", a.grams)) + 1e-100
        np.testing.assert_allclose(a.grams / np.outer(size, size), b.grams / np.outer(size, size), rtol=0, atol=1e-9)
        np.testing.assert_allclose(a.levels / size, b.levels / size, rtol=0, atol=1e-9)
        np.testing.assert_allclose(a.squares, b.squares, rtol=1e-12)
        np.testing.assert_array_equal(a.home, b.home)
    assert one.best.keys() == other.best.keys()
    for id_, s in one.best.items():
        assert s.gain == pytest.approx(other.best[id_].gain, rel=1e-6, abs=1e-6)
        assert s.left_out_gain == pytest.approx(other.best[id_].left_out_gain, rel=1e-5, abs=1e-5)
        assert (s.candidate, s.plain) == (other.best[id_].candidate, other.best[id_].plain)
        assert one.q[id_] == pytest.approx(other.q[id_], rel=1e-4, abs=1e-12)
    assert (one.absorbed_by, one.left_out) == (other.absorbed_by, other.left_out)


@pytest.mark.parametrize(("log", "block_sd"), [("levels", 0.0), ("levels", 30.0), ("blocks", 0.0), ("blocks", 30.0)])
def test_chunks_say_what_the_whole_log_says(log, block_sd, tmp_path):
    """With levels of trips or of blocks inside them; some chunks hold several trips, some trips are longer."""
    problem = prepared(tmp_path, **LOGS[log])
    whole = looked(problem, 10_000, block_sd)
    assert len(list(whole.ground.chunks())) == 1
    assert (whole.ground.noise.level_sd > 0) == (log == "levels")
    assert any(g is not None for c in whole.source.candidates for g in c.groups)
    longest = max(s.stop - s.start for _, s in trip_slices(problem.segments.trip))
    for chunk_rows in (3 * longest, longest // 2):
        parts = looked(problem, chunk_rows, block_sd)
        assert len(list(parts.ground.chunks())) > 1
        same(whole, parts)


def test_a_few_columns_by_chunk(tmp_path):
    """Every row in its place, whatever the chunks; the same numbers as in one piece."""
    problem = prepared(tmp_path, **LOGS["levels"])
    whole, parts = (looked(problem, n) for n in (10_000, 100))
    for id_ in ("time_skew", "gear_efficiency", "tyre_warmup"):
        at = next(c.columns for c in whole.source.candidates if c.id == id_)
        one, other = (written_by_chunk(v.ground, v.source, at) for v in (whole, parts))
        assert one.shape == (len(problem.segments), len(at))
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9 * np.max(np.abs(one)))


@pytest.mark.parametrize("per_piece", [1, 5, 12])
def test_a_stream_says_what_the_log_in_memory_says(per_piece, tmp_path):
    problem = prepared(tmp_path, **LOGS["levels"])
    whole = looked(problem, 10_000)
    effects = [LIBRARY[k] for k in EFFECTS]

    def read():
        for first in range(0, 12, per_piece):
            at = (problem.segments.trip >= first) & (problem.segments.trip < first + per_piece)
            yield problem.segments.take(at), problem.measured[at]

    clusters, rows = cluster_rows(problem.segments), padded(problem.segments, problem.measured)
    fit = calibrate(problem.vehicle, problem.table, rows, problem.target, clusters)
    parts = look_through(read, fit, effects, problem.target, chunk_rows=200)
    same(whole, replace(parts, ground=whole.ground))
    for name in ("coefficients", "scales", "trip_scale"):
        np.testing.assert_allclose(getattr(parts.ground.noise, name), getattr(whole.ground.noise, name), rtol=1e-6)


def test_a_stream_that_is_none_is_refused(tmp_path):
    problem = prepared(tmp_path, **LOGS["levels"])
    fit = looked(problem, 10_000).ground.fit
    segments, measured = problem.segments, problem.measured
    half, effects = len(segments) // 2, [LIBRARY["headwind"]]
    cut_trip = [(segments.take(np.arange(half)), measured[:half]),
                (segments.take(np.arange(half, len(segments))), measured[half:])]  # fmt: skip
    readings = iter([[(segments, measured)], [(segments.take(np.arange(half)), measured[:half])]])
    for read, words in (
        (lambda: cut_trip, "each trip in one piece"),
        (list, "no pieces"),
        (lambda: next(readings), "repeat itself"),
    ):
        with pytest.raises(ValueError, match=words):
            look_through(read, fit, effects, problem.target)


# --- the parts -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("lengths", "most", "expected"),
    [([3, 3, 3], 6, [(0, 2), (2, 3)]), ([9, 1, 1], 6, [(0, 1), (1, 3)]), ([1, 9, 1], 6, [(0, 1), (1, 2), (2, 3)]),
     ([], 6, []), ([2], 6, [(0, 1)])],
)  # fmt: skip
def test_trips_are_kept_whole(lengths, most, expected):
    assert cut(lengths, most) == expected


def test_shapes_are_few():
    """One for all chunks of a long log, powers of two of it for long trips, no more than the longest asks for."""
    assert Shapes(1000, 300).size(1000) == 1024
    long = Shapes(10**7, 400_000)
    assert {long.size(n) for n in range(1, 65_537, 97)} == {65_536}
    assert {long.size(n) for n in range(65_537, 400_001, 997)} == {131_072, 262_144, 458_752}
    with pytest.raises(ValueError, match="do not fit"):
        padded(prepared_rows(9), np.zeros(9), 8)


def prepared_rows(n: int, trips: int = 1):
    """A few rows of standing still."""
    from hdev_jax.segments import Segments

    zero, one = np.zeros(n), np.ones(n)
    return Segments(np.arange(n) * trips // n, np.zeros(n, int), zero, one, zero, zero, zero, {"gear": one})


def test_chunks_count_their_rows_anew():
    """Bounds of trips belong to the chunk; everything else is the log's rows in order."""
    whole = padded(prepared_rows(90, 9), np.arange(90.0))
    real = jax.tree.map(lambda x: x[:90], whole.segments)
    chunks = list(chunks_of(real, np.arange(90.0), Shapes(90, 10, 35), row=500, trip=50))
    assert [(c.at.start, c.rows, c.first_trip, c.trips) for c in chunks] == [
        (500, 30, 50, 3), (530, 30, 53, 3), (560, 30, 56, 3)
    ]  # fmt: skip
    for c in chunks:
        first = np.asarray(c.segments.channels["derived:first_row_of_trip"])[: c.rows]
        np.testing.assert_array_equal(first, np.repeat([0, 10, 20], 10))
    np.testing.assert_array_equal(np.concatenate([c.measured for c in chunks]), np.arange(90.0))


def test_long_trips_are_whitened_in_pieces(monkeypatch):
    """Rows before a piece count for its first ones."""
    rng = np.random.default_rng(0)
    trip = np.repeat([0, 1, 2], [150, 5, 45])
    noise = Noise(np.array([[0, 0], [0.8, 0], [1.1, -0.2]]), np.array([2.0, 1.2, 1.0]), 0.0, np.ones(3), 0.0)
    columns, seconds = rng.normal(size=(200, 3)), np.ones(200)
    whole = whiten(columns, noise, trip, seconds)
    monkeypatch.setattr("hdev_jax.diagnosis.noise.model.PIECE", 37)
    np.testing.assert_allclose(whiten(columns, noise, trip, seconds), whole, rtol=1e-12, atol=1e-12)


def test_many_trips_share_clusters():
    trip = np.repeat(np.arange(3 * MOST_CLUSTERS + 7), 2)
    clusters = clusters_of(trip, np.ones(len(trip)))
    assert (clusters.count, clusters.kind) == (MOST_CLUSTERS, "trip")
    assert np.all(np.diff(clusters.ids) >= 0)
    assert np.all(clusters.ids[::2] == clusters.ids[1::2])  # no trip is split
    sizes = np.bincount(clusters.ids)
    assert sizes.min() >= 6
    assert sizes.max() <= 8


def test_facts_add_up():
    """Of parts and of the whole; with many trips a change may begin at some, and near the best at any."""
    rows = prepared_rows(400, 200)
    parts = [facts_of(rows.take(np.arange(k, k + 100))) for k in range(0, 400, 100)]
    whole, sum_ = facts_of(rows), merged(parts, np.asarray(rows.duration_s))
    np.testing.assert_array_equal(whole.trips, sum_.trips)
    assert (whole.rows, whole.row_s, whole.gears) == (sum_.rows, sum_.row_s, sum_.gears)
    assert whole.groups == sum_.groups
    steps = whole.steps
    assert len(steps) == MOST_STEPS
    assert (steps[0], steps[-1]) == (3.0, 197.0)
    near = whole.steps_near(steps[5])
    assert steps[5] in near
    assert steps[4] < near[0]
    assert near[-1] < steps[6]
    few = facts_of(prepared_rows(20, 10))
    assert few.steps == (3.0, 4.0, 5.0, 6.0, 7.0)
    assert few.steps_near(5.0) == (5.0,)
    with pytest.raises(ValueError, match="same channels"):
        merged([whole, facts_of(rows.without("gear"))], np.ones(800))
