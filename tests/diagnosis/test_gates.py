"""Gates as data: what each turns down, in which words, and what more trips would decide."""

from dataclasses import replace

import numpy as np
import pytest
from planted import declared, opened, training

from hdev_jax.diagnosis.competition.forward import Round, forward
from hdev_jax.diagnosis.competition.state import Verdict
from hdev_jax.diagnosis.competition.verdicts import verdicts_of
from hdev_jax.diagnosis.gates.gates import DRAWN_GATES, SCORE_GATES, Asked, first_rejection, of_class
from hdev_jax.diagnosis.gates.rejection import Kind, Rejection
from hdev_jax.diagnosis.remainder.remainder import Remainder
from hdev_jax.diagnosis.result.summary import _not_decidable
from hdev_jax.diagnosis.scores.scores import score_all
from hdev_jax.diagnosis.settings import SETTINGS, described
from hdev_jax.inference import Fit

LIBRARY = ("standstill_load", "headwind", "cabin_warmup", "auxiliary_power", "drafting", "hvac_power")
EVERY = (*SCORE_GATES, *DRAWN_GATES)


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """A log with a load at standstill: the problem, its rows with a few candidates, and the declared model."""
    options = {"effects": {"standstill_load": {}}, "ratio": 1.0}
    _, problem, _ = opened(tmp_path_factory.mktemp("log"), seed=61, trips=10, **options)
    rows = training(problem, LIBRARY)
    return problem, rows, declared(rows, problem)


@pytest.fixture
def scores(log):
    return score_all(log[1], log[2].fit)


def asked(log, scores, id_: str, **values) -> Asked:
    """The best score of an effect with some of its numbers changed, among all scores."""
    s = replace(scores.best[id_], **values)
    scores.replaced(s)
    return Asked(s, scores, log[1].trip, np.random.default_rng(0))


def test_what_is_there_passes_every_gate(log, scores):
    a = asked(log, scores, "standstill_load")
    assert first_rejection(a, EVERY) is None
    assert a.stability > 0.9
    assert of_class(a) == ()


@pytest.mark.parametrize(
    ("values", "kind", "numbers"),
    [
        ({"beta": np.ones(12)}, Kind.TOO_FEW_CLUSTERS, {"least": 14, "there": 10, "unit": "trips"}),
        ({"beta": np.array([-4000.0])}, Kind.IMPLAUSIBLE, {"sizes": [-4000.0]}),
        ({"left_out_gain": 1.0}, Kind.NOT_CONFIRMED, {"left_out_gain": 1.0, "unit": "trips"}),
        ({"p_model": 1.0}, Kind.NOT_SIGNIFICANT, {"q": 1.0}),
        ({"p_cluster": 1.0}, Kind.NOT_SIGNIFICANT, {"q": 1.0}),
        ({"beta": np.array([9e4]), "plain": True}, Kind.CONTRADICTED, {"share": 0.25}),
        ({"gain": 2.0}, Kind.OUTSCORED, {"worth": -2.5}),
    ],
)
def test_the_first_gate_that_a_score_does_not_pass_says_why(values, kind, numbers, log, scores):
    why = first_rejection(asked(log, scores, "standstill_load", **values), EVERY)
    assert why == Rejection(kind, numbers)


@pytest.mark.parametrize("inexact", [False, True])
def test_what_explains_little_of_the_error_is_not_named(inexact, log, scores):
    scores.inexact = inexact
    a = asked(log, scores, "standstill_load")
    assert first_rejection(a, EVERY) is None
    at = a.score.candidate.columns
    looks = [scores.plain] if inexact else [scores.plain, scores.white]
    shares = [e.gain(e.totals(), at)[0] / e.misfit() for e in looks]
    for least, passes in ((0.99 * max(shares), True), (1.01 * max(shares), False)):
        scores.settings = replace(scores.settings, least_share=least)
        why = first_rejection(a, SCORE_GATES)
        assert (why is None) is passes
        assert why is None or (why.kind, why.numbers["least"]) == (Kind.SMALL, least)
    scores.settings = replace(scores.settings, least_share=2.0)
    constant = first_rejection(asked(log, scores, "auxiliary_power", p_model=0.0, p_cluster=0.0, gain=1e3), SCORE_GATES)
    assert (constant is not None and constant.kind is Kind.SMALL) is inexact


def test_what_a_coefficient_takes_up_is_said_first(log, scores):
    scores.absorbed_by["standstill_load"] = "road.c_rr"
    why = first_rejection(asked(log, scores, "standstill_load", left_out_gain=-9.0), EVERY)
    assert why is not None
    assert (why.kind, why.numbers["by"]) == (Kind.ABSORBED, "road.c_rr")
    assert why.numbers["plausible"]
    why = first_rejection(asked(log, scores, "standstill_load", beta=np.array([-100.0])), EVERY)
    assert why is not None
    assert not why.numbers["plausible"], "a load below nothing is no reason"


@pytest.mark.parametrize("plain", [False, True], ids=["shifted in time", "signs at random"])
def test_a_gain_that_placebos_reach_is_none(plain, log, scores):
    why = first_rejection(asked(log, scores, "standstill_load", gain=-1.0, plain=plain), DRAWN_GATES)
    assert why is not None
    assert why.kind is Kind.PLACEBO
    assert ("signs" in str(why)) is plain


