"""The physics-informed network of paper 1 (section 3.3): two heads, a physics term that calls the kernel, and ours.

What the paper leaves open is a choice of the `Recipe`, its readings named. Ours differs by deltas: coefficients that
cannot saturate, by vehicle and by what a coefficient may depend on; a likelihood whose noise grows with energy in the
place of squares weighed by hand; a term for the sum over a stretch of a trip; effects of the library as physics.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from operator import itemgetter
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from hdev_jax.errors import InputError
from hdev_jax.learn.pinn.heads import Heads, Network
from hdev_jax.learn.pinn.rows import PHYSICAL, Rows, energy, wheel_energy, with_coefficients
from hdev_jax.physics import Effect, Grouped, coefficients_that_hold
from hdev_jax.segments import Ids

__all__ = ["C_RR_LIMIT", "Choices", "Pinn", "Prediction", "Recipe", "Sized", "centred", "predict", "ready"]

C_RR_LIMIT = 0.02  # (0, 0.02] of section 3.3.2
_BY_ROW = 0.5  # how far the network's head moves a free coefficient, in logarithms, for an output of 1


@dataclass(frozen=True)
class Choices:
    """What is built and what is minimised, but for the inputs.

    - `units`, `normalised`, `dropout`: the network.
    - `predicted`, what E_pred of equation 7 is: `residual`, the physics with predicted coefficients plus what the
      energy head says; `alone`, what that head says, about the mean; `table`, the physics at the tables plus what the
      head says.
    - `physics`: `battery` (equation 5) or `wheel` (equation 4 as equation 7 cites it).
    - `coefficients`: `bounded`, c_rr by a scaled sigmoid in (0, 0.02], C_d·A clamped `clamp` around its table;
      `free`, the table times an exponential; `table`, not predicted at all.
    - `coefficient_inputs`: `all` features, or those that a coefficient can depend on (`physical`).
    - `coefficient_loss`: squares of the distance from the table, `relative` to it or `absolute`.
    - `by_vehicle`: coefficients and effects have what trained vehicles have in common, their mean, and a part of each
      vehicle's own about it; a vehicle that was not trained on has the median of these.
    - `loss`: `squares` (equation 7), or the normal `likelihood` of measured and of physical energy, whose variances
      are learned, which is what weighs the terms against each other (Kendall, Gal and Cipolla, CVPR 2018).
    - `energy_head`: with the head, or without; `stretch`, rows of a stretch of a trip whose sum counts too (1: none):
      a composite likelihood, rows and sums being the same data twice.
    """

    units: tuple[int, ...] = (256, 128)
    normalised: bool = True
    dropout: float = 0.1
    predicted: Literal["residual", "alone", "table"] = "residual"
    physics: Literal["battery", "wheel"] = "battery"
    coefficients: Literal["bounded", "free", "table"] = "bounded"
    clamp: float = 0.5
    coefficient_inputs: Literal["all", "physical"] = "all"
    coefficient_loss: Literal["relative", "absolute"] = "relative"
    by_vehicle: bool = False
    loss: Literal["squares", "likelihood"] = "squares"
    energy_head: bool = True
    stretch: int = 1


@dataclass(frozen=True, kw_only=True)
class Recipe(Choices):
    """Choices and inputs: `features`, names of columns."""

    features: tuple[str, ...]


class Sized(NamedTuple):
    """An effect whose sizes are trained: `sizes` by name with the number of values (0: one number, not by group); its
    other parameters stay as in `fixed`."""

    kind: type[Effect]
    sizes: tuple[tuple[str, int], ...]
    fixed: tuple[tuple[str, float], ...] = ()


class Prediction(eqx.Module):
    """By row: energy [Wh], what the physics alone says [Wh], the energy head's part [Wh], c_rr, C_d·A [m²], and the
    standard deviation of the energy [Wh] (NaN without a likelihood)."""

    energy_wh: Float[Array, " row"]
    physics_wh: Float[Array, " row"]
    residual_wh: Float[Array, " row"]
    c_rr: Float[Array, " row"]
    cda_m2: Float[Array, " row"]
    sd_wh: Float[Array, " row"]


class Pinn(eqx.Module):
    """Weights of a recipe. `common` [2] and `own` [vehicle, 2] are logarithms of coefficients over their tables;
    `sizes` and `own_sizes` are the effects' sizes in units of their usual scale. What is a vehicle's own counts from
    the mean over vehicles.

    `scale_wh` is the unit of the energy head where `Rows.unit` is 1, and `mean_wh` where it begins when it is alone.

    **Raises:** `InputError` where coefficients shall depend on `physical` features and there is none.
    """

    network: Network
    coefficient_network: Network | None
    common: Float[Array, " 2"]
    own: Float[Array, "vehicle 2"]
    sizes: dict[str, Array]
    own_sizes: dict[str, Array]
    noise: Float[Array, " 4"]  # logarithms: floor [scale] and share of energy, of the prediction and of the physics
    drift: Float[Array, ""]  # logarithm of the share by which a whole trip's energy is off
    effects: tuple[Sized, ...] = eqx.field(static=True)
    scale_wh: float = eqx.field(static=True)
    mean_wh: float = eqx.field(static=True)
    recipe: Recipe = eqx.field(static=True)

    def __init__(
        self, recipe: Recipe, vehicles: int, *, scale_wh: float, mean_wh: float = 0.0,
        effects: tuple[Sized, ...] = (), key: PRNGKeyArray,
    ):  # fmt: skip
        first, second = jax.random.split(key)
        make = lambda n, units, k: Network(  # noqa: E731
            n, units, normalised=recipe.normalised, dropout=recipe.dropout, key=k
        )
        self.network = make(len(recipe.features), recipe.units, first)
        physical = [n for n in recipe.features if n in PHYSICAL]
        apart = recipe.coefficient_inputs == "physical" and recipe.coefficients == "free"
        if apart and not physical:
            raise InputError(f"coefficient_inputs physical: none of the features is one of {', '.join(PHYSICAL)}")
        self.coefficient_network = make(len(physical), (32, 32), second) if apart else None
        self.common = jnp.zeros(2, jnp.float32)
        self.own = jnp.zeros((vehicles, 2), jnp.float32)
        sizes = [(f"{e.kind.id}.{name}", (n,) if n else ()) for e in effects for name, n in e.sizes]
        self.sizes = {name: jnp.zeros(shape, jnp.float32) for name, shape in sizes}
        self.own_sizes = {name: jnp.zeros((vehicles, *shape), jnp.float32) for name, shape in sizes}
        self.noise = jnp.log(jnp.array([0.1, 0.05, 0.2, 0.1], jnp.float32))
        self.drift = jnp.log(jnp.array(0.03, jnp.float32))
        self.effects = effects
        self.scale_wh = scale_wh
        self.mean_wh = mean_wh
        self.recipe = recipe

    # --- what holds in a row -----------------------------------------------------------------------------------------

    def coefficients(self, heads: Heads, rows: Rows) -> tuple[Array, Array]:
        """c_rr and C_d·A [m²] of each row."""
        r, said = self.recipe, heads.coefficients
        table_c_rr, table_cda = jnp.asarray(rows.c_rr), jnp.asarray(rows.cda_m2)
        if r.coefficients == "table":
            return table_c_rr, table_cda
        if r.coefficients == "bounded":
            # begins at the table, as the drag area does
            start = jnp.log(table_c_rr / (C_RR_LIMIT - table_c_rr))
            c_rr = C_RR_LIMIT * jax.nn.sigmoid(said[:, 0] + start)
            return c_rr, table_cda * jnp.clip(1.0 + said[:, 1], 1.0 - r.clamp, 1.0 + r.clamp)
        log = self.common[None] + _BY_ROW * said
        if r.by_vehicle:
            log = log + _of(self.own, rows.vehicle)
        return table_c_rr * jnp.exp(log[:, 0]), table_cda * jnp.exp(log[:, 1])

    def effects_of(self, rows: Rows) -> tuple[Effect, ...]:
        """The effects with the sizes that hold in each row."""
        made, n = [], rows.vehicle.shape[0]
        for e in self.effects:
            values: dict[str, Any] = {k: jnp.full(n, x, jnp.float32) for k, x in e.fixed}
            for p in e.kind.parameters:
                if (name := f"{e.kind.id}.{p.name}") in self.sizes:
                    size = jnp.broadcast_to(self.sizes[name], (n, *self.sizes[name].shape))
                    if self.recipe.by_vehicle:
                        size = size + _of(self.own_sizes[name], rows.vehicle)
                    value = (p.null + p.scale * size).astype(jnp.float32)
                    values[p.name] = Grouped(value, p.by) if p.by else value
            made.append(e.kind(**values))
        return tuple(made)

    def __call__(
        self, rows: Rows, memory: eqx.nn.State, *, key: PRNGKeyArray | None = None
    ) -> tuple[Prediction, Heads, eqx.nn.State]:
        """What it says of each row; with a `key` as in training."""
        r = self.recipe
        features = jnp.asarray(rows.features)
        heads, memory = self.network(features, memory, key=key)
        if self.coefficient_network is not None:
            at = jnp.array([i for i, n in enumerate(r.features) if n in PHYSICAL])
            other = None if key is None else jax.random.fold_in(key, 17)
            said, memory = self.coefficient_network(features[:, at], memory, key=other)
            heads = Heads(heads.energy, said.coefficients)
        c_rr, cda = self.coefficients(heads, rows)
        law = energy if r.physics == "battery" else wheel_energy
        physics = law(with_coefficients(rows.car, c_rr, cda, *self.effects_of(rows)), rows.segments)
        if r.physics == "battery":  # at the wheels nothing is known of it
            physics = physics + rows.across_wh
        unit = jnp.asarray(rows.unit)
        residual = self.scale_wh * unit * heads.energy if r.energy_head else jnp.zeros_like(physics)
        tables = energy(rows.car, rows.segments) + rows.across_wh
        base = {"residual": physics, "alone": self.mean_wh * unit, "table": tables}[r.predicted]
        floor, share = jnp.exp(self.noise[0]) * self.scale_wh, jnp.exp(self.noise[1])
        sd = jnp.sqrt(floor**2 + (share * physics) ** 2 + jnp.asarray(rows.loose_wh) ** 2)
        if r.loss == "squares":
            sd = jnp.full_like(sd, jnp.nan)
        return Prediction(base + residual, physics, residual, c_rr, cda, sd), heads, memory


def centred(table: Array) -> Array:
    """What each vehicle has of its own, about the mean. Were it not, the own parts could take all that the vehicles
    share and leave the common part, which is all that is known of an unseen vehicle, at the tables."""
    return table - jnp.mean(table, axis=0, keepdims=True)


def _of(table: Array, vehicle: Ids) -> Array:
    """The vehicle's own part; for one that was not trained on the middle one of the trained vehicles', which a few
    tables that are off otherwise than most do not move."""
    own = centred(table)
    middle = jnp.median(own, axis=0, keepdims=True)
    return jnp.concatenate([own, middle])[jnp.minimum(vehicle, table.shape[0])]


@eqx.filter_jit
def predict(model: Pinn, memory: eqx.nn.State, rows: Rows) -> Prediction:
    """The model as it is used: no dropout, running means. Its coefficients are those that hold in the row, with all its
    effects."""
    p = model(rows, memory)[0]
    if not model.effects:
        return p
    car = with_coefficients(rows.car, p.c_rr, p.cda_m2, *model.effects_of(rows))
    both = jax.vmap(coefficients_that_hold)(car, jax.tree.map(jnp.asarray, rows.segments))
    return eqx.tree_at(lambda p: (p.c_rr, p.cda_m2), p, both)


def ready(model: Pinn, memory: eqx.nn.State, like: Rows) -> Callable[[Rows], Prediction]:
    """`predict` for rows of the shape of `like`, a row at a time, where handing over numbers takes longest: the model's
    are compiled in, the row's columns go in as one array of their bytes.

    **Raises:** `ValueError`, of what is returned, for rows of another shape.
    """
    found, tree = jax.tree.flatten_with_path(like)
    leaves = [np.asarray(x) for _, x in found]
    ends = np.cumsum([x.nbytes for x in leaves]).tolist()
    # from node to node: to flatten a tree of modules takes as long as the network
    slots: dict[tuple[Any, ...], int] = {(): 0}
    steps: list[tuple[int, Callable[[Any], Any]]] = []
    for way, _ in found:
        for n in range(1, len(way) + 1):
            if way[:n] not in slots:
                slots[way[:n]] = len(slots)
                steps.append((slots[way[: n - 1]], _step(way[n - 1])))
    columns = [(slots[way], x.dtype) for (way, _), x in zip(found, leaves, strict=True)]

    # one row's products are too small to be worth waking another thread for
    @partial(jax.jit, compiler_options={"xla_cpu_multi_thread_eigen": False})
    def packed(data: Array) -> Prediction:
        parts = []
        for x, begin, end in zip(leaves, [0, *ends], ends, strict=False):
            part = data[begin:end].reshape((*x.shape, x.itemsize) if x.itemsize > 1 else x.shape)
            parts.append(jax.lax.bitcast_convert_type(part, x.dtype))
        return predict(model, memory, jax.tree.unflatten(tree, parts))

    def one(rows: Rows) -> Prediction:
        nodes: list[Any] = [rows]
        for parent, step in steps:
            nodes.append(step(nodes[parent]))
        data = b"".join([np.asarray(nodes[at], kind).tobytes() for at, kind in columns])
        if len(data) != ends[-1]:
            raise ValueError(f"rows of the shape that it was made ready for are expected ({len(like)} of them)")
        return packed(np.frombuffer(data, np.uint8))

    return one


def _step(key: Any) -> Callable[[Any], Any]:
    """From a node of a tree to what it holds under a key of `jax.tree.flatten_with_path`."""
    if isinstance(key, jax.tree_util.GetAttrKey):
        name, get = key.name, object.__getattribute__  # a module's own looks for methods first, which takes long
        return lambda node: get(node, name)
    return itemgetter(key.idx if isinstance(key, jax.tree_util.SequenceKey) else key.key)
