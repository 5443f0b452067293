"""From Python: a frame and a sheet in, an answer with frames, figures and a report out; no folder is needed."""

import pickle
from dataclasses import replace
from typing import Any, ClassVar

import matplotlib.figure
import numpy as np
import pandas as pd
import pytest

import hdev_jax
from hdev_jax.errors import InputError
from hdev_jax.fleet import synthetic_log
from hdev_jax.physics import Aero, Driveline, Effect, Size
from hdev_jax.verbs.demo import demo

ONLY = ["headwind", "auxiliary_power"]
# Columns that are enough: each one more is one more panel of a page and one more that what is left may depend on.
COLUMNS = [
    "vehicle_id", "trip_id", "time_s", "duration_s", "distance_m", "speed_start_mps", "speed_end_mps", "mass_kg",
    "grade_rad", "altitude_m", "ambient_temp_c", "wind_speed_mps", "wind_from_rad", "heading_rad", "gear", "energy_wh",
]  # fmt: skip


class Nothing(Effect):
    """A load while the speed is negative: never."""

    id = "nothing_at_all"
    stage = "battery"
    equation = "P·[v < 0]"
    parameters = (Size("power_w", "W", 0.0, 100.0),)
    power_w: float

    def power(self, row, car, point):
        return self.power_w * (row.speed_mps < 0.0)


@pytest.fixture(scope="module")
def log():
    """A log (synthetic) of which the sheet lacks the wind."""
    effects = {"headwind": {"scale": 0.98}}
    log = synthetic_log(seed=3, trips=9, rows_per_trip=80, effects=effects, noise_level=0.02)
    return replace(log, frame=log.frame[COLUMNS])


@pytest.fixture(scope="module")
def sheet(log, tmp_path_factory):
    return hdev_jax.read_sheet(log.write(tmp_path_factory.mktemp("log"), truth=False)["sheet"])


class Box(Effect):
    """Drag of a box that is on the roof."""

    id: ClassVar = "box"
    stage: ClassVar = "road"
    equation: ClassVar = "s·½ρ·C_dA·v²·box"
    needs: ClassVar = ("roof_box",)
    parameters: ClassVar = (Size("share", "1", 0.0, 0.1, 0.0, 1.0),)
    share: Any

    def force(self, row, car):
        return self.share * car.drag(row) * row.speed_mps**2 * row.channels["roof_box"]


@pytest.fixture(scope="module")
def frame(log):
    """The log's table, with a box on the roof in every other trip."""
    frame = log.frame.assign(roof_box=(log.frame["trip_id"].astype("category").cat.codes % 2).astype(float))
    segments = hdev_jax.Log.from_frame(frame).segments
    car = hdev_jax.Vehicle([Aero(5.6)], mass_kg=1.0, driveline=Driveline(0.91))
    frame["energy_wh"] += np.asarray(car.plus(Box(0.4)).energy(segments) - car.energy(segments))
    return frame


OPTIONS: dict[str, Any] = {"only": ["box", *ONLY], "effects": [Nothing, Box]}


@pytest.fixture(scope="module")
def found(frame, sheet):
    """An effect of one's own is sought beside a sheet that was read before."""
    return hdev_jax.diagnose(frame, sheet, **OPTIONS)


def test_a_frame_and_a_sheet_are_enough(found):
    assert repr(found).startswith("Diagnosis(headwind, box; test RMSE ")
    assert "headwind (scale" in str(found)
    assert found.after["rmse"] < found.before["rmse"]
    assert list(found.effects["effect"]) == ["headwind", "box"]
    for row in found.effects.to_dict("records"):
        assert row["low"] < row["value"] < row["high"]
    assert found.unexplained["significant"] is False
    assert {"id": "nothing_at_all", "why": "not in --only"} in found.summary["excluded"]
    assert "[effects.box]" in found.sheet


def test_the_residual_is_a_frame_as_long_as_the_log(found, frame):
    residual = found.residual
    assert len(residual) == len(frame)
    assert list(residual["trip_id"]) == list(frame["trip_id"])
    np.testing.assert_allclose(residual["measured"], frame["energy_wh"])
    test = residual[residual["test"]]
    assert np.sqrt(np.mean(test["residual_after"] ** 2)) == pytest.approx(found.after["rmse"])


