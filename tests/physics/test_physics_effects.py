"""What holds for every effect of the library, each at its null and at a typical size."""

import dataclasses
import re
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import physics_rows as made
import pytest
from each_effect import (
    ABOVE,
    BELOW,
    NULL,
    NULL_AT_ZERO,
    OWN,
    STEP,
    TYPICAL,
    WEIGHTS,
    alone,
    both_modes,
    directions,
    filled,
    log_of,
    terms,
)

from hdev_jax.physics import LIBRARY, Choice, Grouped, Parameter, Shape, Size, Switch, Vehicle, library
from hdev_jax.physics.effect import STAGES, Effect
from hdev_jax.physics.library import DECLARED, unavailable
from hdev_jax.segments import Segments

HOOKS = ("derive", "across", "sense", "force", "drive", "power", "observe")
STAGE_HOOKS = {
    "sensors": {"across", "sense", "observe"},
    "road": {"derive", "force"},
    "driveline": {"derive", "drive"},
    "machine": {"power"},
    "battery": {"power"},
}
SENSORS = ("time_skew", "speed_scale", "power_gain")  # a channel by trip, a channel by row, the target


@pytest.fixture(params=list(made.EFFECTS))
def effect_id(request: pytest.FixtureRequest) -> str:
    return request.param


def test_every_effect_is_tested() -> None:
    assert sorted(made.EFFECTS) == sorted(LIBRARY)


# --- what it says of itself ----------------------------------------------------------------------------------------


def test_metadata(effect_id: str) -> None:
    effect = LIBRARY[effect_id]
    assert effect.id == effect_id
    assert effect.stage in STAGES
    assert effect.equation
    assert effect.source
    assert effect.separated_by
    assert effect.__doc__
    own = {h for h in HOOKS if getattr(effect, h) is not getattr(Effect, h)}
    assert own, "an effect that does nothing"
    assert own <= STAGE_HOOKS[effect.stage]
    known = {*LIBRARY, *(d.id for d in DECLARED)}
    assert effect.mistaken_for
    assert set(effect.mistaken_for) <= known - {effect_id}
    for name in (*(n for need in effect.needs for n in need.split("|")), *effect.lacks):
        assert re.fullmatch(r"[a-z0-9_]+", name)
    assert set(effect.entries) <= {"road", "wheel", "shaft"}
    assert effect.entries


def test_parameters(effect_id: str) -> None:
    effect = LIBRARY[effect_id]
    names = [p.name for p in effect.parameters]
    assert [f.name for f in dataclasses.fields(effect)] == names
    sizes = {p.name for p in effect.parameters if p.has_column}
    assert sizes, "nothing to find"
    for chosen in effect.variants:
        assert set(chosen) <= sizes
    for p in effect.parameters:
        assert p.unit
        if isinstance(p, Size):
            assert 0 < p.least < abs(p.scale)
        if isinstance(p, Shape):
            assert p.lower < p.null < p.upper
            assert p.of in ("", *sizes)


REFUSED = {
    "no kind": (lambda: Parameter("x", "1", 0.0, 1.0), "Size, Switch, Shape, Choice"),
    "no typical size": (lambda: Size("x", "1", 0.0, 0.0), "scale is 0"),
    "an empty range": (lambda: Size("x", "1", 0.0, 1.0, 2.0, 1.0), "lower is 2 and upper 1"),
    "no number": (lambda: Size("x", "1", 0.0, 1.0, float("nan")), "are numbers"),
    "a size without a null": (lambda: Size("x", "1", float("nan"), 1.0), "are numbers"),
    "a null outside": (lambda: Size("x", "1", 0.0, 1.0, 1.0, 2.0), "null is 0"),
    "an unknown group": (lambda: Size("x", "1", 0.0, 1.0, by="axle"), "by is 'axle'"),
    "whole without groups": (lambda: Size("x", "1", 0.0, 1.0, whole=True), "whole"),
    "a switch that is never tried": (lambda: Switch("x", "1", 0.0, 1.0, grid=()), "a Switch without a grid"),
    "a shape that is never tried": (lambda: Shape("x", "1", 0.0, 1.0, grid=()), "a Shape without a grid"),
    "a grid beyond the range": (lambda: Shape("x", "1", 1.0, 1.0, 0.0, 2.0, grid=(1.0, 3.0)), "grid has 3"),
}


