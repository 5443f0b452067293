"""The verbs end to end, through the command line, on a small synthetic log in a temporary folder."""

import contextlib
import hashlib
import importlib.util
import io
import json
import math
import tomllib
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from user_effect import USER_EFFECT

from hdev_jax import cli
from hdev_jax.diagnosis.candidates.own import known_effects
from hdev_jax.fleet import SyntheticLog, synthetic_log
from hdev_jax.physics import LIBRARY
from hdev_jax.rundir import Run
from hdev_jax.verbs.opening import opened
from hdev_jax.verbs.predict import strongly_correlated

CHECKER = Path(__file__).parents[3] / "shared" / "check_diagnosis.py"
ONLY = ["--only", "headwind,auxiliary_power"]  # two candidates: quick
FILES = {
    "diagnosis.json", "report.html", "augmented_vehicle.toml", "answer.txt", "config.toml", "environment.json",
    "figures", "predictive.json", "data.npz",
}  # fmt: skip

# Columns that are enough: each one more is one more panel of a page and one more that what is left may depend on.
COLUMNS = [
    "vehicle_id", "trip_id", "time_s", "duration_s", "distance_m", "speed_start_mps", "speed_end_mps", "mass_kg",
    "grade_rad", "altitude_m", "ambient_temp_c", "wind_speed_mps", "wind_from_rad", "heading_rad", "gear", "energy_wh",
]  # fmt: skip


def hdev(*argv: object) -> tuple[int, str]:
    """Exit status and standard output of one command; our own fault is a failure with what it said."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        status = cli.main([str(a) for a in argv])
    assert status != 1, err.getvalue()
    return status, out.getvalue()


def refused(capsys: pytest.CaptureFixture[str], *argv: object) -> str:
    """The one line, and no other, of a command that the input is to blame for."""
    capsys.readouterr()
    assert cli.main([str(a) for a in argv]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    lines = [line for line in captured.err.splitlines() if line.startswith("hdev: ")]
    assert captured.err.splitlines() == lines
    assert "Traceback" not in captured.err
    return lines[0]


def read(folder: Path) -> dict:
    """A folder's diagnosis.json, which has to keep the contract wherever it was made."""
    found = json.loads((folder / "diagnosis.json").read_text())
    if CHECKER.is_file():  # not part of the repository: what it checks is skipped where it is not beside it
        spec = importlib.util.spec_from_file_location("check_diagnosis", CHECKER)
        assert spec is not None
        assert spec.loader is not None
        checker = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(checker)
        assert checker.check(found) == []
    return found


@pytest.fixture(autouse=True)
def plain_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    """One line for an error, whatever the shell that runs the tests asks for."""
    monkeypatch.delenv("HDEV_DEBUG", raising=False)


@pytest.fixture(scope="module")
def synthetic() -> SyntheticLog:
    effects = {"headwind": {"scale": 0.98}}
    log = synthetic_log(seed=3, trips=9, rows_per_trip=80, effects=effects, noise_level=0.02)
    return replace(log, frame=log.frame[COLUMNS])


