"""Calibration: Levenberg-Marquardt on the kernel's Jacobian with tabular priors, errors clustered by trip.

The Jacobian and the prediction of a chunk of rows are one compiled program; the steps are taken on normal equations,
which add up over chunks.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hdev_jax.inference.clusters import Clusters, clustered
from hdev_jax.inference.parameters import ParameterTable, insert
from hdev_jax.inference.rows import Chunk, Fit, Shapes, chunks_of_fit, padded, padded_rows
from hdev_jax.physics import Vehicle
from hdev_jax.segments import Segments, trip_slices
from hdev_jax.targets import TargetName

__all__ = [
    "STUDENT_DF", "WEAK", "Calibration", "Fit", "Linearise", "calibrate", "inside", "jacobian", "linearised", "padded",
    "padded_rows", "predict", "tabular",
]  # fmt: skip

STUDENT_DF = 4.0  # Lange, Little and Taylor, JASA 84 (1989): degrees of freedom of a robust working model
WEAK = 1e3  # sd of what has no prior, in its own scales: keeps an empty direction solvable, moves nothing else
MOST_STEPS = 50
SETTLED = 1e-3  # standard errors that a further step would move the estimate by
LEAST_GAIN = 1e-3  # of a whole step, in log-likelihood: 0.04 standard errors
NO_GAIN = 1e-6  # expected gain below which a failed step is not shortened any more
FEW_GAINS = 4  # successful steps in a row below `LEAST_GAIN` that end a fit: at a kink each gains less than the last
# Damping of the first step, and its least; of the one after the first that fails; how much faster it grows with each
# failure. After a step that succeeds it falls by how well the gain was foreseen (after Nielsen, Technical University of
# Denmark, IMM-REP-1999-05).
UNDAMPED, LEAST_DAMPED, DAMPED, GROWTH = 1e-9, 1e-12, 1e-2, 4.0
UNBOUNDED = 1e9  # a bound beyond it is none


@dataclass(frozen=True)
class Calibration:
    """What a fit came to. `values`, `sd` and `covariance` follow `table.free`; `message` says how the solver ended."""

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

    @property
    def errors(self) -> Float[np.ndarray, " free"]:
        """Standard errors; of coefficients known by generalised least squares no smaller than theirs."""
        return np.maximum(self.sd, [c.known[1] if c.known else 0.0 for c in self.table.free])

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


def _jacobian_of(structure: Any, start: np.ndarray, scale: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """From the solver's space to the coefficients' supports: values, and their slopes dθ/dz.

    z = 0 is the start, with slope `scale` there; a coefficient bounded on one side moves by its logarithm, one that is
    bounded on both by its logit.
    """
    theta, slope = np.empty(len(z)), np.empty(len(z))
    for k, (_, _, lower, upper) in enumerate(structure):
        x0, s = start[k], scale[k]
        if np.isinf(lower) and np.isinf(upper):
            theta[k], slope[k] = x0 + s * z[k], s
        elif np.isinf(upper) or upper > UNBOUNDED:
            theta[k] = lower + (x0 - lower) * np.exp(np.clip(s * z[k] / (x0 - lower), -50.0, 50.0))
            slope[k] = s * (theta[k] - lower) / (x0 - lower)
        else:
            width, u = upper - lower, (x0 - lower) / (upper - lower)
            rate = s / (width * u * (1 - u))
            share = 1.0 / (1.0 + np.exp(-np.clip(np.log(u) - np.log1p(-u) + rate * z[k], -50.0, 50.0)))
            theta[k], slope[k] = lower + width * share, width * share * (1 - share) * rate
    return theta, slope


@eqx.filter_jit
def _linearised(
    vehicle: Vehicle, structure: Any, target: TargetName, segments: Segments, theta: Any
) -> tuple[Array, Array]:
    """The prediction, and its derivatives [free, row], which `jax.jacfwd` would transpose."""
    value, push = jax.linearize(lambda x: insert(vehicle, structure, x).predict(segments, target), theta)
    return value, jax.vmap(push)(jnp.eye(len(theta), dtype=theta.dtype))


def linearised(
    vehicle: Vehicle, table: ParameterTable, segments: Segments, target: TargetName, theta: Any = None
) -> tuple[Float[np.ndarray, " row"], Float[np.ndarray, "row free"]]:
    """The prediction and its derivative in the free coefficients, at their present values or at `theta`."""
    if not table.free:
        return np.asarray(predict(vehicle, segments, target)), np.zeros((len(segments), 0))
    at = np.asarray(table.values(vehicle) if theta is None else theta)
    # in an order of their own, so that tables of the same coefficients share a program
    places = [(c.path, c.group) for c in table.free]
    order = np.array(sorted(range(len(places)), key=lambda k: (places[k][0], places[k][1] or 0)))
    structure = tuple((*places[k], -np.inf, np.inf) for k in order)
    value, slopes = _linearised(vehicle, structure, target, segments, jnp.asarray(at[order]))
    return np.asarray(value), np.asarray(slopes)[np.argsort(order)].T


Linearise = Callable[..., tuple[np.ndarray, np.ndarray]]  # `linearised`, or what takes and gives the same


def jacobian(
    vehicle: Vehicle, table: ParameterTable, segments: Segments, target: TargetName
) -> Float[np.ndarray, "row free"]:
    """∂ predicted / ∂θ of the free coefficients at their present values."""
    return linearised(vehicle, table, segments, target)[1]


@dataclass(frozen=True)
class _Point:
    """Where the solver stands: coefficients, the rows' predictions and Jacobian there."""

    theta: Float[np.ndarray, " free"]
    predicted: Float[np.ndarray, " row"]
    slopes: Float[np.ndarray, "row free"]

    @property
    def finite(self) -> bool:
        return bool(np.all(np.isfinite(self.predicted)) and np.all(np.isfinite(self.slopes)))


