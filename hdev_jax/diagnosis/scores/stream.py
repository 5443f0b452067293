"""Every candidate scored on a log that does not fit into memory: a few passes over pieces of it."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from hdev_jax.diagnosis.candidates.facts import Facts, facts_of, merged
from hdev_jax.diagnosis.candidates.plan import plan_of
from hdev_jax.diagnosis.noise.noise import estimate_noise
from hdev_jax.diagnosis.scores.gls import generalised
from hdev_jax.diagnosis.scores.passes import Baseline
from hdev_jax.diagnosis.scores.scores import Scores, scored
from hdev_jax.diagnosis.settings import SETTINGS, Settings
from hdev_jax.inference import Calibration, clusters_of, predict
from hdev_jax.inference.rows import CHUNK_ROWS, Chunk, Shapes, chunks_of
from hdev_jax.physics import Effect
from hdev_jax.segments import Segments, trip_slices
from hdev_jax.targets import TargetName

__all__ = ["Piece", "Survey", "look_through", "survey"]

Piece = tuple[Segments, Float[np.ndarray, " row"]]  # whole trips, and the target measured on their rows


@dataclass(frozen=True)
class Survey:
    """What a first pass keeps: the facts, and 24 bytes of every row.

    `residual` is measured − predicted in the target's unit, `seconds` the durations, `trip` the ids.
    """

    facts: Facts
    trip: Int[np.ndarray, " row"]
    seconds: Float[np.ndarray, " row"]
    residual: Float[np.ndarray, " row"]


def look_through(
    read: Callable[[], Iterable[Piece]],
    fit: Calibration,
    effects: Sequence[type[Effect]],
    target: TargetName,
    *,
    chunk_rows: int = CHUNK_ROWS,
    settings: Settings = SETTINGS,
) -> Scores:
    """What a fitted vehicle leaves of a log that comes in pieces, and what every candidate would explain of it.

    **Arguments:** `read`, called up to nine times, gives the pieces in the order of their trips, each of whole trips
    with one and the same set of channels (a few times `chunk_rows` rows suit it); `fit`, the vehicle calibrated on some
    of them; `effects`, the candidates' classes.

    **Returns:** the same as `score_all` for a log in memory. Memory grows by 24 bytes a row.

    **Raises:** `ValueError` where there are no rows, trips are not in order or lie in two pieces, channels differ, or
    a later reading is not the first.
    """
    seen = survey(read(), fit, target, chunk_rows=chunk_rows)
    clusters = clusters_of(seen.trip, seen.seconds)
    noise = estimate_noise(seen.residual, seen.trip, seen.seconds, levels=clusters.kind == "trip")
    lengths = [s.stop - s.start for _, s in trip_slices(seen.trip)]
    shapes = Shapes(seen.facts.rows, max(lengths), chunk_rows)

    def chunks() -> Iterator[Chunk]:
        row, trip = 0, 0
        for segments, measured in read():
            n = len(segments)
            if not np.array_equal(seen.trip[row : row + n], np.asarray(segments.trip)):
                raise ValueError(f"row {row} and after are other trips than when read first; `read` must repeat itself")
            for chunk in chunks_of(segments, np.asarray(measured, dtype=float), shapes, row=row, trip=trip):
                yield chunk
                trip += chunk.trips
            row += n
        if row != seen.facts.rows:
            raise ValueError(f"{row} rows, {seen.facts.rows} when read first; `read` must repeat itself")

    baseline = Baseline(chunks, clusters, len(lengths), fit, target, noise)
    baseline = replace(baseline, fit=generalised(baseline)[0])
    return scored(baseline, plan_of(baseline.fit.vehicle, effects, seen.facts, target), settings)


def survey(pieces: Iterable[Piece], fit: Calibration, target: TargetName, *, chunk_rows: int = CHUNK_ROWS) -> Survey:
    """The first pass over a log in pieces of whole trips, with what a fitted vehicle leaves of each row.

    It predicts in chunks of `chunk_rows`. Raises `ValueError` where there are no rows, or trips are not in order or
    lie in two pieces.
    """
    facts: list[Facts] = []
    kept: list[tuple[np.ndarray, ...]] = []
    last = -1
    for segments, measured in pieces:
        trip = np.asarray(segments.trip)
        runs = list(trip_slices(trip))
        ids = [t for t, _ in runs]
        if not ids or ids[0] <= last or np.any(np.diff(ids) <= 0):
            raise ValueError(
                f"a piece with the trips {ids[:3]}… after trip {last}: expected ids that rise, each trip in one piece"
            )
        last = ids[-1]
        facts.append(facts_of(segments))
        # a log of one chunk would do with fewer rows, but this may be the first of many
        shapes = Shapes(chunk_rows + 1, max(s.stop - s.start for _, s in runs), chunk_rows)
        parts = chunks_of(segments, np.asarray(measured, dtype=float), shapes)
        left = [c.measured - np.asarray(predict(fit.vehicle, c.segments, target))[: c.rows] for c in parts]
        kept.append((trip, np.asarray(segments.duration_s, dtype=float), np.concatenate(left)))
    if not kept:
        raise ValueError("a log of no pieces has no candidates; expected at least one piece of whole trips")
    trip, seconds, residual = (np.concatenate(column) for column in zip(*kept, strict=True))
    return Survey(merged(facts, seconds), trip, seconds, residual)
