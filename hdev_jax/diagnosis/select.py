"""The loop: calibrate, score every candidate, let the leaders compete, add what clears the bar, repeat."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float
from scipy import stats

from hdev_jax.diagnosis.candidates import Candidate, columns, realised
from hdev_jax.diagnosis.evidence import ABSORBED, Evidence, Score, adjusted, gather
from hdev_jax.diagnosis.whiten import Noise, estimate_noise, whiten
from hdev_jax.inference import (
    Calibration,
    Clusters,
    Fit,
    ParameterTable,
    calibrate,
    cluster_rows,
    effect_coefficients,
    jacobian,
)
from hdev_jax.inference.calibrate import WEAK
from hdev_jax.physics import Effect, Vehicle
from hdev_jax.physics.vehicle import Target

__all__ = ["Found", "Search", "Verdict", "search"]

MOST_EFFECTS = 10
LEADERS = 3  # candidates that are refitted jointly before one is taken
PLACEBOS = 199
RESAMPLES = 100


@dataclass(frozen=True)
class Found:
    """An effect that was added, and on what evidence."""

    id: str
    score: Score
    q_value: float
    stability: float
    twins: tuple[str, ...]
    gain: float


@dataclass(frozen=True)
class Verdict:
    """A candidate that was not chosen, and why."""

    id: str
    score: float | None
    q_value: float
    why_not: str


@dataclass
class Search:
    """Where the loop stands: the vehicle so far, its fit, and what was found and turned down."""

    vehicle: Vehicle
    table: ParameterTable
    fit: Calibration
    found: list[Found] = field(default_factory=list)
    verdicts: list[Verdict] = field(default_factory=list)
    absorbs: dict[str, list[str]] = field(default_factory=dict)
    taken_out: tuple[str, ...] = ()  # added once, superfluous later: not tried again
    finished: bool = False


@dataclass(frozen=True)
class _Problem:
    """What stays the same through the loop."""

    rows: Fit
    target: Target
    clusters: Clusters
    effects: Sequence[type[Effect]]
    fdr: float
    rng: np.random.Generator
    gears: int

    @property
    def trip(self) -> np.ndarray:
        return np.asarray(self.rows.segments.trip)[: self.rows.rows]

    @property
    def measured(self) -> np.ndarray:
        return np.asarray(self.rows.measured)[: self.rows.rows]


def search(
    vehicle: Vehicle,
    table: ParameterTable,
    rows: Fit,
    target: Target,
    effects: Sequence[type[Effect]],
    *,
    fdr: float,
    seed: int,
    tell: Callable[[str], None] = lambda _: None,
    remember: Callable[[int, Callable[[], Search]], Search] = lambda _, compute: compute(),
) -> Search:
    """Steps 1 to 5 of the loop on training rows alone.

    **Arguments:** the declared vehicle with its table, `rows` from `padded`, the candidates' classes, `fdr` the level
    of false discoveries over the whole library, `seed` for placebos and resampling, `tell` for progress, `remember`
    what keeps the state of each step for a run that is killed.

    **Returns:** the vehicle with every effect that cleared the bar, its fit, and a verdict on every other candidate.
    """
    real = rows.segments.take(np.arange(rows.rows))
    gears = int(np.max(np.asarray(real.channels["gear"]))) if real.has("gear") else 1
    clusters = cluster_rows(real)

    def declared() -> Search:
        tell("calibrating the declared model")
        return Search(vehicle, table, calibrate(vehicle, table, rows, target, clusters))

    state = remember(0, declared)
    for step in range(1, MOST_EFFECTS + 2):
        problem = _Problem(rows, target, clusters, effects, fdr, np.random.default_rng([seed, step]), gears)
        state = remember(step, lambda p=problem, s=state, k=step: _step(p, s, k, tell))
        if state.finished:
            break
    return state


def _step(problem: _Problem, state: Search, step: int, tell: Callable[[str], None]) -> Search:
    """One look at all candidates, and the vehicle with the one that is taken; `finished` where none is."""
    tell(f"scoring candidates, step {step}")
    view = _look(problem, state)
    if step == 1:
        state = replace(state, absorbs=view.absorbs)
    choice = _choose(problem, state, view, tell) if step <= MOST_EFFECTS else None
    if choice is None:
        return replace(state, verdicts=view.verdicts(state), finished=True)
    tell(f"added {choice.found[-1].id}")
    return replace(_prune(problem, choice, tell), verdicts=view.verdicts(choice))


@dataclass
class _View:
    """One look at all candidates from where the vehicle stands."""

    evidence: Evidence
    noise: Noise
    best: dict[str, Score]
    ways: dict[str, int]
    q: dict[str, float]
    left_out: dict[str, str]
    absorbs: dict[str, list[str]]
    absorbed_by: dict[str, str]
    residual: np.ndarray
    jacobian: np.ndarray
    matrix: np.ndarray
    reasons: dict[str, str] = field(default_factory=dict)

    def verdicts(self, state: Search) -> list[Verdict]:
        """Why each candidate that the vehicle still lacks was not chosen."""
        out = []
        for id_, s in sorted(self.best.items(), key=lambda kv: -kv[1].gain):
            if state.vehicle.has(id_):
                continue
            why = self.reasons.get(id_) or _why_not(s, self.q[id_], self.absorbed_by.get(id_))
            out.append(Verdict(id_, float(s.gain), float(self.q[id_]), why))
        out += [Verdict(id_, None, 1.0, f"not tried: {why}") for id_, why in self.left_out.items()]
        return out


def _why_not(s: Score, q: float, absorbed_by: str | None) -> str:
    if absorbed_by:
        return f"absorbed: this log cannot tell it from {absorbed_by}"
    if not _plausible(s):
        return "its best size has the wrong sign or is out of range"
    if s.left_out_gain <= 0:
        return "does not lower the error on trips left out of the fit"
    if s.p_cluster > s.p_model and q > 0.05:
        return f"not the same in every trip (q = {q:.2g} with errors clustered)"
    if q > 0.05:
        return f"not significant over the whole library (q = {q:.2g})"
    return "explains less than what was chosen, or too little for the numbers it fits"


def _plausible(s: Score) -> bool:
    """Signs, ranges and least sizes; a switch has to make about the whole of its difference."""
    c = s.candidate
    if c.kind == "limit":
        return bool(0.4 <= s.beta[0] <= 2.5)
    parameters = [c.parameter(n) for n in c.sizes]
    within = all(p.lower <= p.null + b <= p.upper for p, b in zip(parameters, s.beta, strict=True))
    return within and any(abs(b) >= p.least for p, b in zip(parameters, s.beta, strict=True))


def _bic(s: Score, rows: int) -> float:
    return s.gain - 0.5 * s.candidate.freedoms * np.log(rows)


def _moved(fit: Calibration) -> tuple[np.ndarray, np.ndarray]:
    prior = np.array([c.value for c in fit.table.free])
    sd = np.array([c.sd if c.sd is not None else WEAK * c.scale for c in fit.table.free])
    return fit.values - prior, sd


def _look(problem: _Problem, state: Search) -> _View:
    """Whiten, gather and score everything once."""
    rows, n = problem.rows, problem.rows.rows
    residual = problem.measured - state.fit.predicted
    noise = estimate_noise(residual, problem.trip, levels=problem.clusters.kind == "trip")
    car = state.fit.vehicle
    jac = jacobian(car, state.table, rows.segments, problem.target)[:n]
    candidates, matrix, left_out = columns(car, problem.effects, rows.segments, n, problem.target)
    white = whiten(np.concatenate([jac, matrix, residual[:, None]], axis=1), noise, problem.trip, problem.clusters)
    moved, sd = _moved(state.fit)
    p = jac.shape[1]
    evidence = gather(white[:, :p], white[:, p:-1], white[:, -1], problem.clusters, moved=moved, prior_sd=sd)
    best, ways = _best(evidence, candidates)
    for id_ in {c.id for c in candidates} - set(best):
        left_out[id_] = "does nothing on this log"
    absorbs, absorbed_by = _absorption(evidence, state, best)
    ids = list(best)
    ps = [min(1.0, best[i].p * ways[i]) if i not in absorbed_by else 1.0 for i in ids]
    q = dict(zip(ids, adjusted(ps), strict=True))
    return _View(evidence, noise, best, ways, q, left_out, absorbs, absorbed_by, residual, jac, matrix)


def _best(evidence: Evidence, candidates: list[Candidate]) -> tuple[dict[str, Score], dict[str, int]]:
    """The best plausible way to have each effect, and how many ways were tried."""
    total = evidence.grams.sum(axis=0)
    reduction = evidence.base_reduction(total)
    ways: dict[str, int] = {}
    ranked: dict[str, list[tuple[float, Candidate]]] = {}
    for c in candidates:
        norms = [total[evidence.base + k, evidence.base + k] for k in c.columns]
        if min(norms) <= 1e-20:
            continue
        gain, _ = evidence.gain(total, c.columns, reduction)
        ways[c.id] = ways.get(c.id, 0) + 1
        ranked.setdefault(c.id, []).append((gain - 0.5 * c.freedoms * np.log(evidence.rows), c))
    best = {}
    for id_, entries in ranked.items():
        entries.sort(key=lambda e: -e[0])
        scores = []
        for _, c in entries[:4]:
            s = evidence.score(c)
            scores.append(s)
            if _plausible(s):
                break
        best[id_] = next((s for s in scores if _plausible(s)), scores[0])
    return best, ways


def _absorption(
    evidence: Evidence, state: Search, best: dict[str, Score]
) -> tuple[dict[str, list[str]], dict[str, str]]:
    """Which candidates lie in the span of the fitted coefficients, and of which one mostly."""
    names = [c.name for c in state.table.free]
    absorbs: dict[str, list[str]] = {n: [] for n in names}
    by: dict[str, str] = {}
    total = evidence.grams.sum(axis=0)
    for id_, s in best.items():
        if s.left > ABSORBED or not names:
            continue
        column = total[: evidence.base, evidence.base + s.candidate.columns[0]]
        a = total[: evidence.base, : evidence.base]
        d = np.sqrt(np.maximum(np.diag(a), 1e-300))
        x = np.linalg.lstsq(a / np.outer(d, d), column / d, rcond=1e-10)[0]
        k = int(np.argmax(np.abs(x)))
        absorbs[names[k]].append(id_)
        by[id_] = names[k]
    return absorbs, by


def _choose(problem: _Problem, state: Search, view: _View, tell: Callable[[str], None]) -> Search | None:
    """The candidate that clears every bar, refitted; None where none does. Keeps going past one that fails."""
    n = view.evidence.rows
    able = [
        s
        for id_, s in view.best.items()
        if id_ not in state.taken_out and view.q[id_] <= problem.fdr and s.left_out_gain > 0 and _plausible(s) and _bic(s, n) > 0
    ]
    able.sort(key=lambda s: -_bic(s, n))
    while able:
        close = [s for s in able[:LEADERS] if _bic(s, n) > 0.7 * _bic(able[0], n)]
        fits = []
        for s in close:
            tell(f"refitting with {s.candidate.id}")
            if (tried := _refit(problem, state, s, view)) is not None:
                fits.append((tried[1] - 0.5 * s.candidate.freedoms * np.log(n), s, *tried))
            else:
                view.reasons[s.candidate.id] = "the joint refit left its range or did not converge"
        able = [s for s in able if s not in close]
        fits.sort(key=lambda f: -f[0])
        for _, s, new, gain in fits:
            c = s.candidate
            if np.any(view.evidence.sign_placebos(c, problem.rng, PLACEBOS) >= s.gain):
                view.reasons[c.id] = "a placebo (its column with the trips' signs drawn at random) does as well"
                continue
            if not _beats_shifts(problem, state, s, view):
                view.reasons[c.id] = "a placebo (its column shifted in time) does as well"
                continue
            twins = _twins(view, s, problem)
            stability = _stability(problem, view, {c.id, *twins})
            found = Found(c.id, s, float(view.q[c.id]), stability, twins, float(gain))
            return replace(new, found=[*state.found, found])
    return None


def _refit(problem: _Problem, state: Search, s: Score, view: _View) -> tuple[Search, float] | None:
    """The joint refit with a candidate, and its gain in whitened log-likelihood; None where it fails."""
    effect = realised(s.candidate, s.beta, gears=problem.gears)
    sizes = s.candidate.sizes
    groups = [str(g) for g in s.candidate.groups if g is not None]
    vehicle = state.fit.vehicle.plus(effect)
    rows = effect_coefficients(effect, sizes, groups=groups)
    rows = tuple(replace(r, free=False) if _idle(s.candidate, r.path) else r for r in rows)
    table = state.table.plus(*rows)
    fit = calibrate(vehicle, table, problem.rows, problem.target, problem.clusters)
    if not fit.converged and fit.steps < 5:
        return None
    if not _in_range(fit, s.candidate):
        return None
    gain = _whitened_gain(problem, state, fit, view)
    return replace(state, vehicle=fit.vehicle, table=table, fit=fit), gain


def _idle(candidate: Candidate, path: str) -> bool:
    """A shape that belongs to a size this candidate does not have."""
    name = path.rpartition(".")[2]
    return name not in candidate.sizes and all(name != n for n, _ in candidate.shapes)


def _in_range(fit: Calibration, candidate: Candidate) -> bool:
    prefix = f"effects.{candidate.id}."
    for c, v in zip(fit.table.free, fit.values, strict=True):
        if c.path.startswith(prefix):
            p = candidate.parameter(c.path.removeprefix(prefix))
            if p.kind == "size" and not p.lower <= v <= p.upper:
                return False
    return True


def _whitened_gain(problem: _Problem, state: Search, fit: Calibration, view: _View) -> float:
    """Gain of a refitted vehicle over the present one, under the present noise, each at its whitened optimum."""
    n = problem.rows.rows
    jac = jacobian(fit.vehicle, fit.table, problem.rows.segments, problem.target)[:n]
    residual = problem.measured - fit.predicted
    white = whiten(np.c_[jac, residual], view.noise, problem.trip, problem.clusters)
    moved, sd = _moved(fit)
    empty = np.zeros((n, 0))
    after = gather(white[:, :-1], empty, white[:, -1], problem.clusters, moved=moved, prior_sd=sd)
    total, before = after.grams.sum(axis=0), view.evidence.grams.sum(axis=0)
    prior_before = 0.5 * float(np.sum(np.square(np.divide(*_moved(state.fit))))) if state.table.free else 0.0
    prior_after = 0.5 * float(np.sum(np.square(moved / sd)))
    gain_after = after.base_reduction(total) - 0.5 * total[-1, -1] - prior_after
    gain_before = view.evidence.base_reduction(before) - 0.5 * before[-1, -1] - prior_before
    return gain_after - gain_before


def _beats_shifts(problem: _Problem, state: Search, s: Score, view: _View, draws: int = 19) -> bool:
    """Whether the column gains more than itself moved in time by a random amount inside each trip.

    A column that hardly changes in a trip cannot be moved in time; the sign placebos speak for it.
    """
    n = problem.rows.rows
    column = view.matrix[:, list(s.candidate.columns)]
    trip = problem.trip
    edges = np.flatnonzero(np.diff(trip)) + 1
    parts = np.split(np.arange(n), edges)
    within = np.concatenate([column[p] - column[p].mean(axis=0) for p in parts])
    if np.sum(within**2) < 0.05 * np.sum(column**2):
        return True
    shifted = []
    for _ in range(draws):
        moved = [np.roll(p, int(problem.rng.integers(len(p) // 8, max(len(p) - len(p) // 8, 2)))) for p in parts]
        shifted.append(column[np.concatenate(moved)])
    white = whiten(np.concatenate(shifted, axis=1), view.noise, trip, problem.clusters)
    base = whiten(np.c_[view.jacobian, view.residual], view.noise, trip, problem.clusters)
    moved, sd = _moved(state.fit)
    evidence = gather(base[:, :-1], white, base[:, -1], problem.clusters, moved=moved, prior_sd=sd)
    total = evidence.grams.sum(axis=0)
    k = column.shape[1]
    gains = [evidence.gain(total, range(i * k, (i + 1) * k))[0] for i in range(draws)]
    return bool(max(gains) < s.gain)


def _twins(view: _View, s: Score, problem: _Problem) -> tuple[str, ...]:
    """At most two other effects that, put in its place, leave the chosen one insignificant and explain as much."""
    total = view.evidence.grams.sum(axis=0)
    out: list[tuple[float, str]] = []
    for id_, other in view.best.items():
        if id_ == s.candidate.id or id_ in view.absorbed_by or not _plausible(other):
            continue
        if other.gain < 0.8 * s.gain:
            continue
        both = tuple(dict.fromkeys((*other.candidate.columns, *s.candidate.columns)))
        beside = view.evidence.gain(total, both)[0] - other.gain
        if 2 * beside < stats.chi2.ppf(0.95, len(s.candidate.columns)):
            out.append((-other.gain, id_))
    return tuple(id_ for _, id_ in sorted(out)[:2])


def _stability(problem: _Problem, view: _View, names: set[str]) -> float:
    """Share of resampled sets of clusters in which the same effect (or its class) comes first."""
    g = len(view.evidence.grams)
    rivals = sorted(view.best.values(), key=lambda s: -s.gain)[:12]
    hits = 0
    for _ in range(RESAMPLES):
        weight = np.bincount(problem.rng.integers(0, g, g), minlength=g).astype(float)
        gram = view.evidence.weighted(weight)
        reduction = view.evidence.base_reduction(gram)
        gains = [
            view.evidence.gain(gram, s.candidate.columns, reduction)[0]
            - 0.5 * s.candidate.freedoms * np.log(view.evidence.rows)
            if s.candidate.id not in view.absorbed_by and _plausible(s) else -np.inf
            for s in rivals
        ]  # fmt: skip
        hits += rivals[int(np.argmax(gains))].candidate.id in names and max(gains) > 0
    return hits / RESAMPLES


def _prune(problem: _Problem, state: Search, tell: Callable[[str], None]) -> Search:
    """Backward: an effect that the later ones made superfluous goes, the weakest first."""
    while len(state.found) > 1:
        n = problem.rows.rows
        jac = jacobian(state.fit.vehicle, state.table, problem.rows.segments, problem.target)[:n]
        residual = problem.measured - state.fit.predicted
        noise = estimate_noise(residual, problem.trip, levels=problem.clusters.kind == "trip")
        white = whiten(np.c_[jac, residual], noise, problem.trip, problem.clusters)
        moved, sd = _moved(state.fit)
        e = gather(
            white[:, :-1], np.zeros((n, 0)), white[:, -1], problem.clusters, moved=moved, prior_sd=sd
        )
        worst: tuple[float, Found] | None = None
        for f in state.found[:-1]:
            sizes = [
                k
                for k, c in enumerate(state.table.free)
                if c.path.startswith(f"effects.{f.id}.")
                and c.path.rpartition(".")[2] in f.score.candidate.sizes + tuple(x for x, _ in f.score.candidate.shapes)
            ]
            p = _wald(e, sizes, state.fit.values, state.vehicle, f)
            if p > 0.05 and (worst is None or p > worst[0]):
                worst = (p, f)
        if worst is None:
            break
        drop = worst[1].id
        tell(f"taking {drop} out again")
        table = state.table.minus(drop)
        vehicle = state.fit.vehicle.minus(drop)
        fit = calibrate(vehicle, table, problem.rows, problem.target, problem.clusters)
        kept = [f for f in state.found if f.id != drop]
        state = replace(
            state, vehicle=fit.vehicle, table=table, fit=fit, found=kept, taken_out=(*state.taken_out, drop)
        )
    return state


def _wald(e: Evidence, at: list[int], values: Float[np.ndarray, " free"], vehicle: Vehicle, f: Found) -> float:
    """p of an effect already in the vehicle: its sizes against zero with jackknifed clusters. A limit always holds."""
    sizes = [k for k in at if f.score.candidate.kind == "size"][: len(f.score.candidate.sizes)]
    if not sizes:
        return 0.0
    g = len(e.grams)
    beta = e._jackknife(np.empty(0, int))[:, sizes] + values[sizes]
    mean = beta.mean(axis=0)
    spread = beta - mean
    covariance = (g - 1) / g * spread.T @ spread
    d = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    k = len(sizes)
    if g <= k + 1:
        return 0.0
    wald = float((mean / d) @ np.linalg.pinv(covariance / np.outer(d, d), rcond=1e-10) @ (mean / d))
    return float(stats.f.sf(wald * (g - k) / (k * (g - 1)), k, g - k))