@pytest.mark.parametrize(("make", "words"), REFUSED.values(), ids=REFUSED)
def test_a_parameter_that_could_never_be_fitted_or_tried(make: Any, words: str) -> None:
    with pytest.raises(ValueError, match=re.escape(words)):
        make()


@pytest.mark.parametrize(
    ("kind", "field"),
    [(Size, "grid"), (Size, "of"), (Size, "smooth"), (Switch, "by"), (Switch, "of"), (Shape, "least"), (Shape, "by"),
     (Choice, "least"), (Choice, "by"), (Choice, "in_rows")],
)  # fmt: skip
def test_a_parameter_has_only_the_fields_of_its_kind(kind: type[Parameter], field: str) -> None:
    assert field not in {f.name for f in dataclasses.fields(kind)}
    assert getattr(kind, field) == getattr(Parameter, field)  # and reads as nothing


def test_what_is_typical_is_plausible(effect_id: str) -> None:
    effect = LIBRARY[effect_id]
    typical, null = made.typical(effect_id), made.null(effect_id)  # shapes are typical of trips of a few seconds
    assert not effect.implausible({p.name: getattr(typical, p.name) for p in effect.parameters if p.has_column})
    assert not effect.implausible({p.name: getattr(null, p.name) for p in effect.parameters})
    for p in effect.parameters:
        for beyond in (p.lower - abs(p.scale), p.upper + abs(p.scale)):
            if np.isfinite(beyond) and beyond < 1e12 and beyond != p.null:
                assert p.name in effect.implausible({p.name: beyond})
    for low, high in effect.ordered:
        assert {low, high} <= {p.name for p in effect.parameters}


def test_limits_of_one_effect_are_in_order() -> None:
    hvac = LIBRARY["hvac_power"]
    assert not hvac.implausible({"heat_c": 17.0, "cool_c": 23.0})
    assert "not below cool_c" in hvac.implausible({"heat_c": 23.0, "cool_c": 17.0})
    assert "not below cool_c" in hvac.implausible({"heat_c": 20.0, "cool_c": 20.0})
    assert not hvac.implausible({"heat_c": 23.0})
    assert not hvac.implausible({"heat_c": 23.0, "cool_c": None})
    assert not hvac.implausible({"heat_c": 23.0, "cool_c": float("nan")})


def test_values_of_groups_are_judged_one_by_one() -> None:
    drag = LIBRARY["driveline_drag"]
    assert not drag.implausible({"torque_nm": Grouped([0.0, 5.0, 9.0], "gear")})
    assert "-5" in drag.implausible({"torque_nm": Grouped([0.0, 5.0, -5.0], "gear")})
    with pytest.raises(KeyError, match="torque"):
        drag.implausible({"torque": 1.0})


def test_needs_are_what_it_reads(effect_id: str) -> None:
    """Without any one of the channels that it needs, the library says so; with all of them, it says nothing."""
    effect, entry = LIBRARY[effect_id], made.entry_of(effect_id)
    log = made.log_for(effect_id)
    assert unavailable(effect, log, entry) is None
    for need in effect.needs:
        assert need.replace("|", " or ") in str(unavailable(effect, log.without(*need.split("|")), entry))
    for lacking in effect.lacks:
        assert unavailable(effect, log.with_channels(**{lacking: log.time_s}), entry)
    for other in {"road", "wheel", "shaft"} - set(effect.entries):
        assert unavailable(effect, log, other)


