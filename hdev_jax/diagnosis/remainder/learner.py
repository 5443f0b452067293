"""A flexible learner of the residual, validated by trip: how much of it anything in the log predicts."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy import stats

from hdev_jax.diagnosis.remainder.rows import Rows

__all__ = ["curve", "learn", "share_of"]

ROUNDS = 400
BINS = 10  # of the smooth correction
MOST_ROWS = 30_000  # that the learner is trained on
LEANS = 0.15  # of the total importance, for a feature that is named


def learn(train: Rows, test: Rows, names: Sequence[str], seed: int) -> tuple[np.ndarray, float, tuple[str, ...]]:
    """Correction on test rows, its p in cross-validation over training clusters, and the most important features."""
    import lightgbm as lgb

    every = max(1, len(train.residual) // MOST_ROWS)  # neighbouring rows are alike: enough of them
    x, y = train.features[::every], train.residual[::every]
    clusters = replace(train.clusters, ids=train.clusters.ids[::every])
    rng = np.random.default_rng(seed)
    fold = rng.permutation(np.arange(clusters.count) % 4)[clusters.ids]
    rows = len(y)
    parameters = {
        "objective": "regression", "learning_rate": 0.05, "num_leaves": 15, "verbosity": -1, "num_threads": 1,
        "min_data_in_leaf": int(max(20, rows // 200)), "lambda_l2": 10.0, "feature_fraction": 0.8, "seed": seed,
        "deterministic": True, "force_row_wise": True, "max_bin": 127,
    }  # fmt: skip
    scale = float(np.std(y)) + 1e-300

    safe = [f"f{i}" for i in range(len(names))]

    def part(at: np.ndarray, **options: Any) -> Any:
        return lgb.Dataset(x[at], y[at] / scale, feature_name=safe, **options)

    out_of_fold, steps = np.zeros(rows), []
    folds = np.unique(fold)
    for k, k_next in zip(folds, np.roll(folds, -1), strict=True) if len(folds) > 2 else ():
        # rounds are chosen on the fold after the one that is predicted, which takes no part in it
        data = part((fold != k) & (fold != k_next))
        check = part(fold == k_next, reference=data)
        stop = [lgb.early_stopping(20, verbose=False)]
        steps.append(max(lgb.train(parameters, data, ROUNDS, valid_sets=[check], callbacks=stop).best_iteration, 0))
        booster = lgb.train(parameters, part(fold != k), max(steps[-1], 1))
        out_of_fold[fold == k] = np.asarray(booster.predict(x[fold == k])) * scale
    rounds = int(np.median(steps)) if steps else 0
    if rounds < 2:
        return np.zeros(len(test.residual)), 1.0, ()
    gain = clusters.sums(y**2 - (y - out_of_fold) ** 2)
    size = clusters.sums(y**2)
    relative = gain / np.mean(size)
    t = np.mean(relative) / (np.std(relative, ddof=1) / np.sqrt(len(relative)) + 1e-300)
    p = float(stats.t.sf(t, len(relative) - 1))
    booster = lgb.train(parameters, part(np.ones(rows, bool)), rounds)
    correction = np.asarray(booster.predict(test.features)) * scale
    importance = booster.feature_importance("gain")
    first = np.argsort(-importance)[:3]
    leading = tuple(str(names[int(i)]) for i in first if importance[i] > LEANS * importance.sum())
    return correction, p, leading


def share_of(residual: np.ndarray, predicted: np.ndarray) -> float:
    """Share of a residual's squares that a prediction of it takes away, 0 at least."""
    squares = float(np.sum(residual**2))
    return float(np.clip(1.0 - np.sum((residual - predicted) ** 2) / max(squares, 1e-300), 0.0, 1.0))


def curve(correction: np.ndarray, rows: Rows, names: list[str], channel: str, unit: str) -> dict[str, Any]:
    """The mean of a correction in bins of one channel with like numbers of rows."""
    x = rows.features[:, names.index(channel)]
    edges = np.unique(np.quantile(x, np.linspace(0, 1, BINS + 1)[1:-1]))
    place = np.searchsorted(edges, x)
    groups = [place == k for k in np.unique(place)]
    at, value = ([float(np.mean(y[g])) for g in groups] for y in (x, correction))
    return {"channel": channel, "at": at, "value": value, "unit": unit}
