"""`simulate`: a fleet in memory, for those who learn from it or test on it."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from hdev_jax.fleet.config import FleetConfig, load_config, parse_config
from hdev_jax.fleet.rows import ROW_FIELDS
from hdev_jax.fleet.sheets import write_sheet
from hdev_jax.fleet.simulator import Batch, VehiclePart, batches, shares
from hdev_jax.fleet.variants import Variant
from hdev_jax.physics import Vehicle
from hdev_jax.segments import Segments

__all__ = ["Fleet", "FleetVehicle", "joined", "simulate", "trip_name"]


@dataclass(frozen=True)
class FleetVehicle:
    """One vehicle: its log as measured, and what was true.

    `segments` has NumPy columns (`vehicle` is its place in the fleet), `energy_wh` the measured target [row]. `truth`
    is by name of `truth.parquet` [row]. `tabular` is the vehicle of the sheet, `true` the one that was simulated; both
    have their gears padded to twelve, and give what the unpadded ones give.
    """

    variant: Variant
    segments: Segments
    energy_wh: np.ndarray
    truth: dict[str, np.ndarray]
    trip_names: tuple[str, ...]
    tabular: Vehicle
    true: Vehicle
    effects: dict[str, dict[str, Any]]

    @property
    def id(self) -> str:
        return self.variant.id

    @property
    def frame(self) -> pd.DataFrame:
        """The log as a table, with the contract's columns: what `hdev_jax.diagnose` takes."""
        s = self.segments
        ends = {k: getattr(s, k) for k in ROW_FIELDS if k not in ("trip", "vehicle")}
        trip = np.asarray(self.trip_names)[np.asarray(s.trip)]
        return pd.DataFrame({"trip_id": trip, "vehicle_id": self.id, **ends, **s.channels, "energy_wh": self.energy_wh})

    def __len__(self) -> int:
        return len(self.energy_wh)


@dataclass(frozen=True)
class Fleet:
    """Vehicles in the order of the table of variants."""

    config: FleetConfig
    vehicles: tuple[FleetVehicle, ...]

    def write_sheets(self, folder: str | Path) -> dict[str, Path]:
        """The vehicles' sheets, with their efficiency maps, as files. **Returns:** the sheets' paths by vehicle."""
        Path(folder).mkdir(parents=True, exist_ok=True)
        for v in self.vehicles:
            write_sheet(v.variant, self.config, Path(folder))
        return {v.id: Path(folder) / f"{v.id}.toml" for v in self.vehicles}

    def __getitem__(self, id: str) -> FleetVehicle:
        for v in self.vehicles:
            if v.id == id:
                return v
        raise KeyError(id)

    def __len__(self) -> int:
        """Rows of all vehicles."""
        return sum(len(v) for v in self.vehicles)

    def column(self, name: str) -> np.ndarray:
        """A column of all vehicles' rows, one vehicle after the other: of the log, of the truth (`truth:gear`), or the
        vehicle's index (`vehicle`) or a trip's number that is its own in the fleet (`trip`)."""
        if name == "trip":
            before = np.cumsum([0] + [len(v.trip_names) for v in self.vehicles])
            return np.concatenate(
                [np.asarray(v.segments.trip) + b for v, b in zip(self.vehicles, before, strict=False)]
            )
        if name.startswith("truth:"):
            return np.concatenate([v.truth[name.removeprefix("truth:")] for v in self.vehicles])
        if name == "energy_wh":
            return np.concatenate([v.energy_wh for v in self.vehicles])
        return np.concatenate(
            [
                np.asarray(v.segments.channels[name] if v.segments.has(name) else getattr(v.segments, name))
                for v in self.vehicles
            ]
        )


def simulate(config: FleetConfig | Mapping[str, Any] | str | Path) -> Fleet:
    """The fleet of a configuration, in memory.

    **Arguments:** a `FleetConfig`, plain values as in its TOML file, or the path of one. **Raises:** `InputError`.
    """
    if isinstance(config, str | Path):
        config = load_config(config)
    elif not isinstance(config, FleetConfig):
        config = parse_config(config)
    vehicles = [_vehicle(part, list(batches(config, part))) for part in shares(config) if part.routes]
    return Fleet(config, tuple(vehicles))


def trip_name(part: VehiclePart, trip: int) -> str:
    """The name of a route of a vehicle, its own in the fleet."""
    return f"{part.variant.id}-{trip + 1:05d}"


def joined(parts: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Columns of several batches, one after the other."""
    return {k: np.concatenate([p[k] for p in parts]) for k in parts[0]}


def _vehicle(part: VehiclePart, made: list[Batch]) -> FleetVehicle:
    log, truth = joined([b.log for b in made]), joined([b.truth for b in made])
    channels: dict[str, Any] = {
        k: x.astype(float) for k, x in log.items() if k not in (*ROW_FIELDS, "trip", "energy_wh")
    }
    ends = {k: log[k] for k in ROW_FIELDS}
    vehicle = np.full(len(log["trip"]), part.index)
    segments = Segments(trip=log["trip"], vehicle=vehicle, channels=channels, **ends)
    names = tuple(trip_name(part, k) for k in range(part.routes))
    return FleetVehicle(part.variant, segments, log["energy_wh"], truth, names, part.tabular, part.true, part.effects)
