"""The vehicle sheet: what is refused, what each entry and target uses, and the way there and back through TOML."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from hdev_jax.errors import InputError
from hdev_jax.inference import ParameterTable
from hdev_jax.inference.maps.read import read_map
from hdev_jax.inference.sheet import (
    Sheet,
    augmented_sheet,
    build,
    choose_entry,
    read_sheet,
    traction_force_from_torque,
)
from hdev_jax.physics import LIBRARY, EfficiencyMap, Grouped, at_null
from hdev_jax.segments import Segments
from hdev_jax.units import GRAVITY_MPS2

CONFIGS = Path(__file__).parents[2] / "configs" / "vehicles"
ROAD = "mass_kg = 24000.0\n[road]\nc_rr = { value = 0.006, sd = 0.0008 }\ncda_m2 = { value = 5.6, sd = 0.5 }\n"
GEARS = "gear_ratios = [9.16, 5.27, 3.33, 2.16]\nfinal_drive = 4.5\nwheel_radius_m = 0.5\n"
DRIVELINE = "[driveline]\nefficiency = 0.91\n" + GEARS
MACHINE = (
    "[machine]\nmotoring_efficiency = { value = 0.93, sd = 0.05 }\n"
    "regenerating_efficiency = { value = 0.9, sd = 0.04 }\n"
)
BATTERY = "[battery]\nauxiliary_w = { value = 900.0, sd = 300.0 }\n"
FULL = ROAD + DRIVELINE + MACHINE + BATTERY
BRAKING_ALONE = "regenerating_efficiency = 0.9\n"
SIGNALS = ("motor_torque_nm", "motor_speed_radps", "traction_force_n", "gear", "mass_kg", "grade_rad")


def a_log(*channels: str, vehicles: int = 1, rows: int = 60, seed: int = 0) -> Segments:
    """Rows of driving and braking with these channels; vehicles one after the other."""
    rng = np.random.default_rng(seed)
    ids = np.sort(np.arange(rows) % vehicles)
    speed = 12.0 + 6.0 * np.sin(np.arange(rows + 1) / 7.0)
    drawn = {
        "motor_torque_nm": 300.0 * rng.standard_normal(rows),
        "motor_speed_radps": 10.0 * speed[:-1],
        "traction_force_n": 6e3 * rng.standard_normal(rows),
        "gear": rng.integers(1, 5, rows).astype(float),
        "mass_kg": np.full(rows, 31e3),
        "grade_rad": 0.02 * rng.standard_normal(rows),
        "ambient_temp_c": 10.0 + 10.0 * rng.random(rows),
        "accel_mps2": rng.standard_normal(rows),
    }
    mean = 0.5 * (speed[1:] + speed[:-1])
    return Segments(
        ids,
        ids,
        np.arange(rows) * 5.0,
        np.full(rows, 5.0),
        5.0 * mean,
        speed[:-1],
        speed[1:],
        {c: drawn[c] for c in channels},
    )


@pytest.fixture
def sheet(tmp_path):
    def write(text: str, name: str = "truck.toml"):
        path = tmp_path / name
        path.write_text(text, encoding="utf-8")
        return read_sheet(path)

    return write


def refusal(call, *args) -> str:
    with pytest.raises(InputError) as caught:
        call(*args)
    message = str(caught.value)
    assert "\n" not in message
    return message


# --- refused when read ----------------------------------------------------------------------------------------------

REFUSED = {
    "unknown key": ("[road]\nc_r = 0.006", ["road.c_r", "unknown", "did you mean 'c_rr'", "cda_m2"]),
    "unknown section": ("[raod]\nc_rr = 0.006", ["raod", "did you mean 'road'", "driveline"]),
    "unknown top key": ("mass = 2000.0", ["mass", "did you mean 'mass_kg'"]),
    "key of a section at the top": ("c_rr = 0.006", ["c_rr", "[road]"]),
    "section that is a number": ("road = 5", ["road", "found 5", "[road]"]),
    "negative mass": ("mass_kg = -5.0", ["mass_kg", "-5", "above 0"]),
    "zero mass": ("mass_kg = 0", ["mass_kg", "found 0", "above 0"]),
    "negative mass with sd": ("mass_kg = { value = -5.0, sd = 1.0 }", ["mass_kg.value", "-5", "above 0"]),
    "sd of 0": ("[road]\nc_rr = { value = 0.006, sd = 0.0 }", ["road.c_rr.sd", "found 0.0", "above 0"]),
    "negative sd": ("[road]\nc_rr = { value = 0.006, sd = -0.1 }", ["road.c_rr.sd", "-0.1"]),
    "sd as text": ("[road]\nc_rr = { value = 0.006, sd = 'small' }", ["road.c_rr.sd", "'small'"]),
    "sd NaN": ("[road]\nc_rr = { value = 0.006, sd = nan }", ["road.c_rr.sd", "nan"]),
    "sd infinite": ("[road]\nc_rr = { value = 0.006, sd = inf }", ["road.c_rr.sd", "inf"]),
    "sd true": ("[road]\nc_rr = { value = 0.006, sd = true }", ["road.c_rr.sd", "true"]),
    "std for sd": ("[road]\nc_rr = { value = 0.006, std = 0.1 }", ["road.c_rr.std", "did you mean 'sd'"]),
    "no value": ("[road]\nc_rr = { sd = 0.1 }", ["road.c_rr", "value"]),
    "empty table": ("[road]\nc_rr = {}", ["road.c_rr", "value"]),
    "value as text": ("[road]\nc_rr = '0.006'", ["road.c_rr", "'0.006'", "number"]),
    "value true": ("[road]\nc_rr = true", ["road.c_rr", "true", "number"]),
    "value a list": ("[road]\nc_rr = [0.006, 0.007]", ["road.c_rr", "list", "number"]),
    "value a date": ("[road]\nc_rr = 2024-03-05", ["road.c_rr", "2024-03-05", "number"]),
    "value NaN": ("[road]\nc_rr = nan", ["road.c_rr", "nan"]),
    "value beyond floats": ("mass_kg = 1" + 400 * "0", ["mass_kg", "number"]),
    "more digits than Python converts": ("mass_kg = 1" + 5000 * "0", ["TOML"]),
    "negative c_rr": ("[road]\nc_rr = -0.006", ["road.c_rr", "-0.006", "0 or more"]),
    "c_rr in N/kN": ("[road]\nc_rr = 6.0", ["road.c_rr", "6.0", "up to 0.5"]),
    "negative cda": ("[road]\ncda_m2 = { value = -1.0, sd = 0.5 }", ["road.cda_m2.value", "-1", "0 or more"]),
    "efficiency 0": ("[driveline]\nefficiency = 0.0", ["driveline.efficiency", "above 0 and up to 1"]),
    "efficiency in percent": ("[machine]\nmotoring_efficiency = 93", ["motoring_efficiency", "93", "up to 1"]),
    "efficiency above 1": ("[machine]\nregenerating_efficiency = 1.01", ["regenerating_efficiency", "1.01", "up to 1"]),
    "gear_ratios a number": ("[driveline]\ngear_ratios = 9.16", ["driveline.gear_ratios", "9.16", "list"]),
    "gear_ratios empty": ("[driveline]\ngear_ratios = []", ["driveline.gear_ratios", "list"]),
    "gear_ratios with 0": ("[driveline]\ngear_ratios = [9.16, 0.0]", ["driveline.gear_ratios[2]", "above 0"]),
    "gear_ratios with text": ("[driveline]\ngear_ratios = [9.16, 'x']", ["driveline.gear_ratios[2]", "'x'"]),
    "wheel radius with sd": ("[driveline]\nwheel_radius_m = { value = 0.5, sd = 0.1 }", ["wheel_radius_m", "number"]),
    "final drive 0": ("[driveline]\nfinal_drive = 0.0", ["driveline.final_drive", "above 0"]),
    "braking alone": ("[driveline]\n" + BRAKING_ALONE, ["driveline.regenerating_efficiency", "efficiency or map"]),
    "no voltage": ("[battery]\nnominal_voltage_v = 0.0", ["battery.nominal_voltage_v", "above 0"]),
    "number and map": ("[driveline]\nefficiency = 0.9\nmap = 'm.csv'", ["driveline.efficiency", "driveline.map"]),
    "map a number": ("[driveline]\nmap = 3", ["driveline.map", "found 3", "CSV"]),
    "map missing": ("[driveline]\nmap = 'nowhere.csv'", ["nowhere.csv", "no such file"]),
    "name a number": ("name = 5", ["name", "found 5", "text"]),
    "syntax": ("[road]\nc_rr = \n", ["TOML", "line 2"]),
    "key twice": ("[road]\nc_rr = 0.006\nc_rr = 0.007\n", ["TOML", "line 3"]),
    "a log": ("time_s,speed_mps\n0,1\n", ["TOML", "line 1"]),
    "unknown effect": ("[effects.headwnd]\nscale = 1.0", ["effects.headwnd", "did you mean 'headwind'"]),
    "declared effect": ("[effects.rolling]\nc_rr = 0.006", ["effects.rolling", "unknown effect"]),
    "unknown parameter": ("[effects.headwind]\nscal = 1.0", ["effects.headwind.scal", "did you mean 'scale'"]),
    "effect a number": ("[effects]\nheadwind = 1.0", ["effects.headwind", "section"]),
    "effects a number": ("effects = 1.0", ["effects", "section"]),
    "effect without parameters": ("[effects.headwind]", ["effects.headwind", "scale"]),
    "effect at its null": ("[effects.headwind]\nscale = 0.0", ["effects.headwind", "scale", "not 0"]),
    "effect with shapes only": ("[effects.tyre_warmup]\ndistance_m = 5000.0", ["effects.tyre_warmup", "excess"]),
    "a linear force twice": (
        "[road]\nb_n_per_mps = 5.0\n[effects.rolling_linear]\nn_per_mps = 5.0",
        ["road.b_n_per_mps", "effects.rolling_linear.n_per_mps", "one of them"],
    ),
    "shape out of range": (
        "[effects.cabin_warmup]\npower_w = 900.0\ntau_s = -3.0", ["effects.cabin_warmup.tau_s", "-3", "60 or more"],
    ),
    "effect with sd 0": (
        "[effects.headwind]\nscale = { value = 1.0, sd = 0 }", ["effects.headwind.scale.sd", "above 0"],
    ),
    "by gear with text": ("[effects.gear_efficiency]\ndelta = { 1 = 'x' }", ["effects.gear_efficiency.delta.1", "'x'"]),
    "per_vehicle a number": (
        "[road]\nc_rr = { value = 0.006, sd = 0.1, per_vehicle = 1 }", ["per_vehicle", "true or false"],
    ),
    "per_vehicle without sd": ("[road]\nc_rr = { value = 0.006, per_vehicle = true }", ["road.c_rr", "without an sd"]),
    "vehicles without per_vehicle": (
        "[road]\nc_rr = { value = 0.006, vehicles = { A = 0.007 } }", ["per_vehicle = true"],
    ),
    "per_vehicle across rows": (
        "[effects.time_skew]\nskew_s = { value = 1.0, sd = 0.1, per_vehicle = true }",
        ["effects.time_skew.skew_s", "all vehicles"],
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_refused(case, sheet):
    text, parts = REFUSED[case]
    message = refusal(sheet, text)
    for part in ["truck.toml" if case != "map missing" else "nowhere.csv", *parts]:
        assert part in message


def test_files_that_cannot_be_read(tmp_path):
    assert "no such file" in refusal(read_sheet, tmp_path / "nothing.toml")
    assert "cannot be read" in refusal(read_sheet, tmp_path)
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00\x01")
    assert "cannot be read" in refusal(read_sheet, tmp_path / "binary.toml")


def test_plain_number_and_value_and_texts_are_taken(sheet):
    read = sheet("\ufeffname = 'A'\nsource = 'B'\nnotes = 'C'\nmass_kg = 2000\n[road]\nc_rr = { value = 0.01 }\n")
    assert (read.name, read.source, read.notes) == ("A", "B", "C")
    assert (read.declared["mass_kg"].value, read.declared["mass_kg"].sd) == (2000.0, None)
    assert (read.declared["road.c_rr"].value, read.declared["road.c_rr"].sd) == (0.01, None)
    assert sheet("").name == "truck"


# --- efficiency maps ------------------------------------------------------------------------------------------------

HEADER = "gear,motor_speed_radps,motor_torque_nm,efficiency\n"
POINTS = [
    f"{g},{s},{t},{0.8 + 0.01 * g + 1e-4 * s - 1e-5 * t}" for g in (1, 2) for s in (0, 200) for t in (-500, 0, 500)
]
MAPS = {
    "hole": (HEADER + "\n".join(POINTS[:-1]), ["hole", "gear 2, 200 rad/s, 500 Nm"]),
    "two holes": (HEADER + "\n".join(POINTS[1:-1]), ["hole", "gear 1, 0 rad/s, -500 Nm", "1 more"]),
    "text": (HEADER + "1,0,x,0.9\n", ["line 2", "motor_torque_nm", "'x'"]),
    "no cell": (HEADER + "1,0,0\n", ["line 2", "efficiency", "nothing"]),
    "NaN": (HEADER + "1,0,0,nan\n", ["line 2", "efficiency", "'nan'"]),
    "above 1": (HEADER + "1,0,0,1.2\n", ["line 2", "1.2", "up to 1"]),
    "zero": (HEADER + "1,0,0,0\n", ["line 2", "above 0"]),
    "twice": (HEADER + "1,0,0,0.9\n\n1,0,0,0.8\n", ["line 4", "twice"]),
    "column": (HEADER.replace("radps", "rads"), ["did you mean 'motor_speed_rads'", "motor_speed_radps"]),
    "empty": ("", ["empty"]),
    "no rows": (HEADER, ["no rows"]),
}  # fmt: skip


@pytest.mark.parametrize("case", MAPS)
def test_maps_refused(case, sheet, tmp_path):
    text, parts = MAPS[case]
    (tmp_path / "efficiency.csv").write_text(text)
    message = refusal(sheet, "[driveline]\nmap = 'efficiency.csv'\n")
    for part in ["efficiency.csv", *parts]:
        assert part in message


def test_map_is_read_in_any_order_and_beside_the_sheet(sheet, tmp_path):
    (tmp_path / "efficiency.csv").write_text(HEADER.replace(",", ";") + "\n".join(POINTS[::-1]).replace(",", ";"))
    found = sheet("[driveline]\nmap = 'efficiency.csv'\n").efficiency_map
    assert isinstance(found, EfficiencyMap)
    np.testing.assert_allclose(found(2.0, 100.0, 250.0), 0.8 + 0.02 + 0.01 - 0.0025, rtol=1e-12)


def test_map_by_gear_alone(tmp_path):
    (tmp_path / "m.csv").write_text(HEADER + "1,0,0,0.9\n2,0,0,0.95\n")
    found = read_map(tmp_path / "m.csv")
    assert [float(found(g, 300.0, -80.0)) for g in (1.0, 2.0)] == pytest.approx([0.9, 0.95])


def test_vehicle_with_a_map_uses_it(sheet, tmp_path):
    (tmp_path / "m.csv").write_text(HEADER + "\n".join(f"{g},0,0,{0.9 + 0.01 * g}" for g in range(1, 5)))
    log = a_log("gear")
    text = ROAD + "[driveline]\nmap = 'm.csv'\n" + GEARS
    built = build(sheet(text), log, "road", "energy_wh")
    lossless = build(sheet(ROAD + "[driveline]\nefficiency = 1.0\n" + GEARS), log, "road", "energy_wh")
    wheel, battery = lossless.vehicle.power(log), np.asarray(built.vehicle.power(log))
    eta = 0.9 + 0.01 * log.channels["gear"]
    np.testing.assert_allclose(battery, np.where(wheel > 0, wheel / eta, wheel * eta), rtol=1e-9)
    assert built.notes == []
    assert not any(c.path.startswith("driveline") for c in built.table.rows)
    bare = build(sheet(ROAD + "[driveline]\nmap = 'm.csv'\n"), log, "road", "energy_wh")
    assert len(bare.notes) == 2
    assert "wheel radius of 0.478 m" in bare.notes[1]
    no_gear = build(sheet(text), a_log(), "road", "energy_wh")
    assert any("no column 'gear'" in n for n in no_gear.notes)


# --- where the chain is entered -------------------------------------------------------------------------------------


@pytest.mark.parametrize("target", ["energy_wh", "battery_power_kw", "motor_torque_nm", "traction_force_n"])
def test_entry_is_the_measured_quantity_nearest_the_target(target, sheet):
    shaft, force = ("motor_torque_nm", "motor_speed_radps"), ("traction_force_n",)
    expected = {
        (): "road",
        shaft: "shaft" if target in ("energy_wh", "battery_power_kw") else "road",
        force: "road" if target == "traction_force_n" else "wheel",
        ("motor_torque_nm", *force): "road" if target == "traction_force_n" else "wheel",
    }
    for channels, entry in expected.items():
        assert choose_entry(a_log(*channels), target, sheet(ROAD + MACHINE)) == entry


def test_torque_alone_will_do_where_the_sheet_tells_the_motors_speed(sheet):
    log = a_log("motor_torque_nm", "gear")
    truck = sheet(FULL)
    assert choose_entry(log, "energy_wh", truck) == "shaft"
    assert choose_entry(log, "motor_torque_nm", truck) == "road"
    built = build(truck, log, "shaft", "energy_wh")
    assert any(n.startswith("motor_speed_radps is not logged") for n in built.notes)
    ratio = np.array([9.16, 5.27, 3.33, 2.16])[np.asarray(log.channels["gear"]).astype(int) - 1] * 4.5 / 0.5
    told = log.with_channels(motor_speed_radps=np.asarray(log.speed_mps) * ratio)
    measured = build(truck, told, "shaft", "energy_wh")
    np.testing.assert_allclose(built.vehicle.energy(log), measured.vehicle.energy(told), rtol=1e-12)
    assert not any("motor_speed_radps" in n for n in measured.notes)


@pytest.mark.parametrize(
    ("text", "channels"),
    [
        (ROAD + "[driveline]\nefficiency = 0.91\n" + MACHINE, ("gear",)),
        (FULL.replace("wheel_radius_m = 0.5\n", ""), ("gear",)),
        (FULL, ()),
    ],
    ids=["no ratios", "no radius", "no gear in the log"],
)
def test_torque_alone_without_a_ratio_is_left_aside_with_a_note(text, channels, sheet):
    log = a_log("motor_torque_nm", *channels)
    assert choose_entry(log, "energy_wh", sheet(text)) == "road"
    built = build(sheet(text), log, "road", "energy_wh")
    assert sum(n.startswith("motor_torque_nm is not used") for n in built.notes) == 1
    message = refusal(build, sheet(text), log, "shaft", "energy_wh")
    assert "motor torque without motor speed" in message or "column 'gear'" in message


# --- what the log measures, and what the sheet has in its place -------------------------------------------------------


def test_the_declared_drag_uses_the_logs_density_and_says_so(sheet):
    text = FULL + "[effects.air_density]\nscale = 1.0\n"
    log = a_log("gear", "ambient_temp_c")
    dense = log.with_channels(air_density_kgpm3=np.full(len(log), 1.1))
    built = build(sheet(text), dense, "road", "traction_force_n")
    assert any("air_density_kgpm3 in place" in n for n in built.notes)
    assert any("effect air_density" in n and "the declared drag uses the log's air density" in n for n in built.notes)
    assert not built.vehicle.has("air_density")
    assert build(sheet(text), log, "road", "traction_force_n").vehicle.has("air_density")
    plain = build(sheet(FULL), log, "road", "traction_force_n").vehicle
    square = 0.5 * (np.asarray(log.speed_start_mps) ** 2 + np.asarray(log.speed_end_mps) ** 2)
    np.testing.assert_allclose(
        built.vehicle.force(dense) - plain.force(log), 0.5 * (1.1 - 1.225) * 5.6 * square, rtol=1e-9
    )


def test_the_sheets_voltage_stands_in_for_the_logs(sheet):
    text = FULL.replace("[battery]\n", "[battery]\nnominal_voltage_v = 640.0\n")
    text += "[effects.battery_resistance]\nresistance_ohm = 0.1\n"
    log = a_log("gear")
    built = build(sheet(text), log, "road", "energy_wh")
    assert any("nominal 640 V" in n for n in built.notes)
    assert built.vehicle.has("battery_resistance")
    power = np.asarray(build(sheet(FULL), log, "road", "energy_wh").vehicle.power(log))
    np.testing.assert_allclose(built.vehicle.power(log), power + 0.1 * (power / 640.0) ** 2, rtol=1e-9)
    volts = log.with_channels(voltage_v=np.full(len(log), 600.0))
    own = build(sheet(text), volts, "road", "energy_wh")
    assert any("nominal_voltage_v is not used" in n for n in own.notes)
    np.testing.assert_allclose(own.vehicle.power(volts), power + 0.1 * (power / 600.0) ** 2, rtol=1e-9)
    nothing = build(sheet(text.replace("nominal_voltage_v = 640.0\n", "")), log, "road", "energy_wh")
    assert not nothing.vehicle.has("battery_resistance")
    assert any("voltage_v or nominal_voltage_v" in n for n in nothing.notes)
    assert read_back(sheet, text).nominal_voltage_v == 640.0


BACK = "regenerating_efficiency = { value = 0.8, sd = 0.05 }\n"


def test_braking_may_have_an_efficiency_of_its_own(sheet):
    text = FULL.replace("efficiency = 0.91\n", "efficiency = 0.91\n" + BACK, 1)
    log = a_log("gear")
    built = build(sheet(text), log, "road", "battery_power_kw")
    force = np.asarray(build(sheet(FULL), log, "road", "traction_force_n").vehicle.force(log))
    power = force * np.asarray(log.speed_mps)
    at_battery = np.where(power > 0, power / 0.91, power * 0.8) + 900
    np.testing.assert_allclose(built.vehicle.power(log), at_battery, rtol=1e-9)
    row = {c.path: c for c in built.table.rows}["driveline.regenerating_efficiency"]
    assert (row.value, row.sd, row.free) == (0.8, 0.05, True)
    changed = built.table.insert(built.vehicle, built.table.values(built.vehicle) * 0.9)
    assert float(changed.driveline.regenerating_efficiency) == pytest.approx(0.72)
    assert read_back(sheet, text).declared["driveline.regenerating_efficiency"].value == 0.8


def test_the_derived_force_uses_it_too(sheet):
    text = ROAD + DRIVELINE.replace("efficiency = 0.91\n", "efficiency = 0.91\n" + BACK)
    log = a_log("motor_torque_nm", "gear")
    one, two = (traction_force_from_torque(log, sheet(x)) for x in (ROAD + DRIVELINE, text))
    braking = np.asarray(log.channels["motor_torque_nm"]) < 0
    np.testing.assert_allclose(two, np.where(braking, one * 0.91 / 0.8, one), rtol=1e-12)


def read_back(sheet, text):
    """The sheet after a way out and in again."""
    return sheet(augmented_sheet(sheet(text), {}, {}), "again.toml")


# --- which sections are used ----------------------------------------------------------------------------------------

USED = {  # (entry, target): coefficients of the table, and what the notes speak of
    ("road", "energy_wh"): (
        ["driveline.efficiency", "road.c_rr", "road.cda_m2", "mass_kg", "battery.auxiliary_w"], ["[machine]"],
    ),
    ("wheel", "battery_power_kw"): (
        ["machine.motoring_efficiency", "machine.regenerating_efficiency", "battery.auxiliary_w"],
        ["[machine] covers", "[road]", "driveline.efficiency"],
    ),
    ("shaft", "energy_wh"): (
        ["machine.motoring_efficiency", "machine.regenerating_efficiency", "battery.auxiliary_w"],
        ["[road]", "driveline.efficiency"],
    ),
    ("road", "traction_force_n"): (
        ["road.c_rr", "road.cda_m2", "mass_kg"], ["driveline.efficiency", "[machine]", "[battery]"],
    ),
    ("road", "motor_torque_nm"): (
        ["driveline.efficiency", "road.c_rr", "road.cda_m2", "mass_kg"], ["[machine]", "[battery]"],
    ),
    ("wheel", "motor_torque_nm"): ([], ["[road]", "driveline.efficiency", "[machine]", "[battery]"]),
}  # fmt: skip


@pytest.mark.parametrize(("entry", "target"), USED)
def test_only_the_sections_in_use(entry, target, sheet):
    paths, notes = USED[entry, target]
    log = a_log("motor_torque_nm", "motor_speed_radps", "traction_force_n", "gear")
    built = build(sheet(FULL), log, entry, target)
    assert [c.path for c in built.table.rows] == paths
    assert all(any(n.startswith(part) for n in built.notes) for part in notes)
    assert len(built.notes) == len(notes)
    assert [c.free for c in built.table.rows] == [p not in ("mass_kg", "driveline.efficiency") for p in paths]
    assert np.all(np.isfinite(built.vehicle.predict(log, target)))
    assert isinstance(built.table, ParameterTable)


NEEDED = [
    ("road", "energy_wh", DRIVELINE, "road.c_rr"),
    ("road", "energy_wh", "mass_kg = 9.0\n[road]\nc_rr = 0.006\n" + DRIVELINE, "road.cda_m2"),
    ("road", "energy_wh", ROAD, "driveline.efficiency"),
    ("road", "energy_wh", ROAD + "[machine]\nmotoring_efficiency = 0.9\n", "machine.regenerating_efficiency"),
    ("road", "energy_wh", FULL.replace("mass_kg = 24000.0\n", ""), "mass_kg"),
    ("wheel", "energy_wh", ROAD + DRIVELINE, "machine.motoring_efficiency"),
    ("shaft", "battery_power_kw", "[machine]\nmotoring_efficiency = 0.9\n", "machine.regenerating_efficiency"),
    ("road", "traction_force_n", DRIVELINE, "road.c_rr"),
    ("road", "motor_torque_nm", ROAD + "[driveline]\n" + GEARS, "driveline.efficiency"),
    ("road", "motor_torque_nm", FULL.replace("wheel_radius_m = 0.5\n", ""), "driveline.wheel_radius_m"),
    ("road", "motor_torque_nm", ROAD + "[driveline]\nefficiency = 0.9\n", "driveline.gear_ratios"),
    ("wheel", "motor_torque_nm", MACHINE, "driveline.gear_ratios"),
]


@pytest.mark.parametrize(("entry", "target", "text", "key"), NEEDED)
def test_a_needed_key_that_is_missing(entry, target, text, key, sheet):
    message = refusal(build, sheet(text), a_log("gear"), entry, target)
    assert "truck.toml" in message
    assert f"{key}" in message
    assert "needed because" in message


def test_no_note_on_the_efficiency_that_the_target_is_derived_with(sheet):
    built = build(sheet(ROAD + DRIVELINE), a_log("motor_torque_nm", "gear"), "road", "traction_force_n")
    assert built.notes == []


def test_entry_behind_the_target(sheet):
    with pytest.raises(ValueError, match="motor_torque_nm"):
        build(sheet(FULL), a_log("gear"), "shaft", "motor_torque_nm")


def test_efficiency_covers_wheel_to_battery(sheet):
    log = a_log("gear")
    built = build(sheet(FULL), log, "road", "energy_wh")
    force = np.asarray(build(sheet(FULL), log, "road", "traction_force_n").vehicle.force(log))
    power = force * log.speed_mps
    np.testing.assert_allclose(
        built.vehicle.power(log), np.where(power > 0, power / 0.91, power * 0.91) + 900, rtol=1e-9
    )


def test_machine_covers_wheel_to_battery_without_a_driveline_efficiency(sheet):
    log = a_log("gear")
    built = build(sheet(ROAD + MACHINE), log, "road", "energy_wh")
    assert built.notes == ["[machine] covers wheel to battery: the sheet has no driveline.efficiency"]
    force = np.asarray(build(sheet(FULL), log, "road", "traction_force_n").vehicle.force(log))
    power = force * log.speed_mps
    np.testing.assert_allclose(built.vehicle.power(log), np.where(power > 0, power / 0.93, power * 0.9), rtol=1e-9)


def test_without_a_battery_section_nothing_is_drawn_and_nothing_estimated(sheet):
    built = build(sheet(MACHINE), a_log("traction_force_n"), "wheel", "energy_wh")
    assert float(built.vehicle.effect("auxiliary").auxiliary_w) == 0.0
    assert "battery.auxiliary_w" not in [c.path for c in built.table.rows]


def test_mass_of_the_log_comes_first(sheet):
    log = a_log("mass_kg", "gear")
    built = build(sheet(FULL), log, "road", "traction_force_n")
    assert "mass_kg" not in [c.path for c in built.table.rows]
    assert any("mass_kg" in n for n in built.notes)
    text = FULL.replace("mass_kg = 24000.0\n", "")
    np.testing.assert_allclose(
        build(sheet(text), log, "road", "traction_force_n").vehicle.force(log), built.vehicle.force(log)
    )
    free = build(sheet("mass_kg = { value = 24000.0, sd = 500.0 }\n" + text), a_log(), "road", "traction_force_n")
    row = next(c for c in free.table.rows if c.path == "mass_kg")
    assert row.free
    assert (row.value, row.sd, row.unit, row.lower) == (24000.0, 500.0, "kg", 0.0)


def test_rows_carry_prior_unit_and_support(sheet):
    rows = {c.path: c for c in build(sheet(FULL), a_log("gear"), "road", "energy_wh").table.rows}
    c_rr, auxiliary, efficiency = (rows[k] for k in ("road.c_rr", "battery.auxiliary_w", "driveline.efficiency"))
    assert (c_rr.value, c_rr.sd, c_rr.scale, c_rr.unit, c_rr.lower, c_rr.upper) == (0.006, 8e-4, 8e-4, "1", 0.0, np.inf)
    assert (auxiliary.unit, auxiliary.lower, auxiliary.upper, auxiliary.free) == ("W", -np.inf, np.inf, True)
    assert (efficiency.value, efficiency.sd, efficiency.free) == (0.91, None, False)


# --- per vehicle ----------------------------------------------------------------------------------------------------


def test_per_vehicle(sheet):
    text = FULL.replace(
        "sd = 0.0008", "sd = 0.0008, per_vehicle = true, vehicles = { B = { value = 0.008, sd = 0.001 } }"
    )
    log = a_log("gear", vehicles=3)
    built = build(sheet(text), log, "road", "traction_force_n", vehicle_names=("A", "B", "C"))
    rows = [c for c in built.table.rows if c.path == "road.c_rr"]
    assert [(c.name, c.group, c.value, c.sd) for c in rows] == [
        ("road.c_rr[A]", 0, 0.006, 0.0008), ("road.c_rr[B]", 1, 0.008, 0.001), ("road.c_rr[C]", 2, 0.006, 0.0008),
    ]  # fmt: skip
    assert isinstance(built.vehicle.effect("rolling").c_rr, Grouped)
    shared = build(sheet(FULL), log, "road", "traction_force_n").vehicle
    more = np.asarray(built.vehicle.force(log)) - np.asarray(shared.force(log))
    np.testing.assert_allclose(more, np.where(log.vehicle == 1, 0.002 * 24000 * GRAVITY_MPS2, 0.0), atol=1e-6)
    free = built.table.values(built.vehicle)
    other = built.table.insert(built.vehicle, jnp.asarray(free * 2))
    np.testing.assert_allclose(built.table.values(other), free * 2)


def test_mass_per_vehicle_with_a_sensor_effect(sheet):
    text = FULL.replace("24000.0", "{ value = 24000.0, sd = 500.0, per_vehicle = true, vehicles = { B = 20000.0 } }")
    read = sheet(text + "[effects.mass_scale]\nscale = 0.1\n")
    log = a_log("gear", vehicles=2)
    built = build(read, log, "road", "traction_force_n", vehicle_names=("A", "B"))
    logged = log.with_channels(mass_kg=np.where(log.vehicle == 1, 22000.0, 26400.0))
    expected = build(sheet(FULL), logged, "road", "traction_force_n").vehicle.force(logged)
    np.testing.assert_allclose(built.vehicle.force(log), expected, rtol=1e-12)


def test_per_vehicle_without_names(sheet):
    text = MACHINE.replace("sd = 0.05", "sd = 0.05, per_vehicle = true")
    built = build(sheet(text), a_log("traction_force_n", vehicles=2), "wheel", "energy_wh")
    assert [c.name for c in built.table.rows][:2] == [
        "machine.motoring_efficiency[0]",
        "machine.motoring_efficiency[1]",
    ]


# --- effects --------------------------------------------------------------------------------------------------------


def test_effects_are_added_with_their_values(sheet):
    text = FULL + (
        "[effects.tyre_warmup]\nexcess = { value = 0.3, sd = 0.05 }\ndistance_m = 4000.0\n"
        "[effects.regen_limit]\npower_w = { value = 9e4, sd = 2e3 }\n"
    )
    log = a_log("gear")
    built = build(sheet(text), log, "road", "energy_wh")
    effect = built.vehicle.effect("tyre_warmup")
    assert (float(effect.excess), float(effect.distance_m)) == (0.3, 4000.0)
    rows = {c.path: c for c in built.table.rows}
    excess, distance = rows["effects.tyre_warmup.excess"], rows["effects.tyre_warmup.distance_m"]
    assert (excess.sd, excess.free, excess.lower, excess.unit) == (0.05, True, -np.inf, "1")
    assert (distance.free, distance.lower, distance.upper, distance.unit) == (False, 500.0, 6e4, "m")
    assert rows["effects.regen_limit.power_w"].lower == 500.0


def test_effects_that_this_log_or_target_cannot_show_are_skipped(sheet):
    text = FULL + (
        "[effects.headwind]\nscale = 1.0\n[effects.torque_offset]\ngain = 0.1\n"
        "[effects.auxiliary_power]\npower_w = 500.0\n[effects.road_grade]\nscale = 1.0\n"
    )
    built = build(sheet(text), a_log("gear", "grade_rad", "accel_mps2"), "road", "traction_force_n")
    skipped = [n for n in built.notes if n.startswith("effect ")]
    reasons = ("wind_speed_mps", "measured motor torque", "cannot act on the target", "the log has grade_rad")
    assert len(skipped) == 4
    assert {e.id for e in built.vehicle.effects} == {"inertia", "grade", "rolling", "aero"}
    for part in reasons:
        assert any(part in n for n in skipped) or part == "measured motor torque"


def test_an_effect_by_gear(sheet):
    text = FULL + "[effects.gear_efficiency]\ndelta = { 2 = { value = 0.03, sd = 0.01 }, 4 = 0.05 }\n"
    log = a_log("gear")
    built = build(sheet(text), log, "road", "motor_torque_nm")
    rows = [c for c in built.table.rows if c.path.startswith("effects.")]
    assert [(c.name, c.free) for c in rows] == [
        ("effects.gear_efficiency.delta[2]", True), ("effects.gear_efficiency.delta[4]", False),
    ]  # fmt: skip
    plain = np.asarray(build(sheet(FULL), log, "road", "motor_torque_nm").vehicle.torque(log))
    ratio = np.asarray(built.vehicle.torque(log)) / plain - 1
    delta = np.array([0, 0, 0.03, 0, 0.05])[log.channels["gear"].astype(int)]
    np.testing.assert_allclose(ratio, delta * np.sign(plain), atol=1e-12)


def test_an_effect_by_gear_is_skipped_where_the_log_tells_none_and_one_number_holds_in_all(sheet):
    by_gear, one = "torque_nm = { 1 = 5.0, 2 = 9.0 }", "torque_nm = { value = 9.0, sd = 1.0 }"
    log = a_log()
    built = build(sheet(FULL + f"[effects.driveline_drag]\n{by_gear}\n"), log, "road", "energy_wh")
    assert not built.vehicle.has("driveline_drag")
    assert any("driveline_drag" in n and "no column 'gear'" in n for n in built.notes)
    built = build(sheet(FULL + f"[effects.driveline_drag]\n{one}\n"), log, "road", "energy_wh")
    assert [(c.name, c.free) for c in built.table.rows if c.path.startswith("effects.")] == [
        ("effects.driveline_drag.torque_nm", True)
    ]


def test_effects_of_the_users_own(tmp_path):
    class Mine(LIBRARY["auxiliary_power"]):
        id = "mine"

    (tmp_path / "s.toml").write_text(MACHINE + "[effects.mine]\npower_w = 100.0\n")
    refusal(read_sheet, tmp_path / "s.toml")
    read = read_sheet(tmp_path / "s.toml", library={**LIBRARY, "mine": Mine})
    assert build(read, a_log("traction_force_n"), "wheel", "energy_wh").vehicle.has("mine")


@pytest.mark.parametrize("effect_id", LIBRARY)
def test_every_effect_can_stand_in_a_sheet(effect_id, sheet):
    values = {p.name: min(max(p.scale, p.lower), p.upper) for p in LIBRARY[effect_id].parameters}
    lines = "\n".join(f"{k} = {{ value = {v!r}, sd = {abs(v) / 2 + 0.1!r} }}" for k, v in values.items())
    declared = sheet(f"[effects.{effect_id}]\n{lines}\n").declared
    assert {p.split(".")[2]: d.value for p, d in declared.items()} == values
    assert at_null(LIBRARY[effect_id]).id == effect_id


# --- traction force from torque -------------------------------------------------------------------------------------


def test_traction_force_from_torque(sheet):
    log = a_log("motor_torque_nm", "gear")
    torque, gear = log.channels["motor_torque_nm"], log.channels["gear"].astype(int)
    ratio = np.array([9.16, 5.27, 3.33, 2.16])[gear - 1] * 4.5 / 0.5
    force = traction_force_from_torque(log, sheet(FULL))
    np.testing.assert_allclose(force, torque * ratio * np.where(torque > 0, 0.91, 1 / 0.91), rtol=1e-12)


def test_traction_force_is_the_inverse_of_torque(sheet):
    log = a_log("gear")
    read = sheet(FULL)
    torque = np.asarray(build(read, log, "road", "motor_torque_nm").vehicle.torque(log))
    force = np.asarray(build(read, log, "road", "traction_force_n").vehicle.force(log))
    np.testing.assert_allclose(
        traction_force_from_torque(log.with_channels(motor_torque_nm=torque), read), force, rtol=1e-9
    )


@pytest.mark.parametrize("key", ["efficiency = 0.91\n", "wheel_radius_m = 0.5\n"])
def test_traction_force_needs_the_driveline(key, sheet):
    message = refusal(traction_force_from_torque, a_log("motor_torque_nm", "gear"), sheet(FULL.replace(key, "")))
    assert key.split(" ")[0] in message
    assert "traction force is derived" in message


def test_traction_force_needs_ratios_torque_and_gears(sheet):
    assert "gear_ratios" in refusal(traction_force_from_torque, a_log("motor_torque_nm"), sheet(MACHINE))
    assert "motor_torque_nm" in refusal(traction_force_from_torque, a_log("gear"), sheet(FULL))
    assert "'gear'" in refusal(traction_force_from_torque, a_log("motor_torque_nm"), sheet(FULL))
    log = a_log("motor_torque_nm", "gear")
    assert "gear 5" in refusal(
        traction_force_from_torque, log.with_channels(gear=log.channels["gear"] + 1), sheet(FULL)
    )


# --- the augmented sheet --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("entry", "target"), [(e, "energy_wh") for e in ("road", "wheel", "shaft")])
def test_round_trip(entry, target, sheet):
    log = a_log("motor_torque_nm", "motor_speed_radps", "traction_force_n", "gear", "ambient_temp_c", vehicles=2)
    text = FULL.replace("sd = 0.0008", "sd = 0.0008, per_vehicle = true").replace(
        "sd = 0.05", "sd = 0.05, per_vehicle = true"
    )
    read = sheet('name = "truck \\"34\\" \\u007f"\nsource = "somewhere"\n' + text)
    built = build(read, log, entry, target, vehicle_names=("bus 1", "B.2"))
    rng = np.random.default_rng(1)
    values = built.table.values(built.vehicle) * (1.0 + 0.2 * rng.random(len(built.table.free)))  # efficiencies above 1
    after = built.table.insert(built.vehicle, jnp.asarray(values))
    hvac = LIBRARY["hvac_power"](*(np.asarray(x) for x in (120.0, 0.0, 15.5, 22.0)))
    limit = LIBRARY["regen_limit"](np.asarray(41234.5))
    after = after.plus(hvac, limit)
    calibration = {c.name: (float(v), 0.1 * abs(float(v))) for c, v in zip(built.table.free, values, strict=True)}
    effects = {
        "hvac_power": {
            "below_w_per_k": (120.0, 4.0, "W/K"), "above_w_per_k": (0.0, 0.0, "W/K"),
            "heat_c": (15.5, 0.5, "°C"), "cool_c": (22.0, np.nan, "°C"),
        },
        "regen_limit": {"power_w": (41234.5, None, "W")},
    }  # fmt: skip
    text = augmented_sheet(read, calibration, effects)
    again = sheet(text, "augmented.toml")
    rebuilt = build(again, log, entry, target, vehicle_names=("bus 1", "B.2"))
    np.testing.assert_allclose(rebuilt.vehicle.predict(log, target), after.predict(log, target), rtol=1e-9)
    rows = {c.name: c for c in rebuilt.table.rows}
    for name, (value, sd) in calibration.items():
        assert (rows[name].value, rows[name].sd, rows[name].free) == (value, sd, True)
    assert (rows["effects.hvac_power.heat_c"].sd, rows["effects.hvac_power.cool_c"].free) == (0.5, False)
    assert again.name == read.name
    assert again.source == read.source
    assert "# W/K" in text
    assert "declared as" in text
    assert "k₁·max(T₁−T, 0)" in text
    twice = sheet(augmented_sheet(again, {}, {}), "twice.toml")
    assert twice.declared == again.declared


def test_round_trip_by_gear_and_of_effects_in_the_sheet(sheet):
    log = a_log("gear")
    read = sheet(FULL + "[effects.gear_efficiency]\ndelta = { 1 = 0.02, 2 = { value = 0.03, sd = 0.01 } }\n")
    effects = {"tyre_warmup": {"excess": (0.4, 0.1, "1"), "distance_m": (7e3, 1e3, "m")}}
    again = sheet(augmented_sheet(read, {"effects.gear_efficiency.delta[2]": (0.05, 0.002)}, effects), "b.toml")
    rows = {c.name: (c.value, c.sd) for c in build(again, log, "road", "energy_wh").table.rows}
    assert rows["effects.gear_efficiency.delta[1]"] == (0.02, None)
    assert rows["effects.gear_efficiency.delta[2]"] == (0.05, 0.002)
    assert rows["effects.tyre_warmup.distance_m"] == (7e3, 1e3)
    new = sheet(augmented_sheet(sheet(FULL), {}, {"gear_efficiency": {"delta[3]": (0.01, 0.001, "1")}}), "c.toml")
    assert new.declared["effects.gear_efficiency.delta"].groups == {"3": (0.01, 0.001)}


def test_augmented_names_the_map_where_it_is(sheet, tmp_path):
    (tmp_path / "m.csv").write_text(HEADER + "1,0,0,0.9\n")
    read = sheet(ROAD + "[driveline]\nmap = 'm.csv'\n" + GEARS)
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "augmented_vehicle.toml").write_text(augmented_sheet(read, {}, {}))
    assert read_sheet(tmp_path / "out" / "augmented_vehicle.toml").map_path == tmp_path.resolve() / "m.csv"
    assert 'map = "m.csv"' in augmented_sheet(read, {}, {}, map_file="m.csv")


@pytest.mark.parametrize(
    "name", ["road.nothing", "effects.nothing.scale", "effects.headwind.nothing", "road.c_rr[B183]", "driveline.map"]
)
def test_augmented_refuses_what_no_sheet_can_hold(name, sheet):
    with pytest.raises(ValueError, match=name.split("[")[0]):
        augmented_sheet(sheet(FULL), {name: (1.0, 0.1)}, {})


# --- sheets that come with the project ------------------------------------------------------------------------------


def test_sheets_of_the_project():
    names = {"kia_niro", "kia_niro_road", "truck_34t", "ztbus"}
    sheets = {p.stem: read_sheet(p) for p in CONFIGS.glob("*.toml")}
    assert names <= set(sheets)
    efficiencies = {"machine.motoring_efficiency", "machine.regenerating_efficiency"}
    assert set(sheets["kia_niro"].declared) == set(sheets["ztbus"].declared) == efficiencies
    road = sheets["kia_niro_road"]
    assert road.declared["mass_kg"].value == 1739.0  # paper 2, table I
    assert float(road.driveline(1.0).ratio_radpm(a_log())) == pytest.approx(33.28, abs=0.01)
    built = build(sheets["truck_34t"], a_log("gear"), "road", "energy_wh")
    assert [c.path for c in built.table.free] == ["road.c_rr", "road.cda_m2"]
    built = build(road, a_log("motor_torque_nm"), "road", "traction_force_n")
    assert [c.path for c in built.table.free] == ["road.c_rr", "road.cda_m2"]


def test_a_sheet_from_python_is_the_one_of_its_toml(sheet):
    ours = Sheet(
        name="truck", mass_kg=np.float64(24000.0), road={"c_rr": (0.006, 0.0008), "cda_m2": {"value": 5.6, "sd": 0.5}},
        driveline={"efficiency": 0.91, "gear_ratios": (9.16, 5.27), "final_drive": 4.5, "wheel_radius_m": 0.5},
        effects={"headwind": {"scale": (0.9, 0.1)}},
    )  # fmt: skip
    text = """
    name = "truck"
    mass_kg = 24000.0
    [road]
    c_rr = { value = 0.006, sd = 0.0008 }
    cda_m2 = { value = 5.6, sd = 0.5 }
    [driveline]
    efficiency = 0.91
    gear_ratios = [9.16, 5.27]
    final_drive = 4.5
    wheel_radius_m = 0.5
    [effects.headwind]
    scale = { value = 0.9, sd = 0.1 }
    """
    theirs = sheet(text)
    assert ours.declared == theirs.declared
    assert (ours.name, ours.gear_ratios, ours.final_drive) == (theirs.name, theirs.gear_ratios, theirs.final_drive)
    assert repr(ours).startswith("Sheet('truck'; estimated: road.c_rr, road.cda_m2, effects.headwind.scale; known: ")
    with pytest.raises(InputError, match=r"sheet: road\.c_r: unknown key"):
        Sheet(road={"c_r": 0.006})
