"""What a model that knows the cause makes of a log: its error on the same test trips, from the same training trips.

The kernel with the simulator's true parameters, the changed one too, and the form of its efficiency; what the sheet
declares with an sd is fitted, and so are the sizes of what was put in. Where a channel was left out, it has it; where
samples are of the past second, it reads them as that.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from experiments.simulators.logs import sheet
from experiments.simulators.vehicles import Vehicle
from hdev_jax.inference import calibrate, cluster_rows, padded
from hdev_jax.problem import Problem, Split

__all__ = ["known_sheet", "refit_rmse"]

# The form of each simulator's efficiency as effects of the library with a free size.
_BY_DIRECTION = "[effects.regen_efficiency]\nshare = { value = 0.05, sd = 0.5 }\n"
_BY_LOAD = (
    "[effects.inverter_loss]\nstandby_w = { value = 100.0, sd = 2000.0 }\nper_nm_w = { value = 0.05, sd = 2.0 }\n"
)


def known_sheet(task: Mapping[str, Any], true: Vehicle) -> str:
    """The sheet of the vehicle as it was, with effects for what a sheet has no key for."""
    text = sheet(true, task["measured"]) + _BY_DIRECTION
    if task["simulator"] == "fastsim":
        text += _BY_LOAD
    if true.cutoff_mps:
        text += f"[effects.regen_cutoff]\nspeed_mps = {true.cutoff_mps!r}\n"
    if true.headwind_mps:
        text += f"[effects.constant_headwind]\nspeed_mps = {{ value = {true.headwind_mps!r}, sd = 1.0 }}\n"
    return text


def refit_rmse(problem: Problem, split: Split) -> float:
    """The calibrated problem's error on its test trips, in the target's unit."""
    train, test = problem.rows(split.train), problem.rows(split.test)
    real = problem.segments.take(train)
    fit = calibrate(
        problem.vehicle, problem.table, padded(real, problem.measured[train]), problem.target, cluster_rows(real)
    )
    return float(np.sqrt(np.mean((problem.measured - problem.predict(fit.vehicle))[test] ** 2)))
