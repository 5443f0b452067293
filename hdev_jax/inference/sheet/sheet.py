"""The vehicle sheet: read from TOML, where the chain is entered, and traction force from motor torque."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hdev_jax.errors import InputError
from hdev_jax.inference.maps.read import read_map
from hdev_jax.inference.sheet.schema import Declared, parse
from hdev_jax.physics import LIBRARY, Driveline, Effect, EfficiencyMap, most_group
from hdev_jax.physics.driveline import WHEEL_RADIUS_M
from hdev_jax.physics.vehicle import Entry, Target
from hdev_jax.segments import Segments
from hdev_jax.textfiles import read_toml

__all__ = ["BATTERY_TARGETS", "Sheet", "choose_entry", "read_sheet", "traction_force_from_torque"]

BATTERY_TARGETS = ("energy_wh", "battery_power_kw")


@dataclass(frozen=True, eq=False)
class Sheet:
    """A vehicle sheet as read. `declared` holds the coefficients by path (`road.c_rr`, `effects.headwind.scale`).

    `gear_ratios` count from the first gear; `map_path` is where `efficiency_map` came from. `library` are the effects
    that [effects.*] may name.
    """

    name: str
    path: Path
    text: str
    declared: Mapping[str, Declared]
    gear_ratios: tuple[float, ...] | None = None
    final_drive: float | None = None
    wheel_radius_m: float | None = None
    efficiency_map: EfficiencyMap | None = None
    map_path: Path | None = None
    source: str = ""
    notes: str = ""
    library: Mapping[str, type[Effect]] = field(default_factory=lambda: LIBRARY, repr=False)

    def driveline(self, efficiency: Any, *, covers_machine: bool = False) -> Driveline:
        """The driveline with the sheet's ratios and this efficiency; what is not declared is the kernel's default."""
        return Driveline(
            efficiency,
            None if self.gear_ratios is None else jnp.asarray(self.gear_ratios, dtype=float),
            np.asarray(1.0 if self.final_drive is None else self.final_drive),
            np.asarray(WHEEL_RADIUS_M if self.wheel_radius_m is None else self.wheel_radius_m),
            covers_machine,
        )

    def fail(self, key: str, why: str) -> InputError:
        """The error for a key that is missing."""
        return InputError(f"sheet {self.path}: {key} is missing; it is needed because {why}")

    def need_ratios(self, segments: Segments, why: str) -> None:
        """Raise `InputError` unless motor torque and wheel force can be told from each other, row by row."""
        if self.gear_ratios is None and self.final_drive is None:
            raise self.fail("driveline.gear_ratios (or final_drive)", why)
        if self.wheel_radius_m is None:
            raise self.fail("driveline.wheel_radius_m", why)
        if self.gear_ratios is not None and len(self.gear_ratios) > 1:
            if not segments.has("gear"):
                raise InputError(
                    f"sheet {self.path}: driveline.gear_ratios has {len(self.gear_ratios)} gears, but the log has no "
                    "column 'gear'; one ratio, or a log with gears, is expected"
                )
            self.check_gears(segments)

    def check_gears(self, segments: Segments) -> None:
        """Raise `InputError` where the log is in a gear beyond the declared ratios; one ratio holds for all."""
        ratios, most = len(self.gear_ratios or ()), most_group(segments, ("gear",))
        if 1 < ratios < most:
            raise InputError(
                f"sheet {self.path}: driveline.gear_ratios has {ratios} gears, but the log is in gear {most}; a ratio "
                "for each gear is expected"
            )


def read_sheet(path: str | Path, *, library: Mapping[str, type[Effect]] = LIBRARY) -> Sheet:
    """Read a sheet (contract, section 2). `library`: the effects that [effects.*] may name.

    **Raises:** `InputError`, one line with file, key, what was found and what is accepted, for whatever is wrong in it
    or in the efficiency map it names.
    """
    path = Path(path)
    where = f"sheet {path}"
    table, text = read_toml(path, "sheet")
    declared, others = parse(where, table, library)
    map_path = None
    if "driveline.map" in others:
        map_path = path.parent / others["driveline.map"]
    return Sheet(
        name=others.get("name", path.stem),
        path=path,
        text=text,
        declared=declared,
        gear_ratios=others.get("driveline.gear_ratios"),
        final_drive=others.get("driveline.final_drive"),
        wheel_radius_m=others.get("driveline.wheel_radius_m"),
        efficiency_map=None if map_path is None else read_map(map_path),
        map_path=map_path,
        source=others.get("source", ""),
        notes=others.get("notes", ""),
        library=library,
    )


def choose_entry(segments: Segments, target: Target) -> Entry:
    """Where the chain is entered: the measured quantity nearest the target, upstream of it."""
    if target in BATTERY_TARGETS and segments.has("motor_torque_nm", "motor_speed_radps"):
        return "shaft"
    if target != "traction_force_n" and segments.has("traction_force_n"):
        return "wheel"
    return "road"


def traction_force_from_torque(segments: Segments, sheet: Sheet) -> Float[np.ndarray, " row"]:
    """Traction force at the wheels [N] from the measured motor torque: τ·i/r·η^sign(τ), i with the final drive.

    While driving the losses of the gears come off, while braking the wheels gave more than the motor got.

    **Raises:** `InputError` where the log lacks `motor_torque_nm`, or the sheet the ratios, radius or efficiency.
    """
    why = "the traction force is derived from the measured motor torque (torque · ratio / wheel radius · efficiency)"
    if not segments.has("motor_torque_nm"):
        raise InputError("the log has neither traction_force_n nor motor_torque_nm; one of them is needed as target")
    sheet.need_ratios(segments, why)
    efficiency = _declared_efficiency(sheet, why)
    driveline = sheet.driveline(efficiency)

    def force(row: Segments) -> Array:
        torque, ratio = row.channels["motor_torque_nm"], driveline.ratio_radpm(row)
        eta = driveline.efficiency_at(row, row.get("motor_speed_radps", row.speed_mps * ratio), torque)
        return torque * ratio * jnp.where(torque > 0, eta, 1.0 / eta)

    return np.asarray(jax.vmap(force)(jax.tree.map(jnp.asarray, segments)), dtype=float)


def _declared_efficiency(sheet: Sheet, why: str) -> Any:
    """The driveline's efficiency as declared: the map, or the number."""
    if sheet.efficiency_map is not None:
        return sheet.efficiency_map
    if "driveline.efficiency" not in sheet.declared:
        raise sheet.fail("driveline.efficiency (or map)", why)
    return np.asarray(sheet.declared["driveline.efficiency"].value)
