"""Paper 2's future work: the physics NARX identified row by row while the car is driven, against the one of trip 1.

Both are one step ahead. *Frozen* has the coefficients of trip 1; *followed* goes on learning with a memory that was
chosen on trip 1, by its errors before each row was seen. *Ageing* adds a share of the losses to a trip's measured
power, growing over the trip: losses are what the battery gives beyond the power at the shaft.
"""

from collections.abc import Iterator
from typing import Any, Literal

import jax
import numpy as np
from pydantic import Field, PositiveFloat

from experiments.paper2.data import kia_fingerprint, kia_trips
from experiments.runner.config import Strict
from experiments.runner.tables import write_tables
from hdev_jax.errors import InputError
from hdev_jax.learn import KernelTerms, Narx, Structure, Trip, fit_prediction, prepared, with_theta
from hdev_jax.learn.narx.online import Recursive, follow, recursive
from hdev_jax.learn.sequences import energy_kwh, mean_squared
from hdev_jax.rundir import Run

__all__ = ["SOURCES", "Config", "collect", "run", "tasks"]

SOURCES = ("data.py",)


class Config(Strict):
    """The model, the memories to choose from, and the ageing that is planted."""

    experiment: Literal["paper2.online"]
    artefact: str
    caption: str
    outputs: int = Field(3, ge=0)
    lags: list[int] = Field(default_factory=lambda: [0, 1, 2], min_length=1)
    huber_kw: PositiveFloat = 0.4
    memories_min: list[PositiveFloat] = Field(
        default_factory=lambda: [1.0, 2.0, 4.0, 8.0, 15.0, 30.0, 60.0, 120.0], min_length=1
    )
    ageing: float = 0.10  # share of the losses that is added by the end of the trip
    aged_trip: Literal["2", "3", "4"] = "3"
    rows: int = Field(0, ge=0)


def tasks(config: Config) -> Iterator[dict[str, Any]]:
    """As driven, and with the ageing."""
    common = config.model_dump(mode="json", exclude={"experiment", "artefact", "caption", "aged_trip"})
    for trip in ("", config.aged_trip):
        yield {**common, "aged_trip": trip, "data": kia_fingerprint()}


