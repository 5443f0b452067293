"""Models of LightGBM and scikit-learn with a search by Optuna: trees, boosted trees, robust linear, support vectors."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from hdev_jax.errors import InputError
from hdev_jax.learn.narx.selection import folds
from hdev_jax.learn.sequences import Scale, Trip, mean_squared
from hdev_jax.learn.sources import Channels, Source

__all__ = ["CLASSICAL", "ClassicalModel", "search_classical"]

SVR_ROWS = 3000  # support vectors cost the square of the rows: every so-manieth row is used


class _LinearLeaves:
    """LightGBM with the interface of scikit-learn's regressors: leaves that hold a line, as in a model tree.

    Constant leaves end where the training trip ends, and every other trip goes further.
    """

    def __init__(self, rounds: int, **settings: Any):
        self.rounds, self.settings = rounds, settings
        self.booster: Any = None

    def fit(self, x: np.ndarray, y: np.ndarray) -> "_LinearLeaves":
        import lightgbm as lgb

        fixed = {
            "objective": "regression",
            "verbosity": -1,
            "num_threads": 1,
            "deterministic": True,
            "linear_tree": True,
        }
        data = lgb.Dataset(x, y, params={"linear_tree": True, "verbosity": -1})
        self.booster = lgb.train({**fixed, **self.settings}, data, self.rounds)
        return self

    def predict(self, x: np.ndarray) -> np.ndarray:
        return np.asarray(self.booster.predict(x))

    @property
    def numbers(self) -> int:
        """Thresholds and leaf coefficients of all trees."""
        lines = self.booster.model_to_string().splitlines()
        fields = ("threshold=", "leaf_const=", "leaf_coeff=")
        return sum(len(line.partition("=")[2].split()) for line in lines if line.startswith(fields))


class _ModelTree:
    """A regression tree whose leaves hold a line each (Quinlan's M5): grown by squared error, lines by ridge."""

    def __init__(self, leaf: int, ridge: float, seed: int):
        self.leaf, self.ridge, self.seed = leaf, ridge, seed
        self.tree: Any = None
        self.lines: dict[int, np.ndarray] = {}

    def fit(self, x: np.ndarray, y: np.ndarray) -> "_ModelTree":
        from sklearn.tree import DecisionTreeRegressor

        self.scale = Scale.of(x)
        self.tree = DecisionTreeRegressor(min_samples_leaf=self.leaf, random_state=self.seed).fit(x, y)
        at, z = self.tree.apply(x), self._columns(x)
        order = np.argsort(at, kind="stable")
        for rows in np.split(order, np.flatnonzero(np.diff(at[order])) + 1):
            damp = self.ridge * len(rows) * np.diag(np.r_[0.0, np.ones(x.shape[1])])
            self.lines[int(at[rows[0]])] = np.linalg.solve(z[rows].T @ z[rows] + damp, z[rows].T @ y[rows])
        return self

    def _columns(self, x: np.ndarray) -> np.ndarray:
        return np.c_[np.ones(len(x)), self.scale.apply(x)]

    def predict(self, x: np.ndarray) -> np.ndarray:
        lines = np.stack([self.lines[k] for k in self.tree.apply(x)])
        return np.sum(lines * self._columns(x), axis=1)

    @property
    def numbers(self) -> int:
        """Thresholds and coefficients of the leaves."""
        return int(np.sum(self.tree.tree_.children_left >= 0)) + sum(line.size for line in self.lines.values())


def _tree(trial: Any, seed: int) -> Any:
    leaf = trial.suggest_int("min_samples_leaf", 3, 2000, log=True)
    return _ModelTree(leaf, trial.suggest_float("ridge", 1e-6, 1.0, log=True), seed)


def _boosted(trial: Any, seed: int) -> Any:
    return _LinearLeaves(
        trial.suggest_int("rounds", 20, 300, log=True),
        learning_rate=trial.suggest_float("learning_rate", 0.02, 0.5, log=True),
        num_leaves=trial.suggest_int("num_leaves", 3, 64, log=True),
        min_data_in_leaf=trial.suggest_int("min_data_in_leaf", 5, 500, log=True),
        linear_lambda=trial.suggest_float("linear_lambda", 1e-3, 10.0, log=True),
        seed=seed,
    )


def _robust_linear(trial: Any, seed: int) -> Any:
    from sklearn.linear_model import HuberRegressor
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import PolynomialFeatures, StandardScaler

    return make_pipeline(
        StandardScaler(),
        PolynomialFeatures(trial.suggest_int("degree", 1, 4)),
        HuberRegressor(
            epsilon=trial.suggest_float("epsilon", 1.05, 3.0),
            alpha=trial.suggest_float("alpha", 1e-6, 1.0, log=True),
            max_iter=500,
        ),
    )


def _support_vectors(trial: Any, seed: int) -> Any:
    from sklearn.compose import TransformedTargetRegressor
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler
    from sklearn.svm import SVR

    kernel = trial.suggest_categorical("kernel", ["rbf", "poly"])
    degree = trial.suggest_int("degree", 2, 4) if kernel == "poly" else 3
    machine = SVR(
        kernel=kernel,
        degree=degree,
        coef0=1.0,
        C=trial.suggest_float("C", 0.1, 1000.0 if kernel == "rbf" else 10.0, log=True),
        epsilon=trial.suggest_float("epsilon", 3e-3, 0.1, log=True),
        gamma=trial.suggest_float("gamma", 0.03, 1.0, log=True),
        max_iter=500_000,
    )
    return TransformedTargetRegressor(make_pipeline(StandardScaler(), machine), transformer=StandardScaler())


CLASSICAL: dict[str, Callable[[Any, int], Any]] = {
    "tree": _tree,
    "boosted": _boosted,
    "robust_linear": _robust_linear,
    "support_vectors": _support_vectors,
}


@dataclass(frozen=True)
class ClassicalModel:
    """A fitted regressor of the row's own inputs: it has no memory, prediction and simulation are the same."""

    regressor: Any
    source: Source
    settings: dict[str, Any]
    score: float

    def predict(self, trip: Trip) -> Float[np.ndarray, " row"]:
        """Output for every row of a trip, in the target's unit."""
        return np.asarray(self.regressor.predict(self.source(trip)), dtype=float)

    def simulate(self, trip: Trip) -> Float[np.ndarray, " row"]:
        """The same as `predict`."""
        return self.predict(trip)

    def measured(self, trip: Trip) -> Float[np.ndarray, " row"]:
        """What they are to be compared with."""
        return np.asarray(trip.target)

    @property
    def parameters(self) -> int | None:
        """Numbers that were fitted, where that can be said."""
        inner = self.regressor
        if isinstance(inner, _LinearLeaves | _ModelTree):
            return inner.numbers
        if hasattr(inner, "regressor_"):
            return int(inner.regressor_[-1].support_vectors_.size + inner.regressor_[-1].dual_coef_.size + 1)
        return int(inner[-1].coef_.size + 1) if hasattr(inner, "steps") else None


def search_classical(
    kind: str, trip: Trip, *, trials: int, seed: int, blocks: int = 3, source: Source | None = None
) -> ClassicalModel:
    """A search of `trials` settings (Optuna's TPE) by blocks of the training trip, then a fit of the best on all of it.

    The score is the MSE of rows left out, of blocks and of the edge together (`selection.folds`).
    Raises `InputError` for a kind that is not in `CLASSICAL`.
    """
    import optuna

    if kind not in CLASSICAL:
        raise InputError(f"model {kind!r}: one of {', '.join(CLASSICAL)} is expected")
    source = Channels() if source is None else source
    x, y = source(trip), np.asarray(trip.target)
    left_out = folds(y, blocks)
    thin = max(1, len(y) // SVR_ROWS) if kind == "support_vectors" else 1

    def fitted(trial: Any, rows: np.ndarray) -> Any:
        with warnings.catch_warnings():
            warnings.simplefilter(
                "ignore"
            )  # settings that do not converge score badly; that is how they are recognised
            return CLASSICAL[kind](trial, seed).fit(x[rows][::thin], y[rows][::thin])

    def objective(trial: Any) -> float:
        errors = [fitted(trial, ~rows).predict(x[rows]) - y[rows] for rows in left_out]
        return mean_squared(np.concatenate(errors))

    verbosity = optuna.logging.get_verbosity()
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    try:
        study = optuna.create_study(sampler=optuna.samplers.TPESampler(seed=seed))
        study.optimize(objective, n_trials=trials)
    finally:
        optuna.logging.set_verbosity(verbosity)
    best = fitted(optuna.trial.FixedTrial(study.best_params), np.ones(len(y), dtype=bool))
    return ClassicalModel(best, source, dict(study.best_params), float(study.best_value))
