"""Pooling, steps and evidence of a fleet on numbers with a known answer; which vehicles there are."""

import numpy as np
import pytest
from scipy import stats

from hdev_jax.diagnosis.settings import FLEET_SETTINGS
from hdev_jax.energy.ledger import TOTAL, UNEXPLAINED
from hdev_jax.errors import InputError
from hdev_jax.many import fleet_result, pooling, sources, unlike
from hdev_jax.many.evidence import effects_of_types, families
from hdev_jax.many.ledger import fleet_ledger
from hdev_jax.many.pooling import cauchy, pooled, shrunk, without_each
from hdev_jax.many.unlike import Weeks, change_point, equations
from hdev_jax.report.many import fleet_text
from hdev_jax.report.many.figures import effects_map

TRIPS, DAY_S = 40, 86_400.0


def estimates(rng, n=30, between=0.5):
    sd = rng.uniform(0.2, 1.0, n)
    return 3.0 + between * rng.normal(size=n) + sd * rng.normal(size=n), sd


def test_the_pooled_mean_and_the_spread_over_vehicles_are_those_that_the_numbers_were_drawn_with():
    rng = np.random.default_rng(0)
    pools = [pooled(*estimates(rng)) for _ in range(300)]
    z = np.array([(p.mean - 3.0) / p.error for p in pools])
    assert np.mean(np.abs(z) > stats.t.ppf(0.975, 29)) < 0.09  # 5 %, three standard errors of 300 draws above
    assert np.mean([p.between for p in pools]) == pytest.approx(0.5, abs=0.05)


def test_estimates_that_agree_are_averaged_by_their_errors_alone():
    value, sd = np.array([1.0, 1.0, 1.0]), np.array([1.0, 2.0, 2.0])
    pool = pooled(value, sd)
    assert pool.between == 0.0
    assert pool.error == pytest.approx(1.0 / np.sqrt(1.5))
    near, near_sd = shrunk(value, sd, pool)
    np.testing.assert_allclose(near, 1.0)
    np.testing.assert_allclose(near_sd, pool.error)


def test_too_few_estimates_and_errors_that_are_none_are_refused():
    with pytest.raises(ValueError, match="two or more"):
        pooled(np.array([1.0]), np.array([1.0]))
    with pytest.raises(ValueError, match="positive"):
        pooled(np.array([1.0, 2.0]), np.array([1.0, 0.0]))


def test_a_vehicle_is_compared_with_the_others_alone():
    rng = np.random.default_rng(1)
    value, sd = estimates(rng, between=0.1)
    value[7] += 6.0
    away, _, p = without_each(value, sd)
    assert np.argmin(p) == 7
    assert p[7] < 1e-4
    assert away[7] == pytest.approx(6.0, abs=1.5)
    calm = np.array([without_each(*estimates(rng))[2] for _ in range(20)])
    assert 0.02 < np.mean(calm < 0.05) < 0.08


def test_of_many_vehicles_each_is_compared_as_of_few(monkeypatch):
    value, sd = estimates(np.random.default_rng(11), n=120)
    few = without_each(value, sd)
    monkeypatch.setattr(pooling, "MANY", 100)
    many = without_each(value, sd)
    np.testing.assert_allclose(many[0], few[0], atol=0.02)
    np.testing.assert_allclose(many[1], few[1], rtol=0.03)


def test_forms_of_one_effect_are_combined_whatever_their_correlation():
    same = np.full(9, 0.03)
    assert cauchy(same) == pytest.approx(0.03)
    rng = np.random.default_rng(2)
    z = rng.normal(size=(2000, 1)) + 0.3 * rng.normal(size=(2000, 6))
    p = 2 * stats.norm.sf(np.abs(z) / np.hypot(1.0, 0.3))
    assert np.mean([cauchy(x) < 0.05 for x in p]) < 0.065


