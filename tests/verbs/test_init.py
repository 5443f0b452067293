"""`hdev init`: what the log shows is filled in, the rest can be fitted as it stands, nothing is overwritten."""

import shlex
import tomllib

import numpy as np
import pandas as pd
import pytest

import hdev_jax
from hdev_jax.cli import main
from hdev_jax.errors import InputError
from hdev_jax.fleet import synthetic_log
from hdev_jax.verbs.init import init


def log_of(folder, **options):
    rows = 181 if options.get("mode") == "samples" else 180  # as many intervals: what is compiled is shared
    return synthetic_log(seed=3, trips=4, rows_per_trip=rows, **options).write(folder, truth=False)["log"]


def rare_gear(frame):
    """The highest gear in too few rows for a ratio."""
    top = frame.index[frame["gear"] == frame["gear"].max()]
    frame.loc[top[5:], "gear"] = frame["gear"].max() - 1
    return frame


CHANGES = {
    "as it is": lambda f: f,
    "no motor speed": lambda f: f.drop(columns="motor_speed_radps"),
    "no battery power": lambda f: f.drop(columns="battery_power_kw"),
    "no gear": lambda f: f.drop(columns="gear"),
    "a rare gear": rare_gear,
    "no mass, no slope": lambda f: f.drop(columns=["mass_kg", "grade_rad", "altitude_m"]),
}
ROAD = [({}, "as it is"), ({"mode": "samples"}, "no mass, no slope")]
WHEEL = [({"entry": "wheel", "mode": "samples"}, "no mass, no slope")]
SHAFT = [({"entry": "shaft", "mode": "samples"}, change) for change in CHANGES if change != "no mass, no slope"]


@pytest.mark.parametrize(("options", "change"), [*ROAD, *WHEEL, *SHAFT])
def test_the_sheet_that_it_begins_can_be_fitted(options, change, tmp_path):
    path = tmp_path / 'my "first" log.csv'
    CHANGES[change](pd.read_csv(log_of(tmp_path, **options))).to_csv(path, index=False)
    said = init([path], out=tmp_path / "new")
    (file,) = (tmp_path / "new").iterdir()
    assert shlex.split(said.splitlines()[-1])[:3] == ["hdev", "diagnose", str(path)]
    fit = hdev_jax.calibrate([path], file)
    assert np.isfinite(pd.to_numeric(fit.coefficients["value"])).all()
    shows = options.get("entry") == "shaft" and change not in ("no motor speed", "no gear", "a rare gear")
    assert ("gear_ratios" in tomllib.loads(file.read_text())["driveline"]) == shows


@pytest.mark.parametrize(
    ("logs", "said"), [([], "one or several files"), (3.0, "one or several"), ({"a": [1.0]}, "one or several")]
)
def test_what_is_no_file_is_one_line(logs, said, tmp_path):
    with pytest.raises(InputError, match=said):
        init(logs, out=tmp_path)


def test_a_fault_that_an_adapter_cannot_mend_is_said_and_nothing_is_written(tmp_path):
    frame = pd.read_csv(log_of(tmp_path))
    frame.loc[7, "time_s"] = -50.0
    frame.to_csv(tmp_path / "backwards.csv", index=False)
    with pytest.raises(InputError, match="time runs backwards"):
        init(tmp_path / "backwards.csv", out=tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_what_the_log_shows_is_in_the_sheet(tmp_path):
    frame = pd.read_csv(log_of(tmp_path, mode="samples", entry="shaft"))
    ratio = 9.16 * 4.5 / 0.5  # of the lowest gear [rad/m]
    stands = frame["speed_mps"] < 0.1
    frame.loc[stands, "battery_power_kw"] = 3.2
    frame.to_csv(tmp_path / "bus.csv", index=False)
    init(tmp_path / "bus.csv", out=tmp_path)
    sheet = tomllib.loads((tmp_path / "bus.sheet.toml").read_text())
    assert sheet["driveline"]["gear_ratios"][0] / sheet["driveline"]["wheel_radius_m"] == pytest.approx(ratio, rel=0.05)
    assert sheet["battery"]["auxiliary_w"]["value"] == 3200.0
    assert "mass_kg" not in sheet, "the log has it"


def test_other_column_names_begin_an_adapter(tmp_path, capsys):
    frame = pd.read_csv(log_of(tmp_path)).rename(columns={"speed_start_mps": "v0", "speed_end_mps": "v1"})
    frame.to_csv(tmp_path / "own.csv", index=False)
    assert main(["init", str(tmp_path / "own.csv"), "--out", str(tmp_path)]) == 0
    assert "own.adapter.toml: fill in which column is what" in capsys.readouterr().out
    assert "v0" in (tmp_path / "own.adapter.toml").read_text()
    assert not (tmp_path / "own.sheet.toml").exists()


def test_nothing_is_overwritten(tmp_path):
    path = log_of(tmp_path)
    init(path, out=tmp_path)
    before = (tmp_path / "synthetic_truck.sheet.toml").read_text()
    with pytest.raises(InputError, match="is there already"):
        init(path, out=tmp_path)
    assert (tmp_path / "synthetic_truck.sheet.toml").read_text() == before


@pytest.mark.parametrize("shell", ["bash", "zsh"])
def test_the_shell_completes_verbs_and_options(shell, capsys):
    with pytest.raises(SystemExit) as ended:
        main(["--completion", shell])
    assert ended.value.code == 0
    text = capsys.readouterr().out
    assert "diagnose" in text
    assert "--train-trips" in text
