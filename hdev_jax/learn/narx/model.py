"""NARX models (paper 2, section III): regressors with lags, a sigmoid network, fits in prediction and in simulation."""

from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hdev_jax.errors import InputError
from hdev_jax.learn.narx.levenberg import Fitted, fit_many
from hdev_jax.learn.narx.network import Shape, free_run, output, unpack
from hdev_jax.learn.narx.normal import rows_of, windows_of
from hdev_jax.learn.sequences import Scale, Trip, lagged
from hdev_jax.learn.sources import Channels, Source

__all__ = ["Narx", "Structure", "fit_prediction", "fit_simulation", "penalty", "prepared", "starts", "with_theta"]

COARSE = (3.0, 2.0, 1.0)  # weights of a coarse start's lags, newest first: units see one smoothed value of each input


@dataclass(frozen=True)
class Structure:
    """Which regressors, and what the units see of them.

    **Arguments:** `source` of the inputs; `outputs`, past outputs y(k−1) … (n_a of equation 14); `lags` of every
    input, 0 being the present (n_b = 3 and n_g = 0 are lags 0, 1, 2; a negative lag looks ahead); `units`, sigmoids;
    `seen`: "all" regressors or the "inputs" alone, so that what is fed back is linear and the free run cannot run away;
    `linear`: whether regressors enter linearly beside the units (X·M·L of equation 17).
    """

    source: Source = field(default_factory=Channels)
    outputs: int = 3
    lags: tuple[int, ...] = (0, 1, 2)
    units: int = 10
    seen: Literal["all", "inputs"] = "inputs"
    linear: bool = True

    def __post_init__(self) -> None:
        if self.outputs < 0 or not self.lags or self.units < 0:
            raise InputError(
                f"orders of a NARX: at least one lag, no negative counts; found {self.outputs} outputs, lags "
                f"{list(self.lags)}, {self.units} units"
            )

    @property
    def first(self) -> int:
        """The first row that has all its regressors."""
        return max(self.outputs, max(self.lags))

    @cached_property
    def shape(self) -> Shape:
        columns = self.outputs + len(self.source.names) * len(self.lags)
        seen = range(self.outputs if self.seen == "inputs" else 0, columns)
        return Shape(
            columns, self.outputs, columns if self.linear else 0, self.units, tuple(seen) if self.units else ()
        )


@dataclass(frozen=True)
class Narx:
    """A fitted model. `theta` belongs to normalised regressors; what goes in and comes out is in the log's units."""

    structure: Structure
    inputs: Scale
    output: Scale
    theta: Float[np.ndarray, " parameter"]

    @property
    def parameters(self) -> int:
        """Free parameters, those of the normalisation not counted."""
        return self.structure.shape.size

    def regressors(self, trip: Trip) -> tuple[Float[np.ndarray, "row column"], Float[np.ndarray, " row"]]:
        """Normalised X(k) of paper 2, equation 18, and y(k), from row `structure.first` on.

        Raises `InputError` for a trip that is shorter than that.
        """
        s = self.structure
        if len(trip) <= s.first:
            raise InputError(f"trip {trip.name}: {len(trip)} rows, a NARX of these orders needs {s.first + 1}")
        y = self.output.apply(trip.target)
        past = lagged(y[:, None], range(1, s.outputs + 1))
        x = np.concatenate([past, lagged(self.inputs.apply(s.source(trip)), s.lags)], axis=1)
        return x[s.first :], y[s.first :]

    def predict(self, trip: Trip) -> Float[np.ndarray, " row"]:
        """One step ahead, from measured past outputs (figure 11a); rows from `structure.first` on."""
        x, _ = self.regressors(trip)
        return self.output.undo(_output(self.structure.shape, jnp.asarray(self.theta), jnp.asarray(x)))

    def step(self, x: Float[np.ndarray, " column"]) -> float:
        """One step ahead of one row of normalised regressors, in NumPy for a controller; in the target's unit."""
        s = self.structure.shape
        p = _split(s, self.theta)
        y = p[0] + x[: s.linear] @ p[1]
        if s.units:
            y = y + p[2] @ (1.0 / (1.0 + np.exp(-(p[3] @ x[s.seen[0] :] + p[4]))))
        return float(y * self.output.sd + self.output.mean)

    def simulate(self, trip: Trip) -> Float[np.ndarray, " row"]:
        """Free run, from the model's own past outputs (figure 11b), started from the measured rows before the first."""
        x, _ = self.regressors(trip)
        back = self.structure.outputs
        run = _free_run(
            self.structure.shape, jnp.asarray(self.theta), jnp.asarray(x[0, :back]), jnp.asarray(x[:, back:])
        )
        return self.output.undo(run)

    def measured(self, trip: Trip) -> Float[np.ndarray, " row"]:
        """What `predict` and `simulate` are to be compared with."""
        return np.asarray(trip.target)[self.structure.first :]


