"""The loop: residual, candidates, evidence, selection, and what is left."""

from hdev_jax.diagnosis.diagnose import Outcome
from hdev_jax.problem import Problem, Split, prepare, split_trips

__all__ = ["Outcome", "Problem", "Split", "prepare", "split_trips"]
