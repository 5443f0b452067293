"""The project's measured data reads without complaint."""

from pathlib import Path

import numpy as np
import pytest

from hdev_jax.logs import read_log

ADAPTERS = Path(__file__).parents[2] / "configs" / "adapters"
TABLE_V_KWH = (11.82389, 15.768, 11.633, 15.784)  # paper 2, table V


def test_kia_niro(data_dir):
    log = read_log(sorted((data_dir / "kia_niro").glob("*.mat")), ADAPTERS / "kia_niro.toml")
    assert log.trip_names == ("1", "2", "3", "4")
    assert log.default_target == "battery_power_kw"
    energy = [log.target("energy_wh")[log.segments.trip == i].sum() / 1000 for i in range(4)]
    np.testing.assert_allclose(energy, TABLE_V_KWH, rtol=3e-4)  # the edges are trimmed: 10 s of 7000
    moving = log.segments.speed_mps > 5.0
    ratio = log.segments.channels["motor_speed_radps"][moving] / log.segments.speed_mps[moving]
    assert np.median(ratio) == pytest.approx(33.28, rel=2e-3)
    assert not log.segments.has("accelerator_pct")
    assert 0.7 < log.segments.channels["soc"].min() < log.segments.channels["soc"].max() < 0.96


@pytest.mark.parametrize(("trip", "has"), [(1, True), (2, False)])
def test_one_trip_of_the_niro(data_dir, trip, has):
    path = next((data_dir / "kia_niro").glob(f"Trip_{trip}_*.mat"))
    log = read_log(path, ADAPTERS / "kia_niro.toml")
    assert log.trip_names == (str(trip),)
    assert log.segments.has("accelerator_pct") == has


@pytest.mark.slow
def test_every_file_of_the_buses_and_the_cars_folder_are_read(data_dir):
    files = sorted((data_dir / "ztbus").glob("B*.csv.gz"))
    assert len(read_log(files, ADAPTERS / "ztbus.toml").trip_names) == 24
    assert read_log(data_dir / "kia_niro", ADAPTERS / "kia_niro.toml").trip_names == ("1", "2", "3", "4")


def test_ztbus(data_dir):
    files = sorted((data_dir / "ztbus").glob("B*.csv.gz"))  # companions too, as a shell would pass them
    assert len(files) == 48
    log = read_log([f for k, f in enumerate(files) if k % 8 < 2], ADAPTERS / "ztbus.toml")  # one trip of four
    assert len(log.trip_names) == 6
    assert log.vehicle_names == ("B183", "B208")
    assert log.default_target == "battery_power_kw"
    c = log.segments.channels
    assert all(np.isfinite(x).all() for x in c.values())
    assert np.abs(c["grade_rad"]).max() <= np.arctan(0.12)
    assert c["mass_kg"].min() == 19500.0
    assert -10.0 < c["ambient_temp_c"].min() < c["ambient_temp_c"].max() < 45.0
    np.testing.assert_allclose(log.segments.duration_s, 1.0)
    assert log.ledger.count("dropped") == 0