@pytest.mark.parametrize(
    ("setting", "value", "kind"),
    [
        ("absorbed", 1.1, Kind.ABSORBED), ("ahead", 1e9, Kind.NOT_CONFIRMED), ("fdr", 0.0, Kind.NOT_SIGNIFICANT),
        ("size_cost", 1e9, Kind.OUTSCORED), ("stands", 1e9, Kind.REFIT), ("stable", 1.1, Kind.UNSTABLE),
        ("fdr", 0.05, None),
    ],
)  # fmt: skip
def test_the_settings_decide(setting, value, kind, log):
    """One number changed, and what is there is turned down by the gate that the number is of."""
    _, rows, state = log
    rows = replace(rows, settings=replace(SETTINGS, **{setting: value}))
    round_ = Round(rows, state, score_all(rows, state.fit), np.random.default_rng(0))
    new = forward(round_, only={"standstill_load"})
    verdict = {v.id: v.rejection.kind for v in verdicts_of(round_, [])}
    assert (new is not None and new.ids == ("standstill_load",)) is (kind is None)
    assert kind is None or verdict["standstill_load"] is kind
    assert verdict["drafting"] is Kind.UNAVAILABLE


def test_an_effect_without_a_column_has_none(log):
    _, rows, state = log
    calm = rows.rows.segments.with_channels(wind_speed_mps=np.zeros(len(rows.rows.segments)))
    rows = replace(rows, rows=Fit(calm, rows.rows.measured, rows.rows.weight, rows.rows.rows))
    round_ = Round(rows, state, score_all(rows, state.fit), np.random.default_rng(0))
    assert {v.id: v.rejection.kind for v in verdicts_of(round_, [])}["headwind"] is Kind.NO_EFFECT


# --- words -------------------------------------------------------------------------------------------------------

NUMBERS = {
    "reason": "needs the channel gap_m", "by": "road.c_rr", "least": 3, "there": 2, "q": 0.21, "how": "its column",
    "percent": 12.4, "name": "road.c_rr", "z": 3.2, "beside": "headwind", "share": 0.25,
    "channels": "grade_rad",
}  # fmt: skip


@pytest.mark.parametrize("kind", Kind)
def test_every_kind_is_worded(kind):
    said = str(Rejection(kind, NUMBERS))
    assert said
    assert not set("{}") & set(said)
    stretches = str(Rejection(kind, {**NUMBERS, "unit": "stretches of driving"}))
    assert stretches.replace("stretches of driving", "trips") == said
    assert str(Rejection(kind, {"detail": "special to one effect"})) == "special to one effect"


def test_every_setting_is_described():
    told = described()
    assert len({s["name"] for s in told}) == len(told)
    for s in told:
        assert all(s[k] for k in ("name", "meaning", "unit", "source")), s
        assert getattr(SETTINGS, s["name"]) == s["default"]


# --- what more trips would decide --------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["trip", "block"])
def test_only_trips_tell_what_lives_between_them(kind, log):
    """A load that a log of few trips neither shows nor rules out; stretches of a trip, which share its level, are no
    trips, and rows decide on what changes inside them."""
    _, rows, state = log
    rows = replace(rows, clusters=replace(rows.clusters, kind=kind))

    def needed(slow: bool, **values) -> int | None:
        scores = score_all(rows, state.fit)
        score = replace(scores.best["hvac_power"], **values)
        scores.slow = np.full_like(scores.slow, slow)
        scores.replaced(score)
        verdicts = verdicts_of(Round(rows, state, scores, np.random.default_rng(0)), [])
        return next(v.needed for v in verdicts if v.id == "hvac_power")

    k = len(score_all(rows, state.fit).best["hvac_power"].beta)
    unclear = {"p_model": 0.2, "p_cluster": 0.2, "beta": np.full(k, 300.0)}
    assert (needed(True, **unclear) is None) == (kind == "block")
    assert kind == "block" or needed(True, **unclear) > rows.clusters.count
    assert needed(True, **{**unclear, "beta": np.full(k, -300.0)}) is None
    assert needed(False, **unclear) is None
    hinted = needed(False, **{**unclear, "p_model": 0.04, "p_cluster": 0.04})
    assert hinted is not None
    assert hinted > rows.clusters.count


def test_between_trips_a_log_knows_no_more_than_it_has_trips():
    left = Remainder(False, 0.1, 1.0, (), "", trips_differ=True)  # suspected is enough
    why = Rejection(Kind.NOT_SIGNIFICANT, {"q": 1.0})
    hinted = Verdict("hvac_power", 2.0, 1.0, why, needed=40, between=True)
    inside = Verdict("headwind", 2.0, 1.0, why, needed=30)
    strong = Verdict("wet_road", 20.0, 0.2, why, needed=50)
    rows_alone = Verdict("regen_limit", 90.0, 1.0, why, needed=110, by_rows=True)
    others = [Verdict(f"effect_{k}", 0.1, 1.0, why, needed=45 + k, between=True) for k in range(4)]
    every = [inside, *others, rows_alone, strong, hinted]
    said = [(s["id"], s["clusters_needed"]) for s in _not_decidable(every, left, SETTINGS)]
    between = [("hvac_power", 40), *((f"effect_{k}", 45 + k) for k in range(4))]
    assert said == [("wet_road", 50), ("regen_limit", 110), *between]
    alike = _not_decidable(every, replace(left, trips_differ=False), SETTINGS)
    assert [s["id"] for s in alike] == ["wet_road", "regen_limit"]
