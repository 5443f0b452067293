"""Computing what is asked for and not kept yet: each task once, wherever it runs, its result kept when it is there."""

import contextlib
import hashlib
import json
from collections.abc import Callable, Collection, Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from experiments.runner import store
from experiments.runner.log import Log
from experiments.runner.workers import Job, Outcome, in_turn, on_cluster, on_cores
from hdev_jax import progress

__all__ = ["Asked", "Where", "compute"]

IN_TURN = 10  # tasks of a few seconds: what a run that is stopped loses


@dataclass(frozen=True)
class Where:
    """Where tasks run: in this process, in so many `workers`, or on the Dask cluster at `scheduler`."""

    workers: int = 1
    scheduler: str | None = None
    quickly: bool = False  # whether programs are compiled without being optimised

    def start(self, jobs: Sequence[Job], keys: Sequence[str]) -> Iterator[tuple[int, Outcome]]:
        """The jobs' outcomes as they come."""
        if not jobs:
            return iter(())
        if self.scheduler is not None:
            return on_cluster(jobs, self.scheduler, keys)
        return on_cores(jobs, min(self.workers, len(jobs))) if self.workers > 1 and len(jobs) > 1 else in_turn(jobs)


@dataclass(frozen=True)
class Asked:
    """The tasks that the run `name` asks its experiment for."""

    name: str
    module: ModuleType
    tasks: Sequence[dict[str, Any]]


@dataclass(frozen=True)
class Todo:
    """A task that is not kept: where it will be, and the runs that wait for it."""

    at: Path
    module: ModuleType
    task: dict[str, Any]
    names: list[str]

    def says(self, what: str) -> Any:
        """What the experiment's function of that name says of the task; None where it has no such function."""
        ask: Callable[[dict[str, Any]], Any] | None = getattr(self.module, what, None)
        return ask(self.task) if ask is not None else None


def compute(
    asked: Iterable[Asked], where: Where, kept: Path, log: Log, *, keep_going: bool = False
) -> dict[str, Exception]:
    """Run the tasks that are asked for and are not in the store `kept`.

    **Returns** the exception of each run (by its name) that a task of stopped; without `keep_going` the first ends it.

    **Raises:** `ClusterError` where the cluster is at fault.
    """
    every: dict[Path, Todo] = {}
    count = done = 0
    for a in asked:
        for task in a.tasks:
            count += 1
            at = store.place(a.module, task, kept)
            if at.exists():
                done += 1
            else:
                every.setdefault(at, Todo(at, a.module, task, [])).names.append(a.name)
    shared = count - done - len(every)
    log.say(f"{count} tasks, {done} done before" + (f", {shared} shared by several configs" if shared else ""))
    failed: dict[str, Exception] = {}

    def fail(group: Sequence[Todo], error: Exception) -> None:
        log.say(f"{' '.join(t.at.stem for t in group)}: {type(error).__name__}: {error}", shown=False)
        error.add_note(f"in the task {json.dumps(group[0].task)}")
        failed.update({name: error for t in group for name in t.names if name not in failed})

    if not every:
        return failed
    groups = _groups(every.values(), where.workers)
    with contextlib.closing(_outcomes(where, groups)) as outcomes:
        for group, outcome in progress.track(outcomes, "running", total=len(groups)):
            ids = " ".join(t.at.stem for t in group)
            if isinstance(outcome, Exception):
                fail(group, outcome)
                if not keep_going:
                    break
                continue
            results, seconds = outcome
            at_once = len(group) if hasattr(group[0].module, "run_together") else 1
            for t, result in zip(group, results, strict=True):
                try:
                    store.keep(t.at, t.task, result, seconds / len(group), at_once)
                except (TypeError, ValueError) as e:  # a number that is none, or what is no JSON
                    fail([t], e)
            if failed and not keep_going:
                break
            how = f", {len(group)} tasks {'in one program' if at_once > 1 else 'in turn'}" if len(group) > 1 else ""
            log.say(f"{ids}: {seconds:.2f} s{how}", shown=False)
    return failed


def _groups(every: Collection[Todo], workers: int) -> list[list[Todo]]:
    """The tasks that an experiment runs in one call; the others by themselves. No group is more than a worker's share,
    so that a study that is one group has work for all of them; tasks that run in turn are kept every few."""
    groups: dict[Any, list[Todo]] = {}
    for t in every:
        key = t.says("together")
        groups.setdefault(t.at if key is None else (t.module.__name__, key), []).append(t)
    share = -(-len(every) // workers)
    sizes = [(g, share if hasattr(g[0].module, "run_together") else min(share, IN_TURN)) for g in groups.values()]
    return [g[i : i + most] for g, most in sizes for i in range(0, len(g), most)]


def _outcomes(where: Where, groups: list[list[Todo]]) -> Generator[tuple[list[Todo], Outcome], None, None]:
    """Each group with what came of it; those that measure time when all others have ended, so that none disturbs them.

    A generator, so that an error of the reader stops the workers.
    """
    parts: tuple[list[list[Todo]], list[list[Todo]]] = ([], [])
    for group in groups:
        parts[any(t.says("alone") for t in group)].append(group)
    for place, some in zip((where, Where()), parts, strict=True):
        jobs: list[Job] = [(g[0].module.__name__, [t.task for t in g]) for g in some]
        with contextlib.closing(_generator(place.start(jobs, [_name(g) for g in some]))) as outcomes:
            for i, outcome in outcomes:
                yield some[i], outcome


def _generator(outcomes: Iterator[tuple[int, Outcome]]) -> Generator[tuple[int, Outcome], None, None]:
    yield from outcomes


def _name(group: Sequence[Todo]) -> str:
    """A job's name: that of its task, or one for all of them."""
    return (
        group[0].at.stem if len(group) == 1 else hashlib.sha256("".join(t.at.stem for t in group).encode()).hexdigest()
    )
