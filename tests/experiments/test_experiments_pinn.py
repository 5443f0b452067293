"""The networks' experiment: who is trained on what, deltas of models, scores that add up."""

import dataclasses
import json
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.paper1.halves import coefficient
from experiments.pinn import models as pinn_models
from experiments.pinn import pooled as pinn_pooled
from experiments.pinn import study as pinn
from experiments.pinn.closed import closed, kernel, said, sized, trainable
from experiments.pinn.data import Data, load, weighed
from experiments.pinn.diagnosed import united
from experiments.pinn.known import known
from experiments.pinn.models import boosted
from experiments.pinn.pooled import fleet, sizes_of
from experiments.pinn.scores import TAUGHT, pooled, scores
from experiments.pinn.study import Config, chosen, tasks, together
from experiments.runner.config import CONFIGS, resolve, typed
from hdev_jax.errors import InputError
from hdev_jax.learn.pinn.fit import PAPER_WEIGHTS
from hdev_jax.learn.pinn.model import Pinn, Recipe, predict
from hdev_jax.learn.pinn.rows import FEATURES
from hdev_jax.learn.train import DivergedError
from hdev_jax.physics import Grouped
from hdev_jax.physics.battery import RegenLimit
from hdev_jax.physics.loads import AuxiliaryPower
from hdev_jax.physics.losses import GearEfficiency
from hdev_jax.physics.road import Headwind
from hdev_jax.physics.sensors import GradeLag, MassScale, TimeSkew
from hdev_jax.physics.tyres import RoadSurface, RollingSpeed


def config(name, *sets):
    return typed(Config, resolve(CONFIGS / f"{name}.toml", sets), name)


def test_a_model_takes_over_what_it_does_not_change():
    models = chosen(config("studies/pinn_ablations"))
    ours, delta = models["ours"], models["ours without effects"]
    changed = {k for k in type(ours).model_fields if getattr(ours, k) != getattr(delta, k)}
    assert changed == {"effects"}
    with pytest.raises(InputError, match="no model 'none'"):
        chosen(config("studies/pinn_ablations", 'only=["none"]'))
    with pytest.raises(InputError, match="is like itself"):
        chosen(config("studies/pinn_ablations", 'models.ours.like="ours without effects"'))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ('models.ours.coefficients="table"', "sizes in closed form want coefficients that are free"),
        ("effects.fog={}", "'fog' is no effect"),
        ("effects.tyre_warmup={distanz_m=3.0}", "'distanz_m' is none of excess, distance_m"),
        ('variants=["A", "A"]', "there twice"),
        ('held_variants=["nope"]', "'nope' is no variant"),
        ("folds=[0, 1]", "split once"),
        ("grid_values=[[1.0]]", "found 1"),
    ],
)
def test_a_config_that_cannot_be_is_refused_in_one_line(change, said):
    with pytest.raises(InputError, match=said):
        list(tasks(config("paper1/table2", change)))


def test_every_ablation_of_the_networks_changes_one_thing():
    whole = config("studies/pinn_ablations")
    models = chosen(whole)
    for name, model in models.items():
        base = models[whole.models[name].like or name]
        changed = [k for k in type(base).model_fields if getattr(base, k) != getattr(model, k)]
        assert len(changed) == (name not in ("ours", "paper")), name


def test_a_black_box_without_a_kernel_differs_by_its_inputs_alone():
    models = chosen(config("paper1/table2"))
    for name, base in (("LightGBM, no kernel", "lightgbm"), ("network, no kernel", "network without physics")):
        one, other = models[name], models[base]
        assert {k for k in type(one).model_fields if getattr(one, k) != getattr(other, k)} == {"features"}
        assert one.features == "raw"


def test_loss_weights_come_by_pairs_and_train_together():
    every = list(tasks(config("studies/pinn_weights")))
    weights = {tuple(t["weights"]) for t in every}
    assert len(every) == 3 * len(weights) == 3 * 61
    assert all(sum(a != b for a, b in zip(w, PAPER_WEIGHTS, strict=True)) <= 2 for w in weights)
    assert len({together(t) for t in every}) == 1


