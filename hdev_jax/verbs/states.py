"""Loads that switch along a log: one step ahead, from the rows before alone, or given all rows of a trip."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from hdev_jax.errors import InputError
from hdev_jax.inference.states import Decoded, StateRows, Switching, decode, rows_of
from hdev_jax.physics.states import SWITCHING_LOADS, state_channel
from hdev_jax.problem import Problem
from hdev_jax.targets import TARGETS, as_watts

__all__ = ["given_states", "one_step_ahead", "states_of"]


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
    found = _decode(problem, ids, states)
    model, rows, decoded = found.model, found.rows, found.states
    seconds = np.asarray(problem.segments.duration_s)
    per_watt = as_watts(problem.target, np.ones(len(seconds)), seconds)
    width = float(stats.t.ppf(0.5 + 0.5 * level, model.freedom)) * model.scale_w[rows.standing] * rows.wide
    open_w = stats.norm.ppf(0.5 + 0.5 * level) * np.sqrt(
        np.sum(model.power_w**2 * decoded.ahead * (1.0 - decoded.ahead), axis=1)
    )
    return found.predicted(decoded.ahead) + decoded.error_w / per_watt, np.hypot(width, open_w) / per_watt


class _Decoded(NamedTuple):
    """States of the loads in a log: the model, its rows, what decoding gave, and the prediction at any states."""

    model: Switching
    rows: StateRows
    states: Decoded
    predicted: Callable[[np.ndarray], np.ndarray]


def _decode(problem: Problem, ids: Sequence[str], known: Mapping[str, Any]) -> _Decoded:
    car = problem.vehicle
    effects = [car.effect(i) for i in ids]
    model = Switching(
        np.array([float(np.asarray(e.power_w)) for e in effects]), float(known["base_w"]),
        np.asarray(known["scale_w"], dtype=float), np.stack([np.asarray(e.shares()) for e in effects]),
        np.array([float(np.asarray(e.memory_s)) for e in effects]), float(known["error_s"]), float(known["freedom"]),
        np.stack([np.asarray(e.by()) for e in effects]),
    )  # fmt: skip
    seconds = np.asarray(problem.segments.duration_s)

    def predicted(on: np.ndarray) -> np.ndarray:
        return problem.predict(car, _with_states(problem, ids, on).segments)

    off = predicted(np.zeros((len(seconds), len(ids))))
    left = as_watts(problem.target, problem.measured - off, seconds)
    rows = rows_of(problem.segments, left, samples=TARGETS[problem.target].weight != "row")
    return _Decoded(model, rows, decode(model, rows), predicted)


def _with_states(problem: Problem, ids: Sequence[str], on: np.ndarray) -> Problem:
    channels = {state_channel(i): on[:, k] for k, i in enumerate(ids)}
    return replace(problem, segments=problem.segments.with_channels(**channels))


def given_states(problem: Problem, known: Mapping[str, Any]) -> Problem | None:
    """The problem with the states of its switching loads as the measured power shows them (all rows of a trip), as
    channels of the log; None where the sheet has no such load, or nothing is known of its errors.

    **Arguments:** `known`, what `predictive.json` beside the sheet holds.
    """
    ids = [e.id for e in SWITCHING_LOADS if problem.vehicle.has(e.id)]
    states = known.get("states")
    if not ids or states is None or states["ids"] != ids:
        return None
    return _with_states(problem, ids, _decode(problem, ids, states).states.on)