@pytest.fixture(scope="module")
def files(synthetic: SyntheticLog, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return synthetic.write(tmp_path_factory.mktemp("log"), truth=False)


@pytest.fixture(scope="module")
def given(files: dict[str, Path]) -> list[object]:
    return [files["log"], "--vehicle", files["sheet"]]


@pytest.fixture(scope="module")
def done() -> dict[str, tuple[Path, str]]:
    """Folders of what has run, and what was said. They are made by fixtures of a test, so that no plot is drawn."""
    return {}


@pytest.fixture
def first(given: list[object], done, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """One diagnosis that ran through."""
    if "first" not in done:
        out = tmp_path_factory.mktemp("first") / "result"
        status, text = hdev("diagnose", *given, *ONLY, "--out", out)
        assert status == 0
        done["first"] = out, text
    return done["first"]


@pytest.fixture
def by_map(given: list[object], done, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """One calibration, by the method that is taken where none is named."""
    if "map" not in done:
        out = tmp_path_factory.mktemp("map") / "result"
        status, text = hdev("calibrate", *given, "--out", out)
        assert status == 0
        done["map"] = out, text
    return done["map"]


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "result"


# --- check -----------------------------------------------------------------------------------------------------------


def test_check_shows_trips_and_energy_per_km(given, synthetic, capsys):
    assert cli.main(["check", *map(str, given)]) == 0
    text = capsys.readouterr().out
    assert f"{len(synthetic.frame)} rows, 9 trips, 1 vehicles" in text
    assert "kWh/km" in text
    for name, rows in synthetic.frame.groupby("trip_id"):
        line = next(line.split() for line in text.splitlines() if line.split()[:1] == [name])
        assert int(line[1]) == len(rows)
        km = rows.distance_m.sum() / 1e3
        assert float(line[3]) == pytest.approx(km, abs=0.01)
        # three decimals are printed
        assert float(line[-1]) == pytest.approx(rows.energy_wh.sum() / 1e3 / km, abs=1e-3)


def test_check_says_what_a_sheet_leaves_open(given, capsys):
    assert cli.main(["check", *map(str, given)]) == 0
    assert "entered at the road; estimated: road.c_rr, road.cda_m2" in capsys.readouterr().out


# --- diagnose --------------------------------------------------------------------------------------------------------


def test_the_folder_is_complete(first):
    out, text = first
    assert {p.name for p in out.iterdir()} == FILES
    assert {p.name for p in out.parent.iterdir()} == {"result"}  # nothing half-done beside it
    assert list((out / "figures").glob("*.png"))
    assert str(out / "report.html") in text
    assert tomllib.loads((out / "config.toml").read_text())["only"] == ["headwind", "auxiliary_power"]
    environment = json.loads((out / "environment.json").read_text())
    assert set(environment["files"]) == {p.relative_to(out).as_posix() for p in out.rglob("*") if p.is_file()}


def test_what_was_planted_is_found(first, synthetic):
    found = read(first[0])
    assert [e["id"] for e in found["effects"]] == ["headwind"]
    assert found["after"]["test"]["rmse"] < found["before"]["test"]["rmse"]
    scale = found["effects"][0]["parameters"]["scale"]
    # three of its standard errors, and the 3 % that the drag area's own uncertainty leaves open in w·C_dA
    assert abs(scale["value"] - 0.98) < 3 * scale["sd"] + 0.03
    assert found["split"]["test_trips"] == ["T03", "T06", "T09"]
    # the noise is what no model can explain
    assert found["after"]["test"]["rmse"] == pytest.approx(synthetic.noise_rms, rel=0.3)


def test_the_report_opens_offline(first):
    page = (first[0] / "report.html").read_text()
    assert "headwind" in page
    assert 'src="http' not in page
    assert 'href="http' not in page.replace('href="https://doi.org', "")


def test_predict_reproduces_the_error_after(first, files, out):
    folder, _ = first
    predicted = out.with_suffix(".csv")
    status, text = hdev("predict", files["log"], "--vehicle", folder / "augmented_vehicle.toml", "--out", predicted)
    assert status == 0
    assert str(predicted) in text
    log, rows, found = pd.read_csv(files["log"]), pd.read_csv(predicted), read(folder)
    assert list(rows.columns) == ["trip_id", "time_s", "predicted", "lower", "upper", "level"]
    assert (rows.trip_id == log.trip_id).all()
    assert ((rows.lower < rows.predicted) & (rows.predicted < rows.upper)).all()
    test = rows.trip_id.isin(found["split"]["test_trips"])
    rmse = np.sqrt(np.mean((rows.predicted - log.energy_wh)[test] ** 2))
    # the CSV has 8 digits of each row and the sheet all digits of each coefficient
    assert rmse == pytest.approx(found["after"]["test"]["rmse"], rel=1e-6)


def test_the_interval_holds_its_share(first, files, out):
    """Rows of one log are correlated, so the share of a 90 % interval is only about that."""
    rows_file = out.with_suffix(".parquet")
    sheet = first[0] / "augmented_vehicle.toml"
    assert hdev("predict", files["log"], "--vehicle", sheet, "--level", "0.9", "--out", rows_file)[0] == 0
    log, rows = pd.read_csv(files["log"]), pd.read_parquet(rows_file)
    assert 0.8 < np.mean((rows.lower < log.energy_wh) & (log.energy_wh < rows.upper)) < 0.97
    assert set(rows.level) == {0.9}


def test_a_log_without_a_target_is_predicted_too(first, files, out, tmp_path):
    log = pd.read_csv(files["log"])
    log.drop(columns="energy_wh").to_csv(tmp_path / "bare.csv", index=False)
    sheet = first[0] / "augmented_vehicle.toml"
    for name in (files["log"], tmp_path / "bare.csv"):
        assert hdev("predict", name, "--vehicle", sheet, "--out", out / f"{Path(name).stem}.csv")[0] == 0
    with_target, bare = pd.read_csv(out / f"{files['log'].stem}.csv"), pd.read_csv(out / "bare.csv")
    np.testing.assert_allclose(bare.predicted, with_target.predicted, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (lambda d: d.pop("spread"), "KeyError: 'spread'"),
        (lambda d: d["spread"].update(total_freedom=0.0), "not as hdev writes it"),
        (lambda d: d["covariance"].update(matrix=[[1.0]]), "not as hdev writes it"),
        (None, "does not read as JSON"),
    ],
)
def test_what_lies_beside_a_sheet_and_is_at_fault(edit, words, first, files, tmp_path, capsys):
    """Edited or cut off: one line with the file, nothing written."""
    for name in ("augmented_vehicle.toml", "predictive.json"):
        (tmp_path / name).write_bytes((first[0] / name).read_bytes())
    beside = tmp_path / "predictive.json"
    known = json.loads(beside.read_text())
    if edit is not None:
        edit(known)
    beside.write_text(json.dumps(known) if edit is not None else beside.read_text()[:200])
    sheet, out = tmp_path / "augmented_vehicle.toml", tmp_path / "p.csv"
    said = refused(capsys, "predict", files["log"], "--vehicle", sheet, "--out", out)
    assert words in said
    assert str(beside) in said
    assert not out.exists()


def test_coefficients_that_cancel_are_said_to():
    """Two with a correlation of −0.99 and one beside them."""
    sd = np.array([2.0, 0.5, 30.0])
    correlation = np.array([[1.0, -0.99, 0.1], [-0.99, 1.0, 0.3], [0.1, 0.3, 1.0]])
    (said,) = strongly_correlated(["iron", "offset", "drag"], correlation * np.outer(sd, sd))
    assert "iron and offset" in said
    assert "(-0.99)" in said
    assert strongly_correlated(["iron"], np.zeros((1, 1))) == []


def test_intervals_say_where_they_are_from(first, files, tmp_path):
    """Of the fit beside the sheet; of a sheet that was changed since, of the log's own errors, and that is said."""
    log = pd.read_csv(files["log"])
    log.drop(columns="energy_wh").to_csv(tmp_path / "bare.csv", index=False)
    for name in ("augmented_vehicle.toml", "predictive.json"):
        (tmp_path / name).write_bytes((first[0] / name).read_bytes())
    sheet, out = tmp_path / "augmented_vehicle.toml", tmp_path / "p.csv"

    def said(file: Path) -> str:
        status, text = hdev("predict", file, "--vehicle", sheet, "--out", out)
        assert status == 0
        return text

    assert "cross-validation over the fit's training trips" in said(tmp_path / "bare.csv")
    sheet.write_text(sheet.read_text() + "\n# a note\n")
    assert "was changed after" in said(tmp_path / "bare.csv")
    assert "the noise of the rows is not known" in said(tmp_path / "bare.csv")
    assert "this log's own errors" in said(files["log"])
    known = json.loads((tmp_path / "predictive.json").read_text())
    known["spread"]["row_s"] *= 3
    known["sheet_sha256"] = hashlib.sha256(sheet.read_bytes()).hexdigest()
    (tmp_path / "predictive.json").write_text(json.dumps(known))
    assert "rows of this log last" in said(files["log"])


def test_the_same_command_is_done_at_once(first, given, monkeypatch):
    """The text is the same, and nothing is computed for it."""
    folder, text = first
    before = {p: p.stat().st_mtime_ns for p in folder.rglob("*")}
    monkeypatch.setattr("hdev_jax.verbs.diagnose.run_method", lambda *a, **k: pytest.fail("the loop ran again"))
    assert hdev("diagnose", *given, *ONLY, "--out", folder) == (0, text)
    assert {p: p.stat().st_mtime_ns for p in folder.rglob("*")} == before


def test_a_killed_run_is_resumed(first, given, out, monkeypatch, capsys):
    """Interrupted after a stage, nothing is there but the work; the same command ends as if it had not been."""
    keep, computed, asked, last = Run.checkpoint, [], [], None

    def until(run, name, compute):
        def counted():
            computed.append(name)
            return compute()

        asked.append(name)
        value = keep(run, name, counted)
        if name == last:
            raise KeyboardInterrupt
        return value

    monkeypatch.setattr(Run, "checkpoint", until)
    command = ["diagnose", *map(str, given), *ONLY, "--out", str(out)]
    for stage in ("step-0", "step-2"):
        last = stage
        assert cli.main(command) == 130
        assert "the same command resumes" in capsys.readouterr().err
        assert not out.exists()
        assert out.with_name("result.partial").is_dir()
    last = None
    assert cli.main(command) == 0
    assert (asked.count("step-0"), asked.count("step-2")) == (3, 2)
    assert len(computed) == len(set(computed))  # what was done is not done again
    assert read(out) == read(first[0])
    for name in ("diagnosis.json", "augmented_vehicle.toml"):  # the same command twice gives the same answer
        assert (out / name).read_bytes() == (first[0] / name).read_bytes()
    assert not out.with_name("result.partial").exists()


def test_with_the_effect_declared_nothing_is_missing(first, files, out):
    """Exit status 0 with nothing found; the sheet that a diagnosis writes is a sheet like any other."""
    sheet = first[0] / "augmented_vehicle.toml"
    status, text = hdev("diagnose", files["log"], "--vehicle", sheet, *ONLY, "--out", out)
    found = read(out)
    assert status == 0
    assert found["effects"] == []
    assert found["verdict"] in ("nothing_missing", "unexplained_structure")
    assert found["after"] == found["before"]
    assert text


def test_an_effect_of_ones_own(files, given, tmp_path, out):
    """It is searched beside the library's and found where it acts, with its size and unit: one number, although it goes
    by gear, where the log tells no gear. One that fails on the log is only worked out where it is asked for."""
    by_gear = USER_EFFECT.replace("0.0, 100.0)", '0.0, 100.0, by="gear", whole=True)')
    fails = USER_EFFECT.replace("row.time_s", "(1, 2)").replace("slow_drift", "broken").replace("SlowDrift", "Broken")
    effect = tmp_path / "mine.py"
    effect.write_text(by_gear + fails)
    log = pd.read_csv(files["log"]).drop(columns="gear")
    log["energy_wh"] += 60.0 * log.time_s * log.duration_s / 3600
    log.to_csv(tmp_path / "drift.csv", index=False)
    argv = ["--effects", effect, "--only", "headwind,auxiliary_power,slow_drift", "--out", out]
    assert hdev("diagnose", tmp_path / "drift.csv", *given[1:], *argv)[0] == 0
    found = {e["id"]: e for e in read(out)["effects"]}
    assert "slow_drift" in found
    assert set(found["slow_drift"]["parameters"]) == {"w_per_s"}
    drift = found["slow_drift"]["parameters"]["w_per_s"]
    assert abs(drift["value"] - 60.0) < 4 * drift["sd"]
    assert drift["unit"] == "W/s"
    excluded = {e["id"]: e["why"] for e in read(out)["excluded"]}
    assert set(excluded) == set(LIBRARY) - {"headwind", "auxiliary_power"} | {"broken"}
    assert set(excluded.values()) == {"not in --only"}
    assert "Effects that this run left out" in (out / "report.html").read_text()


# --- calibrate -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("noise", ["normal", "student_t"])
def test_calibrate(noise, first, by_map, given, out, tmp_path):
    """calibration.json holds the blocks of a diagnosis's declared model."""
    if noise == "normal":
        out, text = by_map
    else:
        status, text = hdev("calibrate", *given, "--noise", noise, "--out", out)
        assert status == 0
    found = json.loads((out / "calibration.json").read_text())
    assert found["converged"]
    assert {p.name for p in out.iterdir()} >= {"calibration.json", "report.html", "config.toml", "environment.json"}
    assert list((out / "figures").glob("*.png"))
    block = found["baseline"]["parameters"]
    assert set(block) == {"road.c_rr", "road.cda_m2"}
    for p in block.values():
        assert 0 < p["sd"] <= p["prior_sd"] * (1 + 1e-9)  # a log never makes a tabular value less certain
        assert p["prior_z"] == pytest.approx((p["value"] - p["prior_value"]) / p["prior_sd"])
    assert "road.cda_m2" in text
    if noise == "normal":
        same = read(first[0])
        assert found["before"] == same["before"]
        for name, p in block.items():
            assert p["value"] == pytest.approx(same["baseline"]["parameters"][name]["value"], rel=1e-9)
        predicted = tmp_path / "p.csv"
        sheet = out / "calibrated_vehicle.toml"
        assert hdev("predict", given[0], "--vehicle", sheet, "--out", predicted)[0] == 0
        rows, log = pd.read_csv(predicted), pd.read_csv(str(given[0]))
        test = rows.trip_id.isin(found["split"]["test_trips"])
        rmse = math.sqrt(np.mean((rows.predicted - log.energy_wh)[test] ** 2))
        assert rmse == pytest.approx(found["before"]["test"]["rmse"], rel=1e-6)


@pytest.mark.parametrize("method", ["linear", pytest.param("nuts", marks=pytest.mark.drawn)])
def test_the_other_methods_agree_with_the_map(method, by_map, given, tmp_path):
    """Values, the files, what predict makes of the posterior beside the sheet; draws that ArviZ reads."""
    status, text = hdev("calibrate", *given, "--method", method, "--out", tmp_path / method)
    assert status == 0
    folders = {"map": by_map[0], method: tmp_path / method}
    found = {m: json.loads((folder / "calibration.json").read_text()) for m, folder in folders.items()}
    assert found["map"]["method"] == "map"
    assert "sufficient statistics" in text
    for name, p in found["map"]["baseline"]["parameters"].items():
        other = found[method]["baseline"]["parameters"][name]
        assert other["value"] == pytest.approx(p["value"], abs=0.2 * p["sd"])
        assert other["sd"] == pytest.approx(p["sd"], rel=0.3)
    assert (tmp_path / method / "figures" / "posterior.png").stat().st_size > 1000
    if method == "nuts":
        draws = found["nuts"]["draws"]
        assert draws["faults"] == []
        assert draws["r_hat"] < 1.01
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            import arviz

            data = arviz.from_netcdf(tmp_path / "nuts" / "posterior.nc")
        assert list(data.posterior["coefficient"].values) == ["road.c_rr", "road.cda_m2"]
        value = found["nuts"]["baseline"]["parameters"]["road.cda_m2"]["value"]
        assert float(data.posterior["theta"][..., 1].mean()) == pytest.approx(value, rel=1e-9)
    sheet = tmp_path / method / "calibrated_vehicle.toml"
    status, text = hdev("predict", given[0], "--vehicle", sheet, "--out", tmp_path / "p.csv")
    log = pd.read_csv(str(given[0]))
    inside = 0
    for trip, rows in log.groupby("trip_id"):
        words = next(line for line in text.splitlines() if line.startswith(f"{trip} ")).split()
        low, high = float(words[3]), float(words[5])
        assert low < float(words[1]) < high
        inside += low <= rows.energy_wh.sum() / 1e3 <= high
    assert inside >= 6, "of nine trips, by an interval of 90 %"


def test_nothing_to_calibrate(files, tmp_path, capsys, out):
    sheet = tmp_path / "known.toml"
    sheet.write_text('name = "k"\nmass_kg = 1.0\n[road]\nc_rr = 0.006\ncda_m2 = 5.6\n[driveline]\nefficiency = 0.9\n')
    line = refused(capsys, "calibrate", files["log"], "--vehicle", sheet, "--out", out)
    assert "nothing to calibrate" in line
    assert not out.exists()


# --- refused ---------------------------------------------------------------------------------------------------------


def test_another_configuration_into_the_same_folder(first, given, capsys):
    before = (first[0] / "diagnosis.json").read_bytes()
    line = refused(capsys, "diagnose", *given, *ONLY, "--seed", "1", "--out", first[0])
    assert "another configuration" in line
    assert (first[0] / "diagnosis.json").read_bytes() == before


@pytest.mark.parametrize("verb", ["diagnose", "calibrate"])
def test_a_folder_with_other_files(verb, given, tmp_path, capsys):
    (tmp_path / "thesis.txt").write_text("mine")
    line = refused(capsys, verb, *given, "--out", tmp_path)
    assert "holds other files" in line
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.txt"]


@pytest.mark.parametrize("verb", ["diagnose", "calibrate", "predict"])
def test_a_folder_that_cannot_be_written(verb, given, tmp_path, capsys):
    (tmp_path / "file").write_text("in the way")
    line = refused(capsys, verb, *given, "--out", tmp_path / "file" / "result")
    assert "cannot be written" in line
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--train-trips", "T01,T99"], ["T99", "T01"]),
        (["--test-trips", "T1"], ["--test-trips", "T1"]),
        (["--train-trips", "T01,T02", "--test-trips", "T02"], ["T02", "--train-trips", "--test-trips"]),
        (["--train-trips", ",".join(f"T{k:02d}" for k in range(1, 10))], ["test"]),
        (["--target", "traction_force_n"], ["traction_force_n"]),
    ],
)
@pytest.mark.parametrize("verb", ["diagnose", "calibrate"])
def test_trips_and_targets_that_do_not_exist(verb, options, words, given, out, capsys):
    line = refused(capsys, verb, *given, *options, "--out", out)
    assert all(w in line for w in words), line
    assert list(out.parent.iterdir()) == []


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--only", "headwnd"], ["headwnd", "did you mean 'headwind'"]),
        (["--exclude", "auxilary_power"], ["did you mean 'auxiliary_power'"]),
        (["--only", "qqqqq"], ["qqqqq", "hdev effects"]),
        (["--only", "headwind", "--exclude", "headwind"], ["no candidate"]),
        (["--effects", "absent.py"], ["absent.py", "no such"]),
    ],
)
def test_effects_that_do_not_exist(options, words, given, out, capsys):
    line = refused(capsys, "diagnose", *given, *options, "--out", out)
    assert all(w in line for w in words), line
    assert list(out.parent.iterdir()) == []


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("def half(:\n", ["SyntaxError"]),
        ("import no_such_module_at_all\n", ["no_such_module_at_all"]),
        ("x = 1\n", ["no subclass"]),
        ("import sys\nsys.exit(0)\n", ["does not run", "SystemExit"]),
        (USER_EFFECT.replace("slow_drift", "rolling"), ["SlowDrift", "'rolling'", "declared model"]),
        (
            USER_EFFECT.replace("    equation", '    needs: ClassVar = "gear"\n    equation'),
            ["SlowDrift", "needs", "'gear'"],
        ),
        (
            USER_EFFECT.replace("    equation", '    searched: ClassVar = "trips"\n    equation'),
            ["SlowDrift", "'trips'"],
        ),
        (USER_EFFECT.replace("0.0, 100.0", "100.0, 0.0"), ["'w_per_s'", "lower is 100", "upper 0"]),
        (USER_EFFECT.replace("0.0, 100.0", "1.0, 100.0"), ["'w_per_s'", "null is 0", "1 to 100"]),
        (USER_EFFECT.replace("1.0, 0.0, 100.0", "0.0, 0.0, 100.0"), ["'w_per_s'", "scale is 0"]),
        (USER_EFFECT.replace("Size", "Parameter"), ["'w_per_s'", "Switch"]),
        (USER_EFFECT.replace('Size("w', 'Choice("w'), ["'w_per_s'", "grid"]),
        (USER_EFFECT.replace("0.0, 100.0)", '0.0, 100.0, by="axle")'), ["'w_per_s'", "'axle'", "road_surface"]),
        (USER_EFFECT.replace('Size("w', 'Switch("w'), ["argument", "grid"]),
        (USER_EFFECT.replace("0.0, 100.0", "float('nan'), 100.0"), ["'w_per_s'", "numbers"]),
        (USER_EFFECT.replace("self.w_per_s *", "(50.0 + self.w_per_s) *"), ["SlowDrift", "sizes are null"]),
        (
            USER_EFFECT.replace('Size("w', 'Switch("w').replace("0.0, 100.0)", "0.0, 100.0, grid=5.0)"),
            ["'w_per_s'", "grid", "5.0"],
        ),
        (
            USER_EFFECT.replace('Size("w', 'Switch("w').replace("0.0, 100.0)", "0.0, 100.0, grid=None)"),
            ["'w_per_s'", "grid", "None"],
        ),
        (USER_EFFECT.replace("0.0, 100.0)", "0.0, 100.0, grid=(1.0,))"), ["unexpected", "grid"]),
        (USER_EFFECT.replace('"w_per_s", "W/s"', '7, "W/s"'), ["name", "7"]),
        (USER_EFFECT.replace("    equation", "    variants: ClassVar = 3\n    equation"), ["variants", "3"]),
        (
            USER_EFFECT.replace("    w_per_s: Any\n", '    w_per_s: Any\n    mode: str = "v2"\n'),
            ["'v2'", "static=True"],
        ),
        (USER_EFFECT.replace("def power", "def pover"), ["SlowDrift", "overrides none of"]),
        (
            USER_EFFECT.replace("    equation", '    entries: ClassVar = ("raod",)\n    equation'),
            ["entries", "raod", "road"],
        ),
        (
            USER_EFFECT.replace("    equation", '    variants: ClassVar = (("w",),)\n    equation'),
            ["variants", "w_per_s"],
        ),
        (
            USER_EFFECT.replace("0.0, 100.0),)", '0.0, 100.0), Size("w_per_s", "W", 0.0, 1.0))'),
            ["two parameters", "w_per_s"],
        ),
        (
            USER_EFFECT.replace("0.0, 100.0),)", '0.0, 100.0), Shape("w", "s", 1.0, 1.0, grid=(1.0,), of="b"))'),
            ["'w'", "of", "'b'"],
        ),
        (USER_EFFECT.replace("slow_drift", "headwind"), ["headwind", "in the library already"]),
        (USER_EFFECT.replace("slow_drift", "slow.drift"), ["SlowDrift", "'slow.drift'", "letters"]),
        (USER_EFFECT.replace('"battery"', '"gearbox"'), ["SlowDrift", "'gearbox'", "driveline"]),
        (USER_EFFECT.replace("    equation", "    formula"), ["SlowDrift", "equation"]),
        (USER_EFFECT.replace('(Size("w_per_s", "W/s", 0.0, 1.0, 0.0, 100.0),)', "()"), ["SlowDrift", "no size"]),
        (USER_EFFECT.replace('(Size("w_per_s", "W/s", 0.0, 1.0, 0.0, 100.0),)', '("k",)'), ["tuple", "Size"]),
        (USER_EFFECT.replace("    w_per_s: Any\n", ""), ["SlowDrift", "w_per_s"]),
        # what only shows on the log itself
        (USER_EFFECT.replace("row.time_s", 'row.channels["oil_temp_c"]'), ["SlowDrift", "'oil_temp_c'", "needs"]),
        (USER_EFFECT.replace("* row.time_s", "/ row.time_s"), ["SlowDrift", "9 of 720 rows", "trip T01 at 0 s"]),
        (USER_EFFECT.replace("row.time_s", "(1, 2)"), ["SlowDrift", "fails on this log"]),
    ],
)
def test_a_file_of_effects_that_is_none(text, words, given, tmp_path, out, capsys):
    effect = tmp_path / "mine.py"
    effect.write_text(text)
    line = refused(capsys, "diagnose", *given, "--effects", effect, "--out", out)
    assert all(w in line for w in ("mine.py", *words)), line
    assert not out.exists()