@pytest.mark.parametrize("share", [1.0, 0.3])
def test_a_route_has_one_use_and_held_variants_none_but_unseen(share):
    data = load("fleet", 3, 24, ("B",), share, None, 0, ("A", "B"))
    uses = {}
    for m in data.vehicles:
        for route, use in zip(m.routes, m.use, strict=True):
            assert uses.setdefault(route, use) == use
        assert (m.id == "B") == bool(np.all(m.use == 3))
    of = np.bincount([u for u in uses.values() if u != 3], minlength=5)
    assert of.sum() == 12
    assert of[2] == 2, "test routes are the same whatever is trained on"
    assert of[0] == (8 if share == 1.0 else 2)
    assert data.trained == 1
    assert "requested_torque_nm" not in data.vehicles[0].segments.channels


def test_scores_are_those_of_all_rows_and_add_up_over_vehicles():
    data = load("fleet", 3, 24, (), 1.0, None, 0, ("A", "B"))
    rng = np.random.default_rng(0)
    y = data.column("energy_wh")
    told = y + rng.standard_normal(len(y)) + 0.5
    use, route = data.column("use"), data.column("routes")
    parts, first = [], 0
    for k, m in enumerate(data.vehicles):
        mine = told[first : first + len(m.use)]
        parts.append(scores(data, m.use, mine, only=k)["test"])
        first += len(m.use)
    whole, added = pooled([scores(data, use, told)["test"]]), pooled(parts)
    at = use == 2
    assert whole == pytest.approx(added, rel=1e-12)
    assert whole["rmse_wh"] == pytest.approx(np.sqrt(np.mean((told - y)[at] ** 2)), rel=1e-12)
    assert whole["pe_percent"] == pytest.approx(100 * (told[at].sum() / y[at].sum() - 1), rel=1e-9)
    trips = [100 * (told[route == t].sum() / y[route == t].sum() - 1) for t in np.unique(route[at])]
    assert whole["trip_pe_median"] == pytest.approx(np.median(np.abs(trips)), abs=1e-3)


def test_effects_of_several_diagnoses_are_one_list():
    """The commonest first, shapes at their median, sizes and thresholds left open; nothing of one log's trips."""
    found = [
        {"tyre_warmup": {"excess": 0.3, "distance_m": 4000.0}, "grade_lag": {"lag_s": 0.5}, "headwind": {"scale": 1.0}},
        {"tyre_warmup": {"excess": 0.5, "distance_m": 8000.0}, "regen_limit": {"power_w": 9e4}},
        {"step_change": {"power_w": 900.0, "at_trip": 3.0}, "time_skew": {"skew_s": 2.0, "cubic": 1.0}},
        {"sampling_filter": {"tau_s": 9.0}},
    ]
    whole = {
        "tyre_warmup": {"distance_m": 6000.0}, "grade_lag": {}, "headwind": {}, "regen_limit": {},
        "sampling_filter": {}, "time_skew": {"cubic": 1.0},
    }  # fmt: skip
    assert united(found) == whole
    assert united([]) == {}
    assert trainable(whole) == ("tyre_warmup", "headwind")


def planted(data, noise_wh, *effects, noise_share=0.0):
    """The data with another first vehicle, which has these effects."""
    m, *others = data.vehicles
    y = said(m.vehicle.plus(*effects), m)
    z = np.random.default_rng(0).standard_normal(len(y))
    return Data((dataclasses.replace(m, energy_wh=y + z * (noise_wh + noise_share * np.abs(y))), *others), data.trained)