@dataclass(frozen=True)
class _Problem:
    """What stays the same while the solver moves."""

    vehicle: Vehicle
    table: ParameterTable
    chunks: Sequence[Chunk]
    target: TargetName
    measured: Float[np.ndarray, " row"]
    prior: Float[np.ndarray, " free"]
    prior_sd: Float[np.ndarray, " free"]
    scale: Float[np.ndarray, " free"]
    linearise: Linearise

    def at(self, theta: Float[np.ndarray, " free"]) -> _Point:
        """The rows linearised at these coefficients."""
        predicted = np.empty(len(self.measured))
        slopes = np.empty((len(self.measured), len(theta)))
        for chunk in self.chunks:
            value, slope = self.linearise(self.vehicle, self.table, chunk.segments, self.target, theta)
            predicted[chunk.at], slopes[chunk.at] = value[: chunk.rows], slope[: chunk.rows]
        return _Point(theta, predicted, slopes)

    def cost(self, point: _Point, weight: Float[np.ndarray, " row"]) -> float:
        """Half the sum of squares, of rows and of the prior; infinite where a prediction is no number."""
        rows = weight * (self.measured - point.predicted)
        total = 0.5 * float(rows @ rows) + 0.5 * float(np.sum(((point.theta - self.prior) / self.prior_sd) ** 2))
        return total if np.isfinite(total) else np.inf

    def solve(self, point: _Point, weight: Float[np.ndarray, " row"]) -> tuple[_Point, bool, str, int]:
        """Levenberg-Marquardt (Marquardt, SIAM J. Appl. Math. 11, 1963) from a point.

        **Returns:** where it ends, whether it settled, a word on it, and the steps that it took.
        """
        structure, start = self.table.structure, point.theta.copy()
        for k, (_, _, lower, upper) in enumerate(structure):
            edge = 1e-9 * (upper - lower) if np.isfinite(upper - lower) and upper <= UNBOUNDED else 0.0
            if not lower + edge < start[k] < upper - edge:  # where the round before ended the transform has no slope
                start[k] = inside(start[k], lower, upper)
        if np.any(start != point.theta):
            point = self.at(start)
        z, damping, growth, cost = np.zeros(len(start)), UNDAMPED, GROWTH, self.cost(point, weight)
        few = 0  # steps in a row that gained little
        precision = 1.0 / self.prior_sd**2
        for step in range(1, MOST_STEPS + 1):
            _, slope = _jacobian_of(structure, start, self.scale, z)
            weighed = weight[:, None] * point.slopes
            hessian = (weighed.T @ weighed + np.diag(precision)) * np.outer(slope, slope)
            pull = precision * (point.theta - self.prior)
            gradient = slope * (weighed.T @ (weight * (self.measured - point.predicted)) - pull)
            d = np.sqrt(np.maximum(np.diag(hessian), 1e-300))
            scaled, right = hessian / np.outer(d, d), gradient / d
            try:
                newton = np.linalg.solve(scaled + 1e-12 * np.eye(len(d)), right)
                # what a whole step would gain: in standard errors, the distance to the optimum
                if np.sqrt(max(float(newton @ right), 0.0)) < SETTLED:
                    return point, True, "converged", step - 1
                move = np.linalg.solve(scaled + damping * np.eye(len(d)), right) / d
            except np.linalg.LinAlgError:
                return point, False, "the normal equations are singular; give the coefficients priors", step
            expected = float(move @ gradient - 0.5 * move @ hessian @ move)
            trial = self.at(_jacobian_of(structure, start, self.scale, z + move)[0])
            cost_there = self.cost(trial, weight) if trial.finite else np.inf
            if cost_there < cost:
                gained = cost - cost_there
                foreseen = 2.0 * min(gained / max(expected, 1e-300), 1.0) - 1.0
                whole = expected > 0.25 * float(newton @ right)  # half of what the step would gain without damping
                point, z, cost = trial, z + move, cost_there
                damping, growth = max(damping * max(0.1, 1.0 - foreseen**3), LEAST_DAMPED), GROWTH
                few = few + 1 if gained < LEAST_GAIN else 0
                if few and ((whole and foreseen > 0.0) or few == FEW_GAINS):
                    return point, True, "converged", step
            else:
                if expected < NO_GAIN:
                    return point, True, "converged", step
                damping, growth = max(damping * growth, DAMPED), growth * GROWTH
        return point, False, f"stopped after {MOST_STEPS} steps; start nearer or give a prior", MOST_STEPS


