"""What is left once the search has ended, and which effects were no more than its stand-ins.

The mean of a cause that the library does not hold is left to whatever named cause comes nearest. Such an effect is
taken out again and what is left is looked at anew.
"""

from collections.abc import Callable, Collection, Mapping
from dataclasses import asdict, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hdev_jax.diagnosis.candidates.expression import Described, Factor, find_expression
from hdev_jax.diagnosis.competition.refit import as_known, refitted, without
from hdev_jax.diagnosis.competition.select import prune
from hdev_jax.diagnosis.remainder.hint import find_hint
from hdev_jax.diagnosis.remainder.standins import beside, stand_ins
from hdev_jax.diagnosis.remainder.unexplained import LEAST_SHARE, Remainder, Rows, remainder, swing_w
from hdev_jax.diagnosis.scores.look import Loop, Search, Verdict
from hdev_jax.inference import Calibration, calibrate, cluster_rows
from hdev_jax.inference.sheet import BATTERY_TARGETS
from hdev_jax.physics.across import distance_since_start
from hdev_jax.physics.loads import PeriodicLoad
from hdev_jax.problem import Problem, Split

__all__ = ["told_apart"]

SECONDS_PER_WH_OF_A_KW = 3.6
CONSTANTS = {("auxiliary_power", "power_w"), ("power_gain", "offset_w")}  # loads that read nothing and choose nothing
MEAN_OVER_SWING = 2.0  # of a load that is on for up to 78 % of its cycle, over its basic wave's amplitude
MEAN_OF_MORE = "the mean of something larger that is left unexplained, not a cause of its own"
Tell = Callable[[str], None]
Checkpoint = Callable[[str, Callable[[], Any]], Any]


def told_apart(
    problem: Problem, split: Split, state: Search, loop: Loop, *, seed: int, tell: Tell, checkpoint: Checkpoint
) -> tuple[Search, list[Calibration], list[np.ndarray], Remainder]:
    """What is left told apart from what was found.

    **Returns:** the state without effects that only stood in for what is left; the declared model's fit and that with
    each effect in turn, the last as whitened rows know it where nothing is left (`as_known`); their predictions on all
    rows; and what is left.
    """
    train, first = problem.rows(split.train), {}

    def fresh() -> Loop:  # what is kept of an earlier round draws nothing: every stage has its own numbers
        return replace(loop, rng=np.random.default_rng([seed, 999]))

    for round_ in range(len(state.found) + 1):  # each takes one out at least, until none goes
        steps = _path(problem, state, loop)
        predicted = [problem.predict(fit.vehicle) for fit in steps]
        plain = checkpoint(
            f"remainder-{round_}",
            lambda p=predicted: _remainder(problem, split, p[-1], p[0], seed, tell).__dict__,
        )
        left = Remainder(**plain)
        told = checkpoint(
            f"formula-{round_}",
            lambda s=state, p=predicted[-1], f=first, r=left: _formula(problem, train, s, fresh(), p, f, r, tell),
        )
        asked = tuple(f.id for f in state.found) if told else ()
        if told:
            left, first = _described(problem, split, left, told, predicted[-1]), told
        elif np.any(left.cycle_w):
            small = _small(problem, state, loop, predicted, train, _most(problem, train, left.cycle_w))
            told = checkpoint(
                f"cycle-{round_}", lambda s=state, k=small, c=left.cycle_w: _beside_cycle(s, fresh(), c, k, tell)
            )
            asked = tuple(told.get("asked", ()))
        else:
            told = checkpoint(
                f"hint-{round_}", lambda s=state, p=predicted: _hinted(problem, s, fresh(), p, train, tell)
            )
            if told:
                left = left.hinted(told["words"], told["channels"], told["rms"])
            elif state.found and problem.target in BATTERY_TARGETS:
                told = checkpoint(
                    f"covered-{round_}",
                    lambda s=state, p=predicted: _beside_covered(problem, s, fresh(), p, train, tell),
                )
            asked = tuple(told.get("asked", ()))
        gone = next(iter(told.get("superfluous", ())), None)
        description = "the formula" if "formula" in told else "what rows follow" if "words" in told else "the cycle"
        whose = "that it covered" if "covered" in told else "for what is left"
        why = f"not found again beside {description} {whose}"
        if gone is None:  # of what was asked about, that word stands
            gone, why = _shadow(problem, state, predicted, train, left, asked), MEAN_OF_MORE
        if gone is None:
            break
        tell(f"taking {gone} out: {why}")
        state = _gone(loop, state, gone, why, tell)
    if state.found and not left.rms:  # of training rows alone: what test rows say of the rest is no choice
        known = as_known(loop, state)
        steps, predicted = [*steps[:-1], known], [*predicted[:-1], problem.predict(known.vehicle)]
        test = problem.rows(split.test)
        left = replace(left, noise_floor_rmse=float(np.sqrt(np.mean((problem.measured - predicted[-1])[test] ** 2))))
    return state, steps, predicted, left


