"""The simulated fleet: identities, a NumPy reference that shares no code, the driver against mechanics, the files."""

import json
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from map_reference import map_by_scipy

from hdev_jax import cli
from hdev_jax.errors import InputError
from hdev_jax.fleet import VARIANTS, FleetConfig, efficiency_map, files, load_config, simulate
from hdev_jax.fleet.config import parse_config
from hdev_jax.fleet.driver import STEP_M, Car, Roads, drive
from hdev_jax.fleet.hidden import shift_program
from hdev_jax.fleet.rows import ROW_FIELDS, padded
from hdev_jax.fleet.shifting import engaged, load_share, shift_lines
from hdev_jax.fleet.variants import variant
from hdev_jax.inference.sheet import build, read_sheet
from hdev_jax.logs import read_log
from hdev_jax.physics.across import DISTANCE_SINCE_START, FIRST, LAST, distance_since_start, trip_bounds

ROOT = Path(__file__).parents[2]
CHOSEN = ["A", "truck_4x2_12t", "bus_12m_2speed"]
SMALL = {"seed": 5, "routes": 6, "segments_per_route": 40, "variants": CHOSEN}
SWITCHES = [k for k, x in FleetConfig().table()["truth"].items() if x is True]
PERFECT = {
    "truth": {**dict.fromkeys(SWITCHES, False), "payload_bias": 0.0, "payload_sd": 0.0},
    "log": {"energy_noise_wh": 0.0, "energy_noise_share": 0.0, "speed_noise_mps": 0.0, "grade_noise_rad": 0.0,
            "clock_skew_s": 0.0, "dropout_share": 0.0},
}  # fmt: skip


@pytest.fixture(scope="module")
def fleet():
    return simulate(SMALL)


@pytest.fixture(scope="module")
def perfect():
    return simulate({**SMALL, **PERFECT})


# --- what it is made from ---


def test_the_fleet_has_the_variants_that_it_must():
    assert len(VARIANTS) >= 24
    assert {v.gears for v in VARIANTS} == {1, 2, 3, 4, 12}
    assert {v.model for v in VARIANTS} == {"", "A", "B", "C", "D"}
    assert {v.axles.removesuffix("+trailer") for v in VARIANTS} == {"4x2", "6x2", "6x4", "8x4"}
    assert sum(v.bus for v in VARIANTS) >= 4
    assert any("articulated" in v.name for v in VARIANTS)
    for v in VARIANTS:
        assert v.mass_kg[0] < v.mass_kg[1]
        assert list(v.gear_ratios) == sorted(v.gear_ratios, reverse=True)
        values = efficiency_map(v)[3]
        assert values.shape[0] == v.gears
        assert values.min() > 0
        assert 0.85 < values.max() < 0.97


def test_the_config_of_the_study_is_the_default():
    config = load_config(ROOT / "configs" / "studies" / "fleet.toml")
    assert config == FleetConfig()
    assert parse_config(config.table()) == config
    assert config.routes * config.segments_per_route >= 550_000
    assert len(config.chosen) == len(VARIANTS)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("routes = 5", ["seed", "missing"]),
        ("seed = 1\nrouts = 5", ["routs", "routes"]),
        ("seed = 1\nroutes = 0", ["routes", "0", "from 1"]),
        ("seed = 1\nroutes = 2.5", ["routes", "2.5", "whole number"]),
        ("seed = true", ["seed", "True"]),
        ("seed = -1", ["seed", "-1"]),
        ('seed = 1\nvariants = "A"', ["variants", "list of names"]),
        ("seed = 1\nvariants = []", ["variants", "list of names"]),
        ('seed = 1\nvariants = ["A", "bus_12m"]', ["bus_12m", "bus_12m_1speed"]),
        ('seed = 1\nvariants = ["A", "A"]', ["variants", "twice"]),
        ("seed = 1\ntruth = 3", ["truth", "section"]),
        ("seed = 1\n[truth]\nheadwnd = true", ["truth.headwnd", "headwind"]),
        ("seed = 1\n[truth]\nheadwind = 1", ["truth.headwind", "true or false"]),
        ("seed = 1\n[log]\ndropout_share = 0.9", ["log.dropout_share", "0.9"]),
        ("seed = 1\n[weather]\nwind_mps = nan", ["weather.wind_mps", "nan"]),
        ("seed = 1\n[gears\n", ["not a TOML file"]),
    ],
)
def test_a_config_at_fault_is_one_line(text, words, tmp_path, capsys):
    path = tmp_path / "bad.toml"
    path.write_text(text)
    assert cli.main(["simulate", str(path), "--out", str(tmp_path / "out")]) == 2
    line = capsys.readouterr().err
    assert line.count("\n") == 1
    assert all(w in line for w in ("bad.toml", *words)), line
    assert [p.name for p in tmp_path.iterdir()] == ["bad.toml"]


