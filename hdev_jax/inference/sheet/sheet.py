"""The vehicle sheet: read from TOML, where the chain is entered, and traction force from motor torque."""

import copy
from collections.abc import Mapping
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
from hdev_jax.physics.vehicle import Entry
from hdev_jax.segments import Segments
from hdev_jax.targets import TARGETS, TargetName
from hdev_jax.textfiles import read_toml

__all__ = ["Sheet", "choose_entry", "read_sheet", "sheet_of_sections", "traction_force_from_torque"]


class Sheet:
    """A vehicle sheet, from Python as from TOML (contract, section 2).

    ```python
    Sheet(name="rigid truck, 26 t", mass_kg=18e3, road={"c_rr": (0.006, 0.0008), "cda_m2": (5.6, 0.5)},
          driveline={"efficiency": 0.91}, battery={"auxiliary_w": 2500.0})
    ```

    **Arguments:** `sections`: the keys of a sheet. A plain number is known and kept. A number with a standard
    deviation, `(value, sd)` or `{"value": …, "sd": …}`, is a tabular prior and is estimated. `library`: the effects
    that the section `effects` may name. `path`: the sheet's file; an efficiency map is looked for in its folder.

    **Fields:** `declared`: the coefficients by path (`road.c_rr`, `effects.headwind.scale`). `gear_ratios`: from the
    first gear up. `map_path`: the file of `efficiency_map`. `gear_model`: a file of gear trees.

    **Raises:** `InputError`, one line with the key, what was found and what is accepted.
    """

    def __init__(
        self, *, library: Mapping[str, type[Effect]] = LIBRARY, path: str | Path | None = None, **sections: Any
    ) -> None:
        self.path: Path = Path("sheet" if path is None else path)
        where = "sheet" if path is None else f"sheet {path}"
        declared, others = parse(where, _as_toml(sections), library)
        self.declared: dict[str, Declared] = declared
        self.library = library
        self.name: str = others.get("name", self.path.stem)
        self.gear_ratios: tuple[float, ...] | None = others.get("driveline.gear_ratios")
        self.final_drive: float | None = others.get("driveline.final_drive")
        self.wheel_radius_m: float | None = others.get("driveline.wheel_radius_m")
        self.rated_power_w: float | None = others.get("driveline.rated_power_w")
        self.rated_speed_radps: float | None = others.get("driveline.rated_speed_radps")
        model = others.get("driveline.gear_model")
        self.gear_model: Path | None = None if model is None else self.path.parent / model
        self.nominal_voltage_v: float | None = others.get("battery.nominal_voltage_v")
        self.capacity_wh: float | None = others.get("battery.capacity_wh")
        self.map_path: Path | None = self.path.parent / others["driveline.map"] if "driveline.map" in others else None
        self.efficiency_map: EfficiencyMap | None = None if self.map_path is None else read_map(self.map_path)
        self.source: str = others.get("source", "")
        self.notes: str = others.get("notes", "")

    def __repr__(self) -> str:
        free = [k for k, d in self.declared.items() if d.sd is not None or d.groups]
        known = [k for k in self.declared if k not in free]
        return (
            f"Sheet({self.name!r}; estimated: {', '.join(free) or 'nothing'}; known: {', '.join(known) or 'nothing'})"
        )

    def knowing(self, effects: Mapping[str, type[Effect]]) -> "Sheet":
        """The same sheet, with these effects added to its library."""
        other = copy.copy(self)
        other.library = {**self.library, **effects}
        return other

    def driveline(self, efficiency: Any, *, regenerating: Any = None, covers_machine: bool = False) -> Driveline:
        """The driveline with these efficiencies and the sheet's ratios and wheel radius (else the kernel's defaults).

        **Arguments:** `efficiency`, `regenerating`: a number in (0, 1], or an `EfficiencyMap`. `covers_machine`: they
        cover the chain from the wheel to the battery.
        """
        return Driveline(
            efficiency,
            None if self.gear_ratios is None else jnp.asarray(self.gear_ratios, dtype=float),
            np.asarray(1.0 if self.final_drive is None else self.final_drive),
            np.asarray(WHEEL_RADIUS_M if self.wheel_radius_m is None else self.wheel_radius_m),
            covers_machine,
            regenerating,
        )

    def fail(self, key: str, why: str) -> InputError:
        """The `InputError` for a key that is missing; `why` it is needed."""
        return InputError(f"sheet {self.path}: {key} is missing; it is needed because {why}")

    def knows_ratio(self, segments: Segments) -> bool:
        """Whether motor torque and wheel force can be separated in every row of the log."""
        by_gear = self.gear_ratios is not None and len(self.gear_ratios) > 1
        declared = self.wheel_radius_m is not None and (self.gear_ratios is not None or self.final_drive is not None)
        return declared and (not by_gear or segments.has("gear"))

    def need_ratios(self, segments: Segments, why: str) -> None:
        """Raise `InputError` unless motor torque and wheel force can be separated, row by row."""
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
        """Raise `InputError` where the log has a gear without a declared ratio; a single ratio holds for every gear."""
        ratios, most = len(self.gear_ratios or ()), most_group(segments, ("gear",))
        if 1 < ratios < most:
            raise InputError(
                f"sheet {self.path}: driveline.gear_ratios has {ratios} gears, but the log is in gear {most}; a ratio "
                "for each gear is expected"
            )


