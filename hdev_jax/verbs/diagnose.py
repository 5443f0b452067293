"""The verb `diagnose`: the loop on a user's logs, into a folder."""

import json
import time
from collections.abc import Sequence
from pathlib import Path

from hdev_jax import progress
from hdev_jax.diagnosis.diagnose import Diagnosis
from hdev_jax.diagnosis.diagnose import diagnose as run_loop
from hdev_jax.diagnosis.result.stages import add_stages
from hdev_jax.diagnosis.settings import Settings
from hdev_jax.inference.sheet import Sheet, augmented_sheet
from hdev_jax.report.build import answer_text, of_diagnosis
from hdev_jax.report.page import write_report
from hdev_jax.rundir import open_run
from hdev_jax.verbs.opening import Paths, chosen_effects, command_line, known_effects, opened
from hdev_jax.verbs.predict import write_predictive

__all__ = ["diagnose"]


def diagnose(
    logs: Paths,
    vehicle: str | Path,
    adapter: str | Path | None = None,
    target: str | None = None,
    train_trips: Sequence[str] | None = None,
    test_trips: Sequence[str] | None = None,
    effects: str | Path | None = None,
    only: Sequence[str] | None = None,
    exclude: Sequence[str] | None = None,
    fdr: float = 0.05,
    *,
    out: str | Path,
    seed: int = 0,
) -> str:
    """Find what the vehicle's model misses in these logs: the loop, into the folder `out`.

    **Arguments:** as the options of `hdev diagnose`. **Returns:** the answer as text; everything else is in `out`:
    `diagnosis.json`, `report.html`, `augmented_vehicle.toml`, figures. Raises `InputError` for faults of the input.
    """
    started = time.time()
    known = known_effects(effects)
    candidates = chosen_effects(known, only, exclude)
    start = opened(
        "diagnose", logs, vehicle, adapter, target, train_trips, test_trips, effects, seed, known, *candidates
    )
    problem, split = start.problem, start.split
    config = {
        **start.config,
        "only": None if only is None else list(only),
        "exclude": None if exclude is None else list(exclude),
        "fdr": fdr,
    }
    with open_run(out, config, seed=seed) as run:
        if run.done:
            return (run.work / "answer.txt").read_text()
        progress.step(start.read)
        how = {"settings": Settings(fdr=fdr), "seed": seed, "tell": progress.step, "checkpoint": run.checkpoint}
        result = run_loop(problem, split, candidates, **how)
        add_stages(result, candidates, **how)
        progress.step("writing the report")
        why = {k: "--exclude" if k in (exclude or ()) else "not in --only" for k in known if k not in candidates}
        result.summary["excluded"] += [{"id": k, "why": w} for k, w in why.items() if not problem.vehicle.has(k)]
        sheet = run.path("augmented_vehicle.toml")
        sheet.write_text(_augmented(result, start.sheet))
        result.summary["notes"] += write_predictive(run, sheet, problem, split, result.fit, "normal")
        data = of_diagnosis(result, command_line("diagnose", run), started)
        run.path("diagnosis.json").write_text(json.dumps(result.summary, indent=1, allow_nan=False) + "\n")
        write_report(data, run.work)
        answer = answer_text(data, Path(out))
        run.path("answer.txt").write_text(answer)
    return answer


def _augmented(result: Diagnosis, sheet: Sheet) -> str:
    fit = result.fit
    values = {
        c.name: (float(v), float(s))
        for c, v, s in zip(fit.table.free, fit.values, fit.sd, strict=True)
        if c.path.rpartition(".")[0].removeprefix("effects.") not in result.found
    }
    return augmented_sheet(sheet, values, result.found)
