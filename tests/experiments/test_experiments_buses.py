"""The buses' missions by distance: what a row holds, and what is said where the data is not there."""

import gzip

import numpy as np
import pytest

from experiments.pinn.buses import ADAPTER, BUSES, SHEET, bus_files, bus_sources, buses, read_mission
from experiments.pinn.study import Config, tasks
from experiments.runner.config import CONFIGS, resolve, typed
from experiments.runner.data import MissingDataError
from hdev_jax.logs import read_log
from hdev_jax.targets import TARGETS


def test_a_mission_of_each_bus_keeps_the_energy_of_its_samples(data_dir, monkeypatch):
    monkeypatch.setenv("HDEV_DATA", str(data_dir))
    missions = buses(100.0, missions=1)
    assert tuple(m.bus for m in missions) == BUSES
    assert len(bus_files()) == 24
    for m, path in zip(missions, bus_files(1), strict=True):
        assert path.name.startswith(m.name)
        s, log = m.segments, read_log(path, ADAPTER)
        assert s.has("mass_kg", "grade_rad", "ambient_temp_c", "altitude_m")
        assert not set(TARGETS) & set(s.channels)
        assert len(m.energy_wh) == len(s) < len(log) / 10
        # the authors' power demand [W] at 1 Hz
        assert m.energy_wh.sum() == pytest.approx(log.measured["battery_power_w"].sum() / 3600.0, rel=1e-9)
        assert s.distance_m.sum() == pytest.approx(log.segments.distance_m.sum(), rel=1e-9)
        halt = s.distance_m == 0
        assert 0.05 < halt.mean() < 0.3
        # a stretch each 100 m and one more for each halt in it; longer by a sample's way at most
        assert np.sum(~halt) <= s.distance_m.sum() / 100.0 + halt.sum() + 1
        assert s.distance_m.max() < 100.0 + log.segments.distance_m.max()
        assert s.duration_s[halt].max() > 60.0


def test_missing_data_says_where_it_is_from(tmp_path, monkeypatch):
    monkeypatch.setenv("HDEV_DATA", str(tmp_path))
    with pytest.raises(MissingDataError, match=r"no measured data in .*ztbus"):
        buses()
    (tmp_path / "ztbus").mkdir()
    (tmp_path / "ztbus" / "B183_2021-01-01_00-00-00_2021-01-01_01-00-00.csv").touch()
    with pytest.raises(MissingDataError, match=r"no mission of B208 in .*ztbus: they are from doi.org"):
        bus_files()


def test_a_task_on_buses_changes_with_any_file_that_its_rows_are_made_of(tmp_path, monkeypatch):
    monkeypatch.setenv("HDEV_DATA", str(tmp_path))
    (tmp_path / "ztbus").mkdir()
    for bus in BUSES:
        for end in ("csv", "grade.csv.gz"):
            (tmp_path / "ztbus" / f"{bus}_2021.{end}").write_text("1")
    sources = bus_sources()
    assert sorted(p.name for p in sources[:4]) == sorted(p.name for p in (tmp_path / "ztbus").iterdir())
    assert sources[4:] == [ADAPTER, SHEET]
    config = typed(Config, resolve(CONFIGS / "studies" / "pinn_buses.toml"), "pinn_buses")

    def told():
        return {t["data"]["files"] for t in tasks(config)}

    before = told()
    (tmp_path / "ztbus" / "B208_2021.grade.csv.gz").write_text("2")
    assert len(before) == len(told()) == 1
    assert before != told()
    (tmp_path / "ztbus" / "B208_2021.grade.csv.gz").unlink()
    assert len(bus_sources()) == 5
    (tmp_path / "ztbus" / "B208_2021.csv").unlink()
    with pytest.raises(MissingDataError, match="no mission of B208"):
        told()


def test_a_mission_without_its_slope_is_missing_data(data_dir, tmp_path):
    (path,) = (p for p in (data_dir / "ztbus").glob("B183_2021-04-16*.csv.gz") if ".grade." not in p.name)
    with gzip.open(path) as whole, gzip.open(tmp_path / path.name, "wb") as start:
        start.writelines(whole.readline() for _ in range(600))
    with pytest.raises(MissingDataError, match=r"its slope, B183_\S+\.grade\.csv\.gz, is not beside it"):
        read_mission(tmp_path / path.name)
