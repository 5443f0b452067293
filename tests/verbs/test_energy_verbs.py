"""The verbs about energy end to end, in memory and through the command line, on a small synthetic log."""

import contextlib
import io
import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import hdev_jax
from hdev_jax import cli
from hdev_jax.energy.causes import by_cause
from hdev_jax.energy.fitted import Fitted
from hdev_jax.fleet import SyntheticLog, synthetic_log
from hdev_jax.inference.sheet import sheet_of_sections
from hdev_jax.inference.states import Switching
from hdev_jax.logs import Log
from hdev_jax.options.energy import ENERGY_VERBS
from hdev_jax.problem import prepare
from hdev_jax.verbs.energy.result import _write_book
from hdev_jax.verbs.states import given_states, states_of


@pytest.fixture(scope="module")
def synthetic() -> SyntheticLog:
    return synthetic_log(seed=3, trips=9, rows_per_trip=80, effects={"headwind": {"scale": 0.98}}, noise_level=0.02)


@pytest.fixture(scope="module")
def files(synthetic, tmp_path_factory) -> dict[str, Path]:
    return synthetic.write(tmp_path_factory.mktemp("log"), truth=False)


def hdev(*argv: object) -> tuple[int, str, str]:
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        status = cli.main([str(a) for a in argv])
    assert status != 1, err.getvalue()
    said = [line for line in err.getvalue().splitlines() if line.startswith("hdev: ")]
    return status, out.getvalue(), said[0] if said else ""


def arguments(verb: str, files: dict[str, Path]) -> list[object]:
    log, sheet = files["log"], files["sheet"]
    given = {
        "ledger": ["ledger", log, "--vehicle", sheet, "--price", 0.25],
        "roadload": ["roadload", log, "--vehicle", sheet],
        "whatif": ["whatif", sheet, log, "--set", "road.c_rr=-10%", "--set", "mass_kg=+500"],
        "saved": ["saved", log, "--vehicle", sheet, "--before", "T01..T05", "--after", "T06.."],
        "compare": ["compare", "T01", "T04", "--log", log, "--vehicle", sheet],
    }
    return given[verb]


TABLES = {
    "ledger": {"ledger", "about"},
    "roadload": {"road_load", "force"},
    "whatif": {"trips", "causes"},
    "saved": {"trips", "circumstances"},
    "compare": {"causes", "circumstances"},
}


@pytest.mark.parametrize("verb", ENERGY_VERBS)
def test_a_folder_has_page_tables_workbook_and_is_returned_as_done(verb, files, tmp_path):
    out = tmp_path / "result"
    given = [*arguments(verb, files), "--out", out]
    status, text, _ = hdev(*given)
    assert status == 0
    assert str(out / "report.html") in text
    names = {p.name for p in out.iterdir()}
    tables = {f"{t}.{ending}" for t in TABLES[verb] for ending in ("csv", "parquet")}
    assert tables | {"report.html", "figures", f"{verb}.json", f"{verb}.xlsx", "config.toml"} <= names
    for name in TABLES[verb]:
        frame = pd.read_csv(out / f"{name}.csv")
        kept, book = pd.read_parquet(out / f"{name}.parquet"), pd.read_excel(out / f"{verb}.xlsx", sheet_name=name)
        assert list(frame) == list(kept) == list(book)
        assert len(frame) == len(kept) == len(book) > 0
    page = (out / "report.html").read_text()
    assert "synthetic" in page
    assert f"hdev {verb}" in page
    assert "http" not in page.replace("http-equiv", "")
    summary = json.loads((out / f"{verb}.json").read_text())
    assert summary["schema"] == f"hdev-{verb}/1"
    if verb == "ledger":
        assert "calibrated on 9 trips" in summary["how"]
    assert list((out / "figures").glob("*.png"))
    before = (out / "report.html").stat().st_mtime_ns
    assert hdev(*given) == (0, text, "")
    assert (out / "report.html").stat().st_mtime_ns == before
    status, _, said = hdev(*given, "--seed", 5)
    assert (status, "another configuration" in said) == (2, True)


def test_a_fitted_sheet_is_taken_as_fitted(synthetic, files):
    fitted = hdev_jax.calibrate(synthetic.frame, hdev_jax.read_sheet(files["sheet"]))
    found = hdev_jax.ledger(synthetic.frame, fitted)
    assert "as fitted before" in found.summary["how"]


def test_two_sheets_and_two_logs_without_energy(synthetic, files, tmp_path):
    plan = synthetic.frame.drop(columns=["energy_wh"])
    sheet = hdev_jax.read_sheet(files["sheet"])
    other = {
        "mass_kg": 29e3,
        "road": {"c_rr": (0.0060, 0.0008), "cda_m2": (5.0, 0.5)},
        "driveline": {"efficiency": 0.91},
    }
    table = hdev_jax.compare(sheet, other, plan).tables["causes"].set_index("cause")
    assert table.loc["aero", "b"] / table.loc["aero", "a"] == pytest.approx(5.0 / 5.6)
    assert "unexplained" not in table.index
    found = hdev_jax.whatif(sheet, plan, "road.c_rr=-10%")
    np.testing.assert_allclose(
        found.tables["causes"]["difference"].iloc[:-1].sum(), found.tables["causes"]["difference"].iloc[-1]
    )
    assert found.report(tmp_path / "page.html").read_text().startswith("<!DOCTYPE html>")


