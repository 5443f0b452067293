"""A problem: a log, a sheet and a target brought together, its split into training and test trips, its errors."""

from hdev_jax.problem.harm import without_harmful_slope
from hdev_jax.problem.metrics import metrics, sum_weight
from hdev_jax.problem.plausible import implausible
from hdev_jax.problem.problem import Problem, derivable, prepare
from hdev_jax.problem.split import LAST_THIRD, Split, split_trips

__all__ = [
    "LAST_THIRD",
    "Problem",
    "Split",
    "derivable",
    "implausible",
    "metrics",
    "prepare",
    "split_trips",
    "sum_weight",
    "without_harmful_slope",
]
