"""Where jobs run: one after another in this process, on the cores of this machine, or on a Dask cluster.

A job is a module and the tasks that it runs together. Each way yields `(index, outcome)` in the order in which jobs
end; an outcome is the tasks' results and the seconds that they took, or the exception that stopped them.
"""

import importlib
import json
import multiprocessing
import os
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

from experiments.runner.store import sources
from hdev_jax import progress
from hdev_jax.compiling import environment, make_room, of_threads

__all__ = ["ClusterError", "Job", "Outcome", "call", "in_turn", "on_cluster", "on_cores"]

PATIENCE = 30  # seconds for a scheduler to answer

Job = tuple[str, list[dict[str, Any]]]
Outcome = tuple[list[Any], float] | Exception


class ClusterError(Exception):
    """The cluster is at fault, in one line; what is done is kept, and the same command goes on when it is put right."""


_one_at_a_time = threading.Lock()


def call(job: Job) -> tuple[list[Any], float]:
    """Run a job here: `run(task)`, or where there are several `run_together(tasks)`, if the experiment has that."""
    module, tasks = importlib.import_module(job[0]), job[1]

    def run(task: dict[str, Any]) -> Any:
        make_room()
        return module.run(task)

    started = time.perf_counter()
    at_once = len(tasks) > 1 and hasattr(module, "run_together")
    results = module.run_together(tasks) if at_once else [run(t) for t in tasks]
    if len(results) != len(tasks):
        raise ValueError(f"{job[0]}.run_together gave {len(results)} results for {len(tasks)} tasks")
    return results, time.perf_counter() - started


def in_turn(jobs: Sequence[Job]) -> Iterator[tuple[int, Outcome]]:
    """One after another in this process."""
    for i, job in enumerate(jobs):
        try:
            outcome = call(job)
        except Exception as e:
            outcome = e
        yield i, outcome


def on_cores(jobs: Sequence[Job], workers: int) -> Iterator[tuple[int, Outcome]]:
    """In `workers` processes, each with its share of the cores; they end with the generator."""
    with tempfile.TemporaryDirectory(prefix="hdev-compiled-") as compiled:
        threads = max(1, (os.cpu_count() or 1) // workers)
        spawn = multiprocessing.get_context("spawn")
        pool = ProcessPoolExecutor(workers, spawn, _prepare_worker, (compiled, threads))
        try:
            with environment(
                of_threads(threads)
            ):  # they start with the first jobs, and load NumPy before anything of ours runs
                futures = {pool.submit(call, job): i for i, job in enumerate(jobs)}
            for future in as_completed(futures):
                yield futures[future], _outcome(future)
            pool.shutdown()
        except BaseException:  # an interrupt waits for nothing
            processes = list((getattr(pool, "_processes", None) or {}).values())
            pool.shutdown(wait=False, cancel_futures=True)
            for process in processes:
                process.terminate()
            for process in processes:
                process.join()
            raise


def _outcome(future: Any) -> Outcome:
    try:
        return future.result()
    except Exception as e:
        return e


def _prepare_worker(compiled: str, threads: int) -> None:
    """Double precision, a share of the cores, and a cache of compiled programs that outlives `jax.clear_caches`.

    A cache for each worker: JAX does not write an entry in one step.
    """
    os.environ.update(of_threads(threads))
    import jax

    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_compilation_cache_dir", str(Path(compiled) / str(os.getpid())))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def on_cluster(jobs: Sequence[Job], address: str, keys: Sequence[str]) -> Iterator[tuple[int, Outcome]]:
    """On the workers of a Dask cluster, which may come and go: what a lost worker had in hand another one does.

    **Arguments:** `address` of the scheduler, or the scheduler's file; `keys`, a job's name on the cluster, the same
    from every client, so that two that ask for the same job share it.

    **Raises:** `ClusterError` where Dask is not installed, no scheduler answers, or a worker has other sources than we.
    """
    try:
        import distributed
    except ImportError as e:
        raise ClusterError(f"--scheduler {address}: needs Dask; pip install 'hdev_jax[fleet]'") from e
    try:
        at = json.loads(Path(address).read_text())["address"] if Path(address).is_file() else address
    except (OSError, ValueError, LookupError, TypeError) as e:
        raise ClusterError(f"--scheduler {address}: is no scheduler's file") from e
    try:
        client = distributed.Client(at, timeout=PATIENCE, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as e:
        raise ClusterError(f"--scheduler {address}: no scheduler answers there ({type(e).__name__})") from e

    def there(job: Job, expected: str) -> tuple[list[Any], float]:
        # inside, so that it travels by value: a worker that lacks the module can say so, and is not brought down
        from experiments.runner.workers import on_worker

        return on_worker(job, expected)

    expected = {name: sources(importlib.import_module(name)) for name in dict.fromkeys(j[0] for j in jobs)}
    try:
        now = len(client.nthreads())  # pyright: ignore[reportArgumentType]
        progress.step(f"{now} workers at {address}; more may come")
        pairs = zip(jobs, keys, strict=True)
        futures = [client.submit(there, job, expected[job[0]], key=f"hdev-{k}", pure=False) for job, k in pairs]
        index = {f.key: i for i, f in enumerate(futures)}
        for future in distributed.as_completed(futures, loop=client.loop):
            if future.status in ("cancelled", "lost"):
                raise ClusterError(
                    f"--scheduler {address}: the scheduler is gone; start it, and the same command goes on"
                )
            outcome = _outcome(future)
            if isinstance(outcome, distributed.KilledWorker):
                outcome = ClusterError(f"--scheduler {address}: every worker that took it was killed (out of memory?)")
            elif isinstance(outcome, ClusterError | ImportError):
                why = f"a worker says: {outcome}; start it in this checkout, with the same packages"
                raise ClusterError(f"--scheduler {address}: {why}") from outcome
            yield index[future.key], outcome
            future.release()
    finally:
        client.close()


def on_worker(job: Job, expected: str) -> tuple[list[Any], float]:
    """What a worker of a cluster does: prepare its process once, compare its sources with ours, run the job.

    **Raises:** `ClusterError` where the worker's sources are not those that the results will be kept under.
    """
    from distributed import get_worker

    with _one_at_a_time:  # whatever number of threads the worker has: a task has the process to itself
        worker = get_worker()
        if not getattr(worker, "hdev_prepared", False):
            _prepare_worker(str(Path(worker.local_directory) / "hdev-compiled"), worker.state.nthreads)
            worker.hdev_prepared = True  # pyright: ignore[reportAttributeAccessIssue]
        if sources(importlib.import_module(job[0])) != expected:
            raise ClusterError(f"worker {worker.address} has other sources of {job[0]}")
        return call(job)
