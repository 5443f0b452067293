"""Terms without a name compete where no effect of the library passes: the one that passes every gate is added.

They are monomials of the log's channels, and the mean of a cycle: a load that swings has a mean too, in proportion to
its swing, which the nearest named cause would take up otherwise.
"""

from dataclasses import replace

import numpy as np

from hdev_jax.diagnosis.candidates.unnamed import TERM, Described, Factor, Term, described_by, monomials, thresholds
from hdev_jax.diagnosis.competition.forward import Round, forward
from hdev_jax.diagnosis.competition.state import State
from hdev_jax.diagnosis.noise.spectrum import Clocked, strongest_period
from hdev_jax.diagnosis.scores.scores import Scores, score_all
from hdev_jax.diagnosis.training import Training
from hdev_jax.targets import TARGETS, as_watts

__all__ = ["add_unnamed"]

CYCLE = "derived:cycle"
Made = list[tuple[Factor, ...]]


def add_unnamed(round_: Round) -> tuple[Training, State] | None:
    """The training rows with the term's channel and the state with it; None where none passes every gate.

    At a stricter level than an effect of the library has to pass: a description is not a cause.
    """
    state, settings = round_.state, round_.training.settings
    if state.terms:
        return None
    strict = replace(round_.training, settings=replace(settings, fdr=settings.fdr / settings.unnamed_stricter))
    made = monomials(strict.rows.segments, strict.rows.rows)
    swing = _swing_w(strict, state)
    if np.any(swing):
        strict = strict.with_channel(CYCLE, swing)
        made.append((Factor(CYCLE),))
    best = _best(strict, state, made)
    if best is not None and _is_more_than_its_mean(*best):
        made.remove((Factor(CYCLE),))
        best = _best(strict, state, made)
    if best is None or best[1].q[Described.id] > strict.settings.fdr:
        return None
    # what rises with a channel may be switched by it, and a threshold that is off leaves some of the cause to
    # correlated effects
    for _ in range(2):
        more = thresholds(best[0].factors, strict.rows.segments, strict.rows.rows)
        made += [t for t in more if t not in made]
        best = _best(strict, state, made) or best if more else best
        if best[0].factors[0].above is None:
            break
    term, scores = best
    column = term.column(strict.rows.segments)[: strict.rows.rows]
    if CYCLE in term.channels:
        term = replace(term, values=column)
    there = strict.with_channel(TERM, column)
    new = forward(Round(there, state, scores, round_.rng, round_.tell))
    if new is None:
        return None
    before, after = (float(np.mean(there.residual(s.fit) ** 2)) for s in (state, new))
    if before - after < settings.least_share * before:
        return None  # significant, but it explains too little to be described
    new = replace(new, found=new.found[:-1], terms=(*new.terms, term))
    return replace(there, settings=settings), new


def _swing_w(training: Training, state: State) -> np.ndarray:
    """Amplitude [W] of the cycle that the residual has about each row; 0 where it is not significant."""
    target, seconds = TARGETS[training.target], training.seconds
    nothing = np.zeros(len(seconds))
    if not target.of_battery:
        return nothing
    worth = 1.0 / as_watts(target, np.ones(len(seconds)), seconds)
    noise = training.noise(state.fit)
    period = strongest_period(training.residual(state.fit), Clocked.of(training.trip, seconds, worth, noise))
    return nothing if period is None or period.p > training.settings.level else period.amplitudes


def _is_more_than_its_mean(term: Term, scores: Scores) -> bool:
    """Whether the mean of a cycle comes out larger than a load with such a swing could have."""
    size = float(scores.best[Described.id].beta[0]) / term.scale
    return CYCLE in term.channels and not 0.0 <= size <= scores.settings.mean_over_swing


def _best(training: Training, state: State, made: Made) -> tuple[Term, Scores] | None:
    """The best term of those made, and the scores of all; None where none has an effect on the rows."""
    terms = described_by(state.fit.vehicle, training.rows.segments, training.rows.rows, training.target, made)
    scores = score_all(training, state.fit, made=terms) if terms.width else None
    if scores is None or Described.id not in scores.best:
        return None
    which = scores.best[Described.id].candidate.columns[0]
    return Term(terms.sets[which], terms.scales[which]), scores