@pytest.mark.parametrize(
    ("effects", "listed", "wanted"),
    [
        (
            (TimeSkew(4.0, 0.0), GradeLag(6.0)), {"mass_scale": {}, "grade_lag": {}, "time_skew": {}},
            {("time_skew", "skew_s"): (4.0, 0.2), ("grade_lag", "lag_s"): (6.0, 0.3)},
        ),
        (
            (TimeSkew(-2.0, 1.0), RegenLimit(8e3)), {"time_skew": {"cubic": 1.0}, "regen_limit": {}},
            {("time_skew", "skew_s"): (-2.0, 0.05), ("time_skew", "cubic"): (1.0, 0.0),
             ("regen_limit", "power_w"): (8e3, 300.0)},
        ),
        ((RegenLimit(1e5),), {"regen_limit": {"power_w": 9e4}}, {("regen_limit", "power_w"): (9e4, 0.0)}),
        ((), {"regen_limit": {}, "time_skew": {}}, {("regen_limit", "power_w"): (1e12, 0.0),
                                                    ("time_skew", "skew_s"): (0.0, 0.0)}),
    ],
    ids=["two delays", "a cubic and a limit below the grid", "given", "none planted"],
)  # fmt: skip
def test_thresholds_are_found_wherever_they_lie_and_none_where_none_is(effects, listed, wanted):
    data = planted(load("fleet", 3, 24, ("B",), 1.0, None, 0, ("A", "B")), 3.0, *effects)
    car = kernel(data.vehicles[0], listed).vehicle
    for (id, name), (value, within) in wanted.items():
        assert float(getattr(car.effect(id), name)) == pytest.approx(value, abs=within), id


def test_each_gear_has_its_own_size():
    data = load("fleet", 3, 24, ("B",), 1.0, None, 0, ("A", "B"))
    gears = np.zeros(13)
    gears[10:] = 0.03
    data = planted(data, 1.0, GearEfficiency(Grouped(jnp.asarray(gears), "gear")))
    found = np.asarray(kernel(data.vehicles[0], {"gear_efficiency": {}}).vehicle.effect("gear_efficiency").delta.values)
    rows = np.bincount(np.asarray(data.vehicles[0].segments.channels["gear"], int)[data.vehicles[0].use == 0])
    for gear in np.flatnonzero(rows > 100):
        assert found[gear] == pytest.approx(gears[gear], abs=0.006), gear


def test_thresholds_and_a_delay_are_the_vehicles_own_and_no_network_trains_them():
    """Planted, with the fleet's noise of the energy, in the place of what the fleet's vehicle really has."""
    effects = {"headwind": {}, "mass_scale": {}, "regen_limit": {}, "time_skew": {}}
    data = load("fleet", 3, 24, ("B",), 1.0, None, 0, ("A", "B"))
    data = planted(data, 3.0, MassScale(0.03), RegenLimit(1.5e5), TimeSkew(0.3, 0.0), noise_share=0.01)
    a, b = data.vehicles
    closed, (one, other) = kernel(a, effects), known(data, json.dumps(effects))
    car, own = closed.vehicle, closed.weighed(a)
    limit = float(car.effect("regen_limit").power_w)
    assert limit == pytest.approx(1.5e5, rel=0.01)
    assert float(car.effect("time_skew").skew_s) == pytest.approx(0.3, abs=0.03)
    assert float(car.effect("mass_scale").scale) == pytest.approx(0.03, abs=0.005)

    assert float(one.vehicle.effect("regen_limit").power_w) == pytest.approx(limit)
    assert {"headwind", "mass_scale", "time_skew"}.isdisjoint(e.id for e in one.vehicle.effects)
    late = one.fitted.plus(car.effect("time_skew"))
    assert one.across_wh == pytest.approx(said(late, a, own) - said(one.fitted, a, own))
    trips = [np.sum(one.across_wh[a.routes == t]) for t in np.unique(a.routes)]
    assert np.sum(np.abs(one.across_wh)) > 10 * np.sum(np.abs(trips)) > 0, "a delay moves energy from row to row"

    masses = float(b.vehicle.mass_kg) / float(a.vehicle.mass_kg)
    assert float(other.vehicle.effect("regen_limit").power_w) == pytest.approx(limit * masses)
    assert not other.across_wh.any()

    spoilt = dataclasses.replace(a, energy_wh=np.where(a.use == 0, a.energy_wh, -1e4))
    again = known(Data((spoilt, b), 1), json.dumps(effects))
    assert np.array_equal(again[0].across_wh, one.across_wh), "energies of rows that are not trained on say nothing"
    assert float(again[0].vehicle.effect("regen_limit").power_w) == limit