def _formula(
    problem: Problem, train: np.ndarray, state: Search, loop: Loop, predicted: np.ndarray,
    first: Mapping[str, Any], left: Remainder, tell: Tell,
) -> dict[str, Any]:  # fmt: skip
    """A formula for what is left, as plain values; empty where none clears the bar. That of the round before, `first`,
    is tried before others.

    Where what is `left` is a cycle, what only trips tell is no formula: it would be the cycle's mean in each of them.
    """
    tell("what is left: a formula from the log's own channels")
    before = {"first": tuple(Factor(**f) for f in first["factors"]), "ways": first["ways"]} if first else {}
    found = find_expression(state, loop, problem.segments, predict=problem.predict, **before)
    if found is None or (np.any(left.cycle_w) and found.state.found[-1].between):
        return {}
    rms = float(np.sqrt(np.mean((found.predicted - predicted)[train] ** 2)))
    if rms**2 < LEAST_SHARE * np.mean((problem.measured - predicted)[train] ** 2):
        return {}  # real perhaps, but it explains nothing
    channels = tuple(dict.fromkeys(f.name for f in found.factors))
    kept = {f.id for f in prune(found.loop, found.state, tell).found}
    again = [f.id for f in state.found if f.id not in kept]
    beside_it = replace(found.loop, fdr=loop.fdr)
    again += stand_ins(beside_it, found.state, channels, tell, kept - {Described.id})
    return {
        "formula": found.formula, "factors": [asdict(f) for f in found.factors], "channels": list(channels),
        "rms": rms, "ways": found.ways, "predicted": found.predicted, "superfluous": again,
    }  # fmt: skip


def _beside_cycle(state: Search, loop: Loop, cycle_w: np.ndarray, asked: Collection[str], tell: Tell) -> dict[str, Any]:
    """Which of the effects asked for are not found again beside a load as large in each trip as the cycle there, as
    plain values; empty where none is asked for.

    Beside a fit that did not converge they are asked all the same: a cycle is a fact, and what is not found again
    beside it is named on its account.
    """
    if not asked:
        return {}
    load = np.r_[cycle_w, np.zeros(len(loop.rows.measured) - len(cycle_w))]
    return {"asked": list(asked), "superfluous": list(stand_ins(*beside(loop, state, load), (), tell, asked))}


def _beside_covered(
    problem: Problem, state: Search, loop: Loop, predicted: list[np.ndarray], train: np.ndarray, tell: Tell
) -> dict[str, Any]:
    """Whether the last effect to take a cycle out of sight is found again beside that cycle, as plain values; empty
    where none did.

    A cycle that is slow for its trips has a mean in each of them. What trips differ by may take so much of it that the
    peak in the spectrum no longer passes, though before the effect was added one does, and without it now. What was
    found before a periodic load covers none of its cycle: that load is the cycle.
    """

    def cycle_without(prediction: np.ndarray) -> np.ndarray:
        return swing_w(_side(problem, train, prediction, np.zeros((len(prediction), 0))))

    tell("what is left: a cycle that an effect covers")
    ids = [f.id for f in state.found]
    first = ids.index(PeriodicLoad.id) + 1 if PeriodicLoad.id in ids else 0
    k = next((k for k in reversed(range(first, len(ids))) if np.any(cycle_without(predicted[k]))), None)
    if k is None or not np.any(cycle_w := cycle_without(problem.predict(without(loop, state, ids[k]).fit.vehicle))):
        return {}
    small = _small(problem, state, loop, predicted, train, _most(problem, train, cycle_w), of=(ids[k],))
    told = _beside_cycle(state, loop, cycle_w, small, tell)
    return told and {**told, "covered": True}


