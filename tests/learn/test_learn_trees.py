"""Boosted trees in jit against the libraries that made them, at their thresholds too; files that are refused."""

import json
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hdev_jax.errors import InputError
from hdev_jax.learn.trees.files import above, below, read_trees
from hdev_jax.learn.trees.trees import ordered

FEATURES, CLASSES = 5, 4


def rows(count: int, seed: int) -> np.ndarray:
    """Features with ties, zeros, missing values, subnormal and huge numbers."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(count, FEATURES)).astype(np.float32)
    x[:, 1] = np.round(4 * x[:, 1]) / 4
    x[rng.random(x.shape) < 0.05] = 0.0
    x[rng.random(x.shape) < 0.03] = np.nan
    odd = np.array([1e-45, -1e-45, -0.0, 1e-35, -1e-35, 3e38, -np.inf, np.inf], dtype=np.float32)
    hit = rng.random(x.shape) < 0.02
    x[hit] = rng.choice(odd, hit.sum())
    return x


def at_thresholds(x: np.ndarray, thresholds: np.ndarray) -> np.ndarray:
    """The rows with float32 next to a threshold, or on it, in one of their features."""
    rng, out = np.random.default_rng(5), x.copy()
    with np.errstate(over="ignore"):
        near = np.float32(rng.choice(thresholds, len(x)))
    near = np.stack([near, np.nextafter(near, np.float32(9e9)), np.nextafter(near, np.float32(-9e9))])
    out[np.arange(len(x)), rng.integers(0, FEATURES, len(x))] = near[rng.integers(0, 3, len(x)), np.arange(len(x))]
    return out


@pytest.fixture(scope="module")
def known() -> tuple[np.ndarray, np.ndarray]:
    x = rows(3000, 0)
    x[~np.isfinite(x)] = np.nan
    x[np.abs(x) > 9] = 1.0
    z = np.nan_to_num(x)
    label = np.clip(np.floor(z[:, 0] + 0.5 * z[:, 1] * z[:, 2] + 2), 0, CLASSES - 1).astype(int)
    label[:CLASSES] = range(CLASSES)
    return x, label


def same(path, predict, thresholds, classes=None, *, count=20_000, few=True) -> None:
    """The library's probabilities and ours, on rows of several blocks, most of them at thresholds, and on few."""
    trees = read_trees(path, classes)
    x = np.concatenate([rows(5_000, 1), at_thresholds(rows(count, 2), thresholds)])
    expected, f = predict(x), jax.jit(lambda x: trees.probabilities(x))
    np.testing.assert_allclose(f(x), expected, rtol=0, atol=1e-5)
    if few:
        np.testing.assert_allclose(f(x[:9]), expected[:9], rtol=0, atol=1e-5)
    if classes:
        assert trees.classes == classes


@pytest.mark.parametrize(
    "settings", [{}, {"zero_as_missing": True, "num_leaves": 45}, {"use_missing": False}], ids=["nan", "zero", "none"]
)
def test_lightgbm(known, tmp_path, settings):
    import lightgbm as lgb

    fixed = {"objective": "multiclass", "num_class": CLASSES, "verbosity": -1, "num_threads": 1}
    booster = lgb.train({**fixed, **settings}, lgb.Dataset(*known), 2)
    booster.save_model(tmp_path / "m.txt")
    text = re.findall(r"^threshold=(.*)$", (tmp_path / "m.txt").read_text(), flags=re.M)
    thresholds = np.array([float(v) for line in text for v in line.split()])
    assert np.any(np.float64(np.float32(thresholds)) > thresholds), "some are rounded up by the nearest float32"
    same(tmp_path / "m.txt", booster.predict, thresholds, (1.0, 2.0, 3.0, 5.0), few=not settings)


def test_lightgbm_of_two_classes_and_random_forest(known, tmp_path):
    import lightgbm as lgb

    x, label = known
    for extra in ({}, {"boosting": "rf", "bagging_fraction": 0.5, "bagging_freq": 1}):
        fixed = {"objective": "binary", "verbosity": -1, "num_threads": 1, **extra}
        booster = lgb.train(fixed, lgb.Dataset(x, label > 1), 3)
        booster.save_model(tmp_path / "m.txt")
        two = lambda x, b=booster: np.stack([1 - b.predict(x), b.predict(x)], axis=1)  # noqa: E731
        same(tmp_path / "m.txt", two, np.array([0.0, 1.0]), few=not extra)