def test_a_config_that_is_not_there():
    with pytest.raises(InputError, match=r"no\.toml: no such file"):
        load_config("no.toml")


# --- energy ---


def test_the_parts_add_up_and_are_those_switched_on(fleet):
    for v in fleet.vehicles:
        parts = {k.removeprefix("energy_wh:"): x for k, x in v.truth.items() if k.startswith("energy_wh:")}
        np.testing.assert_allclose(sum(parts.values()), v.truth["energy_true_wh"], atol=1e-9)
        assert set(SWITCHES) - {"tabular_error"} <= set(parts)
        assert set(v.effects) - {"time_skew"} == set(SWITCHES) - {"tabular_error"}
        assert all(np.isfinite(x).all() for k, x in v.truth.items() if k != "shift_up_mps")


def test_the_coefficients_of_a_row_are_those_of_its_forces():
    for v in simulate({**SMALL, "log": {"speed_noise_mps": 0.0}}).vehicles:
        s, t = v.segments, v.truth
        square = (s.speed_start_mps**2 + s.speed_end_mps**2) / 2
        moves = (s.distance_m > 0) & (square > 0)  # between two halts in a row the air has no area to speak of
        weight = t["mass_kg"] * 9.80665 * np.cos(t["grade_rad"])
        work = (t["c_rr"] * weight + 0.5 * 1.225 * t["cda_m2"] * square) * s.distance_m / 3600
        ids = ("rolling", "rolling_temperature", "rolling_speed", "tyre_warmup", "wet_road", "road_surface",
               "cornering", "aero", "headwind", "crosswind", "air_density")  # fmt: skip
        told = sum(t[f"energy_wh:{k}"] for k in ids)
        np.testing.assert_allclose(work[moves], told[moves], rtol=1e-9)
        assert np.median(t["c_rr"]) > v.variant.true_c_rr  # cold, rough and wet roads cost


def test_what_is_worked_out_by_trip_is_what_the_kernel_would(fleet):
    s = fleet["A"].segments
    rows = {k: np.asarray(getattr(s, k)) for k in ROW_FIELDS} | s.channels
    ours = padded(rows, s.trip, len(s) + 7)
    bare = ours.without(FIRST, LAST, DISTANCE_SINCE_START)
    first, last = trip_bounds(bare)
    np.testing.assert_array_equal(ours.channels[FIRST], first)
    np.testing.assert_array_equal(ours.channels[LAST], last)
    np.testing.assert_allclose(
        ours.channels[DISTANCE_SINCE_START][: len(s)], distance_since_start(bare)[: len(s)], rtol=1e-12
    )