def test_each_trips_mass_is_found_and_that_of_others_is_open():
    """Trips' masses planted, with the fleet's noise of the energy: found where trips are trained on, within an interval
    where they are not; too few trips tell no variance, and then the usual one holds."""
    effects = {"mass_scale": {}, "headwind": {}}
    data = load("fleet", 3, 40, ("B",), 1.0, None, 0, ("A", "B"))
    a, b = data.vehicles
    off = np.random.default_rng(4).normal(0.0, 0.04, int(a.routes.max()) + 1)[a.routes]
    true = said(a.vehicle.plus(MassScale(0.02)), a, weighed(a.segments, off))
    z = np.random.default_rng(0).standard_normal(len(true))
    a = dataclasses.replace(a, energy_wh=true + z * (3.0 + 0.01 * np.abs(true)))
    closed = kernel(a, effects)
    at = a.use == 0
    scale = float(closed.vehicle.effect("mass_scale").scale)
    found, planted_ = (1 + closed.payload[at]) * (1 + scale), (1 + off[at]) * 1.02
    assert np.sqrt(np.mean((found / planted_ - 1) ** 2)) < 0.006
    assert closed.payload_sd == pytest.approx(np.std([off[a.routes == t][0] for t in np.unique(a.routes[at])]), rel=0.2)
    assert not closed.payload[~at].any()

    one, other = known(Data((a, b), 1), json.dumps(effects))
    assert not one.loose_wh[at].any()
    assert not other.payload.any()
    plain = said(closed.vehicle, a)
    unseen = np.unique(a.routes[~at])
    sums = [(np.sum((true - plain)[a.routes == t]), np.sum(one.loose_wh[a.routes == t])) for t in unseen]
    z = np.array([x / s for x, s in sums])
    assert 0.4 < np.sqrt(np.mean(z**2)) < 1.6, (
        "a trip's energy is off by what its mass is worth, signs of rows included"
    )
    assert np.min(one.loose_wh[~at]) < 0 < np.max(one.loose_wh[~at])

    few = dataclasses.replace(a, use=np.where(a.routes < np.unique(a.routes[at])[3], a.use, 4))
    (short, unknown) = known(Data((few, b), 1), json.dumps(effects))
    assert np.isnan(kernel(few, effects).payload_sd)
    assert short.loose_wh[few.use == 0].any()
    assert unknown.loose_wh.any()
    assert not known(Data((few, b), 1), json.dumps({"mass_scale": {"scale": 0.0}}))[0].loose_wh.any()


def test_a_network_has_what_vehicles_that_resemble_say_in_closed_form():
    """Planted: a rolling resistance that grows with v² alike in all vehicles. By itself a bus tells it from drag badly,
    with the others well; and what is handed over is the closed form's own energy."""
    effects = {"rolling_speed": {}, "road_surface": {}, "auxiliary_power": {}, "headwind": {}}
    data = load("fleet", 3, 60, (), 1.0, None, 0, ("A", "B", "C", "bus_10m"))
    sizes = (RollingSpeed(1.8e-6), RoadSurface(Grouped(jnp.array([0.0, 0.1, 0.05, 0.45]), "road_surface")))
    vehicles = []
    for k, m in enumerate(data.vehicles):
        car = eqx.tree_at(lambda c: c.effect("aero").cda_m2, m.vehicle, 1.2 * m.vehicle.effect("aero").cda_m2)
        y = said(car.plus(*sizes, AuxiliaryPower(1500.0 + 500.0 * k), Headwind(0.9)), m)
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
    model, memory = eqx.nn.make_with_state(Pinn)(one, 4, scale_wh=1.0, effects=opened, key=jax.random.key(0))
    p = predict(known_sizes.of(model), memory, rows)
    wanted = np.concatenate([said(car, m) for m, car in zip(data.vehicles, cars, strict=True)])
    np.testing.assert_allclose(p.physics_wh, wanted, rtol=2e-4, atol=0.05)
    assert np.std(np.asarray(p.energy_wh) - data.column("energy_wh")) < 5.0


