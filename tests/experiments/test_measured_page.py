"""The page of measured logs from small made-up results, and the withholding of a channel from a small made-up log."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import tomli_w
from matplotlib.axes import Axes

from experiments.measured import figures, logs, page
from experiments.measured.compared import changes, moved_sizes, new_names, sentences
from experiments.measured.tables import pooled_interval, pooled_rmse, size_rows, size_table
from experiments.measured.withheld import compare_logs, without_columns, write_adapter
from hdev_jax.errors import InputError
from hdev_jax.logs import read_log


def block(rmse: float, trips=("A", "B")) -> dict:
    metrics = {"rmse": rmse, "mse": rmse**2, "bias": 0.1, "pe_percent": 1.5, "fit_percent": 80.0, "n": 1000}
    return {"train": metrics, "test": metrics, "test_by_trip": dict.fromkeys(trips, metrics)}


def effect(id_: str, path: str, value: float, sd: float, unit: str, twins=()) -> dict:
    size = {"value": value, "sd": sd, "interval_90": [value - 3 * sd, value + 2 * sd], "unit": unit}
    return {
        "id": id_, "stage": "battery", "order": 1, "verdict": "one_of_class" if twins else "found",
        "parameters": {path: size, "shape": {"value": 1.0, "sd": 0.0, "unit": "1"}},
        "q_value": 1e-6, "stability": 0.97, "test_rmse_before": 12.0, "test_rmse_after": 9.0,
        "indistinguishable_from": list(twins),
    }  # fmt: skip


def result(effects: list[dict], rmse: float = 9.0, turned_down=(), left: str | None = None) -> dict:
    kinds = {True: "unavailable", False: "not_confirmed"}
    candidates = [
        {"id": i, "score": s, "q_value": 0.2, "kind": kinds[w.startswith("not tried")], "why_not": w}
        for i, s, w in turned_down
    ]
    return {
        "target": "battery_power_kw", "before": block(13.0), "after": block(rmse), "effects": effects,
        "split": {"train_trips": ["C", "D"], "test_trips": ["A", "B"], "unused_trips": []},
        "candidates": candidates, "parameters_fitted": 7, "clusters": {"kind": "trip", "count": 16},
        "unexplained": {
            "significant": left is not None, "share_of_test_variance": 0.04, "noise_floor_rmse": 8.0,
            "depends_on": ["time_s"] if left else [], "signature": f"What is left: {left or 'noise'}.",
            "expression": None, "memory_s": None,
        },
        "verdict": "effects_found" if left is None else "effects_found_and_unexplained_structure",
        "subsets": {"standing still": {"before": block(5.0)["test"], "after": block(4.0)["test"]}},
        "cost": {"seconds": 60.0, "peak_gib": 1.0}, "together": [],
        "ran": {"vehicle_sha256": "ab", "seed": 0, "fdr": 0.05},
    }  # fmt: skip


COPPER = effect("copper_loss", "w_per_nm2", 3e-5, 3e-6, "W/Nm²")
OFFSET = effect("power_gain", "offset_w", 6100.0, 600.0, "W", ["auxiliary_power"])
CONSTANT = effect("auxiliary_power", "power_w", 6000.0, 700.0, "W", ["power_gain"])
LARGER = effect("auxiliary_power", "power_w", 9000.0, 700.0, "W", ["power_gain"])
HEATING = effect("hvac_power", "below_w_per_k", 550.0, 80.0, "W/K")
STEP = effect("step_change", "jump", 2.0, 0.1, "W")
NO_CHANNEL = [("hvac_power", None, "not tried: needs a channel that the log lacks: ambient_temp_c")]


@pytest.fixture
def results() -> dict:
    folds = {
        "ztbus_1": result([COPPER, OFFSET, HEATING], left="a 5-minute cycle"),
        "ztbus_2": result([COPPER, CONSTANT, HEATING], turned_down=[("iron_loss", 12.0, "too few trips")]),
    }
    niro = {f"niro_{k}": result([COPPER], 0.4, [("iron_loss", 3.0, "too few trips")]) for k in "12"}
    held = {
        "ztbus_1_no_temperature": result([COPPER, LARGER], 11.0, NO_CHANNEL, left="random intercepts by trip"),
        "ztbus_1_no_steering": result([COPPER, OFFSET, HEATING], left="a 5-minute cycle"),
    }
    return {**niro, "niro_road": result([COPPER], 150.0), **folds, **held}


@pytest.mark.drawn
def test_the_page_tells_all_runs_and_draws_them(results, tmp_path):
    rest = {"temperature": {"rows": 2000, "trips": 2, "gone": ["ambient_temp_c"], "same": ["time_s"], "ledger": 3}}
    text, drawn = page.page(results, warm={"A": 3.0, "B": 20.0}, rest=rest)
    for heading in ("Kia Niro: battery power", "Kia Niro: traction force", "Stability over folds", "Steering withheld"):
        assert heading in text
    assert "| **found**, 0.97 | **found**, 0.97 | 2 of 2 |" in text
    assert "| no: too few trips |" not in text  # only what some run found has a row
    assert "The same: sheet, split, seed" in text
    assert "`ambient_temp_c`. The other 1 columns are equal in all 2,000 rows" in text
    assert set(drawn) == {f"{n}.png" for n in (
        "niro_errors", "niro_sizes", "ztbus_errors", "ztbus_sizes", "ztbus_withheld"
    )}  # fmt: skip
    assert all(name in text for name in drawn)
    assert all(content.startswith(b"\x89PNG") and len(content) < 150_000 for content in drawn.values())
    old = tmp_path / page.FOLDER / "gone.png"
    old.parent.mkdir(parents=True)
    old.write_bytes(b"")
    page.write(tmp_path, text, drawn)
    assert not old.exists()
    assert (tmp_path / "real_logs.md").read_text() == text


def test_the_interval_of_a_pooled_error_is_of_trips():
    """Rows of one trip say nothing of the next: with few trips that differ it is wide, however many rows they have."""
    errors = {"A": 1.0, "B": 2.0, "C": 1.5, "D": 1.2}
    blocks = {k: [{"mse": e**2, "n": 10**6}] * 3 for k, e in errors.items()}
    low, high = pooled_interval(blocks)
    mse = np.array([e**2 for e in errors.values()])
    assert np.sqrt(low * high) == pytest.approx(pooled_rmse([m for b in blocks.values() for m in b]))
    # of a mean of squares by hand, and by the slope of its logarithm's half
    expected = 2.353 * np.std(mse, ddof=1) / 2 / (2 * mse.mean())
    assert np.log(high / low) / 2 == pytest.approx(expected, rel=0.1)
    assert pooled_interval({"A": [{"mse": 4.0, "n": 9}], "B": [{"mse": 0.01, "n": 9}]})[0] > 0
    with pytest.raises(ValueError, match="at least two"):
        pooled_interval({"A": blocks["A"]})


def test_the_page_of_one_part_is_a_page(results):
    text, drawn = page.page({"niro_1": results["niro_1"]}, warm={}, rest={})
    assert "ZTBus" not in text
    assert set(drawn) == {"niro_errors.png", "niro_sizes.png"}


def test_sizes_of_one_class_share_a_row_and_a_unit(results):
    rows = {row.paths: row for row in size_rows({"1": results["ztbus_1"], "2": results["ztbus_2"]})}
    shared = rows["power_gain.offset_w", "auxiliary_power.power_w"]
    assert shared.unit == "W"
    assert shared.cells == {
        "1": ("power_gain.offset_w", 6100.0, 600.0),
        "2": ("auxiliary_power.power_w", 6000.0, 700.0),
    }
    assert shared.furthest() == pytest.approx(100.0 / np.hypot(600.0, 700.0))
    assert all("shape" not in path for paths in rows for path in paths)  # chosen among a few: no size


def test_a_size_at_the_end_of_its_range_is_marked_and_agrees_with_nothing():
    ends = {"1": 24.3, "2": 26.0}  # °C; hvac_power's heat_c ends at 26
    runs = {k: result([effect("hvac_power", "heat_c", v, 1.0, "°C")]) for k, v in ends.items()}
    assert size_rows(runs)[0].at_bound == {"2"}
    assert "| 24.3 ± 1.0 | 26.0 ± 1.0, at its bound | 1.2 sd |" in size_table(runs, "fold")[-1]
    assert "Of 0 sizes found in more than one training set, none at a bound, 0 agree" in page._agreement(runs, "")[0]


def test_sizes_agree_as_far_as_equal_ones_of_so_many_sets_differ():
    def offsets(*values: float):
        sized = enumerate(values)
        return {str(k): result([effect("torque_offset", "offset_nm", v, 1.0, "Nm")]) for k, v in sized}

    rng = np.random.default_rng(0)
    two, four = (np.ptp(rng.normal(size=(20_000, k)), axis=1) / np.sqrt(2) for k in (2, 4))
    for apart, sets in ((two, 2), (four, 4)):
        bound = float(np.quantile(apart, 0.95)) * np.sqrt(2)
        for factor, close in ((0.97, True), (1.03, False)):
            (row,) = size_rows(offsets(5.0, 5.0 + factor * bound, *[5.0 + 0.5 * bound] * (sets - 2)))
            assert row.agrees() == close
    assert (
        "Of 1 sizes found in more than one training set, 1 agrees within chance."
        in page._agreement(offsets(5.0, 5.5), "")[0]
    )
    assert (
        "0 agree within chance. These do not: `torque_offset.offset_nm` (2.1 sd)."
        in page._agreement(offsets(5.0, 8.0), "")[0]
    )


def test_an_effect_whose_sign_turns_is_told_first(results):
    offsets = {"niro_1": -5.5, "niro_2": 0.7}  # Nm
    turned = {k: result([effect("torque_offset", "offset_nm", v, 0.1, "Nm")]) for k, v in offsets.items()}
    text = " ".join(page.page(turned, warm={}, rest={})[0].split())
    assert "The sign of `torque_offset.offset_nm` differs." in text.partition("## Kia Niro")[0]
    text = " ".join(page.page(results, warm={}, rest={})[0].split())
    assert "agree on the sign" not in text


def test_bars_of_sizes_are_the_intervals_of_the_diagnosis(results, monkeypatch):
    """Few clusters: a size's distribution has heavier tails than its standard deviation says."""
    drawn = []
    monkeypatch.setattr(Axes, "errorbar", lambda self, x, y, xerr, **_: drawn.append((x, xerr)))
    figures.sizes({"1": result([HEATING])}, "sizes", "fold")
    ((value, ((below,), (above,))),) = drawn
    assert value == 550.0
    assert (below, above) == pytest.approx((240.0, 160.0))


