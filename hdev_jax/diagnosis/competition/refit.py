"""Joint refits: the vehicle with a candidate, every free coefficient refitted; is the candidate significant there?"""

from collections.abc import Mapping, Set
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy import stats

from hdev_jax.diagnosis.candidates.candidate import Candidate, in_order, realised
from hdev_jax.diagnosis.competition.grid import refined
from hdev_jax.diagnosis.competition.state import State
from hdev_jax.diagnosis.gates.rejection import Kind
from hdev_jax.diagnosis.noise.noise import Noise
from hdev_jax.diagnosis.scores.evidence import Evidence, Score
from hdev_jax.diagnosis.scores.gls import generalised
from hdev_jax.diagnosis.scores.passes import distance_from_table, evidence_of
from hdev_jax.diagnosis.scores.scores import Scores, without_idle
from hdev_jax.diagnosis.settings import Settings
from hdev_jax.diagnosis.training import Training
from hdev_jax.inference import Calibration, ParameterTable, effect_coefficients
from hdev_jax.inference.parameters import Coefficient
from hdev_jax.physics import Choice, Effect, Switch, Vehicle

__all__ = [
    "Refit", "as_reported", "fitted", "gained", "in_range", "joined", "large_enough", "refit", "widened", "without",
]  # fmt: skip


@dataclass(frozen=True)
class Refit:
    """A joint refit: the `fit` (None where the candidate is out of range or not significant in it), its gain in
    log-likelihood, the score at the shapes that it started from; where that is the reason, `fewer`, the candidate
    without the group (a gear) or the size that ends out of range; `kind`, why there is none."""

    fit: Calibration | None
    gain: float
    score: Score
    fewer: Candidate | None = None
    kind: Kind = Kind.REFIT


def refit(training: Training, state: State, s: Score, scores: Scores) -> Refit:
    """The joint refit with a candidate.

    A size is taken from generalised least squares where its standard error is at least `known` times smaller than by
    ordinary least squares and both agree (Hausman, Econometrica 46, 1978); else from ordinary least squares, where it
    is significant with clustered errors.
    """
    c, settings = s.candidate, training.settings
    failed = Refit(None, 0.0, s)
    shaped = any(not isinstance(c.parameter(n), Choice) for n, _ in c.shapes)
    plain, plain_sd = scores.plain.estimate(c)
    white, white_sd = scores.white.estimate(c)
    clear = np.abs(plain) > settings.stands * plain_sd
    generalise = c.kind == "size" and not s.plain
    if generalise:
        # clusters that show nothing of a size say nothing of its error either; of its sign those that do may
        one = (1.0 - settings.agrees) / (len(c.groups) if None not in c.groups else 1)
        apart = stats.t.isf(one, np.maximum(scores.plain.bearing(c) - 1.0, 1.0))
        turned = clear & (np.sign(plain) != np.sign(white))
        both = turned & (np.abs(plain) > apart * plain_sd) & (np.abs(white) > apart * white_sd)
        if np.any(both):  # each sign is significant by its own weights
            less = c.narrower(~both) if None in c.groups else c.only(~both)
            return replace(failed, fewer=less, kind=Kind.OPPOSITE)
        generalise = bool(np.all((np.abs(plain - white) <= apart * plain_sd) & ~turned))
    better = generalise and bool(np.all(settings.known * white_sd <= plain_sd))
    # one linear step predicts the result of a refit, unless thresholds and time constants are free to move
    least_squares = bool(np.any(clear)) or shaped or s.plain or c.kind == "limit"
    start = refined(training, s, scores)[0] if shaped or least_squares else s
    noise = scores.baseline.noise
    ways = [noise] * better + [None] * least_squares + [noise] * (generalise and not better)
    fewer = None
    for way in ways:
        fit = _with(training, state, start, way)
        if fit is not None and _stands(fit, c, settings) and _all_in_range(fit, state, settings):
            started = replace(s, candidate=replace(c, shapes=start.candidate.shapes), beta=start.beta)
            return Refit(fit, gained(training, fit, scores), started)
        if fit is not None and fewer is None and c.kind == "size":
            beta = _sizes(fit, c)
            inner = [
                bool(p.lower <= p.null + b <= p.upper) and not c.is_constant_load({p.name: b})
                for p, b in zip(map(c.parameter, c.sizes), beta, strict=True)
            ]
            fewer = without_idle(c, beta) or c.narrower(inner)
    return replace(failed, fewer=fewer)


