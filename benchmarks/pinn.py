"""Speed of the physics-informed network of paper 1: training and inference, against PyTorch and a plain JAX loop.

    python benchmarks/pinn.py [training] [inference] [members] [--rows 385000] [--epochs 5] [--routes 60]
                              [--members 1 4 16] [--compiled] [--json FILE] [--write]

*Training*: the paper's recipe (256-128, batch normalisation, batches of 1,024, Adam, float32), with dropout of 0.1 and
without; `whole` has the loss of equation 7 with the kernel in it, `network` is the energy head's squares alone. PyTorch
(the extra `benchmarks`) has the same network, batch and loss, its data in memory as tensors, with one thread and with
one for each core (two that wait for each other are slow where something else runs), with --compiled also compiled;
ratios are to the fastest of them. Before it is timed its loss is held against ours at the same weights. Its batch
normalisation is its own, by the batch; ours normalises by running means, for about the same work. The plain JAX loop is
a jitted step that Python calls for every batch. An epoch of each side by turns, so that what else the machine does
falls on all; printed are medians, best times and ratios of medians. `cpu` is by seconds of the processor, which other
work moves little: on one core (`taskset -c 0`) it is the fairest of them. Compiling is timed apart. Where JAX has an
accelerator, ours and the loop run on it, as every command does, and `over_cpu` is ours on the processor over that.
*Inference*: one row, called from Python, and 550,000. *Members*: seeds in one program on 20,000 rows, against one.

Rows are of the synthetic fleet, repeated up to the number wanted. With --write the tables are kept in
docs/pinn_speed.md.
"""

import argparse
import json
import os
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from pinn_page import page
from pinn_sides import BATCH, Learner, Torch, same_loss

from experiments.pinn.data import load
from experiments.pinn.known import known
from hdev_jax.learn.pinn.fit import Ensemble, Member
from hdev_jax.learn.pinn.model import Recipe, predict, ready
from hdev_jax.learn.pinn.rows import FEATURES, Rows
from hdev_jax.learn.sequences import Scale
from hdev_jax.learn.train import Trained

LIMITS = {
    "over_torch": 1.0, "over_loop": 3.0, "paper_minutes": 10.0, "ready_one_row_us": 100.0, "many_rows_s": 1.0,
    "grid_minutes": 30.0,
}  # fmt: skip
DOC = Path(__file__).parents[1] / "docs" / "pinn_speed.md"
PAPER_ROWS, GRID = 550_000, 75 * 3
CORES = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Times(NamedTuple):
    """Seconds of a call: median, least, the first's, in which it is compiled, and the median of the processor's."""

    middle: float
    least: float
    first: float
    cpu: float


def by_turns(sides: Mapping[str, Callable[[], Any]], turns: int) -> dict[str, Times]:
    """Seconds of each side, so many turns after the one that compiles."""
    taken: dict[str, list[tuple[float, float]]] = {name: [] for name in sides}
    for _ in range(turns + 1):
        for name, call in sides.items():
            wall, cpu = time.perf_counter(), time.process_time()
            jax.block_until_ready(call())
            taken[name].append((time.perf_counter() - wall, time.process_time() - cpu))
    out = {}
    for name, each in taken.items():
        wall, cpu = np.array(each[1:]).T
        out[name] = Times(float(np.median(wall)), float(wall.min()), each[0][0], float(np.median(cpu)))
    return out


def fleet_rows(count: int, routes: int) -> tuple[Rows, int]:
    """So many rows, features to scale, and the number of vehicles."""
    data = load("fleet", 0, routes, (), 1.0, None, 0, ("all",))
    rows, _ = data.rows(FEATURES["channels"], (), known(data, "{}"))
    scale = Scale.of(np.asarray(rows.features, float))
    rows = eqx.tree_at(lambda r: r.features, rows, np.asarray(scale.apply(rows.features), np.float32))
    return rows.take(np.random.default_rng(0).integers(0, len(rows), count)), data.trained


def training(rows: Rows, vehicles: int, turns: int, compiled: bool) -> dict[str, Any]:
    """Samples a second of each side, with dropout and without, the whole loss and the network alone."""
    out: dict[str, Any] = {}
    try:
        import torch
    except ImportError:
        torch = None
        print("PyTorch is not here (the extra `benchmarks`): its part is left out")
    count = len(rows) // BATCH * BATCH
    for dropout in (0.1, 0.0):
        learner = Learner(Recipe(features=FEATURES["channels"], dropout=dropout), rows, vehicles)
        for part in ("whole", "network"):
            whole, name = part == "whole", f"{part}_dropout_{dropout:g}"
            sides: dict[str, Callable[[], Any]] = {
                "ours": learner.epochs(turns + 2) if whole else learner.network_epochs(turns + 2)
            }
            if whole:
                sides["loop"] = learner.loop()
            if whole and jax.default_backend() != "cpu":
                sides["cpu"] = learner.epochs(turns + 2, jax.devices("cpu")[0])
            if torch is not None:
                if whole and not dropout:
                    out["same_loss"] = same_loss(torch, learner)
                for threads in sorted({1, CORES}):
                    sides[f"torch_{threads}"] = Torch(torch, learner, whole=whole).loop(threads)
                    if compiled:
                        sides[f"torch_{threads}_compiled"] = Torch(torch, learner, whole=whole).compile().loop(threads)
            times = by_turns(sides, turns)
            for side, t in times.items():
                out[f"{name}_{side}_per_s"] = count / t.middle
                out[f"{name}_{side}_best_per_s"] = count / t.least
                out[f"{name}_{side}_cpu_per_s"] = count / t.cpu
                out[f"{name}_{side}_compile_s"] = t.first - t.middle
            for what in ("loop", "torch", "cpu"):
                if theirs := [t for side, t in times.items() if side.startswith(what)]:
                    out[f"{name}_over_{what}"] = min(t.middle for t in theirs) / times["ours"].middle
                    out[f"{name}_best_over_{what}"] = min(t.least for t in theirs) / times["ours"].least
                    out[f"{name}_cpu_over_{what}"] = min(t.cpu for t in theirs) / times["ours"].cpu
            print(_shown({k: v for k, v in out.items() if k.startswith(name)}), flush=True)
    out["paper_minutes"] = 100 * 0.70 * PAPER_ROWS / out["whole_dropout_0.1_ours_per_s"] / 60
    return out