def course(rng, *, step=0.0, at=25, first_day=0.0, season=0.0):
    """Normal equations of two coefficients by trip; the first rises by `step`, and follows a `season`."""
    gram, score = [], []
    for t in range(TRIPS):
        x = rng.normal(size=(20, 2)) @ np.array([[1.0, 0.6], [0.0, 0.8]])
        slow = season * np.sin(2 * np.pi * t / TRIPS)
        y = x[:, 0] * (step * (t >= at) + slow) + rng.normal(size=20)
        gram.append((x.T @ x)[np.triu_indices(2)].tolist())
        score.append((x.T @ y).tolist())
    days = (first_day + np.arange(TRIPS)) * DAY_S * 3 + 1.7e9
    names = {"names": ["road.c_rr", "road.cda_m2"], "declared": [True, True]}
    return {
        "trip": [f"T{t}" for t in range(TRIPS)], "started_s": days.tolist(), "km": [10.0] * TRIPS,
        "coefficients": {**names, "gram": gram, "score": score, "kwh_per_unit": [[2.0, 1.0]] * TRIPS},
    }  # fmt: skip


@pytest.fixture
def _fewer_permutations(monkeypatch):
    monkeypatch.setattr(unlike, "DRAWS", (199, 1999))


def test_a_step_is_certain_to_as_many_digits_as_there_are_permutations():
    found = change_point(*equations(course(np.random.default_rng(3), step=0.6)), 0, np.random.default_rng(0), side=3)
    assert found is not None
    assert found.p < 1e-4


@pytest.mark.usefixtures("_fewer_permutations")
def test_a_step_is_found_at_its_trip_with_its_size_and_none_where_there_is_none():
    rng = np.random.default_rng(3)
    found = [change_point(*equations(course(rng, step=0.6)), 0, rng, side=3) for _ in range(20)]
    assert np.mean([f.p < 0.001 for f in found]) > 0.9
    assert np.mean([f.low <= 25 <= f.high for f in found]) >= 0.8
    assert np.mean([f.size for f in found]) == pytest.approx(0.6, abs=0.06)
    calm = [change_point(*equations(course(rng)), 0, rng, side=3).p for _ in range(100)]
    assert np.mean(np.array(calm) < 0.1) < 0.2  # 10 %, and three standard errors


@pytest.mark.usefixtures("_fewer_permutations")
def test_what_all_vehicles_do_in_a_week_is_no_change_of_one():
    rng = np.random.default_rng(4)
    each = [{"name": f"V{k}", "course": course(rng, season=0.5)} for k in range(10)]
    common = Weeks(each)
    alone = [change_point(*equations(r["course"]), 0, rng, side=3).p for r in each]
    beside = [change_point(*common.of(k), 0, rng, side=3).p for k in range(10)]
    assert np.max(alone) < 0.01
    assert np.median(beside) > 0.05


def record(rng, k, *, effect=0.0, step=0.0, kind="truck", named=()):
    """A vehicle's record with what the fleet's results read of it."""
    own = 0.006 + 1e-4 * rng.normal()
    scan = {f"{id_}.{p}": {"id": id_, "kind": "size", "value": x + rng.normal() * sd, "sd": sd, "clusters": 30.0}
            for id_, p, x, sd in (("air_density", "scale", effect, 0.5), ("headwind", "scale", 0.0, 0.5),
                                  ("auxiliary_power", "power_w", 0.0, 200.0))}  # fmt: skip
    rows = [("rolling", 50.0), (UNEXPLAINED, 2.0), (TOTAL, 52.0)]
    ledger = [{"level": level, "name": name, "cause": c, "kwh": x, "lower": x - 1.0, "upper": x + 1.0}
              for level, name in (("all", "all"), ("week", "2024-W01")) for c, x in rows]  # fmt: skip
    about = [{"level": level, "name": name, "km": 100.0, "hours": 2.0, "trips": 4, "measured_kwh": 52.0,
              "regenerated_kwh": 5.0, "auxiliary_kwh": 3.0, "parked_kwh": 0.0}
             for level, name in (("all", "all"), ("week", "2024-W01"))]  # fmt: skip
    sized = {n: {"value": own, "sd": 1e-4, "unit": "1", "prior_value": 0.006, "prior_sd": 8e-4, "alone": own,
                 "alone_sd": 1e-4} for n in ("road.c_rr", "road.cda_m2")}  # fmt: skip
    return {
        "name": f"{kind}{k:02d}", "type": kind, "status": "done", "message": "", "scan": scan, "seconds": 1.0,
        "effects": [{"id": e, "q_value": q} for e, q in named], "coefficients": sized,
        "course": course(rng, step=step), "ledger": {"rows": ledger, "about": about, "undated": 0},
    }  # fmt: skip