def run(task: dict[str, Any]) -> dict[str, Any]:
    """Trip after trip in the order driven."""
    trips = kia_trips(task["rows"] or None)
    first = trips["1"]
    structure = Structure(KernelTerms(2), task["outputs"], tuple(task["lags"]), units=0)
    model = prepared(structure, first)
    zero = np.zeros((1, structure.shape.size))
    model = with_theta(model, fit_prediction(model, first, jax.numpy.asarray(zero), huber=task["huber_kw"]).theta[0])
    corner = task["huber_kw"] / float(model.output.sd)
    x1, y1 = _rows(model, first)
    if np.linalg.matrix_rank(x1) < x1.shape[1]:
        raise InputError(f"trip 1: {len(first)} rows do not tell {x1.shape[1]} regressors apart; raise rows, or 0: all")
    # columns that are uncorrelated on trip 1: between like columns a covariance that grows loses its sign to rounding
    turn = np.linalg.inv(np.linalg.cholesky(x1.T @ x1 / len(x1))).T
    x1, beta = x1 @ turn, np.linalg.solve(turn, model.theta)
    scores = {}
    half = len(x1) // 2  # the first half to begin with, the second to be judged by
    early = fit_prediction(
        model, first, jax.numpy.asarray(zero), huber=task["huber_kw"], weights=(np.arange(len(x1)) < half)[None] * 1.0
    )
    known = np.linalg.solve(turn, np.asarray(early.theta[0]))
    for memory in task["memories_min"]:
        factor = 1.0 - first.dt_s / (60.0 * memory)
        begin = _begin(known, x1[:half], corner, memory, first.dt_s)
        _, predicted = follow(begin, x1[half:], y1[half:], forgetting=factor, corner=corner, ceiling=_ceiling(begin))
        score = mean_squared((predicted - y1[half:]) * model.output.sd)
        scores[memory] = score if np.isfinite(score) else None
    memory = min((m for m, score in scores.items() if score is not None), key=lambda m: scores[m] or 0.0)
    factor = 1.0 - first.dt_s / (60.0 * memory)
    state = _begin(beta, x1, corner, memory, first.dt_s)
    ceiling = _ceiling(state)
    out: dict[str, Any] = {"memory_min": memory, "scores": {str(k): v for k, v in scores.items()}, "trips": {}}
    for name in ("2", "3", "4"):
        trip = aged(trips[name], task["ageing"]) if name == task["aged_trip"] else trips[name]
        x, y = _rows(model, trip)
        x = x @ turn
        frozen = model.output.undo(x @ beta)
        before = model.output.undo(x @ np.asarray(state.beta))
        state, predicted = follow(state, x, y, forgetting=factor, corner=corner, ceiling=ceiling)
        followed, measured = model.output.undo(predicted), model.measured(trip)
        after = model.output.undo(x @ np.asarray(state.beta))
        last = slice(2 * len(measured) // 3, None)
        out["trips"][name] = {
            "aged": name == task["aged_trip"],
            **{f"{k}_mse": mean_squared(p - measured) for k, p in
               (("frozen", frozen), ("before", before), ("followed", followed), ("after", after))},
            **{f"{k}_pe": _pe(p, measured, trip.dt_s) for k, p in (("frozen", frozen), ("followed", followed))},
            **{f"{k}_last_third_mse": mean_squared((p - measured)[last]) for k, p in
               (("frozen", frozen), ("followed", followed))},
            **{f"{k}_last_third_pe": _pe(p[last], measured[last], trip.dt_s) for k, p in
               (("frozen", frozen), ("followed", followed))},
        }  # fmt: skip
    return out


_HEADS = {
    f"{k}_{q}": f"{'MSE' if q.endswith('mse') else 'energy error [%]'}, {words}"
    + (", last third" if "last_third" in q else "")
    for k, words in (("frozen", "fixed"), ("before", "coefficients at the start"), ("followed", "updated"),
                     ("after", "coefficients at the end"))
    for q in ("mse", "pe", "last_third_mse", "last_third_pe")
}  # fmt: skip


def aged(trip: Trip, share: float) -> Trip:
    """The trip with losses that grow by `share` from its first row to its last [kW]."""
    shaft = trip.inputs["motor_torque_nm"] * trip.inputs["motor_speed_radps"] / 1000.0
    loss = np.maximum(np.asarray(trip.target) - shaft, 0.0)
    more = np.linspace(0.0, share, len(trip)) * loss
    return Trip(trip.name, trip.dt_s, trip.inputs, np.asarray(trip.target) + more, trip.segments)


def _rows(model: Narx, trip: Trip) -> tuple[np.ndarray, np.ndarray]:
    x, y = model.regressors(trip)
    return np.concatenate([np.ones((len(x), 1)), x], axis=1), y


def _begin(beta: np.ndarray, x: np.ndarray, corner: float, memory_min: float, dt_s: float) -> Recursive:
    """The solution of trip 1, known as well as the rows tell that the memory still holds."""
    share = min(1.0, 60.0 * memory_min / dt_s / len(x))
    return recursive(beta, x * np.sqrt(share))


def _ceiling(state: Recursive) -> float:
    """Where the covariance stops growing while the car stands: well above what it is where the drive begins."""
    return 100.0 * float(np.trace(state.covariance))


def _pe(predicted: np.ndarray, measured: np.ndarray, dt_s: float) -> float:
    return 100.0 * (energy_kwh(predicted, dt_s)[0] / energy_kwh(measured, dt_s)[0] - 1.0)


def collect(config: Config, results: Any, run: Run) -> dict[str, Any]:
    """A line for each trip, as driven and aged."""
    rows, lines = [], []
    for task, result in results:
        for trip, m in result["trips"].items():
            if task["aged_trip"] and not m["aged"]:
                continue
            name = f"trip {trip}" + (f", losses rising to +{100 * config.ageing:g} %" if m["aged"] else "")
            rows.append({"name": name, "paper": None, "ours": {**m, "memory_min": result["memory_min"]}})
            lines.append({"trip": name, **{_HEADS.get(k, k): v for k, v in m.items() if k != "aged"}})
    write_tables(run, config.artefact.rpartition("/")[2], lines, config.caption)
    memory = next((result["memory_min"] for _, result in results), None)
    edge = memory in (min(config.memories_min), max(config.memories_min)) and len(config.memories_min) > 1
    return {
        "artefact": config.artefact, "data": "kia_niro", "synthetic": False, "rows": rows,
        "better_than_paper": 0, "of": 0, "logs": 4,
        "notes": [
            "Ageing is simulated: the losses in the measured power rise from the first row of the trip to its last; "
            "everything else is as measured. A row's loss is battery power minus shaft power where that is positive, "
            "timing differences included",
            *([] if memory is None else [
                f"memory: {memory:g} min, the best of {', '.join(f'{m:g}' for m in config.memories_min)} when the "
                "model starts from the first half of trip 1 and is updated through the "
                f"second{', at the edge of the grid' if edge else ''}",
                "fixed: coefficients of trip 1; updated: each row is predicted with the coefficients estimated from "
                "the rows before it; at the start, at the end: the whole trip is predicted with the coefficients "
                "estimated up to its first row, or up to its last",
                "With a short memory the coefficients follow the driving, not only the car's age",
            ]),
        ],
    }  # fmt: skip
