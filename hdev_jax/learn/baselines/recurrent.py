"""LSTM and GRU (paper 2, section IV) in Equinox, trained by Adam on windows of a trip."""

from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key, PRNGKeyArray

from hdev_jax.errors import InputError
from hdev_jax.learn.sequences import Scale, Trip
from hdev_jax.learn.sources import Channels, Source
from hdev_jax.learn.train import DivergedError, Plan, train

__all__ = ["Recurrent", "RecurrentModel", "train_recurrent"]

GAIN = 5.0
CELLS: dict[str, type[eqx.nn.LSTMCell] | type[eqx.nn.GRUCell]] = {"lstm": eqx.nn.LSTMCell, "gru": eqx.nn.GRUCell}


class Recurrent(eqx.Module):
    """One layer of cells and a linear read-out of the hidden state; float32, as it is trained.

    The hidden state is bounded, power is not. Read out times `GAIN`, the state stays small, where it is nearly linear,
    and a trip that goes further than the training trip is not cut off.
    """

    cell: eqx.nn.LSTMCell | eqx.nn.GRUCell
    head: eqx.nn.Linear
    memory: int = eqx.field(static=True)

    def __init__(self, kind: str, inputs: int, units: int, *, key: PRNGKeyArray):
        if kind not in CELLS:
            raise InputError(f"recurrent cell {kind!r}: one of {', '.join(CELLS)}")
        first, second = jax.random.split(key)
        self.cell = CELLS[kind](inputs, units, dtype=jnp.float32, key=first)
        self.head = eqx.nn.Linear(units, 1, dtype=jnp.float32, key=second)
        self.memory = units

    def __call__(self, x: Float[Array, "time inputs"]) -> Float[Array, " time"]:
        """Output of every row; the state begins at zero."""
        zero = jnp.zeros(self.memory, x.dtype)
        first: Any = (zero, zero) if isinstance(self.cell, eqx.nn.LSTMCell) else zero

        def step(state: Any, row: Array) -> tuple[Any, Array]:
            state = self.cell(row, state)
            return state, state[0] if isinstance(state, tuple) else state

        hidden = jax.lax.scan(step, first, x)[1]
        return GAIN * (hidden @ self.head.weight[0]) + (0.0 if self.head.bias is None else self.head.bias[0])


@dataclass(frozen=True)
class RecurrentModel:
    """A trained network with its scales. It feeds nothing measured back: prediction and simulation are the same."""

    network: Recurrent
    source: Source
    inputs: Scale
    output: Scale

    @property
    def parameters(self) -> int:
        """Trained parameters."""
        return sum(x.size for x in jax.tree.leaves(eqx.filter(self.network, eqx.is_array)))

    def predict(self, trip: Trip) -> Float[np.ndarray, " row"]:
        """Output for every row of a trip, in the target's unit."""
        x = jnp.asarray(self.inputs.apply(self.source(trip)), dtype=jnp.float32)
        return self.output.undo(_run(self.network, x))

    def simulate(self, trip: Trip) -> Float[np.ndarray, " row"]:
        """The same as `predict`."""
        return self.predict(trip)

    def measured(self, trip: Trip) -> Float[np.ndarray, " row"]:
        """What they are to be compared with."""
        return np.asarray(trip.target)


@eqx.filter_jit
def _run(network: Recurrent, x: Array) -> Array:
    return network(x)


def train_recurrent(
    kind: str,
    trip: Trip,
    *,
    keys: Key[Array, " start"],
    source: Source | None = None,
    units: int = 10,
    steps: int = 4000,
    batch: int = 128,
    length: int = 128,
    burn_in: int = 32,
    rate: float = 0.02,
    decay: float = 0.03,
    huber: float = np.inf,
    without: Bool[np.ndarray, " row"] | None = None,
) -> list[RecurrentModel]:
    """A network from each start, all in one program: Adam with a cosine schedule from `rate` to 0 over `steps` batches
    (or as many more as fill the last pass over the trip) of windows from all places of the trip.

    **Arguments:** `length` rows of a window count, after `burn_in` that only fill the memory; `decay` of the
    weights (Loshchilov and Hutter 2019), of the cell, not of the read-out, times the rate; `huber`, corner of the
    loss in the target's unit; `without`, rows that no window counts. A start whose loss is not finite stays where it
    was. Raises `InputError` for a trip that has no window, `DivergedError` where no start has a finite loss.
    """
    import optax

    source = Channels() if source is None else source
    columns = source(trip)
    window = length + burn_in
    known = np.ones(len(trip), bool) if without is None else ~np.asarray(without)
    # how many unknown rows a window counts, from where it begins
    unknown = np.concatenate([[0], np.cumsum(~known)])
    begins = np.arange(max(len(trip) - window + 1, 0))
    places = begins[unknown[begins + window] == unknown[begins + burn_in]]
    if not len(places):
        raise InputError(
            f"trip {trip.name}: {known.sum()} rows to train on, a window has {window}; make `length` shorter"
        )
    scales = Scale.of(columns[known]), Scale.of(np.asarray(trip.target)[known])
    x = jnp.asarray(scales[0].apply(columns), dtype=jnp.float32)
    y = jnp.asarray(scales[1].apply(trip.target), dtype=jnp.float32)
    corner = min(huber / float(scales[1].sd), 1e6)
    begin, draw = jax.vmap(jax.random.split, out_axes=1)(keys)
    networks = [Recurrent(kind, x.shape[1], units, key=k) for k in begin]
    weights = jax.tree.map(lambda *w: jnp.stack(w), *(eqx.filter(n, eqx.is_array) for n in networks))
    static = eqx.filter(networks[0], eqx.is_array, inverse=True)
    cell_only = eqx.tree_at(
        lambda n: n.cell, jax.tree.map(lambda _: False, weights), jax.tree.map(lambda _: True, weights.cell)
    )
    each = max(len(places) // batch, 1)
    epochs = -(-steps // each)
    schedule = optax.cosine_decay_schedule(rate, epochs * each)
    optimiser = optax.chain(optax.clip_by_global_norm(1.0), optax.adamw(schedule, weight_decay=decay, mask=cell_only))
    objective = _Windows(static, x, y, burn_in, window, corner)
    trained = train(
        objective, weights, None, jnp.asarray(places), optimiser, Plan(epochs, batch), key=draw, members="side by side"
    )
    if not np.isfinite(trained.losses[:, 0]).any():
        raise DivergedError(f"trip {trip.name}: no {kind} has a finite loss; lower the rate")
    return [
        RecurrentModel(eqx.combine(jax.tree.map(lambda w, k=k: w[k], trained.weights), static), source, *scales)
        for k in range(len(networks))
    ]


@dataclass(frozen=True)
class _Windows:
    """Huber's loss over windows of a trip; a batch is where they begin."""

    static: Any
    x: Array
    y: Array
    burn_in: int
    window: int
    corner: float

    def loss(self, weights: Any, memory: Any, batch: Array, key: Array, settings: Any) -> tuple[Array, Any]:
        import optax

        at = batch[:, None] + jnp.arange(self.window)[None, :]
        error = (
            jax.vmap(eqx.combine(weights, self.static))(self.x[at])[:, self.burn_in :] - self.y[at][:, self.burn_in :]
        )
        return jnp.mean(optax.huber_loss(error, delta=self.corner)) / self.corner, memory
