"""`hdev export`: each format read by its own program agrees with the kernel, and what it cannot hold is named."""

import json
import warnings
import xml.etree.ElementTree as ET
from pathlib import Path

import jax
import numpy as np
import pandas as pd
import pytest

from hdev_jax import cli
from hdev_jax.errors import InputError
from hdev_jax.export.kernel import check_drive, kernel_of
from hdev_jax.export.lookup import interpolated
from hdev_jax.export.programs import OUTPUT, onnx, stablehlo
from hdev_jax.inference.sheet import Sheet
from hdev_jax.verbs.programs.export import export

PLAIN = {
    "name": "truck <26 t>", "mass_kg": 18e3,
    "road": {"c_rr": (0.006, 0.0008), "cda_m2": 5.6, "rotating_mass_factor": 1.03},
    "driveline": {"efficiency": 0.91}, "battery": {"auxiliary_w": 2500.0, "capacity_wh": 300e3},
}  # fmt: skip
EFFECTS = {
    "hvac_power": {"below_w_per_k": 100.0, "above_w_per_k": 50.0}, "regen_cutoff": {"speed_mps": 2.0},
    "battery_resistance": {"resistance_ohm": 0.05},
}  # fmt: skip


def with_effects(**more):
    return Sheet(**(PLAIN | {"battery": PLAIN["battery"] | {"nominal_voltage_v": 650.0}}), effects=EFFECTS | more)


def columns_of(kernel, rows):
    named = {k: getattr(rows, k) for k in kernel.inputs if hasattr(rows, k)} | rows.channels
    return [np.asarray(named[k], float) for k in kernel.inputs]


