"""Calibration: Levenberg-Marquardt on the kernel with tabular priors, errors clustered by trip."""

from dataclasses import dataclass
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from hdev_jax.inference.clusters import Clusters, clustered
from hdev_jax.inference.parameters import ParameterTable, insert
from hdev_jax.physics import Vehicle, derived
from hdev_jax.physics.vehicle import Target
from hdev_jax.segments import Segments

__all__ = [
    "STUDENT_DF", "WEAK", "Calibration", "Fit", "calibrate", "inside", "jacobian", "padded", "padded_rows", "predict",
    "tabular",
]  # fmt: skip

STUDENT_DF = 4.0  # Lange, Little and Taylor, JASA 84 (1989): degrees of freedom of a robust working model
WEAK = 1e3  # sd of what has no prior, in its own scales: keeps an empty direction solvable, moves nothing else


Real = Float[Array, " row"] | Float[np.ndarray, " row"]


class Fit(eqx.Module):
    """The rows of one problem, padded to a shape that others share. Rows past the log have weight 0."""

    segments: Segments
    measured: Real
    weight: Real
    rows: int


@dataclass(frozen=True)
class Calibration:
    """What a fit came to. `values`, `sd` and `covariance` follow `table.free`; `message` is the solver's own word."""

    vehicle: Vehicle
    table: ParameterTable
    values: Float[np.ndarray, " free"]
    sd: Float[np.ndarray, " free"]
    covariance: Float[np.ndarray, "free free"]
    predicted: Float[np.ndarray, " row"]
    sigma: float
    inflation: float
    converged: bool
    message: str
    steps: int

    def prior_z(self) -> Float[np.ndarray, " free"]:
        """How far each coefficient moved from its table, in its tabular sd; NaN without one."""
        prior = np.array([c.value for c in self.table.free])
        sd = np.array([np.nan if c.sd is None else c.sd for c in self.table.free], dtype=float)
        return (self.values - prior) / sd