def test_what_no_network_has_is_not_estimated_beside_its_sizes(monkeypatch):
    load_too = SimpleNamespace(
        fit=SimpleNamespace(table=SimpleNamespace(free=(coefficient("battery.auxiliary_w", "W", 1.0, 1.0),)))
    )
    monkeypatch.setattr(pinn_pooled, "closed", lambda *_: (None, load_too))
    with pytest.raises(InputError, match=r"battery.auxiliary_w is estimated, and no network has it"):
        sizes_of(None, "{}", ())


@pytest.mark.slow
def test_vehicles_of_few_trips_are_alike_where_their_rows_say_nothing():
    """One or two training trips each and all effects of the fleet but thresholds: alone a vehicle is told as anything,
    together rows that were not trained on are told better than by the tables. A vehicle without a row is told, too."""
    effects = {k: v for k, v in config("paper1/table2").effects.items() if k in trainable([k])}
    data = load("fleet", 3, 10, (), 1.0, None, 0, ("A", "B", "C", "bus_10m"))
    rowless = dataclasses.replace(data.vehicles[1], use=np.where(data.vehicles[1].use == 0, 4, data.vehicles[1].use))
    data = Data((data.vehicles[0], rowless, *data.vehicles[2:]), data.trained)
    text = json.dumps(effects)

    def off(car, m):
        return float(np.sqrt(np.mean((said(car, m) - m.energy_wh)[m.use != 0] ** 2)))

    alone = [off(c.vehicle, m) for m, c in zip(data.vehicles, closed(data, text), strict=True) if c is not None]
    tables = [off(m.vehicle, m) for m in data.vehicles]
    together = [off(fleet(data, text).put(m.vehicle, m, k, effects), m) for k, m in enumerate(data.vehicles)]
    assert len(alone) == 3
    assert np.all(np.isfinite(together))
    assert np.max(np.delete(together, 1)) < 0.5 * np.max(alone)
    assert np.all(np.delete(together, 1) < 0.7 * np.delete(tables, 1))


def test_a_networks_physics_has_the_thresholds_and_what_acts_across_rows():
    """An untrained network says what the sheet says, with both."""
    effects = {"regen_limit": {}, "time_skew": {}}
    data = load("fleet", 3, 24, ("B",), 1.0, None, 0, ("A", "B"))
    data = planted(data, 3.0, RegenLimit(6e4), TimeSkew(0.3, 0.0))
    rows, use = data.rows(("speed_mps",), trainable(effects), known(data, json.dumps(effects)))
    at = np.flatnonzero(use == 2)
    recipe = Recipe(features=("speed_mps",), units=(4,))
    model, memory = eqx.nn.make_with_state(Pinn)(recipe, 1, scale_wh=1.0, key=jax.random.key(0))
    physics = np.asarray(predict(model, memory, rows.take(at)).physics_wh)
    off = physics - data.vehicles[0].energy_wh[at]
    assert np.sqrt(np.mean(off**2)) < 4.0
    plain, _ = data.rows(("speed_mps",), (), known(data, "{}"))
    without = np.asarray(predict(model, memory, plain.take(at)).physics_wh) - data.vehicles[0].energy_wh[at]
    assert np.sqrt(np.mean(without**2)) > 8.0


