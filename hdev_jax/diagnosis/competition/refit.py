"""Joint refits: the vehicle with a candidate, every free coefficient fitted anew, and whether it stands."""

from collections.abc import Callable, Set
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy import stats

from hdev_jax.diagnosis.candidates.candidate import FIXED, Candidate, realised
from hdev_jax.diagnosis.competition.sharpen import refined
from hdev_jax.diagnosis.noise.model import Noise
from hdev_jax.diagnosis.scores.evidence import ABSORBED, Score
from hdev_jax.diagnosis.scores.look import Found, Loop, Search, View
from hdev_jax.diagnosis.scores.ranking import without_idle
from hdev_jax.diagnosis.scores.settle import settle
from hdev_jax.diagnosis.scores.sums import distance_from_table, evidence_of
from hdev_jax.inference import Calibration, ParameterTable, calibrate, effect_coefficients, jacobian, predict
from hdev_jax.inference.parameters import Coefficient
from hdev_jax.physics import Effect, Vehicle

__all__ = ["Refitted", "as_known", "gained", "grow", "is_size", "joined", "refit", "refitted", "without"]

BORNE_OUT = 2.6  # standard errors: 1 %
AGREES = 0.9878  # of Student's distribution between what plain rows say of a size and what whitened ones do: 2.25 sd
KNOWN = 2.0  # times as well, from which on whitened rows are asked for a size rather than plain ones
DROWNED = 0.25  # least share of a slow cause's size that weights which suit the noise inside trips leave of it
GROWN = 1e-3  # p of a size that joins an effect found without it

Refitted = tuple[Search, float, Score]


def refit(problem: Loop, state: Search, s: Score, view: View) -> Refitted | Candidate | None:
    """The joint refit with a candidate, its gain in whitened log-likelihood, and the score with the shapes that it
    started from (what is held stays there).

    None where it fails; the candidate with a group less (a gear) where the refit puts its size there beyond its null.
    """
    c = s.candidate
    shaped = any(c.parameter(n).kind != "choice" for n, _ in c.shapes)
    plain, plain_sd = view.plain.estimate(c)
    white, white_sd = view.evidence.estimate(c)
    if s.plain and _contradicted(plain, white, white_sd):
        return None
    clear = np.abs(plain) > BORNE_OUT * plain_sd
    borne_out = bool(np.any(clear))
    lends = c.kind == "size" and not s.plain
    if lends:
        # clusters that show nothing of a size say nothing of its error either; of its sign those that do may
        one = (1.0 - AGREES) / (len(c.groups) if None not in c.groups else 1)
        apart = stats.t.isf(one, np.maximum(view.plain.bearing(c) - 1.0, 1.0))
        turned = clear & (np.sign(plain) != np.sign(white))
        lends = bool(np.all((np.abs(plain - white) <= apart * plain_sd) & ~turned))
    better = lends and bool(np.all(KNOWN * white_sd <= plain_sd))
    # one linear step says about what a refit will, unless thresholds and time constants are free to move
    try_plain = borne_out or shaped or s.plain or c.kind == "limit"
    start = refined(problem, s, view)[0] if shaped or try_plain else s
    # What rows of equal weight bear out is the luckier half of what they may say of a size; whitened rows that know it
    # better are asked first. Where those cannot tell it apart, they come after, as far as plain rows leave room.
    noise = view.ground.noise
    ways = [noise] * better + [None] * try_plain + [noise] * (lends and not better)
    fewer = None
    for way in ways:
        new = _with(problem, state, start, way)
        if new is not None and _stands(new.fit, c):
            started = replace(s, candidate=replace(c, shapes=start.candidate.shapes), beta=start.beta)
            return new, gained(problem, new.fit, view), started
        if new is not None and fewer is None and c.kind == "size":
            fewer = without_idle(c, _sizes(new.fit, c))
    return fewer


