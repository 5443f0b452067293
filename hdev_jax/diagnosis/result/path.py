"""The fits on the way to the result: the declared model, then with each found effect in turn."""

from dataclasses import replace

import jax.numpy as jnp

from hdev_jax.diagnosis.competition.refit import fitted
from hdev_jax.diagnosis.competition.state import State
from hdev_jax.diagnosis.training import Training
from hdev_jax.inference import Calibration
from hdev_jax.problem import Problem

__all__ = ["path"]


def path(training: Training, problem: Problem, state: State) -> list[Calibration]:
    """The declared model, then with each effect in the order found, each fitted to all training rows."""
    fits = [training.calibrate(problem.vehicle, problem.table)]
    for k in range(1, len(state.found)):
        later = state.ids[k:]
        table, vehicle = state.fit.table.minus(*later), state.fit.vehicle.minus(*later)
        values = state.trail.get(",".join(state.ids[:k]))
        if values is not None:  # fitted when it was found
            fits.append(replace(fits[0], vehicle=table.insert(vehicle, jnp.asarray(values)), table=table))
        else:
            fits.append(fitted(training, state.fit, vehicle, table))
    return [*fits, state.fit] if state.found else fits
