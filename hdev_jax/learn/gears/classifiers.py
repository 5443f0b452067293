"""Classifiers of the gear as paper 1 names them, with a search by Optuna whose folds are of whole routes."""

import tempfile
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from hdev_jax.errors import InputError
from hdev_jax.learn.trees.files import read_trees
from hdev_jax.learn.trees.trees import Trees

__all__ = ["CLASSIFIERS", "Classifier", "alike", "balanced_accuracy", "route_folds", "scored", "search_classifier"]

Fit = Callable[[np.ndarray, np.ndarray], Any]  # features, classes from 0
LEAST_ROWS = 30  # of a gear, for its share of correct rows to say something: 1 sd of at most 9 points
COMMON = (0.0, 0.001, 0.003, 0.01, 0.03)  # shares that rarer gears are taken to have


@dataclass(frozen=True)
class Classifier:
    """A fitted classifier; `gears` are what its classes stand for, `common` is what `alike` takes."""

    kind: str
    model: Any
    gears: tuple[int, ...]
    features: tuple[str, ...]
    settings: dict[str, Any]
    score: float
    common: float

    def probabilities(self, x: Float[np.ndarray, "row feature"]) -> Float[np.ndarray, "row gear"]:
        """Probability of each of `gears`, by the library's own predictor."""
        if self.kind == "lightgbm":
            p = np.asarray(self.model.predict(x), dtype=float)
            return p if p.ndim == 2 else np.stack([1 - p, p], axis=1)
        return np.asarray(self.model.predict_proba(x), dtype=float)

    def trees(self) -> Trees:
        """The same model as arrays for the kernel. Raises `InputError` for a kind that is not boosted trees."""
        if self.kind not in ("lightgbm", "catboost"):
            raise InputError(
                f"gear model {self.kind!r}: boosted trees (lightgbm or catboost) are expected in the kernel"
            )
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "model"
            if self.kind == "lightgbm":
                self.model.save_model(path)
            else:
                self.model.save_model(str(path), format="json")
            found = read_trees(path, self.gears)
        return Trees(found.reading, found.forest, found.offset, found.scale, self.features, found.classes, found.link)


def _decision_tree(trial: Any, seed: int) -> Fit:
    from sklearn.tree import DecisionTreeClassifier

    model = DecisionTreeClassifier(
        max_depth=trial.suggest_int("max_depth", 6, 20),
        min_samples_leaf=trial.suggest_int("min_samples_leaf", 2, 100, log=True),
        random_state=seed,
    )
    return model.fit


def _knn(trial: Any, seed: int) -> Fit:
    from sklearn.neighbors import KNeighborsClassifier
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    count = trial.suggest_int("neighbours", 1, 40, log=True)
    model = make_pipeline(StandardScaler(), KNeighborsClassifier(count, weights="distance"))
    return model.fit


def _random_forest(trial: Any, seed: int) -> Fit:
    from sklearn.ensemble import RandomForestClassifier

    model = RandomForestClassifier(
        n_estimators=trial.suggest_int("trees", 20, 60),
        max_depth=trial.suggest_int("max_depth", 8, 20),
        min_samples_leaf=trial.suggest_int("min_samples_leaf", 1, 50, log=True),
        random_state=seed,
        n_jobs=1,
    )
    return model.fit


def _lightgbm(trial: Any, seed: int) -> Fit:
    settings = {
        "learning_rate": trial.suggest_float("learning_rate", 0.08, 0.15, log=True),
        "num_leaves": trial.suggest_int("num_leaves", 12, 31),
        "min_data_in_leaf": trial.suggest_int("min_data_in_leaf", 20, 200, log=True),
        # without it a class of few rows gets leaves without bound, and the loss runs away
        "min_sum_hessian_in_leaf": trial.suggest_float("min_sum_hessian_in_leaf", 0.1, 5.0, log=True),
        "lambda_l2": trial.suggest_float("lambda_l2", 0.1, 10.0, log=True),
    }
    rounds = trial.suggest_int("rounds", 30, 50)
    fixed = {
        "verbosity": -1,
        "deterministic": True,
        "force_row_wise": True,
        "num_threads": 1,
        "seed": seed,
        "max_bin": 127,
    }

    def fit(x: np.ndarray, y: np.ndarray) -> Any:
        import lightgbm as lgb

        classes = {"objective": "multiclass", "num_class": int(y.max()) + 1}
        return lgb.train({**fixed, **classes, **settings}, lgb.Dataset(x, y), rounds)

    return fit


def _catboost(trial: Any, seed: int) -> Fit:
    from catboost import CatBoostClassifier

    model = CatBoostClassifier(
        iterations=trial.suggest_int("trees", 300, 400),
        depth=trial.suggest_int("depth", 5, 6),
        learning_rate=trial.suggest_float("learning_rate", 0.15, 0.3),
        l2_leaf_reg=trial.suggest_float("l2_leaf_reg", 1.0, 10.0, log=True),
        border_count=254, random_seed=seed, thread_count=1, verbose=0, allow_writing_files=False,
    )  # fmt: skip
    return model.fit


CLASSIFIERS: dict[str, Callable[[Any, int], Fit]] = {
    "decision_tree": _decision_tree,
    "knn": _knn,
    "random_forest": _random_forest,
    "lightgbm": _lightgbm,
    "catboost": _catboost,
}


def balanced_accuracy(gear: Int[np.ndarray, " row"], told: Int[np.ndarray, " row"]) -> float:
    """Mean over the gears of the share of their rows that are predicted correctly.

    Gears of fewer than `LEAST_ROWS` rows are left out (`scored` says which rows are not), unless there are no others.
    """
    return _balanced(told == gear, gear)


