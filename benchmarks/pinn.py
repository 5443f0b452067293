"""Speed of the physics-informed network of paper 1: training and inference, against PyTorch and a plain JAX loop.

    python benchmarks/pinn.py [training] [inference] [members] [--rows 385000] [--epochs 5] [--routes 60]
                              [--members 1 4 16] [--compiled] [--json FILE]

*Training*: the paper's recipe (256-128, batch normalisation, batches of 1,024, Adam, float32), with dropout of 0.1 and
without; `whole` has the loss of equation 7 with the kernel in it, `network` is the energy head's squares alone. PyTorch
(the extra `benchmarks`) has the same network, batch and loss, its data in memory as tensors, with one thread and with
one for each core (two that wait for each other are slow where something else runs), with --compiled also compiled;
ratios are to the fastest of them. Before it is timed its loss is held against ours at the same weights. Its batch
normalisation is its own, by the batch; ours normalises by running means, for about the same work. The plain JAX loop is
a jitted step that Python calls for every batch. An epoch of each side by turns, so that what else the machine does
falls on all; printed are medians, best times and ratios of medians. `cpu` is by seconds of the processor, which other
work moves little: on one core (`taskset -c 0`) it is the fairest of them. Compiling is timed apart.
*Inference*: one row, called from Python, and 550,000. *Members*: seeds in one program on 20,000 rows, against one.

Rows are of the synthetic fleet, repeated up to the number wanted.
"""

import argparse
import json
import os
import sys
import threading
import time
from collections.abc import Callable, Mapping
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax

from experiments.pinn_closed import known
from experiments.pinn_data import load
from hdev_jax.learn.heads import Network
from hdev_jax.learn.pinn import C_RR_LIMIT, Objective, Pinn, Recipe, predict, ready
from hdev_jax.learn.pinn_fit import PAPER_WEIGHTS, Ensemble, Member, stretches
from hdev_jax.learn.pinn_rows import FEATURES, Rows
from hdev_jax.learn.sequences import Scale
from hdev_jax.learn.train import Plan, Trained, train
from hdev_jax.units import AIR_DENSITY_KGPM3, GRAVITY_MPS2

LIMITS = {
    "over_torch": 1.0, "over_loop": 3.0, "paper_minutes": 10.0, "ready_one_row_us": 100.0, "many_rows_s": 1.0,
    "grid_minutes": 30.0,
}  # fmt: skip
BATCH, RATE, PAPER_ROWS, GRID = 1024, 0.005, 550_000, 75 * 3
CORES = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
# What the physics reads, in the order of the columns that PyTorch has.
COLUMNS = ("start", "end", "duration", "distance", "mass", "grade", "inertia", "efficiency", "auxiliary", "c_rr", "cda")


class Epochs:
    """`train` in a thread of its own; each call lets it run one epoch more."""

    def __init__(self, run: Callable[[Callable[..., None]], Any]):
        self._go, self._done, self._failed = threading.Semaphore(0), threading.Semaphore(0), None
        threading.Thread(target=self._run, args=(run,), daemon=True).start()

    def _run(self, run: Callable[[Callable[..., None]], Any]) -> None:
        self._go.acquire()
        try:
            run(self._tell)
        except BaseException as e:
            self._failed = e
        self._done.release()

    def _tell(self, *_: Any) -> None:
        self._done.release()
        self._go.acquire()

    def __call__(self) -> None:
        self._go.release()
        self._done.acquire()
        if self._failed is not None:
            raise self._failed


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


