"""The networks' closed form: thresholds, delays and masses that are planted are found; what networks take over."""

import dataclasses
import json
from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pinn_fleet import HELD, config, tractors

from experiments.pinn import study as pinn
from experiments.pinn.closed import closed, kernel, said, sized, trainable
from experiments.pinn.data import Data, load, weighed
from experiments.pinn.known import known
from experiments.pinn.pooled import fleet, sizes_of
from experiments.pinn.study import tasks
from hdev_jax.errors import InputError
from hdev_jax.learn.pinn.model import Pinn, Recipe, predict
from hdev_jax.learn.pinn.rows import FEATURES
from hdev_jax.physics import Grouped
from hdev_jax.physics.battery import RegenLimit
from hdev_jax.physics.loads import AuxiliaryPower
from hdev_jax.physics.losses import GearEfficiency
from hdev_jax.physics.road import Headwind
from hdev_jax.physics.sensors import GradeLag, MassScale, TimeSkew
from hdev_jax.physics.tyres import RoadSurface, RollingSpeed

pytestmark = pytest.mark.slow
THRESHOLDS = {"mass_scale": {"scale": 0.0}, "regen_limit": {}, "time_skew": {}}


def limited(data, power_w, skew_s, cubic=0.0):
    """The data with another first vehicle, which has a limit and a delay; at 1e12 W and at 0 s it has none."""
    limit, skew = RegenLimit(np.asarray(power_w)), TimeSkew(np.asarray(skew_s), np.asarray(cubic))
    return planted(data, MassScale(np.asarray(0.0)), limit, skew)


def planted(data, *effects):
    """The data with another first vehicle, which has these effects."""
    m, *others = data.vehicles
    y = said(m.vehicle.plus(*effects), m)
    z = np.random.default_rng(0).standard_normal(len(y))
    return Data((dataclasses.replace(m, energy_wh=y + 3.0 * z), *others), data.trained)


@pytest.mark.parametrize(
    ("power_w", "skew_s", "cubic", "given", "within"),
    [
        (8e3, -2.0, 1.0, {"time_skew": {"cubic": 1.0}}, (300.0, 0.05)),
        (1e5, 0.0, 0.0, {"regen_limit": {"power_w": 9e4}, "time_skew": {"skew_s": 0.1}}, None),
        (1e12, 0.0, 0.0, {}, (0.0, 0.0)),
    ],
    ids=["a cubic and a limit below the grid", "given", "none planted"],
)
def test_thresholds_are_found_wherever_they_lie_and_none_where_none_is(power_w, skew_s, cubic, given, within):
    data = limited(tractors(HELD), power_w, skew_s, cubic)
    car = kernel(data.vehicles[0], {**THRESHOLDS, **given}).vehicle
    limit, skew = float(car.effect("regen_limit").power_w), car.effect("time_skew")
    if within is None:
        assert (limit, float(skew.skew_s)) == (9e4, 0.1)
        return
    assert limit == pytest.approx(power_w, abs=within[0])
    assert float(skew.skew_s) == pytest.approx(skew_s, abs=within[1])
    assert float(skew.cubic) == cubic


def test_two_delays_are_found():
    data = planted(tractors(HELD), GradeLag(np.asarray(6.0)), TimeSkew(np.asarray(4.0), np.asarray(0.0)))
    car = kernel(data.vehicles[0], {"grade_lag": {}, "time_skew": {}}).vehicle
    assert float(car.effect("time_skew").skew_s) == pytest.approx(4.0, abs=0.2)
    assert float(car.effect("grade_lag").lag_s) == pytest.approx(6.0, abs=0.3)


def test_each_gear_has_its_own_size():
    data = tractors(HELD)
    gears = np.zeros(13)
    gears[10:] = 0.03
    data = planted(data, GearEfficiency(Grouped(jnp.asarray(gears), "gear")))
    found = np.asarray(kernel(data.vehicles[0], {"gear_efficiency": {}}).vehicle.effect("gear_efficiency").delta.values)
    rows = np.bincount(np.asarray(data.vehicles[0].segments.channels["gear"], int)[data.vehicles[0].use == 0])
    for gear in np.flatnonzero(rows > 100):
        assert found[gear] == pytest.approx(gears[gear], abs=0.006), gear


