"""The kernel's Jacobian as a design matrix: where it is linearised, one set of coefficients or one of each group."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from hdev_jax.inference.calibrate import STUDENT_DF, Calibration, Fit, inside, tabular
from hdev_jax.inference.clusters import clustered
from hdev_jax.inference.linear import LEAST_ROWS, Posterior, Prior, Statistics, posterior, statistics
from hdev_jax.inference.parameters import ParameterTable, insert, insert_by
from hdev_jax.physics import Vehicle
from hdev_jax.segments import Segments
from hdev_jax.targets import TargetName

__all__ = ["GROUP", "LinearFit", "Rows", "design", "linear_fit", "supported", "tabular"]

GROUP = "coefficient_group"  # the channel that says which group's coefficients hold for a row
PASSES = 8  # a kernel that is linear needs two, the second to see that it is
ROBUST_PASSES = 24  # an outlier's weight falls by a factor a pass, with the noise that it is measured by
LEAST_NOISE = 1e-5  # of what a usual change of the most influential coefficient changes in a row
SETTLED = 0.01  # relative change of the noise
ENOUGH = 0.02  # posterior sds: a step that is shorter changes nothing that anyone would report


@dataclass(frozen=True)
class Rows:
    """A piece of a log, padded: its rows, the cluster of each, and (for coefficients by group) the group of each."""

    fit: Fit
    cluster: Int[np.ndarray, " row"]
    group: Int[np.ndarray, " row"] | None = None


@dataclass(frozen=True)
class LinearFit:
    """A posterior in closed form, and where it stands: `at` is the point of linearisation, in the table's units.

    `posterior`, `prior` and `statistics` are in units of the table's sds from `at`; each has a leading axis of groups
    where coefficients have groups. `moved` is how far the last linearisation moved the mean, in posterior sds: above
    `ENOUGH` the kernel was not linear enough and `converged` is false.
    """

    table: ParameterTable
    at: Float[np.ndarray, "*group k"]
    scale: Float[np.ndarray, " k"]
    prior: Prior
    statistics: Statistics
    posterior: Posterior
    inflation: float
    moved: float
    passes: int

    @property
    def converged(self) -> bool:
        """Whether another linearisation would change nothing."""
        return self.moved <= ENOUGH

    @property
    def values(self) -> Float[np.ndarray, "*group k"]:
        """Posterior means in the table's units."""
        return self.at + self.scale * np.asarray(self.posterior.mean)

    @property
    def sd(self) -> Float[np.ndarray, "*group k"]:
        """Posterior standard deviations in the table's units."""
        return self.scale * np.asarray(self.posterior.sd)

    @property
    def covariance(self) -> Float[np.ndarray, "*group k k"]:
        """Posterior covariance in the table's units."""
        return np.asarray(self.posterior.covariance) * np.outer(self.scale, self.scale)

    @property
    def table_names(self) -> list[str]:
        """Names of the coefficients."""
        return [c.name for c in self.table.free]

    @property
    def tabular_sd(self) -> Float[np.ndarray, " k"]:
        """The tables' sds; of what has none, one so wide that it says nothing."""
        return tabular(self.table)[1]

    def draws(self, key: Array, count: int) -> tuple[Float[np.ndarray, "draw k"], Float[np.ndarray, " draw"]]:
        """Exact draws of the coefficients, in the table's units, and of the noise of a row."""
        theta, sigma = self.posterior.draws(key, count)
        return self.at + self.scale * np.asarray(theta), np.asarray(sigma)

    def calibration(self, vehicle: Vehicle, predicted: Float[np.ndarray, " row"]) -> Calibration:
        """The same as the other methods give it, one set of coefficients; `predicted` with them, on the rows."""
        message = "closed form" if self.converged else f"{self.passes} linearisations, and the last still moved it"
        fitted = self.table.insert(vehicle, self.values)
        sigma = float(self.posterior.sigma)
        return Calibration(
            fitted, self.table, self.values, self.sd, self.covariance, predicted, sigma, self.inflation,
            self.converged, message, self.passes,
        )  # fmt: skip