def test_sizes_of_effects_that_no_run_calls_one_class_stay_apart():
    runs = {"1": result([OFFSET]), "2": result([STEP])}  # both in W
    assert len(size_rows(runs)) == 2


def test_a_withheld_cause_and_where_it_went(results):
    without, full, others = results["ztbus_1_no_temperature"], results["ztbus_1"], {"2": results["ztbus_2"]}
    assert changes(without, full) == (["hvac_power"], [], [("auxiliary_power", "power_gain")])
    assert [m[0] for m in moved_sizes(without, full)] == ["power_gain.offset_w"]
    text = " ".join(sentences("outside temperature", without, full, others))
    assert "cannot try cabin heating and cooling" in text
    assert "No false name takes the place of cabin heating and cooling" in text
    assert "lowers the test RMSE from 11.00 to 9.00" in text
    assert "random intercepts by trip" in text


def test_a_false_name_is_called_one(results):
    full, others = results["ztbus_1"], {"2": results["ztbus_2"]}
    without = result([COPPER, OFFSET, STEP], 10.0, NO_CHANNEL)
    assert new_names(without, full, others) == ["step_change"]
    text = " ".join(sentences("outside temperature", without, full, others))
    assert "a **new name**" in text
    assert "it names what the full log does not confirm" in text
    assert new_names(without, full, {"2": result([STEP])}) == []  # another training set finds it with every channel