def test_test_rows_of_vehicles_that_are_trained_on_stand_apart():
    data = load("fleet", 3, 24, (), 1.0, None, 0, ("A", "B"))
    a, b = data.vehicles
    b = dataclasses.replace(b, use=np.where(b.use == 0, 4, b.use))
    two = Data((a, b), 2)
    rng = np.random.default_rng(0)
    told = two.column("energy_wh") + rng.standard_normal(len(two.column("use")))
    parts = scores(two, two.column("use"), told)
    assert parts[TAUGHT] == scores(data, a.use, told[: len(a.use)], only=0)["test"]
    assert parts["test"]["rows"] == np.sum(two.column("use") == 2) > parts[TAUGHT]["rows"]
    assert TAUGHT not in scores(data, data.column("use"), told)
    assert two.counts()["routes"] == len(np.unique(a.routes[a.use == 0]))


def test_black_boxes_without_units_know_what_a_row_weighs():
    """Of energy that is the mass times what the features tell, trees learn the second alone, for any mass; the squares
    are of Wh."""
    rng = np.random.default_rng(0)
    unit, at = rng.uniform(0.5, 2.0, 4000), rng.integers(0, 4, 4000)
    use = np.where(np.arange(4000) < 2000, 0, np.where(np.arange(4000) < 3000, 1, 2))
    unit[use == 2] += 3.0  # heavier than any that was trained on
    off = np.where(rng.random(4000) < 0.5, 30.0 / unit, 0.0)  # has a weighted mean, which is the least squares' of Wh
    rows = SimpleNamespace(features=at[:, None].astype(float), unit=unit, energy_wh=unit * (100.0 * at + off))
    told = boosted(rows, use, 0) / unit
    for k in range(4):
        mine = (at == k) & (use == 0)
        best = np.average((100.0 * at + off)[mine], weights=unit[mine] ** 2)
        assert np.unique(told[at == k].round(4)).size == 1
        assert told[at == k][0] == pytest.approx(best, abs=1.5)


def test_few_rows_train_for_as_many_steps_as_many(monkeypatch):
    plans = []

    def networks(*_, plan, **__):
        plans.append(plan)
        raise DivergedError("enough")

    monkeypatch.setattr(pinn_models, "networks", networks)
    (task,) = tasks(config("paper1/table2", "epochs=10", 'only=["paper"]'))
    data = load("fleet", 3, 24, (), 1.0, None, 0, ("A", "B"))
    for rows in (1000, 20 * 1024):
        pinn_models.trained(data, None, np.zeros(rows), [{**task, "effects": {}}], pinn.Model(**task["model"]))
    assert [(p.epochs, p.patience, p.stop_after) for p in plans] == [(170, 68, 204), (10, 4, 12)]


def test_a_task_trains_with_the_effects_of_its_config(monkeypatch):
    """What the networks are given is `known` of the config's effects."""
    given = {}
    monkeypatch.setattr(pinn, "trained", lambda data, rows, use, tasks, model: given.update(rows=rows) or [{}])
    sets = ("routes=24", 'variants=["A"]', 'only=["ours"]', "diagnosed=[]", "effects={regen_cutoff={}, time_skew={}}")
    (task,) = tasks(config("paper1/table2", *sets))
    pinn.run(task)
    data = load("fleet", 1, 24, (), 1.0, None, 0, ("A",))
    (one,) = known(data, json.dumps({"regen_cutoff": {}, "time_skew": {}}))
    assert given["rows"].across_wh == pytest.approx(one.across_wh, rel=1e-6)
    assert given["rows"].car.has("regen_cutoff")
    held = Data(tuple(dataclasses.replace(m, use=np.full(len(m.use), 2)) for m in data.vehicles), 1)
    with pytest.raises(InputError, match="no vehicle has a training route"):
        known(held, "{}")


def test_effects_as_diagnosed_ask_for_vehicles_to_diagnose():
    with pytest.raises(InputError, match="'ours, effects as diagnosed' has the effects of a diagnosis"):
        list(tasks(config("paper1/table2", "diagnosed=[]")))
    task = next(t for t in tasks(config("paper1/table2")) if t["name"] == "ours, effects as diagnosed")
    assert (task["effects"], task["diagnosed"]) == ({}, ["A", "D"])