@pytest.mark.parametrize("name", ["before_after", "residual", "channels", "energy", "trips", "coefficients"])
def test_each_figure_is_drawn(name, found):
    assert isinstance(getattr(found, f"plot_{name}")(), matplotlib.figure.Figure)


@pytest.mark.drawn
def test_the_report_is_one_page_or_a_folder(found, tmp_path):
    page = found.report(tmp_path / "deep" / "page.html")
    assert page.read_text() == found.report(tmp_path / "folder").read_text()
    assert {p.name for p in (tmp_path / "folder").iterdir()} == {"report.html", "figures"}
    assert [p.name for p in (tmp_path / "deep").iterdir()] == ["page.html"]


def test_a_folder_gives_the_same_result_again_and_predicts_as_the_result(found, frame, sheet, tmp_path, monkeypatch):
    out = tmp_path / "out"
    first = hdev_jax.diagnose(frame, sheet, **OPTIONS, out=out)
    monkeypatch.setattr("hdev_jax.verbs.diagnose.run_method", lambda *a, **k: pytest.fail("it ran again"))
    again = hdev_jax.diagnose(frame, sheet, **OPTIONS, out=out)
    assert str(again) == str(first) == f"{found}\n{out / 'report.html'}"
    pd.testing.assert_frame_equal(again.residual, found.residual)
    assert again.effects.equals(found.effects)
    assert again.sheet == found.sheet
    here = hdev_jax.predict(frame, found, effects=[Box])
    there = hdev_jax.predict(frame, out / "augmented_vehicle.toml", effects=[Box])
    pd.testing.assert_frame_equal(here.rows, there.rows)
    assert str(here) == str(there)
    inside = (here.rows["lower"] < frame["energy_wh"]) & (frame["energy_wh"] < here.rows["upper"])
    assert 0.85 < inside.mean() < 0.97
    assert "cross-validation over the fit's training trips" in str(here)
    (out / "data.npz").write_bytes(b"nothing")
    broken = hdev_jax.diagnose(frame, sheet, **OPTIONS, out=out)
    with pytest.raises(InputError, match=r"data\.npz: cannot be read"):
        _ = broken.residual


def test_a_result_is_pickled_with_its_rows(found):
    again = pickle.loads(pickle.dumps(found))
    assert str(again) == str(found)
    pd.testing.assert_frame_equal(again.residual, found.residual)


TYPED: Any = type("Typed", (Nothing,), {"__module__": "nowhere", "id": "typed"})


def test_a_class_that_stands_in_no_file_is_kept_in_no_folder(log, sheet, tmp_path):
    with pytest.raises(InputError, match="put the class in a file"):
        hdev_jax.diagnose(log.frame, sheet, only=["auxiliary_power"], effects=[TYPED], out=tmp_path / "out")


def test_another_efficiency_map_is_another_run(log, tmp_path):
    table = tmp_path / "map.csv"
    efficiencies = "gear,motor_speed_radps,motor_torque_nm,efficiency\n" + "".join(
        f"1,{w},{t},{{0}}\n" for w in (0.0, 200.0, 400.0) for t in (-4000.0, 0.0, 4000.0)
    )
    table.write_text(efficiencies.format(0.93))
    sections = {"mass_kg": 29e3, "road": {"c_rr": (0.006, 0.0008), "cda_m2": 5.6}}
    ratios = {"gear_ratios": [1.0], "final_drive": 20.0, "wheel_radius_m": 0.5}
    sheet = hdev_jax.Sheet(**sections, driveline={"map": "map.csv", **ratios}, path=tmp_path / "sheet.toml")
    hdev_jax.calibrate(log.frame, sheet, out=tmp_path / "out")
    table.write_text(efficiencies.format(0.80))
    again = hdev_jax.Sheet(**sections, driveline={"map": "map.csv", **ratios}, path=tmp_path / "sheet.toml")
    with pytest.raises(InputError, match="another configuration"):
        hdev_jax.calibrate(log.frame, again, out=tmp_path / "out")


def test_the_demo_takes_nothing_that_is_another_s(tmp_path):
    (tmp_path / "result").mkdir()
    (tmp_path / "result" / "mine.txt").write_text("precious")
    with pytest.raises(InputError, match="--out"):
        demo(out=tmp_path)
    assert (tmp_path / "result" / "mine.txt").read_text() == "precious"


