"""Columns of candidates against differences of whole vehicles; the vehicle that a candidate stands for."""

from dataclasses import replace
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from planted import opened, training

from hdev_jax.diagnosis.candidates.candidate import Candidate, finer, realised
from hdev_jax.diagnosis.candidates.facts import facts_of
from hdev_jax.diagnosis.candidates.plan import columns, plan_of
from hdev_jax.diagnosis.candidates.programs import Program
from hdev_jax.diagnosis.candidates.shared import SharedKernel, absent
from hdev_jax.diagnosis.scores.evidence import Score
from hdev_jax.diagnosis.scores.scores import inside, plausible, without_idle
from hdev_jax.diagnosis.settings import SETTINGS
from hdev_jax.inference import ParameterTable, effect_coefficients, linearised, padded, predict
from hdev_jax.inference.parameters import insert
from hdev_jax.physics import LIBRARY, Effect, Grouped, Shape, Size, Vehicle, at_null
from hdev_jax.problem import Problem

# by hook and kind: force, power and sensor effects of one row, sums over a trip, groups, switches, shifts
SIZES = ("headwind", "auxiliary_power", "mass_scale", "tyre_warmup", "hvac_power", "gear_efficiency", "brake_drag")
LIMITS = ("regen_cutoff", "regen_limit", "grade_lag")


@pytest.fixture(scope="module")
def problem(tmp_path_factory: pytest.TempPathFactory) -> Problem:
    return opened(tmp_path_factory.mktemp("log"), seed=2, trips=9, rows_per_trip=60)[1]


@pytest.fixture(scope="module")
def rows(problem: Problem):
    return padded(problem.segments, problem.measured)


@pytest.fixture(scope="module")
def gathered(problem: Problem, rows) -> tuple[list[Candidate], np.ndarray, dict[str, str]]:
    effects = [LIBRARY[k] for k in (*SIZES, *LIMITS, "traction_limit", "drafting")]
    return columns(problem.vehicle, effects, rows.segments, rows.rows, problem.target)


def with_values(cls: type[Effect], gears: int, **values: Any) -> Effect:
    """The effect at its null with some values; `(gear, x)` sets one of a group. No code of the candidates."""
    null = at_null(cls, gears=gears)
    leaves = {p.name: getattr(null, p.name) for p in cls.parameters}
    for name, value in values.items():
        if isinstance(value, tuple):
            leaves[name] = Grouped(leaves[name].values.at[value[0]].set(value[1]), leaves[name].by)
        else:
            leaves[name] = np.asarray(value, dtype=float)
    return cls(**leaves)


def predicted(problem: Problem, rows, vehicle: Vehicle) -> np.ndarray:
    return np.asarray(vehicle.predict(rows.segments, problem.target))[: rows.rows]


def of(gathered, effect_id: str) -> list[Candidate]:
    found = [c for c in gathered[0] if c.id == effect_id]
    assert found
    return found


@pytest.mark.parametrize("effect_id", SIZES)
def test_columns_are_derivatives(effect_id, problem, rows, gathered):
    """Central differences of the vehicle with the effect, at the shapes of the first and of the last candidate."""
    every = of(gathered, effect_id)
    gears = int(np.max(problem.segments.channels["gear"]))
    for c in {id(c): c for c in (every[0], every[-1])}.values():
        assert c.kind == "size"
        for name, group, at in zip(c.sizes, c.groups, c.columns, strict=True):
            # rows that stand have a kink at no wind, |w| w, so the step is small
            h = 1e-5 * abs(c.parameter(name).scale)
            up, down = (
                predicted(problem, rows, problem.vehicle.plus(
                    with_values(c.effect, gears, **dict(c.shapes), **{name: x if group is None else (group, x)})
                ))
                for x in (h, -h)
            )  # fmt: skip
            slope, column = (up - down) / (2 * h), gathered[1][:, at]
            assert np.any(column != 0)
            # rows within h of the efficiency's switch have a kink between the two
            off = np.abs(column - slope) > 1e-5 * np.max(np.abs(slope))
            assert np.mean(off) < 0.01