def _contradicted(plain: np.ndarray, white: np.ndarray, white_sd: np.ndarray) -> bool:
    """Whether whitened rows rule out even a quarter of the size, at two standard errors.

    What rows of equal weight say of a slow column may be slow noise; weights that drown a cause leave some of it.
    """
    return bool(np.all(np.sign(plain) * white + 2.0 * white_sd < DROWNED * np.abs(plain)))


def joined(problem: Loop, state: Search, s: Score, noise: Noise | None = None) -> Search | None:
    """The state with the candidate in a joint fit; None where it fails or does not stand there. With `noise`, its sizes
    are borrowed from rows whitened by it, and its shapes with them unless these rows do not settle them."""
    new = _with(problem, state, s, noise)
    return new if new is not None and _stands(new.fit, s.candidate) else None


def _with(problem: Loop, state: Search, s: Score, noise: Noise | None) -> Search | None:
    """The state with the candidate in a joint fit, whether it stands there or not; None where there is no such fit."""
    c = s.candidate
    effect = realised(c, s.beta, gears=problem.gears)
    vehicle = state.fit.vehicle.plus(effect)
    table = told = None
    for shapes in (True, False)[: 2 if noise is not None else 1]:
        rows = _coefficients(c, effect, shapes=shapes)
        table = state.table.plus(*rows)
        lent = {r.name for r in table.free if r.told or (noise is not None and r in rows)}
        if lent:
            now = replace(state, vehicle=vehicle, table=table)
            told = _borrowed(problem, now, noise or problem.noise(state.fit), lent)
        if told is not None or not any(r.free and _is_shape(c, r) for r in rows):
            break
    if told is None and noise is not None:
        return None
    table = told or table
    assert table is not None
    fit = calibrate(vehicle, table, problem.rows, problem.target, problem.clusters)
    if not fit.converged and fit.steps < 5:
        return None
    return replace(state, vehicle=fit.vehicle, table=table, fit=fit)


def as_known(problem: Loop, state: Search) -> Calibration:
    """The fit of the state, whose effects are chosen, as whitened rows have it: declared coefficients too.

    Where errors are slow these know a declared coefficient several times as well as rows of equal weight, as long as
    both agree on every coefficient (Hausman, Econometrica 46, 1978). Before the effects are there, or beside something
    unexplained, weights that suit the noise would only serve what is missing.

    **Returns:** the state's fit itself where whitened rows know no declared coefficient better, know one worse,
    contradict equal weights, or where trips alone tell an effect, which they drown. All coefficients of the other are
    told.
    """
    fit, found = state.fit, [f.score for f in state.found]
    declared = np.array([not c.path.startswith("effects.") for c in fit.table.free], dtype=bool)
    if not declared.any() or any(s.plain for s in found):
        return fit
    settled, covariance = settle(problem.ground(fit, problem.noise(fit)))
    error = np.sqrt(np.diag(covariance))
    one = (1.0 - AGREES) / len(fit.values)
    agree = np.abs(settled.values - fit.values) <= stats.t.isf(one, max(problem.clusters.count - 1, 1)) * fit.sd
    gained = fit.sd[declared] / error[declared]
    if not (np.all(agree) and np.min(gained) >= 1.0 and np.max(gained) >= KNOWN):
        return fit
    predicted = np.asarray(predict(settled.vehicle, problem.rows.segments, problem.target))[: problem.rows.rows]
    table = _lent(fit.table, settled.values, error, {c.name for c in fit.table.free})
    known = replace(
        settled, table=table, sd=error, covariance=covariance, predicted=predicted,
        sigma=float(np.sqrt(np.mean((problem.measured - predicted) ** 2))),
    )  # fmt: skip
    return known if all(_stands(known, s.candidate) for s in found) else fit


def _lent(
    table: ParameterTable, values: Float[np.ndarray, " free"], error: Float[np.ndarray, " free"], names: Set[str]
) -> ParameterTable:
    """The table with these values and standard errors told of its free coefficients of these names, of no others."""
    told = {c.name: (float(x), float(e)) for c, x, e in zip(table.free, values, error, strict=True) if c.name in names}
    return ParameterTable(tuple(replace(c, told=told.get(c.name)) for c in table.rows))


