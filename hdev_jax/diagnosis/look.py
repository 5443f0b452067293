"""One look at a vehicle and a log: what the fitted model leaves, and what every candidate would explain of it."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from hdev_jax.diagnosis.candidates import Candidate, columns
from hdev_jax.diagnosis.evidence import ABSORBED, Evidence, Score, adjusted, clusters_needed, gather, gather_plain
from hdev_jax.diagnosis.whiten import Noise, estimate_noise, whiten
from hdev_jax.inference import Calibration, Clusters, Fit, ParameterTable, jacobian
from hdev_jax.inference.calibrate import WEAK
from hdev_jax.physics import Effect, Vehicle
from hdev_jax.physics.vehicle import Target

__all__ = [
    "LEFT_OUT",
    "Found",
    "Loop",
    "Search",
    "Verdict",
    "View",
    "best_of",
    "both_looks",
    "distance_from_table",
    "evidence_of",
    "look",
    "plausible",
    "slow",
    "worth",
]

HINT = 0.1  # p, before any correction, from which on a candidate is not even hinted at
LEFT_OUT = 3.0  # least gain in log-likelihood over the clusters left out: chance alone gives about half a unit


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
    """A candidate that was not chosen, and why.

    `needed`: with how many clusters like these it could be told from chance; `between`: only trips can tell it.
    """

    id: str
    score: float | None
    q_value: float
    why_not: str
    needed: int | None = None
    between: bool = False


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
    refused: tuple[str, ...] = ()  # cleared the tests but not the joint refit: tried again only before the end
    trail: dict[str, list[float]] = field(default_factory=dict)  # values of the fit, by the effects it had
    finished: bool = False


@dataclass(frozen=True)
class Loop:
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
    def seconds(self) -> np.ndarray:
        return np.asarray(self.rows.segments.duration_s)[: self.rows.rows]

    @property
    def measured(self) -> np.ndarray:
        return np.asarray(self.rows.measured)[: self.rows.rows]


@dataclass
class View:
    """One look at all candidates from where the vehicle stands."""

    evidence: Evidence
    plain: Evidence
    noise: Noise
    best: dict[str, Score]
    ways: dict[str, int]
    q: dict[str, float]
    left_out: dict[str, str]
    absorbs: dict[str, list[str]]
    absorbed_by: dict[str, str]
    fit: Calibration
    residual: np.ndarray
    jacobian: np.ndarray
    matrix: np.ndarray
    reasons: dict[str, str] = field(default_factory=dict)

    def verdicts(self, state: Search, fdr: float, trip: np.ndarray) -> list[Verdict]:
        """Why each candidate that the vehicle still lacks was not chosen."""
        out = []
        for id_, s in sorted(self.best.items(), key=lambda kv: -kv[1].gain):
            if state.vehicle.has(id_):
                continue
            why = self.reasons.get(id_) or _why_not(s, self.q[id_], self.absorbed_by.get(id_))
            between = bool(slow(self.matrix[:, list(s.candidate.columns)], trip).all())
            out.append(Verdict(id_, float(s.gain), float(self.q[id_]), why, self._needed(s, fdr), between))
        out += [Verdict(id_, None, 1.0, f"not tried: {why}") for id_, why in self.left_out.items()]
        return out

    def _needed(self, s: Score, fdr: float) -> int | None:
        """Clusters that would do for a candidate that looks right but is not told from chance by those there are."""
        if self.q[s.candidate.id] <= fdr or s.p > HINT or s.candidate.id in self.reasons or not plausible(s):
            return None
        level = fdr / len(self.best)
        return clusters_needed(s.over(self.ways[s.candidate.id]), len(s.beta), self.evidence.count, level)


def _why_not(s: Score, q: float, absorbed_by: str | None) -> str:
    if absorbed_by:
        return f"absorbed: this log cannot tell it from {absorbed_by}"
    if not plausible(s):
        return "its best size has the wrong sign or is out of range"
    if s.left_out_gain <= LEFT_OUT:
        return "does not lower the error on trips left out of the fit"
    if s.p_cluster > s.p_model and q > 0.05:
        return f"too few trips or stretches of time bear it out (q = {q:.2g} with errors clustered)"
    if q > 0.05:
        return f"not significant over the whole library (q = {q:.2g})"
    return "explains less than what was chosen, or too little for the numbers it fits"


def plausible(s: Score) -> bool:
    """Signs, ranges and least sizes; a switch has to make about the whole of its difference."""
    c = s.candidate
    if c.kind == "limit":
        first = c.parameter(c.sizes[0])
        size = abs(dict(c.shapes)[first.name] * s.beta[0])
        return bool((0.02 if first.smooth else 0.4) <= s.beta[0] <= 2.5 and size >= first.least)
    parameters = [c.parameter(n) for n in c.sizes]
    within = all(p.lower <= p.null + b <= p.upper for p, b in zip(parameters, s.beta, strict=True))
    return within and any(abs(b) >= p.least for p, b in zip(parameters, s.beta, strict=True))


def worth(gain: float, c: Candidate) -> float:
    """Gain less what its numbers cost: as BIC would for 400 independent rows a size, 20 a shape.

    Rows of a log are not independent, and what differs only between trips has no more of them than trips.
    """
    return gain - 3.0 * len(c.columns) - 1.5 * (c.freedoms - len(c.columns))


def distance_from_table(fit: Calibration) -> tuple[np.ndarray, np.ndarray]:
    prior = np.array([c.value for c in fit.table.free])
    sd = np.array([c.sd if c.sd is not None else WEAK * c.scale for c in fit.table.free])
    return fit.values - prior, sd


Made = tuple[list[Candidate], np.ndarray, dict[str, str]]


def look(problem: Loop, state: Search, made: Made | None = None) -> View:
    """Whiten, gather and score everything once: the problem's effects, or candidates `made` elsewhere."""
    rows, n = problem.rows, problem.rows.rows
    residual = problem.measured - state.fit.predicted
    noise = estimate_noise(residual, problem.trip, problem.seconds, levels=problem.clusters.kind == "trip")
    car = state.fit.vehicle
    jac = jacobian(car, state.table, rows.segments, problem.target)[:n]
    candidates, matrix, left_out = made or columns(car, problem.effects, rows.segments, n, problem.target)
    evidence, plain = both_looks(problem, state.fit, noise, jac, matrix, residual)
    best, ways = best_of(evidence, plain, candidates, slow(matrix, problem.trip))
    for id_ in {c.id for c in candidates} - set(best):
        left_out[id_] = "does nothing on this log"
    absorbs, absorbed_by = _absorption(evidence, state, best)
    ids = list(best)
    ps = [best[i].over(ways[i]) if i not in absorbed_by else 1.0 for i in ids]
    q = dict(zip(ids, adjusted(ps), strict=True))
    return View(evidence, plain, noise, best, ways, q, left_out, absorbs, absorbed_by, state.fit, residual, jac, matrix)


