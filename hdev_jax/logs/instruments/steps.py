"""Steps of an instrument: the spacing of the values that it can show."""

import numpy as np
from jaxtyping import Float

__all__ = ["step_of"]

ENOUGH = 5  # rows for each value: what was written with few digits shows every value many times
LEAST_VALUES = 4  # fewer are a flag or a constant
WHOLE = 0.02  # of a step: what a unit's conversion and a file's digits may be off by


def step_of(x: Float[np.ndarray, " row"]) -> float:
    """The step in whose multiples all values lie, in their unit; 0 where there is none to be seen.

    Values of a smooth quantity differ by no common step; those of a coarse one by whole multiples of the smallest
    difference, and each is seen many times.
    """
    values = np.unique(x[np.isfinite(x)])
    if not LEAST_VALUES <= len(values) <= len(x) / ENOUGH:
        return 0.0
    gaps = np.diff(values)
    size = float(np.max(np.abs(values)))
    gaps = gaps[gaps > 1e-6 * size]  # the same value by two ways of rounding
    if not len(gaps):
        return 0.0
    step = float(np.quantile(gaps, 0.02))
    step = float(np.median(gaps[gaps < 1.5 * step]))
    whole = gaps / step
    return step if np.mean(np.abs(whole - np.round(whole)) < WHOLE * np.maximum(whole, 1.0)) > 0.98 else 0.0
