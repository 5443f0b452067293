"""The loop end to end on one log: from a sheet to what it misses, with the error before and after."""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from hdev_jax.diagnosis.competition.search import search
from hdev_jax.diagnosis.remainder.rest import told_apart
from hdev_jax.diagnosis.result.memory import from_plain, to_plain
from hdev_jax.diagnosis.result.next_drive import advise
from hdev_jax.diagnosis.result.shapes import left_open
from hdev_jax.diagnosis.result.summary import parameters_of, summarise
from hdev_jax.diagnosis.scores.look import Loop, Search
from hdev_jax.errors import InputError
from hdev_jax.inference import Calibration, cluster_rows, padded
from hdev_jax.physics import Effect, Vehicle, most_group
from hdev_jax.problem import Problem, Split

__all__ = ["Diagnosis", "diagnose"]

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
    gears = most_group(problem.segments)  # one that no training trip has is left without a size, as in the sheet

    def remember(step: int, compute: Callable[[], Search]) -> Search:
        plain = checkpoint(f"step-{step}", lambda: to_plain(compute()))
        return from_plain(plain, problem.vehicle, library, gears)

    excluded = []
    if problem.target in ("traction_force_n", "motor_torque_nm") and "power_gain" in library:
        library = {k: c for k, c in library.items() if k != "power_gain"}
        excluded = [{"id": "power_gain", "why": "a power sensor's fault is none of a force's or a torque's"}]
    effects = list(library.values())
    state = search(
        problem.vehicle, problem.table, rows, problem.target, effects,
        fdr=fdr, seed=seed, gears=gears, tell=tell, remember=remember,
    )  # fmt: skip
    tell("error before and after on test trips")
    loop = Loop(rows, problem.target, cluster_rows(real), effects, fdr, np.random.default_rng([seed, 999]), gears)
    state, steps, predicted, left = told_apart(problem, split, state, loop, seed=seed, tell=tell, checkpoint=checkpoint)
    base = steps[0]
    leeway = {f.id: left_open(loop, state, f.score, steps[-1]) for f in state.found}
    summary = summarise(problem, split, state, steps, predicted, left, leeway)
    summary["excluded"] = excluded
    rivals = [(f.id, library[t]) for f in state.found for t in f.twins if t in library]
    if rivals:
        tell("what to measure next: drives that would tell the rest apart")
        drives = checkpoint("next", lambda: [asdict(a) for a in advise(problem, state, rows, rivals)])
        summary["next_drives"] = drives
    # a sheet's numbers belong together: sizes as they are known at the shapes that it holds
    sheet = {f.id: parameters_of(f, steps[-1], {}, summary["clusters"]["count"]) for f in state.found}
    found = {k: {n: (p["value"], p["sd"], p["unit"]) for n, p in v.items()} for k, v in sheet.items()}
    return Diagnosis(
        problem, split, summary, base.vehicle, steps[-1].vehicle, steps[-1], predicted[0], predicted[-1], found
    )
