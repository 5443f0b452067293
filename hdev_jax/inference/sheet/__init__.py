"""The vehicle sheet: read from TOML, checked against its schema, built into a vehicle, written out again."""

from hdev_jax.inference.sheet.build import Built, build
from hdev_jax.inference.sheet.sheet import (
    Sheet,
    choose_entry,
    read_sheet,
    sheet_of_sections,
    traction_force_from_torque,
)
from hdev_jax.inference.sheet.text import augmented_sheet

__all__ = [
    "Built",
    "Sheet",
    "augmented_sheet",
    "build",
    "choose_entry",
    "read_sheet",
    "sheet_of_sections",
    "traction_force_from_torque",
]
