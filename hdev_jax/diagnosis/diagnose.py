"""The loop end to end on one log: from a sheet to what it misses, with the error before and after."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hdev_jax.diagnosis.expression import find_expression
from hdev_jax.diagnosis.look import Loop, Search, Verdict
from hdev_jax.diagnosis.memory import from_plain, to_plain
from hdev_jax.diagnosis.next_drive import advise
from hdev_jax.diagnosis.problem import Problem
from hdev_jax.diagnosis.select import search
from hdev_jax.diagnosis.split import Split
from hdev_jax.diagnosis.summary import summarise
from hdev_jax.diagnosis.unexplained import LEAST_SHARE, Remainder, Rows, remainder
from hdev_jax.errors import InputError
from hdev_jax.inference import Calibration, Fit, calibrate, cluster_rows, padded
from hdev_jax.physics import Effect, Vehicle, most_group
from hdev_jax.physics.across import distance_since_start

__all__ = ["Diagnosis", "diagnose"]

MOST_SHADOWS = 4
SECONDS_PER_WH_OF_A_KW = 3.6
Tell = Callable[[str], None]
Checkpoint = Callable[[str, Callable[[], Any]], Any]


@dataclass(frozen=True)
class Diagnosis:
    """What came out: `summary` is diagnosis.json, `before` and `after` the two vehicles, the columns for figures."""

    problem: Problem
    split: Split
    summary: dict[str, Any]
    before: Vehicle
    after: Vehicle
    fit: Calibration
    predicted_before: np.ndarray
    predicted_after: np.ndarray
    found: dict[str, dict[str, tuple[float, float, str]]]


def diagnose(
    problem: Problem,
    split: Split,
    library: Mapping[str, type[Effect]],
    *,
    fdr: float = 0.05,
    seed: int = 0,
    tell: Tell = lambda _: None,
    checkpoint: Checkpoint = lambda _, compute: compute(),
) -> Diagnosis:
    """Steps 1 to 6 of the loop. Test trips are looked at once, when everything has been chosen.

    **Arguments:** `library`, the candidates by id; `fdr`, the level of false discoveries over all of them; `seed` of
    placebos, resampling and the flexible learner; `checkpoint(name, compute)` keeps plain values of each stage.

    **Returns:** a `Diagnosis`; its `summary` keeps contract §4.
    """
    if problem.target != "energy_wh" and not np.all(np.isfinite(problem.measured)):
        raise InputError("the target holds values that are no numbers; see the ledger of `hdev check`")
    train = problem.rows(split.train)
    rows = padded(problem.segments.take(train), problem.measured[train])
    real = problem.segments.take(train)
    gears = most_group(real)

    def remember(step: int, compute: Callable[[], Search]) -> Search:
        plain = checkpoint(f"step-{step}", lambda: to_plain(compute()))
        return from_plain(plain, problem.vehicle, library, gears)

    if problem.target in ("traction_force_n", "motor_torque_nm"):  # a power sensor's fault is none of theirs
        library = {k: c for k, c in library.items() if k != "power_gain"}
    state = search(
        problem.vehicle, problem.table, rows, problem.target, list(library.values()),
        fdr=fdr, seed=seed, tell=tell, remember=remember,
    )  # fmt: skip
    tell("error before and after on test trips")
    for round_ in range(MOST_SHADOWS + 1):
        steps = _path(problem, state, rows)
        predicted = [problem.predict(fit.vehicle) for fit in steps]
        plain = checkpoint(
            f"remainder-{round_}",
            lambda p=predicted: _remainder(problem, split, p[-1], p[0], seed, tell).__dict__,
        )
        left = Remainder(**plain)
        found_formula = checkpoint(
            f"formula-{round_}", lambda s=state, p=predicted[-1]: _formula(problem, s, rows, p, fdr, seed, gears, tell)
        )
        if found_formula:
            left = _described(problem, split, left, found_formula, predicted[-1])
        stand_ins = found_formula["superfluous"] if found_formula else []
        shadow = stand_ins[0] if stand_ins else _shadow(problem, state, predicted, train, left)
        if shadow is None or round_ == MOST_SHADOWS:
            break
        tell(f"taking {shadow} out: what is left is larger than what it explains")
        state = _without(problem, state, shadow, rows)
    base = steps[0]
    summary = summarise(problem, split, state, steps, predicted, left)
    rivals = [(f.id, library[t]) for f in state.found for t in f.twins if t in library]
    if rivals:
        tell("what to measure next: drives that would tell the rest apart")
        drives = checkpoint("next", lambda: [asdict(a) for a in advise(problem, state, rows, rivals)])
        summary["next_drives"] = drives
    found = {
        e["id"]: {k: (p["value"], p["sd"], p["unit"]) for k, p in e["parameters"].items()} for e in summary["effects"]
    }
    return Diagnosis(
        problem, split, summary, base.vehicle, steps[-1].vehicle, steps[-1], predicted[0], predicted[-1], found
    )


def _formula(
    problem: Problem, state: Search, rows: Fit, predicted: np.ndarray, fdr: float, seed: int, gears: int, tell: Tell
) -> dict[str, Any]:
    """A formula for what is left, as plain values; empty where none clears the bar."""
    tell("what is left: a formula from the log's own channels")
    clusters = cluster_rows(rows.segments.take(np.arange(rows.rows)))
    loop = Loop(rows, problem.target, clusters, (), fdr, np.random.default_rng([seed, 999]), gears)
    found = find_expression(state, loop, problem.segments, predict=problem.predict)
    if found is None:
        return {}
    rms = float(np.sqrt(np.mean((found.predicted - predicted) ** 2)))
    if rms**2 < LEAST_SHARE * np.mean((problem.measured - predicted) ** 2):
        return {}  # real perhaps, but it explains nothing
    return {
        "formula": found.formula, "channels": list(found.channels), "rms": rms, "predicted": found.predicted,
        "superfluous": list(found.superfluous),
    }  # fmt: skip


def _described(
    problem: Problem, split: Split, left: Remainder, found: Mapping[str, Any], predicted: np.ndarray
) -> Remainder:
    test = problem.rows(split.test)
    error = [float(np.sqrt(np.mean((problem.measured - p)[test] ** 2))) for p in (predicted, found["predicted"])]
    return left.described(found["formula"], found["channels"], found["rms"], problem.unit, (error[0], error[1]))


def _shadow(
    problem: Problem, state: Search, predicted: list[np.ndarray], train: np.ndarray, left: Remainder
) -> str | None:
    """A found effect that may be no more than the mean of the structure that is left, the latest first.

    The mean of a cause that the library does not hold is a constant load: one that reads no channel and explains less
    than what is left is no cause of its own. The mean in each trip of a cycle is something that differs between trips:
    what only trips tell is none, where a load in proportion to the cycle's swing in each of them explains as much.
    """
    if not left.significant:
        return None
    mse = [float(np.mean((problem.measured - p)[train] ** 2)) for p in predicted]
    for k, f in reversed(list(enumerate(state.found))):
        effect = f.score.candidate.effect
        gain = max(mse[k] - mse[k + 1], 0.0)
        constant = effect.stage == "battery" and not (effect.needs or effect.searched)
        reads_nothing = effect.id == "power_gain" or constant
        residual = (problem.measured - predicted[k])[train]
        swing = float(left.cycle @ residual) ** 2 / max(float(left.cycle @ left.cycle), 1e-300) / len(residual)
        if (reads_nothing and gain < left.rms**2) or (f.between and gain <= swing):
            return f.id
    return None


def _without(problem: Problem, state: Search, effect_id: str, rows: Fit) -> Search:
    """The state with one effect taken out again and the rest refitted."""
    table, vehicle = state.table.minus(effect_id), state.fit.vehicle.minus(effect_id)
    clusters = cluster_rows(rows.segments.take(np.arange(rows.rows)))
    fit = calibrate(vehicle, table, rows, problem.target, clusters)
    gone = next(f for f in state.found if f.id == effect_id)
    why = "the mean of something larger that is left unexplained, not a cause of its own"
    verdicts = [Verdict(effect_id, gone.score.gain, gone.q_value, why), *state.verdicts]
    found = [f for f in state.found if f.id != effect_id]
    return replace(state, vehicle=fit.vehicle, table=table, fit=fit, found=found, verdicts=verdicts)


def _path(problem: Problem, state: Search, rows: Fit) -> list[Calibration]:
    """The declared model, then with each effect in the order found, each fitted to all training rows."""
    real = rows.segments.take(np.arange(rows.rows))
    clusters = cluster_rows(real)
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
            fits.append(calibrate(vehicle, table, rows, problem.target, clusters))
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

    def side(trips: Sequence[int]) -> Rows:
        at = problem.rows(trips)
        segments = problem.segments.take(at)
        residual, seconds = (problem.measured - predicted)[at], np.asarray(segments.duration_s)
        energy = problem.target == "energy_wh"  # a load in kW, whatever the rows' lengths
        worth, unit = (seconds / SECONDS_PER_WH_OF_A_KW, "kW") if energy else (np.ones(len(seconds)), problem.unit)
        trip = np.asarray(segments.trip)
        return Rows(features[at], residual, cluster_rows(segments), trip, seconds, worth, unit)

    trip_names = problem.log.trip_names
    return remainder(side(split.train), side(split.test), names, problem.unit, trip_names, seed=seed, tell=tell)