@pytest.mark.parametrize("x64", [True, False])
def test_effects_that_are_none_too_odd(x64, given, tmp_path):
    """What is legal stays so: NumPy's numbers in a grid, a shape that is one of its grid alone, single precision."""
    import jax

    text = USER_EFFECT.replace("    w_per_s: Any\n", "    w_per_s: Any\n    tau_s: Any\n")
    text = text.replace("* row.time_s", "* row.time_s / self.tau_s")
    by_numpy = '0.0, 100.0), Shape("tau_s", "s", 60.0, 60.0, 1.0, 1e4, grid=np.linspace(60.0, 600.0, 3)),)'
    no_number = '0.0, 100.0), Shape("tau_s", "s", 0.0, 60.0, 0.0, 1e4, grid=(60.0, 600.0)),)'
    one, other = (text.replace("0.0, 100.0),)", shape) for shape in (by_numpy, no_number))
    assert len({text, one, other}) == 3
    effect = tmp_path / "mine.py"
    other = other.replace("slow_drift", "null_drift").replace("SlowDrift", "NullDrift")
    effect.write_text(f"import numpy as np\n{one}\n{other}")
    ids = "slow_drift,null_drift"
    with jax.enable_x64(x64):
        start = opened("diagnose", [given[0]], given[2], None, None, None, None, effect, 0, known_effects(effect), ids)
    assert {"slow_drift", "null_drift"} <= set(start.sheet.library)