@pytest.mark.parametrize("effect_id", LIMITS)
def test_columns_of_switches_are_differences(effect_id, problem, rows, gathered):
    """Of the vehicle with the switch at its place and without it; other limits of the effect are out."""
    base = predicted(problem, rows, problem.vehicle)
    every = of(gathered, effect_id)
    for c in (every[0], every[-1]):
        assert c.kind == "limit"
        with_ = problem.vehicle.plus(realised(c, np.ones(1)))
        np.testing.assert_allclose(
            gathered[1][:, c.columns[0]], predicted(problem, rows, with_) - base, rtol=1e-9, atol=1e-9 * np.std(base)
        )
        at = dict(c.shapes)[c.sizes[0]]
        assert at != c.parameter(c.sizes[0]).null
    assert {dict(c.shapes)[c.sizes[0]] for c in every} == {dict(c.shapes)[c.sizes[0]] for c in set(every)}


def test_programs_that_a_search_shares_make_the_same_columns(problem, rows):
    """Of one-row effects and across rows, beside found effects that lack a size or a switch; whatever was found, there
    is one kernel."""
    facts = facts_of(rows.segments, rows.rows)
    ids = ("auxiliary_power", "mass_scale", "tyre_warmup", "hvac_power", "gear_efficiency", "regen_limit", "grade_lag")
    effects = [LIBRARY[k] for k in (*ids, "sampling_filter", "power_gain", "headwind")]
    found = [
        with_values(LIBRARY["auxiliary_power"], facts.gears, power_w=900.0),
        with_values(LIBRARY["hvac_power"], facts.gears, above_w_per_k=60.0, cool_c=20.0),
        with_values(LIBRARY["gear_efficiency"], facts.gears, delta=(1, -0.01)),
    ]
    lag = LIBRARY["sampling_filter"](tap_1=np.asarray(0.1), tap_2=np.asarray(0.0), tau_s=None)
    programs, kernel = [], SharedKernel({c.id: c for c in effects}, facts, rows.segments)
    for has in (found[:1], [*found, lag]):
        vehicle = problem.vehicle.plus(*has)
        apart = plan_of(vehicle, effects, facts, problem.target)
        shared = plan_of(vehicle, effects, facts, problem.target, kernel=kernel)
        assert shared.left_out == apart.left_out
        a, b = (np.zeros((len(rows.segments), p.width)) for p in (apart, shared))
        apart.write(a, rows.segments)
        shared.write(b, rows.segments)
        by_way = {replace(c, columns=()): b[:, c.columns] for c in shared.candidates}
        # the column of a switch is the difference of two predictions, each of them rounded
        rounding = (
            4.0 * np.finfo(float).eps * np.max(np.abs(np.asarray(vehicle.predict(rows.segments, problem.target))))
        )
        assert len(by_way) == len(apart.candidates) == len(shared.candidates)
        for c in apart.candidates:
            expected = a[: rows.rows, c.columns]
            scale = np.max(np.abs(expected)) + 1e-300
            same = by_way[replace(c, columns=())][: rows.rows]
            np.testing.assert_allclose(same, expected, atol=1e-9 * scale + rounding)
        kernels = [r.program.parts[1] for r in shared.recipes]
        programs.append({(p.structure, jax.tree.structure(p.car)) for p in kernels})
    assert programs[0] == programs[1]
    assert len(programs[0]) == 1


