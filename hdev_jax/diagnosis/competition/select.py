"""The choice among candidates: the leaders compete in joint refits, and one that clears every bar is taken."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy import stats

from hdev_jax.diagnosis.candidates.candidate import Candidate
from hdev_jax.diagnosis.competition.refit import Refitted, is_size, refit, without
from hdev_jax.diagnosis.gates.forms import another_form
from hdev_jax.diagnosis.scores.chunks import Chunk
from hdev_jax.diagnosis.scores.evidence import Score
from hdev_jax.diagnosis.scores.look import Found, Loop, Search, View
from hdev_jax.diagnosis.scores.ranking import CLOSE, LEFT_OUT, STABLE, inside, plausible, worth
from hdev_jax.diagnosis.scores.sums import evidence_of, written_by_chunk

__all__ = ["choose", "clears", "prune", "twins_of"]

MOST_TWINS = 2  # that are named beside an effect
LEADERS = 3  # candidates that are refitted jointly before one is taken
PLACEBOS = 199
RESAMPLES = 100
TRIES = 4  # rounds of refits in one step before the loop ends


def choose(
    problem: Loop, state: Search, view: View, tell: Callable[[str], None], *, skip: Sequence[str], tries: int = TRIES,
    forms: bool = True,
) -> Search | None:  # fmt: skip
    """The candidate that clears every bar, refitted; None where none does. Keeps going past one that fails.

    `forms`: whether it has to say more than what was found would in another form. What describes the rest need not,
    nor what was found before the rest.
    """
    done = {*state.taken_out, *skip}
    for _ in range(tries):
        # each round anew: an effect that was taken in fewer groups has another p, and with it all have another q
        able = [s for id_, s in view.best.items() if id_ not in done and clears(problem, view, s)]
        # what rows tell comes first; what only the clusters tell, when nothing else is left
        able.sort(key=lambda s: (s.plain, -worth(s.gain, s.candidate)))
        if not able:
            break
        first = able[0]
        bar = CLOSE * worth(first.gain, first.candidate)
        close = [
            s for s in able[:LEADERS] if s is first or (s.plain == first.plain and worth(s.gain, s.candidate) >= bar)
        ]
        fits = []
        for s in close:
            tried = _tried(problem, state, s, view, tell)
            if isinstance(tried, str):
                view.reasons[s.candidate.id] = tried
            else:
                taken, fitted = tried
                gain = max(fitted[1], taken.gain) if taken.plain else fitted[1]
                fits.append((worth(gain, taken.candidate), taken, fitted, gain))
        done |= {s.candidate.id for s in close}
        fits.sort(key=lambda f: -f[0])
        for _, s, (new, _, started), gain in fits:
            c = s.candidate
            if not clears(problem, view, s):
                tell(f"turned down {c.id}: it does not clear every bar beside what has changed")
                continue
            why = _placebo(problem, s, view)
            if why is None and forms and (why := another_form(problem, state, s, view)) is not None:
                view.in_other_forms.add(c.id)
            if why is not None:
                view.reasons[c.id] = why
                tell(f"turned down {c.id}: {why}")
                continue
            alike = twins_of(view, s)
            twins = alike[:MOST_TWINS]
            stability = _stability(problem, view, s, {c.id, *twins}, state.refused)
            if stability < STABLE:
                view.reasons[c.id] = f"comes first in only {100 * stability:.0f} % of resampled sets of trips"
                tell(f"turned down {c.id}: {view.reasons[c.id]}")
                continue
            found = Found(
                c.id, started, float(view.q[c.id]), stability, twins, float(gain), view.between(c), len(alike)
            )
            return replace(new, found=[*state.found, found])
    return None


def clears(problem: Loop, view: View, s: Score) -> bool:
    """Whether a candidate clears what is asked of its score."""
    told = view.q[s.candidate.id] <= problem.fdr and s.left_out_gain > LEFT_OUT
    return told and plausible(s) and worth(s.gain, s.candidate) > 0


def _tried(
    problem: Loop, state: Search, s: Score, view: View, tell: Callable[[str], None]
) -> tuple[Score, Refitted] | str:
    """A candidate as it was taken, with its joint refit, or why it fails.

    Without a group (a gear) that the refit puts beyond nothing it is another candidate, which clears every bar anew: as
    scored at the shapes that it started from, however much finer ones were sought before.
    """
    scores = view.plain.plain_scores if s.plain else view.evidence.scores
    tell(f"refitting with {s.candidate.id}")
    while isinstance(tried := refit(problem, state, s, view), Candidate):
        s = inside(scores([tried])[0], scores)
        view.retaken(s)
        if not clears(problem, view, s):
            by = s.candidate.parameter(s.candidate.sizes[0]).by.replace("_", " ")
            return f"in the joint refit it does nothing in one {by} or more, and the others do not clear every bar"
        tell(f"refitting {s.candidate.id} with {len(s.candidate.groups)} groups")
    return (s, tried) if tried is not None else "in the joint refit it is out of range or not told from nothing"


def _placebo(problem: Loop, s: Score, view: View, draws: int = 19) -> str | None:
    """Why a placebo does as well, or None.

    A column that changes inside trips is moved in time by a random amount in each; one that hardly does is given a
    random sign in each trip instead. (Signs mean little to an effect of two or three trips, shifts nothing to a
    constant.)
    """
    column = written_by_chunk(view.ground, view.source, s.candidate.columns)
    edges = np.flatnonzero(np.diff(problem.trip)) + 1
    parts = np.split(np.arange(len(column)), edges)
    within = np.concatenate([column[p] - column[p].mean(axis=0) for p in parts])
    if s.plain or np.sum(within**2) < 0.2 * np.sum(column**2):
        evidence = view.plain if s.plain else view.evidence
        signs = evidence.sign_placebos(s, problem.rng, PLACEBOS)
        if np.mean(signs >= s.gain) > 0.01:
            return "a placebo (its column with the trips' signs drawn at random) does as well"
        return None
    sizes = [len(p) for p in parts]
    shifts = [[int(problem.rng.integers(n // 8, max(n - n // 8, 2))) for n in sizes] for _ in range(draws)]
    k = column.shape[1]

    def shifted(out: np.ndarray, chunk: Chunk) -> None:
        own = column[chunk.at]
        for t, trip in enumerate(chunk.slices(), start=chunk.first_trip):
            for i, by in enumerate(shifts):
                out[trip, i * k : (i + 1) * k] = np.roll(own[trip], by[t], axis=0)

    evidence = evidence_of(view.ground, draws * k, shifted)
    totals = evidence.totals()
    before = evidence.base_likelihood(totals)
    gains = [evidence.gain(totals, range(i * k, (i + 1) * k), before)[0] for i in range(draws)]
    return "a placebo (its column shifted in time) does as well" if max(gains) >= s.gain else None


def twins_of(view: View, s: Score) -> tuple[str, ...]:
    """Other effects that, put in its place, leave the chosen one insignificant and explain as much, the best first."""
    total = view.evidence.totals()
    before = view.evidence.base_likelihood(total)
    out: list[tuple[float, str]] = []
    for id_, other in view.best.items():
        if id_ == s.candidate.id or id_ in view.absorbed_by or not plausible(other):
            continue
        both = tuple(dict.fromkeys((*other.candidate.columns, *s.candidate.columns)))
        if s.plain:
            rival = view.plain.plain_score(other.candidate).gain
            beside = view.plain.beside(other.candidate.columns, s.candidate.columns)
        else:
            rival = view.evidence.gain(total, other.candidate.columns, before)[0]
            gain = view.evidence.gain(total, both, before)[0] - rival
            beside = float(stats.chi2.sf(2 * max(gain, 0.0), len(s.candidate.columns)))
        if rival > 0.8 * s.gain and beside > 0.05:
            out.append((-rival, id_))
    return tuple(id_ for _, id_ in sorted(out))


def _stability(problem: Loop, view: View, chosen: Score, names: set[str], refused: Sequence[str]) -> float:
    """Share of resampled sets of clusters in which the same effect (or its class) comes first of its kind.

    Its rivals are those that clusters could be speaking for at all (p at most 0.01 before any correction) and that
    no joint refit or placebo has turned down.
    """
    g = view.evidence.count
    down = {*view.reasons, *refused}
    rivals = [
        s
        for s in view.best.values()
        if s.plain == chosen.plain and s.p <= 0.01 and s.candidate.id not in {*view.absorbed_by, *down} and plausible(s)
    ]
    rivals = [chosen, *sorted((s for s in rivals if s is not chosen), key=lambda s: -s.gain)[:7]]
    small = [(view.plain if s.plain else view.evidence).only(s.candidate) for s in rivals]
    hits = 0
    for _ in range(RESAMPLES):
        drawn = problem.rng.integers(0, g, g)
        weight = np.bincount(drawn, minlength=g).astype(float)
        gains = []
        for s, (evidence, candidate) in zip(rivals, small, strict=True):
            if s.plain:
                gain = replace(evidence, grams=evidence.grams[drawn]).plain_score(candidate).gain
            else:
                gain = evidence.gain(evidence.totals(weight), candidate.columns)[0]
            gains.append(worth(gain, candidate))
        hits += rivals[int(np.argmax(gains))].candidate.id in names and max(gains) > 0
    return hits / RESAMPLES


def prune(problem: Loop, state: Search, tell: Callable[[str], None], *, newest: bool = False) -> Search:
    """Backward: an effect that the others made superfluous goes, the weakest first.

    The `newest` has just cleared every bar beside the others and is not asked, unless those are others now.
    """
    while asked := state.found if newest else state.found[:-1]:
        evidence = evidence_of(problem.ground(state.fit, problem.noise(state.fit)))
        worst: tuple[float, Found] | None = None
        for f in asked:
            c = f.score.candidate
            if c.kind == "limit" and not c.parameter(c.sizes[0]).smooth:
                continue  # a switch is either there or not: its size says nothing against zero, as a lag's does
            at = [k for k, free in enumerate(state.table.free) if is_size(free.path, f)]
            p = evidence.present(at, state.fit.values[at])
            if p > 0.05 and (worst is None or p > worst[0]):
                worst = (p, f)
        if worst is None:
            break
        drop = worst[1].id
        tell(f"taking {drop} out again")
        state = replace(without(problem, state, drop), taken_out=(*state.taken_out, drop))
    return state
