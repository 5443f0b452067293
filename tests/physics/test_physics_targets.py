"""Targets: each a record by its name, and what follows from it in the chain, the log and the report."""

import numpy as np
import physics_rows as made
import pytest

from hdev_jax.inference.sheet import build, choose_entry, read_sheet
from hdev_jax.logs import Log
from hdev_jax.problem import sum_weight
from hdev_jax.targets import TARGETS, Target, target_of

LOG = made.drives(*made.LENGTHS)
SHEET = """
mass_kg = 24000.0
[road]
c_rr = 0.006
cda_m2 = 5.6
[driveline]
efficiency = 0.91
gear_ratios = [9.16, 5.27, 3.33, 2.16]
final_drive = 4.5
wheel_radius_m = 0.5
[machine]
motoring_efficiency = 0.93
regenerating_efficiency = 0.9
"""


@pytest.fixture(params=TARGETS.values(), ids=TARGETS)
def target(request: pytest.FixtureRequest) -> Target:
    return request.param


def test_a_record_is_found_by_its_name_and_is_hashable(target: Target) -> None:
    assert target_of(target.name) is target_of(target) is TARGETS[str(target)]
    assert len({*TARGETS.values()}) == len(TARGETS)
    with pytest.raises(ValueError, match="unknown target 'energy_kwh'; one of energy_wh, battery_power_kw"):
        target_of("energy_kwh")


def test_the_vehicle_takes_the_name_or_the_record(target: Target) -> None:
    for entry in target.entries:
        car = made.baseline(entry, covers_machine=False)
        np.testing.assert_array_equal(car.predict(LOG, target.name), car.predict(LOG, target))


def test_every_entry_before_it_builds_and_no_other(target: Target, tmp_path) -> None:
    path = tmp_path / "truck.toml"
    path.write_text(SHEET)
    sheet = read_sheet(path)
    for entry in ("road", "wheel", "shaft"):
        if entry not in target.entries:
            with pytest.raises(ValueError, match=f"{target} cannot be computed"):
                build(sheet, LOG, entry, target.name)
            continue
        built = build(sheet, LOG, entry, target.name)
        assert np.all(np.isfinite(built.vehicle.predict(LOG, target)))
        assert built.vehicle.has("auxiliary") == target.of_battery
    assert choose_entry(LOG, target.name, sheet) == target.entries[-1]
    assert (
        choose_entry(LOG.without(*target.follows, "traction_force_n", "motor_torque_nm"), target.name, sheet) == "road"
    )


def test_a_sum_in_kwh(target: Target) -> None:
    """1 kWh of work or energy over some rows is 1 kWh by each target that has a sum in kWh."""
    seconds, meters = np.array([60.0, 120.0]), np.array([1000.0, 2500.0])
    joule = np.array([1.2e6, 2.4e6])
    rows = {
        "energy_wh": joule / 3600.0, "battery_power_kw": joule / seconds / 1e3, "traction_force_n": joule / meters,
        "motor_torque_nm": np.ones(2),
    }  # fmt: skip
    total = np.sum(rows[target.name] * sum_weight(target.name, seconds, meters))
    if target.per_kwh is None:
        assert total == meters.sum()
    else:
        np.testing.assert_allclose(total / target.per_kwh, 1.0, rtol=1e-12)


def test_what_a_log_can_give_nearest_the_battery_first() -> None:
    energy, power = {"energy_wh": np.ones(len(LOG))}, {"battery_power_w": np.ones(len(LOG))}
    names = tuple(str(k) for k in range(3))
    shaft = ("motor_torque_nm", "traction_force_n")
    assert Log(LOG, energy, names, ("v",)).targets == ("energy_wh", "battery_power_kw", *shaft)
    assert Log(LOG, power, names, ("v",)).targets == ("battery_power_kw", "energy_wh", *shaft)
    assert Log(LOG, energy | power, names, ("v",)).targets == ("energy_wh", "battery_power_kw", *shaft)
    assert Log(LOG.without("motor_torque_nm"), {}, names, ("v",)).targets == ("traction_force_n",)
    hours = LOG.duration_s / 3600.0
    np.testing.assert_array_equal(Log(LOG, power, names, ("v",)).target("energy_wh"), hours)
    np.testing.assert_array_equal(
        Log(LOG, energy, names, ("v",)).target("battery_power_kw"), 3600.0 / LOG.duration_s / 1e3
    )
