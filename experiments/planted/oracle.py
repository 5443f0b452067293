"""What a model that knows the cause makes of a log: its error on the same test trips, from the same training trips.

The declared vehicle with what was planted, in the library's form and with the true shapes; sizes and declared
coefficients are refitted by generalised least squares, for the diagnosis may take its sizes from there too.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from hdev_jax.diagnosis.candidates.plan import plan_of
from hdev_jax.diagnosis.noise.noise import Noise
from hdev_jax.diagnosis.scores.evidence import Evidence
from hdev_jax.diagnosis.scores.gls import generalised
from hdev_jax.diagnosis.scores.passes import distance_from_table, evidence_of
from hdev_jax.diagnosis.scores.scores import plausible, scored
from hdev_jax.diagnosis.settings import SETTINGS
from hdev_jax.diagnosis.training import Training
from hdev_jax.fleet import SyntheticLog
from hdev_jax.fleet.driving import GEAR_RATIOS
from hdev_jax.inference import Calibration, ParameterTable, calibrate, cluster_rows, effect_coefficients, padded
from hdev_jax.physics import LIBRARY, Grouped, Switch, Vehicle, at_null, most_group
from hdev_jax.problem import Problem, Split

__all__ = ["confusable", "fitted_with", "noise_rmse", "oracle_rmse"]

# log-likelihood by which two causes differ where the likelihood ratio test at 5 % of one against the other, both known,
# finds the right one in 95 of 100 logs: (2·1.645)²/2
TELLS = 5.4


def noise_rmse(synthetic: SyntheticLog, problem: Problem, split: Split) -> float:
    """RMS of the noise itself on the test trips, in the target's unit: no model does better but by luck."""
    return float(np.sqrt(np.mean(synthetic.truth["noise"].to_numpy()[problem.rows(split.test)] ** 2)))


def oracle_rmse(synthetic: SyntheticLog, problem: Problem, split: Split) -> float:
    """The oracle's error on the test trips; the noise there, where the library does not hold what was planted."""
    if any(_in_library(k, synthetic, split) is None for k in synthetic.vehicle.effects):
        return noise_rmse(synthetic, problem, split)
    fit, training = fitted_with(list(synthetic.vehicle.effects), synthetic, problem, split)
    known, _ = generalised(training.baseline(fit))
    test = problem.rows(split.test)
    return float(np.sqrt(np.mean((problem.measured - problem.predict(known.vehicle))[test] ** 2)))


def confusable(planted: Sequence[str], synthetic: SyntheticLog, problem: Problem, split: Split) -> dict[str, list[str]]:
    """For each planted effect of the library, the effects that nobody could tell from it on the training trips.

    What was measured without its noise, by the noise's own colour: an effect that in the planted one's place leaves
    less log-likelihood than `TELLS` would pass a test that knows both, in too many of the noises that might have been.
    All that is planted beside it is known. Other effects come in the best way that the diagnosis tries, linearly
    about a fit without the planted one, while the planted one is refitted; for large effects that difference counts as
    evidence, even between identical columns (`scores.TWINS`).
    """
    if not planted or any(_in_library(k, synthetic, split) is None for k in planted):
        return {}
    clean = replace(problem, measured=synthetic.truth["noise_free"].to_numpy())
    known, training = fitted_with(planted, synthetic, problem, split)
    noise = training.noise(known)
    right, training = fitted_with(planted, synthetic, clean, split)
    most = _likelihood(right, _as_noisy(evidence_of(training.baseline(right, noise)), noise))
    out = {}
    for id_ in planted:
        fit, training = fitted_with([k for k in planted if k != id_], synthetic, clean, split)
        plan = plan_of(fit.vehicle, tuple(LIBRARY.values()), training.facts, training.target)
        scores = scored(training.baseline(fit, noise), plan, SETTINGS)
        evidence = _as_noisy(scores.white, noise)
        base, totals = _likelihood(fit, evidence), evidence.totals()
        out[id_] = sorted(
            k for k, s in scores.best.items()
            if k != id_ and k not in scores.absorbed_by and plausible(s, SETTINGS)
            and most - base - evidence.gain(totals, s.candidate.columns)[0] < TELLS
        )  # fmt: skip
    return out


def _as_noisy(evidence: Evidence, noise: Noise) -> Evidence:
    """The evidence of rows without noise, weighed as with it: trips' levels have the variance that they have."""
    return replace(evidence, variances=np.array([noise.level_sd**2]))


