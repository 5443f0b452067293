"""A load that is on or off, by a hidden Markov model of what is left: which rows it is on in is decoded first.

Coloured noise wanders, and a model of two levels follows it too. What noise does not have is levels: the same in every
trip, at standstill and in motion. So the model has to gain more likelihood over errors alone than it does on noise of
the same colour and size (a parametric bootstrap whose innovations are the residual's own with random signs; Wu, Annals
of Statistics 14, 1986), and the power between its levels has to be the same in all trips, standing and moving.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy import signal, stats

from hdev_jax.diagnosis.candidates.candidate import Candidate
from hdev_jax.diagnosis.competition.cycle import barred
from hdev_jax.diagnosis.competition.refit import fitted, joined, without
from hdev_jax.diagnosis.competition.state import Found, Hidden, State, Verdict
from hdev_jax.diagnosis.gates.rejection import Kind, Rejection
from hdev_jax.diagnosis.noise.noise import Noise, estimate_noise
from hdev_jax.diagnosis.scores.evidence import Score
from hdev_jax.diagnosis.settings import Settings
from hdev_jax.diagnosis.training import Training
from hdev_jax.inference import predict
from hdev_jax.inference.states import (
    Decoded,
    StateRows,
    Switching,
    decode,
    errors_alone,
    fit_switching,
    rows_of,
)
from hdev_jax.physics import SecondSwitchingLoad, SwitchingLoad, Vehicle
from hdev_jax.physics.states import KNOTS_C, state_channel
from hdev_jax.segments import trip_slices
from hdev_jax.targets import TARGETS, as_watts

__all__ = ["LOADS", "add_switching", "decoded_again", "mistaken", "with_states"]

LOADS = (SwitchingLoad, SecondSwitchingLoad)
COARSE_S = (5.0, 15.0, 45.0)  # means over so many seconds have less noise, and blur the switching
FIRST_ROUNDS = 3  # of expectation-maximisation
ROUNDS = 6
MOST_ROWS = 30_000  # that the test looks at
BESIDES = (0.4, 0.6, 1.6, 2.5)  # powers of a second load to start from, over the first's
LEAST_SPREAD = 2.0  # of the surrogates' gains, in log-likelihood
LEAST_S = 60.0  # on, and off, for a power of its own (of a trip, at standstill)
LEAST_SWITCHES = 8.0
LEAST_ROWS = 100
EARLY = 3  # surrogates, one of which does as well: no load


@dataclass(frozen=True)
class _Tested:
    """The test of a load: its gain in log-likelihood over errors alone, and p."""

    model: Switching
    gain: float
    p: float


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
    able = [e for e in LOADS if e.id in training.library and not state.fit.vehicle.has(e.id)]
    if not able or any(state.fit.vehicle.has(e.id) and e.id not in held for e in LOADS):  # in the sheet: not decoded
        return None, None
    if (verdict := barred(training, state, able[0])) is not None:
        return None, verdict

    def no(kind: Kind, detail: str, q: float = 1.0) -> tuple[None, Verdict]:
        return None, Verdict(able[0].id, None, q, Rejection(kind, {"detail": detail}))

    settings = training.settings
    beside, slow_w = _without_slow_loads(training, state)
    left = _rows(training, training.residual(state.fit))
    rows = replace(left, residual_w=left.residual_w + slow_w + _loads_w(training, state))
    left = replace(left, residual_w=left.residual_w + slow_w)
    model, decoded = (state.hidden.model, None) if state.hidden else (None, None)
    tests: list[_Tested] = []
    for _ in able:
        tested = _tested(left, training, rng)
        if tested is None or tested.p * len(training.library) > settings.fdr:
            break
        starts = [tested.model] if model is None else [model.plus(tested.model)]
        if model is not None and not held and len(tests) == 1:
            starts += _besides(model)
        tests.append(tested)
        tried = [fit_switching(m, rows, FIRST_ROUNDS) for m in starts]
        model, decoded = fit_switching(max(tried, key=lambda t: t[1].log_likelihood)[0], rows, FIRST_ROUNDS)
        left = replace(rows, residual_w=rows.residual_w - model.predicted_w(decoded.on))
    if not tests or model is None or decoded is None:
        if tested is None:
            return no(Kind.NO_EFFECT, "nothing is left that could have levels")
        q = min(1.0, tested.p * len(training.library))
        return no(Kind.NOT_SIGNIFICANT, f"no more levels than noise of this colour has (FDR-adjusted p = {q:.2g})", q)
    if not held:  # the largest first
        model = model.only(np.argsort(-model.power_w).tolist())
        decoded = decode(model, rows)
    places = range(len(held), len(held) + len(tests))
    why = {k: x for k in places if (x := _unlike(rows, model, decoded, k, settings))}
    kept = [*range(len(held)), *(k for k in places if k not in why)]
    ids = (*held, *(e.id for e in able))[: len(kept)]
    if len(kept) == len(held):
        k = next(iter(why))
        return no(Kind.IMPLAUSIBLE, f"a load of {model.power_w[k] / 1e3:.3g} kW, but {why[k]}", tests[0].p)
    if why:
        model, decoded = fit_switching(model.only(kept), rows, ROUNDS)
    new = replace(without(training, state, *beside) if beside else state, hidden=Hidden(ids, model, decoded.on))
    there = with_states(training, new)
    for k in range(len(held), len(kept)):
        tested, before = tests[kept[k] - len(held)], new.fit
        c = Candidate(able[k - len(held)], ("power_w",), (None,), _shapes(model, k), "size", ())
        score = Score(c, model.power_w[k : k + 1], tested.gain, tested.p, tested.p, tested.gain, 1.0)
        if (fit := joined(there, new, score)) is None:
            return None, Verdict(c.id, None, tested.p, Rejection(Kind.REFIT))
        gain = there.noise(fit).log_likelihood - there.noise(before).log_likelihood
        square = float(np.mean(there.residual(before) ** 2))
        if gain < settings.size_cost or square - np.mean(there.residual(fit) ** 2) < settings.least_share * square:
            return no(Kind.OUTSCORED, f"a load of {model.power_w[k] / 1e3:.3g} kW that explains too little", tested.p)
        q = min(1.0, tested.p * len(training.library))
        stability = _stability(rows, model, decoded, k, rng, settings)
        found = Found(c.id, replace(score, gain=gain, left_out_gain=gain), q, stability, (), gain)
        new = replace(new, fit=fit, found=(*new.found, found))
    return new, None


def _shapes(model: Switching, k: int) -> tuple[tuple[str, float], ...]:
    """Shares and memory of a load as the effect has them."""
    shares = [(f"share_{c:.0f}c", float(x)) for c, x in zip(KNOTS_C, model.share[k], strict=True)]
    return (*shares, ("memory_s", float(model.memory_s[k])))


def decoded_again(training: Training, state: State) -> State:
    """The states decoded beside the vehicle as it is now, and the vehicle fitted to them: what was added or taken out
    since has changed what is left. `training`: with the states as they were or without."""
    if state.hidden is None:
        return state
    kept = [k for k, id_ in enumerate(state.hidden.ids) if state.fit.vehicle.has(id_)]
    if not kept:
        return replace(state, hidden=None)
    at = with_states(training, state)
    rows = _rows(at, at.residual(state.fit))
    rows = replace(rows, residual_w=rows.residual_w + _loads_w(at, state))
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
        vehicle = vehicle.minus(id_).plus(type(now)(now.power_w, **dict(_shapes(state.hidden.model, k))))
    return vehicle


def _without_slow_loads(training: Training, state: State) -> tuple[list[str], np.ndarray]:
    """The found loads that a switching one is mistaken for, and their power in each training row [W]."""
    ids = [f.id for f in state.found if f.id in SwitchingLoad.mistaken_for]
    if not ids:
        return [], np.zeros(len(training.trip))
    car = state.fit.vehicle.minus(*ids)
    each = [np.asarray(predict(car, c.segments, training.target))[: c.rows] for c in training.chunks]
    return ids, as_watts(training.target, state.fit.predicted - np.concatenate(each), training.seconds)


def _rows(training: Training, residual: Float[np.ndarray, " row"]) -> StateRows:
    """The training rows with a residual of the target."""
    watts = as_watts(training.target, residual, training.seconds)
    return rows_of(training.rows.segments, watts, samples=TARGETS[training.target].weight != "row")


def _loads_w(training: Training, state: State) -> np.ndarray:
    """Power of the loads that the vehicle has in each training row [W], as it is fitted."""
    total = np.zeros(len(training.trip))
    for id_, on in _states(state):
        if state.fit.vehicle.has(id_):
            total += float(np.asarray(state.fit.vehicle.effect(id_).power_w)) * on
    return total


def _tested(rows: StateRows, training: Training, rng: np.random.Generator) -> _Tested | None:
    """The load that explains most of these rows, and whether noise of their colour would give as good a one."""
    rows = _some_trips(rows)
    if len(rows.trip) < LEAST_ROWS or np.ptp(rows.residual_w) <= 0 or not np.all(np.isfinite(rows.residual_w)):
        return None
    model, gain = _best(rows)
    noise = estimate_noise(rows.residual_w, rows.trip, rows.duration_s, levels=training.clusters.kind == "trip")
    others = []
    for _ in range(training.settings.shifts):
        others.append(_best(replace(rows, residual_w=_surrogate(rows, noise, rng)))[1])
        if len(others) == EARLY and gain <= max(others):
            return _Tested(model, gain, 1.0)
    spread = max(float(np.std(others, ddof=1)), LEAST_SPREAD) * np.sqrt(1.0 + 1.0 / len(others))
    p = float(stats.t.sf((gain - np.mean(others)) / spread, len(others) - 1))
    return _Tested(model, gain, p)


def _some_trips(rows: StateRows) -> StateRows:
    """Whole trips, evenly spread over the log, of at most `MOST_ROWS` rows in all; one trip at least."""
    slices = [s for _, s in trip_slices(rows.trip)]
    every = int(np.ceil(len(rows.trip) / MOST_ROWS))
    return rows if every < 2 else rows.take(np.concatenate([np.arange(s.start, s.stop) for s in slices[::every]]))


def _best(rows: StateRows) -> tuple[Switching, float]:
    """The load that gains most over errors alone, and its gain in log-likelihood; from several starts."""
    alone, memory = errors_alone(rows)
    tried: list[tuple[Switching, Decoded]] = []
    for seconds in COARSE_S:
        coarse = rows.coarse(seconds)
        if len(coarse.trip) >= LEAST_ROWS and (not tried or len(coarse.trip) < len(rows.trip)):
            tried.append(fit_switching(_two_levels(coarse, memory), rows, 1))
    first = max(tried, key=lambda t: t[1].log_likelihood)[0]
    model, decoded = fit_switching(first, rows, FIRST_ROUNDS + 1)
    return model if model.power_w[0] > 0 else model.turned(), decoded.log_likelihood - alone


def _two_levels(coarse: StateRows, memory: float) -> Switching:
    """Two levels of means over some seconds by their 2-means, and how often they change."""
    x = coarse.residual_w
    low, high = np.quantile(x, (0.1, 0.9))
    for _ in range(20):
        on = x > 0.5 * (low + high)
        if not 0 < np.count_nonzero(on) < len(on):
            break
        low, high = float(np.mean(x[~on])), float(np.mean(x[on]))
    on = (x > 0.5 * (low + high)).astype(float)
    share = float(np.clip(np.mean(on), 0.05, 0.95))
    switches = float(np.sum(np.abs(np.diff(on))[np.diff(coarse.trip) == 0]))
    stays = 2.0 * share * (1.0 - share) * float(np.sum(coarse.duration_s)) / max(switches, 1.0)
    scale = np.full(2, float(np.mean(np.abs(x - np.where(on > 0, high, low)))) + 1e-9)
    return Switching(
        np.array([max(high - low, 1e-6)]), low, scale, np.full((1, len(KNOTS_C)), share), np.array([max(stays, 30.0)]),
        0.5 * memory,
    )  # fmt: skip


def _besides(one: Switching) -> list[Switching]:
    """Two loads, the second of other powers than the first: that may have been fitted to the levels of both."""
    two = one.plus(replace(one, memory_s=one.memory_s.copy()))
    return [replace(two, power_w=one.power_w[0] * np.array([1.0, r])) for r in BESIDES]


def _surrogate(rows: StateRows, noise: Noise, rng: np.random.Generator) -> np.ndarray:
    """Noise of the residual's own colour: its innovations with random signs, coloured again; the trips' means with
    random signs, too."""
    out = np.empty(len(rows.trip))
    filter_ = np.r_[1.0, -noise.coefficients[-1]]
    for _, s in trip_slices(rows.trip):
        mean = float(np.mean(rows.residual_w[s]))
        innovations = np.asarray(signal.lfilter(filter_, [1.0], rows.residual_w[s] - mean))
        drawn = innovations * rng.choice((-1.0, 1.0), len(innovations))
        coloured = np.asarray(signal.lfilter([1.0], filter_, drawn))
        out[s] = coloured - np.mean(coloured) + mean * rng.choice((-1.0, 1.0))
    return out


def _alone(rows: StateRows, model: Switching, decoded: Decoded, k: int) -> StateRows:
    """The rows with the other loads taken out."""
    others = [j for j in range(len(model.power_w)) if j != k]
    return replace(rows, residual_w=rows.residual_w - decoded.on[:, others] @ model.power_w[others])


def _power(rows: StateRows, on: np.ndarray) -> tuple[float, float] | None:
    """The power between the two levels of some rows [W] by medians, and its weight: the time [s] at the rarer level.
    None where that is too little."""
    seconds = [float(np.sum(rows.duration_s[x])) for x in (on > 0.9, on < 0.1)]
    if min(seconds) < LEAST_S:
        return None
    return float(np.median(rows.residual_w[on > 0.9]) - np.median(rows.residual_w[on < 0.1])), min(seconds)


def _unlike(rows: StateRows, model: Switching, decoded: Decoded, k: int, settings: Settings) -> str | None:
    """Why a decoded load is not one consumer that is switched on and off, or None."""
    power, on, alone = float(model.power_w[k]), decoded.on[:, k], _alone(rows, model, decoded, k)
    size = next(p for p in SwitchingLoad.parameters if p.name == "power_w")
    if not size.least <= power <= size.upper:
        return "its power is out of range"
    if np.sum(np.abs(np.diff(on))[np.diff(rows.trip) == 0]) < LEAST_SWITCHES:
        return "it switches too seldom to be told from a change that stays"
    each = [p for _, s in trip_slices(rows.trip) if (p := _power(alone.take(s), on[s])) is not None]
    if len(each) < min(2, len(np.unique(rows.trip))):
        return "it switches in one trip alone"
    by_trip, weight = np.array(each).T
    mean = float(np.average(by_trip, weights=weight))
    if np.sqrt(np.average((by_trip - mean) ** 2, weights=weight)) > settings.alike_spread * power:
        return "its power is not the same in every trip"
    if np.sum(rows.duration_s[rows.standing == 1]) > 4.0 * LEAST_S:
        standing, moving = (_power(alone.take(x), on[x]) for x in (rows.standing == 1, rows.standing == 0))
        if standing is None or moving is None:
            return f"it does not switch {'at standstill' if standing is None else 'in motion'}"
        if abs(standing[0] - moving[0]) > settings.alike_spread * power:
            return f"it has {standing[0] / 1e3:.2g} kW at standstill and {moving[0] / 1e3:.2g} kW in motion"
    return None


def _stability(
    rows: StateRows, model: Switching, decoded: Decoded, k: int, rng: np.random.Generator, settings: Settings
) -> float:
    """Share of resampled sets of trips in which the load explains more than it costs."""
    alone = _alone(rows, model, decoded, k).residual_w
    with_it = model.base_w + decoded.on[:, k] * model.power_w[k]
    each = (np.abs(alone - np.median(alone)) - np.abs(alone - with_it)) / model.scale_w[rows.standing]
    gains = np.array([np.sum(each[s]) for _, s in trip_slices(rows.trip)])
    drawn = rng.integers(0, len(gains), (settings.resamples, len(gains)))
    return float(np.mean(np.sum(gains[drawn], axis=1) > settings.size_cost))