LOOSE = {"regen_limit": {}, "mass_scale": {}, "headwind": {}, "time_skew": {}}


@cache
def loose():
    """Trips' masses, a limit and a delay planted, with the fleet's noise of the energy, in the place of what the
    fleet's vehicle really has: the data, the energy without noise and by what each row's mass is off."""
    data = tractors(HELD, routes=32)
    a, b = data.vehicles
    off = np.random.default_rng(4).normal(0.0, 0.04, int(a.routes.max()) + 1)[a.routes]
    limit, scale, none, skew = (np.asarray(x) for x in (1.5e5, 0.02, 0.0, 0.3))
    effects = (RegenLimit(limit), MassScale(scale), Headwind(none), TimeSkew(skew, none))
    true = said(a.vehicle.plus(*effects), a, weighed(a.segments, off))
    z = np.random.default_rng(0).standard_normal(len(true))
    return Data((dataclasses.replace(a, energy_wh=true + z * (3.0 + 0.01 * np.abs(true))), b), 1), true, off


def test_thresholds_and_a_delay_are_the_vehicles_own_and_no_network_trains_them():
    data, _, off = loose()
    text, (a, b) = json.dumps(LOOSE), data.vehicles
    form, (one, other) = closed(data, text)[0], known(data, text)
    car, own = form.vehicle, form.weighed(a)
    limit = float(car.effect("regen_limit").power_w)
    assert limit == pytest.approx(1.5e5, rel=0.01)
    assert float(car.effect("time_skew").skew_s) == pytest.approx(0.3, abs=0.03)
    mean = np.mean([off[a.routes == t][0] for t in np.unique(a.routes[a.use == 0])])
    assert float(car.effect("mass_scale").scale) == pytest.approx(1.02 * (1 + mean) - 1, abs=0.005)

    assert float(one.vehicle.effect("regen_limit").power_w) == pytest.approx(limit)
    assert {"headwind", "mass_scale", "time_skew"}.isdisjoint(e.id for e in one.vehicle.effects)
    late = one.fitted.plus(car.effect("time_skew"))
    assert one.across_wh == pytest.approx(said(late, a, own) - said(one.fitted, a, own))
    trips = [np.sum(one.across_wh[a.routes == t]) for t in np.unique(a.routes)]
    assert np.sum(np.abs(one.across_wh)) > 10 * np.sum(np.abs(trips)) > 0, "a delay moves energy from row to row"

    masses = float(b.vehicle.mass_kg) / float(a.vehicle.mass_kg)
    assert float(other.vehicle.effect("regen_limit").power_w) == pytest.approx(limit * masses)
    assert not other.across_wh.any()


def test_each_trips_mass_is_found_and_that_of_others_is_open():
    """Found where trips are trained on, within an interval where they are not."""
    data, true, off = loose()
    text, (a, _) = json.dumps(LOOSE), data.vehicles
    form, (one, other) = closed(data, text)[0], known(data, text)
    at = a.use == 0
    scale = float(form.vehicle.effect("mass_scale").scale)
    found, planted_ = (1 + form.payload[at]) * (1 + scale), (1 + off[at]) * 1.02
    assert np.sqrt(np.mean((found / planted_ - 1) ** 2)) < 0.006
    assert form.payload_sd == pytest.approx(np.std([off[a.routes == t][0] for t in np.unique(a.routes[at])]), rel=0.2)
    assert not form.payload[~at].any()

    assert not one.loose_wh[at].any()
    assert not other.payload.any()
    plain = said(form.vehicle, a)
    unseen = np.unique(a.routes[~at])
    sums = [(np.sum((true - plain)[a.routes == t]), np.sum(one.loose_wh[a.routes == t])) for t in unseen]
    z = np.array([x / s for x, s in sums])
    assert 0.4 < np.sqrt(np.mean(z**2)) < 1.6, (
        "a trip's energy is off by what its mass is worth, signs of rows included"
    )
    assert np.min(one.loose_wh[~at]) < 0 < np.max(one.loose_wh[~at])


