"""One look at a vehicle and a log: what the fitted model leaves, and what every candidate would explain of it."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from hdev_jax.diagnosis.candidates import Candidate, Source, plan_of
from hdev_jax.diagnosis.chunks import CHUNK_ROWS, Shapes, chunks_of_fit
from hdev_jax.diagnosis.evidence import ABSORBED, Evidence, Score
from hdev_jax.diagnosis.facts import Facts, facts_of
from hdev_jax.diagnosis.settle import settle
from hdev_jax.diagnosis.significance import adjusted, clusters_needed, effective_number
from hdev_jax.diagnosis.sums import Ground, both_looks
from hdev_jax.diagnosis.whiten import Noise, estimate_noise
from hdev_jax.inference import Calibration, Clusters, Fit, ParameterTable
from hdev_jax.inference.sheet import BATTERY_TARGETS
from hdev_jax.physics import Effect, Vehicle
from hdev_jax.physics.vehicle import Target
from hdev_jax.segments import trip_slices

__all__ = [
    "CLOSE",
    "LEFT_OUT",
    "Found",
    "Loop",
    "Search",
    "Verdict",
    "View",
    "barred",
    "best_of",
    "look",
    "plausible",
    "scored",
    "worth",
]

HINT = 0.1  # p, before any correction, from which on a candidate is not even hinted at
CERTAIN = 1e-6  # p below which it does not matter how small it is
CLOSE = 0.85  # of what the best is worth, for a candidate to be about as good
LEFT_OUT = 3.0  # least gain in log-likelihood over the clusters left out: chance alone gives about half a unit


@dataclass(frozen=True)
class Found:
    """An effect that was added, and on what evidence. `between`: it hardly changes inside a trip."""

    id: str
    score: Score
    q_value: float
    stability: float
    twins: tuple[str, ...]
    gain: float
    between: bool = False
    alike: int = 0  # how many others would do in its place; `twins` are the best of them


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
    """What stays the same through the loop; passes over its rows take `chunk_rows` of them at a time."""

    rows: Fit
    target: Target
    clusters: Clusters
    effects: Sequence[type[Effect]]
    fdr: float
    rng: np.random.Generator
    gears: int
    chunk_rows: int = CHUNK_ROWS

    @property
    def trip(self) -> np.ndarray:
        return np.asarray(self.rows.segments.trip)[: self.rows.rows]

    @property
    def seconds(self) -> np.ndarray:
        return np.asarray(self.rows.segments.duration_s)[: self.rows.rows]

    @property
    def measured(self) -> np.ndarray:
        return np.asarray(self.rows.measured)[: self.rows.rows]

    @property
    def facts(self) -> Facts:
        """What its candidates depend on beside its rows."""
        return facts_of(self.rows.segments, self.rows.rows)

    def noise(self, fit: Calibration) -> Noise:
        """The noise of what a fit leaves."""
        levels = self.clusters.kind == "trip"
        return estimate_noise(self.measured - fit.predicted, self.trip, self.seconds, levels=levels)

    def ground(self, fit: Calibration, noise: Noise) -> Ground:
        """What passes over these rows stand on, with this fit and noise."""
        lengths = [s.stop - s.start for _, s in trip_slices(self.trip)]
        shapes = Shapes(self.rows.rows, max(lengths), self.chunk_rows)
        return Ground(lambda: chunks_of_fit(self.rows, shapes), self.clusters, len(lengths), fit, self.target, noise)


def barred(problem: Loop, state: Search, effect: type[Effect]) -> str | None:
    """Why an effect that is sought elsewhere than in columns is not sought now; None where it is.

    The reason is empty where there is nothing to say of it: the vehicle has it, or it was not asked for.
    """
    if state.vehicle.has(effect.id) or effect not in problem.effects:
        return ""
    if problem.target not in BATTERY_TARGETS:
        return f"not tried: acts behind the target {problem.target}"
    return "superfluous beside what was added later" if effect.id in state.taken_out else None


@dataclass
class View:
    """One look at all candidates from where the vehicle stands."""

    evidence: Evidence
    plain: Evidence
    ground: Ground
    source: Source
    slow: np.ndarray
    best: dict[str, Score]
    ways: dict[str, float]
    q: dict[str, float]
    left_out: dict[str, str]
    absorbs: dict[str, list[str]]
    absorbed_by: dict[str, str]
    reasons: dict[str, str] = field(default_factory=dict)
    sought: list[Verdict] = field(default_factory=list)  # on what is looked for elsewhere than in columns

    def verdicts(self, state: Search, fdr: float) -> list[Verdict]:
        """Why each candidate that the vehicle still lacks was not chosen."""
        out = []
        for id_, s in sorted(self.best.items(), key=lambda kv: -kv[1].gain):
            if state.vehicle.has(id_):
                continue
            why = self.reasons.get(id_) or _why_not(s, self.q[id_], self.absorbed_by.get(id_))
            out.append(
                Verdict(id_, float(s.gain), float(self.q[id_]), why, self._needed(s, fdr), self.between(s.candidate))
            )
        out += [v for v in self.sought if not state.vehicle.has(v.id)]
        out += [Verdict(id_, None, 1.0, f"not tried: {why}") for id_, why in self.left_out.items()]
        return out

    def between(self, candidate: Candidate) -> bool:
        """Whether its columns hardly change inside a trip, so that only trips can tell it."""
        return bool(self.slow[list(candidate.columns)].all())

    def _needed(self, s: Score, fdr: float) -> int | None:
        """Clusters that would do for a candidate that looks right but is not told from chance by those there are."""
        if self.q[s.candidate.id] <= fdr or s.p > HINT or s.candidate.id in self.reasons or not plausible(s):
            return None
        level = fdr / (2.0 * len(self.best) * self.ways[s.candidate.id])  # before it is corrected as q is
        return clusters_needed(max(s.p_model, s.p_cluster), len(s.beta), self.evidence.count, level)


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


def look(problem: Loop, state: Search, made: Source | None = None) -> View:
    """Whiten, gather and score everything once: the problem's effects, or candidates `made` elsewhere."""
    noise = problem.noise(state.fit)
    fit, _ = settle(ground := problem.ground(state.fit, noise))
    source = made or plan_of(fit.vehicle, problem.effects, problem.facts, problem.target)
    return scored(replace(ground, fit=fit), source)


