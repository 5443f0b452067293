"""The method, step by step: from a log and a sheet to what the sheet lacks, with the error before and after."""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from threadpoolctl import ThreadpoolController

from hdev_jax.diagnosis.candidates.unnamed import TERM, Described, formula
from hdev_jax.diagnosis.competition.compete import compete, named_alone, no_instrument_named, none_named, rows_with
from hdev_jax.diagnosis.competition.refit import as_reported
from hdev_jax.diagnosis.competition.state import State
from hdev_jax.diagnosis.gates.gates import MOST_IN_CLASS
from hdev_jax.diagnosis.gates.held_out import held_out_gain
from hdev_jax.diagnosis.remainder.remainder import Formula, Remainder, remainder
from hdev_jax.diagnosis.result.checkpoint import from_plain, to_plain
from hdev_jax.diagnosis.result.hidden import Given, given_states
from hdev_jax.diagnosis.result.intervals import left_open
from hdev_jax.diagnosis.result.next_drive import advise
from hdev_jax.diagnosis.result.path import path
from hdev_jax.diagnosis.result.summary import parameters_of, summarise
from hdev_jax.diagnosis.settings import SETTINGS, Settings
from hdev_jax.diagnosis.training import Training
from hdev_jax.errors import InputError
from hdev_jax.inference import Calibration, cluster_rows, padded
from hdev_jax.physics import Effect, Vehicle, most_group
from hdev_jax.problem import Problem, Split
from hdev_jax.targets import TARGETS

__all__ = ["Outcome", "diagnose", "training_of"]

Tell = Callable[[str], None]
Checkpoint = Callable[[str, Callable[[], Any]], Any]


@dataclass(frozen=True)
class Outcome:
    """What came out: `summary` is diagnosis.json, `before` and `after` the two vehicles, the columns for figures;
    `training`, the rows it was searched on; `given`, the rows with their decoded states, where a load has one."""

    problem: Problem
    split: Split
    summary: dict[str, Any]
    before: Vehicle
    after: Vehicle
    fit: Calibration
    predicted_before: np.ndarray
    predicted_after: np.ndarray
    found: dict[str, dict[str, tuple[float, float, str]]]
    training: Training
    given: Given | None = None


def diagnose(
    problem: Problem,
    split: Split,
    library: Mapping[str, type[Effect]],
    *,
    settings: Settings = SETTINGS,
    seed: int = 0,
    next_drives: bool = True,
    tell: Tell = lambda _: None,
    checkpoint: Checkpoint = lambda _, compute: compute(),
) -> Outcome:
    """What the declared vehicle lacks. Test trips are held out: nothing is chosen by them, but at the end they may
    contradict the model.

    **Arguments:** `library`, the candidates by id; `settings`, the numbers that decide; `seed` of placebos,
    resampling and the flexible learner; `next_drives`, whether to look for drives that separate the members of a
    class; `checkpoint(name, compute)` keeps plain values of each stage.

    **Returns:** an `Outcome`; its `summary` keeps contract §4. Raises `InputError` where the target is not finite.
    """
    # Products of a few hundred rows: more threads than one only wait for each other, long where cores are shared
    with _blas().limit(limits=1, user_api="blas"):
        return _diagnosed(problem, split, library, settings, seed, next_drives, tell, checkpoint)


@cache
def _blas() -> ThreadpoolController:
    return ThreadpoolController()


def _diagnosed(
    problem: Problem, split: Split, library: Mapping[str, type[Effect]], settings: Settings, seed: int,
    next_drives: bool, tell: Tell, checkpoint: Checkpoint,
) -> Outcome:  # fmt: skip
    # 1. The training rows, and the effects that could act on this target
    training, excluded = training_of(problem, split, library, settings)

    # 2. Calibrate the declared model, then let candidates compete until none is added, taken out or exchanged
    def remember(step: int, compute: Callable[[], State]) -> State:
        plain = checkpoint(f"step-{step}", lambda: to_plain(compute()))
        return from_plain(plain, problem.vehicle, training)

    state = compete(training, problem.vehicle, problem.table, seed=seed, tell=tell, remember=remember)

    # 3. The model that is handed out: the named effects alone, by generalised least squares where nothing is missing;
    #    the declared one where the held-out trips contradict them
    # 4. What remains, given the states that were decoded: the term without a name, a flexible learner, cycles, change
    #    points, random intercepts of trips. While most of it is structure, no instrument is the cause; nor is the
    #    payload while most of it behaves like a slope that the log lacks
    tell("error before and after on the held-out test trips")
    training = rows_with(training, state)

    def handed_out(named: State, state: State | None, name: str) -> _Model:
        return _handed_out(
            problem, split, training, named, state, seed=seed, tell=tell, keep=lambda compute: checkpoint(name, compute)
        )

    model = handed_out(named_alone(training, state), state, "remainder")
    lacks = model.left.missing_channels if model.left.missing_share > settings.instrument_share else ()
    share = model.left.missing_share if lacks else model.left.share
    if model.left.significant and share > settings.instrument_share:
        physics = no_instrument_named(training, model.named, share, lacks)
        if physics is not model.named:
            tell("most of what is left is structure, or like a channel that the log lacks: no instrument is named")
            model = handed_out(physics, None, "remainder-2")
    named, steps, predicted, given, left = model

    # 5. Sizes with their intervals, classes, and the drives that separate the members of a class
    leeway = {f.id: left_open(training, named, f.score, steps[-1]) for f in named.found}
    leeway |= {} if given is None else given.left_open
    summary = summarise(problem, split, named, steps, predicted, left, leeway, training, given)
    summary["excluded"] = excluded
    twins = [(f.id, library[t]) for f in named.found for t in f.alike[:MOST_IN_CLASS] if t in library]
    if twins and next_drives:
        tell("what to measure next: drives that separate the members of a class")
        drives = checkpoint("next", lambda: [asdict(a) for a in advise(problem, named, training.rows, twins)])
        summary["next_drives"] = drives
    # a sheet's numbers belong together: sizes as estimated at the shapes that it holds
    sheet = {f.id: parameters_of(f, steps[-1], {}, summary["clusters"]["count"]) for f in named.found}
    found = {k: {n: (p["value"], p["sd"], p["unit"]) for n, p in v.items()} for k, v in sheet.items()}
    return Outcome(
        problem, split, summary, steps[0].vehicle, steps[-1].vehicle, steps[-1], predicted[0], predicted[-1], found,
        training, given,
    )  # fmt: skip


