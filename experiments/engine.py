"""Running an experiment: its tasks on all cores, each once for all time, and what it makes of their results.

An experiment is a module with a `Config`, `tasks(config)` (plain dicts, each decides its result by itself),
`run(task)` (plain values) and `collect(config, results, run)` (metrics, tables, figures). A task's result is kept
under the fingerprint of the task and of the sources: what is done is not done again, what was killed resumes, and two
runs share what they share.
"""

import hashlib
import importlib
import itertools
import json
import multiprocessing
import os
import shutil
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

from experiments.config import expanded, resolve, typed
from experiments.page import write_page
from hdev_jax import progress
from hdev_jax.errors import InputError
from hdev_jax.rundir import atomic_file, config_digest, open_run

__all__ = ["run_config", "run_tasks"]

ROOT = Path(__file__).parents[1]
EXPERIMENTS = (
    "paper2",
    "paper2_figures",
    "paper2_online",
    "paper2_pedal",
    "paper2_selection",
    "paper2_trips",
    "planted",
)
EVERY = tuple(sorted(p.name for p in Path(__file__).parent.glob("*.py")))
FORGET_EVERY = 40  # tasks: a process that compiles for ever runs out of memory maps
Result = tuple[dict[str, Any], dict[str, Any]]


def run_config(
    path: str | Path,
    sets: Sequence[str] = (),
    *,
    out: str | Path,
    workers: int = 1,
    kept: str | Path | None = None,
    fresh: bool = True,
) -> list[dict[str, Any]]:
    """Run a config, or each point of its sweep in a folder of its own under `out`. **Returns** their metrics.

    **Arguments:** `kept`, a folder for the results of tasks that other runs may share; without it a run keeps them in
    its own folder until it is complete, and the points of a sweep share one under `out`; `fresh=False` runs no task
    and reports on those that are kept (`metrics["tasks_left_out"]` says how many are not).
    """
    table = resolve(path, sets)
    points = list(expanded(table, path))
    found = []
    for delta, config in points:
        folder = Path(out) if len(points) == 1 else Path(out) / config_digest(config, "")[:12]
        shared = Path(kept) if kept is not None else None if len(points) == 1 else Path(out) / "tasks"
        run = _run_one(config, path, folder, workers, shared, fresh)
        found.append({"sweep": delta, "folder": str(folder), **run})
    if len(points) > 1:
        with atomic_file(Path(out) / "sweep.json") as temporary:
            Path(temporary).write_text(json.dumps(found, indent=1, allow_nan=False) + "\n")
    return found


def _run_one(
    config: dict[str, Any], path: str | Path, out: Path, workers: int, kept: Path | None, fresh: bool
) -> dict[str, Any]:
    module = _module(config, path)
    parsed = typed(module.Config, config, path)
    started = time.monotonic()
    resolved = {"config": parsed.model_dump(mode="json"), "sources": sources(EVERY), "fresh": fresh}
    with open_run(out, resolved, seed=config.get("seed")) as run:
        if not run.done:
            tasks = list(module.tasks(parsed))
            own = run.path(".tasks")
            if not fresh:
                tasks = [t for t in tasks if _place(module, t, kept or own).exists()]
            results = list(run_tasks(module, tasks, workers=workers, kept=kept or own))
            progress.step("tables and figures")
            left_out = sum(1 for _ in module.tasks(parsed)) - len(tasks)
            cost = {"tasks_left_out": left_out, "seconds": round(time.monotonic() - started, 1)}
            metrics = {**module.collect(parsed, results, run), **cost}
            write_page(run, metrics)
            shutil.rmtree(own, ignore_errors=True)
            run.path("metrics.json").write_text(json.dumps(metrics, indent=1, allow_nan=False) + "\n")
        return json.loads((run.work / "metrics.json").read_text())


def _module(config: Mapping[str, Any], path: str | Path) -> ModuleType:
    name = config.get("experiment")
    if name not in EXPERIMENTS:
        raise InputError(f"{path}, key experiment: one of {', '.join(EXPERIMENTS)} is expected, found {name!r}")
    return importlib.import_module(f"experiments.{name}")


def run_tasks(module: ModuleType, tasks: Sequence[dict[str, Any]], *, workers: int, kept: Path) -> Iterator[Result]:
    """`(task, result)` in the order of the tasks; those that are kept are read, the others run, `workers` at once."""
    places = [_place(module, task, kept) for task in tasks]
    todo = [i for i, p in enumerate(places) if not p.exists()]
    progress.step(f"{len(tasks)} tasks, {len(tasks) - len(todo)} done before")
    if workers > 1 and len(todo) > 1:
        with tempfile.TemporaryDirectory(prefix="hdev-compiled-") as compiled:
            threads = max(1, (os.cpu_count() or 1) // workers)
            spawn = multiprocessing.get_context("spawn")
            pool = ProcessPoolExecutor(workers, spawn, _prepare_worker, (compiled, threads))
            try:
                futures = {pool.submit(_call, module.__name__, tasks[i]): i for i in todo}
                for future in progress.track(as_completed(futures), "running", total=len(todo)):
                    _keep(places[futures[future]], future.result())
                pool.shutdown()
            except BaseException:  # an interrupt keeps what is done and waits for nothing else
                workers_now = list((getattr(pool, "_processes", None) or {}).values())
                pool.shutdown(wait=False, cancel_futures=True)
                for process in workers_now:
                    process.terminate()
                for process in workers_now:
                    process.join()
                raise
    else:
        for i in progress.track(todo, "running"):
            _keep(places[i], _call(module.__name__, tasks[i]))
    for task, place in zip(tasks, places, strict=True):
        yield task, json.loads(place.read_text())


def _place(module: ModuleType, task: dict[str, Any], kept: Path) -> Path:
    text = json.dumps([task, sources(module.SOURCES)], sort_keys=True)
    return kept / module.__name__.rpartition(".")[2] / f"{hashlib.sha256(text.encode()).hexdigest()[:24]}.json"


def _keep(place: Path, result: dict[str, Any]) -> None:
    place.parent.mkdir(parents=True, exist_ok=True)
    with atomic_file(place) as temporary:
        Path(temporary).write_text(json.dumps(result, allow_nan=False))


_calls = itertools.count(1)


def _call(module: str, task: dict[str, Any]) -> dict[str, Any]:
    if next(_calls) % FORGET_EVERY == 0:
        import jax

        jax.clear_caches()
    return importlib.import_module(module).run(task)


def _prepare_worker(compiled: str, threads: int) -> None:
    """Double precision, a share of the cores, and a cache of compiled programs that outlives `FORGET_EVERY`.

    A cache for each worker: JAX does not write an entry in one step.
    """
    if threads == 1:
        os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
    os.environ["OMP_NUM_THREADS"] = os.environ["OPENBLAS_NUM_THREADS"] = str(threads)
    import jax

    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_compilation_cache_dir", str(Path(compiled) / str(os.getpid())))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


@cache
def sources(own: tuple[str, ...]) -> str:
    """Fingerprint of every source file that a task's result may depend on: the package's, and the experiment's own."""
    digest = hashlib.sha256()
    for path in [*sorted((ROOT / "hdev_jax").rglob("*.py")), *(ROOT / "experiments" / name for name in own)]:
        digest.update(path.relative_to(ROOT).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:16]