def scored(ground: Ground, source: Source) -> View:
    """Every candidate of the source scored in one pass over the log's chunks."""
    evidence, plain, slow = both_looks(ground, source)
    best, ways = best_of(evidence, plain, source.candidates, slow)
    left_out = dict(source.left_out)
    for id_ in {c.id for c in source.candidates} - set(best):
        left_out[id_] = "does nothing on this log"
    absorbs, absorbed_by = _absorption(evidence, ground.fit.table, best)
    ids = list(best)
    ps = [min(1.0, best[i].p * ways[i]) if i not in absorbed_by else 1.0 for i in ids]
    q = dict(zip(ids, adjusted(ps), strict=True))
    return View(evidence, plain, ground, source, slow, best, ways, q, left_out, absorbs, absorbed_by)


def best_of(
    evidence: Evidence, plain: Evidence, candidates: Sequence[Candidate], slow: np.ndarray
) -> tuple[dict[str, Score], dict[str, float]]:
    """The best plausible way to have each effect, and how many independent ways were tried."""
    totals = evidence.totals()
    before = evidence.base_likelihood(totals)
    tried: dict[str, int] = {}
    ranked: dict[str, list[tuple[float, Candidate]]] = {}
    for c in candidates:
        if min(totals[0, evidence.base + k, evidence.base + k] for k in c.columns) <= 1e-20:
            continue
        gain, _ = evidence.gain(totals, c.columns, before)
        tried[c.id] = tried.get(c.id, 0) + 1
        ranked.setdefault(c.id, []).append((worth(gain, c), c))
    best, ways = {}, {}
    for id_, entries in ranked.items():
        at = evidence.base + np.unique([k for _, c in entries for k in c.columns])
        ways[id_] = min(float(tried[id_]), effective_number(totals[0][np.ix_(at, at)]))
        looks = [_clearest([evidence.score(c) for _, c in _leading(entries)])]
        scores = [plain.plain_score(c) for _, c in entries if c.kind == "size" and slow[list(c.columns)].all()]
        if scores:
            looks.append(_clearest(sorted(scores, key=lambda s: _falling(worth(s.gain, s.candidate)))))
        # what both looks see is told by the whitened rows, which see it better
        able = [s for s in looks if plausible(s) and s.left_out_gain > LEFT_OUT] or looks[:1]
        best[id_] = min(able, key=lambda s: (s.p > CERTAIN, s.p if s.p > CERTAIN else 0.0))
    return best, ways


def _leading(entries: list[tuple[float, Candidate]]) -> list[tuple[float, Candidate]]:
    return sorted(entries, key=lambda e: _falling(e[0]))[:6]


def _falling(worth: float) -> float:
    """For sorting from the best: ways that come to the same but for rounding keep the order of the library's grids.

    A delay of a row by linear and by cubic interpolation is one column, but where a refit starts from differs.
    """
    return -float(f"{worth:.9g}")


def _clearest(scores: list[Score]) -> Score:
    """The first that is plausible, or one that explains about as much with fewer doubts: a second size may blur it."""
    able = [s for s in scores if plausible(s)]
    if not able or able[0].p <= CERTAIN:
        return (able or scores)[0]
    bar = CLOSE * worth(able[0].gain, able[0].candidate)
    return min((s for s in able if worth(s.gain, s.candidate) >= bar), key=lambda s: s.p, default=able[0])


def _absorption(
    evidence: Evidence, table: ParameterTable, best: dict[str, Score]
) -> tuple[dict[str, list[str]], dict[str, str]]:
    """Which candidates lie in the span of the fitted coefficients, and of which one mostly."""
    names = [c.name for c in table.free]
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
