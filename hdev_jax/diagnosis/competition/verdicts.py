"""Verdicts on the candidates that were not chosen, and how many trips would decide on them."""

from collections.abc import Sequence

from hdev_jax.diagnosis.competition.forward import Round
from hdev_jax.diagnosis.competition.state import Verdict
from hdev_jax.diagnosis.gates.gates import SCORE_GATES, first_rejection
from hdev_jax.diagnosis.gates.rejection import Kind, Rejection
from hdev_jax.diagnosis.scores.evidence import Score
from hdev_jax.diagnosis.scores.scores import NO_EFFECT, plausible
from hdev_jax.diagnosis.scores.significance import clusters_needed, clusters_to_tell, ruled_out

__all__ = ["verdicts_of"]


def verdicts_of(round_: Round, sought: Sequence[Verdict]) -> tuple[Verdict, ...]:
    """Why each candidate outside the model was not chosen; `sought`, verdicts of the searches without columns."""
    scores, state, out = round_.scores, round_.state, []
    vehicle = scores.baseline.fit.vehicle
    for id_, s in sorted(scores.best.items(), key=lambda kv: -kv[1].gain):
        if vehicle.has(id_):
            continue
        why = (
            round_.reasons.get(id_)
            or first_rejection(round_.asked(s), SCORE_GATES)
            or state.removed.get(id_)
            or Rejection(Kind.OUTSCORED, {"worth": scores.worth(s)})
        )
        by_rows = not s.plain and bool(s.p_model <= scores.level(id_))
        between = scores.between(s.candidate)
        out.append(Verdict(id_, float(s.gain), float(scores.q[id_]), why, _needed(round_, s), between, by_rows))
    out += [v for v in sought if not vehicle.has(v.id)]
    for id_, reason in scores.left_out.items():
        kind = Kind.NO_EFFECT if reason == NO_EFFECT else Kind.UNAVAILABLE
        out.append(Verdict(id_, None, 1.0, Rejection(kind, {"reason": reason})))
    return tuple(out)


def _needed(round_: Round, s: Score) -> int | None:
    """How many clusters would be enough for a candidate that is plausible but not yet significant. For a candidate that
    differs only between trips: how many trips, where the data allow that it explains half of their differences."""
    scores, settings = round_.scores, round_.training.settings
    id_, k, count = s.candidate.id, len(s.beta), scores.white.count
    if scores.q[id_] <= settings.fdr or id_ in round_.reasons or id_ in scores.absorbed_by:
        return None
    if not plausible(s, settings):
        return None
    level = scores.level(id_)
    p = max(s.p_model, s.p_cluster)
    if s.p <= settings.hint or s.p_model <= level:
        some = s.plain or s.candidate.effect.between_trips
        rests_on = scores.evidence(s).rests_on(s.candidate) if some else None
        return clusters_needed(p, k, count, level, rests_on)
    if scores.baseline.clusters.kind != "trip" or not scores.between(s.candidate):
        return None
    if ruled_out(settings.half, p, k, count):
        return None
    needed = clusters_to_tell(settings.half, k, level)
    return needed if needed is not None and needed > count else None