@eqx.filter_jit
def _design(vehicle: Vehicle, structure: Any, target: TargetName, segments: Segments, theta: Any, group: Any) -> Any:
    def column(step: Array) -> tuple[Array, Array]:
        if group is None:
            predicted = insert(vehicle, structure, theta + step).predict(segments, target)
        else:
            rows = segments.with_channels(**{GROUP: group.astype(theta.dtype)})
            predicted = insert_by(vehicle, structure, theta + step[None, :], GROUP).predict(rows, target)
        return predicted, predicted

    return jax.jacfwd(column, has_aux=True)(jnp.zeros(theta.shape[-1], dtype=theta.dtype))


def design(
    vehicle: Vehicle, table: ParameterTable, segments: Segments, target: TargetName, theta: Any, group: Any = None
) -> tuple[Float[Array, "row k"], Float[Array, " row"]]:
    """∂ predicted / ∂θ of each row's own coefficients, and what is predicted there.

    **Arguments:** `theta` `[k]`, or `[group k]` with the `group` of each row. Raises `ValueError` where a coefficient
    that acts across rows is asked for by group.
    """
    return _design(vehicle, table.structure, target, segments, jnp.asarray(theta, dtype=float), group)


def linear_fit(
    vehicle: Vehicle,
    table: ParameterTable,
    read: Callable[[], Iterable[Rows]],
    target: TargetName,
    *,
    clusters: int = 0,
    groups: int = 0,
    noise: float | None = None,
    robust: bool = False,
    passes: int | None = None,
    prior: tuple[Any, Any] | None = None,
) -> LinearFit:
    """The posterior of the table's free coefficients in closed form, from a log in pieces of any number.

    The kernel is linearised at the tables' values, then at the posterior's mean, until the mean stays: once for a
    kernel that is linear in them, a few times where an efficiency is free or its switch is crossed.

    **Arguments:** `read()` starts the log again and gives its pieces. `clusters`: how many there are; errors inside one
    are correlated, so each row counts for 1/`inflation` of one, as in `calibrate` (0: rows are independent). `groups`:
    a set of coefficients for each of so many groups (vehicles, trips), each with the same table (0: one set for all).
    `noise` of a row, where it is known about (counts for `LEAST_ROWS` rows); without it the residual's after the fit.
    `robust`: rows are weighted by a Student t of 4 degrees of freedom. `passes`: readings of the log at most (1: the
    kernel is taken as linear). `prior`: mean and sd `[group k]` of each group, where they are not the tables'.

    **Returns:** a `LinearFit`, always finite. Raises `ValueError` for a table without a free coefficient.
    """
    if not table.free:
        raise ValueError("no coefficient is free; give one an sd, or free it")
    value, scale = tabular(table)
    k, shape = len(value), (groups, len(value)) if groups else (len(value),)
    mean, sd = (np.broadcast_to(a, shape) for a in (prior or (value, scale)))
    at = supported(table, np.array(mean))
    first, believed, inflation, moved, sweep = None, noise, 1.0, np.inf, 0
    most = passes or (ROBUST_PASSES if robust else PASSES)
    for sweep in range(1, most + 1):
        cells = groups if groups else max(clusters, 1)
        tail = believed if robust and sweep > 1 else None  # in the first pass nothing is known of a row's noise
        summed = Statistics.zero(k, cells)
        for piece in read():
            summed = summed + _of_piece(vehicle, table, target, piece, at, scale, cells, bool(groups), tail)
        summed = _no_perfect_log(summed, scale, np.array([c.scale for c in table.free]))
        data = summed if groups else summed.total()
        if first is None:  # as against a perfect log
            first = _noise(data) if noise is None else noise
        believed = first if believed is None else believed
        step, last = jnp.zeros(shape), believed
        for _ in range(8):  # the noise, what clusters leave of a row, and the fit that both lead to
            if clusters > 1 and not groups:
                inflation = _inflation(summed, step, believed)
            before = Prior(
                jnp.asarray((mean - at) / scale), jnp.asarray((scale / sd)[..., None] ** 2 * np.eye(k)),
                jnp.full(shape[:-1], believed), jnp.full(shape[:-1], LEAST_ROWS),
            )  # fmt: skip
            counted = data.times(jnp.asarray(1.0 / inflation))
            result = jax.vmap(posterior)(before, counted) if groups else posterior(before, counted)
            step = result.mean
            old = believed
            if noise is None:
                believed = _noise(data.about(step), first)
            if abs(np.log(believed / old)) < 0.1 * SETTLED:
                break
        moved = float(jnp.max(jnp.abs(step) / result.sd)) if sweep > 1 else np.inf
        settled = not robust or (sweep > 2 and abs(np.log(believed / last)) < SETTLED)
        if (moved <= ENOUGH and settled) or sweep == most:
            break
        at = supported(table, at + scale * np.asarray(step))
    return LinearFit(table, at, scale, before, counted, result, inflation, 0.0 if most == 1 else moved, sweep)