def joined(training: Training, state: State, s: Score, noise: Noise | None = None) -> Calibration | None:
    """The joint fit with a candidate; None where it fails or the candidate is not significant. With `noise`, its sizes
    are those of generalised least squares, and its shapes with them unless these rows do not settle them."""
    fit = _with(training, state, s, noise)
    settings = training.settings
    good = fit is not None and _stands(fit, s.candidate, settings) and _all_in_range(fit, state, settings)
    return fit if good else None


def _with(training: Training, state: State, s: Score, noise: Noise | None) -> Calibration | None:
    """The joint fit with a candidate, significant or not; None where the fit fails."""
    c = s.candidate
    effect = realised(c, s.beta, gears=training.gears)
    vehicle = state.fit.vehicle.plus(effect)
    table = known = None
    for shapes in (True, False)[: 2 if noise is not None else 1]:
        rows = _coefficients(c, effect, shapes=shapes)
        table = state.fit.table.plus(*rows)
        names = {r.name for r in table.free if r.known or (noise is not None and r in rows)}
        if names:
            known = _by_gls(training, state.fit, vehicle, table, noise or training.noise(state.fit), names)
        if known is not None or not any(r.free and r.path.rpartition(".")[2] not in c.sizes for r in rows):
            break
    if known is None and noise is not None:
        return None
    table = known or table
    assert table is not None
    fit = training.calibrate(vehicle, table)
    return fit if fit.converged or fit.steps >= 5 else None


def fitted(training: Training, near: Calibration, vehicle: Vehicle, table: ParameterTable) -> Calibration:
    """A fit of a vehicle by a table; sizes known by generalised least squares beside other effects are estimated again.

    Such a value has a small standard error, and would be held where it no longer is with an effect more or less.
    Ordinary least squares where the steps do not settle. Limits that would end out of order stay where they are.
    `near` is a fit of these rows.
    """
    if names := {c.name for c in table.free if c.known}:
        known = _by_gls(training, near, vehicle, table, training.noise(near), names)
        table = known or ParameterTable(tuple(replace(c, known=None) for c in table.rows))
    fit = training.calibrate(vehicle, table)
    if crossed := _crossed(fit):
        held = ParameterTable(tuple(replace(c, free=c.free and c.path not in crossed) for c in table.rows))
        fit = training.calibrate(vehicle, held)
    return fit


def _crossed(fit: Calibration) -> set[str]:
    """Fitted limits that ended out of order, by path."""
    at, out = {c.path: float(v) for c, v in zip(fit.table.free, fit.values, strict=True)}, set[str]()
    for e in fit.vehicle.effects:
        for pair in e.ordered:
            low, high = (f"effects.{e.id}.{n}" for n in pair)
            if low in at and high in at and at[low] >= at[high]:
                out |= {low, high}
    return out


def without(training: Training, state: State, *ids: str) -> State:
    """The state with effects taken out and the rest refitted."""
    fit = fitted(training, state.fit, state.fit.vehicle.minus(*ids), state.fit.table.minus(*ids))
    found = tuple(f for f in state.found if f.id not in ids)
    return replace(state, fit=fit, found=found, terms=tuple(t for t in state.terms if t.id not in ids))


def as_reported(training: Training, state: State) -> Calibration:
    """The fit of the state, whose effects are chosen, by generalised least squares: declared coefficients too.

    Where errors are slow its standard errors are several times smaller than by ordinary least squares; both have to
    agree on every coefficient (Hausman). Before the effects are there, or beside something unexplained, these weights
    would fit what is missing.

    **Returns:** the state's fit itself where generalised least squares make no standard error of a declared coefficient
    smaller, make one larger, contradict ordinary least squares, or where an effect was found between trips alone.
    """
    fit, found, settings = state.fit, [f.score for f in state.found], training.settings
    declared = np.array([not c.path.startswith("effects.") for c in fit.table.free], dtype=bool)
    if not declared.any() or any(s.plain for s in found):
        return fit
    known, covariance = generalised(training.baseline(fit))
    error = np.sqrt(np.diag(covariance))
    one = (1.0 - settings.agrees) / len(fit.values)
    agree = np.abs(known.values - fit.values) <= stats.t.isf(one, max(training.clusters.count - 1, 1)) * fit.sd
    better = fit.sd[declared] / error[declared]
    if not (np.all(agree) and np.min(better) >= 1.0 and np.max(better) >= settings.known):
        return fit
    predicted = np.concatenate(
        [training.kernel.predict(known.vehicle, c.segments, training.target)[: c.rows] for c in training.chunks]
    )
    each = zip(fit.table.free, known.values, error, strict=True)
    table = _known(fit.table, {c.name: (float(x), float(e)) for c, x, e in each})
    known = replace(
        known, table=table, sd=error, covariance=covariance, predicted=predicted,
        sigma=float(np.sqrt(np.mean((training.measured - predicted) ** 2))),
    )  # fmt: skip
    return known if all(_stands(known, s.candidate, settings) for s in found) else fit


