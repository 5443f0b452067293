"""The table of coefficients: values in and out of a vehicle, and what jit sees of it."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from inference_rows import driving, tabular, truck

from hdev_jax.inference import Coefficient, ParameterTable, effect_coefficients, jacobian
from hdev_jax.physics import LIBRARY, Grouped, at_null

PATHS = (
    "mass_kg", "road.c_rr", "road.cda_m2", "road.rotating_mass_factor", "battery.auxiliary_w", "driveline.efficiency",
    "machine.motoring_efficiency", "machine.regenerating_efficiency", "effects.headwind.scale",
)  # fmt: skip


def table(*paths: str, **options) -> ParameterTable:
    return ParameterTable(tuple(Coefficient(p, "1", 1.0, 0.1, 1.0, **options) for p in paths))


@pytest.fixture(scope="module")
def car():
    return truck().plus(at_null(LIBRARY["headwind"]))


@pytest.mark.parametrize("path", PATHS)
def test_a_value_goes_in_and_comes_out(path, car):
    """And nothing else of the vehicle changes."""
    new = table(path).insert(car, [0.123])
    assert table(path).values(new) == 0.123
    others = table(*(p for p in PATHS if p != path))
    np.testing.assert_array_equal(others.values(new), others.values(car))
    assert sum(not np.array_equal(a, b) for a, b in zip(*map(jax.tree.leaves, (car, new)), strict=True)) == 1


def test_all_at_once(car):
    values = np.linspace(0.1, 0.9, len(PATHS))
    np.testing.assert_array_equal(table(*PATHS).values(table(*PATHS).insert(car, values)), values)


def test_a_coefficient_of_each_vehicle():
    """One row of the table for each value of a grouped coefficient; the others of the group stay."""
    car = truck(c_rr=Grouped(jnp.asarray([0.005, 0.006, 0.007]), "vehicle"))
    rows = tuple(Coefficient("road.c_rr", "1", 0.006, 1e-3, 1e-3, group=k, label=f"bus {k}") for k in (0, 2))
    both = ParameterTable(rows)
    assert [c.name for c in both.free] == ["road.c_rr[bus 0]", "road.c_rr[bus 2]"]
    np.testing.assert_array_equal(both.values(car), [0.005, 0.007])
    new = both.insert(car, [0.1, 0.3])
    np.testing.assert_array_equal(new.effect("rolling").c_rr.values, [0.1, 0.006, 0.3])
    assert new.effect("rolling").c_rr.by == "vehicle"


@pytest.mark.parametrize("path", ["road.c_r", "effects.crosswind.drag_per_rad2", "chassis.mass"])
def test_a_path_that_the_vehicle_lacks(path, car):
    with pytest.raises(KeyError):
        table(path).values(car)


def test_structure_is_static_and_leaves_numbers_out():
    """Two tables of the same coefficients share a compilation whatever their priors."""
    one, other = tabular(), tabular(scale=3.0)
    assert hash(one.structure) == hash(other.structure)
    assert one.structure == other.structure
    assert one.structure != tabular(lower=0.0).structure
    assert one.structure != one.with_free(**{"road.c_rr": False}).structure


def test_inserting_is_traced_once(car):
    t = table("road.c_rr", "effects.headwind.scale")
    traces = []

    @eqx.filter_jit
    def drag(values):
        traces.append(1)
        return t.insert(car, values).effect("rolling").c_rr ** 2

    for x in (0.1, 0.2):
        assert drag(jnp.asarray([x, 1.0])) == pytest.approx(x**2)
    assert len(traces) == 1
    assert jax.grad(lambda v: drag(v))(jnp.asarray([0.5, 1.0]))[0] == pytest.approx(1.0)


def test_rows_are_held_freed_added_and_taken_away():
    t = tabular()
    held = t.with_free(**{"road.c_rr": False})
    assert [c.name for c in held.free] == ["road.cda_m2"]
    assert [c.free for c in t.rows] == [True, True]  # the first table is as it was
    wind = Coefficient("effects.headwind.scale", "1", 1.0, None, 1.0)
    other = dataclasses.replace(wind, path="effects.headwind_gust.scale")
    more = t.plus(wind, other)
    assert [c.name for c in more.minus("headwind").rows] == ["road.c_rr", "road.cda_m2", other.path]


def test_rows_of_an_effect():
    """Its sizes and the shapes that are searched are free, the choices held, each in its plausible range."""
    tyre = effect_coefficients(at_null(LIBRARY["tyre_warmup"]), ("excess",))
    by_name = {c.path.rpartition(".")[2]: c for c in tyre}
    assert by_name["excess"].free
    assert by_name["excess"].sd is None  # nothing is tabulated for what was just found
    assert by_name["distance_m"].free
    assert by_name["distance_m"].sd is not None
    assert not any(c.free for c in effect_coefficients(at_null(LIBRARY["tyre_warmup"]), (), shapes=False))
    skew = effect_coefficients(at_null(LIBRARY["time_skew"]), ("skew_s",))
    assert [c.path.rpartition(".")[2] for c in skew if c.free] == ["skew_s"]  # linear or cubic is a choice


def test_rows_of_an_effect_by_gear():
    gears = effect_coefficients(at_null(LIBRARY["gear_efficiency"], gears=4), ("delta",), groups=("1", "3"))
    assert [c.name for c in gears if c.free] == [f"effects.gear_efficiency.delta[{k}]" for k in (1, 3)]
    assert len(gears) == 5  # gears are counted from 1 in logs; place 0 is there


def test_the_jacobian_is_the_slope():
    """Central differences of a model that is linear are exact to rounding."""
    s, t = driving(40, 24), tabular()
    car = truck()
    slope = jacobian(car, t, s, "battery_power_kw")
    for k, h in enumerate((1e-4, 0.1)):
        values = t.values(car)
        up, down = (t.insert(car, values + d * h * np.eye(2)[k]).predict(s, "battery_power_kw") for d in (1, -1))
        np.testing.assert_allclose(slope[:, k], (up - down) / (2 * h), rtol=1e-9)
    assert jacobian(car, ParameterTable(()), s, "battery_power_kw").shape == (64, 0)
