"""Loads with a hidden state, on all rows of the log: errors by what they may know, and what each load took.

Three errors are kept apart. The *free run* knows no measured power: a load has its expected share of time on. *One step
ahead* knows the rows before: the filtered state, carried on by one row. *Given the states* knows the trip's measured
power, this row's included: it explains and does not predict.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy import stats

from hdev_jax.diagnosis.candidates.shared import SharedKernel
from hdev_jax.diagnosis.competition.state import State
from hdev_jax.diagnosis.result.intervals import Open
from hdev_jax.inference import Calibration, cluster_rows
from hdev_jax.inference.states import (
    Decoded,
    StateRows,
    Switching,
    contrasts,
    decode,
    energy_draws,
    fit_switching,
    rows_of,
    shares_of,
)  # fmt: skip
from hdev_jax.physics.states import KNOTS_C, state_channel
from hdev_jax.problem import Problem, Split
from hdev_jax.segments import Segments, trip_slices
from hdev_jax.targets import TARGETS, as_watts

__all__ = ["Given", "given_states", "state_block"]

DRAWS = 40
# quantiles between so few draws lie further inside than those of the distribution: of a normal by so much
FEW = float(stats.norm.ppf(0.05) / stats.norm.ppf((0.05 * (DRAWS - 1) + 1.0) / (DRAWS + 1)))
NEAR_C = 5.0  # a temperature is reported where the training trips have one as near
LEAST_S = 600.0  # of time there


@dataclass(frozen=True)
class Given:
    """The log's rows with the decoded states (`segments`), predictions given them and one step ahead, the model that
    decoded them, the power of each load as fitted with all else in the vehicle [W], and what draws their energies."""

    segments: Segments
    predicted: np.ndarray
    ahead: np.ndarray
    ids: tuple[str, ...]
    model: Switching
    power_w: dict[str, float]
    drawn: Callable[[], list[dict[str, list[float]]]]

    @cached_property
    def kwh(self) -> list[dict[str, list[float]]]:
        """The energy of each load in each trip [kWh]: mean, 5 % and 95 %."""
        return self.drawn()

    @property
    def left_open(self) -> dict[str, dict[str, Open]]:
        """The power of each load by expectation-maximisation, which knows that states are uncertain, is as likely as
        that by least squares, which knows all else in the vehicle."""
        away = {i: float(p) - self.power_w[i] for i, p in zip(self.ids, self.model.power_w, strict=True)}
        return {i: {"power_w": Open(np.array([0.0, x]), np.full(2, 0.5))} for i, x in away.items()}


def given_states(
    problem: Problem, split: Split, state: State, fit: Calibration, seed: int, *, kernel: SharedKernel
) -> Given | None:
    """The states on every row of the log by what was fitted to the training trips; None where nothing is hidden.

    The `kernel` of the search predicts."""
    if state.hidden is None or not state.hidden.ids:
        return None
    ids, seconds = state.hidden.ids, np.asarray(problem.segments.duration_s)

    def known(on: np.ndarray) -> Segments:
        return problem.segments.with_channels(**{state_channel(i): on[:, k] for k, i in enumerate(ids)})

    def predicted(on: Segments) -> np.ndarray:
        return problem.predict(fit.vehicle, on, compute=kernel.predict)

    off = known(np.zeros((len(seconds), len(ids))))
    left = as_watts(problem.target, problem.measured - predicted(off), seconds)
    rows = rows_of(problem.segments, left, samples=TARGETS[problem.target].weight != "row")
    model, _ = fit_switching(state.hidden.model, rows.take(problem.rows(split.train)), 1)
    decoded = decode(model, rows)
    where = known(decoded.on)
    error = decoded.error_w / as_watts(problem.target, np.ones(len(seconds)), seconds)
    errors = {c.path: float(e) for c, e in zip(fit.table.free, fit.errors, strict=True)}
    power = {i: float(np.asarray(fit.vehicle.effect(i).power_w)) for i in ids}
    both = [(power[i], errors.get(f"effects.{i}.power_w", 0.0)) for i in ids]
    return Given(
        where, predicted(where), predicted(known(decoded.ahead)) + error, ids, model, power,
        lambda: _kwh(problem, split, rows, model, decoded, both, seed),
    )  # fmt: skip


def _kwh(
    problem: Problem, split: Split, rows: StateRows, model: Switching, decoded: Decoded,
    fitted: list[tuple[float, float]], seed: int,
) -> list[dict[str, list[float]]]:  # fmt: skip
    """Energy of each load in each trip [kWh], with 5 % and 95 % over draws of its states and of its power: that of the
    model or the one `fitted` with all else, as likely, either off by Student's t of the fitted one's error."""
    drawn = energy_draws(model, rows, seed=seed, draws=DRAWS) / 1e3
    drawn = drawn.mean(axis=0) + FEW * (drawn - drawn.mean(axis=0))
    freedom = max(cluster_rows(problem.segments.take(problem.rows(split.train))).count - 1, 1)
    off = stats.t.ppf((np.arange(DRAWS) + 0.5) / DRAWS, freedom)
    out = []
    for k, (power, error) in enumerate(fitted):
        own = max(float(model.power_w[k]), 1e-9)
        factor = np.concatenate([1.0 + error / max(power, 1e-9) * off, (power + error * off) / own])
        each = np.maximum(drawn[:, None, k, :] * factor[None, :, None], 0.0)
        low, high = np.quantile(each.reshape(-1, each.shape[-1]), (0.05, 0.95), axis=0)
        trips = {}
        for j, (t, s) in enumerate(trip_slices(rows.trip)):
            mean = float(model.power_w[k] * np.sum(decoded.on[s, k] * rows.duration_s[s])) / 3.6e6
            trips[problem.log.trip_names[t]] = [mean, min(float(low[j]), mean), max(float(high[j]), mean)]
        out.append(trips)
    return out


def state_block(problem: Problem, split: Split, given: Given, effect_id: str) -> dict[str, Any]:
    """What the contract's `state` of an effect holds: power, share of time on by temperature, dwell times, energy."""
    k = given.ids.index(effect_id)
    model, train = given.model, problem.rows(split.train)
    on = np.asarray(given.segments.channels[state_channel(effect_id)])
    rows = rows_of(problem.segments, np.zeros(len(on)), samples=True)
    seconds = rows.duration_s
    share = float(np.sum((seconds * on)[train]) / np.sum(seconds[train]))
    memory = float(model.memory_s[k])
    test = problem.rows(split.test)
    per_kwh = TARGETS[problem.target].per_kwh or np.inf
    total = float(np.sum((problem.measured * problem.weight())[test])) / per_kwh
    return {
        "power_w": float(model.power_w[k]),
        "share_on": _shares(rows.take(train), on[train], share),
        "mean_share_on": share,
        "depends_on": contrasts(model, rows.take(train), k),
        "dwell_on_s": memory / max(1.0 - share, 1e-3),
        "dwell_off_s": memory / max(share, 1e-3),
        "kwh_by_trip": given.kwh[k],
        "share_of_test_energy": float(sum(given.kwh[k][t][0] for t in split.names(split.test)) / total)
        if abs(total) > 0
        else None,
    }


def _shares(rows: Any, on: np.ndarray, share: float) -> list[list[float]]:
    """Temperature, share of time on, 5 % and 95 % by the jackknife over trips; where the trips were so warm or cold."""
    if not rows.has_temperature:
        return []
    best, trips = shares_of(rows, on), np.unique(rows.trip)
    each = np.stack([shares_of(rows.take(m), on[m]) for t in trips if (m := rows.trip != t).any()] or [best])
    n = len(each)
    sd = np.sqrt((n - 1) / n * np.sum((each - each.mean(axis=0)) ** 2, axis=0))
    half = sd * float(stats.t.ppf(0.95, max(n - 1, 1)))
    out = []
    for c, x, h in zip(KNOTS_C, best, half, strict=True):
        if np.sum(rows.duration_s[np.abs(rows.temp_c - c) <= NEAR_C]) >= LEAST_S:
            out.append([c, float(x), float(max(x - h, 0.0)), float(min(x + h, 1.0))])
    return out