@pytest.mark.parametrize("short", [True, False])
def test_the_shared_kernel_gives_the_same_prediction_and_jacobian(problem, rows, monkeypatch, short):
    """Beside effects of one row, across rows (a delay of the readings) and of the instrument, with every coefficient
    free; whatever was found, the kernel is compiled once, and each instrument. On a long log each set of effects has
    its own program, compiled once."""
    if not short:
        monkeypatch.setattr("hdev_jax.diagnosis.candidates.shared.SHORT_ROWS", rows.rows - 1)
    facts = facts_of(rows.segments, rows.rows)
    found = [
        with_values(LIBRARY["auxiliary_power"], facts.gears, power_w=900.0),
        with_values(LIBRARY["hvac_power"], facts.gears, above_w_per_k=60.0, cool_c=20.0),
        with_values(LIBRARY["time_skew"], facts.gears, skew_s=0.7),
        with_values(LIBRARY["power_gain"], facts.gears, gain=0.02),
    ]
    effects = ["auxiliary_power", "hvac_power", "time_skew", "power_gain", "cornering", "headwind"]
    kernel, programs = SharedKernel({k: LIBRARY[k] for k in effects}, facts, rows.segments), set()
    instruments = set()
    for has in (found[:1], found):
        vehicle = problem.vehicle.plus(*has)
        own = [c for e in has for c in effect_coefficients(e, [p.name for p in e.parameters if p.has_column])]
        table = ParameterTable((*problem.table.rows, *own))
        theta = table.values(vehicle) * 1.01
        expected = linearised(vehicle, table, rows.segments, problem.target, theta)
        got = kernel.linearised(vehicle, table, rows.segments, problem.target, theta)
        for a, b in zip(got, expected, strict=True):
            assert np.all(np.abs(a - b) <= 1e-9 * np.max(np.abs(b), axis=0))
        plain = np.asarray(predict(vehicle, rows.segments, problem.target))
        shared = kernel.predict(vehicle, rows.segments, problem.target)
        assert np.all(np.abs(shared - plain) <= 1e-12 * np.max(np.abs(plain)))
        whole = kernel._of_table(vehicle, table, shared=short)[0]
        assert kernel._of_table(table.insert(vehicle, theta), table, shared=short)[0] is whole
        _, part, after = whole.parts
        programs.add((part.structure, jax.tree.structure(part.car)))
        instruments |= {(x.structure, jax.tree.structure(x.car)) for x in after}
    assert kernel.serves(vehicle, problem.target) == short
    assert len(programs) == (1 if short else 2)
    assert len(instruments) == 2


