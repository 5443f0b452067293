"""The networks' experiment: who is trained on what, deltas of models, scores that add up."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from pinn_fleet import HELD, config, tractors

from experiments.paper1.halves import coefficient
from experiments.pinn import models as pinn_models
from experiments.pinn import pooled as pinn_pooled
from experiments.pinn import study as pinn
from experiments.pinn.closed import trainable
from experiments.pinn.data import Data
from experiments.pinn.diagnosed import united
from experiments.pinn.models import boosted
from experiments.pinn.pooled import sizes_of
from experiments.pinn.scores import TAUGHT, pooled, scores
from experiments.pinn.study import chosen, tasks, together
from hdev_jax.errors import InputError
from hdev_jax.learn.pinn.fit import PAPER_WEIGHTS
from hdev_jax.learn.train import DivergedError


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
    data = tractors(HELD, share=share)
    uses = {}
    for m in data.vehicles:
        for route, use in zip(m.routes, m.use, strict=True):
            assert uses.setdefault(route, use) == use
        assert (m.id == HELD) == bool(np.all(m.use == 3))
    of = np.bincount([u for u in uses.values() if u != 3], minlength=5)
    assert of.sum() == 12
    assert of[2] == 2, "test routes are the same whatever is trained on"
    assert of[0] == (8 if share == 1.0 else 2)
    assert data.trained == 1
    assert "requested_torque_nm" not in data.vehicles[0].segments.channels


def test_scores_are_those_of_all_rows_and_add_up_over_vehicles():
    data = tractors()
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


def test_what_no_network_has_is_not_estimated_beside_its_sizes(monkeypatch):
    load_too = SimpleNamespace(
        fit=SimpleNamespace(table=SimpleNamespace(free=(coefficient("battery.auxiliary_w", "W", 1.0, 1.0),)))
    )
    monkeypatch.setattr(pinn_pooled, "closed", lambda *_: (None, load_too))
    with pytest.raises(InputError, match=r"battery.auxiliary_w is estimated, and no network has it"):
        sizes_of(None, "{}", ())


def test_test_rows_of_vehicles_that_are_trained_on_stand_apart():
    data = tractors()
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
    data = tractors()
    for rows in (1000, 20 * 1024):
        pinn_models.trained(data, None, np.zeros(rows), [{**task, "effects": {}}], pinn.Model(**task["model"]))
    assert [(p.epochs, p.patience, p.stop_after) for p in plans] == [(170, 68, 204), (10, 4, 12)]


def test_effects_as_diagnosed_ask_for_vehicles_to_diagnose():
    with pytest.raises(InputError, match="'ours, effects as diagnosed' has the effects of a diagnosis"):
        list(tasks(config("paper1/table2", "diagnosed=[]")))
    task = next(t for t in tasks(config("paper1/table2")) if t["name"] == "ours, effects as diagnosed")
    assert (task["effects"], task["diagnosed"]) == ({}, ["A", "D"])