def test_an_effect_whose_channel_is_not_logged_is_left_out(given, tmp_path):
    """It says so in its needs: nothing of it is worked out, and the log is not to blame."""
    reads = USER_EFFECT.replace("row.time_s", 'row.channels["oil_temp_c"]')
    effect = tmp_path / "mine.py"
    effect.write_text(reads.replace("    equation", '    needs: ClassVar = ("oil_temp_c",)\n    equation'))
    start = opened(
        "diagnose", [given[0]], given[2], None, None, None, None, effect, 0, known_effects(effect), "slow_drift"
    )
    assert "slow_drift" in start.sheet.library


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("c_rr ", "c_r ", ["c_r", "c_rr"]),
        ("sd = 0.5", "sd = 0", ["cda_m2", "sd"]),
        ("mass_kg = 29000.0", "mass_kg = -29000.0", ["mass_kg", "-29000"]),
        ("[road]", "[road", ["line"]),
        ("value = 5.6", 'value = "5.6"', ["cda_m2"]),
    ],
)
@pytest.mark.parametrize("verb", ["diagnose", "calibrate", "predict", "check"])
def test_a_sheet_at_fault(verb, old, new, words, files, tmp_path, capsys):
    """One line that names the file and the key; nothing is written."""
    text = files["sheet"].read_text()
    assert old in text
    sheet = tmp_path / "bad.toml"
    sheet.write_text(text.replace(old, new, 1))
    argv = [] if verb == "check" else ["--out", tmp_path / "result"]
    line = refused(capsys, verb, files["log"], "--vehicle", sheet, *argv)
    assert all(w in line for w in ("bad.toml", *words)), line
    assert [p.name for p in tmp_path.iterdir()] == ["bad.toml"]