def without(problem: Loop, state: Search, effect_id: str) -> Search:
    """The state with one effect taken out again and the rest refitted."""
    table, vehicle = state.table.minus(effect_id), state.fit.vehicle.minus(effect_id)
    fit = refitted(problem, replace(state, vehicle=vehicle, table=table))
    found = [f for f in state.found if f.id != effect_id]
    return replace(state, vehicle=fit.vehicle, table=fit.table, fit=fit, found=found)


def refitted(problem: Loop, state: Search) -> Calibration:
    """A fit of the state's vehicle by its table, where what was borrowed beside other effects is borrowed anew.

    A borrowed value is tight; that of a model with an effect more or less would hold its own where it no longer is.
    Without one where whitened rows do not settle it.
    """
    table = state.table
    if lent := {c.name for c in table.free if c.told}:
        told = _borrowed(problem, state, problem.noise(state.fit), lent)
        table = told or ParameterTable(tuple(replace(c, told=None) for c in table.rows))
    return calibrate(state.vehicle, table, problem.rows, problem.target, problem.clusters)


def _borrowed(problem: Loop, state: Search, noise: Noise, names: Set[str]) -> ParameterTable | None:
    """The state's table with what whitened rows say of these coefficients, all others fitted beside them.

    One linear step is not enough: the coefficients that it starts from may have been fitted without the effect. None
    where the steps do not settle.
    """
    values, nothing = state.table.values(state.vehicle), np.zeros((len(state.table.free), len(state.table.free)))
    start = replace(
        state.fit, vehicle=state.vehicle, table=state.table, values=values, sd=np.diag(nothing), covariance=nothing
    )
    fit, covariance = settle(problem.ground(start, noise))
    error = np.sqrt(np.diag(covariance))
    if not all(np.isfinite(e) for c, e in zip(state.table.free, error, strict=True) if c.name in names):
        return None
    return _lent(state.table, fit.values, error, names)


def _coefficients(candidate: Candidate, effect: Effect, *, shapes: bool = True) -> tuple[Coefficient, ...]:
    """The table's rows of a candidate: its sizes and shapes free, shapes of sizes that it does not have held."""
    groups = [str(g) for g in candidate.groups if g is not None]
    rows = effect_coefficients(effect, candidate.sizes, groups=groups, shapes=shapes)
    return tuple(replace(r, free=False) if _idle(candidate, r.path) else r for r in rows)


def _stands(fit: Calibration, candidate: Candidate) -> bool:
    return _in_range(fit, candidate) and _present(fit, candidate)


def _sizes(fit: Calibration, c: Candidate) -> Float[np.ndarray, " k"]:
    """A candidate's sizes in a fit, against their null."""
    by = {(row.path, row.group): float(v) for row, v in zip(fit.table.free, fit.values, strict=True)}
    each = zip(c.sizes, c.groups, strict=True)
    return np.array([by[f"effects.{c.id}.{n}", g] - c.parameter(n).null for n, g in each])


def _present(fit: Calibration, candidate: Candidate) -> bool:
    """Whether a size stands in the joint refit too, where rows weigh the same, at 1 % with errors clustered."""
    if candidate.kind == "limit":
        return True
    at = [k for k, c in enumerate(fit.table.free) if c.path.rpartition(".")[2] in candidate.sizes
          and c.path.startswith(f"effects.{candidate.id}.")]  # fmt: skip
    return bool(np.any(np.abs(fit.values[at]) > BORNE_OUT * fit.sd[at]))


def _is_shape(candidate: Candidate, row: Coefficient) -> bool:
    return row.path.rpartition(".")[2] not in candidate.sizes


def _idle(candidate: Candidate, path: str) -> bool:
    """A shape that belongs to a size this candidate does not have."""
    name = path.rpartition(".")[2]
    return name not in candidate.sizes and all(name != n for n, _ in candidate.shapes)