def _hinted(
    problem: Problem, state: Search, loop: Loop, predicted: list[np.ndarray], train: np.ndarray, tell: Tell
) -> dict[str, Any]:
    """What rows follow though no formula is borne out, as plain values; empty where they follow nothing."""
    tell("what is left: what its rows follow")
    hint = find_hint(state, loop)
    if hint is None:
        return {}
    rms = float(np.sqrt(np.mean(hint.column[: loop.rows.rows] ** 2)))
    beside_it, known = beside(loop, state, 1000.0 * hint.column / rms)
    swing = float(np.std(known.fit.predicted - state.fit.predicted))
    if swing**2 < LEAST_SHARE * np.mean((problem.measured - predicted[-1])[train] ** 2):
        return {}
    channels = tuple(dict.fromkeys(f.name for f in hint.factors))
    # a mean as it goes with a wave of the same variance; nothing is asked beside a fit that did not converge
    most = 2.0 * (MEAN_OVER_SWING * swing) ** 2
    asked = _small(problem, state, loop, predicted, train, most) if known.fit.converged else ()
    gone = stand_ins(beside_it, known, channels, tell, asked)
    return {
        "words": hint.words(), "channels": list(channels), "rms": swing,
        "asked": list(asked), "superfluous": list(gone),
    }  # fmt: skip


def _most(problem: Problem, train: np.ndarray, cycle_w: np.ndarray) -> float:
    """Mean square, in the target's unit, of the mean that a load with a cycle of this amplitude can have."""
    to_unit = np.asarray(problem.segments.duration_s)[train] / 3600.0 if problem.target == "energy_wh" else 1e-3
    return float(np.mean((MEAN_OVER_SWING * cycle_w * to_unit) ** 2))


def _small(
    problem: Problem, state: Search, loop: Loop, predicted: list[np.ndarray], train: np.ndarray, most: float,
    of: Collection[str] | None = None,
) -> tuple[str, ...]:  # fmt: skip
    """Effects, of these or of all, that explain no more of the training rows than the mean (`most`, its square) of what
    is left could, when they were found or now, beside all others.

    A heater's cycle is larger in the cold, and beside it what the cabin takes is hardly found again: but it takes more
    than a swing of this size could, and so is no stand-in for it.
    """
    mse = float(np.mean((problem.measured - predicted[-1])[train] ** 2))

    def now(effect_id: str) -> float:
        bare = problem.predict(without(loop, state, effect_id).fit.vehicle)
        return float(np.mean((problem.measured - bare)[train] ** 2)) - mse

    gains = _gains(problem, state, predicted, train)
    return tuple(k for k, gain in gains.items() if (of is None or k in of) and (gain < most or now(k) < most))


def _gains(problem: Problem, state: Search, predicted: list[np.ndarray], train: np.ndarray) -> dict[str, float]:
    """What each found effect, in its turn, takes off the mean square of the training rows' residual."""
    mse = [float(np.mean((problem.measured - p)[train] ** 2)) for p in predicted]
    return {f.id: max(mse[k] - mse[k + 1], 0.0) for k, f in enumerate(state.found)}


def _described(
    problem: Problem, split: Split, left: Remainder, found: Mapping[str, Any], predicted: np.ndarray
) -> Remainder:
    test = problem.rows(split.test)
    error = [float(np.sqrt(np.mean((problem.measured - p)[test] ** 2))) for p in (predicted, found["predicted"])]
    return left.described(found["formula"], found["channels"], found["rms"], problem.unit, (error[0], error[1]))


