"""What others would do with the same residual and the same columns: sparse regression, lasso, forward BIC, boosting.

Each gets the help it needs: the declared model's coefficients are projected off, what they take up whole is left out,
every effect comes in the way that fits it best (its sizes and the shapes they are at), columns have unit variance.
None knows of trips but the lasso, whose folds are trips. Effects that the diagnosis does not search by column have
no column here.
"""

import time
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from hdev_jax.diagnosis.candidates.candidate import Candidate
from hdev_jax.diagnosis.candidates.plan import columns
from hdev_jax.diagnosis.settings import SETTINGS
from hdev_jax.inference import calibrate, cluster_rows, jacobian, padded
from hdev_jax.physics import LIBRARY
from hdev_jax.problem import Problem, Split

__all__ = ["comparable", "run_rivals"]


def _stlsq(x: np.ndarray, y: np.ndarray, _: np.ndarray) -> np.ndarray:
    """Sequentially thresholded least squares, PySINDy's optimiser at its defaults (threshold 0.1, ridge 0.05)."""
    import pysindy

    optimiser = pysindy.optimizers.STLSQ(threshold=0.1, alpha=0.05)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # all coefficients below the threshold
        optimiser.fit(x, y[:, None])
    return np.flatnonzero(np.abs(optimiser.coef_[0]) > 0)


def _lasso(x: np.ndarray, y: np.ndarray, trip: np.ndarray) -> np.ndarray:
    from sklearn.linear_model import LassoCV
    from sklearn.model_selection import GroupKFold

    folds = list(GroupKFold(min(5, len(np.unique(trip)))).split(x, y, trip))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # slow convergence
        fit = LassoCV(cv=folds).fit(x, y)
    return np.flatnonzero(np.abs(fit.coef_) > 0)


def _forward_bic(x: np.ndarray, y: np.ndarray, _: np.ndarray) -> np.ndarray:
    chosen: list[int] = []
    n, best = len(y), len(y) * np.log(np.mean(y**2))
    while len(chosen) < x.shape[1]:
        trials = []
        for k in range(x.shape[1]):
            if k not in chosen:
                a = x[:, [*chosen, k]]
                rest = y - a @ np.linalg.lstsq(a, y, rcond=None)[0]
                trials.append((n * np.log(np.mean(rest**2)) + (len(chosen) + 1) * np.log(n), k))
        score, k = min(trials)
        if score >= best:
            break
        best, chosen = score, [*chosen, k]
    return np.array(chosen, dtype=int)


SELECTORS: dict[str, Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]] = {
    "stlsq": _stlsq,
    "lasso_cv": _lasso,
    "forward_bic": _forward_bic,
}


def run_rivals(names: list[str], problem: Problem, split: Split) -> dict[str, dict[str, Any]]:
    """For each rival: the effects it names, its error on test trips, seconds (the shared columns apart)."""
    if not names:
        return {}
    train, test = problem.rows(split.train), problem.rows(split.test)
    rows = padded(problem.segments.take(train), problem.measured[train])
    fit = calibrate(problem.vehicle, problem.table, rows, problem.target, cluster_rows(problem.segments.take(train)))
    every = padded(problem.segments, problem.measured)
    residual = problem.measured - problem.predict(fit.vehicle)
    jac = jacobian(fit.vehicle, fit.table, every.segments, problem.target)[: every.rows]
    candidates, matrix, _ = columns(fit.vehicle, list(LIBRARY.values()), every.segments, every.rows, problem.target)
    trip = np.asarray(problem.segments.trip)[train]
    beyond = _projected(jac[train], matrix[train])
    y = _projected(jac[train], residual[train][:, None])[:, 0]
    seen = np.sum(beyond**2, axis=0) > SETTINGS.absorbed * np.sum(matrix[train] ** 2, axis=0)
    best = _best_ways([c for c in candidates if seen[list(c.columns)].all()], beyond, y)
    at = [k for c in best.values() for k in c.columns]
    ids = [id_ for id_, c in best.items() for _ in c.columns]
    x = beyond[:, at] / np.std(beyond[:, at], axis=0)
    scaled = y / np.std(y)
    out: dict[str, dict[str, Any]] = {}
    for name in names:
        started = time.perf_counter()
        if name == "lightgbm":
            predicted = _boosted(problem, split, residual)
            named: list[str] = []
        else:
            chosen = SELECTORS[name](x, scaled, trip)
            named = sorted({ids[k] for k in chosen})
            design = np.concatenate([jac, matrix[:, [at[k] for k in chosen]]], axis=1)
            scale = np.maximum(np.linalg.norm(design[train], axis=0), 1e-300)
            beta = np.linalg.lstsq(design[train] / scale, residual[train], rcond=None)[0] / scale
            predicted = design[test] @ beta
        rmse = float(np.sqrt(np.mean((residual[test] - predicted) ** 2)))
        out[name] = {"named": named, "test_rmse": rmse, "seconds": time.perf_counter() - started}
    return out


def comparable(planted: Sequence[str]) -> bool:
    """Whether rivals could name all of it: what is sought elsewhere than in columns gives them no column."""
    return not any(LIBRARY[k].searched for k in planted if k in LIBRARY)


def _best_ways(candidates: Sequence[Candidate], x: np.ndarray, y: np.ndarray) -> dict[str, Candidate]:
    """Of each effect the way that fits best, by BIC: one size, or several together."""
    best: dict[str, tuple[float, Candidate]] = {}
    for c in candidates:
        a = x[:, list(c.columns)]
        rest = y - a @ np.linalg.lstsq(a, y, rcond=None)[0]
        score = len(y) * np.log(np.mean(rest**2)) + len(c.columns) * np.log(len(y))
        if c.id not in best or score < best[c.id][0]:
            best[c.id] = score, c
    return {id_: c for id_, (_, c) in best.items()}


def _projected(jac: np.ndarray, columns: np.ndarray) -> np.ndarray:
    if not jac.shape[1]:
        return columns
    q, _ = np.linalg.qr(jac / np.linalg.norm(jac, axis=0))
    return columns - q @ (q.T @ columns)


def _boosted(problem: Problem, split: Split, residual: np.ndarray) -> np.ndarray:
    """A gradient-boosted correction from every channel: what names nothing but may predict."""
    import lightgbm as lgb

    s = problem.segments
    features = np.stack([s.speed_mps, s.accel_mps2, s.time_s, s.duration_s, *map(np.asarray, s.channels.values())], 1)
    train, test = problem.rows(split.train), problem.rows(split.test)
    parameters = {"objective": "regression", "verbosity": -1, "num_threads": 1, "seed": 0, "deterministic": True}
    booster = lgb.train(parameters, lgb.Dataset(features[train], residual[train]), 100)
    return np.asarray(booster.predict(features[test]))
