"""The sides of `pinn.py`: the network of paper 1 trained by ours, by a plain JAX loop and by PyTorch."""

import threading
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax

from hdev_jax.learn.pinn.fit import PAPER_WEIGHTS, stretches
from hdev_jax.learn.pinn.heads import Network
from hdev_jax.learn.pinn.loss import Objective
from hdev_jax.learn.pinn.model import C_RR_LIMIT, Pinn, Recipe
from hdev_jax.learn.pinn.rows import Rows
from hdev_jax.learn.train import Plan, Trained, train
from hdev_jax.units import AIR_DENSITY_KGPM3, GRAVITY_MPS2

__all__ = ["BATCH", "Learner", "Torch", "same_loss"]

BATCH, RATE = 1024, 0.005
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

    def epochs(self, most: int, device: jax.Device | None = None) -> Epochs:
        """The whole loss, by `train`; on JAX's default device, or on this one."""

        def run(tell: Callable[..., None]) -> Trained:
            with jax.default_device(device):
                weights, memory, settings, data = jax.device_put(
                    (self.weights, self.memory, self.settings, stretches(self.rows, 1)), device
                )
                return train(
                    self.objective, weights, memory, data, optax.adam(RATE), Plan(most, BATCH),
                    key=jax.random.key(1), settings=settings, tell=tell,
                )  # fmt: skip

        return Epochs(run)

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
