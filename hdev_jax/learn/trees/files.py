"""Models of LightGBM, XGBoost and CatBoost, read from the files that these libraries write, as `Trees`.

LightGBM: the text of `save_model`. XGBoost: the JSON of `save_model`. CatBoost: the JSON export of oblivious trees
(`save_model(format="json")`). None of the three libraries is needed to read them.
"""

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hdev_jax.errors import InputError
from hdev_jax.learn.trees.arrays import Leaf, Node, branching, oblivious
from hdev_jax.learn.trees.trees import Reading, Trees

__all__ = ["above", "below", "read_trees"]

LIGHTGBM_VERSIONS = ("v3", "v4")  # v4: LightGBM 4; v3 differs in nothing that is read here
XGBOOST_VERSIONS = (1, 2, 3)  # major numbers whose JSON has the fields that are read here


def below(x: float) -> int:
    """The `ordered` number of the largest float32 that is not above `x`: beyond it is v > x, for every float32 v."""
    with np.errstate(over="ignore"):
        y = np.float32(x)
    # in float64: in float32 a threshold that was rounded up compares equal to itself
    return _ordered(y) - (float(y) > x)


def above(x: float) -> int:
    """The `ordered` number of the largest float32 below `x`: beyond it is v >= x, for every float32 v."""
    with np.errstate(over="ignore"):
        y = np.float32(x)
    return _ordered(y) - (float(y) >= x)


def _ordered(y: np.float32) -> int:
    bits = int(y.view(np.int32))
    return -(bits & 0x7FFFFFFF) if bits < 0 else bits


def read_trees(path: str | Path, classes: Sequence[float | int] | None = None) -> Trees:
    """The model in a file of LightGBM (text), XGBoost or CatBoost (JSON); which one is seen by its content.

    **Arguments:** `classes`: what the model's classes stand for, in their order (default: what the file says, else
    their numbers from 0).

    **Raises:** `InputError`, one line, for a file that cannot be read, that is of another kind or version, or that
    holds what is not evaluated here (categories, linear leaves, …), and for another number of classes.
    """
    where = f"model file {path}"
    try:
        text = Path(path).read_text(encoding="utf-8")
    except FileNotFoundError:
        raise InputError(f"{where}: no such file") from None
    except (OSError, UnicodeDecodeError) as e:
        raise InputError(f"{where}: cannot be read as text ({e}); save CatBoost and XGBoost models as JSON") from None
    try:
        if text.startswith("tree\n"):
            trees = _lightgbm(text, where)
        else:
            table = json.loads(text)
            if "oblivious_trees" in table:
                trees = _catboost(table, where)
            elif "learner" in table:
                trees = _xgboost(table, where)
            else:
                raise InputError(f"{where}: JSON, but neither of XGBoost (learner) nor of CatBoost (oblivious_trees)")
    except json.JSONDecodeError:
        raise InputError(
            f"{where}: neither a text model of LightGBM (its first line is 'tree') nor the JSON of XGBoost or CatBoost"
        ) from None
    except (KeyError, IndexError, ValueError, TypeError) as e:
        raise InputError(f"{where}: cut off, or of another version ({type(e).__name__}: {e}); save it again") from None
    return _named(trees, classes, where)


def _named(trees: Trees, classes: Sequence[float | int] | None, where: str) -> Trees:
    if classes is None or trees.link == "identity":
        return trees
    if len(classes) != len(trees.classes):
        raise InputError(f"{where}: has {len(trees.classes)} classes, expected {len(classes)}: {[*classes]}")
    named = tuple(float(c) for c in classes)
    return Trees(trees.reading, trees.forest, trees.offset, trees.scale, trees.features, named, trees.link)


# --- LightGBM ----------------------------------------------------------------------------------------------------


def _fields(block: str) -> dict[str, str]:
    return {k: v for k, found, v in (line.partition("=") for line in block.splitlines()) if found}


