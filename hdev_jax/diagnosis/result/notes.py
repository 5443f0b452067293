"""The notes of a diagnosis: fits that stopped, coefficients far from their tables, what rests on few rows or trips."""

import numpy as np

from hdev_jax.diagnosis.competition.state import State
from hdev_jax.diagnosis.result.coefficients import as_they_end, baseline_block, far
from hdev_jax.diagnosis.settings import Settings
from hdev_jax.diagnosis.training import Training
from hdev_jax.inference import Calibration
from hdev_jax.physics import StepChange
from hdev_jax.problem import Problem, metrics

__all__ = ["by_trip", "known", "odd_rows", "of_last_vehicle", "warnings"]


def warnings(steps: list[Calibration], state: State, settings: Settings) -> list[str]:
    """Fits that stopped early, and declared coefficients that are far from their tables: as they end, or as they began
    where they came back."""
    out = []
    for fit, when in ((steps[0], "declared model"), (steps[-1], "model with the effects")):
        if not fit.converged:
            out.append(f"the fit of the {when} stopped early: {fit.message}")
    ends = as_they_end(steps[-1], state, settings) if state.found else {}
    ends = {k: p for k, p in ends.items() if far(p, settings)}
    begins = {k: p for k, p in baseline_block(steps[0], state.absorbs).items() if far(p, settings) and k not in ends}
    for when, block in (("declared model", begins), ("model with the effects", ends)):
        for name, p in block.items():
            held = f"; on this log it cannot be distinguished from {', '.join(p['absorbs'])}" if p["absorbs"] else ""
            out.append(f"{name} moved {p['prior_z']:+.1f} prior sd from its table in the {when}{held}")
    return out


def known(
    problem: Problem, state: State, last: Calibration, training: Training, test: np.ndarray, rmse: float
) -> list[str]:
    """How the coefficients of the model with the effects are estimated, where not as those of the declared model."""
    if last is state.fit or not state.found:
        return []
    said = problem.predict(state.fit.vehicle, compute=training.kernel.predict)[test]
    plain = metrics(problem.measured[test], said, problem.weight()[test])["rmse"]
    return [
        "the model with the effects is fitted by generalised least squares, which gives smaller standard errors: test "
        f"RMSE {rmse:.4g} {problem.unit}; by ordinary least squares, as for the declared model, {plain:.4g}"
    ]


def by_trip(problem: Problem, state: State) -> list[str]:
    """What was estimated for each trip: the phases of a cycle, the trips of a mode."""
    out = []
    for f in state.found:
        values = next(iter(f.score.candidate.by_trip.values()), {})
        by_trip = [(problem.log.trip_names[t], v) for t, v in values.items()]
        mean = "other trips, and all trips by augmented_vehicle.toml, are predicted with its mean"
        if f.score.candidate.effect.searched == "trips":
            trips = ", ".join(t for t, v in by_trip if v > 0)
            out.append(f"{f.id} is on in {trips}; {mean}")
        elif by_trip:
            phases = ", ".join(f"{t} {v:+.2f}" for t, v in by_trip)
            out.append(f"{f.id}: phase by trip {phases}; {mean}")
    return out


def of_last_vehicle(problem: Problem, train: np.ndarray) -> list[str]:
    """A note where trips of several vehicles train: a change that stays is searched for in those of the last alone."""
    ids = np.asarray(problem.segments.vehicle)[train]
    if len(np.unique(ids)) < 2:
        return []
    last = problem.log.vehicle_names[int(ids[-1])]
    return [f"{StepChange.id} is tried within the last trips of {last} only; diagnose the other vehicles separately"]


def odd_rows(problem: Problem, declared: np.ndarray, settings: Settings) -> list[str]:
    """A note on a single outlier that has much of the log's squared error."""
    square = (problem.measured - declared) ** 2
    worst = int(np.argmax(square))
    share = square[worst] / max(float(np.sum(square)), 1e-300)
    size = np.sort(np.abs(problem.measured))
    if len(square) < 100 or share < settings.odd or abs(problem.measured[worst]) <= 3.0 * size[-2]:
        return []
    trip = problem.log.trip_names[int(problem.log.trip[worst])]
    at = float(np.asarray(problem.segments.time_s)[worst])
    return [
        f"one row has {100 * share:.0f} % of the declared model's squared error: trip {trip} at {at:.6g} s, "
        f"{problem.target} = {problem.measured[worst]:.6g}; if it is a measurement fault, remove it and run again"
    ]
