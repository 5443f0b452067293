"""A vehicle is written with plain numbers, and every one of them has a gradient."""

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import physics_rows as made
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hdev_jax import physics
from hdev_jax.physics import (
    LIBRARY,
    Aero,
    Driveline,
    Effect,
    EfficiencyMap,
    Grade,
    Grouped,
    Inertia,
    Machine,
    Rolling,
    Size,
    Vehicle,
)
from hdev_jax.physics.effect import Car
from hdev_jax.physics.parameter import as_array

LOG = made.drives(*made.LENGTHS)


def truck(c_rr: Any = 0.006, cda_m2: Any = 5.6, efficiency: Any = 0.91, mass_kg: Any = 18e3) -> Vehicle:
    road = [Inertia(1.03), Grade(), Rolling(c_rr), Aero(cda_m2)]
    return Vehicle(road, mass_kg=mass_kg, driveline=Driveline(efficiency))


def is_strong_float(x: Any) -> bool:
    return isinstance(x, jax.Array) and x.dtype == float and not x.weak_type


def test_the_gradient_of_a_vehicle_in_five_lines() -> None:
    car = Vehicle([Inertia(1.03), Grade(), Rolling(0.006), Aero(5.6)], mass_kg=18e3, driveline=Driveline(0.91))
    gradient = eqx.filter_grad(lambda v: jnp.sum(v.energy(LOG)))(car)
    by_c_rr = jax.grad(lambda c: jnp.sum(truck(c).energy(LOG)))(0.006)
    step = 1e-6
    slope = (jnp.sum(truck(0.006 + step).energy(LOG)) - jnp.sum(truck(0.006 - step).energy(LOG))) / (2 * step)
    np.testing.assert_allclose(by_c_rr, slope, rtol=1e-6)
    np.testing.assert_allclose(gradient.effect("rolling").c_rr, by_c_rr, rtol=1e-12)


def test_it_reads_as_the_road_chain_with_one_efficiency() -> None:
    car = made.baseline(rotating=1.03, auxiliary_w=0.0)
    np.testing.assert_allclose(truck().energy(LOG), car.energy(LOG), rtol=1e-12)
    lossless = Vehicle([Rolling(0.006)], mass_kg=18e3)
    assert (lossless.driveline, lossless.machine) == (Driveline(), Machine())
    np.testing.assert_allclose(lossless.power(LOG), lossless.force(LOG) * LOG.speed_mps, rtol=1e-12)


@jax.jit
def energy(x: Any) -> Any:
    return truck(*x).energy(LOG.without("mass_kg"))


slopes = jax.jit(jax.jacfwd(energy))


@settings(max_examples=25)
@given(st.floats(0.003, 0.02), st.floats(1.0, 9.0), st.floats(0.7, 1.0), st.floats(5e3, 4e4), st.sampled_from(range(4)))
def test_gradients_against_differences(c_rr: float, cda: float, efficiency: float, mass: float, which: int) -> None:
    """By each number, wherever the vehicle is: the sign of no row's force changes over so small a step."""
    at = np.array([c_rr, cda, efficiency, mass])
    step = np.zeros(4)
    step[which] = 1e-6 * at[which]
    slope = (energy(at + step) - energy(at - step)) / (2e-6 * at[which])
    found = slopes(jnp.asarray(at))[:, which]
    off = np.abs(found - slope) > 1e-6 * np.max(np.abs(slope))
    assert np.sum(off) == 0 or np.any(np.abs(truck(*at).force(log)[off]) < 1.0)


@pytest.mark.parametrize("effect", [*LIBRARY.values(), *physics.DECLARED], ids=lambda c: c.id)
def test_every_effect_takes_plain_numbers(effect: type[Effect]) -> None:
    names = [p.name for p in effect.parameters] or [*effect.declared]
    made_of = effect(**dict.fromkeys(names, 1))
    assert all(is_strong_float(getattr(made_of, n)) for n in names)
    nothing = effect(**dict.fromkeys(names))
    assert all(getattr(nothing, n) is None for n in names)