def _likelihood(fit: Calibration, evidence: Evidence) -> float:
    """Of the fit's own columns and their tables, up to a constant."""
    moved, sd = distance_from_table(fit)
    return evidence.base_likelihood(evidence.totals()) - 0.5 * float(np.sum((moved / sd) ** 2))


def fitted_with(
    ids: Sequence[str], synthetic: SyntheticLog, problem: Problem, split: Split
) -> tuple[Calibration, Training]:
    """The declared vehicle with these of the planted effects, at their true shapes, calibrated on the training trips;
    and those trips, without candidates. Raises `KeyError` where the library does not hold one."""
    vehicle, table = problem.vehicle, problem.table
    for id_ in ids:
        vehicle, table = _with(id_, synthetic, split, vehicle, table)
    train = problem.rows(split.train)
    real = problem.segments.take(train)
    rows, clusters = padded(real, problem.measured[train]), cluster_rows(real)
    fit = calibrate(vehicle, table, rows, problem.target, clusters)
    return fit, Training(rows, problem.target, clusters, {}, most_group(real))


def _with(
    id_: str, synthetic: SyntheticLog, split: Split, vehicle: Vehicle, table: ParameterTable
) -> tuple[Vehicle, ParameterTable]:
    values = _in_library(id_, synthetic, split)
    if values is None:
        raise KeyError(id_)
    kind, null = LIBRARY[id_], at_null(LIBRARY[id_])
    leaves: dict[str, Any] = {p.name: getattr(null, p.name) for p in kind.parameters}
    leaves |= {p.name: None for p in kind.parameters if isinstance(p, Switch) and p.name not in values}
    leaves |= {k: v if isinstance(v, Grouped) else np.asarray(float(v)) for k, v in values.items()}
    effect = kind(**leaves)
    sized = [p.name for p in kind.parameters if p.has_column and values.get(p.name)]
    by_gear = [v.values for v in values.values() if isinstance(v, Grouped) and v.by == "gear"]
    groups = [str(g) for v in by_gear for g in np.flatnonzero(np.asarray(v))]
    return vehicle.plus(effect), table.plus(*effect_coefficients(effect, sized, shapes=False, groups=groups))


def _in_library(id_: str, synthetic: SyntheticLog, split: Split) -> dict[str, Any] | None:
    """What was planted by the library's parameters, or None where the library has no such form.

    Where a trip's phase or mode has to be known, it is that of the training trips: nobody knows the others.
    """
    truth = synthetic.vehicle
    values: dict[str, Any] = dict(truth.effects[id_])
    if id_ == "friction_blending":
        values["above_pa"] = 0.0
    if id_ == "driveline_drag":
        every = values.get("torque_nm", 0.0)
        by_gear = [every + values.get(f"torque_nm[{n}]", 0.0) for n in range(1, len(GEAR_RATIOS) + 1)]
        values = {"torque_nm": Grouped(jnp.asarray([0.0, *by_gear]), "gear")}
    if id_ == "voltage_dependence":
        values["at_v"] = float(synthetic.drive.columns["voltage_v"].mean())
    if id_ == "periodic_load":  # the truth's load comes on at its phase, the library's is centred there
        values["phase"] = _of_training(np.array(truth.phase) - 0.5 * values["duty"], split)
    if id_ == "step_change" and set(values) == {"auxiliary_w", "trip"}:
        values = {"power_w": values["auxiliary_w"], "at_trip": values["trip"]}
    if id_ == "mode_change" and set(values) == {"regenerating_efficiency", "share"}:
        second = np.array(truth.lottery) < values["share"]
        values = {
            "regeneration": 1.0 - values["regenerating_efficiency"] / truth.efficiency,
            "in_mode": _of_training(second, split),
            "share": float(np.mean(second[list(split.train)])),
        }
    known = {p.name for p in LIBRARY[id_].parameters} if id_ in LIBRARY else set()
    return values if set(values) <= known else None


def _of_training(by_trip: np.ndarray, split: Split) -> Grouped:
    """A number of each training trip, NaN for every other."""
    values = np.full(len(by_trip) + 1, np.nan)
    train = list(split.train)
    values[train] = np.asarray(by_trip, dtype=float)[train]
    return Grouped(jnp.asarray(values), "trip")