def test_a_network_has_what_vehicles_that_resemble_say_in_closed_form():
    """Planted: a rolling resistance that grows with v² alike in all vehicles. By itself a bus tells it from drag badly,
    with the others well; and what is handed over is the closed form's own energy."""
    effects = {"rolling_speed": {}, "road_surface": {}, "auxiliary_power": {}, "headwind": {}}
    data = load("fleet", 3, 45, (), 1.0, None, 0, ("B", "tractor_4x2_40t_2speed", "bus_12m_2speed"))
    sizes = (RollingSpeed(np.asarray(1.8e-6)), RoadSurface(Grouped(jnp.array([0.0, 0.1, 0.05, 0.45]), "road_surface")))
    vehicles = []
    for k, m in enumerate(data.vehicles):
        car = eqx.tree_at(lambda c: c.effect("aero").cda_m2, m.vehicle, 1.2 * m.vehicle.effect("aero").cda_m2)
        load_w, wind = np.asarray(1500.0 + 500.0 * k), np.asarray(0.9)
        y = said(car.plus(*sizes, AuxiliaryPower(load_w), Headwind(wind)), m)
        noise = np.random.default_rng(k).standard_normal(len(y)) * (3.0 + 0.01 * np.abs(y))
        vehicles.append(dataclasses.replace(m, energy_wh=y + noise))
    data = Data(tuple(vehicles), data.trained)
    text, opened = json.dumps(effects), sized(effects)
    cars = [fleet(data, text).put(m.vehicle, m, k, effects) for k, m in enumerate(data.vehicles)]

    def off(car, m):
        return float(car.effect("aero").cda_m2 / m.vehicle.effect("aero").cda_m2) / 1.2 - 1

    alone = [off(c.vehicle, m) for m, c in zip(data.vehicles, closed(data, text), strict=True)]
    together = [off(car, m) for m, car in zip(data.vehicles, cars, strict=True)]
    assert np.max(np.abs(alone)) > 0.05
    assert np.max(np.abs(together)) < 0.6 * np.max(np.abs(alone))
    assert np.max(np.abs(together)) < 0.04

    known_sizes = sizes_of(data, text, opened)
    rows, _ = data.rows(FEATURES["unitless"], tuple(effects), known(data, text))
    one = Recipe(features=FEATURES["unitless"], units=(4,), coefficients="free", by_vehicle=True, loss="likelihood")
    model, memory = eqx.nn.make_with_state(Pinn)(one, 3, scale_wh=1.0, effects=opened, key=jax.random.key(0))
    p = predict(known_sizes.of(model), memory, rows)
    wanted = np.concatenate([said(car, m) for m, car in zip(data.vehicles, cars, strict=True)])
    np.testing.assert_allclose(p.physics_wh, wanted, rtol=2e-4, atol=0.05)
    assert np.std(np.asarray(p.energy_wh) - data.column("energy_wh")) < 5.0