def test_driveline_machine_and_map_take_numbers_and_lists() -> None:
    line = Driveline(0.9, [9.0, 4.0], final_drive=4, wheel_radius_m=0.5)
    assert all(is_strong_float(x) for x in jax.tree.leaves((line, Machine(0.9, 0.8), truck().mass_kg)))
    assert line.gear_ratios is not None
    assert line.gear_ratios.shape == (2,)
    grid = EfficiencyMap([1, 2], [0, 100], [-50, 50], np.full((2, 2, 2), 0.9))
    assert all(is_strong_float(x) for x in jax.tree.leaves(grid))
    assert isinstance(Driveline(grid).efficiency, EfficiencyMap)
    by_vehicle = Grouped([0.006, 0.007], "vehicle")
    assert Rolling(by_vehicle).c_rr is by_vehicle


class OfAUser(Effect):
    """A user's own, with a number, one that has a usual value, a switch of the code and a text."""

    id: ClassVar = "of_a_user"
    stage: ClassVar = "battery"
    equation: ClassVar = "k·x"
    parameters: ClassVar = (Size("k", "W", 0.0, 1.0),)
    count: "ClassVar[int]" = 0
    k: Any
    offset: Any = 2
    squared: bool = eqx.field(static=True, default=False)
    name: str = "v2"

    def power(self, row, car, point):
        return (self.k + self.offset) * (row.speed_mps ** (2 if self.squared else 1))


def test_a_users_effect_gets_the_same() -> None:
    effect = OfAUser(3)
    assert is_strong_float(effect.k)
    assert is_strong_float(effect.offset)
    assert (effect.squared, effect.name, OfAUser.count) == (False, "v2", 0)
    car = lambda k: Vehicle([OfAUser(k, squared=True)], mass_kg=1.0)  # noqa: E731
    by_k = jax.grad(lambda k: jnp.sum(car(k).power(LOG)))(3.0)
    np.testing.assert_allclose(by_k, np.sum(np.asarray(LOG.speed_mps) ** 2), rtol=1e-12)


class OfAUserAgain(OfAUser):
    """One more number in a class derived from a user's."""

    more: Any = 1.0


def test_a_class_derived_from_an_effect_gets_it_too() -> None:
    assert all(is_strong_float(x) for x in (OfAUserAgain(1).more, OfAUserAgain(1, more=2).more, OfAUserAgain(1).k))


@settings(max_examples=40)
@given(st.one_of(st.integers(-(10**6), 10**6), st.floats(-1e6, 1e6), st.lists(st.floats(-1e6, 1e6), min_size=1)))
def test_numbers_keep_their_value(x: Any) -> None:
    for given_as in (x, np.asarray(x), jnp.asarray(x)):
        np.testing.assert_array_equal(as_array(given_as), np.asarray(x, dtype=float))
        assert is_strong_float(as_array(given_as))


@pytest.mark.parametrize("x", [None, "v2", True, np.array(["a"]), {"a": 1.0}], ids=str)
def test_what_is_no_number_stays_as_it_is(x: Any) -> None:
    assert as_array(x) is x


def test_single_precision_stays_single() -> None:
    assert Rolling(np.float32(0.006)).c_rr.dtype == jnp.float32


def test_without_double_precision_doubles_become_single_without_a_warning() -> None:
    with jax.enable_x64(False):
        for x in (0.006, np.asarray(0.006), np.float64(0.006), [0.006]):
            assert as_array(x).dtype == jnp.float32


def test_another_value_is_no_other_program() -> None:
    energy = eqx.filter_jit(eqx.debug.assert_max_traces(lambda v, s: v.energy(s), max_traces=1))
    for c_rr in (0.006, np.float64(0.007), jnp.asarray(0.008), 1):
        energy(truck(c_rr), LOG)


def test_a_vehicle_is_what_effects_read_of_it() -> None:
    assert isinstance(truck(), Car)
