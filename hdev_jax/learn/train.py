"""The one training loop, of every network here: new batches each epoch, the whole epoch one compiled program.

What is trained is a pytree of weights; what is carried from batch to batch besides (running means of a batch
normalisation) is its memory. Several members with starts, keys and settings of their own train in one program
(`members`), which is how a grid of loss weights or an ensemble is run.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Key, PRNGKeyArray

from hdev_jax.errors import InputError
from hdev_jax.rundir import atomic_file

__all__ = ["DivergedError", "NotFiniteError", "Objective", "Plan", "Scored", "Trained", "train"]


class DivergedError(InputError):
    """Nothing came of a training: of its data, or of its rate."""


class NotFiniteError(DivergedError):
    """A loss or its slope is NaN or infinite; the batch that it came from: `epoch`, `step` and `rows` of the data."""

    def __init__(self, epoch: int, step: int, rows: np.ndarray):
        self.epoch: int = epoch
        self.step: int = step
        self.rows: np.ndarray = rows
        few = ", ".join(map(str, rows[:8])) + (", …" if len(rows) > 8 else "")
        super().__init__(
            f"training: the loss or its slope is not finite in epoch {epoch}, batch {step} (entries {few} of the "
            "data); look for a bad row there, or lower the rate"
        )


@runtime_checkable
class Objective(Protocol):
    """What is minimised: `loss(weights, memory, batch, key, settings)`, a scalar, and the memory after the batch."""

    def loss(self, weights: Any, memory: Any, batch: Any, key: PRNGKeyArray, settings: Any) -> tuple[Array, Any]: ...


@runtime_checkable
class Scored(Objective, Protocol):
    """An objective that a validation set can be scored by: `score(weights, memory, data, settings)`, less is better."""

    def score(self, weights: Any, memory: Any, data: Any, settings: Any) -> Array: ...


@dataclass(frozen=True)
class Plan:
    """How long and how fast.

    **Arguments:** `batch`, entries of the data in one step (what is left over at an epoch's end waits for the next
    shuffle); `shrink` and `patience`, the rate times `shrink` after so many epochs without a better score (0: never),
    down to `least` of it; `stop_after`, epochs without a better score after which training ends (0: never).
    """

    epochs: int = 100
    batch: int = 1024
    shrink: float = 0.5
    patience: int = 0
    least: float = 1e-3
    stop_after: int = 0


class _State(NamedTuple):
    """Between two epochs. `best` is what the validation set liked most; `since` counts epochs from then."""

    weights: Any
    memory: Any
    optimiser: Any
    best: Any
    score: Array
    since: Array
    slow: Array  # epochs since the last better score or change of the rate
    factor: Array
    stopped: Array
    epoch: Array
    losses: Array
    scores: Array


@dataclass(frozen=True)
class Trained:
    """`weights` and `memory` of the best epoch by the validation set, of the last one where there is none.

    `losses` and `scores` [epoch] (of several members [member, epoch]); NaN for epochs after the end. `epochs` run.
    """

    weights: Any
    memory: Any
    losses: np.ndarray
    scores: np.ndarray
    epochs: int


def train(
    objective: Objective,
    weights: Any,
    memory: Any,
    data: Any,
    optimiser: optax.GradientTransformation,
    plan: Plan,
    *,
    key: PRNGKeyArray | Key[Array, " member"],
    held: Any = None,
    settings: Any = None,
    members: Literal["", "in turn", "side by side"] = "",
    checkpoint: Path | None = None,
    every: int = 5,
    tell: Callable[[int, float, float], None] | None = None,
) -> Trained:
    """Train, epoch after epoch, until `plan.epochs` or until the score of `held` gets no better.

    **Arguments:** `data` and `held`, pytrees of arrays with one leading axis; `settings`, numbers for the objective
    (loss weights); with `members`, `weights`, `memory`, `key` and `settings` have a leading axis of members, the data
    are the same for all. In turn, epoch by epoch (`jax.lax.map`), is faster on a CPU where a step fills the machine:
    `jax.vmap`'s batched products fill the caches (16 of 256-128 units: 1.2 times). Side by side (`jax.vmap`) is faster
    where a step is many small operations, as of a recurrent cell. `checkpoint`, a file that is written every so many
    epochs; where it is there, training goes on from it, to the same numbers. `tell(epoch, loss, score)` after each
    epoch.

    **Raises:** `NotFiniteError` with the batch; of several members, one whose loss is not finite stops, and keeps
    what it had. `DivergedError` where `held` never had a finite score. `InputError` for a checkpoint of other shapes;
    that it is of the same data and settings is the caller's to see to.
    """
    if held is not None and not isinstance(objective, Scored):
        raise TypeError(f"{type(objective).__name__} has no score, and rows are held out")
    entries = jax.tree.leaves(data)[0].shape[0]
    batch = min(plan.batch, entries)
    epoch: Callable[..., Any] = functools.partial(_epoch, objective, optimiser, plan, batch)
    start: Callable[..., Any] = functools.partial(_start, optimiser, plan)
    if members:
        each = functools.partial(_in_turn, epoch)
        epoch = each if members == "in turn" else jax.vmap(epoch, in_axes=(0, 0, 0, None, None))
        start = jax.vmap(start)
    step: Any = eqx.filter_jit(epoch)
    state = start(weights, memory)
    if checkpoint is not None and checkpoint.exists():
        state = _resumed(checkpoint, state)
    done = int(np.max(np.asarray(state.epoch)))
    while done < plan.epochs and not bool(np.all(np.asarray(state.stopped))):
        state, losses = step(state, key, settings, data, held)
        losses = np.asarray(losses)
        if not members and not np.isfinite(losses).all():
            at = int(np.flatnonzero(~np.isfinite(losses))[0])
            rows = np.asarray(_shuffled(key, done, entries, batch))[at]
            raise NotFiniteError(done, at, rows)
        if tell is not None:
            scores = np.asarray(state.scores)[..., done]
            tell(done, _finite(np.mean, losses), _finite(np.min, scores))
        done += 1
        if checkpoint is not None and (done % every == 0 or done == plan.epochs):
            with atomic_file(checkpoint) as path, path.open("wb") as file:
                eqx.tree_serialise_leaves(file, state)
    if held is not None and not np.isfinite(np.asarray(state.score)).any():
        raise DivergedError("training: no epoch has a finite score; look for a bad row in what is held out")
    kept, remembered = state.best if held is not None else (state.weights, state.memory)
    return Trained(kept, remembered, np.asarray(state.losses), np.asarray(state.scores), done)


def _resumed(checkpoint: Path, state: Any) -> Any:
    try:
        with checkpoint.open("rb") as file:  # of a path Equinox would add an ending to a name that has none
            return jax.tree.map(_as_weak, eqx.tree_deserialise_leaves(file, state), state)
    except (RuntimeError, ValueError, EOFError, OSError) as e:
        why = str(e).strip().partition("\n")[0]
        raise InputError(
            f"{checkpoint}: not a checkpoint of this training ({why}); delete it, or train as it was begun"
        ) from e


def _as_weak(read: Any, began: Any) -> Any:
    """What was read, weakly typed if it began so, as Python's numbers are: a file does not say it, and a counter that
    has a type of its own makes float64 of the float32 that it meets."""
    if not getattr(began, "weak_type", False):
        return read
    each = [jnp.asarray(x) for x in np.ravel(read).tolist()]
    return jnp.stack(each).reshape(np.shape(read))


def _finite(of: Callable[[np.ndarray], Any], x: np.ndarray) -> float:
    """Mean or least of what is finite, of members that go on; NaN where nothing is."""
    x = x[np.isfinite(x)]
    return float(of(x)) if x.size else float("nan")


def _start(optimiser: optax.GradientTransformation, plan: Plan, weights: Any, memory: Any) -> _State:
    none = jnp.full(plan.epochs, jnp.nan, jnp.float32)
    zero, one = jnp.zeros((), jnp.int32), jnp.ones((), jnp.float32)
    return _State(
        weights, memory, optimiser.init(weights), (weights, memory), jnp.inf * one, zero, zero, one,
        jnp.zeros((), bool), zero, none, none,
    )  # fmt: skip


def _shuffled(key: PRNGKeyArray, epoch: Any, entries: int, batch: int) -> Array:
    """Entries of each batch of an epoch [step, batch]."""
    steps = entries // batch
    # one sort, where `jax.random.permutation` makes two: of n words only n²/2³³ pairs are alike, and stay in order
    words = jax.random.bits(jax.random.fold_in(jax.random.fold_in(key, epoch), 0), (entries,), jnp.uint32)
    _, order = jax.lax.sort((words, jax.lax.iota(jnp.int32, entries)), num_keys=1)
    return order[: steps * batch].reshape(steps, batch)


def _epoch(
    objective: Any,
    optimiser: optax.GradientTransformation,
    plan: Plan,
    batch: int,
    state: _State,
    key: PRNGKeyArray,
    settings: Any,
    data: Any,
    held: Any,
) -> tuple[_State, Float[Array, " step"]]:
    """One pass over the data, and the score after it."""
    entries = jax.tree.leaves(data)[0].shape[0]
    at = _shuffled(key, state.epoch, entries, batch)
    draws = jax.random.split(jax.random.fold_in(jax.random.fold_in(key, state.epoch), 1), at.shape[0])

    def step(carry: Any, now: tuple[Array, Array]) -> tuple[Any, Array]:
        weights, memory, inner = carry
        rows, draw = now
        part = jax.tree.map(lambda x: x[rows], data)
        (loss, memory), slope = jax.value_and_grad(objective.loss, has_aux=True)(weights, memory, part, draw, settings)
        # a slope can be NaN where the loss is not (√ at 0); the next batch would be blamed, or the last one nobody
        sound = jnp.stack([jnp.all(jnp.isfinite(g)) for g in jax.tree.leaves(slope)])
        loss = jnp.where(jnp.all(sound), loss, jnp.nan)
        update, inner = optimiser.update(slope, inner, weights)
        update = jax.tree.map(lambda u: u * state.factor.astype(u.dtype), update)
        return (optax.apply_updates(weights, update), memory, inner), loss

    (weights, memory, inner), losses = jax.lax.scan(step, (state.weights, state.memory, state.optimiser), (at, draws))
    finite = jnp.all(jnp.isfinite(losses))
    score = jnp.asarray(jnp.nan if held is None else objective.score(weights, memory, held, settings), jnp.float32)
    better = (score < state.score) & finite
    since = jnp.where(better, 0, state.since + 1)
    slow = jnp.where(better, 0, state.slow + 1)
    shrinks = (slow >= plan.patience) & (plan.patience > 0) & (held is not None)
    after = _State(
        weights, memory, inner, _where(better, (weights, memory), state.best),
        jnp.where(better, score, state.score), since, jnp.where(shrinks, 0, slow),
        jnp.where(shrinks, jnp.maximum(state.factor * plan.shrink, plan.least), state.factor).astype(jnp.float32),
        ~finite | ((since >= plan.stop_after) & (plan.stop_after > 0) & (held is not None)),
        state.epoch, state.losses.at[state.epoch].set(jnp.mean(losses).astype(jnp.float32)),
        state.scores.at[state.epoch].set(score),
    )  # fmt: skip
    # a member that has stopped stays as it was, one whose loss is not finite stays as it was before
    new = _where(finite & ~state.stopped, after, state._replace(stopped=state.stopped | ~finite))
    return new._replace(epoch=state.epoch + 1), losses


def _in_turn(
    epoch: Callable[..., Any], state: _State, key: Any, settings: Any, data: Any, held: Any
) -> tuple[_State, Float[Array, "member step"]]:
    """An epoch of every member, one after the other."""
    return jax.lax.map(lambda own: epoch(*own, data, held), (state, key, settings))


def _where(choose: Array, yes: Any, no: Any) -> Any:
    return jax.tree.map(lambda a, b: jnp.where(choose, a, b), yes, no)