@pytest.mark.parametrize("classes", [2, CLASSES])
def test_xgboost(known, tmp_path, classes):
    xgb = pytest.importorskip("xgboost")
    x, label = known
    model = xgb.XGBClassifier(n_estimators=2, max_depth=5, n_jobs=1).fit(x, np.minimum(label, classes - 1))
    model.save_model(tmp_path / "m.json")
    stored = json.loads((tmp_path / "m.json").read_text())["learner"]["gradient_booster"]["model"]["trees"]
    thresholds = np.array(
        [v for t in stored for v, k in zip(t["split_conditions"], t["left_children"], strict=True) if k >= 0]
    )
    same(tmp_path / "m.json", model.predict_proba, thresholds)


@pytest.mark.parametrize("classes", [2, CLASSES])
def test_catboost(known, tmp_path, classes):
    cat = pytest.importorskip("catboost")
    x, label = known
    model = cat.CatBoostClassifier(iterations=6, depth=5, verbose=0, allow_writing_files=False, thread_count=1)
    model.fit(x, np.minimum(label, classes - 1))
    model.save_model(str(tmp_path / "m.json"), format="json")
    about = json.loads((tmp_path / "m.json").read_text())["features_info"]["float_features"]
    borders = np.concatenate([f["borders"] or [0.0] for f in about])
    same(tmp_path / "m.json", model.predict_proba, borders, count=70_000)


def test_rounding_down_agrees_with_float64_for_every_neighbour():
    rng = np.random.default_rng(0)
    edges = [0.0, -0.0, 1e-45, -1e-45, 1e-46, -1e-46, 1e-40, 1.0, 0.1, -0.1, 1e-35, 3.5e38, -3.5e38]
    every = np.array([*edges, *rng.normal(size=300), *np.float64(rng.normal(size=300).astype(np.float32))])
    with np.errstate(over="ignore"):
        x = every.astype(np.float32)
    near = np.stack([x, np.nextafter(x, np.float32(np.inf)), np.nextafter(x, np.float32(-np.inf)), -x], axis=1)
    for t, places, values in zip(every, np.asarray(ordered(jnp.asarray(near))), near.astype(float), strict=True):
        np.testing.assert_array_equal(places > below(float(t)), values > t)
        np.testing.assert_array_equal(places > above(float(t)), values >= t)


def test_files_that_are_not_what_they_say(known, tmp_path):
    import lightgbm as lgb

    fixed = {"objective": "multiclass", "num_class": CLASSES, "verbosity": -1, "num_threads": 1}
    lgb.train(fixed, lgb.Dataset(*known), 2).save_model(tmp_path / "m.txt")
    text = (tmp_path / "m.txt").read_text()
    broken = {
        "v9": text.replace("version=v4", "version=v9"),
        "cut off": text[: len(text) // 3],
        "objective": text.replace("objective=multiclass", "objective=lambdarank"),
        "categories": re.sub(r"decision_type=\d+", "decision_type=1", text),
        "neither": "hello",
        "neither of": "{}",
        "another version": '{"oblivious_trees": [], "features_info": {}}',
        "of XGBoost 9": '{"learner": {}, "version": [9, 0, 0]}',
    }
    for said, content in broken.items():
        (tmp_path / "broken").write_text(content)
        with pytest.raises(InputError, match=f"model file .*{said}") as e:
            read_trees(tmp_path / "broken")
        assert "\n" not in str(e.value)
    with pytest.raises(InputError, match="no such file"):
        read_trees(tmp_path / "nothing")
    with pytest.raises(InputError, match="has 4 classes, expected 3"):
        read_trees(tmp_path / "m.txt", (1.0, 2.0, 3.0))
    trees = read_trees(tmp_path / "m.txt")
    with pytest.raises(InputError, match="trained on the features Column_0"):
        trees.expect(("speed_mps",))
    with pytest.raises(ValueError, match="5 features, found 2"):
        trees.scores(jnp.zeros((3, 2)))
