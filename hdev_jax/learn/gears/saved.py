"""A gear model in a file: the library's own model file, or a JSON file that says what its classes and features are."""

import json
from pathlib import Path

from hdev_jax.errors import InputError
from hdev_jax.learn.gears.classifiers import Classifier
from hdev_jax.learn.gears.gears import PLACE
from hdev_jax.learn.trees.files import read_trees
from hdev_jax.learn.trees.trees import Trees

__all__ = ["SCHEMA", "read_gear_model", "save_gear_model"]

SCHEMA = "hdev-gears/1"


def save_gear_model(path: str | Path, classifier: Classifier) -> None:
    """Write a fitted classifier of boosted trees: a JSON file at `path`, and beside it the library's own model file.

    **Raises:** `InputError` for a kind that is not boosted trees.
    """
    path, ending = Path(path), {"lightgbm": ".txt", "catboost": ".model.json"}.get(classifier.kind)
    if ending is None:
        raise InputError(f"gear model {classifier.kind!r}: boosted trees (lightgbm or catboost) can be saved")
    model = path.with_name(path.stem + ending)
    if classifier.kind == "lightgbm":
        classifier.model.save_model(model)
    else:
        classifier.model.save_model(str(model), format="json")
    about = {"schema": SCHEMA, "model": model.name, "classes": classifier.gears, "features": classifier.features}
    path.write_text(json.dumps(about) + "\n", encoding="utf-8")


def read_gear_model(path: str | Path) -> Trees:
    """The trees in a file that `save_gear_model` wrote, or in a model file of LightGBM, XGBoost or CatBoost (JSON).

    The classes of such a model must be the gears from the first up, and its features must have the names of `FEATURES`
    (not `PLACE`, which makes distances of the classes).

    **Raises:** `InputError`, one line, for a file that cannot be read or is neither.
    """
    path = Path(path)
    try:
        about = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"gear model {path}: no such file") from None
    except (OSError, ValueError):  # the text of LightGBM is no JSON
        about = None
    if not isinstance(about, dict) or about.get("schema") != SCHEMA:
        found = read_trees(path)
        if found.link == "identity":
            raise InputError(f"gear model {path}: a regression; a classifier whose classes are gears is expected")
        if PLACE in found.features:
            raise InputError(
                f"gear model {path}: has the feature '{PLACE}', so its classes are distances from the reference gear, "
                "and which they are is not known from this file; it has to be written with save_gear_model"
            )
        gears = tuple(float(g + 1) for g in range(len(found.classes)))
        return _named(found, gears, found.features)
    try:
        model, classes, features = about["model"], about["classes"], tuple(map(str, about["features"]))
    except (KeyError, TypeError) as e:
        raise InputError(f"gear model {path}: lacks {e}; write it again with save_gear_model") from e
    found = read_trees(path.parent / model, classes)
    if len(features) != len(found.features):
        raise InputError(f"gear model {path}: names {len(features)} features, its trees have {len(found.features)}")
    return _named(found, found.classes, features)


def _named(found: Trees, classes: tuple[float, ...], features: tuple[str, ...]) -> Trees:
    return Trees(found.reading, found.forest, found.offset, found.scale, features, classes, found.link)
