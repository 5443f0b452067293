"""Running an experiment: its tasks on all cores or a cluster, each once for all time, and what it makes of them.

An experiment is a module with

- `Config`, a `Strict` model, and `tasks(config)`: plain dicts, each decides its result by itself (a task that reads a
  file has the file's fingerprint among its values, a task that draws has its seed); a `KeyError` is a name that the
  config uses and does not define;
- `run(task)`: plain values;
- `collect(config, results, run)`: writes tables and figures into the run's folder and returns its metrics;
- `SOURCES`: the files that a task's result depends on, beside its own: names relative to its folder;
- if it likes, `together(task)`: tasks of the same key (None: none) are one job, run one after another in one process,
  where they share what it compiled; or with `run_together(tasks)` in one call, for small models that are faster in one
  program by `vmap`. A task's result is kept under the task alone, either way;
- if it likes, `alone(task)`: true for a task that measures time. Those run last, one by one, in this process.

What is done is not done again, what was killed resumes, and two runs share what they share: a task's result is kept
under the fingerprint of the task and of its sources, a run under that of its resolved config, its tasks and sources.
"""

import contextlib
import hashlib
import json
import platform
import subprocess
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

from experiments.runner import store
from experiments.runner.compare import check
from experiments.runner.compute import Asked, Where, compute
from experiments.runner.config import artefact, expanded, resolve, shown_point, typed
from experiments.runner.log import Log
from experiments.runner.pages.html import write_page
from experiments.runner.sweep import write_sweep
from hdev_jax.errors import InputError
from hdev_jax.rundir import Run, config_digest, is_complete, open_run

__all__ = ["Plan", "claim_folder", "plan", "run_config", "unfinished"]

MARK = ".hdev-runs"  # a folder of several runs, which another command may add to


@dataclass(frozen=True)
class Plan:
    """A run that is to be: the experiment, its typed config and tasks, and everything that decides its result."""

    name: str
    module: ModuleType
    config: Any
    tasks: list[dict[str, Any]]
    left_out: int
    resolved: dict[str, Any] = field(repr=False)
    delta: dict[str, Any]

    @property
    def asked(self) -> Asked:
        """What is to be computed for it."""
        return Asked(self.name, self.module, self.tasks)


def run_config(
    path: str | Path,
    sets: Sequence[str] = (),
    *,
    out: str | Path,
    workers: int = 1,
    scheduler: str | None = None,
    quickly: bool = False,
    kept: str | Path | None = None,
    fresh: bool = True,
    tiny: bool = False,
    replace: bool = False,
) -> list[dict[str, Any]]:
    """Run a config, or each point of its sweep in a folder of its own under `out`. **Returns** their metrics.

    **Arguments:** `workers`, `scheduler`, `quickly`: see `Where`; `kept`, a folder for the results of tasks that other
    runs may share; without it a run keeps them in its own folder until it is complete, and the points of a sweep share
    one under `out`; `fresh=False` runs no task and reports on those that are kept (`metrics["tasks_left_out"]` says how
    many are not); `tiny` makes the config as small as its table `[tiny]` says; `replace`: a run of another
    configuration in `out` gives way.

    **Raises:** `InputError` where the config or `out` is at fault; what a task raises.
    """
    where = Where(workers, scheduler, quickly)
    shared = Path(kept) if kept is not None else None
    plans = plan(path, sets, tiny=tiny, kept=None if fresh else shared or Path(out) / "tasks")
    refuse_hurry(plans, where)
    if not plans:
        raise InputError(f"{path}: none of its tasks has been run yet; run it without --kept")
    if not plans[0].delta:
        metrics = finish(plans[0], Path(out), where, shared, replace=replace)
        return [{"sweep": {}, "folder": str(out), **metrics}]
    claim_folder(out)
    shared = shared or Path(out) / "tasks"
    todo = unfinished(plans, Path(out))
    log = Log(Path(out) / "log.txt")
    log.say(f"{path}: {len(plans)} runs, {len(plans) - len(todo)} done before")
    if failed := compute([p.asked for p in todo], where, shared, log):
        raise next(iter(failed.values()))
    folders = [folder_of(p, Path(out)) for p in plans]
    found = [
        {"sweep": p.delta, "folder": str(folder), **finish(p, folder, where, shared, replace=True)}
        for p, folder in zip(plans, folders, strict=True)
    ]
    write_sweep(Path(out), path, found)
    log.say("sweep.json, sweep.md, sweep.tex, report.html")
    return found


def folder_of(plan: Plan, out: Path) -> Path:
    """Where a run goes: `out` itself, or for a point of a sweep the folder in it that its content names."""
    return out / config_digest(plan.resolved)[:12] if plan.delta else out


def unfinished(plans: Iterable[Plan], out: Path) -> list[Plan]:
    """Those whose run is not complete under `out`."""
    return [p for p in plans if not is_complete(folder_of(p, out), p.resolved)]


def claim_folder(out: str | Path) -> None:
    """Make the folder `out` one of several runs. **Raises:** `InputError` where it holds something else."""
    try:
        folder = Path(out)
        folder.mkdir(parents=True, exist_ok=True)
        if any(folder.iterdir()) and not (folder / MARK).exists():
            raise InputError(f"--out {out}: holds other files; name a new or an empty folder")
        (folder / MARK).touch()
    except OSError as e:
        raise InputError(f"--out {out}: cannot be written ({e.strerror or e}); name a folder that you may write") from e


