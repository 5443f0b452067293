"""Forward: the leaders compete in joint refits, and one that passes every gate is taken."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from hdev_jax.diagnosis.competition.grid import LEADERS
from hdev_jax.diagnosis.competition.refit import Refit, refit
from hdev_jax.diagnosis.competition.state import Found, State
from hdev_jax.diagnosis.gates.gates import DRAWN_GATES, SCORE_GATES, Asked, first_rejection, of_class
from hdev_jax.diagnosis.gates.rejection import Rejection
from hdev_jax.diagnosis.scores.evidence import Score
from hdev_jax.diagnosis.scores.scores import CERTAIN, Scores, inside
from hdev_jax.diagnosis.training import Training

__all__ = ["Round", "forward"]


@dataclass
class Round:
    """One step of the competition: the scores of all candidates, why some were rejected, which exchanges of two were
    tested, and its random draws."""

    training: Training
    state: State
    scores: Scores
    rng: np.random.Generator
    tell: Callable[[str], None] = lambda _: None
    reasons: dict[str, Rejection] = field(default_factory=dict)
    tested: list[str] = field(default_factory=list)

    def asked(self, s: Score) -> Asked:
        """What the gates look at for a candidate of this round."""
        out = frozenset((*self.reasons, *self.state.refused))
        return Asked(s, self.scores, self.training.trip, self.rng, out, self.state.barred)

    def passes(self, s: Score) -> bool:
        """Whether a candidate passes the gates of its score."""
        return first_rejection(self.asked(s), SCORE_GATES) is None

    def turned_down(self, id_: str, why: Rejection) -> None:
        """Note why a candidate is out for this round."""
        self.reasons[id_] = why
        self.tell(f"rejected {id_}: {why}")


TRIES = 4  # rounds of leaders in one step


def forward(round_: Round, *, skip: Collection[str] = (), only: Collection[str] | None = None) -> State | None:
    """The state with the candidate that passes every gate, refitted; None where none does. Goes on past one that
    fails; `only` these, without those to `skip`."""
    scores, settings = round_.scores, round_.training.settings
    done = {*round_.state.barred, *skip}
    for _ in range(TRIES):
        # in each round again: an effect taken in fewer groups has another p, which changes every adjusted p-value
        wanted = scores.best if only is None else {k: s for k, s in scores.best.items() if k in only}
        able = [s for id_, s in wanted.items() if id_ not in done and round_.passes(s)]
        # candidates of generalised least squares first; those of ordinary least squares when nothing else is left
        able.sort(key=lambda s: (s.plain, -scores.worth(s)))
        if not able:
            return None
        able = _constant_first(scores, able)
        first, members = _plainest(round_, able)
        bar = settings.close * scores.worth(first)
        rivals = [s for s in able if s.plain == first.plain and s.candidate.id not in members]
        close = [first, *(s for s in rivals[: LEADERS - 1] if scores.worth(s) >= bar)]
        fits = [(s, fit) for s in close if (fit := _refitted(round_, s)) is not None]
        done |= {s.candidate.id for s in close}
        each = [(taken, fit, max(fit.gain, taken.gain) if taken.plain else fit.gain) for taken, fit in fits]
        each.sort(key=lambda f: -scores.worth(replace(f[0], gain=f[2])))
        for s, fit, gain in each:
            if (new := _taken(round_, s, fit, gain)) is not None:
                return new
    return None


def _constant_first(scores: Scores, able: list[Score]) -> list[Score]:
    """The candidates in their order; if a load leads whose p-value is not tiny, and a constant load has a smaller one,
    without the loads that are less significant than the constant.

    Generalised least squares compare a row with its neighbours: they see little of a constant, and more of a load that
    begins, ends or grows, by which name a constant would be found first.
    """

    def p(s: Score) -> float:
        return s.p * scores.ways[s.candidate.id]

    def is_load(s: Score) -> bool:
        effect = s.candidate.effect
        units = {s.candidate.parameter(n).unit for n in s.candidate.sizes}
        return units == {"W"} and effect.stage == "battery" and not effect.of_efficiency

    constant = next((s for s in able if is_load(s) and s.candidate.constant), None)
    if constant is None or not is_load(able[0]) or p(able[0]) <= max(CERTAIN, p(constant)):
        return able
    asked = [constant, *(s for s in able if not (is_load(s) and p(s) >= p(constant)))]
    return sorted(asked, key=lambda s: (s.plain and s is not constant, -scores.worth(s)))


def _plainest(round_: Round, able: Sequence[Score]) -> tuple[Score, set[str]]:
    """The leader, or the simplest of those that these rows cannot distinguish from it; and the ids of the class.

    Where one efficiency is declared for all of it, and the leader is a gain, a mass or a limit that a wrong efficiency
    looks like, the efficiency that does about as well takes its place; or the mass that of a gain.
    """

    def asks(s: Score) -> tuple[int, int]:
        effect = s.candidate.effect
        return effect.instrument + (effect.stage == "sensors"), s.candidate.freedoms

    def prior(s: Score) -> tuple[bool, bool]:
        return s.candidate.effect.instrument, not s.candidate.effect.of_efficiency

    same = {able[0].candidate.id, *of_class(round_.asked(able[0]), inexact=0.0)}
    first = min((s for s in able if s.candidate.id in same), key=asks)
    library = round_.training.library.values()
    looks_like = {id_ for c in library if c.of_efficiency for id_ in c.mistaken_for}
    gives_way = asks(first)[0] or first.candidate.kind == "limit"
    if not (round_.state.fit.vehicle.one_efficiency and first.candidate.id in looks_like and gives_way):
        return first, same
    members = {*of_class(round_.asked(first))}
    instead = [
        s for s in able if s.candidate.id in members
        and (s.candidate.effect.of_efficiency or (s.candidate.id in looks_like and asks(s)[0]))
        and (asks(first)[0] or s.candidate.freedoms <= first.candidate.freedoms)
    ]  # fmt: skip
    return min((first, *instead), key=prior), same | members


def _refitted(round_: Round, s: Score) -> Refit | None:
    """A candidate's joint refit, None where it fails.

    Without a group (a gear) or a size that the refit puts out of range it is another candidate, which passes every gate
    again.
    """
    again = round_.scores.again(s)
    round_.tell(f"refitting with {s.candidate.id}")
    came = refit(round_.training, round_.state, s, round_.scores)
    while came.fit is None and came.fewer is not None:
        s = inside(again([came.fewer])[0], again)
        round_.scores.replaced(s)
        if not round_.passes(s):
            break
        round_.tell(f"refitting {s.candidate.id} with {len(s.candidate.sizes)} of its sizes")
        came = refit(round_.training, round_.state, s, round_.scores)
    if came.fit is None:
        round_.turned_down(s.candidate.id, Rejection(came.kind))
        return None
    return came


def _taken(round_: Round, s: Score, came: Refit, gain: float) -> State | None:
    """The state with a refitted candidate, if it passes the remaining gates."""
    state, scores, id_ = round_.state, round_.scores, s.candidate.id
    s = scores.best[id_]  # as it was taken: perhaps in fewer groups
    asked = round_.asked(s)
    if (why := first_rejection(asked, (*SCORE_GATES, *DRAWN_GATES))) is not None:
        round_.turned_down(id_, why)
        return None
    assert came.fit is not None
    found = Found(
        id_,
        came.score,
        float(scores.q[id_]),
        asked.stability,
        of_class(asked),
        float(gain),
    )  # fmt: skip
    round_.tell(f"added {id_}")
    return replace(state, fit=came.fit, found=(*state.found, found))
