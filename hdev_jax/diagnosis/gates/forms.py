"""What a found effect leaves behind where it truly has another form than the library's.

A resistance that grows with cold, a cut-off that fades: the library's form takes most of it, and the rest looks like
something else, which more of the same log can only make surer. A further candidate has to say more than the found
effects would in other forms, or as much as the best of these: a loss in proportion to torque is the root of one in
proportion to its square, and is named all the same.
"""

from collections.abc import Callable, Iterator

import numpy as np
from jaxtyping import Float
from scipy import stats

from hdev_jax.diagnosis.candidates.candidate import plan_of
from hdev_jax.diagnosis.scores.chunks import Chunk
from hdev_jax.diagnosis.scores.evidence import Score
from hdev_jax.diagnosis.scores.look import Loop, Search, View
from hdev_jax.diagnosis.scores.sums import evidence_of
from hdev_jax.inference import predict
from hdev_jax.segments import Segments

__all__ = ["another_form"]

VARIES_WITH = ("ambient_temp_c", "soc")  # beside speed and time, where a log has them
ALWAYS: tuple[Callable[[np.ndarray, Segments], np.ndarray], ...] = (
    lambda does, _: does,
    lambda does, _: does * np.abs(does),
    lambda does, _: np.sign(does) * np.sqrt(np.abs(does)),
    lambda does, segments: does * np.asarray(segments.speed_mps),
    lambda does, segments: does * np.asarray(segments.time_s),
)
CLOSER = 1.0  # in log-likelihood, that one form has to explain more than the candidate
SHAPES = 24  # of an effect's thresholds and time constants that are tried at most


def another_form(problem: Loop, state: Search, s: Score, view: View) -> str | None:
    """Which found effects, in other forms, would say what the candidate does, and one of them more of it; or None.

    Other forms of an effect: its columns at other thresholds and time constants together, and what it does now, times
    speed, temperature, charge and time in the trip, squared, or as its root. The candidate is to stay significant
    over the library beside all of them, by Bonferroni, or to explain as much as any one does, each of its further sizes
    counted against it. What only trips tell is not asked: they are too few for so many numbers. A second cause that is
    closely such a form of the first (a constant load, and one in proportion to temperature) may not be named beside it,
    however long the log; a truth that has two other forms at once may leave something that is.
    """
    if s.plain or not state.found:
        return None
    car = view.ground.fit.vehicle
    parts = []
    for f in state.found:
        bare = car.minus(f.id)
        plan = plan_of(bare, problem.effects, problem.facts, problem.target)
        own = sorted({k for c in plan.candidates if c.id == f.id for k in c.columns})
        parts.append((bare, plan, own[:: max(1, -(-len(own) // SHAPES))]))
    varied = len(ALWAYS) + sum(problem.rows.segments.has(n) for n in VARIES_WITH)
    width = sum(len(own) + varied for _, _, own in parts)
    k = len(s.candidate.columns)

    def write(out: np.ndarray, chunk: Chunk) -> None:
        now = np.asarray(predict(car, chunk.segments, problem.target))
        at = 0
        for bare, plan, own in parts:
            plan.write(out[:, at : at + len(own)], chunk.segments, own)
            at += len(own)
            does = now - np.asarray(predict(bare, chunk.segments, problem.target))
            for column in _varied(does, chunk.segments):
                out[:, at] = np.nan_to_num(column)
                at += 1
        view.source.write(out[:, width:], chunk.segments, s.candidate.columns)

    evidence = evidence_of(view.ground, width + k, write)
    totals = evidence.totals()
    beside = evidence.gain(totals, range(width + k))[0] - evidence.gain(totals, range(width))[0]
    if stats.chi2.sf(2.0 * max(beside, 0.0), k) <= view.level(s.candidate.id, problem.fdr):
        return None
    alone = evidence.gain(totals, range(width, width + k))[0]
    if np.max(evidence.gains(totals, [[c] for c in range(width)])) <= alone - (k - 1) + CLOSER:
        return None
    return f"no more than {' and '.join(f.id for f in state.found)} would say in another form"


def _varied(does: Float[np.ndarray, " row"], segments: Segments) -> Iterator[np.ndarray]:
    """What an effect does, and as it would be if its size varied or its answer were not in proportion."""
    for form in ALWAYS:
        yield form(does, segments)
    for name in VARIES_WITH:
        if segments.has(name):
            yield does * np.asarray(segments.channels[name])
