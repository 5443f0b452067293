"""The competition: candidates are added, taken out and exchanged, one at a time, until none of these does better."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from hdev_jax.diagnosis.candidates.unnamed import TERM
from hdev_jax.diagnosis.competition.cycle import add_cycle
from hdev_jax.diagnosis.competition.exchange import one_exchanged, two_exchanged
from hdev_jax.diagnosis.competition.forward import Round, forward
from hdev_jax.diagnosis.competition.grid import sharpened
from hdev_jax.diagnosis.competition.mode import add_mode
from hdev_jax.diagnosis.competition.needed import (
    backward,
    classes,
    without_far,
    without_idle_switches,
    without_unclear,
)
from hdev_jax.diagnosis.competition.refit import widened, without
from hdev_jax.diagnosis.competition.state import Found, State, Verdict
from hdev_jax.diagnosis.competition.switching import add_switching, decoded_again, mistaken, with_states
from hdev_jax.diagnosis.competition.unnamed_step import add_unnamed
from hdev_jax.diagnosis.competition.verdicts import verdicts_of
from hdev_jax.diagnosis.gates.rejection import Kind, Rejection
from hdev_jax.diagnosis.scores.scores import score_all
from hdev_jax.diagnosis.training import Training
from hdev_jax.inference import Calibration, ParameterTable
from hdev_jax.physics import Vehicle

__all__ = ["compete", "named_alone", "no_instrument_named", "none_named", "rows_with"]

Tell = Callable[[str], None]


MOST_EFFECTS = 10  # that one search adds


def compete(
    training: Training,
    vehicle: Vehicle,
    table: ParameterTable,
    *,
    seed: int,
    tell: Tell = lambda _: None,
    remember: Callable[[int, Callable[[], State]], State] = lambda _, compute: compute(),
) -> State:
    """From the declared vehicle to the one with every effect that the training rows support.

    **Arguments:** the declared vehicle with its table; `seed` for placebos and resampling; `tell` for progress;
    `remember` keeps the state of each step for a run that is killed.

    **Returns:** the vehicle with every effect that passed the gates, its fit, a term without a name where one passed
    too, and a verdict on every other candidate.
    """

    def calibrated() -> State:
        tell("calibrating the declared model")
        return State(training.calibrate(vehicle, table))

    state = remember(0, calibrated)
    declared = state.fit
    # nothing is added in the second half: what is taken out there is one of those that were
    for step in range(1, 2 * MOST_EFFECTS + 3):
        rng = np.random.default_rng([seed, step])
        state = remember(step, lambda s=state, k=step, r=rng: _step(rows_with(training, s), s, declared, k, r, tell))
        if state.finished:
            break
    return state


def rows_with(training: Training, state: State) -> Training:
    """The training rows with the channels of the terms, and the decoded loads, that the state holds."""
    for term in state.terms:
        if not training.rows.segments.has(TERM):
            training = training.with_channel(TERM, term.column(training.rows.segments)[: training.rows.rows])
    return with_states(training, state)


def _step(
    training: Training, state: State, declared: Calibration, step: int, rng: np.random.Generator, tell: Tell
) -> State:
    """One round: the first of an exchange of two, forward, the searched candidates, an exchange, a wider form and a
    term without a name that changes something; then backward. `finished` where none does."""
    tell(f"scoring candidates, step {step}")
    scores = sharpened(training, score_all(training, state.fit))
    if step == 1:
        state = replace(state, absorbs=scores.absorbs)
    round_ = Round(training, state, scores, rng, tell)
    sought: list[Verdict] = []
    new = None
    if len(state.found) < MOST_EFFECTS and step <= MOST_EFFECTS + 1:
        new = two_exchanged(round_) or forward(round_, skip=state.refused)
        if new is None and state.refused:
            new = forward(round_, skip=tuple(round_.reasons))  # tried just now: no second time
        if new is not None and mistaken(state, new):
            switching, verdict = add_switching(training, state, rng.spawn(1)[0])
            sought += [verdict] if verdict is not None else []
            new = switching or new
        for add in (add_cycle, add_switching, add_mode):
            # last: the residual without an effect that depends on traffic is not noise, and may have cycles
            if new is None and not state.terms:
                new, verdict = add(training, state, rng.spawn(1)[0])
                sought += [verdict] if verdict is not None else []
        new = new or one_exchanged(round_) or widened(training, state)
        if new is None and (added := add_unnamed(round_)) is not None:
            training, new = added
            tell("added a term without a name")
    asked = {v.id for v in sought}
    sought += [v for v in state.verdicts if v.id not in asked and training.library[v.id].searched]
    if new is None:
        less = without_far(training, without_idle_switches(training, state, scores), declared)
        less = without_unclear(training, less)
        new = None if less is state else less
    if new is None:
        state = replace(state, found=classes(scores, state))
        return replace(state, verdicts=verdicts_of(round_, sought), finished=True)
    if new.hidden is not state.hidden:
        training = with_states(training, new)
    old = len(new.terms) > len(state.terms) or {*new.ids} < {*state.ids}  # the last one found is not the newest then
    kept = decoded_again(training, backward(training, new, newest=old))
    for id_ in {*state.ids, *new.ids} - {*kept.ids}:
        tell(f"removed {id_}: {kept.removed.get(id_, 'competes again')}")
    trail = {**kept.trail, ",".join(kept.ids): [float(x) for x in kept.fit.values]} if not kept.terms else kept.trail
    refused = tuple(dict.fromkeys((*kept.refused, *round_.reasons)))
    tested = (*kept.tested, *round_.tested)
    return replace(kept, verdicts=verdicts_of(round_, sought), trail=trail, refused=refused, tested=tested)


def named_alone(training: Training, state: State) -> State:
    """The state without the terms that have no name: what is handed out. An effect has to be significant there too."""
    if not state.terms:
        return state
    alone = without(training, state, *(t.id for t in state.terms))
    return _what_stands(training, alone)


def none_named(state: State, declared: Calibration) -> State:
    """The declared model again: what was found does not predict the held-out trips better."""
    why = Rejection(Kind.NOT_HELD_OUT)
    return State(declared, verdicts=(*_verdicts(state.found, why), *state.verdicts), absorbs=state.absorbs)


def no_instrument_named(training: Training, state: State, share: float, missing: Sequence[str] = ()) -> State:
    """The state without instruments' faults, and without what is not needed any more; itself where it has none.

    `share`: of the variance that is left, what the log's channels predict: then the model's form is wrong, and an
    instrument not the likely cause. Nor is the payload where this share behaves like channels that the log lacks
    (`missing`).
    """
    percent = 100.0 * share
    why = Rejection(Kind.INSTRUMENT, {"percent": percent})
    if missing:
        why = Rejection(Kind.MISSING_CHANNEL, {"percent": percent, "channels": ", ".join(missing)})
    every = [f.score.candidate.effect for f in state.found]
    blamed = [f for f, e in zip(state.found, every, strict=True) if e.instrument or (missing and e.stage == "sensors")]
    if not blamed:
        return state
    less = without(training, state, *(f.id for f in blamed))
    return _what_stands(training, replace(less, verdicts=(*_verdicts(blamed, why), *less.verdicts)))


def _what_stands(training: Training, less: State) -> State:
    """A state from which something was taken out, without what is no longer significant, and a verdict on each that
    goes."""
    kept = decoded_again(training, without_unclear(training, backward(training, less, newest=True)))
    lost = [f for f in less.found if f.id not in kept.ids]
    verdicts = tuple(v for f in lost for v in _verdicts([f], kept.removed[f.id]))
    return replace(kept, verdicts=(*verdicts, *less.verdicts))


def _verdicts(found: Sequence[Found], why: Rejection) -> tuple[Verdict, ...]:
    return tuple(Verdict(f.id, f.gain, f.q_value, why) for f in found)