def test_reads_nothing_else(effect_id: str) -> None:
    """The effect runs on a log of its own channels and those of the chain's entry alone, each alternative in turn.

    What may be by gear reads the gear where it is, and needs none where it is one number.
    """
    effect = LIBRARY[effect_id]
    log = made.log_for(effect_id)
    entry = {"road": (), "wheel": ("traction_force_n",), "shaft": ("motor_torque_nm", "motor_speed_radps")}
    typical = made.typical(effect_id)
    groups = {p.name: p.by for p in effect.parameters if p.whole}
    one = effect(**{p.name: getattr(typical, p.name) for p in effect.parameters} | {k: np.asarray(1.0) for k in groups})
    forms = [(one, set())] + [(typical, set(groups.values()))] * bool(groups)
    longest = max((len(need.split("|")) for need in effect.needs), default=1)
    for k in range(longest):
        names = {need.split("|")[min(k, need.count("|"))] for need in effect.needs}
        names |= set(entry[made.entry_of(effect_id)])
        for form, by in forms:
            car = made.without_effect(effect_id).plus(form)
            assert np.all(np.isfinite(car.energy(log.without(*set(log.channels) - names - by))))


def test_a_users_effect_must_have_a_name_of_its_own(effect_id: str) -> None:
    with pytest.raises(ValueError, match=effect_id):
        library([LIBRARY[effect_id]])


# --- what it adds --------------------------------------------------------------------------------------------------


def test_null_adds_exactly_nothing(effect_id: str) -> None:
    seen = alone(effect_id)
    np.testing.assert_array_equal(seen.energy[NULL], seen.bare)
    np.testing.assert_array_equal(seen.parts[effect_id][NULL], np.zeros(len(seen.bare)))


def test_typical_adds_something(effect_id: str) -> None:
    seen = alone(effect_id)
    if effect_id == "standstill_hold":  # a force that does no work
        np.testing.assert_array_equal(seen.energy[TYPICAL], seen.bare)
        log, car = made.log_for(effect_id), made.without_effect(effect_id)
        held = np.asarray(log.speed_mps) < 0.1
        assert held.any()
        both = car.plus(made.typical(effect_id))
        np.testing.assert_allclose(both.force(log)[held], 0.1 * car.force(log)[held])
        return
    assert np.max(np.abs(seen.energy[TYPICAL] - seen.bare)) > 0.1  # Wh in a second; the drive itself is at some 10² Wh


def assert_finite(energy: np.ndarray, forward: np.ndarray, terms: np.ndarray) -> None:
    """Forward and reverse agree and are finite, in every number of each vehicle of a stack and of the log."""
    assert np.all(np.isfinite(energy))
    assert np.all(np.isfinite(terms))
    for one, parts in zip(forward, terms, strict=True):
        np.testing.assert_allclose(one @ WEIGHTS, np.sum(parts), atol=1e-9 * np.sum(np.abs(parts)))


def test_finite_with_finite_gradients(effect_id: str) -> None:
    """The log has standstill, distance 0 and negative power, and two of the vehicles a row of zero force."""
    seen = alone(effect_id)
    assert np.any((seen.energy[NULL_AT_ZERO] == 0) & (log_of(effect_id).distance_m > 0))
    assert_finite(seen.energy, seen.along, seen.terms)


@pytest.mark.parametrize("entry", ["wheel", "shaft"])
def test_finite_with_all_effects_at_zero_force(entry: str) -> None:
    """Without loads the flat stretch at one speed has no power at any entry; from the road that is above."""
    car, log = made.baseline(entry, auxiliary_w=0.0), made.drives(*made.LENGTHS)
    assert np.any((np.asarray(car.power(log)) == 0) & (log.distance_m > 0))
    ids = [i for i, e in LIBRARY.items() if entry in e.entries]
    both = filled(*(car.plus(*(size(i) for i in ids)) for size in (made.null, made.typical)))
    numbers, rest = eqx.partition((both, filled(log)), made.is_real)
    direction = directions(numbers)
    energy, along, reverse = jax.vmap(both_modes)(numbers, rest, direction)
    assert_finite(energy[:2], along[:2], terms(reverse, direction)[:2])