def test_vehicles_of_few_trips_are_alike_where_their_rows_say_nothing():
    """One or three training trips each and all effects of the fleet but thresholds: alone a vehicle could have any;
    together they predict rows that were not trained on better than the tables do, as does one without a row.
    """
    effects = {k: v for k, v in config("paper1/table2").effects.items() if k in trainable([k])}
    data = load("fleet", 3, 45, (), 1.0, None, 0, ("B", "tractor_4x2_40t_2speed", "bus_12m_2speed"))
    few = []
    for m, trips in zip(data.vehicles, (0, 3, 1), strict=True):
        kept = np.isin(m.routes, np.unique(m.routes[m.use == 0])[:trips])
        few.append(dataclasses.replace(m, use=np.where((m.use == 0) & ~kept, 4, m.use)))
    data = Data(tuple(few), data.trained)
    text = json.dumps(effects)

    def off(car, m):
        return float(np.sqrt(np.mean((said(car, m) - m.energy_wh)[m.use != 0] ** 2)))

    alone = [off(c.vehicle, m) for m, c in zip(data.vehicles, closed(data, text), strict=True) if c is not None]
    tables = [off(m.vehicle, m) for m in data.vehicles]
    together = [off(fleet(data, text).put(m.vehicle, m, k, effects), m) for k, m in enumerate(data.vehicles)]
    assert len(alone) == 2
    assert np.all(np.isfinite(together))
    assert np.max(together[1:]) < 0.5 * np.max(alone)
    assert np.all(np.array(together[1:]) < 0.7 * np.array(tables[1:]))
    # trips are too few for a variance of their masses: it is the usual one
    assert all(c is None or np.isnan(c.payload_sd) for c in closed(data, text))
    assert all(own.loose_wh[m.use == 0].any() for own, m in zip(known(data, text)[1:], data.vehicles[1:], strict=True))
    assert known(data, text)[0].loose_wh.any()


def test_a_networks_physics_has_the_thresholds_and_what_acts_across_rows():
    """An untrained network says what the sheet says, with both."""
    data = limited(tractors(HELD), 6e4, 0.3)
    text = json.dumps(THRESHOLDS)
    assert float(closed(data, text)[0].vehicle.effect("time_skew").skew_s) == pytest.approx(0.3, abs=0.03)
    one, _ = known(data, text)
    assert not one.loose_wh.any(), "the mass is as it is given"
    a, b = data.vehicles
    spoilt = dataclasses.replace(a, energy_wh=np.where(a.use == 0, a.energy_wh, -1e4))
    again = known(Data((spoilt, b), 1), text)
    assert np.array_equal(again[0].across_wh, one.across_wh), "energies of rows that are not trained on say nothing"
    assert again[0].vehicle.effect("regen_limit").power_w == one.vehicle.effect("regen_limit").power_w
    rows, use = data.rows(("speed_mps",), trainable(THRESHOLDS), known(data, text))
    at = np.flatnonzero(use == 2)
    recipe = Recipe(features=("speed_mps",), units=(4,))
    model, memory = eqx.nn.make_with_state(Pinn)(recipe, 1, scale_wh=1.0, key=jax.random.key(0))
    physics = np.asarray(predict(model, memory, rows.take(at)).physics_wh)
    off = physics - data.vehicles[0].energy_wh[at]
    assert np.sqrt(np.mean(off**2)) < 4.0
    plain, _ = data.rows(("speed_mps",), (), known(data, "{}"))
    without = np.asarray(predict(model, memory, plain.take(at)).physics_wh) - data.vehicles[0].energy_wh[at]
    assert np.sqrt(np.mean(without**2)) > 8.0


def test_a_task_trains_with_the_effects_of_its_config(monkeypatch):
    """What the networks are given is `known` of the config's effects."""
    given = {}
    monkeypatch.setattr(pinn, "trained", lambda data, rows, use, tasks, model: given.update(rows=rows) or [{}])
    sets = ("routes=12", 'variants=["A"]', 'only=["ours"]', "diagnosed=[]",
            "effects={mass_scale={scale=0.0}, regen_limit={}, time_skew={}}")  # fmt: skip
    (task,) = tasks(config("paper1/table2", *sets))
    pinn.run(task)
    data = load("fleet", 1, 12, (), 1.0, None, 0, ("A",))
    (one,) = known(data, json.dumps(THRESHOLDS))
    assert given["rows"].across_wh == pytest.approx(one.across_wh, rel=1e-6)
    assert given["rows"].car.has("regen_limit")
    held = Data(tuple(dataclasses.replace(m, use=np.full(len(m.use), 2)) for m in data.vehicles), 1)
    with pytest.raises(InputError, match="no vehicle has a training route"):
        known(held, "{}")