def inference(rows: Rows, vehicles: int) -> dict[str, float]:
    """Microseconds of one row, seconds of 550,000."""
    learner = Learner(Recipe(features=FEATURES["channels"]), rows, vehicles)
    one = jax.tree.map(lambda x: x[:1], rows)
    with_numbers = ready(learner.model, learner.memory, one)
    ways = {"ready": lambda: with_numbers(one), "predict": lambda: predict(learner.model, learner.memory, one)}
    taken: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(20):
        for name, call in ways.items():
            for _ in range(100):  # as the rows of a stream come
                started = time.perf_counter()
                jax.block_until_ready(call())
                taken[name].append(time.perf_counter() - started)
    lead: Callable[[Any], Any] = lambda tree: jax.tree.map(lambda x: x[None] if eqx.is_array(x) else x, tree)  # noqa: E731
    plain = Scale(np.zeros(len(learner.recipe.features)), np.ones(len(learner.recipe.features)))
    ensemble = Ensemble(
        lead(learner.model), lead(learner.memory), plain, (Member(0),), Trained(None, None, np.empty(0), np.empty(0), 0)
    )
    many = rows.take(np.resize(np.arange(len(rows)), PAPER_ROWS))
    times = by_turns({"many": lambda: ensemble.predict(many)}, 5)["many"]
    return {
        **{f"{k}_one_row_us": 1e6 * float(np.median(t)) for k, t in taken.items()},
        **{f"{k}_one_row_least_us": 1e6 * min(t) for k, t in taken.items()},
        "many_rows_s": times.middle, "many_rows_least_s": times.least, "many_rows_cpu_s": times.cpu,
        "many_rows_compile_s": times.first - times.middle,
    }  # fmt: skip


def members(rows: Rows, vehicles: int, counts: list[int], turns: int) -> dict[str, float]:
    """Microseconds of a member and row in training, together and alone; minutes of the grid, 100 epochs each."""
    learner = Learner(Recipe(features=FEATURES["channels"]), rows, vehicles)
    sides: dict[str, Callable[[], Any]] = {"alone": learner.epochs(turns + 2)}
    sides |= {f"{n}_together": learner.members(n, turns + 2) for n in counts}
    times = by_turns(sides, turns)
    number = {"alone": 1, **{f"{n}_together": n for n in counts}}
    samples = len(rows) // BATCH * BATCH
    out = {f"members_{k}_us": 1e6 * t.middle / samples / number[k] for k, t in times.items()}
    out |= {f"members_{k}_cpu_us": 1e6 * t.cpu / samples / number[k] for k, t in times.items()}
    largest = out[f"members_{max(counts)}_together_us"]
    return {**out, "members_over_alone": out["members_alone_us"] / largest,
            "grid_minutes": largest * 1e-6 * samples * 100 * GRID / 60}  # fmt: skip


def _shown(out: Mapping[str, Any]) -> str:
    def one(v: Any) -> str:
        return str(v) if isinstance(v, str) else f"{v:,.4g}" if isinstance(v, float) and v < 1e4 else f"{v:,.0f}"

    return "\n".join(f"{k}: {one(v)}" for k, v in out.items())


def main(argv: list[str] | None = None) -> int:
    """Print what was measured; 1 where a limit is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="*", default=["training", "inference", "members"])
    parser.add_argument("--rows", type=int, default=int(0.70 * PAPER_ROWS))
    parser.add_argument("--epochs", type=int, default=5, help="of each side that count")
    parser.add_argument("--routes", type=int, default=60, help="of the fleet, whose rows are repeated")
    parser.add_argument("--members", type=int, nargs="+", default=[1, 4, 16])
    parser.add_argument("--compiled", action="store_true", help="torch.compile too, which wants a compiler")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--write", action="store_true", help="keep the tables in docs/pinn_speed.md")
    given = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    rows, vehicles = fleet_rows(given.rows, given.routes)
    device = jax.devices()[0]
    out: dict[str, Any] = {"device": f"{device.platform}, {device.device_kind}", "rows": given.rows, "cores": CORES,
                           "load": os.getloadavg()[0]}  # fmt: skip
    if "training" in given.what:
        out |= training(rows, vehicles, given.epochs, given.compiled)
    if "inference" in given.what:
        out |= inference(rows, vehicles)
    if "members" in given.what:
        out |= members(rows.take(np.arange(20_000) % len(rows)), vehicles, given.members, given.epochs)
    print(_shown(out))
    if given.json:
        given.json.write_text(json.dumps(out, indent=1) + "\n")
    if given.write:
        command = " ".join(["python benchmarks/pinn.py", *(sys.argv[1:] if argv is None else argv)])
        DOC.write_text(page(out, LIMITS, command), encoding="utf-8")
    missed = []
    for key, value in out.items():
        limit = next((v for k, v in LIMITS.items() if key.endswith(k)), None)
        least = "_over_" in key
        if limit is not None and (value < limit if least else value > limit):
            missed.append(f"{key}: {value:.3g}, at {'least' if least else 'most'} {limit:g}")
    print("within the limits" if not missed else "MISSED\n  " + "\n  ".join(missed))
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
