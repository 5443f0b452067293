"""Wall time of a call on a machine that others use too: the median, compiled before."""

import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

__all__ = ["median_seconds"]


def median_seconds(call: Callable[[], Any], repeats: int) -> float:
    """Seconds of a call, the median of `repeats`, after one that does not count; arrays are waited for."""
    jax.block_until_ready(call())
    taken = []
    for _ in range(repeats):
        started = time.perf_counter()
        jax.block_until_ready(call())
        taken.append(time.perf_counter() - started)
    return float(np.median(taken))