def _of_piece(
    vehicle: Vehicle, table: ParameterTable, target: TargetName, piece: Rows, at: np.ndarray, scale: np.ndarray,
    cells: int, grouped: bool, tail: float | None,
) -> Statistics:  # fmt: skip
    """A piece's statistics by cluster, or by group."""
    fit, size = piece.fit, np.shape(piece.fit.weight)[0]

    def whole(ids: Any) -> Any:
        return np.concatenate([np.asarray(ids), np.zeros(size - fit.rows, dtype=int)]) if ids is not None else ids

    group = whole(piece.group) if grouped else None
    x, predicted = design(vehicle, table, fit.segments, target, at, group)
    r = jnp.asarray(fit.measured) - predicted
    weight = jnp.asarray(fit.weight) ** 2
    if tail is not None:
        weight = weight * (STUDENT_DF + 1.0) / (STUDENT_DF + (r / tail) ** 2)
    ids = group if grouped else (whole(piece.cluster) if cells > 1 else np.zeros(size, dtype=int))
    return statistics(x * jnp.asarray(scale)[None, :], r, fit.measured, weight, ids, cells)


@jax.jit
def _no_perfect_log(
    summed: Statistics, scale: Float[Any, " k"], unit: Float[Any, " k"]
) -> Statistics:  # fmt: skip
    """Rows with the noise that computed ones have: without any, the table's own width would go to 0 with the noise's,
    also of what the rows do not determine.
    """
    effect = jnp.einsum("...kk,k->...k", summed.gram, jnp.asarray(unit / scale) ** 2)
    least = (
        LEAST_NOISE**2 * jnp.sum(effect, axis=tuple(range(effect.ndim - 1))) / jnp.maximum(jnp.sum(summed.rows), 1.0)
    )
    return eqx.tree_at(lambda s: s.square, summed, summed.square + summed.rows * jnp.max(least))


def _noise(data: Statistics, first: float | None = None) -> float:
    """Noise of a row from what is left; of few rows also what the first look said."""
    square, rows = float(jnp.sum(data.square)), float(jnp.sum(data.rows))
    more = 0.0 if first is None else LEAST_ROWS * max(0.0, 1.0 - rows / (10.0 * data.moment.shape[-1]))
    return float(np.sqrt((square + more * (first or 0.0) ** 2) / max(rows + more, 1.0))) + 1e-9


def _inflation(summed: Statistics, step: Array, sigma: float) -> float:
    """How many rows of one cluster are worth one independent row."""
    left = summed.about(jnp.broadcast_to(step, summed.moment.shape))
    seen = np.asarray(left.rows) > 0
    nothing = np.full(step.shape[-1], np.inf)
    return (
        clustered(np.asarray(left.gram)[seen], np.asarray(left.moment)[seen], sigma, nothing)[1] if seen.any() else 1.0
    )


def supported(table: ParameterTable, theta: np.ndarray) -> np.ndarray:
    """The point `[*group k]` moved inside the support, where the kernel is finite and which a sheet may hold.

    The posterior itself is not cut.
    """
    out = np.array(theta, dtype=float)
    for k, c in enumerate(table.free):
        out[..., k] = np.vectorize(lambda v, c=c: inside(float(v), c.lower, c.upper))(out[..., k])
    return out
