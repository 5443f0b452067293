"""The gear where rows have none: trees of a sheet's gear model, for the vehicle's own gearbox."""

from hdev_jax.errors import InputError
from hdev_jax.inference.sheet import Sheet
from hdev_jax.learn.gears.gears import Gearbox, Surrogate
from hdev_jax.learn.gears.saved import read_gear_model
from hdev_jax.physics import EfficiencyMap, Vehicle
from hdev_jax.segments import Segments

__all__ = ["gears_of", "untold"]


def untold(sheet: Sheet, rows: Segments, vehicle: Vehicle) -> bool:
    """Whether the vehicle reads a map over gears that rows like these do not tell."""
    mapped = vehicle.entry == "road" and isinstance(vehicle.driveline.efficiency, EfficiencyMap)
    return mapped and len(sheet.gear_ratios or ()) > 1 and not rows.has("gear")


def gears_of(sheet: Sheet) -> Surrogate | None:
    """The trees of the sheet's `driveline.gear_model`; None for a sheet without one.

    **Raises:** `InputError` for a file that is no gear model, for a gear that was missing from its training, and where
    the sheet lacks what its features need.
    """
    if sheet.gear_model is None:
        return None
    trees = read_gear_model(sheet.gear_model)
    why = f"the gear model {sheet.gear_model.name} is read with it"
    if sheet.wheel_radius_m is None:
        raise sheet.fail("driveline.wheel_radius_m", why)
    rated = {"rated_power_w": sheet.rated_power_w, "rated_speed_radps": sheet.rated_speed_radps}
    needs = [k for k, v in rated.items() if v is None]
    if needs and not {*trees.features} <= {"speed_mps", "requested_torque_nm", "mass_kg", "grade_rad", "gears"}:
        raise sheet.fail(f"driveline.{needs[0]}", why)
    box = Gearbox(
        sheet.gear_ratios or (1.0,), sheet.final_drive or 1.0, sheet.wheel_radius_m, sheet.rated_power_w or 1.0,
        sheet.rated_speed_radps or 1.0,
    )  # fmt: skip
    try:
        return Surrogate.of(trees, box)
    except InputError as e:
        raise InputError(f"{sheet.gear_model}: {e}") from e
