"""Work on the parts of a long log in a few threads: XLA, BLAS and NumPy leave the interpreter to others meanwhile."""

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from functools import cache
from typing import TypeVar

__all__ = ["side_by_side"]

THREADS = max(1, min(4, os.cpu_count() or 1))  # parts that are in memory at a time

Part = TypeVar("Part")
Result = TypeVar("Result")


def side_by_side(work: Callable[[Part], Result], parts: Iterable[Part]) -> Iterator[tuple[Part, Result]]:
    """Each part with what `work` makes of it, in their order; no more than `THREADS` at a time.

    `work` may write nothing that another part's does, nor call this function. What it raises is raised at its part.
    """
    pool, ahead = _pool(), deque[tuple[Part, Future[Result]]]()
    try:
        for part in parts:
            ahead.append((part, pool.submit(work, part)))
            if len(ahead) == THREADS:
                first, result = ahead.popleft()
                yield first, result.result()
        while ahead:
            last, result = ahead.popleft()
            yield last, result.result()
    finally:
        wait([result for _, result in ahead])


@cache
def _pool() -> ThreadPoolExecutor:
    """One for all: the heap that a thread has used is used again by the next part."""
    return ThreadPoolExecutor(THREADS, "hdev")