def _lightgbm(text: str, where: str) -> Trees:
    head, *blocks = text.partition("\nend of trees")[0].split("\nTree=")
    about = _fields(head)
    if about["version"] not in LIGHTGBM_VERSIONS:
        raise InputError(
            f"{where}: of LightGBM's format {about['version']}; {' or '.join(LIGHTGBM_VERSIONS)} is expected: save it "
            "with LightGBM 3 or 4"
        )
    if "\nend of trees" not in text:
        raise InputError(f"{where}: cut off before 'end of trees'; save it again")
    objective, *options = about.get("objective", "custom").split()
    links = {"multiclass": "softmax", "softmax": "softmax", "binary": "logistic", "regression": "identity"}
    if objective not in links or (objective == "binary" and "sigmoid:1" not in options):
        raise InputError(f"{where}: objective {about.get('objective')!r}; one of {', '.join(links)} is expected")
    scores = int(about["num_tree_per_iteration"])
    trees = [_lightgbm_tree(_fields(b), where) for b in blocks]
    averaged = "\naverage_output" in head
    forest, reading = branching(trees, [k % scores for k in range(len(trees))], scores)
    classes = max(scores, 2 if links[objective] == "logistic" else 1)
    return _trees(
        Reading(reading.feature, reading.missing, rounds_to_zero=True), forest, np.zeros(scores),
        scores / len(trees) if averaged else 1.0, about["feature_names"].split(), range(classes), links[objective],
    )  # fmt: skip


def _lightgbm_tree(t: Mapping[str, str], where: str) -> Node | Leaf:
    if t.get("is_linear", "0") != "0":
        raise InputError(f"{where}: has linear leaves, which are not evaluated here; train with linear_tree=False")
    value = [float(v) for v in t["leaf_value"].split()]
    if len(value) != int(t["num_leaves"]):
        raise ValueError(f"{len(value)} leaves of {t['num_leaves']}")
    if len(value) == 1:
        return Leaf(value[0])
    feature, kind, left, right = (
        [int(v) for v in t[k].split()] for k in ("split_feature", "decision_type", "left_child", "right_child")
    )
    threshold = [float(v) for v in t["threshold"].split()]

    def part(k: int) -> Node | Leaf:
        if k < 0:
            return Leaf(value[~k])
        if kind[k] & 1:
            raise InputError(f"{where}: splits feature {feature[k]} by categories; numbers are expected")
        is_left, treated = bool(kind[k] & 2), kind[k] >> 2 & 3  # none, zero, NaN: what counts as missing
        missing = {
            0: Reading.ZERO,
            1: Reading.ZERO_LOW if is_left else Reading.ZERO_HIGH,
            2: Reading.LOW if is_left else Reading.HIGH,
        }[treated]
        return Node(feature[k], missing, below(threshold[k]), part(left[k]), part(right[k]))

    return part(0)


# --- XGBoost -----------------------------------------------------------------------------------------------------


def _xgboost(table: Mapping[str, Any], where: str) -> Trees:
    version = table["version"]
    if version[0] not in XGBOOST_VERSIONS:
        raise InputError(
            f"{where}: of XGBoost {'.'.join(map(str, version))}; version {XGBOOST_VERSIONS[0]} to "
            f"{XGBOOST_VERSIONS[-1]} is expected"
        )
    learner = table["learner"]
    booster = learner["gradient_booster"]
    if booster["name"] != "gbtree":
        raise InputError(f"{where}: booster {booster['name']!r}; gbtree is expected")
    objective = learner["objective"]["name"]
    links = {
        "multi:softprob": "softmax", "multi:softmax": "softmax", "binary:logistic": "logistic",
        "reg:squarederror": "identity",
    }  # fmt: skip
    if objective not in links:
        raise InputError(f"{where}: objective {objective!r}; one of {', '.join(links)} is expected")
    about, model = learner["learner_model_param"], booster["model"]
    scores = max(int(about["num_class"]), 1)
    base = np.atleast_1d(np.asarray(json.loads(about["base_score"]), dtype=float))
    if links[objective] == "logistic":
        base = np.log(base / (1 - base))  # stored as a probability
    trees = [_xgboost_tree(t, where) for t in model["trees"]]
    forest, reading = branching(trees, [int(k) for k in model["tree_info"]], scores)
    count = int(about["num_feature"])
    return _trees(
        reading, forest, np.broadcast_to(base, (scores,)), 1.0,
        learner.get("feature_names") or [f"f{k}" for k in range(count)],
        range(max(scores, 2 if links[objective] == "logistic" else 1)), links[objective],
    )  # fmt: skip