def scored(by: Int[np.ndarray, " row"]) -> Bool[np.ndarray, " row"]:
    """Rows of gears that have at least `LEAST_ROWS` of them; all rows where no gear has."""
    _, at, count = np.unique(by, return_inverse=True, return_counts=True)
    enough = count >= LEAST_ROWS
    return enough[at] if enough.any() else np.ones(len(by), dtype=bool)


def _balanced(right: np.ndarray, by: np.ndarray) -> float:
    gears = np.unique(by[scored(by)])
    return float(np.mean([np.mean(right[by == g]) for g in gears]))


def alike(
    p: Float[np.ndarray, "row gear"], share: Float[np.ndarray, "*row gear"], common: float
) -> Int[np.ndarray, " row"]:
    """The place of the gear that is likeliest where each gear is as common as any other: what balanced accuracy asks.

    Weights of classes in the decision, not in the fit, whose probabilities stay those of the road. `share` is how
    common each gear was in training. One of a few rows cannot be predicted that well: rarer ones than
    `common` count as that common, one that training never showed is not predicted.
    """
    return np.argmax(np.where(share > 0, p / np.maximum(share, max(common, 1e-12)), 0.0), axis=1)


def route_folds(route: Int[np.ndarray, " row"], count: int, seed: int) -> Iterator[np.ndarray]:
    """The rows of `count` shares of the routes, each route whole in one of them."""
    every, at = np.unique(route, return_inverse=True)
    share = np.random.default_rng(seed).permutation(len(every)) % count
    for k in range(count):
        yield share[at] == k


def search_classifier(
    kind: str,
    x: Float[np.ndarray, "row feature"],
    gear: Int[np.ndarray, " row"],
    route: Int[np.ndarray, " row"],
    *,
    features: Sequence[str],
    trials: int,
    folds: int,
    seed: int,
    search_rows: int = 30_000,
    by: Int[np.ndarray, " row"] | None = None,
) -> Classifier:
    """A search of `trials` settings by routes left out, then a fit of the best on all rows.

    **Arguments:** `gear`, what is predicted, 1 and up; `by`: what rows are balanced by where that is another thing (the
    gear, where its distance from another is predicted).

    The score is the mean of the accuracy of the likeliest gear and the balanced accuracy of `alike` at the
    best of a few values of its `common`. Of more than `search_rows` rows the search sees whole routes, as many as make
    up so many.

    **Raises:** `InputError` for an unknown kind, and where a gear below the highest is missing from the rows.
    """
    import optuna

    if kind not in CLASSIFIERS:
        raise InputError(f"gear classifier {kind!r}: one of {', '.join(CLASSIFIERS)} is expected")
    every = np.unique(gear)
    if missing := sorted(set(range(1, int(every.max()) + 1)) - set(every.tolist())):
        raise InputError(
            f"gear {missing[0]} is missing from the {len(gear)} rows of training, which go up to gear {every.max()}; "
            "train on more routes, or on vehicles that use it"
        )
    by = gear if by is None else by
    share = np.bincount(by) / len(by)
    # how common what each class stands for is, by row
    stands = np.clip((by - gear)[:, None] + every, 0, len(share))
    shares = np.append(share, 0.0)[stands]

    def fitted(trial: Any, rows: np.ndarray) -> Any:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return CLASSIFIERS[kind](trial, seed)(x[rows], gear[rows] - 1)

    def made(model: Any, settings: dict[str, Any], score: float, common: float) -> Classifier:
        return Classifier(kind, model, tuple(int(g) for g in every), tuple(features), settings, score, common)

    used = _some_routes(route, search_rows, seed)

    def objective(trial: Any) -> float:
        scores, balanced = [], []
        for left_out in route_folds(route, folds, seed):
            # what few rows have is in all of them that are not left out
            rare = ~np.isin(gear, np.unique(gear[used & ~left_out]))
            rows = (used | rare) & ~left_out
            if len(np.unique(gear[rows])) < len(every):
                continue  # a fold that holds all rows of a gear says nothing
            seen = used & left_out
            p = made(fitted(trial, rows), {}, 0.0, 0.0).probabilities(x[seen])
            scores.append(np.mean(1 + np.argmax(p, axis=1) == gear[seen]))
            told = [1 + alike(p, shares[seen], c) for c in COMMON]
            balanced.append([_balanced(t == gear[seen], by[seen]) for t in told])
        if not scores:
            return 0.0
        best = int(np.argmax(np.mean(balanced, axis=0)))
        trial.set_user_attr("common", COMMON[best])
        return float(0.5 * np.mean(scores) + 0.5 * np.mean(balanced, axis=0)[best])

    verbosity = optuna.logging.get_verbosity()
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    try:
        study = optuna.create_study(direction="maximize", sampler=optuna.samplers.TPESampler(seed=seed))
        study.optimize(objective, n_trials=trials)
        if study.best_value == 0.0:
            raise InputError(
                f"gear classifier: in none of {folds} folds of whole routes do the others have every gear; "
                "train on more routes"
            )
    finally:
        optuna.logging.set_verbosity(verbosity)
    model = fitted(optuna.trial.FixedTrial(study.best_params), np.ones(len(gear), dtype=bool))
    common = study.best_trial.user_attrs["common"]
    return made(model, {**study.best_params, "common": common}, float(study.best_value), common)


def _some_routes(route: np.ndarray, rows: int, seed: int) -> np.ndarray:
    every, at, count = np.unique(route, return_inverse=True, return_counts=True)
    order = np.random.default_rng(seed).permutation(len(every))
    chosen = np.zeros(len(every), dtype=bool)
    chosen[order[: max(2, int(np.searchsorted(np.cumsum(count[order]), rows)) + 1)]] = True
    return chosen[at]