@pytest.mark.parametrize(
    ("verb", "right", "wrong"),
    [("diagnose", "speed_start_mps", "sped_start_mps"), ("check", "speed_start_mps", "sped_start_mps"),
     ("diagnose", "energy_wh", "enrgy_wh")],
)  # fmt: skip
def test_a_misspelt_column(verb, right, wrong, given, files, tmp_path, capsys):
    log = tmp_path / "log.csv"
    pd.read_csv(files["log"]).rename(columns={right: wrong}).to_csv(log, index=False)
    argv = [] if verb == "check" else ["--out", tmp_path / "result"]
    line = refused(capsys, verb, log, *given[1:], *argv)
    assert all(w in line for w in (f"'{wrong}'", right)), line
    assert [p.name for p in tmp_path.iterdir()] == ["log.csv"]


@pytest.mark.parametrize("unknown", [65535, 4294967295])
@pytest.mark.parametrize("channel", ["gear", "road_surface"])
def test_an_id_that_no_gear_has_is_missing(channel, unknown, given, files, tmp_path):
    """An instrument's word for "unknown": a coefficient for each id up to it would be made."""
    log = pd.read_csv(files["log"])
    log[channel] = 1
    log.loc[[3, 4], channel] = unknown
    log.to_csv(tmp_path / "log.csv", index=False)
    status, said = hdev("check", tmp_path / "log.csv", "--vehicle", given[2])
    assert status == 0
    assert f"noted 2 rows of {channel}: beyond 64, such as {unknown:g}: no such id, taken as missing" in said
    assert f"filled 2 rows of {channel}" in said
    start = opened("diagnose", [tmp_path / "log.csv"], given[2], None, None, None, None, None, 0, known_effects(None))
    assert set(np.asarray(start.problem.segments.channels[channel]).tolist()) == {1}


def test_a_log_that_is_not_there(given, tmp_path, capsys):
    line = refused(capsys, "diagnose", tmp_path / "no.csv", *given[1:], "--out", tmp_path / "result")
    assert "no.csv" in line
    assert list(tmp_path.iterdir()) == []


def test_effects_lists_the_library(capsys):
    assert cli.main(["effects"]) == 0
    text = capsys.readouterr().out
    assert "headwind" in text
    assert "wind_speed_mps" in text