def gained(training: Training, fit: Calibration, scores: Scores) -> float:
    """Gain of a refitted vehicle over the present one, both under the present noise and at their own best levels."""
    after = evidence_of(training.baseline(fit, scores.baseline.noise))
    prior = [0.5 * float(np.sum(np.square(np.divide(*distance_from_table(f))))) for f in (scores.baseline.fit, fit)]
    before = scores.white.base_likelihood(scores.white.totals()) - prior[0]
    return after.base_likelihood(after.totals()) - prior[1] - before


def widened(training: Training, state: State) -> State | None:
    """The state with a size more in one found effect, or None: heating was found, cooling may be there too.

    An effect is found in the way that its first step shows best; once it is in, only a joint refit can show the rest.
    """
    for f in state.found:
        c = f.score.candidate
        for sizes in c.effect.variants:
            if c.kind != "size" or not set(c.sizes) < set(sizes) or any(g is not None for g in c.groups):
                continue
            now = state.fit.vehicle.effect(f.id)
            values = {p.name: getattr(now, p.name) for p in c.effect.parameters}
            new = [n for n in sizes if n not in c.sizes]
            values.update({n: np.asarray(c.parameter(n).scale) for n in new})
            shapes = tuple((p.name, float(values[p.name])) for p in c.effect.parameters if not p.has_column)
            wider = replace(c, sizes=sizes, groups=(None,) * len(sizes), shapes=shapes)
            effect = c.effect(**values)
            vehicle = state.fit.vehicle.minus(f.id).plus(effect)
            table = state.fit.table.minus(f.id).plus(*_coefficients(wider, effect))
            at = [k for k, r in enumerate(table.free) if r.path in {f"effects.{f.id}.{n}" for n in new}]
            there = replace(
                state.fit, vehicle=vehicle, table=table, values=table.values(vehicle), sd=np.ones(len(table.free)),
                covariance=np.eye(len(table.free)),
            )  # fmt: skip
            evidence = evidence_of(training.baseline(there, training.noise(state.fit))).freed(at, there.values[at])
            assert isinstance(evidence, Evidence)
            added = evidence.score(replace(wider, sizes=tuple(new), columns=tuple(range(len(at)))))
            if added.left < training.settings.absorbed or max(added.p_model, added.p_cluster) > training.settings.level:
                continue
            fit = fitted(training, state.fit, vehicle, table)
            p = 2 * stats.t.sf(np.abs(fit.values[at] / fit.sd[at]), max(training.clusters.count - 1, 1))
            if fit.converged and in_range(fit, wider) and np.all(p < training.settings.level):
                by_path = {r.path: float(v) for r, v in zip(fit.table.free, fit.values, strict=True)}
                beta = np.array([by_path[f"effects.{f.id}.{n}"] for n in sizes])
                score = replace(f.score, candidate=wider, beta=beta)
                found = tuple(replace(g, score=score) if g is f else g for g in state.found)
                # fits on the way here had the effect without the new size: they are run again where they are needed
                trail = {k: v for k, v in state.trail.items() if f.id not in k.split(",")}
                return replace(state, fit=fit, found=found, trail=trail)
    return None


def _known(table: ParameterTable, known: Mapping[str, tuple[float, float]]) -> ParameterTable:
    """The table with these values and standard errors as known, by coefficient; no others are."""
    return ParameterTable(tuple(replace(c, known=known.get(c.name)) for c in table.rows))


def _by_gls(
    training: Training, near: Calibration, vehicle: Vehicle, table: ParameterTable, noise: Noise, names: Set[str]
) -> ParameterTable | None:
    """The table with these coefficients as estimated by generalised least squares, all others fitted beside them.

    One linear step is not enough: the coefficients that it starts from may have been fitted without the effect. None
    where the steps do not settle.
    """
    thresholds = {f"effects.{e.id}.{p.name}" for e in vehicle.effects for p in e.parameters if isinstance(p, Switch)}
    held = ParameterTable(tuple(replace(c, free=c.free and c.path not in thresholds) for c in table.rows))
    for tried in dict.fromkeys((table, held)):  # a threshold may jump from row to row, and no step settles
        values, nothing = tried.values(vehicle), np.zeros((len(tried.free), len(tried.free)))
        start = replace(near, vehicle=vehicle, table=tried, values=values, sd=np.diag(nothing), covariance=nothing)
        fit, covariance = generalised(training.baseline(start, noise))
        error = np.sqrt(np.diag(covariance))
        known = [np.isfinite(e) for c, e in zip(tried.free, error, strict=True) if c.name in names]
        if known and all(known):
            by_name = {c.name: (float(x), float(e)) for c, x, e in zip(tried.free, fit.values, error, strict=True)}
            return _known(table, {n: by_name[n] for n in names if n in by_name})
    return None


