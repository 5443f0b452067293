"""The networks' experiment: who is trained on what, deltas of models, scores that add up."""

import dataclasses
import json

import equinox as eqx
import jax
import numpy as np
import pytest

from experiments.config import CONFIGS, resolve, typed
from experiments.pinn import Config, chosen, tasks, together
from experiments.pinn_data import Data, load
from experiments.pinn_diagnosed import united
from experiments.pinn_models import kernel, known, said, trainable
from experiments.pinn_scores import pooled, scores
from hdev_jax.errors import InputError
from hdev_jax.learn.pinn import Pinn, Recipe, predict
from hdev_jax.learn.pinn_fit import PAPER_WEIGHTS
from hdev_jax.physics.battery import RegenLimit
from hdev_jax.physics.sensors import MassScale, TimeSkew


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
    models = chosen(config("studies/pinn_ablations"))
    for name, model in models.items():
        base = models["ours" if name.startswith("ours") else "paper"]
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
    """The commonest first, shapes at their median, sizes and thresholds left open."""
    found = [
        {"tyre_warmup": {"excess": 0.3, "distance_m": 4000.0}, "grade_lag": {"lag_s": 0.5}, "headwind": {"scale": 1.0}},
        {"tyre_warmup": {"excess": 0.5, "distance_m": 8000.0}, "regen_limit": {"power_w": 9e4}},
    ]
    whole = {"tyre_warmup": {"distance_m": 6000.0}, "grade_lag": {}, "headwind": {}, "regen_limit": {}}
    assert united(found) == whole
    assert united([]) == {}
    assert trainable(whole) == ("tyre_warmup", "headwind")


def test_thresholds_and_a_delay_are_the_vehicles_own_and_no_network_trains_them():
    """Planted, with the fleet's noise, in the place of what the fleet's vehicle really has."""
    effects = {"headwind": {}, "mass_scale": {}, "regen_limit": {}, "time_skew": {}}
    data = load("fleet", 3, 24, ("B",), 1.0, None, 0, ("A", "B"))
    a, b = data.vehicles
    planted = a.vehicle.plus(MassScale(0.03), RegenLimit(1.5e5), TimeSkew(0.3, 0.0))
    noise = 3.0 * np.random.default_rng(0).standard_normal(len(a.use))
    a = dataclasses.replace(a, energy_wh=said(planted, a) + noise)
    data = Data((a, b), 1)
    car, (one, other) = kernel(a, effects), known(data, json.dumps(effects))
    limit = float(car.effect("regen_limit").power_w)
    assert limit == pytest.approx(1.5e5, rel=0.01)
    assert float(car.effect("time_skew").skew_s) == pytest.approx(0.3, abs=0.02)
    assert float(car.effect("mass_scale").scale) == pytest.approx(0.03, abs=0.005)

    assert float(one.vehicle.effect("regen_limit").power_w) == pytest.approx(limit)
    assert {"headwind", "mass_scale", "time_skew"}.isdisjoint(e.id for e in one.vehicle.effects)
    assert one.moved_wh == pytest.approx(said(car, a) - said(car.minus("time_skew"), a))
    trips = [np.sum(one.moved_wh[a.routes == t]) for t in np.unique(a.routes)]
    assert np.sum(np.abs(one.moved_wh)) > 10 * np.sum(np.abs(trips)) > 0, "a delay moves energy from row to row"

    masses = float(b.vehicle.mass_kg) / float(a.vehicle.mass_kg)
    assert float(other.vehicle.effect("regen_limit").power_w) == pytest.approx(limit * masses)
    assert not other.moved_wh.any()

    plain, use = data.rows(("speed_mps",))
    rows, _ = data.rows(("speed_mps",), trainable(effects), (one, other))
    assert np.asarray(rows.moved_wh) == pytest.approx(np.concatenate([one.moved_wh, other.moved_wh]), rel=1e-6)
    recipe = Recipe(features=("speed_mps",), units=(4,))
    model, memory = eqx.nn.make_with_state(Pinn)(recipe, 1, scale_wh=1.0, key=jax.random.key(0))
    lone = jax.tree.map(lambda x: x[use == 0], eqx.tree_at(lambda r: r.car, rows, plain.car))
    without = predict(model, memory, plain.take(use == 0)).physics_wh
    assert predict(model, memory, lone).physics_wh - without == pytest.approx(lone.moved_wh, abs=0.01)


def test_effects_as_diagnosed_ask_for_vehicles_to_diagnose():
    with pytest.raises(InputError, match="'ours, effects as diagnosed' has the effects of a diagnosis"):
        list(tasks(config("paper1/table2", "diagnosed=[]")))
    task = next(t for t in tasks(config("paper1/table2")) if t["name"] == "ours, effects as diagnosed")
    assert (task["effects"], task["diagnosed"], task["diagnosed_routes"]) == ({}, ["A", "B", "C", "D"], 12)
