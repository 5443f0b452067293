"""What is left decides what was found by training rows alone; test rows are for the report."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from bare import bare

from hdev_jax.diagnosis.candidates.expression import Expression
from hdev_jax.diagnosis.remainder import rest
from hdev_jax.diagnosis.remainder.unexplained import Remainder, Rows, remainder
from hdev_jax.diagnosis.scores.look import Found, Loop, Search
from hdev_jax.inference import Calibration, Clusters
from hdev_jax.physics import LIBRARY
from hdev_jax.problem import Problem, Split

TRIPS, ROWS = 8, 150
CYCLE = "not found again beside the cycle for what is left"


def silent(_: str) -> None:
    return None


def side(seed: int, *, size: float) -> Rows:
    """Rows whose residual follows a bump of the first of two features, of so much beside noise of variance 1."""
    rng = np.random.default_rng(seed)
    n = TRIPS * ROWS
    features = rng.uniform(-1, 1, (n, 2))
    residual = size * np.where(np.abs(features[:, 0]) < 0.5, 1.0, -1.0) + rng.standard_normal(n)
    trip = np.repeat(np.arange(TRIPS), ROWS)
    amounts = {"time": np.full(n, 2.0), "distance": np.full(n, 20.0), "energy": np.ones(n)}
    clusters = Clusters(trip, TRIPS, "trip")
    return Rows(features, residual, clusters, trip, np.full(n, 2.0), np.ones(n), "kW", np.ones(n), amounts)


def left_of(train: Rows, test: Rows) -> Remainder:
    return remainder(train, test, ["humidity_pct", "soc"], "Wh", [f"T{k}" for k in range(TRIPS)], seed=0)


def test_what_decides_is_seen_on_training_rows_alone():
    """Test rows without the structure change what is told of it, not its size: that one removes effects."""
    train = side(0, size=1.0)
    there, gone = left_of(train, side(1, size=1.0)), left_of(train, side(1, size=0.0))
    assert there.significant
    assert there.share == pytest.approx(0.5, abs=0.1)
    assert there.correction is not None
    assert there.correction["channel"] == "humidity_pct"
    at, value = np.array(there.correction["at"]), np.array(there.correction["value"])
    clear = np.abs(np.abs(at) - 0.5) > 0.15  # a bin about the edge holds both
    np.testing.assert_allclose(value[clear], np.where(np.abs(at[clear]) < 0.5, 1.0, -1.0), atol=0.4)
    assert not gone.significant
    assert gone.correction is None
    assert gone.scales_with is None
    assert gone.rms == there.rms == pytest.approx(1.0, abs=0.15)
    assert left_of(side(2, size=0.0), side(1, size=1.0)).rms == 0.0


def test_what_a_formula_or_the_learner_predicts_is_no_noise():
    """The floor is under both; a share that training rows do not bear out is told, and lowers nothing."""
    there, chance = left_of(side(0, size=1.0), side(1, size=1.0)), left_of(side(2, size=0.0), side(1, size=1.0))
    assert there.borne_out
    assert not chance.borne_out
    assert there.noise_floor_rmse == pytest.approx(1.0, abs=0.05)
    assert there.described("k·soc", ["soc"], 1.0, "Wh", (1.4, 0.9)).noise_floor_rmse == 0.9
    assert there.described("k·soc", ["soc"], 1.0, "Wh", (1.4, 1.3)).noise_floor_rmse == there.noise_floor_rmse


def test_a_formula_that_explains_test_rows_alone_is_none(monkeypatch):
    """Whether a formula explains enough is asked of training rows, not of test rows nor of those that nobody uses."""
    train = np.arange(300) < 200
    problem = bare(Problem, measured=np.random.default_rng(0).standard_normal(300), segments=None)
    found = bare(Expression, predicted=np.where(train, 0.01, 5.0))
    monkeypatch.setattr(rest, "find_expression", lambda *_, **__: found)
    left = bare(Remainder, cycle_w=np.zeros(200))
    assert rest._formula(problem, train, bare(Search), bare(Loop), np.zeros(300), {}, left, silent) == {}


@pytest.mark.parametrize(
    ("effect", "sizes", "rms", "gone"),
    [
        ("power_gain", ("offset_w",), 0.0, False), ("power_gain", ("offset_w",), 0.1, False),
        ("power_gain", ("offset_w",), 2.0, True), ("auxiliary_power", ("power_w",), 2.0, True),
        ("power_gain", ("gain",), 2.0, False), ("power_gain", ("gain", "offset_w"), 2.0, False),
        *((k, tuple(p.name for p in c.parameters), 2.0, False) for k, c in LIBRARY.items()
          if k not in ("power_gain", "auxiliary_power")),
    ],
)  # fmt: skip
def test_a_constant_goes_where_more_than_it_explains_is_left(effect, sizes, rms, gone):
    """Loads that read nothing and choose nothing alone: a limit or a gain is no mean of what is left."""
    candidate = SimpleNamespace(effect=LIBRARY[effect], sizes=sizes)
    state = bare(Search, found=[SimpleNamespace(id=effect, score=SimpleNamespace(candidate=candidate))])
    problem, train = bare(Problem, measured=np.r_[np.ones(10), np.full(5, 9.0)]), np.arange(15) < 10
    predicted = [np.zeros(15), np.where(train, 1.0, 0.0)]  # explains the training rows: a gain of 1
    left = replace(left_of(side(0, size=0.0), side(1, size=0.0)), rms=rms, significant=rms == 0.0)
    assert rest._shadow(problem, state, predicted, train, left, ()) == (effect if gone else None)
    assert rest._shadow(problem, state, predicted, train, left, (effect,)) is None


@pytest.mark.parametrize(("target", "unit"), [("battery_power_kw", 1.0), ("energy_wh", 10.0)])
def test_what_takes_more_than_a_cycle_could_is_no_stand_in_for_it(target, unit, monkeypatch):
    """A cycle of 1 kW about its mean: a load that is on for most of it takes 2 kW on the average, no more."""
    turn = {"hvac_power": 9.0, "cabin_warmup": 9.0, "auxiliary_power": 3.0, "inverter_loss": 0.1}  # mean squares, kW²
    now = {**turn, "cabin_warmup": 1.0}  # found first, and the next took most of it over
    state = bare(Search, found=[SimpleNamespace(id=k) for k in turn])
    train = np.arange(15) < 10
    segments = SimpleNamespace(duration_s=np.full(15, 36.0))  # 1 kW is 10 Wh
    problem = bare(Problem, measured=np.where(train, 0.0, 99.0), segments=segments, target=target)
    squares = 30.0 - np.cumsum([0.0, *turn.values()])
    predicted = [np.where(train, unit * np.sqrt(x), 0.0) for x in squares]
    fits = {k: SimpleNamespace(fit=SimpleNamespace(vehicle=unit * np.sqrt(squares[-1] + x))) for k, x in now.items()}
    monkeypatch.setattr(rest, "without", lambda _, __, k: fits[k])
    monkeypatch.setattr(Problem, "predict", lambda _, size: np.where(train, size, 0.0))
    cycle = np.full(10, 1000.0)
    small = ("cabin_warmup", "auxiliary_power", "inverter_loss")
    most = rest._most(problem, train, cycle)
    assert most == pytest.approx(4.0 * unit**2)
    assert rest._small(problem, state, bare(Loop), predicted, train, most) == small
    assert rest._small(problem, state, bare(Loop), predicted, train, 0.01 * most) == ()


@pytest.mark.parametrize(("kept", "gone"), [(["headwind"], ["grade_lag"]), (["headwind", "grade_lag"], []), ([], None)])
def test_what_only_stood_beside_a_stand_in_goes_with_it(kept, gone, monkeypatch):
    """All that is left is asked once more, the effect found last too, and each that goes is told why."""
    ids = ["headwind", "auxiliary_power", "grade_lag"]
    gone = ["headwind", "grade_lag"] if gone is None else gone

    def state_of(ids) -> Search:
        found = [bare(Found, id=k, score=SimpleNamespace(gain=9.0), q_value=1e-4) for k in ids]
        return bare(Search, found=found, verdicts=[])

    def prune(loop, state, tell, *, newest):
        assert newest
        return state_of(kept)

    monkeypatch.setattr(rest, "without", lambda loop, state, k: state_of([f.id for f in state.found if f.id != k]))
    monkeypatch.setattr(rest, "prune", prune)
    monkeypatch.setattr(rest, "replace", lambda state, **new: bare(Search, found=state.found, **new))
    left = rest._gone(bare(Loop), state_of(ids), "auxiliary_power", "why", silent)
    assert [f.id for f in left.found] == kept
    beside_it = "not told from nothing without auxiliary_power, which was taken out"
    why = {k: "why" if k == "auxiliary_power" else beside_it for k in ids if k in ("auxiliary_power", *gone)}
    assert [(v.id, v.why_not) for v in left.verdicts] == list(why.items())


@pytest.mark.parametrize(
    ("small", "again", "gone"),
    [
        ((), (), [("auxiliary_power", rest.MEAN_OF_MORE)]),
        (("hvac_power",), ("hvac_power",), [("auxiliary_power", rest.MEAN_OF_MORE)]),
        (("hvac_power",), (), [("hvac_power", CYCLE), ("auxiliary_power", rest.MEAN_OF_MORE)]),
        (("hvac_power", "auxiliary_power"), ("hvac_power", "auxiliary_power"), []),
        (("hvac_power", "auxiliary_power"), (), [("hvac_power", CYCLE), ("auxiliary_power", CYCLE)]),
    ],
)
def test_of_a_cycle_only_what_is_small_is_asked_and_of_more_that_is_left_only_what_was_not(
    small, again, gone, monkeypatch
):
    """A constant load goes where more than it explains is left, whatever else was found and asked about."""
    train, asked, said = np.ones(10, bool), [], []

    def found(id_: str) -> SimpleNamespace:
        effect = LIBRARY[id_]
        sizes = tuple(p.name for p in effect.parameters if p.name.endswith("_w") or "w_per" in p.name)[:1]
        return SimpleNamespace(id=id_, score=SimpleNamespace(candidate=SimpleNamespace(effect=effect, sizes=sizes)))

    def stand_ins(loop, state, channels, tell, of):
        asked.append(tuple(of))
        return tuple(k for k in of if k not in again)

    def take_out(loop, state, id_, why, tell):
        said.append((id_, why))
        return bare(Search, found=[f for f in state.found if f.id != id_])

    left = replace(left_of(side(0, size=0.0), side(1, size=0.0)), rms=9.0, cycle_w=np.full(10, 500.0))
    state = bare(Search, found=[found("hvac_power"), found("auxiliary_power")])
    predicted = [np.full(10, np.sqrt(x)) for x in (50.0, 30.0, 20.0)]
    for name, answer in {
        "_path": lambda p, s, _: [bare(Calibration, vehicle=k) for k in range(len(s.found) + 1)],
        "_remainder": lambda *_: left, "_formula": lambda *_: {},
        "_small": lambda _, s, *__: tuple(k for k in small if k in [f.id for f in s.found]),
        "_most": lambda *_: 1.0,
        "beside": lambda loop, state, _: (loop, state), "stand_ins": stand_ins, "_gone": take_out,
        "replace": lambda loop, **_: loop,
    }.items():  # fmt: skip
        monkeypatch.setattr(rest, name, answer)
    monkeypatch.setattr(Problem, "rows", lambda *_: train)
    monkeypatch.setattr(Problem, "predict", lambda _, k: predicted[k])
    loop = bare(Loop, rows=SimpleNamespace(measured=np.zeros(10)))
    problem, split = bare(Problem, measured=np.zeros(10)), bare(Split, train=(0,), test=(1,))
    rest.told_apart(problem, split, state, loop, seed=0, tell=silent, checkpoint=lambda _, make: make())
    assert said == gone
    assert asked[:1] == ([small] if small else [])


@pytest.mark.parametrize(
    ("found", "seen", "now", "small", "asked"),
    [
        # seen: the cycle of the residual before each effect; now: of that without it, beside all others
        (["hvac_power", "mode_change"], [1, 1], [5, 6], ["hvac_power", "mode_change"], ("mode_change", 6)),
        (["hvac_power", "mode_change"], [2, 0], [5, 6], ["hvac_power", "mode_change"], ("hvac_power", 5)),
        (["hvac_power", "mode_change"], [2, 0], [0, 6], ["hvac_power", "mode_change"], None),  # the other covers it too
        (["hvac_power", "mode_change"], [0, 0], [5, 6], ["hvac_power", "mode_change"], None),
        (["hvac_power", "mode_change"], [0, 3], [5, 6], ["hvac_power"], None),  # takes more than a cycle could
        (["hvac_power", "periodic_load"], [1, 1], [5, 6], ["hvac_power", "periodic_load"], None),  # it is the cycle
        (["periodic_load", "mode_change"], [1, 2], [5, 6], ["periodic_load", "mode_change"], ("mode_change", 6)),
    ],
)  # fmt: skip
@pytest.mark.parametrize("again", [False, True])
def test_who_took_a_cycle_out_of_sight_is_asked(found, seen, now, small, asked, again, monkeypatch):
    """The last effect before which it was seen, if it is seen without it now and its mean could be all that it is."""
    calls = []

    def stand_ins(loop, state, channels, tell, of):
        calls.extend((k, state.found) for k in of)
        return () if again else tuple(of)

    for name, answer in {
        "_side": lambda problem, train, prediction, features: prediction, "swing_w": lambda prediction: prediction,
        "without": lambda loop, state, k: SimpleNamespace(fit=SimpleNamespace(vehicle=now[found.index(k)])),
        "_small": lambda *_, of: tuple(k for k in small if k in of), "_most": lambda *_: 1.0, "stand_ins": stand_ins,
        "beside": lambda loop, state, w: (loop, bare(Search, found=w[0])),
    }.items():  # fmt: skip
        monkeypatch.setattr(rest, name, answer)
    monkeypatch.setattr(Problem, "predict", lambda _, vehicle: np.full(5, float(vehicle)))
    state = bare(Search, found=[SimpleNamespace(id=k) for k in found])
    loop = bare(Loop, rows=SimpleNamespace(measured=np.zeros(8)))
    predicted = [np.full(5, float(x)) for x in (*seen, 0)]
    told = rest._beside_covered(bare(Problem), state, loop, predicted, np.ones(5, bool), silent)
    assert calls == ([asked] if asked else [])
    superfluous = [] if again else [asked[0]] if asked else []
    assert told == ({"asked": [asked[0]], "superfluous": superfluous, "covered": True} if asked else {})


def test_beside_a_cycle_effects_are_asked_though_the_fit_did_not_converge(monkeypatch):
    """Kept for that, two of forty effects that stood in for a cycle were named."""
    known = bare(Search, fit=SimpleNamespace(converged=False))
    monkeypatch.setattr(rest, "beside", lambda loop, state, w: (loop, known))
    monkeypatch.setattr(rest, "stand_ins", lambda loop, state, channels, tell, of: tuple(of))
    loop = bare(Loop, rows=SimpleNamespace(measured=np.zeros(8)))
    told = rest._beside_cycle(bare(Search), loop, np.ones(5), ("hvac_power",), silent)
    assert told == {"asked": ["hvac_power"], "superfluous": ["hvac_power"]}


@pytest.mark.parametrize("again", [(), ("hvac_power",)])
def test_beside_what_rows_follow_effects_are_asked_again_and_it_is_said(again, monkeypatch):
    """A stand-in goes with its reason; what is left is called by its channel in either case, and told once."""
    train, said, kept = np.ones(10, bool), [], []
    found = SimpleNamespace(id="hvac_power", score=SimpleNamespace(candidate=SimpleNamespace(sizes=("power_w",))))

    def hinted(problem, state, loop, predicted, train, tell):
        asked = [f.id for f in state.found]
        gone = [k for k in asked if k not in again]
        return {
            "words": "[humidity_pct > 70]", "channels": ["humidity_pct"], "rms": 3.0,
            "asked": asked, "superfluous": gone,
        }  # fmt: skip

    def take_out(loop, state, id_, why, tell):
        said.append((id_, why))
        return bare(Search, found=[])

    left = left_of(side(0, size=0.0), side(1, size=0.0))
    assert not left.significant
    for name, answer in {
        "_path": lambda p, s, _: [bare(Calibration, vehicle=k) for k in range(len(s.found) + 1)],
        "_remainder": lambda *_: left, "_formula": lambda *_: {}, "_hinted": hinted, "_gone": take_out,
        "replace": lambda loop, **_: loop,
    }.items():  # fmt: skip
        monkeypatch.setattr(rest, name, answer)
    monkeypatch.setattr(Problem, "rows", lambda *_: train)
    monkeypatch.setattr(Problem, "predict", lambda _, k: np.full(10, float(k)))
    problem, split = bare(Problem, measured=np.zeros(10)), bare(Split, train=(0,), test=(1,))
    state = bare(Search, found=[found])
    loop = bare(Loop, rows=SimpleNamespace(measured=np.zeros(10)))
    state, _, _, rest_of_it = rest.told_apart(
        problem, split, state, loop, seed=0, tell=silent,
        checkpoint=lambda name, make: (kept.append(name), make())[1],
    )  # fmt: skip
    assert rest_of_it.significant
    assert rest_of_it.depends_on == ("humidity_pct",)
    assert rest_of_it.rms == 3.0
    assert "rows follow [humidity_pct > 70]" in rest_of_it.signature
    assert [f.id for f in state.found] == list(again)
    assert said == ([] if again else [("hvac_power", "not found again beside what rows follow for what is left")])
    assert kept.count("hint-0") == 1


@pytest.mark.parametrize("duty", [0.05, 0.3, 0.5, 0.78])
def test_the_mean_of_a_load_that_is_on_and_off_by_its_swing(duty):
    on = np.arange(10_000) < duty * 10_000
    swing = 2.0 * abs(np.fft.rfft(on)[1]) / 10_000
    assert on.mean() < rest.MEAN_OVER_SWING * swing