def _split(shape: Shape, theta: np.ndarray) -> tuple[Any, ...]:
    """The parts as views: `unpack` without JAX. What the units see ends with the last column."""
    a, n, q = 1 + shape.linear, shape.units, len(shape.seen)
    slope = theta[a + n : a + n + n * q].reshape(n, q)
    return theta[0], theta[1:a], theta[a : a + n], slope, theta[a + n + n * q :]


_output = jax.jit(output, static_argnums=0)
_free_run = jax.jit(free_run, static_argnums=0)


def prepared(structure: Structure, trip: Trip) -> Narx:
    """A model without parameters yet: scales of the trip it is going to be trained on."""
    shape = structure.shape
    return Narx(structure, Scale.of(structure.source(trip)), Scale.of(trip.target), np.zeros(shape.size))


def starts(
    model: Narx,
    trip: Trip,
    *,
    keys: Array,
    steps: int = 60,
    huber: float = np.inf,
    ridge: Any = None,
    weights: np.ndarray | None = None,
) -> Array:
    """Starting points: the linear solution, with units from a coarse fit in which each input is one smoothed value.

    Units of random direction pass through random rows of the trip; their sizes come from ridge regression; then a
    Levenberg-Marquardt fit of few columns, whose solution is spread over the lags.

    **Arguments:** `keys`, a random key for each start; `huber` and `ridge` as in `fit_prediction`; `weights`
    `[start, row]` where starts differ in the rows they may see. **Returns** `[start, parameter]`.
    """
    s, shape = model.structure, model.structure.shape
    x, y = model.regressors(trip)
    lags, inputs = len(s.lags), len(s.source.names)
    taps = np.array([*COARSE, *[1.0] * lags][:lags])
    taps = taps / taps.sum()
    smooth = np.stack([x[:, s.outputs + j * lags : s.outputs + (j + 1) * lags] @ taps for j in range(inputs)], axis=1)
    wide = np.concatenate([x, smooth], axis=1)
    coarse = Shape(wide.shape[1], shape.feedback, shape.linear, s.units, tuple(range(x.shape[1], wide.shape[1])))
    rows = rows_of(wide, y)
    some = slice(None, None, max(1, len(y) // 8192))
    own = np.ones((len(keys), len(y))) if weights is None else weights
    first = _drawn(coarse, jnp.asarray(wide[some]), jnp.asarray(y[some]), jnp.asarray(own[:, some]), keys)
    chunked = None if weights is None else jnp.stack([rows_of(wide[:, :0], y, w).weight for w in weights])
    fitted = fit_many(
        coarse, rows, first, huber=huber / float(model.output.sd), ridge=penalty(coarse, **(ridge or {})),
        max_steps=steps, weights=chunked,
    )  # fmt: skip
    spread = np.zeros((inputs, len(shape.seen)))
    for at, column in enumerate(shape.seen):
        if column >= s.outputs:
            spread[(column - s.outputs) // lags, at] = taps[(column - s.outputs) % lags]

    def finer(theta: Array) -> Array:
        p = unpack(coarse, theta)
        return jnp.concatenate([p.offset[None], p.linear, p.size, (p.slope @ jnp.asarray(spread)).ravel(), p.shift])

    return jax.vmap(finer)(fitted.theta)


def penalty(shape: Shape, size: float = 0.0, slope: float = 0.0) -> Array:
    """Ridge of each parameter: on the units' output coefficients s and dilations b; none on the rest."""
    n, q = shape.units, len(shape.seen)
    free = jnp.zeros(1 + shape.linear)
    return jnp.concatenate([free, jnp.full(n, size), jnp.full(n * q, slope), jnp.zeros(n)])


@partial(jax.jit, static_argnums=0)
def _drawn(shape: Shape, x: Array, y: Array, weights: Array, keys: Array) -> Array:
    """A start for each key, with its own weights of rows."""
    return jax.vmap(partial(_drawn_once, shape, x, y))(weights, keys)


def _drawn_once(shape: Shape, x: Array, y: Array, weight: Array, key: Array) -> Array:
    """Random units, the rest by ridge regression."""
    direction, steepness, row = jax.random.split(key, 3)
    q = len(shape.seen)
    slope = jax.random.normal(direction, (shape.units, q))
    slope = slope / jnp.linalg.norm(slope, axis=1, keepdims=True)
    slope = slope * jax.random.uniform(steepness, (shape.units, 1), minval=0.5, maxval=2.0)
    seen = x[:, jnp.array(shape.seen)]
    shift = -jnp.sum(slope * seen[jax.random.randint(row, (shape.units,), 0, x.shape[0])], axis=1)
    unit = jax.nn.sigmoid(seen @ slope.T + shift[None, :])
    design = jnp.concatenate([jnp.ones((x.shape[0], 1)), x[:, : shape.linear], unit], axis=1)
    damp = jnp.concatenate([jnp.full(1 + shape.linear, 1e-9), jnp.full(shape.units, 2.5e-6)]) * x.shape[0]
    weighed = design * weight[:, None]
    flat = jnp.linalg.solve(weighed.T @ design + jnp.diag(damp), weighed.T @ y)
    return jnp.concatenate([flat, slope.ravel(), shift])


def fit_prediction(
    model: Narx,
    trip: Trip,
    begin: Float[Any, "start parameter"],
    *,
    huber: float = np.inf,
    ridge: Any = None,
    weights: np.ndarray | None = None,
    max_steps: int = 150,
    rtol: float = 1e-6,
) -> Fitted:
    """Fit the one-step error from several starts in one program (paper 2, section III-C).

    **Arguments:** `huber`, the corner of the loss in the target's unit; `ridge`, keywords of `penalty`; `weights`
    `[start, row]` where starts differ in the rows they are fitted on.

    Where there are units, products of the Hessian are in float32 (`fit_many`); a structure that is linear in its
    parameters is solved in one step or two, in double.
    """
    x, y = model.regressors(trip)
    rows = rows_of(x, y)
    own = None if weights is None else jnp.stack([rows_of(x[:, :0], y, w).weight for w in weights])
    shape = model.structure.shape
    return fit_many(
        shape, rows, jnp.asarray(begin), huber=huber / float(model.output.sd), ridge=penalty(shape, **(ridge or {})),
        max_steps=max_steps, rtol=rtol, weights=own, single=shape.units > 0,
    )  # fmt: skip


def fit_simulation(
    model: Narx,
    trip: Trip,
    begin: Float[Any, "start parameter"],
    *,
    huber: float = np.inf,
    ridge: Any = None,
    length: int = 256,
    max_steps: int = 50,
    rtol: float = 1e-6,
) -> Fitted:
    """Fit the free run from solutions of the one-step fit (paper 2, section IV), windows of the trip in parallel.

    A window starts from measured outputs, 64 rows before it counts: its start is forgotten by then. Products of the
    Hessian as in `fit_prediction`.
    """
    x, y = model.regressors(trip)
    shape = model.structure.shape
    windows = windows_of(x, y, shape.feedback, length=length)
    return fit_many(
        shape, windows, jnp.asarray(begin), huber=huber / float(model.output.sd), ridge=penalty(shape, **(ridge or {})),
        max_steps=max_steps, rtol=rtol, single=shape.units > 0,
    )  # fmt: skip


def with_theta(model: Narx, theta: Any) -> Narx:
    """The same model with these parameters."""
    return replace(model, theta=np.asarray(theta))
