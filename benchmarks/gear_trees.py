"""The gear's trees within jit beside the predictors that they are compared with: LightGBM, CatBoost, Treelite with
tl2cgen, lleaves; the same model in each, single rows and batches, in one run and on one thread.

    python benchmarks/gear_trees.py [--routes 60] [--rows 100000] [--repeats 5] [--write] [--json FILE]

The models are those of two rows of the accuracy table of `configs/paper1/fig5.toml`, catboost/relative with the
settings that its search found and lightgbm/sheet, trained on fewer routes (`benchmarks/trees.py`). Treelite and lleaves
read LightGBM's file, CatBoost's none of them. A predictor that is not installed is left out and named. lleaves 1.3
needs llvmlite below 0.44. One row: a call from Python with one row of features. Medians; on a shared machine the ratios
within a run are what to trust.
"""

import argparse
import importlib
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
from timing import median_seconds
from trees import HELD, accuracy, columns, models

from experiments.paper1.gears import fleet_rows
from experiments.runner.pages.site import wrapped
from hdev_jax.learn.gears.classifiers import Classifier

PAGE = Path(__file__).parents[1] / "docs" / "gear_speed.md"
BATCHES = (1, 100, 10_000)
Predictor = Callable[[np.ndarray], Any]
WITHIN = 3.0  # times the fastest, for one row


def ours(model: Classifier) -> Predictor:
    """The same trees within jit."""
    trees = model.trees()
    call = jax.jit(lambda z: trees.probabilities(z))
    return lambda x: np.asarray(call(x))


def own(model: Classifier) -> Predictor:
    """The library's own predictor, on one thread."""
    if model.kind == "lightgbm":
        return lambda x: model.model.predict(x, num_threads=1)
    return lambda x: model.model.predict_proba(x, thread_count=1)


def tl2cgen(model: Classifier, folder: Path) -> Predictor:
    """Treelite's model of the file, compiled from C by tl2cgen."""
    treelite, generator = importlib.import_module("treelite"), importlib.import_module("tl2cgen")
    model.model.save_model(folder / "model.txt")
    read = treelite.frontend.load_lightgbm_model(folder / "model.txt")
    library = folder / "model.so"
    generator.export_lib(read, toolchain="gcc", libpath=library, params={"parallel_comp": 8}, nthread=1)
    predictor = generator.Predictor(library, nthread=1)
    return lambda x: np.squeeze(predictor.predict(generator.DMatrix(x, dtype="float32")))


def lleaves(model: Classifier, folder: Path) -> Predictor:
    """The file compiled by LLVM."""
    model.model.save_model(folder / "model.txt")
    compiled = importlib.import_module("lleaves").Model(model_file=str(folder / "model.txt"))
    compiled.compile()
    return lambda x: compiled.predict(x, n_jobs=1)


def measured(model: Classifier, x: np.ndarray, repeats: int, folder: Path) -> dict[str, Any]:
    """Of each predictor the seconds to make it, and a call of each batch, in turn."""
    makers: dict[str, Callable[[], Predictor]] = {"hdev_jax": lambda: ours(model), model.kind: lambda: own(model)}
    if model.kind == "lightgbm":
        makers |= {"treelite + tl2cgen": lambda: tl2cgen(model, folder), "lleaves": lambda: lleaves(model, folder)}
    out: dict[str, Any] = {}
    truth = model.probabilities(x[:1000])
    for name, make in makers.items():
        started = time.perf_counter()
        try:
            call = make()
        except ImportError as e:
            out[name] = {"missing": f"not installed: {e}"}
            continue
        off = float(np.max(np.abs(np.reshape(call(x[:1000]), truth.shape) - truth)))
        out[name] = {"make_s": time.perf_counter() - started, "largest_difference": off}
        for n in (*BATCHES, len(x)):
            some = np.ascontiguousarray(x[:n], dtype=np.float32)
            seconds = median_seconds(lambda c=call, s=some: c(s), 200 if n == 1 else repeats)
            out[name][str(n)] = 1e6 * seconds
    return out


