"""Measured missions of two trolleybuses as stretches of road and halts, with the energy of the whole bus."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from experiments.runner.config import CONFIGS
from experiments.runner.data import ORIGIN, MissingDataError, data_folder
from hdev_jax.logs import by_distance, read_log
from hdev_jax.segments import Segments
from hdev_jax.targets import TARGETS

__all__ = ["BUSES", "SHEET", "Mission", "bus_files", "bus_sources", "buses", "read_mission"]

BUSES = ("B183", "B208")
ADAPTER = CONFIGS / "adapters" / "ztbus.toml"
SHEET = CONFIGS / "vehicles" / "ztbus_road.toml"


@dataclass(frozen=True)
class Mission:
    """One file of ZTBus by distance: `length_m` of road or a halt in each row.

    **Fields:** `name`, of the file without its end time; `bus`, of `BUSES`; `segments`, NumPy columns `[row]` with the
    channels of `configs/adapters/ztbus.toml` less the targets, so that no model is given the force of its drive (what
    the driver does, brake, halt brake and doors, is among them: a model that is to foresee a drive leaves it out);
    `energy_wh`, `[row]`, positive into the bus.

    The energy is the measured power demand of the *whole* bus, from grid or battery, over time: traction with all that
    is on board, heating first, which switches and which no column tells apart; at halts there is nothing else. Braking
    by the motors comes back in it as negative demand; the friction brake is not in it, so that a road load counts
    work as recovered where `brake_pressure_pa` says that it was not. The mass is of 19.5 t and 70 kg a counted
    passenger; in winter the temperature is up to 15 K too high while the bus leaves its depot.
    """

    name: str
    bus: str
    segments: Segments
    energy_wh: np.ndarray


def bus_files(missions: int = 0) -> list[Path]:
    """The files of the first `missions` of each bus (0: all), by bus and date.

    **Raises:** `MissingDataError` where the folder or the missions of a bus are absent.
    """
    folder = data_folder("ztbus")
    every = [p for p in sorted(folder.glob("B*.csv*")) if ".grade." not in p.name]
    of = {bus: [p for p in every if p.name.startswith(f"{bus}_")] for bus in BUSES}
    if lacking := [bus for bus, files in of.items() if not files]:
        raise MissingDataError(f"no mission of {' or '.join(lacking)} in {folder}: they are from {ORIGIN['ztbus']}")
    return [p for files in of.values() for p in files[: missions or None]]


def bus_sources(missions: int = 0) -> list[Path]:
    """Every file that rows of the buses are made of: `bus_files`, their slopes where they are there, adapter and sheet.

    Raises what `bus_files` does.
    """
    files = bus_files(missions)
    return [*files, *(s for f in files if (s := _slope(f)).is_file()), ADAPTER, SHEET]


def _slope(path: Path) -> Path:
    """Where the slope of a mission is."""
    return path.with_name(f"{path.name.split('.')[0]}.grade.csv.gz")


def read_mission(path: Path, length_m: float = 100.0) -> Mission:
    """The mission in a file of `bus_files`, by `length_m` of road.

    **Raises:** `MissingDataError` where the slope is not beside the file: without it there is no road to speak of;
    `InputError` for what `read_log` and `by_distance` refuse.
    """
    log = by_distance(read_log(path, ADAPTER), length_m)
    if not log.segments.has("grade_rad"):
        raise MissingDataError(f"{path}: its slope, {_slope(path).name}, is not beside it")
    segments = log.segments.without(*TARGETS)
    return Mission(log.trip_names[0], log.vehicle_names[0], segments, log.target("energy_wh"))


def buses(length_m: float = 100.0, missions: int = 0) -> list[Mission]:
    """The first `missions` of each bus (0: all), as `bus_files` orders them. Raises what it and `read_mission` do."""
    return [read_mission(path, length_m) for path in bus_files(missions)]