def calibrate(
    vehicle: Vehicle,
    table: ParameterTable,
    fit: Fit,
    target: TargetName,
    clusters: Clusters,
    *,
    noise: Literal["normal", "student_t"] = "normal",
    weights: Float[np.ndarray, " row"] | None = None,
    chunks: Sequence[Chunk] | None = None,
    linearise: Linearise = linearised,
) -> Calibration:
    """Maximum a posteriori values of the table's free coefficients.

    Errors inside a cluster are correlated, so rows are not independent evidence against a tabular prior: the
    likelihood counts 1/`inflation` of each row, where `inflation` is the ratio of clustered to naive variance of the
    estimates. Standard errors are clustered (jackknife over clusters; MacKinnon, Nielsen and Webb 2023).

    **Arguments:** `fit` from `padded`; `clusters` of its real rows; `noise`: "student_t" reweights rows by a
    t-distribution with 4 degrees of freedom, for logs with outliers; `weights` (real rows) multiply residuals;
    `chunks`, the rows of `fit` in chunks, where they have been made already; `linearise`, what gives predictions and
    Jacobians.

    **Returns:** a `Calibration`, whose `converged` and `message` its caller reads. Coefficients that are not free are
    kept.
    """
    rows, free = fit.rows, table.free
    base = np.ones(rows) if weights is None else np.asarray(weights, dtype=float)
    measured = np.asarray(fit.measured)[:rows]
    theta = table.values(vehicle)
    if chunks is None:
        longest = max(s.stop - s.start for _, s in trip_slices(np.asarray(fit.segments.trip)[:rows]))
        chunks = list(chunks_of_fit(fit, Shapes(rows, longest)))
    if free:
        prior, prior_sd = tabular(table)
        theta = np.array([inside(x, c.lower, c.upper) for x, c in zip(theta, free, strict=True)])
    else:
        prior = prior_sd = np.zeros(0)
    scale = np.array([c.scale for c in free])
    problem = _Problem(vehicle, table, chunks, target, measured, prior, prior_sd, scale, linearise)
    point = problem.at(theta)
    sigma = float(np.sqrt(np.mean((base * (measured - point.predicted)) ** 2)))
    if not free:
        none = np.zeros((0, 0))
        return Calibration(
            vehicle, table, theta, theta, none, point.predicted, sigma, 1.0, True, "nothing to estimate", 0
        )
    sigma += 1e-12
    inflation, tail, steps = 1.0, np.ones(rows), 0
    message, converged = "values are no longer finite; start nearer or give a prior", False
    covariance = np.diag(prior_sd**2)  # of a fit that ends before it has looked
    for _ in range(8 if noise == "student_t" else 3):
        if not (np.isfinite(sigma) and point.finite):
            break
        before = point.theta
        point, converged, message, taken = problem.solve(point, base * np.sqrt(tail / inflation) / sigma)
        steps += taken
        change = np.max(np.abs(point.theta - before) / scale)
        r = base * (measured - point.predicted)
        if noise == "student_t":
            tail = (STUDENT_DF + 1.0) / (STUDENT_DF + (r / sigma) ** 2)
            new_sigma = float(np.sqrt(np.mean(tail * r**2))) + 1e-12
        else:
            new_sigma = float(np.sqrt(np.mean(r**2))) + 1e-12
        weighed = (np.sqrt(tail) * base)[:, None] * point.slopes
        grams, scores = clusters.grams(weighed), clusters.sums(weighed * (np.sqrt(tail) * r)[:, None])
        covariance, new_inflation = clustered(grams, scores, new_sigma, prior_sd)
        if noise == "student_t":
            settled = abs(np.log(new_sigma / sigma)) < 1e-3 and change < 1e-4
        else:  # new weights of the likelihood move the optimum only as far as the prior pulls on it
            pull = np.abs(1.0 - (sigma**2 * inflation) / (new_sigma**2 * new_inflation))
            pull = pull * (point.theta - prior) / prior_sd**2
            settled = bool(np.all(np.abs(covariance @ pull) < 0.01 * np.sqrt(np.diag(covariance))))
        # the steps ended by what they gain over the noise before: with less than half of it they may have ended early
        settled = settled and sigma**2 * inflation < 4.0 * new_sigma**2 * new_inflation
        sigma, inflation = new_sigma, new_inflation
        if settled:
            break

    fitted = table.insert(vehicle, jnp.asarray(point.theta))
    sd = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    return Calibration(
        fitted, table, point.theta, sd, covariance, point.predicted, sigma, inflation, converged, message, steps
    )


def inside(x: float, lower: float, upper: float) -> float:
    """A start inside the support, off its edges, where the solver's transform has no slope."""
    if np.isinf(lower) and np.isinf(upper):
        return x
    if np.isinf(upper) or upper > 1e9:
        return max(x, lower + 1e-6 * max(1.0, abs(lower)))
    edge = 1e-3 * (upper - lower)
    return float(np.clip(x, lower + edge, upper - edge))


@eqx.filter_jit
def predict(vehicle: Vehicle, segments: Segments, target: TargetName) -> Array:
    """The target's column on every row of `segments`, in its unit; one compiled program for each padded shape."""
    return vehicle.predict(segments, target)