def test_a_channel_that_nothing_reads_is_a_control(results):
    text = " ".join(sentences("steering", results["ztbus_1_no_steering"], results["ztbus_1"], {}))
    assert "The run is a control." in text
    assert "finds the same effects" in text
    assert "leaves the test RMSE as it is" in text
    assert "place of" not in text


def test_what_two_runs_do_not_have_in_common_is_said(results):
    results["ztbus_1_no_steering"]["ran"]["seed"] = 7
    text = " ".join(page.page(results, warm={}, rest={})[0].split())
    assert text.count("**Not the same in both: seed.**") == 1
    del results["ztbus_1_no_temperature"]["ran"]["fdr"]  # what a run does not say, it does not share
    assert "The same: sheet, split, seed.\n" in page.page(results, warm={}, rest={})[0]


def test_road_load_without_the_force_stands_beside_that_with_it(results):
    results["niro_road"]["coefficients"] = {"road.c_rr": (0.010, 0.0003), "road.cda_m2": (0.70, 0.01)}
    results["niro_power"] = {
        **result([COPPER], 3.0),
        "coefficients": {
            "road.c_rr": (0.0104, 0.0004),
            "road.cda_m2": (0.75, 0.01),
            "driveline.efficiency": (0.9, 0.01),
        },
    }
    text = " ".join(page.page(results, warm={}, rest={})[0].split())
    assert "## Road load without the force" in text
    assert "| Kia Niro, trip 1 | `road.c_rr` | 0.01 ± 0.0003 | 0.0104 ± 0.0004 | +0.8 | yes |" in text
    assert "| Kia Niro, trip 1 | `road.cda_m2` | 0.7 ± 0.01 | 0.75 ± 0.01 | +3.5 | no |" in text
    assert "2 of 2" in text  # of the Niro's training trips: the run without torque is none of them


