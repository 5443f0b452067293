"""The four trips of paper 2 as its experiments read them."""

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Literal

from experiments.runner.config import CONFIGS
from experiments.runner.data import ORIGIN, MissingDataError, data_folder, fingerprint
from hdev_jax.errors import InputError
from hdev_jax.learn import Trip, trips_of
from hdev_jax.logs import Log, read_log
from hdev_jax.logs.adapter import Adapter

__all__ = ["LEAST_ROWS", "MPH", "TripName", "kia_fingerprint", "kia_log", "kia_trips"]

TripName = Literal["1", "2", "3", "4"]
MPH = 0.44704  # m/s: the international mile (1959)
LEAST_ROWS = 20  # of a trip that a model is fitted on
TRIPS: tuple[TripName, ...] = ("1", "2", "3", "4")
ADAPTER = CONFIGS / "adapters" / "kia_niro.toml"


def _files(only: str) -> list[Path]:
    """The adapter and the trips' files. Raises `MissingDataError` where a trip has none."""
    folder = data_folder("kia_niro")
    files = [ADAPTER]
    for trip in (only,) if only else TRIPS:
        if not (own := sorted(folder.glob(f"Trip_{trip}_Road_Data_*.mat"))):
            where = f"they are from {ORIGIN['kia_niro']}; put them there"
            raise MissingDataError(f"no Trip_{trip}_Road_Data_*.mat in {folder}: {where}")
        files += own
    return files


def kia_fingerprint(only: str = "") -> str:
    """What a task that reads the trips has among its values. Raises `MissingDataError` without data."""
    return _digest(*_files(only))


@cache
def _digest(*files: Path) -> str:
    return fingerprint(files)


def kia_log(only: str = "") -> Log:
    """The log of all trips, or of one (`only`): the pedal is in trip 1 alone. Rows as in the paper, untrimmed.

    Raises `MissingDataError` without data.
    """
    return _read(*_files(only))


@cache
def _read(adapter: Path, *files: Path) -> Log:
    return read_log(list(files), replace(Adapter.load(adapter), edge_trim_s=0.0))


def kia_trips(rows: int | None = None, only: str = "") -> dict[str, Trip]:
    """The trips by name, power in kW; the first `rows` of each where a run is to be tiny.

    Raises `InputError` where those are too few, and `MissingDataError` without data.
    """
    if rows is not None and rows < LEAST_ROWS:
        raise InputError(f"config, key rows: {rows} rows of a trip, at least {LEAST_ROWS} are needed, or 0: all")
    log = kia_log(only)
    found = trips_of(log.segments, log.target("battery_power_kw"), log.trip_names)
    return {t.name: t.part(0, rows) if rows else t for t in found}
