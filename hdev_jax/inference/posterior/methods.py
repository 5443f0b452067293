"""Calibration by one of three methods, as the verbs ask for it: `map`, `linear` (closed form), `nuts` (draws)."""

from dataclasses import dataclass, replace
from typing import Any, Literal

import jax
import numpy as np
from jaxtyping import Float

from hdev_jax.inference.calibrate import Calibration, Fit, calibrate, predict
from hdev_jax.inference.clusters import Clusters
from hdev_jax.inference.design import LinearFit, Rows, design, linear_fit, supported
from hdev_jax.inference.identified import caveats
from hdev_jax.inference.parameters import ParameterTable
from hdev_jax.inference.posterior.draws import Draws
from hdev_jax.inference.posterior.hierarchy import fleet_draws
from hdev_jax.inference.posterior.models import Model
from hdev_jax.inference.posterior.nuts import sampled
from hdev_jax.physics import Grouped, Vehicle
from hdev_jax.targets import TargetName

__all__ = ["METHODS", "Method", "Outcome", "calibrated", "is_linear", "one_of_each"]

Method = Literal["map", "linear", "nuts"]
METHODS: tuple[Method, ...] = ("map", "linear", "nuts")
CHAINS, DRAWS = 4, 1000
BENT = 0.1  # of the noise of a row: a line that is off by less is a line


@dataclass(frozen=True)
class Outcome:
    """A calibration with what its method says besides: `notes`, and `draws` where there are any.

    `good`: whether the answer may be called one; the notes say why not.
    """

    fit: Calibration
    notes: list[str]
    draws: Draws | None = None
    good: bool = True


def calibrated(
    vehicle: Vehicle,
    table: ParameterTable,
    fit: Fit,
    target: TargetName,
    clusters: Clusters,
    method: Method,
    *,
    noise: Literal["normal", "student_t"] = "normal",
    vehicles: int = 1,
    seed: int = 0,
    chains: int = CHAINS,
    draws: int = DRAWS,
) -> Outcome:
    """The table's free coefficients by one of `METHODS`.

    `nuts` draws from sufficient statistics wherever the noise is normal and the kernel a line in the coefficients over
    what they leave open (`is_linear`), and by NUTS on every row otherwise; its notes say which. Errors inside a cluster
    are correlated: with every method a row counts for 1/`inflation` of one. Coefficients that the sheet has per vehicle
    resemble each other (partial pooling) where all free ones are per vehicle.
    """
    line = linear_fit(
        vehicle, table, lambda: [Rows(fit, clusters.ids)], target, clusters=clusters.count, robust=noise == "student_t"
    )
    if method == "map":
        found = calibrate(vehicle, table, fit, target, clusters, noise=noise)
        return Outcome(found, caveats(line), good=found.converged)
    values = supported(table, line.values)
    outside = [c.name for v, w, c in zip(values, line.values, table.free, strict=True) if v != w]
    car = table.insert(vehicle, values)
    predicted = np.asarray(predict(car, fit.segments, target))[: fit.rows]
    found = replace(line.calibration(vehicle, predicted), vehicle=car, values=values)
    notes = caveats(line)
    if outside:
        notes.append(
            f"{', '.join(outside)}: the closed form, which has no bounds, ends outside the range and is set to its "
            "edge; compare with --method map, and check the tables"
        )
    if not line.converged:
        notes.append(f"the closed form is not exact here: {found.message}; compare with --method map")
    if method == "linear":
        how = f"closed form on sufficient statistics of {fit.rows:,} rows, linearised {line.passes} times"
        return Outcome(found, [how, *notes], good=line.converged and not outside)
    return _drawn(vehicle, table, fit, target, line, found, notes, noise, vehicles, seed, chains, draws)


