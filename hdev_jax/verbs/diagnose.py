"""The verb `diagnose`: the method on a user's logs, in memory or into a folder."""

import time
from collections.abc import Callable, Sequence
from numbers import Real
from pathlib import Path
from typing import Any

from hdev_jax import progress
from hdev_jax.diagnosis.candidates.own import Effects, known_effects
from hdev_jax.diagnosis.diagnose import Outcome
from hdev_jax.diagnosis.diagnose import diagnose as run_method
from hdev_jax.diagnosis.result.stages import add_stages
from hdev_jax.diagnosis.settings import Settings
from hdev_jax.errors import InputError
from hdev_jax.inference.sheet import Sheet, augmented_sheet
from hdev_jax.logs.checks import Suspicion
from hdev_jax.physics import Effect
from hdev_jax.problem import implausible
from hdev_jax.report.build import answer_text, of_diagnosis
from hdev_jax.rundir import Run, open_run
from hdev_jax.verbs.arguments import names_of
from hdev_jax.verbs.opening import Logs, Opening, Vehicles, chosen_effects, command_line, opened
from hdev_jax.verbs.predict import predictive_of, sheet_digest
from hdev_jax.verbs.result import Diagnosis
from hdev_jax.verbs.states import states_of

__all__ = ["diagnose"]


def diagnose(
    logs: Logs,
    vehicle: Vehicles,
    adapter: str | Path | None = None,
    target: str | None = None,
    train_trips: Sequence[str] | None = None,
    test_trips: Sequence[str] | None = None,
    effects: Effects = None,
    only: Sequence[str] | None = None,
    exclude: Sequence[str] | None = None,
    fdr: float = 0.05,
    *,
    trust: bool = False,
    out: str | Path | None = None,
    seed: int = 0,
) -> Diagnosis:
    """Find what the vehicle's model misses in these logs.

    ```python
    found = hdev_jax.diagnose(frame, hdev_jax.Sheet(mass_kg=18e3, road={"c_rr": (0.006, 0.0008), "cda_m2": (5.6, 0.5)}))
    print(found)
    found.effects
    found.report("bus.html")
    ```

    **Arguments:** as the options of `hdev diagnose`.

    - `logs`: a path or several, a `Log`, or a table in memory.
    - `vehicle`: a sheet's path, a `Sheet`, or a mapping of its sections.
    - `target`: what is explained; by default what the log measures nearest the battery.
    - `train_trips`, `test_trips`: names of trips; by default every third trip is a test trip.
    - `effects`: your own effects, as a Python file or as classes. `only`, `exclude`: ids of effects.
    - `fdr`: the highest adjusted p-value of an effect that is named.
    - `trust`: search even where a unit or a sign seems to be wrong.
    - `out`: a folder for `diagnosis.json`, `report.html`, figures and `augmented_vehicle.toml`; an interrupted run
      resumes from it.

    **Returns:** a `Diagnosis`; `str()` is the answer as text. **Raises:** `InputError` for faults of the input.
    """
    started = time.time()
    if not isinstance(fdr, Real) or not 0.0 < fdr < 1.0:
        raise InputError(f"fdr {fdr!r}: a number between 0 and 1 is expected")
    only, exclude = names_of(only), names_of(exclude)
    known = known_effects(effects)
    candidates = chosen_effects(known, only, exclude)
    start = opened(
        "diagnose",
        logs,
        vehicle,
        adapter,
        target,
        train_trips,
        test_trips,
        effects,
        seed,
        known,
        *candidates,
        kept=out is not None,
    )
    why = {k: "--exclude" if k in (exclude or ()) else "not in --only" for k in known if k not in candidates}
    excluded = [{"id": k, "why": w} for k, w in why.items() if not start.problem.vehicle.has(k)]
    found = () if trust else implausible(start.problem, start.split.train)
    candidates = {} if found else candidates
    if out is None:
        progress.step(start.read)
        return _diagnosed(start, candidates, excluded, fdr, seed, started, suspected=found)
    config = {
        **start.config,
        "only": None if only is None else list(only),
        "exclude": None if exclude is None else list(exclude),
        "fdr": fdr,
        **({"trust": True} if trust else {}),
    }
    with open_run(out, config, seed=seed) as run:
        if run.done:
            return Diagnosis.of_folder(run.work)
        progress.step(start.read)
        result = _diagnosed(start, candidates, excluded, fdr, seed, started, run, suspected=found)
        result.write(run, out)
    return result


def _diagnosed(
    start: Opening, candidates: dict[str, type[Effect]], excluded: list[dict[str, str]], fdr: float, seed: int,
    started: float, run: Run | None = None, *, suspected: tuple[Suspicion, ...] = (),
) -> Diagnosis:  # fmt: skip
    """The diagnosis in memory; with a run, each stage is kept in its folder. What is `suspected` ends it at the
    calibration: no effect is named on a log whose unit or sign is in doubt."""
    checkpoint: Callable[[str, Callable[[], Any]], Any] = (lambda _, c: c()) if run is None else run.checkpoint
    how = {"settings": Settings(fdr=fdr), "seed": seed, "tell": progress.step, "checkpoint": checkpoint}
    outcome = run_method(start.problem, start.split, candidates, **how)
    add_stages(outcome, candidates, **how)
    outcome.summary["excluded"] += excluded
    text = ""
    if suspected:
        suspect = {"verdict": "suspect_log", "suspicions": [s.to_dict() for s in suspected]}
        outcome.summary.update(suspect)
        said = [s.line() for s in suspected]
        outcome.summary["notes"] = [f"suspected: {line}" for line in said] + outcome.summary["notes"]
        text = "\n".join(["The log is suspect; no effect was searched for (--trust searches nonetheless):", *said])
    sheet = _augmented(outcome, start.sheet)
    predictive, notes = predictive_of(start.problem, start.split, outcome.fit, "normal", sheet_digest(sheet))
    outcome.summary["notes"] += notes
    if outcome.given is not None:
        predictive["states"] = states_of(outcome.given.ids, outcome.given.model)
    progress.step("writing the report")
    data = of_diagnosis(outcome, command_line("diagnose", run), started)
    return Diagnosis(text or answer_text(data), outcome.summary, sheet, predictive, data)


def _augmented(outcome: Outcome, sheet: Sheet) -> str:
    fit = outcome.fit
    values = {
        c.name: (float(v), float(s))
        for c, v, s in zip(fit.table.free, fit.values, fit.sd, strict=True)
        if c.path.rpartition(".")[0].removeprefix("effects.") not in outcome.found
    }
    return augmented_sheet(sheet, values, outcome.found)