def _xgboost_tree(t: Mapping[str, Any], where: str) -> Node | Leaf:
    if any(t.get("split_type", ())):
        raise InputError(f"{where}: splits by categories; numbers are expected")
    if int(t["tree_param"].get("size_leaf_vector", "1")) > 1:
        raise InputError(f"{where}: has vectors in its leaves; one tree for each class is expected")
    left, right, feature = t["left_children"], t["right_children"], t["split_indices"]
    value, is_left = t["split_conditions"], t["default_left"]

    def part(k: int) -> Node | Leaf:
        if left[k] < 0:
            return Leaf(float(value[k]))
        missing = Reading.LOW if is_left[k] else Reading.HIGH
        # stored as float32, written in decimals; x < t goes left
        return Node(feature[k], missing, above(float(np.float32(value[k]))), part(left[k]), part(right[k]))

    return part(0)


# --- CatBoost ----------------------------------------------------------------------------------------------------


def _catboost(table: Mapping[str, Any], where: str) -> Trees:
    about, info = table["features_info"], table["model_info"]
    if about.get("categorical_features") or about.get("text_features") or about.get("embedding_features"):
        raise InputError(f"{where}: has features that are no numbers; numbers are expected")
    loss = json.loads(info["params"])["loss_function"]["type"] if isinstance(info["params"], str) else (
        info["params"]["loss_function"]["type"]
    )  # fmt: skip
    links = {"MultiClass": "softmax", "Logloss": "logistic", "RMSE": "identity"}
    if loss not in links:
        raise InputError(f"{where}: loss {loss!r}; one of {', '.join(links)} is expected")
    scale, offset = table["scale_and_bias"]
    offset = np.atleast_1d(np.asarray(offset, dtype=float))
    floats = sorted(about["float_features"], key=lambda f: f["feature_index"])
    missing = [Reading.HIGH if f.get("nan_value_treatment") == "AsTrue" else Reading.LOW for f in floats]
    trees = []
    for t in table["oblivious_trees"]:
        splits = t.get("splits") or []
        if any(s["split_type"] != "FloatFeature" for s in splits):
            raise InputError(f"{where}: splits by categories; numbers are expected")
        asked = [
            (s["float_feature_index"], missing[s["float_feature_index"]], below(float(np.float32(s["border"]))))
            for s in splits
        ]
        trees.append((asked, np.reshape(np.asarray(t["leaf_values"], dtype=float), (1 << len(splits), len(offset)))))
    names = [f.get("feature_id") or f"f{f['flat_feature_index']}" for f in floats]
    forest, reading = oblivious(trees)
    known = [*_class_names(info)]
    classes = known or range(max(len(offset), 2 if links[loss] == "logistic" else 1))
    return _trees(reading, forest, offset, float(scale), names, classes, links[loss])


def _class_names(info: Mapping[str, Any]) -> Iterator[float]:
    """The classes that the file names, where they are numbers."""
    given = info.get("class_params", {})
    given = json.loads(given) if isinstance(given, str) else given
    for name in given.get("class_names") or ():
        number = float(name)
        if not math.isfinite(number):
            raise ValueError(f"class {name!r}")
        yield number


def _trees(
    reading: Reading, forest: Any, offset: Any, scale: float, features: Sequence[str], classes: Any, link: Any
) -> Trees:
    import jax.numpy as jnp

    named = tuple(float(c) for c in classes) if link != "identity" else ()
    f32 = np.float32
    return Trees(reading, forest, jnp.asarray(offset, f32), jnp.asarray(scale, f32), tuple(features), named, link)