def test_an_effect_that_no_vehicle_decides_is_decided_by_its_type():
    rng = np.random.default_rng(5)
    records = [record(rng, k, effect=1.0) for k in range(40)] + [record(rng, k, kind="bus") for k in range(40)]
    found = [(e["type"], e["id"]) for e in effects_of_types(records, FLEET_SETTINGS) if e["found"]]
    assert found == [("truck", "air_density")]


def test_what_an_effect_of_the_type_explains_is_no_second_one():
    rng = np.random.default_rng(6)
    records = [record(rng, k, effect=1.0) for k in range(20)]
    for r in records:
        r["scan"]["headwind.scale"]["value"] += 0.7
    asked = []

    def again(some, beside):
        asked.append(beside)
        return {r["name"]: {k: {**s, "value": 0.01 * rng.normal()} for k, s in r["scan"].items() if "air" not in k}
                for r in some}  # fmt: skip

    assert len([e for e in effects_of_types(records, FLEET_SETTINGS) if e["found"]]) == 2
    found = [e["id"] for e in effects_of_types(records, FLEET_SETTINGS, again) if e["found"]]
    assert found == ["air_density"]
    ((value, sd),) = [asked[0]["air_density"]["scale"]]
    assert value == pytest.approx(1.0, abs=0.4)
    assert sd > abs(value)


def test_nothing_is_shown_by_a_type_that_has_nothing():
    rng = np.random.default_rng(7)
    fleets = [[record(rng, k) for k in range(6)] for _ in range(40)]
    assert sum(any(e["found"] for e in effects_of_types(f, FLEET_SETTINGS)) for f in fleets) <= 4


def test_false_finds_are_bounded_over_vehicles():
    rng = np.random.default_rng(8)
    lone = [record(rng, 0, named=[("headwind", 0.04)]), *(record(rng, k) for k in range(1, 20))]
    assert families(lone, 0.05) == 0.0
    sure = [record(rng, k, named=[("headwind", 1e-6)]) for k in range(10)] + [record(rng, k) for k in range(10, 20)]
    assert families(sure, 0.05) == pytest.approx(0.025)


def test_the_ledger_of_the_fleet_adds_up_at_every_level():
    rng = np.random.default_rng(9)
    records = [record(rng, k, kind=kind) for kind in ("truck", "bus") for k in range(3)]
    rows, about = fleet_ledger(records, price=0.5)
    for _, block in rows.groupby(["level", "name"]):
        by = block.set_index("cause")["kwh"]
        assert by.drop(TOTAL).sum() == pytest.approx(by[TOTAL], rel=1e-12)
    assert set(rows["level"]) == {"fleet", "type", "vehicle", "week"}
    whole = rows[(rows["level"] == "fleet") & (rows["cause"] == "rolling")].iloc[0]
    assert (whole["kwh"], whole["cost"]) == (300.0, 150.0)
    assert whole["upper"] - whole["kwh"] == pytest.approx(np.sqrt(6.0))
    assert about.loc[about["level"] == "fleet", "measured_kwh"].item() == pytest.approx(312.0)


@pytest.mark.usefixtures("_fewer_permutations")
def test_a_changed_vehicle_is_named_once_with_its_date_and_cost_and_a_bad_log_is_a_line():
    rng = np.random.default_rng(10)
    records = [record(rng, k, step=0.8 if k == 3 else 0.0) for k in range(12)]
    bad = {"name": "bad", "type": "", "status": "refused", "message": "bad.csv: no column", "seconds": 0.0}
    result = fleet_result([bad, *records[::-1]], fdr=0.05, seed=0)
    changed = [e for e in result.summary["unlike"] if e["kind"] == "change"]
    assert [(e["vehicle"], e["coefficient"]) for e in changed] == [("truck03", "road.c_rr")]
    assert abs(changed[0]["since"] - records[3]["course"]["started_s"][25]) <= 7 * DAY_S
    # 15 trips in 42 days, each 2 kWh a unit
    assert changed[0]["kwh_per_day"] == pytest.approx(changed[0]["difference"] * 30.0 / 42.0, rel=0.2)
    assert result.summary["counts"] == {"done": 12, "suspect": 0, "refused": 1, "failed": 0}
    line = result.tables["fleet"].set_index("name").loc["bad"]
    assert (line["status"], line["message"]) == ("refused", "bad.csv: no column")
    assert fleet_result([*records, bad], fdr=0.05, seed=0).summary == result.summary


