"""Speed of the gear's trees within jit, against LightGBM's and CatBoost's own predictors, in one run.

    python benchmarks/trees.py [--rows 1000000] [--routes 280] [--repeats 5] [--json FILE]

The model is that of a row of the accuracy table of `configs/paper1/fig5.toml`, catboost/relative, with the settings
that its search found (`--trees`, `--depth`, `--rate`, `--l2`), on fewer routes; LightGBM's on the same rows tells all
twelve gears, as in peers.md. `over_lightgbm` is the one's speed in the kernel over the other's own predictor, both
about as accurate; `kernel_over_own` is of one and the same model. Each predicts with as many threads as there are
cores; what is printed is the median, and ratios within this run are what to trust. Compiling is timed apart. One row:
a call from Python with one row of features. Accuracies are of routes that were not trained on.
"""

import argparse
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
from timing import median_seconds

from experiments.paper1.gears import fleet_rows
from hdev_jax.learn.gears.classifiers import Classifier
from hdev_jax.learn.gears.gears import EVERY, FEATURES, PLACE

LIMITS = {"kernel_mrows_s": 1.0, "over_lightgbm": 30.0, "one_row_us": 100.0, "accuracy_behind": 0.003}
HELD = ("truck_4x2_16t", "bus_12m_3speed", "truck_8x4_37t", "tractor_6x2_44t")


def models(rows: Any, fit: np.ndarray, given: argparse.Namespace) -> dict[str, Classifier]:
    """Both boosted classifiers, fitted on the rows: the distance from the reference gear, and the gear."""
    import lightgbm as lgb
    from catboost import CatBoostClassifier

    cores = os.cpu_count() or 1
    gear, gears = rows.gear[fit], tuple(range(1, int(rows.gear[fit].max()) + 1))
    away = gear - rows.x[fit, EVERY.index("reference_gear")].astype(int)
    cat = CatBoostClassifier(
        iterations=given.trees, depth=given.depth, learning_rate=given.rate, l2_leaf_reg=given.l2, border_count=254,
        random_seed=0, thread_count=cores, verbose=0, allow_writing_files=False,
    ).fit(columns(rows, "relative")[fit], away - away.min())  # fmt: skip
    fixed = {
        "objective": "multiclass", "num_class": len(gears), "max_depth": 6, "num_leaves": 31, "learning_rate": 0.1,
        "min_sum_hessian_in_leaf": 1.0, "lambda_l2": 1.0, "verbosity": -1, "num_threads": cores, "seed": 0,
    }  # fmt: skip
    light = lgb.train(fixed, lgb.Dataset(columns(rows, "sheet")[fit], gear - 1), given.lightgbm_rounds)
    told = tuple(range(int(away.min()), int(away.max()) + 1))
    return {
        "catboost": Classifier("catboost", cat, told, FEATURES["relative"], {}, 0.0, 0.0),
        "lightgbm": Classifier("lightgbm", light, gears, FEATURES["sheet"], {}, 0.0, 0.0),
    }


def columns(rows: Any, name: str) -> np.ndarray:
    """The features of a set [row, feature]."""
    return np.ascontiguousarray(rows.x[:, [EVERY.index(n) for n in FEATURES[name]]])


def accuracy(rows: Any, model: Classifier, at: np.ndarray) -> float:
    """Share of the rows whose gear is told."""
    x = columns(rows, "relative" if PLACE in model.features else "sheet")[at]
    told = np.array(model.gears)[np.argmax(model.probabilities(x), axis=1)]
    if PLACE in model.features:
        told = np.clip(told + rows.x[at, EVERY.index("reference_gear")].astype(int), 1, rows.gears[at])
    return float(np.mean(told == rows.gear[at]))


def main(argv: list[str] | None = None) -> int:
    """Print what was measured; 1 where a limit is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", type=int, default=1_000_000)
    parser.add_argument("--routes", type=int, default=280)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--trees", type=int, default=340)
    parser.add_argument("--depth", type=int, default=6)
    parser.add_argument("--rate", type=float, default=0.2129)
    parser.add_argument("--l2", type=float, default=4.844)
    parser.add_argument("--lightgbm-rounds", type=int, default=100)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    rows = fleet_rows((1, given.routes, ("all",)), HELD, 4)
    fit, test = np.flatnonzero(rows.train), np.flatnonzero(rows.unseen_routes)
    own = models(rows, fit, given)
    out: dict[str, Any] = {"rows": given.rows, "cores": os.cpu_count()}
    for name, model in own.items():
        trees = model.trees()
        call = jax.jit(lambda z, trees=trees: trees.probabilities(z))
        x = columns(rows, "relative" if name == "catboost" else "sheet")[test]
        # LightGBM's predictor takes half a minute for a million
        count = given.rows if name == "catboost" else min(given.rows, 100_000)
        used = np.resize(x, (count, x.shape[1]))
        started = time.perf_counter()
        ours = np.asarray(call(used))
        out[f"{name}_compile_s"] = time.perf_counter() - started
        theirs = model.probabilities(used)
        out[f"{name}_largest_difference"] = float(np.max(np.abs(ours - theirs)))
        # in turn, so that what else the machine does falls on both
        out[f"{name}_own_mrows_s"] = len(used) / median_seconds(lambda m=model, u=used: m.probabilities(u), 3) / 1e6
        out[f"{name}_kernel_mrows_s"] = len(used) / 1e6 / median_seconds(
            lambda c=call, u=used: c(u).block_until_ready(), given.repeats
        )  # fmt: skip
        out[f"{name}_one_row_us"] = 1e6 * median_seconds(lambda c=call, u=used: c(u[:1]).block_until_ready(), 200)
        out[f"{name}_own_one_row_us"] = 1e6 * median_seconds(lambda m=model, u=used: m.probabilities(u[:1]), 50)
        out[f"{name}_accuracy"] = accuracy(rows, model, test)
    out["over_lightgbm"] = out["catboost_kernel_mrows_s"] / out["lightgbm_own_mrows_s"]
    for name in own:
        out[f"{name}_kernel_over_own"] = out[f"{name}_kernel_mrows_s"] / out[f"{name}_own_mrows_s"]
    for key, value in out.items():
        print(f"{key}: {value:.4g}" if isinstance(value, float) else f"{key}: {value}")
    if given.json:
        given.json.write_text(json.dumps(out, indent=1) + "\n")
    missed = []
    if out["catboost_kernel_mrows_s"] < LIMITS["kernel_mrows_s"]:
        missed.append(f"{out['catboost_kernel_mrows_s']:.2f} million rows a second, at least 1")
    if out["over_lightgbm"] < LIMITS["over_lightgbm"]:
        missed.append(f"{out['over_lightgbm']:.0f} times LightGBM, at least 30")
    if out["catboost_one_row_us"] > LIMITS["one_row_us"]:
        missed.append(f"{out['catboost_one_row_us']:.0f} µs for one row, at most 100")
    if out["catboost_accuracy"] < out["lightgbm_accuracy"] - LIMITS["accuracy_behind"]:
        missed.append(f"accuracy {out['catboost_accuracy']:.4f}, LightGBM's {out['lightgbm_accuracy']:.4f}")
    print("within the limits" if not missed else "MISSED\n  " + "\n  ".join(missed))
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
