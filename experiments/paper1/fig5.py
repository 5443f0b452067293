"""Figure 5 and section 3.1 of paper 1 on the synthetic fleet: the gear by classifier, row by row and with memory.

One task is one classifier on one set of features. A row's gear is the likeliest of those that its gearbox has.
"""

import time
from collections.abc import Iterator
from typing import Any, Literal

import jax
import numpy as np
from pydantic import Field

from experiments.paper1.gear_bound import bounds
from experiments.paper1.gear_energy import energy_cost
from experiments.paper1.gear_tables import collect
from experiments.paper1.gears import Rows, fleet_rows, scores
from experiments.runner.config import Strict
from hdev_jax.learn.gears.classifiers import Classifier, search_classifier
from hdev_jax.learn.gears.gears import EVERY, FEATURES, MOST_GEARS, PLACE, absolute, chained, filtered, markov

__all__ = ["SOURCES", "Config", "collect", "run", "tasks"]

SOURCES = ("gears.py", "gear_bound.py", "gear_energy.py")


class Config(Strict):
    """The fleet, what is held out, the budget of the searches, and the paper's numbers."""

    experiment: Literal["paper1.fig5"]
    artefact: str
    caption: str
    seed: int = Field(1, ge=0)
    routes: int = 1120
    variants: list[str] = Field(default_factory=lambda: ["all"])
    held_variants: list[str]
    left_out: int = 4  # one route in so many is never trained on
    train_rows: int = 70_000  # at most; whole routes
    classifiers: list[str]
    sets: list[str] = Field(default_factory=lambda: ["paper", "sheet", "relative"])
    memory: list[str] = Field(default_factory=list)  # classifiers that also get the measured previous gear
    trials: int = 3
    folds: int = 2
    search_rows: int = 8_000
    figure: str = "catboost"
    paper: dict[str, dict[str, float]] = Field(default_factory=dict)


def tasks(config: Config) -> Iterator[dict[str, Any]]:
    """The bound, and each classifier on each set of features."""
    common = {
        "seed": config.seed, "routes": config.routes, "variants": config.variants, "held": config.held_variants,
        "left_out": config.left_out,
    }  # fmt: skip
    yield {**common, "bound": True}
    budget = {k: getattr(config, k) for k in ("train_rows", "trials", "folds", "search_rows")}
    for kind in config.classifiers:
        for name in reversed(config.sets):
            yield {**common, **budget, "kind": kind, "set": name, "previous": False}
        if kind in config.memory:
            yield {**common, **budget, "kind": kind, "set": config.sets[-1], "previous": True}


