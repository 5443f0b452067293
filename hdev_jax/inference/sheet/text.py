"""A sheet written out again: the same vehicle with estimated coefficients and found effects, for every verb to read."""

import json
import math
from collections.abc import Mapping
from typing import Any

from hdev_jax.inference.sheet.schema import KEYS, SECTIONS, Declared, Prior, effect_key
from hdev_jax.inference.sheet.sheet import Sheet

__all__ = ["augmented_sheet"]

_Found = Mapping[str, Mapping[str, tuple[float, float | None, str]]]


def augmented_sheet(
    sheet: Sheet, calibration_values: Mapping[str, tuple[float, float | None]], effects: _Found, *, map_file: str = ""
) -> str:
    """TOML of the sheet with its coefficients at their estimates, and with these effects besides its own.

    What was estimated carries its sd (a prior for whoever reads the sheet next) and `estimated = true`: it may have
    absorbed what the model lacks and lie outside a table's range. A vehicle built from the text predicts what the
    calibrated one did, but for what was searched for by trip (a cycle's phase, the trips of a mode): a sheet is for any
    log, and every trip gets the mean.

    **Arguments:** `calibration_values`: (value, sd) by coefficient name (`road.c_rr`, `road.c_rr[B183]`,
    `effects.headwind.scale`, `effects.gear_efficiency.delta[2]`); `effects`: (value, sd, unit) by effect id and
    parameter, shapes and limits included, by gear as `delta[2]`. An sd that is None, 0 or NaN is left out, and the
    number is then known. `map_file`: what the text calls the efficiency map, for a copy that lies beside it; without
    it the map is named where it is.

    **Raises:** `ValueError` for a name that a sheet cannot hold.
    """
    declared = dict(sheet.declared)
    units = {path: key.unit for path, key in KEYS.items()}
    found = {f"effects.{e}.{p}": v for e, parameters in effects.items() for p, v in parameters.items()}
    for name, (value, sd, *_) in {**calibration_values, **found}.items():
        path, group = _split(name)
        if not path.startswith("effects.") and (path not in KEYS or KEYS[path].kind != "coefficient"):
            raise ValueError(f"{name!r} is no coefficient of a sheet")
        declared[path] = _updated(sheet, declared.get(path), path, group, (float(value), _sd(sd)))
    for path in declared:
        if path.startswith("effects."):
            _, effect_id, name = path.split(".")
            units[path] = next(p.unit for p in sheet.library[effect_id].parameters if p.name == name)
    return _write(sheet, declared, units, map_file)


def _sd(sd: float | None) -> float | None:
    return float(sd) if sd is not None and math.isfinite(sd) and sd > 0 else None


def _split(name: str) -> tuple[str, str | None]:
    """`road.c_rr[B183]` → (`road.c_rr`, `B183`)."""
    path, bracket, group = name.partition("[")
    return path, group.removesuffix("]") if bracket else None


def _updated(sheet: Sheet, old: Declared | None, path: str, group: str | None, prior: Prior) -> Declared:
    value, sd = prior
    if path.startswith("effects."):
        _, effect_id, name = path.split(".")
        if effect_id not in sheet.library or name not in {p.name for p in sheet.library[effect_id].parameters}:
            raise ValueError(f"{path!r} is no parameter of an effect in the library")
    if group is None:
        return Declared(value, sd, estimated=True)
    groups = {**(old.groups if old else {}), group: prior}
    if path.startswith("effects.") and _by_gear(sheet, path):
        return Declared(math.nan, groups=groups, estimated=True)
    if old is None or not old.per_vehicle:
        raise ValueError(f"{path!r} is not per vehicle in the sheet")
    return Declared(old.value, old.sd, per_vehicle=True, estimated=True, groups=groups)


def _by_gear(sheet: Sheet, path: str) -> bool:
    _, effect_id, name = path.split(".")
    cls = sheet.library[effect_id]
    return effect_key(cls, next(p for p in cls.parameters if p.name == name)).by_gear


def _write(sheet: Sheet, declared: Mapping[str, Declared], units: Mapping[str, str], map_file: str) -> str:
    others: dict[str, Any] = {
        "name": sheet.name,
        "source": sheet.source or None,
        "notes": sheet.notes or None,
        "driveline.gear_ratios": sheet.gear_ratios,
        "driveline.final_drive": sheet.final_drive,
        "driveline.wheel_radius_m": sheet.wheel_radius_m,
        "driveline.gear_model": str(sheet.gear_model.resolve()) if sheet.gear_model else None,
        "driveline.rated_power_w": sheet.rated_power_w,
        "driveline.rated_speed_radps": sheet.rated_speed_radps,
        "battery.nominal_voltage_v": sheet.nominal_voltage_v,
        "battery.capacity_wh": sheet.capacity_wh,
    }
    if sheet.map_path is not None:
        others["driveline.map"] = map_file or str(sheet.map_path.resolve())
    lines: list[str] = []
    for section, keys in SECTIONS.items():
        body = []
        for k in keys:
            path = f"{section}.{k}" if section else k
            if path in declared:
                body.append(f"{k} = {_coefficient(declared[path])}{_comment(sheet, path, units[path])}")
            elif others.get(path) is not None:
                body.append(f"{k} = {_other(others[path])}")
        lines += [f"[{section}]"] * bool(section and body) + body
    for effect_id in dict.fromkeys(p.split(".")[1] for p in declared if p.startswith("effects.")):
        lines += [f"[effects.{effect_id}]  # {sheet.library[effect_id].equation}"]
        for path, d in declared.items():
            if path.startswith(f"effects.{effect_id}."):
                comment = _comment(sheet, path, units[path])
                name = path.split(".")[2]
                lines.append(f"{name} = {_by_group(d) if math.isnan(d.value) else _coefficient(d)}{comment}")
    return "\n".join(lines) + "\n"


def _comment(sheet: Sheet, path: str, unit: str) -> str:
    """The unit, and what the sheet said before the estimate."""
    old, text = sheet.declared.get(path), "" if unit == "1" else unit
    if old is not None and old.sd is not None:
        text += ("; " if text else "") + f"declared as {old.value:g} ± {old.sd:g}"
    return f"  # {text}" if text else ""


def _text(x: str) -> str:
    """A TOML basic string: JSON's escapes are TOML's, but for DEL, which JSON leaves bare."""
    return json.dumps(x, ensure_ascii=False).replace("\x7f", "\\u007f")


def _other(x: Any) -> str:
    if isinstance(x, str):
        return _text(x)
    return f"[{', '.join(repr(v) for v in x)}]" if isinstance(x, tuple) else repr(x)


def _prior(prior: Prior) -> str:
    value, sd = prior
    return repr(value) if sd is None else f"{{ value = {value!r}, sd = {sd!r} }}"


def _by_group(d: Declared) -> str:
    return "{ " + ", ".join(f"{_text(k)} = {_prior(p)}" for k, p in d.groups.items()) + " }"


def _coefficient(d: Declared) -> str:
    """The shortest form that says it all."""
    if not d.per_vehicle and not d.estimated:
        return _prior((d.value, d.sd))
    parts = [f"value = {d.value!r}"]
    parts += [f"sd = {d.sd!r}"] * (d.sd is not None)
    parts += ["per_vehicle = true"] * d.per_vehicle + ["estimated = true"] * d.estimated
    parts += [f"vehicles = {_by_group(d)}"] * bool(d.groups)
    return "{ " + ", ".join(parts) + " }"