@pytest.mark.parametrize("short", [True, False])
def test_the_shared_kernel_has_the_effects_that_were_searched_for(problem, rows, monkeypatch, short):
    """A load that switches, by its decoded state, a cycle with a phase and a mode in each trip, the last of them
    unknown: one program whatever their sizes and phases, another one where a trip more has a phase; of a long log also
    where there is one effect more."""
    if not short:
        monkeypatch.setattr("hdev_jax.diagnosis.candidates.shared.SHORT_ROWS", rows.rows - 1)
    facts = facts_of(rows.segments, rows.rows)
    segments = rows.segments.with_channels(**{"derived:switching_load": np.arange(len(rows.measured)) // 7 % 2.0})
    trips = int(np.max(np.asarray(segments.trip)))
    effects = ("switching_load", "periodic_load", "mode_change", "auxiliary_power", "headwind")
    kernel, programs = SharedKernel({k: LIBRARY[k] for k in effects}, facts, rows.segments), []

    def by_trip(cls: type[Effect], name: str, known: np.ndarray, **values: float) -> Effect:
        effect = with_values(cls, facts.gears, **values)
        return eqx.tree_at(lambda e: getattr(e, name), effect, Grouped(jnp.asarray([*known, np.nan]), "trip"))

    for k, more in ((1.0, 0), (1.7, 0), (1.7, 1)):
        phases = np.linspace(-0.5, 0.5, trips + more) * k
        has = [
            with_values(LIBRARY["switching_load"], facts.gears, power_w=2000.0 * k),
            by_trip(LIBRARY["periodic_load"], "phase", phases, power_w=800.0 * k, period_s=300.0 * k, duty=0.4),
            by_trip(LIBRARY["mode_change"], "in_mode", (phases > 0) * 1.0, loss=0.05 * k, share=0.5),
            *([with_values(LIBRARY["auxiliary_power"], facts.gears, power_w=900.0)] if k > 1.0 else []),
        ]
        vehicle, sizes = problem.vehicle.plus(*has), ["power_w", "loss"]
        table = ParameterTable((*problem.table.rows, *(c for e in has for c in effect_coefficients(e, sizes))))
        assert kernel._of_library(vehicle)
        assert kernel.serves(vehicle, problem.target) == short
        programs.append(kernel._of_table(vehicle, table, shared=short)[0])
        if more:  # another program of the same kind
            continue
        expected = linearised(vehicle, table, segments, problem.target)
        got = kernel.linearised(vehicle, table, segments, problem.target)
        for a, b in zip(got, expected, strict=True):
            assert np.all(np.abs(a - b) <= 1e-9 * np.max(np.abs(b), axis=0))
        np.testing.assert_allclose(kernel.predict(vehicle, segments, problem.target), expected[0], rtol=1e-9)
    assert (programs[0] is programs[1]) == short
    assert programs[1] is not programs[2]


def test_a_change_of_mode_has_the_same_columns_by_shared_programs(problem, rows):
    facts, mode = facts_of(rows.segments, rows.rows), LIBRARY["mode_change"]
    effects = [LIBRARY[k] for k in ("auxiliary_power", "headwind")]
    kernel = SharedKernel({c.id: c for c in (*effects, mode)}, facts, rows.segments)
    vehicle = problem.vehicle.plus(with_values(effects[0], facts.gears, power_w=900.0))
    on = {"in_mode": (1.0,), "share": (0.5,)}
    plans = [plan_of(vehicle, [mode], facts, problem.target, on, searched=True, kernel=k) for k in (kernel, None)]
    assert plans[0].candidates == plans[1].candidates
    a, b = (np.zeros((len(rows.segments), p.width)) for p in plans)
    for out, plan in zip((a, b), plans, strict=True):
        plan.write(out, rows.segments)
    assert np.all(np.std(b, axis=0) > 0)
    np.testing.assert_allclose(a, b, atol=1e-9 * np.max(np.abs(b)))


class Amplified(Effect):
    """An amplifier that draws power itself, so that it acts in the kernel and behind it."""

    id = "amplified"
    stage = "battery"
    equation = "P → (P + P₀)(1 + g)"
    parameters = (Size("gain", "1", 0.0, 0.1, -1.0, 1.0), Size("power_w", "W", 0.0, 1e3))
    gain: Any
    power_w: Any

    def power(self, row, car, point):
        return self.power_w

    def observe(self, column, segments):
        return column * (1.0 + self.gain)


@pytest.mark.parametrize("target", ["energy_wh", "motor_torque_nm"])
def test_instruments_show_the_column_one_after_the_other(problem, rows, target):
    """Also where one of them acts in the kernel too; values and slopes as of the whole vehicle."""
    facts = facts_of(rows.segments, rows.rows)
    known = [absent(LIBRARY[k], facts) for k in ("power_gain", "time_skew", "auxiliary_power")]
    program = Program.of(problem.vehicle, [*known, absent(Amplified, facts)])
    values = program.null + 0.1 * np.arange(1, len(program.null) + 1)
    column, slopes = program.linearised(rows.segments, target, values, range(len(values)))

    @jax.jit
    def whole(x):
        return insert(program.car, program.structure, x).predict(rows.segments, target)

    expected = np.asarray(whole(jnp.asarray(values)))
    np.testing.assert_allclose(column, expected, atol=1e-9 * np.max(np.abs(expected)))
    np.testing.assert_allclose(program.predicted(rows.segments, target, values), column, rtol=1e-12)
    for got, slope in zip(slopes.T, np.asarray(jax.jit(jax.jacfwd(whole))(jnp.asarray(values))).T, strict=True):
        np.testing.assert_allclose(got, slope, atol=1e-9 * np.max(np.abs(slope)))


class Fading(Effect):
    """Without a slope at the usual value of its shape, 0."""

    id = "fading"
    stage = "battery"
    equation = "P = P₀ exp(−t/τ)"
    parameters = (
        Size("power_w", "W", 0.0, 1e3),
        Shape("tau_s", "s", 0.0, 10.0, 0.0, 1e3, grid=(100.0, 300.0)),
    )
    power_w: Any
    tau_s: Any

    def power(self, row, car, point):
        return self.power_w * jnp.exp(-row.duration_s / self.tau_s)


class RootOfSpeed(Effect):
    """With an infinite slope in the speed where it stands."""

    id = "root_of_speed"
    stage = "battery"
    equation = "P = w √v"
    parameters = (Size("w", "W/√(m/s)", 0.0, 1e2),)
    w: Any

    def power(self, row, car, point):
        return self.w * jnp.sqrt(row.speed_mps)


def test_a_reading_that_is_no_number_harms_no_vehicle_that_does_not_use_it(problem, rows):
    """Absent effects are at their null in the shared kernel, and 0 times what is no number is none."""
    spoilt = np.array(rows.segments.channels["ambient_temp_c"])
    spoilt[7] = np.nan
    segments = rows.segments.with_channels(ambient_temp_c=spoilt)
    facts, effects = facts_of(segments, rows.rows), [LIBRARY[k] for k in ("auxiliary_power", "hvac_power")]
    vehicle = problem.vehicle.plus(with_values(effects[0], facts.gears, power_w=900.0))
    table = ParameterTable((*problem.table.rows, *effect_coefficients(vehicle.effect("auxiliary_power"), ["power_w"])))
    plain = linearised(vehicle, table, segments, problem.target)
    for seen in (segments, rows.segments):  # in training rows, and only in others
        kernel = SharedKernel({c.id: c for c in effects}, facts, seen)
        assert kernel.serves(vehicle, problem.target) == (seen is rows.segments)
        for a, b in zip(kernel.linearised(vehicle, table, segments, problem.target), plain, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-9)
        np.testing.assert_allclose(kernel.predict(vehicle, segments, problem.target), plain[0], rtol=1e-9)
    assert np.all(np.isfinite(plain[0]))


@pytest.mark.parametrize("long", [False, True])
def test_an_effect_of_a_user_does_no_harm_to_other_columns(problem, rows, long):
    facts = facts_of(rows.segments, rows.rows)
    facts = replace(facts, rows=100_000) if long else facts
    effects = [LIBRARY[k] for k in ("speed_scale", "auxiliary_power", "tyre_warmup")]
    kernel = SharedKernel({c.id: c for c in effects}, facts, rows.segments)
    alone = plan_of(problem.vehicle, effects, facts, problem.target, kernel=kernel)
    every = [Fading, *effects, RootOfSpeed]
    with_own = SharedKernel({c.id: c for c in every}, facts, rows.segments)
    beside = plan_of(problem.vehicle, every, facts, problem.target, kernel=with_own)
    a, b = (np.zeros((len(rows.segments), p.width)) for p in (alone, beside))
    alone.write(a, rows.segments)
    beside.write(b, rows.segments)
    columns_of = {replace(c, columns=()): b[:, c.columns] for c in beside.candidates}
    for c in alone.candidates:
        np.testing.assert_array_equal(columns_of[replace(c, columns=())], a[:, c.columns])
    own = {c.id: columns_of[replace(c, columns=())] for c in beside.candidates if c.id in ("fading", "root_of_speed")}
    assert all(np.any(x != 0) for x in own.values())
    assert len(own) == 2


@pytest.mark.parametrize("effect_id", SIZES)
def test_a_realised_candidate_has_its_coefficients(effect_id, problem, gathered):
    c = of(gathered, effect_id)[-1]
    gears = int(np.max(problem.segments.channels["gear"]))
    beta = np.arange(1.0, 1.0 + len(c.sizes))
    effect = realised(c, beta, gears=gears)
    for name, group, b in zip(c.sizes, c.groups, beta, strict=True):
        leaf = getattr(effect, name)
        assert float(leaf if group is None else leaf.values[group]) == b
    for name, value in c.shapes:
        assert float(getattr(effect, name)) == value


def test_the_null_of_everything_is_the_vehicle(problem, rows, gathered):
    """What the derivatives are taken at predicts what the declared vehicle does."""
    base = predicted(problem, rows, problem.vehicle)
    gears = int(np.max(problem.segments.channels["gear"]))
    for effect_id in SIZES:
        null = problem.vehicle.plus(at_null(LIBRARY[effect_id], gears=gears))
        np.testing.assert_allclose(predicted(problem, rows, null), base, rtol=1e-12, err_msg=effect_id)


def test_what_the_log_cannot_show_is_left_out_with_a_reason(gathered):
    assert "drafting" in gathered[2]
    assert "gap_m" in gathered[2]["drafting"]
    assert not any(c.id == "drafting" for c in gathered[0])
    assert set(gathered[2]) == {"drafting"}


def test_an_effect_that_the_vehicle_has_is_no_candidate(problem, rows):
    car = problem.vehicle.plus(with_values(LIBRARY["headwind"], 1, scale=0.9))
    found, matrix, left_out = columns(
        car, [LIBRARY[k] for k in ("headwind", "auxiliary_power")], rows.segments, rows.rows, problem.target
    )
    assert {c.id for c in found} == {"auxiliary_power"}
    assert matrix.shape == (rows.rows, 1)
    assert left_out == {}


def test_none_at_all(problem, rows):
    found, matrix, _ = columns(problem.vehicle, [], rows.segments, rows.rows, problem.target)
    assert found == []
    assert matrix.shape == (rows.rows, 0)


@pytest.mark.parametrize("effect_id", ["tyre_warmup", "hvac_power", "regen_cutoff", "grade_lag"])
def test_finer_grids(effect_id, problem, gathered):
    """About where the candidate stands, inside the plausible range; what goes in proportion stays where it is."""
    row_s = float(np.median(problem.segments.duration_s))
    for c in of(gathered, effect_id):
        grids = finer(c, row_s)
        assert set(grids) == {n for n, _ in c.shapes}
        for name, at in c.shapes:
            p = c.parameter(name)
            assert min(abs(np.array(grids[name]) - at)) < 1e-9 * max(abs(at), 1.0)
            assert all(p.lower <= x <= p.upper for x in grids[name])
            if p.smooth:
                assert grids[name] == (at,)


def test_drag_of_the_driveline_is_sought_in_every_gear(problem, rows):
    """Nothing declared stands for the commonest gear, as an efficiency does for `gear_efficiency`."""
    (c,), made, _ = columns(problem.vehicle, [LIBRARY["driveline_drag"]], rows.segments, rows.rows, problem.target)
    assert (c.sizes, c.groups) == (("torque_nm",) * 4, (1, 2, 3, 4))
    car, segments = problem.vehicle, problem.segments
    ratio = np.array([9.16, 5.27, 3.33, 2.16])[np.asarray(segments.channels["gear"], dtype=int) - 1] * 4.5 / 0.5
    turns = ratio * np.asarray(segments.distance_m) / (2 * np.pi)
    for gear, k in zip(c.groups, c.columns, strict=True):  # a newton metre over a turn is 2π joules
        expected = np.where(segments.channels["gear"] == gear, 2 * np.pi * turns / 3600, 0.0)
        np.testing.assert_allclose(made[:, k], expected, rtol=1e-9, atol=1e-12)
    back = realised(c, np.array([1.0, 2.0, 3.0, 4.0]), gears=4)
    added = predicted(problem, rows, car.plus(back)) - predicted(problem, rows, car)
    np.testing.assert_allclose(added, made[:, list(c.columns)] @ [1.0, 2.0, 3.0, 4.0], rtol=1e-6, atol=1e-9)


def test_without_a_gear_drag_of_the_driveline_is_one_number(problem):
    segments = replace(problem.segments, channels={k: v for k, v in problem.segments.channels.items() if k != "gear"})
    rows = padded(segments, problem.measured)
    effects = [LIBRARY[k] for k in ("driveline_drag", "gear_efficiency")]
    (c,), made, left_out = columns(problem.vehicle, effects, rows.segments, rows.rows, problem.target)
    assert (c.id, c.sizes, c.groups) == ("driveline_drag", ("torque_nm",), (None,))
    assert set(left_out) == {"gear_efficiency"}
    car = problem.vehicle.plus(realised(c, np.array([7.0])))
    added = predicted(problem, rows, car) - predicted(problem, rows, problem.vehicle)
    np.testing.assert_allclose(added, 7.0 * made[:, c.columns[0]], rtol=1e-6, atol=1e-9)


def test_an_effect_by_gear_starts_as_one_number_each_where_the_log_tells_no_gear():
    """Sizes that a variant leaves out too: nothing may ask for a gear then."""

    class TwoDrags(LIBRARY["driveline_drag"]):
        parameters: ClassVar = tuple(
            Size(n, "Nm", 0.0, 5.0, 0.0, 200.0, by="gear", whole=True) for n in ("torque_nm", "more_nm")
        )
        variants: ClassVar = (("torque_nm",), ("more_nm",))
        more_nm: Any

    c = Candidate(TwoDrags, ("more_nm",), (None,), (), "size", (0,))
    effect = realised(c, np.array([4.0]))
    assert float(effect.more_nm) == 4.0
    assert float(effect.torque_nm) == 0.0
    by_gear = realised(replace(c, groups=(2,)), np.array([4.0]), gears=3)
    np.testing.assert_array_equal(by_gear.more_nm.values, [0.0, 0.0, 4.0, 0.0])
    np.testing.assert_array_equal(by_gear.torque_nm.values, np.zeros(4))


def test_groups_may_go_one_by_one_and_other_sizes_all_together(problem):
    effects = [LIBRARY[k] for k in ("driveline_drag", "hvac_power")]
    every, _, _ = columns(problem.vehicle, effects, problem.segments, len(problem.measured), problem.target)
    drag = next(c for c in every if c.id == "driveline_drag")
    two = drag.only([False, True, True, False])
    assert two is not None
    assert (two.sizes, two.groups, two.columns) == (("torque_nm",) * 2, (2, 3), drag.columns[1:3])
    assert drag.only([True] * 4) is drag
    assert drag.only([False] * 4) is None
    both = next(c for c in every if len(c.sizes) == 2 and c.id == "hvac_power")
    assert both.only([True, True]) is both
    assert both.only([True, False]) is None, "heating without cooling is a way of its own, with its own shapes"


def test_only_a_group_beyond_a_null_that_bounds_it_goes(problem):
    """A torque below nothing is a gear without drag; one of 300 Nm, or a delta of half, says the effect is another."""
    effects = [LIBRARY[k] for k in ("driveline_drag", "gear_efficiency", "hvac_power")]
    every, _, _ = columns(problem.vehicle, effects, problem.segments, len(problem.measured), problem.target)
    drag, efficiency = (next(c for c in every if c.id == k) for k in ("driveline_drag", "gear_efficiency"))
    both = next(c for c in every if len(c.sizes) == 2 and c.id == "hvac_power")
    fewer = without_idle(drag, np.array([9.0, -0.5, -2.0, 8.0]))
    assert fewer is not None
    assert fewer.groups == (1, 2, 4), "the furthest goes first"
    assert without_idle(drag, np.array([9.0, 2.5, 7.0, 300.0])) is None
    assert without_idle(efficiency, np.full(len(efficiency.sizes), -0.5)) is None
    assert without_idle(both, np.array([-9.0, 0.5])) is None, "heating without cooling is a way of its own"

    def scores(candidates):
        sizes = np.array([9.0, -0.1, 0.0, 300.0])
        return [Score(c, sizes[np.array(c.groups) - 1], 50.0, 1e-9, 1e-9, 9.0, 0.5) for c in candidates]

    left = inside(scores([drag])[0], scores)
    assert left.candidate.groups == (1, 3, 4)
    assert not plausible(left, SETTINGS), "300 Nm are no drag"


@pytest.mark.parametrize(
    ("sizes", "is_plausible"),
    [((0.05, -800.0), True), ((0.05, -1e-3), False), ((1e-9, -800.0), False), ((0.05, 800.0), False)],
)
def test_of_two_sizes_of_one_effect_neither_may_be_nothing(sizes, is_plausible):
    """A gain of 0 beside an offset is an offset alone, and one above 0 is a constant load by another name."""
    c = Candidate(LIBRARY["power_gain"], ("gain", "offset_w"), (None, None), (), "size", (0, 1))
    s = Score(c, np.array(sizes), 50.0, 1e-9, 1e-9, 9.0, 0.5)
    assert plausible(s, SETTINGS) is is_plausible


def test_of_two_limits_of_one_effect_the_lower_is_the_lower(problem):
    """Heating above the temperature where cooling begins is no way to have either: with both it is a constant load."""
    grids = {"heat_c": (10.0, 18.0), "cool_c": (14.0, 22.0)}
    every, _, _ = columns(
        problem.vehicle, [LIBRARY["hvac_power"]], problem.segments, len(problem.measured), problem.target, grids
    )
    pairs = [(x["heat_c"], x["cool_c"]) for c in every if {"heat_c", "cool_c"} <= {*(x := dict(c.shapes))}]
    assert sorted(set(pairs)) == [(10.0, 14.0), (10.0, 22.0), (18.0, 22.0)]


def test_what_was_fitted_is_scored_without_being_computed_again(tmp_path):
    """By the values of the vehicle, whichever holds them; at others, or on other rows, it is."""
    _, problem, _ = opened(tmp_path, seed=2, trips=3, rows_per_trip=80)
    rows = training(problem)
    table, segments = problem.table, rows.chunks[0].segments
    theta = table.values(problem.vehicle) * 1.1
    fitted = table.insert(problem.vehicle, theta)
    first = rows.kernel.linearised(problem.vehicle, table, segments, problem.target, theta)
    again = rows.kernel.linearised(fitted, table, segments, problem.target)
    assert again[1] is first[1]
    assert rows.kernel.linearised(problem.vehicle, table, segments, problem.target)[1] is not first[1]
    others = rows.kernel.linearised(fitted, table, jax.tree.map(np.array, segments), problem.target)
    assert others[1] is not first[1]
    np.testing.assert_array_equal(others[1], first[1])
