"""Scores of four rows and the pages made of them, every number by hand."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from experiments.pinn import figures as pinn_figures
from experiments.pinn import models as pinn_models
from experiments.pinn import pages as pinn_pages
from experiments.pinn import study as pinn
from experiments.pinn import sweeps
from experiments.pinn.data import Data, Member
from experiments.pinn.scores import TAUGHT, pooled, scores
from experiments.runner.config import CONFIGS, resolve, typed
from experiments.runner.tables import read_markdown
from hdev_jax.errors import InputError
from hdev_jax.learn.pinn.model import Recipe
from hdev_jax.learn.train import DivergedError
from hdev_jax.rundir import Run
from hdev_jax.segments import Segments

# Two routes that test, of two rows and of a halt, and one row that is unseen.
USE = np.array([2, 2, 2, 3])
ROUTES = np.array([0, 0, 1, 2])
MEASURED = np.array([100.0, 200.0, 50.0, 150.0])
SAID = np.array([110.0, 196.0, 45.0, 170.0])  # errors of 10, −4, −5 and 20 Wh
C_RR = np.array([0.0066, 0.0060, 0.9, 0.0055])  # 1.1, 1.2, at the halt nonsense, and 1.0 of the truth
CDA = np.array([5.0, 6.0, -7.0, 4.0])  # 1.0, 1.2, nonsense and 0.8


def four_rows(id="A"):
    length = np.array([100.0, 100.0, 0.0, 100.0])
    speed = np.where(length > 0, 10.0, 0.0)
    s = Segments(ROUTES, np.zeros(4, int), np.zeros(4), np.full(4, 10.0), length, speed, speed, {})
    true = {"c_rr": np.array([0.0060, 0.0050, 0.0050, 0.0055]), "cda_m2": np.full(4, 5.0)}
    return Data((Member(id, s, MEASURED, None, None, ROUTES, USE, **true),), 1)


def scored(said=SAID, **more):
    return scores(four_rows(), USE, np.asarray(said, float), **more)


def task(name, kind="network", fold=0, **more):
    return {"name": name, "model": {"kind": kind}, "data": {"fold": fold, "share": 1.0}, **more}


def config(name="paper1/table2", *sets):
    return typed(pinn.Config, resolve(CONFIGS / f"{name}.toml", sets), name)


@pytest.fixture
def run(tmp_path):
    return Run(tmp_path, tmp_path, {}, "", done=False)


@pytest.fixture
def no_figures(monkeypatch):
    monkeypatch.setattr(pinn_figures, "save_figure", lambda *_: None)


def written(run, name):
    head, *body = read_markdown(run.path("tables", f"{name}.md"))[1]
    return [dict(zip(head, line, strict=True)) for line in body]


def test_scores_of_four_rows():
    test, unseen = (scored(c_rr=C_RR, cda_m2=CDA, sd_wh=np.full(4, 3.0))[k] for k in ("test", "unseen"))
    assert (test["rows"], test["trips"], unseen["rows"], unseen["trips"]) == (3, 2, 1, 1)
    assert (test["squares"], test["error_wh"], test["energy_wh"]) == (141.0, 1.0, 350.0)
    assert test["trip_pe"] == [2.0, -10.0]  # 6 of 300 Wh, −5 of 50 Wh
    assert test["share_inside_90"] == pytest.approx(1 / 3)  # 4 Wh is within 1.645 · 3 Wh; 5 Wh is not
    assert unseen["squares"] == 400.0
    assert unseen["trip_pe"] == pytest.approx([100 * 20 / 150], abs=1e-4)
    c = test["coefficients"]["A"]
    assert c["c_rr"][2] == pytest.approx(0.0063), "the halt has no coefficient"
    assert c["c_rr"][0] == pytest.approx(0.0060 + 0.05 * 0.0006)
    assert c["c_rr_true"][2] == pytest.approx(0.0055)
    assert c["c_rr_error"] == pytest.approx(0.15)  # median of 1.1 and 1.2, less one
    assert c["cda_m2_error"] == pytest.approx(0.1)
    assert unseen["coefficients"]["A"]["cda_m2_error"] == pytest.approx(0.2), "too little is an error, too"


def test_scores_without_finite_deviations_or_coefficients_have_none():
    test = scored(sd_wh=np.array([3.0, np.nan, 3.0, 3.0]), c_rr=C_RR)["test"]
    assert "share_inside_90" not in test
    assert "coefficients" not in test


def test_pooled_scores_by_hand():
    parts = list(scored(c_rr=C_RR, cda_m2=CDA, sd_wh=np.full(4, 3.0)).values())
    p = pooled(parts)
    assert p["rmse_wh"] == pytest.approx(np.sqrt((100 + 16 + 25 + 400) / 4))
    assert p["pe_percent"] == pytest.approx(100 * 21 / 500)
    assert p["trip_pe_mean"] == pytest.approx((2 - 10 + 40 / 3) / 3, abs=1e-4)
    assert p["trip_pe_median"] == pytest.approx(10.0)
    assert (p["rows"], p["trips"]) == (4, 3)
    assert p["share_inside_90"] == pytest.approx(1 / 4)  # one of three rows, and none of one
    assert p["c_rr_error_percent"] == pytest.approx(7.5)  # of 15 and 0
    assert p["c_rr_error_worst"] == pytest.approx(15.0)
    assert p["cda_m2_error_worst"] == pytest.approx(20.0)


def test_the_table_counts_rows_once_and_bounds_over_all_trainings(run, no_figures):
    """Three seeds of two folds: one diverged, and bounds are met by the first alone."""
    bound = {"rows": 3, "c_rr": 3, "cda_m2": 1}
    free = {"rows": 3, "c_rr": 0, "cda_m2": 0}
    results = [
        (task("paper", seed=0), {"network": scored(), "at_bound": bound}),
        (task("paper", seed=1), {"network": scored(MEASURED + 2.0), "at_bound": free}),
        (task("paper", seed=2), {"diverged": True}),
        (task("paper", seed=0, fold=1), {"network": scored(MEASURED + 1.0), "at_bound": free}),
        (task("network without physics", seed=0), {"diverged": True}),
        (task("physics", "vehicles", vehicle=0), {"tabular": scored(MEASURED * 1.5)}),
        (task("physics", "vehicles", vehicle=1), {"tabular": scored(MEASURED * 1.5)}),
    ]
    out = pinn_pages.table(config(), results, run)
    paper, unseen, tables, _, lost = written(run, "table")
    assert (paper["model"], paper["n"], paper["trips"]) == ("PINN", "6", "4")
    assert (unseen["model"], unseen["n"]) == ("PINN: unseen", "2")
    assert (tables["model"], tables["n"]) == ("physics, tables", "6")
    assert lost["model"] == "network, physics as input only: diverged, 1 of 1 trainings"
    rows = {r["name"]: r for r in out["rows"]}
    assert rows["PINN"]["ours"]["rmse"] == pytest.approx(np.sqrt((141 + 3 * 4 + 3 * 1) / 9))
    assert rows["PINN"]["ours"]["pe"] == pytest.approx(100 * (1 + 6 + 3) / 1050)
    assert rows["PINN"]["paper"] == {"rmse": 5.78, "pe": -11.7}
    assert rows["PINN (unseen)"]["paper"] is None
    assert rows["physics_tabular"]["ours"]["pe"] == pytest.approx(50.0)
    assert rows["network without physics"]["ours"] is None
    assert rows["network without physics"]["reason"] == "diverged, 1 of 1 trainings"
    said = "diverged trainings, left out of all errors: 'PINN' 1 of 4, 'network, physics as input only' 1 of 1"
    assert said in out["notes"]
    (bounds,) = written(run, "bounds")
    assert [float(bounds[k]) for k in ("c_rr", "C_d·A")] == pytest.approx([100 * 3 / 9, 100 * 1 / 9], abs=0.1)


def test_missed_targets_are_listed(run, no_figures):
    ours = scored(MEASURED * 1.02, c_rr=C_RR, cda_m2=np.full(4, 5.1))
    paper = scored(MEASURED * 1.01)
    results = [
        (task("ours"), {"network": ours, "at_bound": {"rows": 3, "c_rr": 0, "cda_m2": 1}}),
        (task("paper"), {"network": paper, "physics": scored(MEASURED * 1.2)}),
        (task("physics", "vehicles", vehicle=0), {"tabular": scored(MEASURED * 1.1)}),
    ]
    unit = np.sqrt((100**2 + 200**2 + 50**2) / 3)
    assert pinn_pages.table(config(), results, run)["missed"] == [
        f"RMSE is not in the order of table 2: {0.01 * unit:.2f}, {0.2 * unit:.2f}, {0.1 * unit:.2f}",
        "our network: PE +2.00 %, target ±1",
        "our network: RMSE 2 times the paper's, target 0.9",
        "our network: c_rr off by 15.0 % in the median of vehicles, target 5",
        "our network: c_rr off by 15.0 % in the worst vehicle, target 5",
        "our network: 33.3 % at a bound",
    ]
    buses = pinn_pages.table(config("studies/pinn_buses"), results, run)["missed"]
    assert f"our network: RMSE {0.02 * unit:.1f} Wh, the best is PINN with {0.01 * unit:.1f}" in buses
    good = [(task("ours"), {"network": scored(MEASURED * 1.001)}), (task("paper"), {"network": paper})]
    assert pinn_pages.table(config(), good, run)["missed"] == []


def test_coefficients_are_those_of_the_first_seed(run, no_figures):
    table = scored(c_rr=np.full(4, 0.008), cda_m2=np.full(4, 6.0))
    results = [
        (task("physics", "vehicles", vehicle=0), {"tabular": table}),
        (task("paper", seed=0), {"network": scored(c_rr=C_RR, cda_m2=CDA)}),
        (task("paper", seed=1), {"network": scored(c_rr=2 * C_RR, cda_m2=CDA)}),
    ]
    out = pinn_pages.coefficients(config("paper1/fig6"), results, run)
    found = {r["name"]: r["ours"] for r in out["rows"]}
    assert found == {
        "A, tables": {"median": pytest.approx(0.008), "true_median": pytest.approx(0.0055)},
        "A, PINN": {"median": pytest.approx(0.0063), "true_median": pytest.approx(0.0055)},
    }
    assert [float(x["coefficient error [%]"]) for x in written(run, "coefficients")] == pytest.approx(
        [100 * (np.median([0.008 / 0.006, 0.008 / 0.005]) - 1), 15.0], rel=0.01
    )
    with pytest.raises(InputError, match="every training of the networks diverged"):
        pinn_pages.coefficients(config("paper1/fig6"), [results[0], (task("paper"), {"diverged": True})], run)


def test_ours_against_black_boxes_at_the_least_data_and_on_what_is_unseen(run, no_figures):
    def at(share, name, times):
        t, found = task(name), scored(MEASURED + times)
        return {**t, "data": {**t["data"], "share": share}}, {
            "network": {**found, TAUGHT: found["test"]} if share < 1 else found, "still_better": times == 4.0,
            "counts": {"routes": round(20 * share), "training": round(900 * share)},
        }  # fmt: skip

    results = [
        at(0.1, "ours", 2.0), at(0.1, "ours", 4.0), at(0.1, "ours", 3.0), at(0.1, "network without physics", 4.0),
        at(1.0, "ours", 1.0), at(1.0, "network without physics", 1.0),
    ]  # fmt: skip
    out = sweeps.shares(config("studies/pinn_data"), results, run)
    assert out["missed"] == [
        "10 % of the routes, test: RMSE 0.75 times that of network, physics as input only, target 0.7",
        "10 % of the routes, test, vehicles trained on: RMSE 0.75 times that of network, physics as input only, "
        "target 0.7",
        "10 % of the routes, unseen: RMSE 0.75 times that of network, physics as input only, target 0.7",
        "100 % of the routes, unseen: RMSE 1 times that of network, physics as input only, target 0.7",
    ]
    first = written(run, "shares")[0]
    expected = {"seeds": 3, "RMSE [Wh]": 3, "smallest": 2, "largest": 4, "training routes": 2, "training rows": 90}
    assert {k: float(first[k]) for k in expected} == expected
    assert (
        "validation error still falling at the last epoch, in some training: 'network, physics as input only', "
        "'our network'" in out["notes"]
    )
    # where every route trains, every vehicle is trained on
    assert [x["share [%]"] for x in written(run, "shares") if x["evaluated on"] == TAUGHT] == ["10", "10", "100", "100"]


def test_how_much_of_what_is_learned_has_a_name(run, no_figures):
    """Squared errors of 16, 4 and 6.25 Wh²: of the 12 that the network without effects takes off, 9.75 have names."""
    vehicles = {"bayesian": scored(MEASURED + 4.0), "kernel": scored(MEASURED + 2.5)}
    results = [
        (task("physics", "vehicles", vehicle=0), vehicles),
        (task("ours without effects"), {"network": scored(MEASURED + 2.0)}),
        *(
            (task("ours, effects as diagnosed", seed=k), {"form": scored(MEASURED + 3.0), "network": scored(MEASURED)})
            for k in range(2)
        ),
    ]
    notes = pinn_pages.table(config(), results, run)["notes"]
    (said,) = [n for n in notes if n.startswith("how far named effects")]
    assert "(RMSE 4 Wh)" in said
    assert "'our network without effects' lowers it (2 Wh)" in said
    assert "0.81 by 'physics, known effects, linear fit' (2.5 Wh)" in said
    assert "0.58 by 'our network, effects as diagnosed, its linear fit before training' (3 Wh)" in said
    alone = [x for x in written(run, "table") if x["model"].endswith("linear fit before training")]
    assert [(x["n"], float(x["RMSE [Wh]"])) for x in alone] == [("3", 3.0)], "no seed changes a closed form"
    other = [(results[0][0], {**vehicles, "kernel": scored(MEASURED + 5.0)}), results[1]]
    (none,) = [n for n in pinn_pages.table(config(), other, run)["notes"] if n.startswith("how far named effects")]
    assert "-0.75 by 'physics, known effects, linear fit' (5 Wh)" in none
    worse = [results[0], (task("ours without effects"), {"network": scored(MEASURED + 3.95)})]
    assert not [n for n in pinn_pages.table(config(), worse, run)["notes"] if n.startswith("how far named effects")]


def test_the_grid_has_medians_over_seeds_and_says_what_diverged(run, no_figures):
    results = [
        (task("paper", weights=[1.0, 0.1, w]), {"network": scored(MEASURED + error)})
        for w, error in ((0.01, 2.0), (0.01, 6.0), (0.01, 3.0), (1.0, 4.0))
    ]
    lost = (task("paper", weights=[9.0, 0.1, 0.01]), {"diverged": True})
    out = sweeps.grid(config("studies/pinn_weights"), [*results, lost], run)
    assert out["rows"] == [
        {"name": "1, 0.1, 0.01", "paper": None, "ours": {"rmse_wh": pytest.approx(3.0)}},
        {"name": "1, 0.1, 1", "paper": None, "ours": {"rmse_wh": pytest.approx(4.0)}},
    ]
    assert out["findings"] == [
        "The lowest median RMSE is 3.00 Wh, at λ = 1, 0.1, 0.01; the 2 medians differ by at most 1.0 Wh, the seeds of "
        "one setting by at most 4.0 Wh; 1 of 5 trainings diverged"
    ]
    with pytest.raises(InputError, match="every training of the grid diverged"):
        sweeps.grid(config("studies/pinn_weights"), [lost], run)


def test_both_bounds_of_both_coefficients_count_in_every_member():
    near = [
        SimpleNamespace(c_rr=np.array([0.0199, 0.0001, 0.0100, 0.0100]), cda_m2=np.array([3.0, 9.0, 6.0, 3.0])),
        SimpleNamespace(c_rr=np.array([0.0197, 0.0003, 0.0100, 0.0199]), cda_m2=np.array([3.1, 8.9, 8.97, 6.0])),
    ]
    found = pinn_models._at_bound(
        Recipe(features=(), clamp=0.5), np.full(4, 6.0), near, np.array([True, True, True, False])
    )
    assert found == {"rows": 6, "c_rr": 2, "cda_m2": 3}


def test_a_training_that_diverges_is_a_result(monkeypatch):
    def diverges(*_, **__):
        raise DivergedError("training: the loss or its slope is not finite")

    monkeypatch.setattr(pinn_models, "networks", diverges)
    monkeypatch.setattr(pinn_models, "names_of", lambda *_: ("slope",))
    whole = json.loads(json.dumps({**next(t for t in pinn.tasks(config()) if t["name"] == "paper"), "effects": {}}))
    spec = pinn.Model(**whole["model"])
    assert pinn_models.trained(four_rows(), None, USE, [whole, whole], spec) == [{"diverged": True}] * 2


def test_effects_found_are_said_with_their_units_and_who_is_given_them(run, no_figures):
    found = {"regen_limit": {"power_w": 2e5, "share": 1.0}, "auxiliary_power": {"power_w": 823.4}}
    physics = {"kernel": scored(MEASURED + 1.0), "found": found}
    own = {**task("ours"), "model": {**task("ours")["model"], "effects": True}}
    out = pinn_pages.table(
        config(), [(task("physics", "vehicles", vehicle=0), physics), (own, {"network": scored()})], run
    )
    assert [x["effect"] for x in written(run, "effects")] == ["constant auxiliary load", "limit of regeneration"]
    said = {x["effect"]: x["median"] for x in written(run, "effects")}
    assert said["constant auxiliary load"] == "power 823\N{NO-BREAK SPACE}W"
    assert said["limit of regeneration"].startswith("power 200,000\N{NO-BREAK SPACE}W")
    given = "'physics, known effects, linear fit' and 'our network' are given the effects that the fleet hides"
    assert given in out["findings"]
    bare = pinn_pages.table(config(), [(task("paper"), {"network": scored()})], run)
    assert not [x for x in bare["findings"] if "the fleet hides" in x]