def beside(path) -> dict:
    return json.loads(Path(f"{path}.json").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def kernel():
    return kernel_of(with_effects())


@pytest.fixture(scope="module")
def drive(kernel):
    """A check drive of other masses and temperatures, and what the kernel says of it."""
    rows = check_drive(kernel, seed=1)
    rng = np.random.default_rng(0)
    rows = rows.with_channels(
        mass_kg=rng.uniform(12e3, 26e3, len(rows)), ambient_temp_c=rng.uniform(-10.0, 35.0, len(rows))
    )
    return rows, np.asarray(kernel.vehicle.energy(rows))


def test_stablehlo_reloaded_is_the_kernel_for_any_number_of_rows(kernel, drive):
    assert kernel.channels == ("grade_rad", "mass_kg", "ambient_temp_c")
    pytest.importorskip("flatbuffers", reason="extra `export` is not installed")
    rows, energy = drive
    program = jax.export.deserialize(bytearray(stablehlo(kernel).content))
    columns = columns_of(kernel, rows)
    for some in (slice(None), slice(600, 607), slice(600, 601)):
        found = np.asarray(program.call(*(c[some] for c in columns)))
        np.testing.assert_allclose(found, energy[some], rtol=1e-12, atol=1e-12)


def test_onnx_agrees_in_onnxruntime(kernel, drive):
    pytest.importorskip("jax2onnx", reason="extra `export` is not installed")
    runtime = pytest.importorskip("onnxruntime", reason="extra `export` is not installed")
    rows, energy = drive
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        session = runtime.InferenceSession(onnx(kernel).content, providers=["CPUExecutionProvider"])
    for some in (slice(None), slice(600, 601)):
        feed = {k: c[some] for k, c in zip(kernel.inputs, columns_of(kernel, rows), strict=True)}
        (found,) = session.run([OUTPUT], feed)
        np.testing.assert_allclose(found, energy[some], rtol=1e-9, atol=1e-9)


def test_lookup_is_the_kernel_at_its_points_and_errs_between_as_it_says(tmp_path):
    sheet = Sheet(**PLAIN, effects={"hvac_power": EFFECTS["hvac_power"]})
    kernel = kernel_of(sheet)
    said = export(sheet, "lookup", out=tmp_path / "t.csv")
    table, about = pd.read_csv(tmp_path / "t.csv", comment="#"), beside(tmp_path / "t.csv")
    error = about["error_wh_per_km"]
    assert f"{error['rms']:.3g} Wh/km rms" in said
    assert error["rms"] < 0.01 * error["mean_size_of_values"]
    axes = about["axes"]
    assert list(table.columns) == [*axes, about["value"]]
    some = table.sample(50, random_state=0)
    power = kernel.steady(some["speed_mps"], **{k: some[k] for k in kernel.channels})
    np.testing.assert_allclose(some[about["value"]], power / some["speed_mps"] / 3.6, rtol=1e-6)
    u = np.random.default_rng(5).random((500, 4))
    at = np.stack([g[0] + x * (g[-1] - g[0]) for g, x in zip(map(np.asarray, axes.values()), u.T, strict=True)], axis=1)
    true = kernel.steady(at[:, 0], **dict(zip(list(axes)[1:], at[:, 1:].T, strict=True))) / at[:, 0] / 3.6
    off = interpolated(axes, table[about["value"]].to_numpy(), at) - true
    assert np.quantile(np.abs(off), 0.95) == pytest.approx(error["p95"], rel=0.5)
    assert "acceleration" in {x["what"] for x in about["left_out"]}


def test_what_a_simulator_cannot_hold_is_named_with_its_share_of_the_energy(tmp_path):
    sheet = with_effects(auxiliary_power={"power_w": 700.0})
    said = export(sheet, "sumo", out=tmp_path / "v.add.xml")
    about = beside(tmp_path / "v.add.xml")
    left = {x["what"]: x["share"] for x in about["left_out"]}
    assert {"effects.regen_cutoff", "effects.battery_resistance", "effects.hvac_power"} <= left.keys()
    assert "effects.auxiliary_power" not in left, "a constant load adds to the declared one"
    kernel = kernel_of(sheet)
    rows = check_drive(kernel)
    whole, without = (
        float(np.sum(v.energy(rows))) for v in (kernel.vehicle, kernel.vehicle.minus("battery_resistance"))
    )
    assert left["effects.battery_resistance"] == pytest.approx(1 - without / whole, rel=0.2)
    assert "not in the file: effects.battery_resistance" in said
    values = {p.get("key"): p.get("value") for p in ET.parse(tmp_path / "v.add.xml").getroot().iter("param")}
    assert float(values["constantPowerIntake"] or 0) == 3200.0


def test_what_acts_across_rows_or_by_vehicle_is_named():
    sheet = Sheet(**(PLAIN | {"road": {"c_rr": {"value": 0.006, "sd": 0.001, "per_vehicle": True}, "cda_m2": 5.6}}),
                  effects={"grade_lag": {"lag_s": 2.0}})  # fmt: skip
    left = {x.what for x in kernel_of(sheet).left_out}
    assert {"road.c_rr", "effects.grade_lag", "sd"} <= left


def test_the_time_since_the_start_is_an_input_where_an_effect_goes_by_it():
    kernel = kernel_of(Sheet(**PLAIN, effects={"cabin_warmup": {"power_w": 5000.0, "tau_s": 900.0}}))
    assert kernel.inputs[4] == "time_s"
    early, late = kernel.steady(10.0, time_s=np.array([0.0, 900.0]))
    assert early - late == pytest.approx(5000.0 * (1 - np.exp(-1)), rel=0.01)
    assert "time_s" not in kernel_of(Sheet(**PLAIN)).inputs


def test_fastsim_drives_the_exported_vehicle_with_the_same_energy(tmp_path):
    fastsim = pytest.importorskip("fastsim", reason="extra `truth` is not installed")
    export(Sheet(**PLAIN), "fastsim", out=tmp_path / "v.yaml")
    kernel = kernel_of(Sheet(**PLAIN))
    rows = check_drive(kernel)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        cycle = fastsim.Cycle.from_dict({
            "time_seconds": np.arange(len(rows) + 1.0).tolist(),
            "speed_meters_per_second": [0.0, *rows.speed_end_mps.tolist()],
            "grade": [0.0, *np.tan(rows.channels["grade_rad"]).tolist()],
        })  # fmt: skip
        simulation = fastsim.SimDrive(fastsim.Vehicle.from_file(str(tmp_path / "v.yaml")), cycle)
        simulation.run_once()
        h = simulation.to_dataframe()
    power = h["veh.pt_type.BEV.res.history.pwr_out_electrical_watts"].to_numpy(dtype=float)[1:]
    ours = float(np.sum(kernel.vehicle.energy(rows)))
    # its air is that of the altitude, its drag that of the mean speed of a second
    assert power.sum() / 3600.0 == pytest.approx(ours, rel=0.005)


def test_sumo_drives_the_exported_vehicle_with_the_same_energy(tmp_path):
    pytest.importorskip("sumo", reason="extra `truth` is not installed")
    from experiments.simulators.with_sumo import run_tool

    export(Sheet(**PLAIN), "sumo", out=tmp_path / "type.xml")
    name = beside(tmp_path / "type.xml")["vtype"]
    run_tool("netgenerate", "--grid", "--grid.number=3", "--grid.length=600", "--default.speed=14", "--seed", "3",
         "--perturb-z=norm(0,6)", "-o", "net.xml", folder=tmp_path)  # fmt: skip
    edges = [e.get("id", "") for e in ET.parse(tmp_path / "net.xml").getroot().iter("edge") if not e.get("function")]
    (tmp_path / "routes.xml").write_text(
        f'<routes><trip id="own" type="{name}" depart="0" from="{edges[0]}" to="{edges[-1]}"/></routes>'
    )
    run_tool("sumo", "-n", "net.xml", "-a", "type.xml", "-r", "routes.xml", "--step-length", "0.1", "--no-step-log",
         "--step-method.ballistic", "--fcd-output", "fcd.xml", "--fcd-output.attributes", "speed,slope",
         "--battery-output", "battery.xml", "--battery-output.precision", "8", "--precision", "8",
         folder=tmp_path)  # fmt: skip
    found = [
        (float(v.get("speed", 0)), float(v.get("slope", 0))) for v in ET.parse(tmp_path / "fcd.xml").iter("vehicle")
    ]
    used = [float(v.get("energyConsumed", 0)) for v in ET.parse(tmp_path / "battery.xml").iter("vehicle")]
    speed, slope = np.array(found).T
    kernel = kernel_of(Sheet(**PLAIN))
    columns = {"duration_s": 0.1, "speed_start_mps": speed[:-1], "speed_end_mps": speed[1:], "mass_kg": 18e3}
    columns |= {"distance_m": 0.05 * (speed[:-1] + speed[1:]), "grade_rad": np.radians(slope[1:])}
    rows = np.broadcast_arrays(*(np.asarray(columns[k], float) for k in kernel.inputs))
    ours = np.asarray(kernel.function()(*rows))
    assert len(used) == len(found) > 500
    assert sum(used[1:]) == pytest.approx(ours.sum(), rel=0.01)


@pytest.mark.parametrize(
    ("sheet", "options", "says"),
    [
        (PLAIN, {"to": "lookup", "out": "t.xml"}, "ends in .csv"),
        (PLAIN, {"to": "fmu", "out": "t.fmu"}, "no such format"),
        (PLAIN, {"to": "lookup", "out": "t.csv", "channels": "mass_kg"}, "grade_rad and mass_kg are expected"),
        (PLAIN, {"to": "fastsim", "out": "t.json", "channels": "distance_m"}, "distance_m is no channel"),
        ({k: v for k, v in PLAIN.items() if k != "mass_kg"}, {"to": "sumo", "out": "t.xml"}, "mass_kg is missing"),
        ({"mass_kg": 18e3, "road": {"c_rr": 0.006}, "driveline": {"efficiency": 0.9}}, {"to": "sumo", "out": "t.xml"},
         "road.cda_m2 is missing"),
    ],
)  # fmt: skip
def test_bad_input_is_one_line(sheet, options, says, tmp_path):
    with pytest.raises(InputError, match=says):
        export(Sheet(**sheet), **(options | {"out": tmp_path / options["out"]}))
    assert not list(tmp_path.iterdir())


def test_from_the_command_line(tmp_path, capsys):
    sheet = Path(__file__).parents[2] / "configs" / "vehicles" / "truck_34t.toml"
    assert cli.main(["export", str(sheet), "--to", "fastsim", "--out", str(tmp_path / "v.json")]) == 0
    assert "not in the file: sd" in capsys.readouterr().out
    assert beside(tmp_path / "v.json")["format"] == "fastsim"
