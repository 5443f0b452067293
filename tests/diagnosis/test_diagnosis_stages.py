"""Where the chain is measured in the middle, each side has its own residual and its own suspects."""

from dataclasses import replace

import pytest
from planted import ROAD_SIDE

from hdev_jax.diagnosis.diagnose import diagnose
from hdev_jax.diagnosis.result.stages import add_stages
from hdev_jax.fleet import synthetic_log
from hdev_jax.inference.sheet import read_sheet
from hdev_jax.logs import read_log
from hdev_jax.physics import LIBRARY
from hdev_jax.problem import prepare, split_trips

SIDES = ("copper_loss", "iron_loss", "auxiliary_power", "rolling_speed", "headwind", "mass_scale")


@pytest.mark.slow
def test_each_side_is_diagnosed_apart(tmp_path):
    made = synthetic_log(
        seed=2, trips=9, rows_per_trip=200, entry="shaft", mode="samples", effects={"copper_loss": {}}, ratio=2.0
    )
    files = made.write(tmp_path, truth=False)
    log, machine_alone = read_log([files["log"]]), read_sheet(files["sheet"])
    files["sheet"].write_text(files["sheet"].read_text() + ROAD_SIDE)
    problem, split = prepare(log, read_sheet(files["sheet"])), split_trips(log)
    library = {k: LIBRARY[k] for k in SIDES}
    result = diagnose(problem, split, library)
    assert [e["id"] for e in result.summary["effects"]] == ["copper_loss"]
    add_stages(replace(result, problem=prepare(log, machine_alone)), library, fdr=0.05, seed=0)
    assert "stages" not in result.summary, "the sheet says nothing of the road"
    add_stages(result, library, fdr=0.05, seed=0)
    stages = result.summary["stages"]
    assert stages["machine"]["effects"] == ["copper_loss"]
    assert stages["machine"]["after"] == result.summary["after"]["test"]
    assert stages["road"]["unit"] == "N"
    assert "copper_loss" not in stages["road"]["effects"]
    assert stages["road"]["before"]["n"] == result.summary["before"]["test"]["n"]
    assert any("between the road and the wheels" in note for note in result.summary["notes"])