def _in_range(fit: Calibration, candidate: Candidate) -> bool:
    """Whether sizes and limits are plausible, and no limit ends up at an edge of its range.

    An edge that is its null is none: a filter of half a second is a short one, whatever the longest may be.
    """
    prefix = f"effects.{candidate.id}."
    for c, v in zip(fit.table.free, fit.values, strict=True):
        if c.path.startswith(prefix):
            p = candidate.parameter(c.path.removeprefix(prefix))
            if p.kind in ("size", "limit") and not p.lower <= v <= p.upper:
                return False
            width, edges = p.upper - p.lower, [e for e in (p.lower, p.upper) if e != p.null]
            if p.kind == "limit" and width < 1e9 and any(abs(v - e) < 0.01 * width for e in edges):
                return False
    return True


def gained(problem: Loop, fit: Calibration, view: View) -> float:
    """Gain of a refitted vehicle over the present one, both under the present colour and at their own best levels."""
    after = evidence_of(problem.ground(fit, view.ground.noise))
    prior = [0.5 * float(np.sum(np.square(np.divide(*distance_from_table(f))))) for f in (view.ground.fit, fit)]
    before = view.evidence.base_likelihood(view.evidence.totals()) - prior[0]
    return after.base_likelihood(after.totals()) - prior[1] - before


def grow(problem: Loop, state: Search, tell: Callable[[str], None]) -> Search | None:
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
            shapes = tuple((p.name, float(values[p.name])) for p in c.effect.parameters if p.kind in FIXED)
            wider = replace(c, sizes=sizes, groups=(None,) * len(sizes), shapes=shapes)
            effect = c.effect(**values)
            rows = _coefficients(wider, effect)
            vehicle, table = state.fit.vehicle.minus(f.id).plus(effect), state.table.minus(f.id).plus(*rows)
            paths = {f"effects.{f.id}.{n}" for n in new}
            if _left(problem, vehicle, table, paths) < ABSORBED:
                continue
            tell(f"refitting {f.id} with {', '.join(new)}")
            fit = refitted(problem, replace(state, vehicle=vehicle, table=table))
            at = [k for k, r in enumerate(fit.table.free) if r.path in paths]
            p = 2 * stats.t.sf(np.abs(fit.values[at] / fit.sd[at]), max(problem.clusters.count - 1, 1))
            if fit.converged and _in_range(fit, wider) and np.all(p < GROWN):
                by_path = {r.path: float(v) for r, v in zip(fit.table.free, fit.values, strict=True)}
                beta = np.array([by_path[f"effects.{f.id}.{n}"] for n in sizes])
                score = replace(f.score, candidate=wider, beta=beta)
                found = [replace(g, score=score) if g is f else g for g in state.found]
                # fits on the way here had the effect without the new size: they are run again where they are asked for
                trail = {k: v for k, v in state.trail.items() if f.id not in k.split(",")}
                return replace(state, vehicle=fit.vehicle, table=fit.table, fit=fit, found=found, trail=trail)
    return None


def _left(problem: Loop, vehicle: Vehicle, table: ParameterTable, paths: set[str]) -> float:
    """Smallest share of these coefficients' columns that the other coefficients do not hold."""
    jac = jacobian(vehicle, table, problem.rows.segments, problem.target)[: problem.rows.rows]
    new = np.array([r.path in paths for r in table.free])
    own, others = jac[:, new], jac[:, ~new]
    others = others / np.maximum(np.linalg.norm(others, axis=0), 1e-300)
    x = np.linalg.lstsq(others.T @ others, others.T @ own, rcond=1e-10)[0]
    rest = np.sum((own - others @ x) ** 2, axis=0)
    return float(np.min(rest / np.maximum(np.sum(own**2, axis=0), 1e-300)))


def is_size(path: str, f: Found) -> bool:
    """Whether a coefficient is one of the sizes of a found effect."""
    return any(path == f"effects.{f.id}.{name}" for name in f.score.candidate.sizes)