def test_runs_that_find_nothing_in_common(results):
    results["niro_2"]["effects"] = []
    text = " ".join(page.page(results, warm={}, rest={})[0].split())
    assert "No effect is found by all." in text


ADAPTER = {
    "format": "csv",
    "others": "drop",
    "columns": {
        "time_s": {"source": "t"},
        "speed_mps": {"source": "v"},
        "battery_power_w": {"source": "p"},
        "ambient_temp_c": {"source": "temp", "unit": "K"},
        "passengers": {"source": "people", "fill": "forward", "initial": 0},
        "mass_kg": {"source": "passengers", "affine": [19500.0, 70.0]},
    },
}


@pytest.fixture
def log(tmp_path) -> tuple[Path, Path]:
    n = 60
    speed = 5.0 + np.sin(np.arange(n) / 5.0)
    people = pd.Series(np.where(np.arange(n) % 20 == 5, 10.0, np.nan))
    frame = pd.DataFrame({"t": np.arange(n), "v": speed, "p": 900.0 * speed, "temp": 283.0 + speed, "people": people})
    frame["by_the_way"] = 1.0
    frame.to_csv(tmp_path / "one.csv", index=False)
    (tmp_path / "base.toml").write_text(tomli_w.dumps(ADAPTER))
    return tmp_path / "one.csv", tmp_path / "base.toml"