def test_energy_is_that_of_a_plain_reference(perfect):
    """Paper 1, equations 3 to 5, in NumPy, with the map by SciPy: nothing shared but the table of variants."""
    for v in perfect.vehicles:
        s, t, car = v.segments, v.truth, v.variant
        mass, slope = s.channels["mass_kg"], s.channels["grade_rad"]
        accel = (s.speed_end_mps - s.speed_start_mps) / s.duration_s
        square = (s.speed_end_mps**2 + s.speed_start_mps**2) / 2
        force = mass * (1.04 * accel + 9.80665 * (np.sin(slope) + car.true_c_rr * np.cos(slope)))
        force = force + 0.5 * 1.225 * car.true_cda_m2 * square
        gear = s.channels["gear"].astype(int)
        ratio = np.array(car.gear_ratios)[gear - 1] * car.final_drive / car.wheel_radius_m
        _, speeds, torques, values = efficiency_map(car)
        omega, torque = s.distance_m / s.duration_s * ratio, force / ratio
        eta = np.array([
            map_by_scipy(speeds, torques, values[g - 1], w, m) for g, w, m in zip(gear, omega, torque, strict=True)
        ])  # fmt: skip
        wheel = force * s.distance_m
        energy = (np.where(wheel > 0, wheel / eta, wheel * eta) + car.auxiliary_w * s.duration_s) / 3600
        np.testing.assert_allclose(v.energy_wh, energy, rtol=1e-9, atol=1e-9)
        moves = s.distance_m > 0
        np.testing.assert_allclose(t["efficiency"][moves], eta[moves], rtol=1e-9)
        np.testing.assert_allclose(t["tabular_wh"], energy, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(t["tabular_wheel_wh"], wheel / 3600, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(t["requested_torque_nm"][moves], (force * car.wheel_radius_m)[moves], rtol=1e-9)


def test_a_switch_changes_nothing_but_its_own(fleet):
    """Without a wind the same roads are driven at the same speeds by the same vehicles, less its part of the energy."""
    (b,) = simulate({**SMALL, "variants": ["A"], "routes": 2, "truth": {"headwind": False}}).vehicles
    a = fleet["A"]
    np.testing.assert_array_equal(a.segments.speed_end_mps, b.segments.speed_end_mps)
    np.testing.assert_array_equal(a.segments.channels["mass_kg"], b.segments.channels["mass_kg"])
    assert {k: p for k, p in a.effects.items() if k != "headwind"} == b.effects
    np.testing.assert_allclose(a.truth["energy_wh:rolling"], b.truth["energy_wh:rolling"], rtol=1e-12)
    assert "energy_wh:headwind" not in b.truth


def test_the_same_seed_and_another(fleet):
    again = simulate({**SMALL, "variants": ["A", "bus_12m_2speed"], "routes": 4})
    for v in again.vehicles:  # a vehicle's rows do not depend on which others there are
        for k, x in fleet[v.id].truth.items():
            np.testing.assert_array_equal(v.truth[k], x)
        np.testing.assert_array_equal(v.energy_wh, fleet[v.id].energy_wh)
    other = simulate({**SMALL, "seed": 6, "variants": ["A"], "routes": 2})
    assert len(other["A"]) != len(fleet["A"]) or not np.array_equal(other["A"].energy_wh, fleet["A"].energy_wh)


def test_columns_of_the_whole_fleet(fleet):
    n = len(fleet)
    assert n == sum(len(v) for v in fleet.vehicles)
    trip, vehicle, gear = fleet.column("trip"), fleet.column("vehicle"), fleet.column("truth:gear")
    assert trip.shape == vehicle.shape == gear.shape == fleet.column("mass_kg").shape == (n,)
    assert len(np.unique(trip)) == SMALL["routes"]
    assert all(len(np.unique(vehicle[trip == k])) == 1 for k in np.unique(trip))
    np.testing.assert_array_equal(gear, fleet.column("gear"))
    with pytest.raises(KeyError):
        fleet["Z"]


# --- gears ---


def test_gears_follow_the_program_with_memory(perfect):
    """A Python loop over rows, from the lines alone."""
    for v in perfect.vehicles:
        t, trip = v.truth, np.asarray(v.segments.trip)
        gear = 1
        for i in range(len(v)):
            low, high = t["gear_lowest"][i], t["gear_highest"][i]
            first = i == 0 or trip[i] != trip[i - 1]
            gear = low if first else min(max(gear, low), high)
            assert gear == t["gear"][i]
            assert t["gear_previous"][i] == (gear if first else t["gear"][i - 1])
            assert low <= t["gear_static"][i] <= high
        speed = v.segments.distance_m / v.segments.duration_s
        assert np.all((t["shift_down_mps"] < speed) | (t["gear"] == 1))
        assert np.all(speed <= t["shift_up_mps"])
        assert t["gear"].max() <= v.variant.gears
        assert np.all(t["gear"][speed == 0] == 1)


@eqx.filter_jit
def lines_of(program, speed, load, grade):
    return jax.vmap(lambda *row: shift_lines(program, *row))(speed, load, grade)


def test_hysteresis_is_what_the_config_says():
    v = variant("C")
    speed = jnp.asarray(np.linspace(0.0, 25.0, 400))
    zero = jnp.zeros_like(speed)
    none = shift_program(v, parse_config({"seed": 1, "gears": {"hysteresis": 0.0, "hysteresis_load": 0.0}}))
    lines = lines_of(none, speed, zero, zero)
    np.testing.assert_array_equal(lines.lowest, lines.highest)
    wide = lines_of(shift_program(v, parse_config({"seed": 1, "gears": {"hysteresis": 0.2}})), speed, zero, zero)
    np.testing.assert_allclose(wide.up_mps[0, :3] - wide.down_mps[0, :3], 0.2 * wide.center_mps[0, :3], rtol=1e-12)
    assert np.all(np.isinf(wide.up_mps[:, 3:]))
    assert np.all(np.diff(np.asarray(lines.static)) >= 0)
    assert set(np.unique(lines.static)) == {1, 2, 3, 4}
    uphill = lines_of(none, speed, zero, zero + 0.06)
    loaded = lines_of(none, speed, zero + 0.8, zero)
    assert np.all(uphill.static <= lines.static)
    assert np.any(uphill.static < lines.static)
    assert np.all(loaded.static <= lines.static)
    assert np.any(loaded.static < lines.static)
    assert float(load_share(none, jnp.asarray(1e4), jnp.asarray(10.0))) == pytest.approx(1e5 / (v.power_kw * 1e3))


def test_engaged_holds_between_the_lines():
    low, high = jnp.array([1, 1, 2, 3, 1, 1, 1]), jnp.array([3, 2, 4, 4, 4, 2, 5])
    starts = jnp.array([True, False, False, False, False, False, True])
    np.testing.assert_array_equal(engaged(low, high, starts), [1, 1, 2, 3, 3, 2, 1])


# --- driving ---


def driven(v, *, grade=0.0, cap=20.0, mass=None, metres=4000.0, stop_at=None, friction=0.7, accel=0.8, share=0.5):
    """One route of constant slope and cap, ending in a halt."""
    steps = round(metres / STEP_M)
    caps = np.full((steps + 1, 1), cap)
    caps[-1] = 0.0
    if stop_at is not None:
        caps[round(stop_at / STEP_M)] = 0.0
    one = np.ones((steps, 1))
    row = np.ones(1)
    roads = Roads(*(jnp.asarray(x) for x in (caps, grade * one, (mass or v.mass_kg[1]) * one, accel * row, 0.9 * one,
                                             friction * row, row)))  # fmt: skip
    numbers = (v.true_c_rr, 0.5 * 1.225 * v.true_cda_m2, 1.04, v.torque_nm, share, 0.5, 2.0)
    car = Car(*(jnp.asarray(x) for x in numbers), shift_program(v, FleetConfig()))
    return jax.tree.map(np.asarray, eqx.filter_jit(drive)(car, roads))


def test_a_halt_is_a_halt_and_braking_is_comfortable():
    v = variant("bus_12m_2speed")
    d = driven(v, cap=14.0, metres=1000.0, stop_at=500.0)
    speed = d.speed_mps[:, 0]
    at = round(500.0 / STEP_M)
    assert speed[0] == speed[at] == speed[-1] == 0.0
    assert np.all(speed <= 14.0 + 1e-9)
    assert speed[at - 1] > 0.5
    decel = -np.diff(speed**2) / (2 * STEP_M)
    assert decel.max() < 0.9 + 1e-6
    np.testing.assert_allclose(d.step_s[:, 0].sum(), np.sum(2 * STEP_M / np.maximum(speed[1:] + speed[:-1], 1e-9)))


def test_work_at_the_wheels_is_what_the_drive_costs():
    """From standstill to standstill on a slope: work is height, rolling and air, and nothing of the inertia."""
    v = variant("C")
    d = driven(v, grade=0.01, cap=15.0)
    mass, metres = v.mass_kg[1], 4000.0
    still = mass * 9.80665 * (np.sin(0.01) + v.true_c_rr) * metres
    air = np.sum(0.5 * 1.225 * v.true_cda_m2 * d.speed_mps[:-1, 0] ** 2) * STEP_M
    np.testing.assert_allclose(np.sum(d.force_n) * STEP_M, still + air, rtol=1e-9)


def test_on_a_long_hill_the_motor_is_the_limit():
    """The speed at which rated power balances the forces, by SciPy's root."""
    from scipy.optimize import brentq

    v = variant("A")
    d = driven(v, grade=0.05, cap=24.0, metres=6000.0)
    mass = v.mass_kg[1]

    def spare(speed):
        road = mass * 9.80665 * (np.sin(0.05) + v.true_c_rr) + 0.5 * 1.225 * v.true_cda_m2 * speed**2
        return 0.9 * v.power_kw * 1e3 - road * speed

    # between shifts: without torque for half a second now and then, and in one gear or the next
    assert np.median(d.speed_mps[400:1000, 0]) == pytest.approx(brentq(spare, 3.0, 24.0), rel=0.05)
    assert np.max(d.force_n[:, 0] * d.speed_mps[:-1, 0]) <= 0.9 * v.power_kw * 1e3 * 1.001


def test_on_ice_the_wheels_are_the_limit():
    v = variant("tractor_4x2_40t_2speed")
    dry = driven(v, cap=20.0, share=0.3, metres=1000.0)
    ice = driven(v, cap=20.0, share=0.3, metres=1000.0, friction=0.1)
    most = 0.1 * 0.3 * v.mass_kg[1] * 9.80665
    assert ice.force_n.max() == pytest.approx(most, rel=1e-6)
    assert dry.force_n.max() > most
    assert ice.step_s.sum() > dry.step_s.sum()


def test_speeds_of_the_fleet_are_those_of_vehicles(perfect):
    for v in perfect.vehicles:
        s, t = v.segments, v.truth
        assert np.all(s.speed_end_mps <= 1.12 * t["limit_mps"] + 1.0)
        steady = (s.distance_m > 0) & (t["shifts"] == 0)
        power = t["motor_torque_nm"] * t["motor_speed_radps"]
        assert np.max(power[steady]) < 1.35 * v.variant.power_kw * 1e3  # a row's means are not its drive's limits
        inside = np.diff(s.trip, append=-1) == 0
        np.testing.assert_array_equal(s.speed_end_mps[inside], s.speed_start_mps[1:][inside[:-1]])
        np.testing.assert_allclose((s.time_s + s.duration_s)[inside], s.time_s[1:][inside[:-1]])
        halts = s.distance_m == 0
        assert halts.any()
        assert np.all(s.speed_start_mps[halts] == 0)
        assert np.all(s.speed_end_mps[halts] == 0)
        last = np.flatnonzero(~inside)
        assert np.all(s.speed_end_mps[last] == 0)


# --- files ---


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    root = tmp_path_factory.mktemp("fleet")
    config = root / "fleet.toml"
    names = ", ".join(f'"{v}"' for v in CHOSEN)
    config.write_text(f"seed = 5\nroutes = 6\nsegments_per_route = 40\nvariants = [{names}]\n")
    assert cli.main(["simulate", str(config), "--out", str(root / "a")]) == 0
    return root


def test_the_files_hold_the_fleet(fleet, folder):
    out = folder / "a"
    for v in fleet.vehicles:
        log = pd.read_parquet(out / "log.parquet" / f"{v.id}.parquet")
        truth = pd.read_parquet(out / "truth.parquet" / f"{v.id}.parquet")
        assert set(log["vehicle_id"]) == {v.id}
        np.testing.assert_array_equal(log["energy_wh"], v.energy_wh)
        np.testing.assert_array_equal(truth["gear"], v.truth["gear"])
        np.testing.assert_array_equal(truth["trip_id"], log["trip_id"])
        np.testing.assert_allclose(truth["energy_true_wh"], v.truth["energy_true_wh"])
    whole = pd.read_parquet(out / "log.parquet")
    assert len(whole) == len(fleet)
    summary = json.loads((out / "fleet.json").read_text())
    assert summary["rows"] == len(fleet)
    assert summary["synthetic"] is True
    error = 100 * (fleet.column("truth:tabular_wh").sum() / fleet.column("energy_wh").sum() - 1)
    assert summary["tabular"]["pe_percent"] == pytest.approx(error)
    page = (out / "report.html").read_text()
    assert "synthetic" in page
    assert "http" not in page
    figures = {p.stem for p in (out / "figures").iterdir()}
    assert figures == {"routes", "cycles", "consumption", "gears", "energy", "errors"}


def test_the_sheet_predicts_what_the_truth_says_it_does(folder):
    """Through the files alone: the log and the sheet as any user's, through the reader and the sheet's builder."""
    log = read_log(folder / "a" / "log.parquet" / "A.parquet")
    built = build(read_sheet(folder / "a" / "sheets" / "A.toml"), log.segments, "road", "energy_wh")
    truth = pd.read_parquet(folder / "a" / "truth.parquet" / "A.parquet")
    predicted = eqx.filter_jit(lambda vehicle, segments: vehicle.energy(segments))(
        built.vehicle, jax.tree.map(jnp.asarray, log.segments)
    )
    np.testing.assert_allclose(predicted, truth["tabular_wh"], rtol=1e-6, atol=1e-6)
    assert {c.name for c in built.table.free} == {"road.c_rr", "road.cda_m2"}


def test_a_killed_run_goes_on_to_the_same_bytes_and_done_is_done(folder, capsys, monkeypatch):
    config, write, written = folder / "fleet.toml", files._write_vehicle, []

    def killed(config, part, kept):
        if len(written) == 2:
            raise KeyboardInterrupt
        written.append(part.variant.id)
        return write(config, part, kept)

    monkeypatch.setattr(files, "_WORKERS", 1)
    monkeypatch.setattr(files, "_write_vehicle", killed)
    assert cli.main(["simulate", str(config), "--out", str(folder / "b")]) == 130
    assert not (folder / "b").exists()
    first = list(written)
    monkeypatch.setattr(files, "_write_vehicle", lambda c, p, k: (written.append(p.variant.id), write(c, p, k))[1])
    capsys.readouterr()
    assert cli.main(["simulate", str(config), "--out", str(folder / "b")]) == 0
    assert sorted(written) == sorted(CHOSEN), "what was finished is not simulated again"
    assert len(first) == 2
    first = capsys.readouterr().out
    for path in sorted((folder / "a").rglob("*")):  # the figures of the first run alone are drawn
        unlike = path.parent.name == "figures" or path.name in ("environment.json", "report.html", "answer.txt")
        if path.is_file() and not unlike:
            assert path.read_bytes() == (folder / "b" / path.relative_to(folder / "a")).read_bytes(), path.name
    before = {p: p.stat().st_mtime_ns for p in (folder / "b").rglob("*")}
    assert cli.main(["simulate", str(config), "--out", str(folder / "b")]) == 0
    assert capsys.readouterr().out == first
    assert {p: p.stat().st_mtime_ns for p in (folder / "b").rglob("*")} == before


def test_check_reads_the_whole_fleet_as_one_log(folder, capsys):
    assert cli.main(["check", str(folder / "a" / "log.parquet")]) == 0
    assert f"{SMALL['routes']} trips, {len(CHOSEN)} vehicles" in capsys.readouterr().out