def read_sheet(path: str | Path, *, library: Mapping[str, type[Effect]] = LIBRARY) -> Sheet:
    """Read a vehicle sheet from a TOML file (contract, section 2).

    **Arguments:** `library`: the effects that a section `[effects.…]` may name.

    **Raises:** `InputError` for a fault in the sheet or in its efficiency map: one line with the file, the key, what
    was found and what is accepted.
    """
    table, _ = read_toml(Path(path), "sheet")
    return sheet_of_sections(table, library=library, path=path)


def sheet_of_sections(
    sections: Mapping[Any, Any], *, library: Mapping[str, type[Effect]] = LIBRARY, path: str | Path | None = None
) -> Sheet:
    """A sheet from a mapping of its sections. Raises `InputError` for a key that is none."""
    table = {str(k): v for k, v in sections.items()}
    if {"library", "path"} & {*table}:  # arguments of `Sheet`, unknown keys of a sheet
        parse("sheet" if path is None else f"sheet {path}", table, library)
    return Sheet(library=library, path=path, **table)


def _as_toml(found: Any) -> Any:
    """Values as TOML has them: `(value, sd)` as a table, arrays as lists."""
    if isinstance(found, Mapping):
        return {k: list(v) if k == "gear_ratios" and isinstance(v, tuple) else _as_toml(v) for k, v in found.items()}
    if isinstance(found, tuple) and len(found) == 2:
        return {"value": _as_toml(found[0]), "sd": _as_toml(found[1])}
    return found.tolist() if isinstance(found, np.generic | np.ndarray) else found


def choose_entry(segments: Segments, target: TargetName, sheet: Sheet) -> Entry:
    """Where the chain is entered: the measured quantity nearest the target, upstream of it.

    Torque alone is enough where the sheet gives the motor's speed from the vehicle's.
    """
    turns = segments.has("motor_speed_radps") or sheet.knows_ratio(segments)
    shaft = segments.has("motor_torque_nm") and turns
    measured = {"road": True, "wheel": segments.has("traction_force_n"), "shaft": shaft}
    return next(e for e in reversed(TARGETS[target].entries) if measured[e])


def traction_force_from_torque(segments: Segments, sheet: Sheet) -> Float[np.ndarray, " row"]:
    """Traction force at the wheels [N] from the measured motor torque: τ·i/r·η^sign(τ), i with the final drive.

    While driving the losses of the gears come off, while braking the wheels gave more than the motor got.

    **Raises:** `InputError` where the log lacks `motor_torque_nm`, or the sheet the ratios, radius or efficiency.
    """
    why = "the traction force is derived from the measured motor torque (torque · ratio / wheel radius · efficiency)"
    if not segments.has("motor_torque_nm"):
        raise InputError("the log has neither traction_force_n nor motor_torque_nm; one of them is needed as target")
    sheet.need_ratios(segments, why)
    back = sheet.declared.get("driveline.regenerating_efficiency")
    driveline = sheet.driveline(_declared_efficiency(sheet, why), regenerating=back and back.value)

    def force(row: Segments) -> Array:
        torque, ratio = row.channels["motor_torque_nm"], driveline.ratio_radpm(row)
        eta = driveline.efficiency_at(row, row.get("motor_speed_radps", row.speed_mps * ratio), torque)
        regenerating = driveline.regenerating_efficiency
        return torque * ratio * jnp.where(torque > 0, eta, 1.0 / (eta if regenerating is None else regenerating))

    return np.asarray(jax.vmap(force)(jax.tree.map(jnp.asarray, segments)), dtype=float)


def _declared_efficiency(sheet: Sheet, why: str) -> Any:
    """The driveline's efficiency as declared: the map, or the number."""
    if sheet.efficiency_map is not None:
        return sheet.efficiency_map
    if "driveline.efficiency" not in sheet.declared:
        raise sheet.fail("driveline.efficiency (or map)", why)
    return np.asarray(sheet.declared["driveline.efficiency"].value)