def page(m: dict[str, Any]) -> str:
    """The measurements as a page of the site."""
    command = f"python benchmarks/gear_trees.py --routes {m['routes']} --rows {m['rows']} --write"
    lines = [
        "# Gear classifiers: time of a prediction", "",
        f"Made by `{command}`: two models of the [gear table](fig5.md), trained again on {m['routes']} routes, timed "
        f"in several inference libraries, on one thread (load average before the run: {m['load']:.1f}). Accuracies "
        "are on routes not trained on.", "",
    ]  # fmt: skip
    for name, part in m["models"].items():
        sizes = [str(n) for n in (*BATCHES, m["rows"])]
        lines += [f"## {name}", "", f"{part['trees']} trees, accuracy {100 * part['accuracy']:.1f} %.", ""]
        lines += ["| | one row [µs] | " + " | ".join(f"{int(n):,} rows [µs per row]" for n in sizes[1:]) +
                  " | compiling [s] | largest difference in probability |",
                  "|---|" + "---:|" * (len(sizes) + 2)]  # fmt: skip
        for who, row in part["predictors"].items():
            if "missing" in row:
                lines.append(f"| {who} | {row['missing']} |" + " |" * (len(sizes) + 1))
                continue
            each = [f"{row[n] / int(n):.3g}" for n in sizes]
            lines.append(
                f"| {who} | " + " | ".join(each) + f" | {row['make_s']:.1f} | {row['largest_difference']:.1g} |"
            )
        lines += ["", verdict(part["predictors"], sizes), ""]
    lines += [
        f"A call from Python of a compiled JAX function that does nothing takes {m['empty_call_us']:.1f} µs here. "
        "lleaves is faster for two reasons: thresholds and leaves are constants in its machine code, and a row "
        "follows one path of a tree, while arrays within jit evaluate every node. In oblivious trees (CatBoost) a "
        "single path saves nothing: there ours is faster, and the model of [figure 5](fig5.md) is of this kind; "
        "none of the compilers compared reads CatBoost's file. On board the trees are part of the one program that "
        "updates the "
        "[estimates](online.md), so there is no second call, and the gear's probabilities stay in JAX.", "",
    ]  # fmt: skip
    return "\n".join(lines)


def verdict(predictors: dict[str, Any], sizes: list[str]) -> str:
    """How far ours is ahead for the largest batch, and behind for one row."""
    mine = predictors["hdev_jax"]
    others = {k: v for k, v in predictors.items() if k != "hdev_jax" and "missing" not in v}
    best = {n: min(others, key=lambda k, n=n: others[k][n]) for n in (sizes[0], sizes[-1])}
    one, many = (others[best[n]][n] / mine[n] for n in (sizes[0], sizes[-1]))
    return (
        f"For {int(sizes[-1]):,} rows ours takes {1 / many:.2f} times as long as the best other, {best[sizes[-1]]}; "
        f"for one row {1 / one:.2f} times as long as {best[sizes[0]]} (target: below 1, and at most {WITHIN:g})."
    )


def main(argv: list[str] | None = None) -> int:
    """Print what was measured, and write it where that is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--routes", type=int, default=60)
    parser.add_argument("--rows", type=int, default=100_000)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--trees", type=int, default=340)
    parser.add_argument("--depth", type=int, default=6)
    parser.add_argument("--rate", type=float, default=0.2129)
    parser.add_argument("--l2", type=float, default=4.844)
    parser.add_argument("--lightgbm-rounds", type=int, default=45)
    parser.add_argument("--write", action="store_true")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    out: dict[str, Any] = {"routes": given.routes, "rows": given.rows, "load": os.getloadavg()[0], "models": {}}
    nothing, row = jax.jit(lambda x: x), np.zeros((1, 10), np.float32)
    out["empty_call_us"] = 1e6 * median_seconds(lambda: np.asarray(nothing(row)), 500)
    rows = fleet_rows((1, given.routes, ("all",)), HELD, 4)
    fit, test = np.flatnonzero(rows.train), np.flatnonzero(rows.unseen_routes)
    for name, model in models(rows, fit, given).items():
        features = "relative" if name == "catboost" else "sheet"
        x = columns(rows, features)[test]
        x = np.resize(x, (given.rows, x.shape[1]))
        count = model.model.tree_count_ if name == "catboost" else model.model.num_trees()
        with tempfile.TemporaryDirectory() as folder:
            out["models"][f"{name}/{features}"] = {
                "trees": int(count), "accuracy": accuracy(rows, model, test),
                "predictors": measured(model, x, given.repeats, Path(folder)),
            }  # fmt: skip
        print(json.dumps(out["models"][f"{name}/{features}"], indent=1), flush=True)
    if given.json:
        given.json.write_text(json.dumps(out, indent=1) + "\n", encoding="utf-8")
    if given.write:
        PAGE.write_text(wrapped(page(out)), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