@pytest.mark.parametrize("verb", ["ledger", "whatif", "saved", "compare"])
def test_a_suspect_log_is_refused_unless_it_is_trusted(verb, synthetic, files, tmp_path):
    dead = synthetic.frame.assign(energy_wh=0.0)
    dead.to_csv(tmp_path / "dead.csv", index=False)
    argv = arguments(verb, {**files, "log": tmp_path / "dead.csv"})
    status, _, said = hdev(*argv, "--out", tmp_path / "out")
    assert status == 2
    assert "suspect" in said
    assert "--trust" in said
    if verb == "ledger":
        assert hdev(*argv, "--trust", "--out", tmp_path / "out")[0] == 0


def test_a_coast_down_is_known_by_what_it_lacks(tmp_path):
    rng = np.random.default_rng(0)
    rows = []
    for run in range(6):
        v, t = 30.0, 0.0
        while v > 4.0:
            rows.append((f"run{run}", t, v + 0.02 * rng.normal()))
            v -= (160.0 + 0.4 * v**2) / 1500.0
            t += 1.0
    frame = pd.DataFrame(rows, columns=["trip_id", "time_s", "speed_mps"])
    sheet = {"mass_kg": 1500.0, "road": {"c_rr": 0.012, "cda_m2": 0.65}}
    found = hdev_jax.roadload(frame, sheet)
    assert "coast-down of 6 runs" in found.summary["how"]
    force = found.tables["force"].set_index("speed_kmh")
    assert force.loc[50.0, "force_n"] == pytest.approx(160.0 + 0.4 * (50 / 3.6) ** 2, rel=0.03)
    assert any("no road.rotating_mass_factor" in note for note in found.summary["notes"])


def test_a_load_that_switches_is_on_where_the_power_shows_it():
    rng = np.random.default_rng(1)
    on = np.zeros(600)
    on[100:250] = on[400:480] = 1.0
    sheet = {"mass_kg": 2e4, "road": {"c_rr": 0.006, "cda_m2": 5.6}, "driveline": {"efficiency": 0.9}}
    switching = {"power_w": 8e3, "memory_s": 60.0, **{f"share_{k}c": 0.4 for k in (0, 10, 20, 30)}}
    frame = {"time_s": np.arange(600.0), "speed_mps": np.full(600, 12.0), "battery_power_kw": np.ones(600)}
    plain = prepare(Log.from_frame(frame), sheet_of_sections(sheet))
    frame["battery_power_kw"] = plain.predict(plain.vehicle) + 8.0 * on + 0.3 * rng.normal(size=600)
    problem = prepare(Log.from_frame(frame), sheet_of_sections({**sheet, "effects": {"switching_load": switching}}))
    model = Switching(np.array([8e3]), 0.0, np.full(2, 400.0), np.full((1, 4), 0.4), np.full(1, 60.0))
    given = given_states(problem, {"states": states_of(("switching_load",), model)})
    assert given is not None
    np.testing.assert_allclose(np.asarray(given.segments.channels["derived:switching_load"]), on, atol=0.05)
    fitted = Fitted(given, given.vehicle, np.zeros((0, 0)), 200.0, None, "known")
    parts = by_cause(fitted, fitted.draws(0))
    assert parts.value[0, parts.causes.index("switching_load")] == pytest.approx(8.0 * on.sum() / 3600, rel=0.02)
    assert given_states(problem, {}) is None
    assert given_states(plain, {"states": states_of(("switching_load",), model)}) is None


REFUSED = {
    "no energy": (["ledger", "LOG", "--vehicle", "SHEET", "--target", "traction_force_n"], "energy at the battery"),
    "a price below 0": (["ledger", "LOG", "--vehicle", "SHEET", "--price", "-1"], "a number of 0 or more"),
    "near name": (["whatif", "SHEET", "LOG", "--set", "road.crr=-10%"], "did you mean 'road.c_rr'"),
    "both sides": (
        ["saved", "LOG", "--vehicle", "SHEET", "--before", "T01..T05", "--after", "T05..T07"], "both have trip 'T05'"
    ),
    "one trip": (["saved", "LOG", "--vehicle", "SHEET", "--before", "T01..T05", "--after", "T06"], "at least 2"),
    "no such trip": (["compare", "T01", "T77", "--log", "LOG", "--vehicle", "SHEET"], "no trip or vehicle 'T77'"),
    "no sheet": (["compare", "T01", "T02", "--log", "LOG"], "--vehicle is missing"),
    "a sheet and a trip": (["compare", "SHEET", "T02", "--log", "LOG"], "one is a sheet"),
    "a mass of nothing": (["roadload", "LOG", "--vehicle", "SHEET", "--mass", "0"], "above 0 kg"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_bad_input_is_one_line(case, files, tmp_path):
    argv, said = REFUSED[case]
    named = {"LOG": files["log"], "SHEET": files["sheet"]}
    out = tmp_path / "out"
    status, text, line = hdev(*(named.get(a, a) for a in argv), "--out", out)
    assert (status, text) == (2, "")
    assert said in line
    assert not out.exists()


def test_a_name_that_looks_like_a_formula_stays_text_in_the_workbook(tmp_path):
    openpyxl = pytest.importorskip("openpyxl")
    table = pd.DataFrame({"trip_id": ["=1+1", "T01"], "kwh": [1.5, 2.0]})
    _write_book(tmp_path / "b.xlsx", {"trips": table})
    cells = openpyxl.load_workbook(tmp_path / "b.xlsx")["trips"]
    assert [(c.value, c.data_type) for c in cells["A"][1:]] == [("=1+1", "s"), ("T01", "s")]
    assert [c.data_type for c in cells["B"][1:]] == ["n", "n"]