@pytest.mark.usefixtures("_fewer_permutations")
@pytest.mark.parametrize(("vehicles", "words"), [(3, "no vehicle changed;"), (12, "changed or differs from its type;")])
def test_the_answer_says_what_was_compared_and_what_most_logs_name(vehicles, words):
    rng = np.random.default_rng(11)
    records = [record(rng, k) for k in range(vehicles)]
    for k, r in enumerate(records):
        ids = ["headwind", "tyre_warmup"][: 1 + (k == 0)]
        r["effects"] = [{"id": id_, "q_value": 1e-12} for id_ in ids]
    text = fleet_text(fleet_result(records, fdr=0.05, seed=0))
    assert words in text
    assert f"named most often from the vehicles' own logs: headwind ({vehicles}), tyre warm-up (1)" in text


def test_short_logs_are_not_called_unchanged_and_what_was_not_estimated_is_grey_in_the_map():
    rng = np.random.default_rng(12)
    records = [record(rng, k) for k in range(2)]
    for r in records:
        r["course"]["coefficients"] = None
        r |= {"scan": {}, "effects": []}
    records[0]["effects"] = [{"id": "headwind", "q_value": 1e-12}]
    result = fleet_result(records, fdr=0.05, seed=0)
    assert "; changes were not looked for;" in fleet_text(result)
    shown = effects_map(records, result.summary["effects"]).axes[0]
    assert np.all(np.ma.getmaskarray(shown.images[0].get_array()))
    assert [len(line.get_xdata()) for line in shown.lines if line.get_marker() == "o"] == [1]
    assert effects_map([{**r, "effects": []} for r in records], []) is None


def files(folder, *names):
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text("x\n")
    return folder


def test_vehicles_are_files_folders_and_parts_of_a_data_set(tmp_path):
    logs = files(tmp_path / "logs", "A.csv.gz", "B/1.csv", "B/2.csv", "vehicle_id=C/part-0.parquet", "readme.md")
    sheets = files(tmp_path / "sheets", "A.toml", "B.toml", "D.toml")
    found, notes = sources(logs, sheets)
    by = {s.name: s for s in found}
    assert list(by) == ["A", "B", "C", "D"]
    assert [len(by[k].files) for k in "ABCD"] == [1, 2, 1, 0]
    assert [by[k].whole for k in "ABC"] == [False, False, True]
    assert by["C"].missing.startswith("vehicle C: no sheet")
    assert by["D"].missing == "vehicle D: a sheet but no log"
    assert "readme.md" in notes[0]


def test_a_table_gives_sheets_and_types(tmp_path):
    logs = files(tmp_path / "logs", "A.csv", "B.csv")
    table = tmp_path / "t.csv"
    table.write_text("vehicle,sheet,type\nA,x.toml,bus\nB,y.toml,\n")
    a, b = sources(logs, table)[0]
    assert (a.sheet, a.kind, b.kind) == (str(tmp_path / "x.toml"), "bus", None)


@pytest.mark.parametrize(
    ("text", "says"),
    [("name,sheet\nA,x\n", "column vehicle is missing"), ("vehicle,sheet\nA,\n", "row 2"),
     ("vehicle,sheet\nA,x\nA,y\n", "row 3: vehicle A is there twice"), ("", "column vehicle is missing")],
)  # fmt: skip
def test_a_table_that_is_none_is_refused_in_one_line(tmp_path, text, says):
    logs = files(tmp_path / "logs", "A.csv")
    (tmp_path / "t.csv").write_text(text)
    with pytest.raises(InputError, match=says):
        sources(logs, tmp_path / "t.csv")


def test_a_fleet_without_logs_or_with_a_vehicle_twice_is_refused(tmp_path):
    (tmp_path / "empty").mkdir()
    sheets = files(tmp_path / "sheets", "A.toml")
    with pytest.raises(InputError, match="no vehicle's log"):
        sources(tmp_path / "empty", sheets)
    with pytest.raises(InputError, match="twice"):
        sources([files(tmp_path / "a", "A.csv"), files(tmp_path / "b", "A.csv")], sheets)
    with pytest.raises(InputError, match="no such file"):
        sources(tmp_path / "nowhere", sheets)
