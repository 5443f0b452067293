"""A load that is on or off, by a hidden Markov model of what is left: which rows it is on in is decoded first.

Coloured noise wanders, and a model of two levels follows it too. What noise does not have is levels: the same in every
trip, at standstill and in motion. So the model has to gain more likelihood over errors alone than it does on noise of
the same colour and size (a parametric bootstrap whose innovations are the residual's own with random signs; Wu, Annals
of Statistics 14, 1986), and the power between its levels has to be the same in all trips, standing and moving, and
from the first row to the last that it is on.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from hdev_jax.diagnosis.candidates.candidate import Candidate
from hdev_jax.diagnosis.competition.cycle import barred
from hdev_jax.diagnosis.competition.grid import LEADERS
from hdev_jax.diagnosis.competition.levels import FIRST_ROUNDS, LOAD_NUMBERS, Tested, besides, level_test, some_rows
from hdev_jax.diagnosis.competition.refit import fitted, joined, without
from hdev_jax.diagnosis.competition.state import Found, Hidden, State, Verdict
from hdev_jax.diagnosis.gates.gates import RESAMPLES
from hdev_jax.diagnosis.gates.rejection import Kind, Rejection
from hdev_jax.diagnosis.scores.evidence import Score
from hdev_jax.diagnosis.scores.scores import score_all
from hdev_jax.diagnosis.settings import Settings
from hdev_jax.diagnosis.training import Training
from hdev_jax.inference.clusters import Clusters
from hdev_jax.inference.states import (
    Decoded,
    StateRows,
    Switching,
    decode,
    fit_switching,
    rise,
    rows_of,
    what_it_depends_on,
)
from hdev_jax.physics import SwitchingLoad, Vehicle
from hdev_jax.physics.states import COVARIATES, KNOTS_C, SWITCHING_LOADS, state_channel
from hdev_jax.segments import trip_slices
from hdev_jax.targets import TARGETS, as_watts

__all__ = ["add_switching", "decoded_again", "mistaken", "with_states"]

ROUNDS = 6  # of expectation-maximisation, at the last


def with_states(training: Training, state: State) -> Training:
    """The training rows with the decoded states of the loads that the state holds."""
    for id_, on in _states(state):
        training = training.with_channel(state_channel(id_), on)
    return training


def _states(state: State) -> list[tuple[str, Float[np.ndarray, " row"]]]:
    """Id and decoded state of each load that the state holds."""
    return [] if state.hidden is None else [(id_, state.hidden.on[:, k]) for k, id_ in enumerate(state.hidden.ids)]


def mistaken(state: State, new: State) -> bool:
    """Whether the effect that was just found is a load that one which switches looks like on average, and none was
    sought yet: that one is asked about first."""
    added = [id_ for id_ in new.ids if id_ not in state.ids]
    asked = state.hidden is not None or any(v.id == SwitchingLoad.id for v in state.verdicts)
    return not asked and bool(added) and added[-1] in SwitchingLoad.mistaken_for


def add_switching(training: Training, state: State, rng: np.random.Generator) -> tuple[State | None, Verdict | None]:
    """The state with the loads that switch, decoded and refitted, or a verdict on why there is none.

    All are decoded before the first is judged: the levels of one are blurred by another that is not known yet. Slow
    loads that were found already (heating by temperature) are taken out first, and compete again beside the states:
    they may be what the loads are on average.
    """
    held = state.hidden.ids if state.hidden else ()
    able = [e for e in SWITCHING_LOADS if e.id in training.library and not state.fit.vehicle.has(e.id)]
    if not able or any(
        state.fit.vehicle.has(e.id) and e.id not in held for e in SWITCHING_LOADS
    ):  # in the sheet: not decoded
        return None, None
    if (verdict := barred(training, state, able[0])) is not None:
        return None, verdict

    def no(kind: Kind, detail: str, q: float = 1.0) -> tuple[None, Verdict]:
        return None, Verdict(able[0].id, None, q, Rejection(kind, {"detail": detail}))

    settings = training.settings
    beside, slow_w = _without_slow_loads(training, state)
    left = _rows(training, training.residual(state.fit))
    left = replace(left, residual_w=left.residual_w + slow_w)
    rows = replace(left, residual_w=left.residual_w + _loads_w(training, state))
    model, tests = _sought(training, state.hidden.model if state.hidden else None, left, rows, len(able), rng)
    if not tests:
        return no(Kind.NO_EFFECT, "nothing is left that could have levels")
    q = min(1.0, max(t.p for t in tests) * len(training.library))
    if model is None or q > settings.fdr:
        why = f"levels no clearer than in noise with the same autocorrelation (FDR-adjusted p = {q:.2g})"
        return no(Kind.NOT_SIGNIFICANT, why, q)
    decoded = decode(model, rows)
    places = range(len(held), len(model.power_w))
    why = {k: x for k in places if (x := _unlike(rows, model, decoded, k, training.clusters, settings))}
    kept = [*range(len(held)), *(k for k in places if k not in why)]
    if len(kept) == len(held):
        k = next(iter(why))
        return no(Kind.IMPLAUSIBLE, f"a load of {model.power_w[k] / 1e3:.3g} kW, but {why[k]}", q)
    if why:
        model, decoded = fit_switching(model.only(kept), rows, ROUNDS)
    model = what_it_depends_on(model, rows, decoded, training.clusters.ids, cost=settings.size_cost, level=settings.fdr)
    if np.any(model.by):
        model, decoded = fit_switching(model, rows, FIRST_ROUNDS)
    ids = (*held, *(e.id for e in able))[: len(kept)]
    new = replace(without(training, state, *beside) if beside else state, hidden=Hidden(ids, model, decoded.on))
    there = with_states(training, new)
    for k in range(len(held), len(kept)):
        c = Candidate(able[k - len(held)], ("power_w",), (None,), _shapes(model, k), "size", ())
        score = Score(c, model.power_w[k : k + 1], tests[0].gain, tests[0].p, tests[0].p, tests[0].gain, 1.0)
        if (fit := joined(there, new, score)) is None:
            return None, Verdict(c.id, None, q, Rejection(Kind.REFIT))
        gain = there.noise(fit).log_likelihood - there.noise(new.fit).log_likelihood
        square = float(np.mean(there.residual(new.fit) ** 2))
        if gain < settings.size_cost or square - np.mean(there.residual(fit) ** 2) < settings.least_share * square:
            return no(Kind.OUTSCORED, f"a load of {model.power_w[k] / 1e3:.3g} kW that explains too little", q)
        stability = _stability(rows, model, decoded, k, rng, settings)
        found = Found(c.id, replace(score, gain=gain, left_out_gain=gain), q, stability, (), gain)
        new = replace(new, fit=fit, found=(*new.found, found))
    less = _without_last(training, new) if len(kept) > 1 else None
    if less is not None and len(kept) - 1 == len(held):
        return no(Kind.OUTSCORED, "an effect that resembles a load explains more, together with the other load", q)
    return less or new, None


def _without_last(training: Training, state: State) -> State | None:
    """The state without its last load, where an effect that loads look like explains more beside the others.

    A model of two loads also follows one load and what begins or fades within a trip. None where two loads explain
    more: by the likelihood of all courses of the states, and by what is left beside the most likely one.
    """
    assert state.hidden is not None
    last = state.hidden.ids[-1]
    less = decoded_again(training, without(with_states(training, state), state, last))
    there = with_states(training, less)
    like = [c for k, c in training.library.items() if k in SwitchingLoad.mistaken_for and not less.fit.vehicle.has(k)]
    scores = score_all(there, less.fit, training.plan(less.fit.vehicle, like))
    leaders = sorted(scores.best.values(), key=scores.worth, reverse=True)[:LEADERS]
    able = ((s, fit) for s in leaders if (fit := joined(there, less, s)) is not None)
    if (found := next(able, None)) is None:
        return None
    one = _likelihoods(training, decoded_again(training, replace(less, fit=found[1])))
    more = training.settings.size_cost * (LOAD_NUMBERS - found[0].candidate.freedoms)
    return None if np.all(_likelihoods(training, state) > one + more) else less


def _likelihoods(training: Training, state: State) -> Float[np.ndarray, "2"]:
    """Of the rows beside all but the loads, over all courses of their states; and of what is left, beside the most
    likely course."""
    assert state.hidden is not None
    at = with_states(training, state)
    return np.array([decode(state.hidden.model, _beside(at, state)).log_likelihood, at.noise(state.fit).log_likelihood])


def _sought(
    training: Training, held: Switching | None, left: StateRows, rows: StateRows, most: int, rng: np.random.Generator
) -> tuple[Switching | None, list[Tested]]:
    """The model with as many more loads as are significant, `most` of them, the largest first; and their tests, or that
    of the first where it is not. `left`: rows without the loads that are held already."""
    model, tests, settings = held, list[Tested](), training.settings
    for _ in range(most):
        last = level_test(left, training, rng)
        significant = last is not None and last.p * len(training.library) <= settings.fdr
        if last is None or not significant:
            tests += [last] if last is not None and not tests else []
            break
        starts = [last.model] if model is None else [model.plus(last.model)]
        if model is not None and held is None and len(tests) == 1:
            starts += besides(model)
        tests.append(last)
        if len(starts) == 1:
            model, decoded = fit_switching(starts[0], rows, 2 * FIRST_ROUNDS)
        else:
            some = some_rows(rows)  # as many as the test looks at
            tried = [fit_switching(m, some, FIRST_ROUNDS) for m in starts]
            model, decoded = fit_switching(max(tried, key=lambda t: t[1].log_likelihood)[0], rows, FIRST_ROUNDS)
        left = replace(rows, residual_w=rows.residual_w - model.predicted_w(decoded.on))
    if model is None or held is not None:
        return (None if model is held else model), tests
    return model.only(np.argsort(-model.power_w).tolist()), tests


def _shapes(model: Switching, k: int) -> tuple[tuple[str, float], ...]:
    """Shares, memory and what else the chances depend on, as the effect has them."""
    shares = [(f"share_{c:.0f}c", float(x)) for c, x in zip(KNOTS_C, model.share[k], strict=True)]
    by = [(c.name, float(b)) for c, b in zip(COVARIATES, model.by[k], strict=True) if b]
    return (*shares, ("memory_s", float(model.memory_s[k])), *by)


def decoded_again(training: Training, state: State) -> State:
    """The states decoded beside the vehicle as it is now, and the vehicle fitted to them: what was added or taken out
    since has changed what is left. `training`: with the states as they were or without."""
    if state.hidden is None:
        return state
    kept = [k for k, id_ in enumerate(state.hidden.ids) if state.fit.vehicle.has(id_)]
    if not kept:
        return replace(state, hidden=None)
    rows = _beside(with_states(training, state), state)
    model, decoded = fit_switching(state.hidden.model.only(kept), rows, FIRST_ROUNDS)
    hidden = Hidden(tuple(state.hidden.ids[k] for k in kept), model, decoded.on)
    state = replace(state, hidden=hidden, found=tuple(_reshaped(f, hidden) for f in state.found))
    at = with_states(training, state)
    return replace(state, fit=fitted(at, state.fit, _as_decoded(state), state.fit.table))


def _reshaped(f: Found, hidden: Hidden) -> Found:
    """A found load with its shares and memory as they are now."""
    if f.id not in hidden.ids:
        return f
    candidate = replace(f.score.candidate, shapes=_shapes(hidden.model, hidden.ids.index(f.id)))
    return replace(f, score=replace(f.score, candidate=candidate))


def _as_decoded(state: State) -> Vehicle:
    """The vehicle with the shares and memories of its loads as they were decoded."""
    vehicle = state.fit.vehicle
    for k, id_ in enumerate(state.hidden.ids if state.hidden else ()):
        now = vehicle.effect(id_)
        assert state.hidden is not None
        shapes = {**{c.name: 0.0 for c in COVARIATES}, **dict(_shapes(state.hidden.model, k))}
        vehicle = vehicle.minus(id_).plus(type(now)(now.power_w, **shapes))
    return vehicle


def _without_slow_loads(training: Training, state: State) -> tuple[list[str], np.ndarray]:
    """The found loads that a switching one is mistaken for, and their power in each training row [W]."""
    ids = [f.id for f in state.found if f.id in SwitchingLoad.mistaken_for]
    if not ids:
        return [], np.zeros(len(training.trip))
    car = state.fit.vehicle.minus(*ids)
    each = [training.kernel.predict(car, c.segments, training.target)[: c.rows] for c in training.chunks]
    return ids, as_watts(training.target, state.fit.predicted - np.concatenate(each), training.seconds)


def _rows(training: Training, residual: Float[np.ndarray, " row"]) -> StateRows:
    """The training rows with a residual of the target."""
    watts = as_watts(training.target, residual, training.seconds)
    return rows_of(training.rows.segments, watts, samples=TARGETS[training.target].weight != "row")


def _beside(training: Training, state: State) -> StateRows:
    """The training rows, which have the states, with what is left beside all but the decoded loads."""
    left = _rows(training, training.residual(state.fit))
    return replace(left, residual_w=left.residual_w + _loads_w(training, state))


def _loads_w(training: Training, state: State) -> np.ndarray:
    """Power of the loads that the vehicle has in each training row [W], as it is fitted."""
    total = np.zeros(len(training.trip))
    for id_, on in _states(state):
        if state.fit.vehicle.has(id_):
            total += float(np.asarray(state.fit.vehicle.effect(id_).power_w)) * on
    return total


def _alone(rows: StateRows, model: Switching, decoded: Decoded, k: int) -> StateRows:
    """The rows with the other loads taken out."""
    others = [j for j in range(len(model.power_w)) if j != k]
    return replace(rows, residual_w=rows.residual_w - decoded.on[:, others] @ model.power_w[others])


def _power(rows: StateRows, on: np.ndarray, least_s: float) -> tuple[float, float] | None:
    """The power between the two levels of some rows [W] by medians, and its weight: the time [s] at the rarer level.
    None where that is too little."""
    seconds = [float(np.sum(rows.duration_s[x])) for x in (on > 0.9, on < 0.1)]
    if min(seconds) < least_s:
        return None
    return float(np.median(rows.residual_w[on > 0.9]) - np.median(rows.residual_w[on < 0.1])), min(seconds)


def _sure(seconds: np.ndarray, on: np.ndarray) -> float:
    """Probability of the decoded state over the time on, and over the time off: the mean of the two."""
    each = [float(np.sum(seconds * p**2) / max(np.sum(seconds * p), 1e-9)) for p in (on, 1.0 - on)]
    return 0.5 * sum(each)


def _unlike(
    rows: StateRows, model: Switching, decoded: Decoded, k: int, clusters: Clusters, settings: Settings
) -> str | None:
    """Why a decoded load is not one consumer that is switched on and off, or None."""
    power, on, alone = float(model.power_w[k]), decoded.on[:, k], _alone(rows, model, decoded, k)
    size = next(p for p in SwitchingLoad.parameters if p.name == "power_w")
    if not size.least <= power <= size.upper:
        return "its power is out of range"
    if (sure := _sure(rows.duration_s, on)) < settings.load_sure:
        return f"its states are decoded with a probability of {sure:.2f} only"
    # once in a trip is what begins or fades in it: a change that stays, a cabin that is warm by then
    switches = [float(np.sum(np.abs(np.diff(on[s])))) for _, s in trip_slices(rows.trip)]
    if np.sum(np.maximum(np.array(switches) - 1.0, 0.0)) < settings.least_count:
        return "it switches too seldom to be distinguished from what changes once in a trip"
    parts = [clusters.ids == c for c in np.unique(clusters.ids)]
    each = [p for x in parts if (p := _power(alone.take(x), on[x], settings.load_s)) is not None]
    if len(each) < min(2, len(parts)):
        return f"it is both on and off for long enough in {len(each)} of {len(parts)} {clusters.pieces} only"
    by_part, weight = np.array(each).T
    mean = float(np.average(by_part, weights=weight))
    if np.sqrt(np.average((by_part - mean) ** 2, weights=weight)) > settings.load_alike * power:
        return f"its power is not the same in all {clusters.pieces}"
    if np.sum(rows.duration_s[rows.standing == 1]) > 4.0 * settings.load_s:
        standing, moving = (
            _power(alone.take(x), on[x], settings.load_s) for x in (rows.standing == 1, rows.standing == 0)
        )
        if standing is None or moving is None:
            return f"it does not switch {'at standstill' if standing is None else 'in motion'}"
        if abs(standing[0] - moving[0]) > settings.load_alike * power:
            return f"it has {standing[0] / 1e3:.2g} kW at standstill and {moving[0] / 1e3:.2g} kW in motion"
    rises, sd = rise(model, alone, on)
    if abs(rises) - 2.0 * sd > settings.load_steady:
        return f"its power {'rises' if rises > 0 else 'falls'} by {abs(rises):.0%} while it is on"
    return None


def _stability(
    rows: StateRows, model: Switching, decoded: Decoded, k: int, rng: np.random.Generator, settings: Settings
) -> float:
    """Share of resampled sets of trips in which the load explains more than it costs."""
    alone = _alone(rows, model, decoded, k).residual_w
    with_it = model.base_w + decoded.on[:, k] * model.power_w[k]
    each = (np.abs(alone - np.median(alone)) - np.abs(alone - with_it)) / (model.scale_w[rows.standing] * rows.wide)
    gains = np.array([np.sum(each[s]) for _, s in trip_slices(rows.trip)])
    drawn = rng.integers(0, len(gains), (RESAMPLES, len(gains)))
    return float(np.mean(np.sum(gains[drawn], axis=1) > settings.size_cost))
