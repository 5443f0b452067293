"""Vehicles are analysed in this process, in worker processes, or on a Dask cluster whose workers come and go.

Each way yields `(index, record)` in the order in which vehicles are finished. The work of a lost worker is done by
another.
"""

import contextlib
import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hdev_jax.compiling import environment, keep_compiled, make_room, of_threads
from hdev_jax.errors import InputError

__all__ = ["Workers", "computed"]

PATIENCE_S = 30  # for a scheduler to answer
RETRIES = 3  # of a vehicle whose worker was lost
# Arrays of a log are megabytes. Given back to the system after each use, as Dask has it (65,536 bytes), they cost
# page faults: a quarter of a vehicle's time is then spent in the operating system, with these a thirtieth.
_KEEPS_MEMORY = {"MALLOC_TRIM_THRESHOLD_": "268435456", "MALLOC_MMAP_THRESHOLD_": "33554432"}
_NO_DASK = "needs Dask: pip install 'hdev_jax[fleet]'"

Work = Callable[[Mapping[str, Any]], dict[str, Any]]


@dataclass(frozen=True)
class Workers:
    """`count` processes on this machine, or the Dask cluster at `scheduler` (its address, or its file)."""

    count: int = 1
    scheduler: str | None = None


def computed(work: Work, tasks: Sequence[Mapping[str, Any]], where: Workers) -> Iterator[tuple[int, dict[str, Any]]]:
    """Yields the index of each task and `work(task)`, in the order in which they are finished.

    **Arguments:** `work`: a function in a module of this package, from plain values to plain values. `where`: the
    processes or the cluster.

    **Raises:** `InputError` where Dask is needed and not installed, or no scheduler answers.
    """
    if not tasks:
        return
    if where.scheduler is None and (where.count < 2 or len(tasks) < 2):
        for i, task in enumerate(tasks):
            yield i, _done(work, task)
        return
    option = f"--scheduler {where.scheduler}" if where.scheduler else f"--workers {where.count}"
    try:
        import distributed
    except ImportError as e:
        raise InputError(f"{option}: {_NO_DASK}") from e
    with contextlib.ExitStack() as stack:
        if where.scheduler is None:
            # threads are set before the processes start: they load NumPy before anything of ours runs
            keeps = {k: os.environ.get(k, v) for k, v in _KEEPS_MEMORY.items()}
            stack.enter_context(environment(keeps | of_threads(1)))
            cluster = distributed.LocalCluster(
                n_workers=min(where.count, len(tasks)), threads_per_worker=1, processes=True, memory_limit=0,
                silence_logs=50,
                # any free port, of this machine alone: by default it is 8787 on all networks, and a second cluster
                # finds that taken
                dashboard_address="127.0.0.1:0", scheduler_kwargs={"dashboard": False},
            )  # fmt: skip
            stack.callback(cluster.close)
            client = distributed.Client(cluster, set_as_default=False)
        else:
            client = _client_of(where.scheduler, option)
        stack.callback(client.close)
        futures = [client.submit(_there, work, dict(t), pure=False, retries=RETRIES) for t in tasks]
        index = {f.key: i for i, f in enumerate(futures)}
        for future in distributed.as_completed(futures, loop=client.loop):
            if future.status in ("cancelled", "lost"):
                raise InputError(f"{option}: the scheduler is gone; start it, then the same command resumes")
            try:
                record = future.result()
            except distributed.KilledWorker as e:
                raise InputError(
                    f"{option}: every worker that took {tasks[index[future.key]].get('name')} was killed (out of "
                    "memory?); what is done is kept, and the same command goes on"
                ) from e
            yield index[future.key], record
            future.release()


def _client_of(address: str, option: str) -> Any:
    import distributed

    try:
        at = json.loads(Path(address).read_text())["address"] if Path(address).is_file() else address
    except (OSError, ValueError, LookupError, TypeError) as e:
        raise InputError(f"{option}: is no scheduler's file") from e
    try:
        return distributed.Client(at, timeout=PATIENCE_S, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as e:
        raise InputError(f"{option}: no scheduler answers there ({type(e).__name__})") from e


def _there(work: Work, task: dict[str, Any]) -> dict[str, Any]:
    """What a worker does: double precision, the cache of compiled programs that all of them share, the task."""
    import jax

    jax.config.update("jax_enable_x64", True)
    keep_compiled()
    return _done(work, task)


def _done(work: Work, task: Mapping[str, Any]) -> dict[str, Any]:
    make_room()
    return work(task)