def test_gradient_against_differences(effect_id: str) -> None:
    """Away from switches: no row of this log lies on one at the typical size. (That reverse is forward is above.)"""
    seen = alone(effect_id)
    largest = float(np.max(np.abs(seen.energy[TYPICAL])))
    difference = (seen.energy[ABOVE] - seen.energy[BELOW]) / (2 * STEP)
    np.testing.assert_allclose(seen.along[OWN] / largest, difference / largest, atol=1e-6, rtol=1e-6)


# --- the vehicle as a sum ------------------------------------------------------------------------------------------


def test_plus_and_minus_round_trip(effect_id: str) -> None:
    car, effect = made.without_effect(effect_id), made.typical(effect_id)
    longer = car.plus(effect)
    assert longer.has(effect_id)
    assert not car.has(effect_id), "plus changed the vehicle that it was called on"
    assert longer.effect(effect_id) is effect
    assert eqx.tree_equal(longer.minus(effect_id), car)
    assert eqx.tree_equal(longer.minus(effect_id).plus(effect), longer)
    with pytest.raises(ValueError, match="each effect once"):
        longer.plus(effect)
    with pytest.raises(ValueError, match=f"no such effect.*{effect_id}"):
        car.minus(effect_id)
    with pytest.raises(KeyError, match=effect_id):
        car.effect(effect_id)


def assert_adds_up(parts: dict[str, np.ndarray], total: np.ndarray) -> None:
    largest = np.maximum(np.sum([np.abs(p) for p in parts.values()], axis=0), 1e-9)
    assert np.max(np.abs(np.sum(list(parts.values()), axis=0) - total) / largest) < 1e-13


def test_breakdown_adds_up(effect_id: str) -> None:
    seen = alone(effect_id)
    assert {e.id for e in made.without_effect(effect_id).effects} | {effect_id} <= set(seen.parts)
    assert_adds_up(seen.parts, seen.energy)


@pytest.mark.parametrize("entry", ["road", "wheel", "shaft"])
def test_breakdown_adds_up_with_all_effects_together(entry: str) -> None:
    """With every stage, and from the road of the sensors one of each kind: each is a pass over all effects."""
    ids = SENSORS if entry == "road" else LIBRARY
    acting = [i for i, e in LIBRARY.items() if entry in e.entries and (e.stage != "sensors" or i in ids)]
    car = made.baseline(entry, covers_machine=False).plus(*(made.typical(i) for i in acting))
    log = made.drives(*made.LENGTHS)
    parts = car.breakdown(log)
    assert {e.id for e in car.effects} <= set(parts)
    assert_adds_up(parts, np.asarray(car.energy(log)))


# --- precision -----------------------------------------------------------------------------------------------------


def all_together(entry: str, dtype: Any) -> tuple[Vehicle, Segments]:
    acting = [i for i, e in LIBRARY.items() if entry in e.entries]
    car = made.baseline(entry, covers_machine=False).plus(*(made.typical(i) for i in acting))
    both = (car, made.drives(*made.LENGTHS))
    return jax.tree.map(lambda x: jnp.asarray(x, dtype) if made.is_real(x) else x, both)


@pytest.mark.parametrize("entry", ["road", "shaft"])
def test_precision_is_kept_under_strict_promotion(entry: str) -> None:
    """All effects together: a vehicle and a log in float32 give float32, though float64 is switched on.

    That jit gives the same numbers is asked of the kernel's loop (`test_physics_reference`).
    """
    with jax.numpy_dtype_promotion("strict"):
        energy = eqx.filter_jit(lambda c, s: c.energy(s))(*all_together(entry, jnp.float32))
        double = eqx.filter_eval_shape(lambda c, s: c.energy(s), *all_together(entry, jnp.float64))
    assert energy.dtype == jnp.float32
    assert double.dtype == jnp.float64
    car, log = all_together(entry, jnp.float64)
    exact = np.asarray(car.energy(log))
    assert np.max(np.abs(energy - exact)) < 1e-4 * np.max(np.abs(exact))
