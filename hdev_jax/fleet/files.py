"""A fleet on disk: a Parquet file of each vehicle for the log and one for the truth, written a batch at a time.

`log.parquet/<vehicle>.parquet` has the columns of the contract; `truth.parquet/<vehicle>.parquet` has the same rows
in the same order. Folders of such files are what Parquet readers take as one table, and `hdev` as one log."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from hdev_jax.fleet.config import FleetConfig
from hdev_jax.fleet.sheets import write_sheet
from hdev_jax.fleet.simulated import trip_name
from hdev_jax.fleet.simulator import Batch, VehiclePart, batches, shares
from hdev_jax.fleet.tally import Tally
from hdev_jax.rundir import Run

__all__ = ["LOG_COLUMNS", "write_fleet"]

LOG_COLUMNS = (
    "trip_id", "vehicle_id", "time_s", "duration_s", "distance_m", "speed_start_mps", "speed_end_mps", "mass_kg",
    "grade_rad", "altitude_m", "heading_rad", "curvature_1pm", "road_surface", "ambient_temp_c", "wind_speed_mps",
    "wind_from_rad", "wet_road", "gear", "requested_torque_nm", "energy_wh",
)  # fmt: skip
_WORKERS = 2


def write_fleet(config: FleetConfig, run: Run, tell: Callable[[str], None] = lambda _: None) -> list[Tally]:
    """Simulate and write everything but the report. **Returns** what the report needs of each vehicle, in order.

    Vehicles that a killed run had finished are there already.
    """
    folder = run.kept("fleet")
    for name in ("log.parquet", "truth.parquet", "sheets"):
        (folder / name).mkdir(parents=True, exist_ok=True)

    def one(part: VehiclePart) -> Tally:
        made = run.checkpoint(f"fleet-{part.variant.id}", lambda: _write_vehicle(config, part, folder).state())
        return Tally.of(part.variant, part.effects, made)

    parts = [p for p in shares(config) if p.routes]
    # the first vehicle alone: it compiles what all of them use
    done = [one(p) for p in parts[:1]]
    with ThreadPoolExecutor(_WORKERS) as pool:
        for tally in pool.map(one, parts[1:]):
            done.append(tally)
            if len(done) % 7 == 0:
                tell(f"{len(done)} of {len(parts)} vehicles, {sum(t.rows for t in done):,} rows")
    run.place(folder)
    return done


def _write_vehicle(config: FleetConfig, part: VehiclePart, folder: Path) -> Tally:
    import pyarrow.parquet as pq

    write_sheet(part.variant, config, folder / "sheets")
    tally = Tally(part.variant, part.effects)
    names = np.array([trip_name(part, k) for k in range(part.routes)])
    with ExitStack() as stack:
        writers: dict[str, Any] = {}
        for batch in batches(config, part):
            for kind, table in (("log", _log(batch, names)), ("truth", _truth(batch, names))):
                if kind not in writers:
                    path = folder / f"{kind}.parquet" / f"{part.variant.id}.parquet"
                    texts: Any = ["trip_id", "vehicle_id"]
                    writer = pq.ParquetWriter(path, table.schema, compression="zstd", use_dictionary=texts)
                    writers[kind] = stack.enter_context(writer)
                writers[kind].write_table(table)
            tally.add(batch)
    return tally


def _ids(batch: Batch, names: np.ndarray) -> dict[str, Any]:
    import pyarrow as pa

    trip = batch.log["trip"]
    vehicle = pa.array([batch.vehicle.variant.id], type=pa.string())
    return {
        "trip_id": pa.DictionaryArray.from_arrays(pa.array(trip, type=pa.int32()), pa.array(names)).cast(pa.string()),
        "vehicle_id": pa.DictionaryArray.from_arrays(pa.array(np.zeros(len(trip), np.int32)), vehicle).cast(
            pa.string()
        ),
    }


def _log(batch: Batch, names: np.ndarray) -> Any:
    import pyarrow as pa

    columns = _ids(batch, names)
    for name in LOG_COLUMNS[2:]:
        whole = name in ("gear", "road_surface")
        columns[name] = pa.array(batch.log[name].astype(np.int8 if whole else np.float64))
    return pa.table(columns)


def _truth(batch: Batch, names: np.ndarray) -> Any:
    """Whole numbers as such, the parts of the energy in single precision."""
    import pyarrow as pa

    columns = {"trip_id": _ids(batch, names)["trip_id"], "time_s": pa.array(batch.log["time_s"])}
    for name, x in sorted(batch.truth.items()):
        kind = np.int8 if x.dtype.kind in "iu" else np.float32 if name.startswith("energy_wh:") else np.float64
        columns[name] = pa.array(x.astype(kind))
    return pa.table(columns)
