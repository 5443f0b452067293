"""A vehicle with the uncertainty of its coefficients: calibrated on a log, or as a fit before has left it."""

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy import stats

from hdev_jax.inference import Spread, calibrate, cluster_rows, covariance_root, left_out, padded
from hdev_jax.inference import predict as predict_rows
from hdev_jax.inference.calibrate import inside
from hdev_jax.inference.sheet import Sheet
from hdev_jax.physics import Vehicle
from hdev_jax.problem import Problem
from hdev_jax.targets import TARGETS

__all__ = ["DRAWS", "LEVEL", "WIDE", "Fitted", "calibrated_on", "forgotten", "interval"]

DRAWS = 256  # points of a Sobol sequence: quantiles of 5 and 95 % are within about 2 % of a standard deviation
WIDE = 0.5  # sd over value of a coefficient of which nothing is to be known before the log
LEVEL = 0.9  # probability inside every interval


@dataclass(frozen=True)
class Fitted:
    """A vehicle at its estimates and what they leave open.

    `covariance` of the table's free coefficients, known to `freedom` degrees of freedom; `spread`, the noise of rows
    and trips, None where the log does not measure the target and no fit has left it; `how`, where the estimates come
    from, in a sentence; `notes` for the user; `compute`, as in `Problem.predict`.
    """

    problem: Problem
    vehicle: Vehicle
    covariance: Float[np.ndarray, "free free"]
    freedom: float
    spread: Spread | None
    how: str
    notes: tuple[str, ...] = ()
    compute: Callable[..., Any] = predict_rows

    @property
    def values(self) -> Float[np.ndarray, " free"]:
        """The free coefficients at their estimates."""
        return self.problem.table.values(self.vehicle)

    def draws(self, seed: int, count: int = DRAWS) -> Float[np.ndarray, "draw free"]:
        """Coefficients: the estimates, then draws of a multivariate Student t, inside their supports.

        Quasi-random (scrambled Sobol), so that few draws have steady quantiles; one more dimension than coefficients
        for the t's common scale.
        """
        free, at = self.problem.table.free, self.values
        if not free:
            return at[None, :]
        u = stats.qmc.Sobol(len(free) + 1, rng=np.random.default_rng(seed)).random(count)
        u = np.clip(u, 1e-9, 1.0 - 1e-9)
        z = stats.norm.ppf(u[:, 1:]) @ covariance_root(self.covariance).T
        scale = np.sqrt(self.freedom / stats.chi2.ppf(u[:, :1], self.freedom))
        drawn = at + scale * z
        inner = [[inside(float(x), c.lower, c.upper) for x, c in zip(row, free, strict=True)] for row in drawn]
        return np.concatenate([at[None, :], np.asarray(inner)])

    def by_trip(self, column: Float[np.ndarray, " row"]) -> Float[np.ndarray, " trip"]:
        """Sums over the trips of the log of a column in the target's unit [kWh]."""
        problem = self.problem
        weight = problem.weight() / (TARGETS[problem.target].per_kwh or 1.0)
        return np.bincount(problem.log.trip, weights=weight * column, minlength=len(problem.log.trip_names))

    def noise_kwh(self) -> Float[np.ndarray, " trip"]:
        """Standard deviation of the measured energy of each trip about the model [kWh]; 0 where it is not known."""
        if self.spread is None:
            return np.zeros(len(self.problem.log.trip_names))
        problem, s = self.problem, self.spread
        each = np.sqrt(s.scale**2 + (s.growth * self.predicted) ** 2)
        alone = self.by_trip(problem.weight() * each**2) / (TARGETS[problem.target].per_kwh or 1.0)
        return np.sqrt(s.together * alone + (s.level * self.by_trip(each)) ** 2)

    @cached_property
    def predicted(self) -> Float[np.ndarray, " row"]:
        """The target's column at the estimates."""
        return self.problem.predict(self.vehicle, compute=self.compute)


def calibrated_on(problem: Problem, trips: Sequence[int] | None = None) -> Fitted:
    """The vehicle calibrated on these trips of the log, all by default.

    Degrees of freedom are those of the clusters: trips, or blocks where there are few trips.
    """
    used = np.ones(len(problem.log), bool) if trips is None else problem.rows(trips)
    segments = problem.segments.take(used)
    rows, clusters = padded(segments, problem.measured[used]), cluster_rows(segments)
    fit = calibrate(problem.vehicle, problem.table, rows, problem.target, clusters)
    spread, _ = left_out(fit, rows, problem.target, problem.weight()[used])
    count = len(np.unique(problem.log.trip[used]))
    how = f"calibrated on {count} trip{'s' if count > 1 else ''} of this log"
    notes = () if fit.converged else (f"the calibration stopped early: {fit.message}",)
    if not problem.table.free:
        how = "every coefficient of the sheet is known: nothing was calibrated"
    fitted = Fitted(
        problem, fit.vehicle, fit.covariance, max(clusters.count - 1.0, 2.0), spread, how, (*problem.notes, *notes)
    )
    return fitted if problem.table.free else replace(fitted, covariance=np.zeros((0, 0)))


def forgotten(sheet: Sheet) -> tuple[Sheet, list[str]]:
    """The sheet with estimates that came from a log, perhaps from this very one, as rough values: half of each is its
    sd, so that a calibration decides by its own trips; and a note that says so."""
    declared, names = dict(sheet.declared), []
    for path, d in sheet.declared.items():
        if d.estimated and (d.sd is not None or d.groups):
            groups = {k: (x, _rough(x, sd)) for k, (x, sd) in d.groups.items()}
            declared[path] = replace(d, sd=_rough(d.value, d.sd), groups=groups)
            names.append(path)
    other = copy.copy(sheet)
    other.declared = declared
    what = f"{', '.join(names)} of the sheet came from a log: estimated anew from these trips alone"
    return (other, [what]) if names else (sheet, [])


def _rough(value: float, sd: float | None) -> float | None:
    return None if sd is None else max(WIDE * abs(value), sd)


def interval(drawn: Float[np.ndarray, "draw *rest"], level: float = LEVEL) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper end of the central interval of draws (first axis)."""
    low, high = np.quantile(drawn, [0.5 - level / 2, 0.5 + level / 2], axis=0)
    return np.asarray(low), np.asarray(high)
