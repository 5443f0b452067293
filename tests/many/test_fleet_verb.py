"""`hdev fleet` from files to its folder: bad logs, a resumed run, worker processes, a data set by vehicle."""

import contextlib
import functools
import hashlib
import importlib.util
import io
import json
import os
import shutil
from pathlib import Path

import jax
import numpy as np
import pandas as pd
import pytest
from planted import library_of
from user_effect import USER_EFFECT

from hdev_jax import cli, compiling
from hdev_jax.fleet import synthetic_log
from hdev_jax.many import Workers, computed, vehicle_record
from hdev_jax.many import workers as workers_module
from hdev_jax.many.vehicle import scanned_again
from hdev_jax.verbs.many import fleet as verb_module

SEARCHED = ("auxiliary_power", "headwind")
needs_dask = pytest.mark.skipif(importlib.util.find_spec("distributed") is None, reason="needs the extra fleet")


def hdev(*argv: object) -> tuple[int, str, str]:
    """The command, with few effects to search."""
    out, err = io.StringIO(), io.StringIO()
    with library_of(SEARCHED), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        status = cli.main([str(a) for a in argv])
    assert status != 1, err.getvalue()
    said = [line for line in err.getvalue().splitlines() if line.startswith("hdev: ")]
    return status, out.getvalue(), said[0] if said else ""


@pytest.fixture(scope="module")
def logs(tmp_path_factory) -> Path:
    """Three short logs of one type, as a folder of files; one of them is bad, one a data set's partition."""
    folder = tmp_path_factory.mktemp("fleet")
    (folder / "logs").mkdir()
    for k in range(2):
        made = synthetic_log(seed=40 + k, trips=9, rows_per_trip=60)
        frame = made.frame.drop(columns="vehicle_id")
        trip = frame["trip_id"].str[1:].astype(int)
        frame["time_unix"] = 1.7e9 + trip * 4 * 86_400.0 + frame.pop("time_s")
        if k < 1:
            frame.to_csv(folder / "logs" / f"V{k}.csv", index=False)
            continue
        at = folder / "logs" / f"vehicle_id=V{k}"
        at.mkdir()
        # a trip begins in one part and ends in the next
        for part, rows in enumerate((frame.iloc[:100], frame.iloc[100:])):
            rows.to_parquet(at / f"part-{part}.parquet")
    (folder / "logs" / "bad.csv").write_text("a,b\n1,2\n")
    (folder / "truck.toml").write_text(made.sheet)
    return folder


@pytest.fixture(scope="module")
def whole(logs) -> Path:
    out = logs / "out"
    assert hdev("fleet", logs / "logs", "--vehicles", logs / "truck.toml", "--price", 0.2, "--out", out)[0] == 0
    return out


def same(a, b, where=""):
    """Equal but for times, numbers to 1e-9."""
    if isinstance(a, dict):
        assert a.keys() == b.keys(), where
        for k in a.keys() - {"seconds"}:
            same(a[k], b[k], f"{where}/{k}")
    elif isinstance(a, list):
        assert len(a) == len(b), where
        for i, (x, y) in enumerate(zip(a, b, strict=True)):
            same(x, y, f"{where}[{i}]")
    elif isinstance(a, float):
        assert a == pytest.approx(b, rel=1e-9, abs=1e-12), where
    else:
        assert a == b, where


OWN = USER_EFFECT.replace("0.0, 100.0)", "0.0, 200.0)")


def read(out: Path) -> dict:
    return json.loads((out / "fleet.json").read_text())


def test_every_vehicle_has_a_line_the_bad_one_with_what_check_says(logs, whole):
    found = read(whole)
    assert found["counts"] == {"done": 2, "suspect": 0, "refused": 1, "failed": 0}
    line = pd.read_csv(whole / "fleet.csv").set_index("name").loc["bad"]
    assert f"hdev: {line['message']}" == hdev("check", logs / "logs" / "bad.csv")[2]
    assert {p.stem for p in (whole / "vehicles").iterdir()} == {"V0", "V1", "bad"}
    page = (whole / "report.html").read_text()
    assert "synthetic" in page
    assert line["message"].split(";")[0] in page
    for v in found["vehicles"]:
        assert v["status"] == "refused" or v["trips"] == 9, "parts of a data set are one log"