class Learner:
    """A recipe and rows, as `fit` gives them to `train`."""

    def __init__(self, recipe: Recipe, rows: Rows, vehicles: int):
        self.rows, self.recipe = rows, recipe
        self.unit = float(np.std(rows.energy_wh))
        self.make = partial(eqx.nn.make_with_state(Pinn), recipe, vehicles, scale_wh=self.unit)
        self.model, self.memory = self.make(key=jax.random.key(0))
        self.weights, static = eqx.partition(self.model, eqx.is_inexact_array)
        self.objective = Objective(static, len(rows))
        self.settings = jnp.asarray(PAPER_WEIGHTS, jnp.float32)

    def epochs(self, most: int) -> Epochs:
        """The whole loss, by `train`."""
        data = jax.tree.map(jnp.asarray, stretches(self.rows, 1))
        return Epochs(
            lambda tell: train(
                self.objective, self.weights, self.memory, data, optax.adam(RATE), Plan(most, BATCH),
                key=jax.random.key(1), settings=self.settings, tell=tell,
            )
        )  # fmt: skip

    def network_epochs(self, most: int) -> Epochs:
        """The energy head's squares alone, by `train`."""
        weights, static = eqx.partition(self.model.network, eqx.is_inexact_array)
        data = jnp.asarray(self.rows.features), jnp.asarray(self.rows.energy_wh / self.unit)
        return Epochs(
            lambda tell: train(
                _Squares(static), weights, self.memory, data, optax.adam(RATE), Plan(most, BATCH),
                key=jax.random.key(1), tell=tell,
            )
        )  # fmt: skip

    def loop(self) -> Callable[[], Any]:
        """An epoch of the plain loop: Python draws each batch and calls a jitted step."""
        optimiser, data, rng = optax.adam(RATE), stretches(self.rows, 1), np.random.default_rng(0)
        state = [self.weights, self.memory, optimiser.init(self.weights)]

        @jax.jit
        def step(weights: Any, memory: Any, inner: Any, batch: Any, key: Any) -> Any:
            value = jax.value_and_grad(self.objective.loss, has_aux=True)
            (_, memory), slope = value(weights, memory, batch, key, self.settings)
            update, inner = optimiser.update(slope, inner, weights)
            return optax.apply_updates(weights, update), memory, inner

        def epoch() -> Any:
            order, key = rng.permutation(len(self.rows)), jax.random.key(int(rng.integers(2**31)))
            for k in range(len(order) // BATCH):
                at = order[k * BATCH : (k + 1) * BATCH]
                batch = jax.tree.map(lambda x: x[at], data)  # noqa: B023
                state[:] = step(*state, batch, jax.random.fold_in(key, k))
            return state

        return epoch

    def members(self, count: int, most: int) -> Epochs:
        """So many seeds in one program."""
        made = [self.make(key=jax.random.key(k)) for k in range(count)]
        stack: Callable[..., Any] = lambda *x: jnp.stack(x)  # noqa: E731
        weights = jax.tree.map(stack, *(eqx.filter(model, eqx.is_inexact_array) for model, _ in made))
        memory = jax.tree.map(stack, *(memory for _, memory in made))
        data = jax.tree.map(jnp.asarray, stretches(self.rows, 1))
        return Epochs(
            lambda tell: train(
                self.objective, weights, memory, data, optax.adam(RATE), Plan(most, BATCH), members="in turn",
                tell=tell, key=jax.random.split(jax.random.key(1), count), settings=jnp.tile(self.settings, (count, 1)),
            )
        )  # fmt: skip


class _Squares:
    """The energy head's error alone."""

    def __init__(self, static: Any):
        self.static = static

    def loss(self, weights: Any, memory: Any, batch: Any, key: Any, settings: Any) -> tuple[Any, Any]:
        network: Network = eqx.combine(weights, self.static)
        heads, memory = network(batch[0], memory, key=key)
        return jnp.mean((batch[1] - heads.energy) ** 2), memory

    def score(self, weights: Any, memory: Any, data: Any, settings: Any) -> Any:
        raise NotImplementedError("nothing is held out here")


def physics_columns(rows: Rows) -> np.ndarray:
    """`COLUMNS` of the rows [row, column]."""
    s, car = rows.segments, rows.car
    each = (
        s.speed_start_mps, s.speed_end_mps, s.duration_s, s.distance_m, s.channels["mass_kg"], s.channels["grade_rad"],
        car.effect("inertia").rotating_mass_factor, car.driveline.efficiency, car.effect("auxiliary").auxiliary_w,
        rows.c_rr, rows.cda_m2,
    )  # fmt: skip
    return np.stack([np.asarray(x) for x in each], axis=1)


class Torch:
    """The same network and loss in PyTorch."""

    def __init__(self, torch: Any, learner: Learner, *, whole: bool):
        nn, self.torch, self.whole, self.unit = torch.nn, torch, whole, learner.unit
        rows, recipe, layers = learner.rows, learner.recipe, []
        sizes = (len(recipe.features), *recipe.units)
        for a, b in pairwise(sizes):
            layers += [nn.Linear(a, b), nn.ReLU(), nn.BatchNorm1d(b, momentum=0.01)]
            layers += [nn.Dropout(recipe.dropout)] if recipe.dropout else []
        self.network = nn.Sequential(*layers, nn.Linear(sizes[-1], 3))
        for p in self.network[-1].parameters():
            nn.init.zeros_(p)
        self.x, self.y = torch.tensor(np.asarray(rows.features)), torch.tensor(np.asarray(rows.energy_wh))
        self.physics = torch.tensor(physics_columns(rows))
        self.loss = self.equation_7 if whole else self.squares

    def compile(self) -> "Torch":
        """The loss, compiled."""
        self.loss = self.torch.compile(self.loss)
        return self

    def squares(self, x: Any, y: Any, columns: Any) -> Any:
        """The energy head's error alone."""
        return ((y / self.unit - self.network(x)[:, 0]) ** 2).mean()

    def equation_7(self, x: Any, y: Any, columns: Any) -> Any:
        """Equation 7 of paper 1 with the battery's energy (equation 5), as `Recipe` reads it."""
        torch, out = self.torch, self.network(x)
        start, end, duration, distance, mass, grade, inertia, efficiency, auxiliary, table, area = columns.unbind(1)
        c_rr = C_RR_LIMIT * torch.sigmoid(out[:, 1] + torch.log(table / (C_RR_LIMIT - table)))
        cda = area * torch.clamp(1.0 + out[:, 2], 0.5, 1.5)
        sine = torch.sin(grade)
        force = inertia * mass * (end - start) / duration + mass * GRAVITY_MPS2 * sine
        force = force + c_rr * mass * GRAVITY_MPS2 * torch.sqrt(1.0 - sine**2)
        force = force + 0.5 * AIR_DENSITY_KGPM3 * cda * 0.5 * (start**2 + end**2)
        force = torch.where(force > 0, force / efficiency, force * efficiency)
        physics = (force * distance / duration + auxiliary) * duration / 3600.0
        away = ((c_rr / table - 1.0) ** 2).mean() + ((cda / area - 1.0) ** 2).mean()
        data, term = ((y - physics - self.unit * out[:, 0]) ** 2).mean(), ((y - physics) ** 2).mean()
        return PAPER_WEIGHTS[0] * data + PAPER_WEIGHTS[1] * term + PAPER_WEIGHTS[2] * away

    def loop(self, threads: int) -> Callable[[], Any]:
        """An epoch: what is called by turns."""
        torch = self.torch
        optimiser = torch.optim.Adam(self.network.parameters(), lr=RATE, fused=True)
        self.network.train()

        def epoch() -> None:
            torch.set_num_threads(threads)
            order = torch.randperm(len(self.x))
            for k in range(len(order) // BATCH):
                at = order[k * BATCH : (k + 1) * BATCH]
                optimiser.zero_grad()
                self.loss(self.x[at], self.y[at], self.physics[at] if self.whole else None).backward()
                optimiser.step()

        return epoch


def same_loss(torch: Any, learner: Learner) -> float:
    """Relative difference of both losses on one batch, without dropout, at weights that move every head."""
    head = lambda m: (m.network.head.weight, m.network.head.bias)  # noqa: E731
    draw = np.random.default_rng(0)
    new = tuple(0.1 * draw.standard_normal(np.shape(x)).astype(np.float32) for x in head(learner.model))
    model = eqx.tree_at(head, learner.model, jax.tree.map(jnp.asarray, new))
    theirs = Torch(torch, learner, whole=True)
    linear = [m for m in theirs.network if isinstance(m, torch.nn.Linear)]
    for layer, own in zip(linear, (*model.network.layers, model.network.head), strict=True):
        layer.weight.data, layer.bias.data = (torch.tensor(np.asarray(v)) for v in (own.weight, own.bias))
    batch = jax.tree.map(lambda x: jnp.asarray(x[:BATCH]), stretches(learner.rows, 1))
    weights = eqx.filter(model, eqx.is_inexact_array)
    # the first batch has no running means yet: ours is by the batch too
    ours, _ = learner.objective.loss(weights, learner.memory, batch, jax.random.key(0), learner.settings)
    other = theirs.equation_7(theirs.x[:BATCH], theirs.y[:BATCH], theirs.physics[:BATCH]).item()
    return abs(float(ours) / other - 1.0)


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
            for what in ("loop", "torch"):
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
    with_numbers = ready(learner.model, learner.memory)
    ways = {"ready": lambda: with_numbers(one), "predict": lambda: predict(learner.model, learner.memory, one)}
    taken: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(2000):
        for name, call in ways.items():
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
    return "\n".join(f"{k}: {v:,.4g}" if isinstance(v, float) and v < 1e4 else f"{k}: {v:,.0f}" for k, v in out.items())


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
    given = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    rows, vehicles = fleet_rows(given.rows, given.routes)
    out: dict[str, Any] = {"rows": given.rows, "cores": CORES, "load": os.getloadavg()[0]}
    if "training" in given.what:
        out |= training(rows, vehicles, given.epochs, given.compiled)
    if "inference" in given.what:
        out |= inference(rows, vehicles)
    if "members" in given.what:
        out |= members(rows.take(np.arange(20_000) % len(rows)), vehicles, given.members, given.epochs)
    print(_shown(out))
    if given.json:
        given.json.write_text(json.dumps(out, indent=1) + "\n")
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