class _Model(NamedTuple):
    """A model that may be handed out: the effects it names, the fits on the way there with their predictions, the
    decoded states, what remains."""

    named: State
    steps: list[Calibration]
    predicted: list[np.ndarray]
    given: Given | None
    left: Remainder


def _handed_out(
    problem: Problem, split: Split, training: Training, named: State, state: State | None, *, seed: int, tell: Tell,
    keep: Callable[[Callable[[], Any]], Any],
) -> _Model:  # fmt: skip
    """The model with the named effects, or the declared one where the held-out trips contradict them. `state` holds
    the term without a name, where it is still to be described.

    Held-out trips know no states: effects with a search of their own (loads that switch, phases and modes by trip) are
    predicted by their means there, so a model that has one is not asked.
    """
    settings = training.settings
    steps = path(training, problem, named)
    predicted = [problem.predict(fit.vehicle, compute=training.kernel.predict) for fit in steps]
    if named.found and not any(f.score.candidate.effect.searched for f in named.found):
        levels = training.clusters.kind == "trip"
        if not held_out_gain(problem, split, predicted[0], predicted[-1], levels=levels) > -settings.ahead:
            tell("rejected by the held-out trips: nothing is named")
            named, steps, predicted, state = none_named(named, steps[0]), steps[:1], predicted[:1], None
    given = given_states(problem, split, named, steps[-1], seed, kernel=training.kernel)
    explained = predicted[-1] if given is None else given.predicted
    described = _formula(problem, training, state, explained, given) if state is not None else None
    plain = keep(
        lambda: (
            remainder(
                problem, split, predicted[-1], predicted[0], described, settings, given=explained, seed=seed, tell=tell
            ).__dict__
        )
    )
    left = Remainder(**plain)
    if named.found and not left.significant:  # beside something unexplained, these weights would fit that
        known = as_reported(training, named)
        last = problem.predict(known.vehicle, compute=training.kernel.predict)
        steps, predicted = [*steps[:-1], known], [*predicted[:-1], last]
        test = problem.rows(split.test)
        left = replace(left, noise_floor_rmse=float(np.sqrt(np.mean((problem.measured - predicted[-1])[test] ** 2))))
        given = given_states(problem, split, named, known, seed, kernel=training.kernel)
    return _Model(named, steps, predicted, given, left)


def training_of(
    problem: Problem, split: Split, library: Mapping[str, type[Effect]], settings: Settings = SETTINGS
) -> tuple[Training, list[dict[str, str]]]:
    """The training rows with the effects that could act on the target; which were excluded, and why."""
    if problem.target != "energy_wh" and not np.all(np.isfinite(problem.measured)):
        raise InputError("the target has missing or infinite values; see the ledger of `hdev check`")
    excluded = []
    if not TARGETS[problem.target].of_battery:
        other = [k for k, c in library.items() if c.of_battery]
        library = {k: c for k, c in library.items() if k not in other}
        excluded = [{"id": k, "why": "it acts on battery power, which this target does not depend on"} for k in other]
    train = problem.rows(split.train)
    real = problem.segments.take(train)
    gears = most_group(problem.segments)  # one in no training trip has no size, as in the sheet
    rows = padded(real, problem.measured[train])
    return Training(rows, problem.target, cluster_rows(real), library, gears, settings), excluded


def _formula(
    problem: Problem, training: Training, state: State, predicted: np.ndarray, given: Given | None
) -> Formula | None:
    """The term without a name, if there is one that explains anything, with the prediction of the model that has it."""
    if not state.terms or state.terms[0].values is not None:  # a cycle's mean: reported with what remains
        return None
    term = state.terms[0]
    at = next(i for i, c in enumerate(state.fit.table.free) if c.path == f"effects.{Described.id}.k")
    words = formula(term, float(state.fit.values[at]), float(state.fit.sd[at]), problem.target)
    everything = (given.segments if given else problem.segments).with_channels(**{TERM: term.column(problem.segments)})
    with_it = problem.predict(state.fit.vehicle, everything)
    train = np.isin(np.asarray(problem.segments.trip), np.unique(training.trip))
    before = float(np.mean((problem.measured - predicted)[train] ** 2))
    if before - float(np.mean((problem.measured - with_it)[train] ** 2)) < training.settings.least_share * before:
        return None  # significant perhaps, but it explains too little
    return Formula(words, term.channels, with_it)