def slow(matrix: np.ndarray, trip: np.ndarray) -> np.ndarray:
    """Which columns hardly change inside a trip: those that only trips can tell."""
    edges = np.r_[0, np.flatnonzero(np.diff(trip)) + 1]
    rows = np.diff(np.r_[edges, len(trip)])
    means = np.add.reduceat(matrix, edges, axis=0)
    return np.sum(means**2 / rows[:, None], axis=0) > 0.5 * np.sum(matrix**2, axis=0)


def best_of(
    evidence: Evidence, plain: Evidence, candidates: list[Candidate], slow: np.ndarray
) -> tuple[dict[str, Score], dict[str, int]]:
    """The best plausible way to have each effect, and how many ways were tried."""
    totals = evidence.totals()
    before = evidence.base_likelihood(totals)
    ways: dict[str, int] = {}
    ranked: dict[str, list[tuple[float, Candidate]]] = {}
    for c in candidates:
        if min(totals[0, evidence.base + k, evidence.base + k] for k in c.columns) <= 1e-20:
            continue
        gain, _ = evidence.gain(totals, c.columns, before)
        ways[c.id] = ways.get(c.id, 0) + 1
        ranked.setdefault(c.id, []).append((worth(gain, c), c))
    best = {}
    for id_, entries in ranked.items():
        looks = [_first_plausible([evidence.score(c) for _, c in _leading(entries)])]
        scores = [plain.plain_score(c) for _, c in entries if c.kind == "size" and slow[list(c.columns)].all()]
        if scores:
            looks.append(_first_plausible(sorted(scores, key=lambda s: -worth(s.gain, s.candidate))))
        # what both looks see is told by the whitened rows, which see it better
        able = [s for s in looks if plausible(s) and s.left_out_gain > LEFT_OUT] or looks[:1]
        best[id_] = min(able, key=lambda s: (s.p > 1e-6, s.p if s.p > 1e-6 else 0.0))
    return best, ways


def _leading(entries: list[tuple[float, Candidate]]) -> list[tuple[float, Candidate]]:
    return sorted(entries, key=lambda e: -e[0])[:6]


def _first_plausible(scores: list[Score]) -> Score:
    return next((s for s in scores if plausible(s)), scores[0])


def both_looks(
    problem: Loop, fit: Calibration, noise: Noise, jac: np.ndarray, matrix: np.ndarray, residual: np.ndarray
) -> tuple[Evidence, Evidence]:
    """Evidence from whitened rows, and from rows as they are, each worth 1/inflation of its own variance."""
    rows = np.concatenate([jac, matrix, residual[:, None]], axis=1)
    moved, sd = distance_from_table(fit)
    white = whiten(rows, noise, problem.trip, problem.seconds)
    variance = float(np.mean(residual**2)) * fit.inflation
    return (
        gather(white, jac.shape[1], problem.clusters, noise, moved=moved, prior_sd=sd),
        gather_plain(rows, jac.shape[1], problem.clusters, variance=variance, moved=moved, prior_sd=sd),
    )


def evidence_of(problem: Loop, fit: Calibration, noise: Noise) -> Evidence:
    """A fitted vehicle's own Jacobian and residual, whitened; no candidates."""
    jac = jacobian(fit.vehicle, fit.table, problem.rows.segments, problem.target)[: problem.rows.rows]
    white = whiten(np.c_[jac, problem.measured - fit.predicted], noise, problem.trip, problem.seconds)
    moved, sd = distance_from_table(fit)
    return gather(white, jac.shape[1], problem.clusters, noise, moved=moved, prior_sd=sd)


def _absorption(
    evidence: Evidence, state: Search, best: dict[str, Score]
) -> tuple[dict[str, list[str]], dict[str, str]]:
    """Which candidates lie in the span of the fitted coefficients, and of which one mostly."""
    names = [c.name for c in state.table.free]
    absorbs: dict[str, list[str]] = {n: [] for n in names}
    by: dict[str, str] = {}
    total = evidence.totals()[0]
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