@pytest.mark.parametrize(
    ("options", "says"), [({"target": "energy"}, "unknown target"), ({"out": "p.xlsx"}, ".parquet")]
)
def test_predict_says_what_it_does_not_know(options, says, log, sheet):
    with pytest.raises(InputError, match=says):
        hdev_jax.predict(log.frame, sheet, **options)


def test_a_calibration_has_its_coefficients_in_a_frame(log, sheet):
    result = hdev_jax.calibrate(log.frame, sheet, method="linear")
    assert repr(result).startswith("CalibrationResult(2 coefficients; test RMSE ")
    assert list(result.coefficients.index) == ["road.c_rr", "road.cda_m2"]
    assert result.coefficients.loc["road.c_rr", "prior_value"] == 0.006
    assert result.draws is None


def test_what_is_no_log_or_effect_is_said(sheet, log):
    with pytest.raises(TypeError):
        hdev_jax.diagnose(3.0, sheet)
    with pytest.raises(InputError, match="seed is missing"):
        hdev_jax.simulate({"routes": 4})
    with pytest.raises(InputError, match=r"effects: .*Effect.> is no subclass"):
        hdev_jax.diagnose(log.frame, sheet, effects=[Effect])
    with pytest.raises(InputError, match="column"):
        hdev_jax.diagnose(log.frame.drop(columns="speed_start_mps"), sheet)


def test_arguments_are_taken_as_people_write_them(log):
    """A sheet's sections as a mapping, one name as text, trips by number, a class that stands in no file."""
    frame = log.frame.assign(trip_id=log.frame["trip_id"].astype("category").cat.codes + 1)
    sheet = {
        "mass_kg": 24e3,
        "road": {"c_rr": (0.006, 0.0008), "cda_m2": (5.6, 0.5)},
        "driveline": {"efficiency": 0.91},
    }
    options: dict[str, Any] = {"only": "headwind, auxiliary_power", "test_trips": [3, 6, 9], "effects": [TYPED]}
    result = hdev_jax.diagnose(frame, sheet, **options)
    assert result.summary["split"]["test_trips"] == ["3", "6", "9"]
    assert {"id": "typed", "why": "not in --only"} in result.summary["excluded"]
    assert [e["id"] for e in result.summary["effects"]] == ["headwind"]


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"vehicle": 3.0}, "vehicle: a sheet's path"),
        ({"vehicle": {"library": 1}}, "unknown"),
        ({"vehicle": {1: 2}}, "unknown"),
        ({"seed": "x"}, "seed: a whole number from 0"),
        ({"seed": 2**40}, "seed: a whole number from 0"),
        ({"only": "headwind,"}, "names with commas"),
        ({"fdr": None}, "between 0 and 1"),
        ({"only": "headwnd"}, "did you mean 'headwind'"),
        ({"test_trips": [99]}, "99"),
        ({"fdr": 2.0}, "between 0 and 1"),
    ],
)
def test_a_wrong_argument_is_one_line(wrong, said, log, sheet):
    with pytest.raises(InputError, match=said) as caught:
        hdev_jax.diagnose(log.frame, **({"vehicle": sheet, "only": ONLY} | wrong))
    assert "\n" not in str(caught.value)


def test_a_list_of_frames_is_refused_in_one_line(log, sheet):
    with pytest.raises(InputError, match="a list of paths is expected, found DataFrame"):
        hdev_jax.diagnose([log.frame, log.frame], sheet)


def test_a_fleet_in_memory_is_read_by_its_frame(tmp_path):
    fleet = hdev_jax.simulate({"seed": 1, "routes": 2, "variants": ["A"], "segments_per_route": 40})
    frame, sheet = fleet["A"].frame, fleet.write_sheets(tmp_path)["A"]
    log = hdev_jax.Log.from_frame(frame)
    assert len(log.trip_names) == 2
    np.testing.assert_allclose(log.segments.distance_m, fleet["A"].segments.distance_m)
    assert len(hdev_jax.predict(frame, sheet).rows) == len(frame)
    with pytest.raises(InputError, match="path of a TOML file"):
        hdev_jax.simulate({"seed": 1}, out=tmp_path / "out")  # pyright: ignore
