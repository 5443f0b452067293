"""Predictions one step ahead: loads that switch are filtered along the log, from the rows before alone."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy import stats

from hdev_jax.errors import InputError
from hdev_jax.inference.states import Switching, decode, rows_of
from hdev_jax.physics.states import SWITCHING_LOADS, state_channel
from hdev_jax.problem import Problem
from hdev_jax.targets import TARGETS, as_watts

__all__ = ["one_step_ahead", "states_of"]


def states_of(ids: tuple[str, ...], model: Switching) -> dict[str, Any]:
    """What filtering needs beside a sheet, for `predictive.json`: the errors about the levels, in W and s."""
    return {
        "ids": list(ids), "base_w": model.base_w, "scale_w": model.scale_w.tolist(), "error_s": model.error_s,
        "freedom": model.freedom,
    }  # fmt: skip


def one_step_ahead(
    problem: Problem, known: Mapping[str, Any], measures: bool, level: float
) -> tuple[np.ndarray, np.ndarray]:
    """Each row predicted from the rows of its trip before it, and half the width of its interval, in the target's unit.

    The interval has the innovations of the errors and the uncertain states. **Raises:** `InputError` where the log does
    not measure the target, the sheet has no load that switches, or nothing is known of the errors.
    """
    car = problem.vehicle
    ids = [e.id for e in SWITCHING_LOADS if car.has(e.id)]
    if not ids:
        raise InputError("--online: the sheet has no load that switches; hdev diagnose finds them")
    if not measures:
        raise InputError(f"--online: the log does not measure {problem.target}; leave --online out for the free run")
    states = known.get("states")
    if states is None or states["ids"] != ids:
        raise InputError(
            "--online: predictive.json beside the sheet says nothing of its states; use the folder of the diagnosis"
        )
    effects = [car.effect(i) for i in ids]
    model = Switching(
        np.array([float(np.asarray(e.power_w)) for e in effects]), float(states["base_w"]),
        np.asarray(states["scale_w"], dtype=float), np.stack([np.asarray(e.shares()) for e in effects]),
        np.array([float(np.asarray(e.memory_s)) for e in effects]), float(states["error_s"]), float(states["freedom"]),
        np.stack([np.asarray(e.by()) for e in effects]),
    )  # fmt: skip
    seconds = np.asarray(problem.segments.duration_s)

    def predicted(on: np.ndarray) -> np.ndarray:
        channels = {state_channel(i): on[:, k] for k, i in enumerate(ids)}
        return problem.predict(car, problem.segments.with_channels(**channels))

    off = predicted(np.zeros((len(seconds), len(ids))))
    left = as_watts(problem.target, problem.measured - off, seconds)
    rows = rows_of(problem.segments, left, samples=TARGETS[problem.target].weight != "row")
    decoded = decode(model, rows)
    per_watt = as_watts(problem.target, np.ones(len(seconds)), seconds)
    width = float(stats.t.ppf(0.5 + 0.5 * level, model.freedom)) * model.scale_w[rows.standing] * rows.wide
    open_w = stats.norm.ppf(0.5 + 0.5 * level) * np.sqrt(
        np.sum(model.power_w**2 * decoded.ahead * (1.0 - decoded.ahead), axis=1)
    )
    return predicted(decoded.ahead) + decoded.error_w / per_watt, np.hypot(width, open_w) / per_watt