def test_the_ledger_adds_up_to_what_the_meters_measured(logs, whole):
    rows = pd.read_csv(whole / "ledger.csv")
    block = rows[rows["level"] == "fleet"].set_index("cause")["kwh"]
    parts = logs / "logs" / "vehicle_id=V1"
    logs_wh = [pd.read_csv(logs / "logs" / "V0.csv")["energy_wh"].sum()]
    logs_wh.append(pd.read_parquet(parts, partitioning=None)["energy_wh"].sum())
    assert block["measured"] == pytest.approx(sum(logs_wh) / 1e3, rel=1e-6)
    assert block.drop("measured").sum() == pytest.approx(block["measured"], rel=1e-6)


@pytest.mark.parametrize(("maps", "programs"), [(10**6, [1, 2, 3]), (0, [1, 1, 1])])
def test_a_process_does_not_keep_the_programs_of_every_vehicle(monkeypatch, maps, programs):
    double = jax.jit(lambda x: 2.0 * x)

    def work(task):
        double(np.zeros(task["rows"]))
        return {"programs": double._cache_size()}

    monkeypatch.setattr(compiling, "MOST_MAPS", maps)
    done = computed(work, [{"rows": n} for n in (1, 2, 3)], Workers())
    assert [r["programs"] for _, r in done] == programs


def test_a_run_that_was_killed_goes_on_with_what_is_left(logs, whole, monkeypatch):
    """Each vehicle's record is that of the whole run: here it is what is asked, kept and read again that counts."""
    out = logs / "resumed"
    seen, again, asked = [], [], {}

    def done(names):
        def computed(_, tasks, __):
            asked.update({t["name"]: t for t in tasks if t["name"] not in asked})
            for i, task in enumerate(tasks):
                assert str(asked[task["name"]]) == str(task), "what is resumed is the same task"
                names.append(task["name"])
                yield i, json.loads((whole / "vehicles" / f"{task['name']}.json").read_text())

        return computed

    def stops(work, tasks, where):
        for i, record in done(seen)(work, tasks, where):
            yield i, record
            if "V0" in seen:
                raise KeyboardInterrupt

    command = ("fleet", logs / "logs", "--vehicles", logs / "truck.toml", "--price", 0.2, "--out", out)
    monkeypatch.setattr(verb_module, "computed", stops)
    assert hdev(*command)[0] == 130
    monkeypatch.setattr(verb_module, "computed", done(again))
    assert hdev(*command)[0] == 0
    assert sorted(seen + again) == ["V0", "V1", "bad"]
    same(read(whole), read(out))
    again.clear()
    assert hdev(*command)[1].startswith("2 vehicles diagnosed")
    assert again == [], "a folder that is complete is returned"


def dies_once(mark, known, task):
    """What a worker makes of a vehicle: V1's record is the known one, for time. The bad log kills its worker, once."""
    if task["name"] == "bad" and not mark.exists():
        mark.touch()
        os._exit(9)
    if task["name"] == "V1":
        return json.loads((known / "V1.json").read_text())
    with library_of(SEARCHED):
        return vehicle_record(task)


@needs_dask
@pytest.mark.slow
def test_worker_processes_give_the_same_even_if_one_is_killed(logs, whole, tmp_path, monkeypatch):
    here = Path(__file__).parent
    path = os.pathsep.join([str(here), str(here.parent), os.environ.get("PYTHONPATH", "")])
    monkeypatch.setenv("PYTHONPATH", path)  # of the workers
    monkeypatch.setattr(
        verb_module, "vehicle_record", functools.partial(dies_once, tmp_path / "mark", whole / "vehicles")
    )
    out = logs / "spread"
    command = ("fleet", logs / "logs", "--vehicles", logs / "truck.toml", "--price", 0.2, "--out", out)
    assert hdev(*command, "--workers", 2)[0] == 0
    assert (tmp_path / "mark").exists()
    same(read(whole), read(out))


def test_without_dask_more_workers_are_refused_in_one_line(logs, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "distributed", None)
    command = ("fleet", logs / "logs", "--vehicles", logs / "truck.toml", "--workers", 2, "--out", logs / "none")
    status, _, said = hdev(*command)
    assert status == 2
    assert "--workers 2: needs Dask: pip install 'hdev_jax[fleet]'" in said


@needs_dask
def test_a_scheduler_that_is_not_there_is_refused_in_one_line(monkeypatch):
    monkeypatch.setattr(workers_module, "PATIENCE_S", 0.2)
    with pytest.raises(workers_module.InputError, match="no scheduler answers"):
        list(computed(vehicle_record, [{}], Workers(1, "tcp://127.0.0.1:9")))


