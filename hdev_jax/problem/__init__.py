"""A problem: a log, a sheet and a target brought together, its split into training and test trips, its errors."""

from hdev_jax.problem.metrics import PER_KWH, metrics, sum_weight
from hdev_jax.problem.problem import UNITS, Problem, prepare
from hdev_jax.problem.split import LAST_THIRD, Split, split_trips

__all__ = [
    "LAST_THIRD",
    "PER_KWH",
    "UNITS",
    "Problem",
    "Split",
    "metrics",
    "prepare",
    "split_trips",
    "sum_weight",
]