@pytest.mark.parametrize(
    ("names", "gone"),
    [(["ambient_temp_c"], {"ambient_temp_c"}), (["passengers"], {"passengers", "mass_kg"})],
    ids=["temperature", "passengers and what is made from them"],
)
def test_a_withheld_channel_is_not_in_the_log(log, tmp_path, names, gone):
    file, base = log
    adapter = write_adapter(base, names, tmp_path / "less" / "adapter.toml")
    full, less = read_log(file, base), read_log(file, adapter)
    assert set(full.segments.channels) - set(less.segments.channels) == gone
    assert not gone & {c.name for c in less.columns}
    told = compare_logs([file], base, adapter)
    assert set(told["gone"]) == gone
    assert told["rows"] == len(full)
    assert {"battery_power_w", "speed_start_mps", "time_s"} <= set(told["same"])


def test_withholding_that_changes_more_is_refused(log, tmp_path):
    file, base = log
    table = without_columns(ADAPTER, ["ambient_temp_c"])
    table["columns"]["mass_kg"] = {"source": "passengers", "affine": [19000.0, 70.0]}
    other = tmp_path / "other.toml"
    other.write_text(tomli_w.dumps(table))
    with pytest.raises(InputError, match="more than the columns withheld"):
        compare_logs([file], base, other)
    with pytest.raises(InputError, match="makes no column weather"):
        without_columns(ADAPTER, ["weather"])
    with pytest.raises(InputError, match='others = "drop"'):
        without_columns({**ADAPTER, "others": "keep"}, ["ambient_temp_c"])
    written = write_adapter(base, ["ambient_temp_c"], tmp_path / "a.toml")
    before = written.stat().st_mtime_ns
    assert write_adapter(base, ["ambient_temp_c"], written).stat().st_mtime_ns == before  # a run can resume


def test_kept_runs_make_the_page_without_data(results, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(logs, "DATA", tmp_path / "none")
    work, docs = tmp_path / "work", tmp_path / "docs"
    jobs = logs.jobs(work)["niro"]
    for name in ("niro_1", "niro_2"):
        (work / name).mkdir(parents=True)
        (work / name / "diagnosis.json").write_text(json.dumps(results[name]))
        config = {
            "vehicle": "configs/vehicles/kia_niro.toml", "adapter": "configs/adapters/kia_niro.toml",
            "asked_train": [name[-1]],
        }  # fmt: skip
        (work / name / "config.toml").write_text(tomli_w.dumps(config))
        covariance = {"names": ["iron", "offset"], "matrix": [[1.0, -0.99], [-0.99, 1.0]]}
        (work / f"{name}.begun").write_text(next(j for j in jobs if j.name == name).made_of)
        (work / name / "augmented_vehicle.toml").write_text(
            'name = "car"\n[machine]\nmotoring_efficiency = { value = 0.92, sd = 0.01 }\n'
        )
        (work / name / "predictive.json").write_text(json.dumps({"covariance": covariance}))
    assert logs.main(["--work", str(work), "--docs", str(docs), "--kept", "--write"]) == 0
    text = " ".join((docs / "real_logs.md").read_text().split())
    assert logs.kept(jobs[0], work)["coefficients"] == {"machine.motoring_efficiency": (0.92, 0.01)}  # pyright: ignore
    assert "trained on trip" in text
    assert "- `iron` and `offset` (1: -0.99, 2: -0.99)." in text
    assert "`iron` and `offset` are strongly correlated in every run: only their combination is determined." in text
    assert "pooled over 2 training trips." in text
    assert "for it was not run: niro_3, niro_4" in capsys.readouterr().err
    for end in ("", ".begun"):
        (work / f"niro_2{end}").rename(work / f"niro_3{end}")
    with pytest.raises(SystemExit, match="holds another run"):
        logs.main(["--work", str(work), "--kept"])
    monkeypatch.setattr(logs, "sources_of", lambda *_: "mended")  # runs of other code are none
    assert all(logs.kept(job, work) is None for job in jobs)
