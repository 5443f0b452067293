"""What remains: how much of the residual the log's channels predict, and what it looks like."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from hdev_jax.diagnosis.noise.noise import estimate_noise, whiten
from hdev_jax.diagnosis.remainder.drift import Drift, Slow, drift_of
from hdev_jax.diagnosis.remainder.learner import curve, learn, share_of
from hdev_jax.diagnosis.remainder.missing import MissingSlope, missing_slope
from hdev_jax.diagnosis.remainder.rows import features, side
from hdev_jax.diagnosis.remainder.structure import (
    GROWS_AS,
    change_point,
    colour,
    levels_of,
    period_of,
    scales_with,
    shared_offset,
)
from hdev_jax.diagnosis.settings import Settings
from hdev_jax.problem import Problem, Split
from hdev_jax.targets import TARGETS, as_watts

__all__ = ["Formula", "Remainder", "remainder"]


@dataclass(frozen=True)
class Remainder:
    """The contract's `unexplained`, and a smooth correction: what a flexible learner would add, by its first channel.

    `scales_with` is what a trip's remainder is in proportion to: `time`, `distance`, `energy`, or None. `trips_differ`
    where random intercepts of trips are significant or suspected: effects that differ between trips alone may be among
    them.
    """

    significant: bool
    share: float
    noise_floor_rmse: float
    depends_on: tuple[str, ...]
    signature: str
    trips_differ: bool = False
    scales_with: str | None = None
    correction: Mapping[str, Any] | None = None  # `channel`, its values `at`, what is added there [`unit`]
    expression: str | None = None
    behaves_like: str = "none"  # what is slow in it: a load, a force, a gain
    sd: float | None = None  # of that: W, N, share of the power
    memory_s: float | None = None
    course: Mapping[str, Any] | None = None  # of what is slow: kWh by trip, and its power in one of the test trips
    missing_channels: tuple[str, ...] = ()  # what the model needs and the log lacks, where the rest behaves like it
    missing_share: float = 0.0  # of the remaining variance that behaves like it
    confirmed: bool = False  # whether cross-validation over training clusters confirms the learner's share


@dataclass(frozen=True)
class Formula:
    """A term without a name that passed the gates: its words, the channels in it, and the prediction with it."""

    words: str
    channels: tuple[str, ...]
    predicted: np.ndarray


def remainder(
    problem: Problem, split: Split, predicted: np.ndarray, declared: np.ndarray, formula: Formula | None,
    settings: Settings, *, given: np.ndarray, seed: int, tell: Callable[[str], None] = lambda _: None,
) -> Remainder:  # fmt: skip
    """Five tests of the residual: the term without a name that passed the gates of the search, a flexible learner
    validated by trip, periods, change points, random intercepts of trips.

    The learner (LightGBM) is trained on training rows; its share is what it predicts of the test residual. It counts
    only where cross-validation over training clusters confirms it. The others are tests against coloured noise. What
    is reported is measured on test rows.

    **Arguments:** predictions of the model with the found effects and of the declared one on every row of the log, and
    `given` the decoded states of its loads, of which the residual is (the first where it has none).
    """
    columns, names = features(problem, predicted, declared)
    train, test = (side(problem, problem.rows(trips), given, columns) for trips in (split.train, split.test))
    tell("what remains: a flexible learner, validated by trip")
    correction, p_learner, order = learn(train, test, names, seed)
    share = share_of(test.residual, correction)
    learned = p_learner < settings.level and share > settings.least_share
    tell("what remains: periods, change points, random intercepts of trips")
    noise = estimate_noise(train.residual, train.trip, train.duration_s, levels=False)
    white = whiten(train.residual[:, None], noise, train.trip, train.duration_s)[:, 0]
    period = period_of(train, noise, settings)
    change = change_point(white, train.trip, settings)
    levels = levels_of(train, train.residual, settings)  # a common offset is part of them, and is separated below
    rmse = float(np.sqrt(np.mean(test.residual**2)))
    # what switches is in no other channel of the log: it stays in the free run's error
    hidden = float(np.mean((problem.measured - predicted)[problem.rows(split.test)] ** 2)) - rmse**2
    floor = rmse * float(np.sqrt(1.0 - (share if learned else 0.0)))
    parts: list[str] = []
    depends: list[str] = []
    after = rmse
    if formula is not None:
        after = float(np.sqrt(np.mean((problem.measured - formula.predicted)[problem.rows(split.test)] ** 2)))
        formula = formula if after < rmse else None  # a description that held-out trips contradict is none
    if formula is not None:
        floor = min(floor, after)
        depends += formula.channels
        error = f"test RMSE {rmse:.4g} → {after:.4g} {problem.unit}"
        parts.append(f"it follows {formula.words}, which is no effect of the library ({error})")
    if learned:
        depends += list(order)
        how = f"{100 * share:.0f} % of its variance depends on {', '.join(order) or 'several channels'}"
        parts.append(f"{how} in a form that no effect of the library has")
    if period is not None:
        seconds, amplitude = period.period_s, period.amplitude
        depends.append("time_s")
        clock = f"{seconds / 60:.0f}-minute" if seconds >= 120 else f"{seconds:.0f}-second"
        parts.append(f"a {clock} cycle of about {amplitude:.3g} {train.cycle_unit}")
    if change is not None:
        where, row = change
        before = (train.trip == where) & (np.arange(len(train.trip)) <= row)
        depends.append("time_s")
        minutes = float(np.sum(train.duration_s[before]) / 60.0)
        parts.append(f"a change inside trip {problem.log.trip_names[where]} after {minutes:.0f} min")
    mean = shared_offset(train) if levels is not None else 0.0
    apart = train.residual - mean
    apart[np.abs(apart) < 1e-9 * abs(mean)] = 0.0  # rounding is no difference between trips
    differing = levels_of(train, apart, settings) if mean else levels
    if differing is not None and differing.significant:
        depends.append("trip_id")
        worst = f"{problem.log.trip_names[differing.worst]} ({differing.level:+.2g} {problem.unit})"
        parts.append(f"random intercepts by trip, sd about {differing.sd:.2g} {problem.unit}, largest in {worst}")
    elif mean and levels is not None and levels.significant:
        parts.append(f"an offset of about {mean:+.2g} {problem.unit} that all trips share")
    floor = float(np.sqrt(floor**2 + max(hidden, 0.0)))
    grows = scales_with(train, settings) if parts else None
    if grows is not None:
        parts.append(f"from trip to trip it grows with {grows}, as {GROWS_AS[grows]} does")
    drift, course, slope = _drift(problem, split, given, settings)
    if slope:
        parts.insert(0, slope.words)
    if drift.words:
        found = "; ".join(parts) or f"no channel of the log explains it, and it is {colour(noise)}"
        signature = f"What is left: {found}; {drift.words}"
    elif parts:
        signature = "What is left: " + "; ".join(parts)
    else:
        signature = "What is left looks like noise: " + colour(noise)
    return Remainder(
        bool(parts), share, floor, tuple(dict.fromkeys(depends)), signature + ".", differing is not None,
        scales_with=grows,
        correction=curve(correction, test, list(names), order[0], problem.unit) if learned and order else None,
        behaves_like=drift.like, sd=drift.sd if np.isfinite(drift.sd) else None, memory_s=drift.memory_s or None,
        course=course, missing_channels=("grade_rad",) if slope else (),
        missing_share=slope.rms**2 if slope else 0.0,
        expression=formula.words if formula is not None else None, confirmed=learned,
    )  # fmt: skip


def _drift(
    problem: Problem, split: Split, given: np.ndarray, settings: Settings
) -> tuple[Drift, dict[str, Any] | None, MissingSlope | None]:
    """What is slow in the training rows' residual of a battery's target, its course in all trips, and the slope that it
    behaves like where the log has none; nothing of another target."""
    if not TARGETS[problem.target].of_battery:
        return Drift("none", float("nan"), 0.0), None, None
    s = problem.segments
    seconds, trip, speed = np.asarray(s.duration_s), np.asarray(s.trip), np.asarray(s.speed_mps)
    residual, predicted = (as_watts(problem.target, x, seconds) for x in (problem.measured - given, given))
    slow = Slow.of(residual, predicted, speed, seconds, trip)
    drift = drift_of(slow.take(np.isin(slow.trip, split.train)), settings)
    slope = missing_slope(problem, split, residual, predicted, drift, settings)
    return drift, drift.course(slow, problem.log.trip_names, split.test), slope
