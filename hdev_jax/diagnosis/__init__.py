"""The loop: residual, candidates, evidence, selection, and what is left."""

from hdev_jax.diagnosis.diagnose import Diagnosis
from hdev_jax.diagnosis.problem import Problem, prepare
from hdev_jax.diagnosis.split import Split, split_trips

__all__ = ["Diagnosis", "Problem", "Split", "prepare", "split_trips"]