def _coefficients(candidate: Candidate, effect: Effect, *, shapes: bool = True) -> tuple[Coefficient, ...]:
    """The table's rows of a candidate: its sizes and shapes free, shapes of sizes that it does not have held."""
    groups = [str(g) for g in candidate.groups if g is not None]
    rows = effect_coefficients(effect, candidate.sizes, groups=groups, shapes=shapes)
    return tuple(replace(r, free=False) if _idle_shape(candidate, r.path.rpartition(".")[2]) else r for r in rows)


def _stands(fit: Calibration, candidate: Candidate, settings: Settings) -> bool:
    """Whether it is in range, and a size is significant with clustered errors and large enough to name."""
    if not in_range(fit, candidate):
        return False
    if candidate.kind == "limit":
        return not candidate.parameter(candidate.sizes[0]).smooth or large_enough(fit, candidate)
    if not large_enough(fit, candidate):
        return False
    at = [k for k, c in enumerate(fit.table.free) if c.path.rpartition(".")[2] in candidate.sizes
          and c.path.startswith(f"effects.{candidate.id}.")]  # fmt: skip
    return bool(np.any(np.abs(fit.values[at]) > settings.stands * fit.errors[at]))


def _all_in_range(fit: Calibration, state: State, settings: Settings) -> bool:
    """Whether no earlier effect is clearly out of its range now: of two sizes that cancel, one is too many. An effect
    of about 0 is left to the backward step."""
    return all(in_range(fit, f.score.candidate, settings.stands) for f in state.found)


def _sizes(fit: Calibration, c: Candidate) -> Float[np.ndarray, " k"]:
    """A candidate's sizes in a fit, against their null."""
    by = {(row.path, row.group): float(v) for row, v in zip(fit.table.free, fit.values, strict=True)}
    each = zip(c.sizes, c.groups, strict=True)
    return np.array([by[f"effects.{c.id}.{n}", g] - c.parameter(n).null for n, g in each])


def _idle_shape(candidate: Candidate, name: str) -> bool:
    """A shape that belongs to a size this candidate does not have."""
    return name not in candidate.sizes and all(name != n for n, _ in candidate.shapes)


def large_enough(fit: Calibration, candidate: Candidate) -> bool:
    """Whether one of its sizes is at least the smallest that is worth naming. (An effect one of whose sizes is nothing
    competes without it.)"""
    prefix = f"effects.{candidate.id}."
    each = ((c.path.removeprefix(prefix), v) for c, v in zip(fit.table.free, fit.values, strict=True)
            if c.path.startswith(prefix))  # fmt: skip
    sizes = [(candidate.parameter(n), float(v)) for n, v in each if n in candidate.sizes]
    return any(abs(v - p.null) >= p.least for p, v in sizes)


def in_range(fit: Calibration, candidate: Candidate, slack: float = 0.0) -> bool:
    """Whether sizes and limits are plausible, and no limit ends up at an edge of its range; `slack` in standard errors.

    An edge that is its null is none: a filter of half a second is a short one, whatever the longest may be.
    """
    prefix = f"effects.{candidate.id}."
    for c, v, sd in zip(fit.table.free, fit.values, fit.errors, strict=True):
        if c.path.startswith(prefix):
            p = candidate.parameter(c.path.removeprefix(prefix))
            if candidate.is_constant_load({p.name: v - p.null - slack * sd}):
                return False
            if p.has_column and not p.lower - slack * sd <= v <= p.upper + slack * sd:
                return False
            width, edges = p.upper - p.lower, [e for e in (p.lower, p.upper) if e != p.null]
            if isinstance(p, Switch) and width < 1e9 and any(abs(v - e) < 0.01 * width for e in edges):
                return False
    now = fit.vehicle.effect(candidate.id)
    limits = {n: getattr(now, n) for pair in candidate.effect.ordered for n in pair}
    used = {n: float(np.asarray(v)) for n, v in limits.items() if v is not None and not _idle_shape(candidate, n)}
    return in_order(candidate.effect, used)
