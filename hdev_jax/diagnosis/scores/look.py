"""One look at a vehicle and a log: what the fitted model leaves, and what every candidate would explain of it."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy import stats

from hdev_jax.diagnosis.candidates.candidate import Candidate, Source, plan_of
from hdev_jax.diagnosis.candidates.facts import Facts, facts_of
from hdev_jax.diagnosis.noise.model import Noise, estimate_noise
from hdev_jax.diagnosis.scores.chunks import CHUNK_ROWS, Shapes, chunks_of_fit
from hdev_jax.diagnosis.scores.evidence import ABSORBED, Evidence, Score
from hdev_jax.diagnosis.scores.ranking import LEFT_OUT, best_of, plausible
from hdev_jax.diagnosis.scores.settle import settle
from hdev_jax.diagnosis.scores.significance import clusters_needed, clusters_to_tell, least_clusters, ruled_out
from hdev_jax.diagnosis.scores.sums import Ground, both_looks
from hdev_jax.inference import Calibration, Clusters, Fit, ParameterTable
from hdev_jax.inference.sheet import BATTERY_TARGETS
from hdev_jax.physics import Effect, Vehicle
from hdev_jax.physics.vehicle import Target
from hdev_jax.segments import trip_slices

__all__ = [
    "Found",
    "Loop",
    "Search",
    "Verdict",
    "View",
    "barred",
    "look",
    "scored",
]

HELD = 0.5  # of what trips differ by: what a cause that they alone tell is asked to hold
HINT = 0.1  # p, before any correction, from which on a candidate is not even hinted at


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

    `needed`: with how many clusters like these it could be told from chance; `between`: only trips can tell it, and
    where nothing hints at it `needed` is what would do for half of what they differ by; `by_rows`: rows alone say it as
    surely as is asked.
    """

    id: str
    score: float | None
    q_value: float
    why_not: str
    needed: int | None = None
    between: bool = False
    by_rows: bool = False


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
    exchanged: tuple[str, ...] = ()  # left for another that does more in its place: takes no other's place
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
    left_out: dict[str, str]
    absorbs: dict[str, list[str]]
    absorbed_by: dict[str, str]
    reasons: dict[str, str] = field(default_factory=dict)
    in_other_forms: set[str] = field(default_factory=set)  # say no more than what was found would in another form
    sought: list[Verdict] = field(default_factory=list)  # on what is looked for elsewhere than in columns
    q: dict[str, float] = field(init=False)

    def __post_init__(self) -> None:
        self._correct()

    def _correct(self) -> None:
        every = [1.0 if k in self.absorbed_by else min(1.0, s.p * self.ways[k]) for k, s in self.best.items()]
        self.q = dict(zip(self.best, map(float, stats.false_discovery_control(every)), strict=True))

    def retaken(self, s: Score) -> None:
        """Have an effect in another way than the one that looked best, and correct every p anew."""
        self.best[s.candidate.id] = s
        self._correct()

    def counted(self, id_: str, ways: float) -> None:
        """Count so many times the ways in which an effect was tried, and correct every p anew."""
        self.ways[id_] *= ways
        self._correct()

    def verdicts(self, state: Search, fdr: float) -> list[Verdict]:
        """Why each candidate that the vehicle still lacks was not chosen."""
        out = []
        for id_, s in sorted(self.best.items(), key=lambda kv: -kv[1].gain):
            if state.vehicle.has(id_):
                continue
            why = self.reasons.get(id_) or _why_not(s, self.q[id_], fdr, self.absorbed_by.get(id_), self.evidence.count)
            by_rows = not s.plain and bool(s.p_model <= self.level(id_, fdr))
            needed, between = self._needed(s, fdr), self.between(s.candidate)
            out.append(Verdict(id_, float(s.gain), float(self.q[id_]), why, needed, between, by_rows))
        out += [v for v in self.sought if not state.vehicle.has(v.id)]
        out += [Verdict(id_, None, 1.0, f"not tried: {why}") for id_, why in self.left_out.items()]
        return out

    def between(self, candidate: Candidate) -> bool:
        """Whether its columns hardly change inside a trip, so that only trips can tell it."""
        return bool(self.slow[list(candidate.columns)].all())

    def level(self, id_: str, fdr: float) -> float:
        """What a p of one test has to be, by Bonferroni over the library, and over rows whitened and as they are."""
        return fdr / (2.0 * len(self.best) * self.ways[id_])

    def _needed(self, s: Score, fdr: float) -> int | None:
        """Clusters that would do for a candidate that looks right but is not told from chance by those there are, or
        that the rows of too few of them speak for; or trips, for one that they alone tell, and that may hold half of
        what they differ by for all that these say."""
        id_, k, count = s.candidate.id, len(s.beta), self.evidence.count
        if self.q[id_] <= fdr or id_ in self.reasons or id_ in self.absorbed_by or not plausible(s):
            return None
        level = self.level(id_, fdr)
        p = max(s.p_model, s.p_cluster)
        if s.p <= HINT or s.p_model <= level:
            return clusters_needed(p, k, count, level)
        if self.ground.clusters.kind != "trip" or not self.between(s.candidate) or ruled_out(HELD, p, k, count):
            return None
        needed = clusters_to_tell(HELD, k, level)
        return needed if needed is not None and needed > count else None


def _why_not(s: Score, q: float, fdr: float, absorbed_by: str | None, clusters: int) -> str:
    if absorbed_by:
        return f"absorbed: this log cannot tell it from {absorbed_by}"
    if clusters < (least := least_clusters(len(s.beta))):
        return f"not decidable: {least} trips or stretches of time are needed at least, {clusters} to train on"
    if not plausible(s):
        return "its best size has the wrong sign or is out of range"
    if s.left_out_gain <= LEFT_OUT:
        return "does not lower the error on trips left out of the fit"
    if s.p_cluster > s.p_model and q > fdr:
        return f"too few trips or stretches of time bear it out (q = {q:.2g} with errors clustered)"
    if q > fdr:
        return f"not significant over the whole library (q = {q:.2g})"
    return "explains less than what was chosen, or too little for the numbers it fits"


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
    for id_ in sorted({c.id for c in source.candidates} - set(best)):
        left_out[id_] = "does nothing on this log"
    absorbs, absorbed_by = _absorption(evidence, ground.fit.table, best, source.candidates)
    return View(evidence, plain, ground, source, slow, best, ways, left_out, absorbs, absorbed_by)


def _absorption(
    evidence: Evidence, table: ParameterTable, best: dict[str, Score], candidates: Sequence[Candidate]
) -> tuple[dict[str, list[str]], dict[str, str]]:
    """Which candidates lie in the span of the fitted coefficients, and of which one mostly.

    Of an effect with several sizes one may: a gain, though not the offset beside it. A coefficient may have absorbed
    that effect too, which by its other ways can still be found.
    """
    names = [c.name for c in table.free]
    absorbs: dict[str, list[str]] = {n: [] for n in names}
    by: dict[str, str] = {}
    if not names:
        return absorbs, by
    plainest = [c for c in candidates if c.kind == "size" and c.id in best and c.freedoms == len(c.columns) == 1]
    for c in [*(s.candidate for s in best.values() if s.left <= ABSORBED), *plainest]:
        left, weights = min((evidence.span(k) for k in c.columns), key=lambda x: x[0])
        if left > ABSORBED or any(c.id in ids for ids in absorbs.values()):
            continue
        name = names[int(np.argmax(np.abs(weights)))]
        absorbs[name].append(c.id)
        if best[c.id].left <= ABSORBED:
            by[c.id] = name
    return absorbs, by