def test_a_fleet_of_bad_logs_alone_is_refused(logs, tmp_path):
    shutil.copy(logs / "logs" / "bad.csv", tmp_path / "bad.csv")
    status, _, said = hdev("fleet", tmp_path / "bad.csv", "--vehicles", logs / "truck.toml", "--out", tmp_path / "out")
    assert status == 2
    assert "none of 1 vehicles could be used" in said
    assert "no column speed_mps" in said


def test_an_adapter_is_a_file_or_the_name_of_a_preset(logs, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "torque").mkdir()  # a folder of that name is none of the two
    (tmp_path / "a.csv").write_text("Device Time,Speed (OBD)(km/h)\n2026-01-01 00:00:00,3\n2026-01-01 00:00:01,4\n")
    given = ("fleet", tmp_path / "a.csv", "--vehicles", logs / "truck.toml", "--out", tmp_path / "out")
    assert "no column speed_mps" in hdev(*given)[2]
    status, _, said = hdev(*given, "--adapter", "torque")
    assert status == 2
    assert "none of 1 vehicles could be used" in said
    assert "no column speed_mps" not in said
    status, _, said = hdev(*given, "--adapter", "torqe")
    assert status == 2
    assert "no such file, and no preset; there are carscanner, " in said


def test_effects_of_ones_own_are_searched_declared_and_pooled(logs, tmp_path):
    """Four vehicles have it, one of a fifth's own type declares it."""
    (tmp_path / "mine.py").write_text(OWN)
    (tmp_path / "logs").mkdir()
    sheet = (logs / "truck.toml").read_text()
    for name in "ABCDE":
        made = synthetic_log(seed=50 + ord(name), trips=9, rows_per_trip=60)
        frame = made.frame.drop(columns="vehicle_id")
        frame["energy_wh"] += 100.0 * frame["time_s"] * frame["duration_s"] / 3600.0
        frame.to_csv(tmp_path / "logs" / f"{name}.csv", index=False)
        declared = "\n[effects.slow_drift]\nw_per_s = 100.0\n" if name == "E" else ""
        (tmp_path / f"{name}.toml").write_text(sheet + declared)
    lines = [f"{name},{name}.toml,{'other' if name == 'E' else 'truck'}\n" for name in "ABCDE"]
    (tmp_path / "vehicles.csv").write_text("vehicle,sheet,type\n" + "".join(lines))
    argv = ["fleet", tmp_path / "logs", "--vehicles", tmp_path / "vehicles.csv"]
    status, _, said = hdev(*argv, "--effects", tmp_path / "none.py", "--out", tmp_path / "no")
    assert (status, said) == (2, f"hdev: --effects {tmp_path / 'none.py'}: no such Python file")
    assert hdev(*argv, "--effects", tmp_path / "mine.py", "--out", tmp_path / "out")[0] == 0
    found = read(tmp_path / "out")
    named = {v["name"]: {e["id"]: e for e in v["effects"]} for v in found["vehicles"]}
    assert {k for k, v in named.items() if "slow_drift" in v} == {*"ABCD"}
    (pooled,) = [e for e in found["effects"] if e["id"] == "slow_drift"]
    assert pooled["found"]
    assert (pooled["type"], pooled["named_in"], pooled["unit"]) == ("truck", 4, "W/s")
    assert abs(pooled["value"] - 100.0) < 4 * pooled["sd"] < 40.0
    assert "--effects" in (tmp_path / "out" / "report.html").read_text()


def test_a_worker_with_another_file_of_effects_or_none_says_so(logs, tmp_path):
    """Also where a type's vehicles are scanned again with an effect of one's own in their models."""
    mine = tmp_path / "mine.py"
    mine.write_text(OWN)
    task = {
        "name": "V0", "files": [str(logs / "logs" / "V0.csv")], "whole": False, "sheet": str(logs / "truck.toml"),
        "kind": "", "missing": "", "adapter": None, "target": None, "fdr": 0.05, "seed": 0, "trust": False,
        "effects": str(mine), "effects_sha256": hashlib.sha256(mine.read_bytes()).hexdigest(),
    }  # fmt: skip
    with library_of(SEARCHED):
        again = scanned_again({**task, "beside": {"slow_drift": {"w_per_s": [10.0, 5.0]}}})
    assert (again["message"], "slow_drift" in {s["id"] for s in again["scan"].values()}) == ("", False)
    other = vehicle_record({**task, "effects_sha256": "0"})
    assert (other["status"], other["message"].partition(": ")[2][:8]) == ("refused", "not the ")
    gone = vehicle_record({**task, "effects": str(tmp_path / "gone.py")})
    assert (gone["status"], gone["message"].partition(": ")[2][:11]) == ("refused", "not on this")