def tabular(table: ParameterTable) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Values and sds that the free coefficients have before the log (`Coefficient.prior`); without an sd, `WEAK` of
    their scales."""
    priors = [(*c.prior, c.scale) for c in table.free]
    sd = [WEAK * scale if sd is None else sd for _, sd, scale in priors]
    return np.array([value for value, _, _ in priors], dtype=float), np.array(sd, dtype=float)


def padded_rows(n: int) -> int:
    """The next of eight shapes per octave, so that logs of like length share one compilation."""
    quantum = max(64, 2 ** max(int(np.ceil(np.log2(max(n, 1)))) - 3, 0))
    return int(np.ceil(n / quantum) * quantum)


def padded(segments: Segments, measured: np.ndarray, size: int | None = None) -> Fit:
    """Rows padded to `size` rows, by default to `padded_rows` of them. Raises `ValueError` where they do not fit."""
    n = len(segments)
    size = padded_rows(n) if size is None else size
    if size < n:
        raise ValueError(f"{n} rows do not fit into {size}; give a size of at least as many rows")
    extra = size - n

    def pad(x: Any, fill: Any = None) -> np.ndarray:
        x = np.asarray(x)
        return np.concatenate([x, np.full(extra, x[-1] if fill is None else fill, dtype=x.dtype)]) if extra else x

    out = jax.tree.map(pad, segments)
    # a trip of its own, standing still: finite everywhere, and no neighbour of a real row
    out = eqx.tree_at(
        lambda s: (s.trip, s.distance_m),
        out,
        (pad(segments.trip, fill=int(np.max(np.asarray(segments.trip))) + 1), pad(segments.distance_m, fill=0.0)),
    )
    out = jax.tree.map(np.asarray, derived(out))
    return Fit(out, pad(measured, fill=0.0), np.r_[np.ones(n), np.zeros(extra)], n)


def _to_support(z: Array, start: Any, scale: Any, structure: Any) -> Array:
    """From the solver's space to the coefficient's support; z = 0 is the start, slope `scale` there."""
    out = []
    for k, (_, _, lower, upper) in enumerate(structure):
        x0, s = start[k], scale[k]
        if np.isinf(lower) and np.isinf(upper):
            out.append(x0 + s * z[k])
        elif np.isinf(upper) or upper > 1e9:
            out.append(lower + (x0 - lower) * jnp.exp(s * z[k] / (x0 - lower)))
        else:
            u = (x0 - lower) / (upper - lower)
            logit = jnp.log(u) - jnp.log1p(-u)
            out.append(lower + (upper - lower) * jax.nn.sigmoid(logit + s * z[k] / ((upper - lower) * u * (1 - u))))
    return jnp.stack(out)


@eqx.filter_jit
def _solve(
    vehicle: Vehicle,
    structure: Any,
    target: Target,
    segments: Segments,
    measured: Any,
    weight: Any,
    start: Any,
    scale: Any,
    prior: Any,
    prior_sd: Any,
) -> Any:
    def residuals(z: Array, args: Any) -> Array:
        vehicle, segments, measured, weight = args
        theta = _to_support(z, start, scale, structure)
        r = weight * (insert(vehicle, structure, theta).predict(segments, target) - measured)
        return jnp.concatenate([r, (theta - prior) / prior_sd])

    solver = optx.LevenbergMarquardt(rtol=1e-6, atol=1e-4, linear_solver=lx.Normal(lx.Cholesky()))
    z0 = jnp.zeros_like(start)
    args = (vehicle, segments, measured, weight)
    sol = optx.least_squares(residuals, solver, z0, args=args, max_steps=50, throw=False)
    theta = _to_support(sol.value, start, scale, structure)
    predicted = insert(vehicle, structure, theta).predict(segments, target)
    return theta, predicted, sol.result, sol.stats["num_steps"]


@eqx.filter_jit
def _jacobian(vehicle: Vehicle, structure: Any, target: Target, segments: Segments, theta: Any) -> Array:
    def column(x: Array) -> Array:
        return insert(vehicle, structure, x).predict(segments, target)

    return jax.jacfwd(column)(theta)


def jacobian(
    vehicle: Vehicle, table: ParameterTable, segments: Segments, target: Target
) -> Float[np.ndarray, "row free"]:
    """∂ predicted / ∂θ of the free coefficients at their present values."""
    if not table.free:
        return np.zeros((len(segments), 0))
    return np.asarray(_jacobian(vehicle, table.structure, target, segments, jnp.asarray(table.values(vehicle))))


def calibrate(
    vehicle: Vehicle,
    table: ParameterTable,
    fit: Fit,
    target: Target,
    clusters: Clusters,
    *,
    noise: Literal["normal", "student_t"] = "normal",
    weights: Float[np.ndarray, " row"] | None = None,
) -> Calibration:
    """Maximum a posteriori values of the table's free coefficients.

    Errors inside a cluster are correlated, so rows are not independent evidence against a tabular prior: the
    likelihood counts 1/`inflation` of each row, where `inflation` is the ratio of clustered to naive variance of the
    estimates. Standard errors are clustered (jackknife over clusters; MacKinnon, Nielsen and Webb 2023).

    **Arguments:** `fit` from `padded`; `clusters` of its real rows; `noise`: "student_t" reweights rows by a
    t-distribution with 4 degrees of freedom, for logs with outliers; `weights` (real rows) multiply residuals.

    **Returns:** a `Calibration`, whose `converged` and `message` its caller reads. Coefficients that are not free are
    kept.
    """
    rows, free = fit.rows, table.free
    base = np.ones(rows) if weights is None else np.asarray(weights, dtype=float)
    measured = np.asarray(fit.measured)[:rows]
    theta = table.values(vehicle)
    if not free:
        predicted = np.asarray(predict(vehicle, fit.segments, target))[:rows]
        sigma = float(np.sqrt(np.mean((base * (measured - predicted)) ** 2)))
        none = np.zeros((0, 0))
        return Calibration(vehicle, table, theta, theta, none, predicted, sigma, 1.0, True, "nothing to estimate", 0)

    scale = np.array([c.scale for c in free])
    prior, prior_sd = tabular(table)
    theta = np.array([inside(x, c.lower, c.upper) for x, c in zip(theta, free, strict=True)])
    structure = table.structure

    sigma, inflation, tail = 1.0, 1.0, np.ones(rows)
    message, converged, steps = "", False, 0
    predicted = np.zeros(rows)
    covariance = np.diag(prior_sd**2)  # of a fit that ends before it has looked
    for sweep in range(8 if noise == "student_t" else 3):
        if sweep == 0:  # the first sweep only looks for σ: the prior weighs as against a perfect log
            p = np.asarray(predict(insert(vehicle, structure, jnp.asarray(theta)), fit.segments, target))[:rows]
            sigma = float(np.sqrt(np.mean((base * (measured - p)) ** 2))) + 1e-12
        row_weight = np.zeros(np.shape(fit.weight)[0])
        row_weight[:rows] = base * np.sqrt(tail / inflation) / sigma
        rows_of = (fit.segments, fit.measured, row_weight)  # not `fit`, whose number of real rows would be compiled in
        start = jnp.asarray(theta)
        new, p, result, taken = _solve(vehicle, structure, target, *rows_of, start, scale, prior, prior_sd)
        if not (np.isfinite(sigma) and np.all(np.isfinite(new)) and np.all(np.isfinite(p))):
            message, converged = "left the finite numbers; start nearer or give a prior", False
            break
        predicted, steps = np.asarray(p)[:rows], steps + int(taken)
        converged = bool(result == optx.RESULTS.successful)
        message = "converged" if converged else str(optx.RESULTS[result]).strip() or "did not converge"
        change = np.max(np.abs(np.asarray(new) - theta) / scale)
        theta = np.asarray(new)
        r = base * (measured - predicted)
        if noise == "student_t":
            tail = (STUDENT_DF + 1.0) / (STUDENT_DF + (r / sigma) ** 2)
            new_sigma = float(np.sqrt(np.mean(tail * r**2))) + 1e-12
        else:
            new_sigma = float(np.sqrt(np.mean(r**2))) + 1e-12
        jac = np.asarray(_jacobian(vehicle, structure, target, fit.segments, jnp.asarray(theta)))[:rows]
        w = np.sqrt(tail)[:, None] * base[:, None]
        grams, scores = clusters.grams(w * jac), clusters.sums(w * jac * (np.sqrt(tail) * r)[:, None])
        covariance, new_inflation = clustered(grams, scores, new_sigma, prior_sd)
        if noise == "student_t":
            settled = abs(np.log(new_sigma / sigma)) < 1e-3 and change < 1e-4
        else:  # new weights of the likelihood move the optimum only as far as the prior pulls on it
            pull = np.abs(1.0 - (sigma**2 * inflation) / (new_sigma**2 * new_inflation)) * (theta - prior) / prior_sd**2
            settled = bool(np.all(np.abs(covariance @ pull) < 0.01 * np.sqrt(np.diag(covariance))))
        sigma, inflation = new_sigma, new_inflation
        if settled:
            break

    fitted = table.insert(vehicle, jnp.asarray(theta))
    sd = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    return Calibration(fitted, table, theta, sd, covariance, predicted, sigma, inflation, converged, message, steps)


def inside(x: float, lower: float, upper: float) -> float:
    """A start inside the support, off its edges, where the solver's transform has no slope."""
    if np.isinf(lower) and np.isinf(upper):
        return x
    if np.isinf(upper) or upper > 1e9:
        return max(x, lower + 1e-6 * max(1.0, abs(lower)))
    edge = 1e-3 * (upper - lower)
    return float(np.clip(x, lower + edge, upper - edge))


@eqx.filter_jit
def predict(vehicle: Vehicle, segments: Segments, target: Target) -> Array:
    """The target's column on every row of `segments`, in its unit; one compiled program for each padded shape."""
    return vehicle.predict(segments, target)