def _shadow(
    problem: Problem, state: Search, predicted: list[np.ndarray], train: np.ndarray, left: Remainder,
    asked: Collection[str],
) -> str | None:  # fmt: skip
    """A found effect that may be no more than the mean of the structure that is left, the latest first, of those that
    were not `asked` about beside a description of it.

    The mean of a cause that the library does not hold is one of the `CONSTANTS`. One that explains less than what is
    left (`left.rms`) is no cause of its own. Both are of training rows: no choice sees the others.
    """
    gains = _gains(problem, state, predicted, train)
    for f in reversed(state.found):
        if f.id in asked:
            continue
        if {(f.id, size) for size in f.score.candidate.sizes} <= CONSTANTS and gains[f.id] < left.rms**2:
            return f.id
    return None


def _gone(loop: Loop, state: Search, effect_id: str, why: str, tell: Tell) -> Search:
    """The state without a stand-in and without what `prune` finds superfluous now, with the verdict on each."""
    left = prune(loop, without(loop, state, effect_id), tell, newest=True)
    kept, beside_it = {f.id for f in left.found}, f"not told from nothing without {effect_id}, which was taken out"
    gone = [f for f in state.found if f.id not in kept]
    verdicts = [Verdict(f.id, f.score.gain, f.q_value, why if f.id == effect_id else beside_it) for f in gone]
    return replace(left, verdicts=[*verdicts, *state.verdicts])


def _path(problem: Problem, state: Search, loop: Loop) -> list[Calibration]:
    """The declared model, then with each effect in the order found, each fitted to all training rows."""
    rows, clusters = loop.rows, loop.clusters
    fits = [calibrate(problem.vehicle, problem.table, rows, problem.target, clusters)]
    for k in range(1, len(state.found)):
        later = [f.id for f in state.found[k:]]
        table = state.table
        for id_ in later:
            table = table.minus(id_)
        vehicle = state.fit.vehicle.minus(*later)
        values = state.trail.get(",".join(f.id for f in state.found[:k]))
        if values is not None:  # fitted when it was found
            fits.append(replace(fits[0], vehicle=table.insert(vehicle, jnp.asarray(values)), table=table))
        else:
            fits.append(refitted(loop, replace(state, vehicle=vehicle, table=table)))
    return [*fits, state.fit] if state.found else fits


def _features(problem: Problem, predicted: np.ndarray, declared: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """What a flexible learner may use: every channel, motion, time and place in the trip, and the models' own words."""
    s = problem.segments
    columns: dict[str, np.ndarray] = {
        "speed_mps": np.asarray(s.speed_mps),
        "acceleration": np.asarray(s.accel_mps2),
        "time_s": np.asarray(s.time_s),
        "distance_since_start_m": np.asarray(distance_since_start(jax.tree.map(jnp.asarray, s))),
        "duration_s": np.asarray(s.duration_s),
        "predicted": predicted,
        "declared": declared,
        **{k: np.asarray(v, dtype=float) for k, v in s.channels.items()},
    }
    names = [k for k, v in columns.items() if np.ptp(v) > 0]
    return np.stack([columns[k] for k in names], axis=1), names


def _remainder(
    problem: Problem, split: Split, predicted: np.ndarray, declared: np.ndarray, seed: int, tell: Tell
) -> Remainder:
    features, names = _features(problem, predicted, declared)
    train, test = (_side(problem, problem.rows(trips), predicted, features) for trips in (split.train, split.test))
    return remainder(train, test, names, problem.unit, problem.log.trip_names, seed=seed, tell=tell)


def _side(problem: Problem, at: np.ndarray, predicted: np.ndarray, features: np.ndarray) -> Rows:
    """Rows of one side of the split with what a prediction leaves of them; predictions and features are of all rows."""
    segments = problem.segments.take(at)
    residual, seconds = (problem.measured - predicted)[at], np.asarray(segments.duration_s)
    worth, unit = np.ones(len(seconds)), problem.unit
    if problem.target == "energy_wh":  # a load in kW, whatever the rows' lengths
        worth, unit = seconds / SECONDS_PER_WH_OF_A_KW, "kW"
    trip, weight = np.asarray(segments.trip), problem.weight()[at]
    meters, energy = np.asarray(segments.distance_m), weight * np.abs(problem.measured[at])
    amounts = {"time": seconds, "distance": meters, "energy": energy}
    return Rows(features[at], residual, cluster_rows(segments), trip, seconds, worth, unit, weight, amounts)
