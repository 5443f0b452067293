"""Where a difference in energy comes from: two sets of trips, or two vehicle sheets on one log."""

import numpy as np
import pandas as pd
from scipy import sparse

from hdev_jax.energy.causes import ByCause, by_cause
from hdev_jax.energy.fitted import Fitted, interval
from hdev_jax.energy.ledger import TOTAL, UNEXPLAINED
from hdev_jax.errors import InputError

__all__ = ["alike", "compare_sheets", "compare_trips"]

COLUMNS = ["cause", "a", "b", "difference", "lower", "upper"]


def compare_trips(fitted: Fitted, a: tuple[int, ...], b: tuple[int, ...], *, seed: int = 0) -> pd.DataFrame:
    """Energy of trips `a` and `b` by cause [kWh/100 km], b less a with its 90 % interval.

    The differences of the causes and of what is unexplained add up to that of the measured energy exactly. Intervals
    are draws of the coefficients, the same for both; that of *unexplained* has the noise of the trips besides.
    **Raises:** `InputError` for trips that never move.
    """
    problem = fitted.problem
    log, parts = problem.log, by_cause(fitted, fitted.draws(seed))
    names = len(log.trip_names)
    km = np.bincount(log.trip, weights=np.asarray(log.segments.distance_m) / 1e3, minlength=names)
    kwh = np.bincount(log.trip, weights=np.asarray(log.target("energy_wh")) / 1e3, minlength=names)
    weight = np.zeros((2, names))
    for row, trips in enumerate((a, b)):
        if not km[list(trips)].sum() > 0:
            which = ", ".join(log.trip_names[i] for i in trips)
            raise InputError(f"{which}: never moves; trips that go somewhere are expected")
        weight[row, list(trips)] = 100.0 / km[list(trips)].sum()
    wobble = np.random.default_rng(seed).standard_t(fitted.freedom, (len(parts.drawn), names)) * fitted.noise_kwh()
    return _table(parts.grouped(sparse.csr_array(weight)), weight @ kwh, wobble @ weight.T)


def compare_sheets(a: Fitted, b: Fitted, *, seed: int = 0) -> pd.DataFrame:
    """Energy of one log by cause, by two vehicles [kWh/100 km], b less a with its 90 % interval.

    What was measured is the same, so that the differences of all causes and of what is unexplained add up to 0.
    Coefficients that both know alike (`alike`) are one and the same: they have the same draws, so that a sheet beside
    itself differs by exactly 0. The others are drawn independently.
    """
    log = a.problem.log
    km = float(np.sum(np.asarray(log.segments.distance_m))) / 1e3
    if not km > 0:
        raise InputError("the log never moves; a log of driving is expected")
    first, second = a.draws(seed), b.draws(seed + 1)
    if len(first) == len(second):
        for i, k in alike(a, b):
            second[:, k] = first[:, i]
    one, two = by_cause(a, first), by_cause(b, second)
    causes = tuple(dict.fromkeys((*one.causes, *two.causes)))
    many = max(len(one.drawn), len(two.drawn))  # a vehicle that is known has but one draw
    value, drawn = [], []
    for part in (one.over(causes), two.over(causes)):
        value.append(100.0 / km * part.value.sum(axis=0))
        drawn.append(np.resize(100.0 / km * part.drawn.sum(axis=1), (many, len(causes))))
    measured = np.zeros(2)
    if log.measured:
        measured += 100.0 / km * float(np.sum(np.asarray(log.target("energy_wh")))) / 1e3
    both = ByCause(causes, np.stack(value), np.stack(drawn, axis=1))
    table = _table(both, measured, np.zeros((many, 2)))
    return table if log.measured else pd.DataFrame(table[:-2])


def alike(a: Fitted, b: Fitted) -> list[tuple[int, int]]:
    """Places in both of the coefficients that are known alike: same name, value and variance, and correlated with none
    that differ."""
    names = [c.name for c in b.problem.table.free]
    both = [(i, names.index(c.name)) for i, c in enumerate(a.problem.table.free) if c.name in names]
    same = [(i, k) for i, k in both if a.values[i] == b.values[k] and a.covariance[i, i] == b.covariance[k, k]]
    if not same or a.freedom != b.freedom:
        return []
    i, k = (np.array(x) for x in zip(*same, strict=True))
    equal = np.array_equal(a.covariance[np.ix_(i, i)], b.covariance[np.ix_(k, k)])
    apart = all(not np.any(np.delete(f.covariance[at], at, axis=1)) for f, at in ((a, i), (b, k)))
    return same if equal and apart else []


def _table(parts: ByCause, measured: np.ndarray, wobble: np.ndarray) -> pd.DataFrame:
    value = np.column_stack([parts.value, measured - parts.value.sum(axis=1), measured])
    drawn = np.concatenate(
        [parts.drawn, (measured - parts.drawn.sum(axis=2) + wobble)[:, :, None],
         np.broadcast_to(measured[None, :, None], (*parts.drawn.shape[:2], 1))], axis=2
    )  # fmt: skip
    low, high = interval(drawn[:, 1] - drawn[:, 0])
    rows = zip((*parts.causes, UNEXPLAINED, TOTAL), value[0], value[1], value[1] - value[0], low, high, strict=True)
    return pd.DataFrame(list(rows), columns=COLUMNS)