def _drawn(
    vehicle: Vehicle, table: ParameterTable, fit: Fit, target: TargetName, line: LinearFit, found: Calibration,
    notes: list[str], noise: str, vehicles: int, seed: int, chains: int, draws: int,
) -> Outcome:  # fmt: skip
    """By drawing: the fleet's or the one vehicle's posterior, from statistics or from rows."""
    key = jax.random.key(seed)
    single = one_of_each(vehicle, table)
    pooled = single is not None and vehicles > 1
    if not pooled and any(c.group is not None and c.free for c in table.rows):
        notes = [
            *notes,
            "some free coefficients are per vehicle and some are not: each has its own prior, none is pooled",
        ]
    reach = 3.0 * line.sd  # draws of the closed form know no bounds
    free = all(c.lower < low and high < c.upper for c, low, high in
               zip(table.free, line.values - reach, line.values + reach, strict=True))  # fmt: skip
    straight = free and noise == "normal" and line.converged and is_linear(vehicle, table, fit, target, line)
    sigma = float(np.mean(np.asarray(line.posterior.sigma)))
    if pooled:
        assert single is not None
        own = np.asarray(fit.segments.vehicle)[: fit.rows].astype(int)
        one, one_table = single
        worth = replace_weight(fit, line.inflation)
        groups = linear_fit(
            one, one_table, lambda: [Rows(worth, own, own)], target, groups=vehicles, robust=noise == "student_t"
        )
        if straight:
            made = fleet_draws(groups, key=key, chains=chains, draws=draws)
            for more in (4, 16):  # of few vehicles the tails of their spread take more, which costs little
                if made.faults():
                    made = fleet_draws(groups, key=key, chains=chains, draws=more * draws)
        else:
            model = Model.of(one, one_table, fit, target, noise=sigma, size=found.predicted, group=own, groups=vehicles,
                             student=noise == "student_t", worth=1.0 / line.inflation)  # fmt: skip
            made = sampled(model, groups.values, key=key, chains=chains, draws=draws, noise=sigma)
        theta = made.values["theta"]  # [chain, draw, vehicle, coefficient], the table has vehicles inside coefficients
        flat = np.swapaxes(theta, -1, -2).reshape(theta.shape[0] * theta.shape[1], -1)
        notes = [
            *(f"each vehicle by itself, before pooling: {note}" for note in notes),
            f"coefficients of {vehicles} vehicles are partially pooled: each is shrunk towards the fleet's mean",
        ]
    elif straight:
        values, sigmas = line.draws(key, chains * draws)
        shape = (chains, draws)
        sites = {"theta": values.reshape(*shape, -1), "variance": sigmas.reshape(shape) ** 2}
        rows = float(np.sum(np.asarray(line.statistics.rows))) * line.inflation
        how = f"exact draws from the closed form on sufficient statistics of {rows:,.0f} rows (linear, normal noise)"
        labels = {"coefficient": [c.name for c in table.free]}
        made = Draws(sites, how, {"theta": ("coefficient",)}, labels)
        flat = values
    else:
        model = Model.of(vehicle, table, fit, target, noise=sigma, size=found.predicted, student=noise == "student_t",
                         worth=1.0 / line.inflation)  # fmt: skip
        made = sampled(model, found.values, key=key, chains=chains, draws=draws, noise=sigma)
        flat = made.flat("theta")
    values, covariance = supported(table, np.mean(flat, axis=0)), np.atleast_2d(np.cov(flat.T))
    faults = made.faults()
    car = table.insert(vehicle, values)
    predicted = np.asarray(predict(car, fit.segments, target))[: fit.rows]
    message = "; ".join(faults) or "chains agree"
    spread = np.sqrt(np.diag(covariance))
    fitted = replace(
        found, vehicle=car, values=values, sd=spread, covariance=covariance, predicted=predicted,
        sigma=float(np.sqrt(np.mean(made.flat("variance")))), converged=not faults, message=message,
    )  # fmt: skip
    bad = [f"these draws are not usable: {fault}" for fault in faults]
    return Outcome(fitted, [made.how, *bad, *notes], made, not faults)


def replace_weight(fit: Fit, inflation: float) -> Fit:
    """The same rows, each worth 1/`inflation` of one."""
    return Fit(fit.segments, fit.measured, np.asarray(fit.weight) / np.sqrt(inflation), fit.rows)


def one_of_each(vehicle: Vehicle, table: ParameterTable) -> tuple[Vehicle, ParameterTable] | None:
    """The vehicle and table with one coefficient where each vehicle has its own; None unless all free ones are so.

    The tables have to be the same for all vehicles: that is what a fleet's mean has a table for.
    """
    paths = dict.fromkeys(c.path for c in table.free)
    chosen = []
    for path in paths:
        rows = [c for c in table.free if c.path == path]
        if any(c.group is None for c in rows) or len({(c.value, c.sd) for c in rows}) > 1:
            return None
        chosen.append(replace(rows[0], group=None, label=""))
    if not chosen or any(isinstance(x, Grouped) and x.by != "vehicle" for x in _grouped(vehicle)):
        return None
    leaf = lambda x: np.asarray(x.values)[0] if isinstance(x, Grouped) else x  # noqa: E731
    one = jax.tree.map(leaf, vehicle, is_leaf=lambda x: isinstance(x, Grouped))
    return one, ParameterTable(tuple(chosen))


def _grouped(vehicle: Vehicle) -> list[Any]:
    leaves = jax.tree.leaves(vehicle, is_leaf=lambda x: isinstance(x, Grouped))
    return [x for x in leaves if isinstance(x, Grouped)]


def is_linear(vehicle: Vehicle, table: ParameterTable, fit: Fit, target: TargetName, line: LinearFit) -> bool:
    """Whether the prediction is a line over what the posterior leaves open: two sds along each of its axes, its error
    is under `BENT` of the noise, as the root of the mean over rows.
    """
    x, at_mean = design(vehicle, table, fit.segments, target, line.values)
    sigma = float(np.mean(np.asarray(line.posterior.sigma)))
    values, vectors = np.linalg.eigh(line.covariance / np.outer(line.sd, line.sd))
    for value, axis in zip(values, vectors.T, strict=True):
        step = 2.0 * np.sqrt(max(value, 0.0)) * axis * line.sd
        for sign in (1.0, -1.0):
            car = table.insert(vehicle, line.values + sign * step)
            bent = np.asarray(predict(car, fit.segments, target)) - np.asarray(at_mean) - sign * np.asarray(x) @ step
            if _rms(bent[: fit.rows]) > BENT * sigma:
                return False
    return True


def _rms(x: Float[np.ndarray, " row"]) -> float:
    return float(np.sqrt(np.mean(np.square(x))))
