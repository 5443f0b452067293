"""Speed of the gear's trees within jit, against LightGBM's and CatBoost's own predictors, in one run.

    python benchmarks/trees.py [--rows 1000000] [--routes 280] [--repeats 5] [--json FILE]

The model is a row of the accuracy table: CatBoost's with the sheet's features, made on the synthetic fleet by the settings
below (`--trees`, `--depth`, `--rate`), beside LightGBM's on the same rows. All three predict the same rows, with as many
threads as there are cores; what is printed is the median, and ratios within this run are what to trust. Compiling is
timed apart. One row: a call from Python with one row of features. Accuracies are of routes that were not trained on.
"""

import argparse
import json
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments.paper1_gears import fleet_rows
from hdev_jax.learn.classifiers import Classifier
from hdev_jax.learn.gears import FEATURES

LIMITS = {"kernel_mrows_s": 1.0, "over_lightgbm": 30.0, "one_row_us": 100.0, "accuracy_behind": 0.003}
HELD = ("truck_4x2_16t", "bus_12m_3speed", "truck_8x4_37t", "tractor_6x2_44t")


def median(call: Callable[[], Any], repeats: int) -> float:
    """Seconds of a call, the median, after one that does not count."""
    call()
    taken = []
    for _ in range(repeats):
        started = time.perf_counter()
        call()
        taken.append(time.perf_counter() - started)
    return float(np.median(taken))


def models(x: np.ndarray, gear: np.ndarray, given: argparse.Namespace) -> dict[str, Classifier]:
    """Both boosted classifiers, fitted on the rows."""
    import lightgbm as lgb
    from catboost import CatBoostClassifier

    names, gears = FEATURES["sheet"], tuple(range(1, int(gear.max()) + 1))
    cores = os.cpu_count() or 1
    cat = CatBoostClassifier(
        iterations=given.trees, depth=given.depth, learning_rate=given.rate, border_count=254, random_seed=0,
        thread_count=cores, verbose=0, allow_writing_files=False,
    ).fit(x, gear - 1)  # fmt: skip
    fixed = {
        "objective": "multiclass", "num_class": len(gears), "max_depth": 6, "num_leaves": 31, "learning_rate": 0.1,
        "min_sum_hessian_in_leaf": 1.0, "lambda_l2": 1.0, "verbosity": -1, "num_threads": cores, "seed": 0,
    }  # fmt: skip
    light = lgb.train(fixed, lgb.Dataset(x, gear - 1), given.lightgbm_rounds)
    return {
        "catboost": Classifier("catboost", cat, gears, names, {}, 0.0),
        "lightgbm": Classifier("lightgbm", light, gears, names, {}, 0.0),
    }


def main(argv: list[str] | None = None) -> int:
    """Print what was measured; 1 where a limit is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", type=int, default=1_000_000)
    parser.add_argument("--routes", type=int, default=280)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--trees", type=int, default=40)
    parser.add_argument("--depth", type=int, default=6)
    parser.add_argument("--rate", type=float, default=0.4)
    parser.add_argument("--lightgbm-rounds", type=int, default=60)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    rows = fleet_rows((1, given.routes, ("all",)), HELD, 4)
    x = rows.x[:, : len(FEATURES["sheet"])]
    fit, test = np.flatnonzero(rows.train), np.flatnonzero(rows.unseen_routes)
    own = models(x[fit], rows.gear[fit], given)
    many = np.ascontiguousarray(np.resize(x[test], (given.rows, x.shape[1])))
    few = many[: min(given.rows, 100_000)]  # LightGBM's predictor takes half a minute for a million
    out: dict[str, Any] = {"rows": given.rows, "cores": os.cpu_count()}
    accuracy = {}
    for name, model in own.items():
        trees = model.trees()
        call = jax.jit(lambda z, trees=trees: trees.probabilities(z))
        used = many if name == "catboost" else few
        started = time.perf_counter()
        ours = np.asarray(call(used))
        out[f"{name}_compile_s"] = time.perf_counter() - started
        theirs = model.probabilities(used)
        out[f"{name}_largest_difference"] = float(np.max(np.abs(ours - theirs)))
        # in turn, so that what else the machine does falls on both
        out[f"{name}_own_mrows_s"] = len(used) / median(lambda m=model, u=used: m.probabilities(u), 3) / 1e6
        out[f"{name}_kernel_mrows_s"] = len(used) / 1e6 / median(
            lambda c=call, u=used: c(u).block_until_ready(), given.repeats
        )  # fmt: skip
        out[f"{name}_one_row_us"] = 1e6 * median(lambda c=call: c(few[:1]).block_until_ready(), 200)
        out[f"{name}_own_one_row_us"] = 1e6 * median(lambda m=model: m.probabilities(few[:1]), 50)
        accuracy[name] = float(np.mean(1 + np.argmax(model.probabilities(x[test]), axis=1) == rows.gear[test]))
        out[f"{name}_accuracy"] = accuracy[name]
    out["over_lightgbm"] = out["catboost_kernel_mrows_s"] / out["lightgbm_own_mrows_s"]
    out["over_catboost"] = out["catboost_kernel_mrows_s"] / out["catboost_own_mrows_s"]
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
    if accuracy["catboost"] < accuracy["lightgbm"] - LIMITS["accuracy_behind"]:
        missed.append(f"accuracy {accuracy['catboost']:.4f}, LightGBM's {accuracy['lightgbm']:.4f}")
    print("within the limits" if not missed else "MISSED\n  " + "\n  ".join(missed))
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