def plan(path: str | Path, sets: Sequence[str] = (), *, tiny: bool = False, kept: Path | None = None) -> list[Plan]:
    """A config as runs that are to be: one, or one for each point of its sweep.

    **Arguments:** `kept`: leave out the tasks whose result is not in this folder, and points that have none there.

    **Raises:** `InputError` where the config is at fault, two points of its sweep are one run, or the measured data
    that its tasks need is not there.
    """
    plans: list[Plan] = []
    points: dict[str, dict[str, Any]] = {}
    for delta, table in expanded(resolve(path, sets, tiny=tiny), path):
        module = store.experiment(table.get("experiment"), path)
        config = typed(module.Config, table, path, sets)
        try:
            every = list(module.tasks(config))
        except KeyError as e:
            raise InputError(f"{path}: names {e.args[0]!r}, and has nothing of that name") from e
        tasks = [t for t in every if kept is None or store.place(module, t, kept).exists()]
        resolved = {
            "config": config.model_dump(mode="json"),
            "sources": store.sources(module, collect=True),
            "tasks": len(tasks),
            "tasks_sha256": hashlib.sha256(json.dumps(tasks, sort_keys=True).encode()).hexdigest(),
        }
        if (twin := points.setdefault(config_digest(resolved), delta)) is not delta and tasks:
            raise InputError(f"{path}, table sweep: {shown_point(twin)} and {shown_point(delta)} are one run")
        if tasks or kept is None:
            plans.append(Plan(artefact(path), module, config, tasks, len(every) - len(tasks), resolved, delta))
    return plans


def refuse_hurry(plans: Iterable[Plan], where: Where) -> None:
    """**Raises:** `InputError` for programs that are compiled quickly where a task measures time."""
    for p in plans if where.quickly else ():
        ask = getattr(p.module, "alone", None)
        if ask is not None and any(ask(t) for t in p.tasks):
            raise InputError(f"--compile-quickly: {p.name} measures time, which it would change; run it without")


def finish(plan: Plan, out: Path, where: Where, kept: Path | None, *, replace: bool = False) -> dict[str, Any]:
    """The run in its folder `out`, complete: what tasks are left, its tables and figures. **Returns** its metrics.

    **Arguments:** `kept`, the store of tasks' results (None: in the run's folder until it is complete); `replace`: a
    run of another configuration in `out` gives way to this one.

    **Raises:** `InputError` where `out` holds something else; what a task raises.
    """
    seed = getattr(plan.config, "seed", None)
    with open_run(out, plan.resolved, seed=seed, environment=_environment(where), replace=replace) as run:
        if not run.done:
            log = Log(run.kept("log.txt"))  # what stays there when the run is killed
            log.say(
                f"{plan.name}: {len(plan.tasks)} tasks of {plan.module.__name__}, sources {plan.resolved['sources']}"
            )
            kept = kept or run.kept("tasks")
            if failed := compute([plan.asked], where, kept, log):
                raise next(iter(failed.values()))
            log.say("tables and figures")
            started = time.monotonic()
            places = [store.place(plan.module, t, kept) for t in plan.tasks]
            results = [store.read(p) for p in places]
            pairs = [(t, r["result"]) for t, r in zip(plan.tasks, results, strict=True)]
            metrics = _collected(plan, pairs, run)
            metrics |= {
                "tasks_left_out": plan.left_out,
                "tasks_in_one_program": sum(r["together"] > 1 for r in results),
                "seconds": round(sum(r["seconds"] for r in results) + time.monotonic() - started, 1),
            }
            check(metrics)
            text = json.dumps(metrics, indent=1, allow_nan=False) + "\n"
            write_page(run, metrics)
            run.path("metrics.json").write_text(text)
            log.say(f"done, {metrics['seconds']} s in all tasks and here")
            run.path("log.txt").write_bytes(log.path.read_bytes())
        return json.loads((run.work / "metrics.json").read_text())


def _collected(plan: Plan, pairs: list[tuple[dict[str, Any], Any]], run: Run) -> dict[str, Any]:
    """What the experiment makes of its results. Raises `InputError` where it cannot without the tasks left out."""
    try:
        return plan.module.collect(plan.config, pairs, run)
    except (LookupError, StopIteration, ValueError) as e:
        if not plan.left_out:
            raise
        raise InputError(f"{plan.name}: cannot be shown: {plan.left_out} of its tasks have not been run") from e


def _environment(where: Where) -> dict[str, Any]:
    """What decides speed, and which commit of the checkout runs, beside what every run records."""
    known = {"workers": where.workers, "scheduler": where.scheduler, "machine": platform.machine()}
    with contextlib.suppress(OSError, subprocess.SubprocessError):
        git = ["git", "-C", str(store.HERE), "describe", "--always", "--dirty", "--abbrev=12"]
        known["commit"] = subprocess.run(git, capture_output=True, text=True, timeout=10, check=True).stdout.strip()
    return known
