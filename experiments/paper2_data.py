"""The four trips of paper 2 as its experiments read them, and one line where they are not there."""

import os
from dataclasses import replace
from functools import cache
from pathlib import Path

from hdev_jax.errors import InputError
from hdev_jax.learn import Trip, trips_of
from hdev_jax.logs import Log, read_log
from hdev_jax.logs.adapter import Adapter

__all__ = ["kia_log", "kia_trips"]

ROOT = Path(__file__).parents[1]
SOURCE = "github.com/FMLabSouthampton/EV_EnergyConsumptionModel_v1_2024"


@cache
def kia_log(only: str = "") -> Log:
    """The log of all trips, or of one (`only`): the pedal is in trip 1 alone. Rows as in the paper, untrimmed.

    Raises `InputError` without the data.
    """
    folder = Path(os.environ.get("HDEV_DATA") or ROOT.parent / "shared" / "data") / "kia_niro"
    files = sorted(folder.glob(f"Trip_{only or '*'}_Road_Data_*.mat"))
    if not files:
        raise InputError(
            f"no Trip_*.mat in {folder}: they are in {SOURCE}; put them in a folder kia_niro and set HDEV_DATA to the "
            "folder above it"
        )
    adapter = replace(Adapter.load(ROOT / "configs" / "adapters" / "kia_niro.toml"), edge_trim_s=0.0)
    return read_log(files, adapter)


def kia_trips(rows: int | None = None, only: str = "") -> dict[str, Trip]:
    """The trips by name, power in kW; the first `rows` of each where a run is to be tiny."""
    log = kia_log(only)
    found = trips_of(log.segments, log.target("battery_power_kw"), log.trip_names)
    return {t.name: t.part(0, rows) if rows else t for t in found}