def run(task: dict[str, Any]) -> dict[str, Any]:
    """Search, fit, tell every row that was not trained on; score, filter, and what it costs in energy."""
    fleet = task["seed"], task["routes"], tuple(task["variants"])
    rows = fleet_rows(fleet, tuple(task["held"]), task["left_out"])
    if task.get("bound"):
        return {"bounds": bounds(rows, task["seed"]), "rows": [int(m.sum()) for m in (rows.train, rows.unseen_routes,
                rows.unseen_variants)]}  # fmt: skip
    names = FEATURES[task["set"]]
    x = rows.x[:, [EVERY.index(n) for n in names]]
    reference = _reference(rows) if PLACE in names else np.zeros(len(rows.gear), dtype=int)
    target = rows.gear - reference
    if task["previous"]:
        names, x = (*names, "previous_gear"), np.c_[x, (rows.previous - reference).astype(np.float32)]
    fit = _first_routes(rows, task["train_rows"])
    started = time.perf_counter()
    lowest = int(target[fit].min()) if PLACE in names else 1
    model = search_classifier(
        task["kind"], x[fit], target[fit] - lowest + 1, rows.route[fit], features=names, by=rows.gear[fit],
        trials=task["trials"],
        folds=task["folds"], seed=task["seed"], search_rows=task["search_rows"],
    )  # fmt: skip
    seconds = time.perf_counter() - started
    p = np.zeros((len(rows.gear), MOST_GEARS))
    test = np.flatnonzero(~rows.train)
    classes = tuple(float(c + lowest - 1) for c in model.gears)

    def told_at(at: np.ndarray, x: np.ndarray = x) -> np.ndarray:
        known = reference[at] if PLACE in names else None
        return _of_the_box(model.probabilities(x[at]), classes, known, rows.gears[at])

    p[test] = told_at(test)
    told = 1 + np.argmax(p, axis=1)
    out = {
        "scores": scores(rows, p, model.common), "confusion": _confusion(rows, told), "settings": model.settings,
        "fit_seconds": seconds, "train_rows": len(fit), "speed": _speed(model, x[test]),
        "energy": energy_cost(rows, np.where(p.sum(axis=1, keepdims=True) > 0, p, 1.0), fleet),
        "sample": _sample(rows, told),
    }  # fmt: skip
    if task["previous"]:
        after = _chain(rows, test, x, reference, told_at)
    else:
        seen = fit[:: max(1, len(fit) // 20_000)]
        after = _filter(rows, p, test, seen, told_at(seen))
    out["memory"] = scores(rows, after, model.common)
    out["sample"]["filter"] = _sample(rows, 1 + np.argmax(after, axis=1))["told"]
    return out


def _first_routes(rows: Rows, most: int) -> np.ndarray:
    """Rows of training, of as many whole routes of every vehicle as make up at most so many rows."""
    train = np.flatnonzero(rows.train)
    share = min(1.0, most / len(train))
    kept = []
    for k in np.unique(rows.vehicle[train]):
        of = train[rows.vehicle[train] == k]
        routes = np.unique(rows.route[of])
        kept.append(of[np.isin(rows.route[of], routes[: max(2, round(share * len(routes)))])])
    return np.concatenate(kept)


def _reference(rows: Rows) -> np.ndarray:
    return rows.x[:, EVERY.index("reference_gear")].astype(int)


def _of_the_box(p: np.ndarray, classes: tuple[float, ...], reference: Any, gears: np.ndarray) -> np.ndarray:
    """Probabilities of the gears that each row's box has."""
    out = np.zeros((len(p), MOST_GEARS))
    for count in np.unique(gears):
        at = gears == count
        known = None if reference is None else reference[at]
        out[at, :count] = np.asarray(absolute(p[at], classes, known, int(count)))
    return out


def _filter(rows: Rows, p: np.ndarray, test: np.ndarray, seen: np.ndarray, share: np.ndarray) -> np.ndarray:
    """The hidden Markov filter, for boxes of as many gears each its own chain, counted on the training routes."""
    out = np.zeros_like(p)
    run_filter = jax.jit(lambda p, trip, change, share: filtered(p, trip, change=change, share=share))
    for gears in np.unique(rows.gears):
        train = rows.where(rows.train, rows.gears == gears)
        change, _ = markov(rows.gear[train], rows.route[train], int(gears))
        # the prior in the classifier's probabilities, weights of classes included: their mean on training rows
        prior = share[rows.gears[seen] == gears][:, :gears].mean(axis=0) + 1e-6
        at = test[rows.gears[test] == gears]
        if len(at):
            out[at, :gears] = run_filter(p[at][:, :gears], rows.route[at], change, prior / prior.sum())
    return out


def _chain(rows: Rows, test: np.ndarray, x: np.ndarray, reference: np.ndarray, told_at: Any) -> np.ndarray:
    """The gear by the classifier that sees the previous gear, which it only knows from its own telling so far."""
    out = np.zeros((len(rows.gear), MOST_GEARS))
    run_chain = jax.jit(chained)
    for gears in np.unique(rows.gears):
        at = test[rows.gears[test] == gears]
        if not len(at):
            continue
        given = []
        for before in range(1, int(gears) + 1):
            supposed = x.copy()
            supposed[:, -1] = before - reference
            given.append(told_at(at, supposed)[:, :gears])
        out[at, :gears] = run_chain(np.stack(given, axis=1), rows.route[at])
    return out


def _confusion(rows: Rows, told: np.ndarray) -> list[list[int]]:
    """Counts of unseen routes [true gear, predicted gear]."""
    at = rows.where(rows.unseen_routes)
    table = np.zeros((MOST_GEARS, MOST_GEARS), dtype=int)
    np.add.at(table, (rows.gear[at] - 1, told[at] - 1), 1)
    return table.tolist()


def _speed(model: Classifier, x: np.ndarray) -> dict[str, float]:
    """Seconds for a million rows and for one, by the library and, for boosted trees, in the kernel's jit."""
    some = x[:10_000]
    out = {
        "library_s_per_million": 1e6 / len(some) * _median(lambda: model.probabilities(some), 3),
        "library_us_one_row": 1e6 * _median(lambda: model.probabilities(some[:1]), 15),
    }
    if model.kind in ("lightgbm", "catboost") and "previous_gear" not in model.features:
        trees = model.trees()
        call = jax.jit(lambda x: trees.probabilities(x))
        many = np.resize(x, (262_144, x.shape[1]))
        for z in (many, some[:1]):
            call(z).block_until_ready()
        out["kernel_s_per_million"] = 1e6 / len(many) * _median(lambda: call(many).block_until_ready(), 3)
        out["kernel_us_one_row"] = 1e6 * _median(lambda: call(some[:1]).block_until_ready(), 50)
        out["kernel_difference"] = float(np.max(np.abs(np.asarray(call(some)) - model.probabilities(some))))
    return out


def _median(call: Any, repeats: int) -> float:
    taken = []
    for _ in range(repeats):
        started = time.perf_counter()
        call()
        taken.append(time.perf_counter() - started)
    return float(np.median(taken))


def _sample(rows: Rows, told: np.ndarray) -> dict[str, Any]:
    """The longest unseen route of a box of most gears, for the figure."""
    most = rows.gears == rows.gears[~rows.train].max()
    routes, count = np.unique(rows.route[rows.where(~rows.train, most)], return_counts=True)
    at = np.flatnonzero(rows.route == routes[np.argmax(count)])
    return {
        "gear": rows.gear[at].tolist(), "told": told[at].tolist(),
        "speed_kmh": np.round(3.6 * rows.x[at, 0], 1).tolist(),
    }  # fmt: skip
