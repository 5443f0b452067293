"""The verb `export`: a vehicle sheet as a file that another program reads, and beside it what is not in it."""

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Literal

from hdev_jax.diagnosis.candidates.own import Effects, known_effects
from hdev_jax.errors import InputError
from hdev_jax.export.exported import Exported
from hdev_jax.export.kernel import Kernel, kernel_of
from hdev_jax.export.lookup import lookup
from hdev_jax.export.programs import onnx, stablehlo
from hdev_jax.export.simulators import fastsim, sumo
from hdev_jax.rundir import atomic_file
from hdev_jax.verbs.arguments import names_of
from hdev_jax.verbs.opening import Vehicles, sheet_of

__all__ = ["FORMATS", "SCHEMA", "export"]

SCHEMA = "hdev-export/1"
Format = Literal["stablehlo", "onnx", "lookup", "fastsim", "sumo"]
FORMATS: dict[str, tuple[Callable[[Kernel], Exported], tuple[str, ...]]] = {
    "stablehlo": (stablehlo, ()), "onnx": (onnx, (".onnx",)), "lookup": (lookup, (".csv",)),
    "fastsim": (fastsim, (".json", ".yaml")), "sumo": (sumo, (".xml",)),
}  # fmt: skip


def export(
    vehicle: Vehicles,
    to: Format,
    channels: str | Sequence[str] | None = None,
    effects: Effects = None,
    *,
    out: str | Path,
) -> str:
    """Write the sheet in another program's format, and beside it `OUT.json`: inputs, errors and what is left out.

    **Arguments:**

    - `vehicle`: a sheet's path, a `Sheet`, or what `diagnose` or `calibrate` returned. It is exported from the road to
      the battery.
    - `to`: `stablehlo` and `onnx` are functions that give the energy of rows [Wh]; `lookup` is a table of consumption
      at steady speeds [Wh/km]; `fastsim` and `sumo` are vehicles of those programs.
    - `channels`: inputs beside time, distance and speeds; by default slope, mass and what the sheet's effects read.

    **Returns:** what was written and what the format cannot hold, as text. **Raises:** `InputError`.
    """
    if to not in FORMATS:
        raise InputError(f"--to {to}: no such format; accepted: {', '.join(FORMATS)}")
    write, endings = FORMATS[to]
    path = Path(out)
    if endings and path.suffix not in endings:
        raise InputError(f"--out {out}: {to} is written to a file that ends in {' or '.join(endings)}")
    beside = path.with_name(path.name + ".json")
    sheet = sheet_of(vehicle, known_effects(effects))
    kernel = kernel_of(sheet, names_of(channels))
    exported = write(kernel)
    about = {
        "schema": SCHEMA, "format": to, "vehicle": sheet.name, "file": path.name,
        "sha256": hashlib.sha256(exported.content).hexdigest(), **exported.about,
        "left_out": [asdict(x) for x in exported.left_out],
    }  # fmt: skip
    for file, content in ((path, exported.content), (beside, (json.dumps(about, indent=2) + "\n").encode())):
        with atomic_file(file) as temporary:
            temporary.write_bytes(content)
    lines = [f"{path}: {sheet.name} for {to}, {len(exported.content):,} bytes; {beside.name} says what it holds"]
    if "inputs" in about:
        lines.append(f"inputs: {', '.join(kernel.inputs)}")
    if "error_wh_per_km" in about:
        lines.append(
            "interpolation error: {rms:.3g} Wh/km rms, {largest:.3g} largest".format(**about["error_wh_per_km"])
        )
    lines += [f"not in the file: {x}" for x in exported.left_out] or ["nothing of the sheet is left out"]
    return "\n".join(lines)
