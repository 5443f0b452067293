"""What may stand in a vehicle sheet: its sections and keys, their units and ranges, and the reading of one value."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NoReturn

from hdev_jax.errors import InputError
from hdev_jax.logs.adapter import near
from hdev_jax.physics import Effect, Parameter, Shape, Size

__all__ = ["KEYS", "SECTIONS", "Declared", "Key", "Prior", "effect_key", "parse"]

Prior = tuple[float, float | None]  # a value and its sd


@dataclass(frozen=True)
class Declared:
    """A number of the sheet: known without an `sd`, with one a tabular prior that is estimated.

    `per_vehicle`: one coefficient for each vehicle of the log, all with this prior but those in `groups`, by the
    vehicle's name. A parameter that an effect has by gear keeps its values in `groups`, by gear. `estimated`: the
    value comes from a calibration and need not be a plausible table's (it may have absorbed what the model lacks).
    """

    value: float
    sd: float | None = None
    per_vehicle: bool = False
    estimated: bool = False
    groups: Mapping[str, Prior] = field(default_factory=dict)


@dataclass(frozen=True)
class Key:
    """One key: what kind of value it takes, in which unit and range, and the support its estimate keeps to."""

    kind: Literal["coefficient", "number", "numbers", "file", "text"]
    unit: str = ""
    lower: float = -math.inf
    upper: float = math.inf
    above: bool = False  # `lower` itself is not in the range
    support: tuple[float, float] = (-math.inf, math.inf)
    by_gear: bool = False
    across_rows: bool = False  # cannot differ by vehicle: acts on whole columns

    @property
    def expected(self) -> str:
        """The range in words."""
        low = f"above {self.lower:g}" if self.above else f"of {self.lower:g} or more"
        match math.isfinite(self.lower), math.isfinite(self.upper):
            case True, True:
                return f"a number {low} and up to {self.upper:g}"
            case True, False:
                return f"a number {low}"
            case False, True:
                return f"a number up to {self.upper:g}"
        return "a finite number"

    def holds(self, x: float) -> bool:
        """Whether x is in the range."""
        return (x > self.lower if self.above else x >= self.lower) and x <= self.upper


_POSITIVE = (0.0, math.inf)
_EFFICIENCY = Key("coefficient", "1", 0.0, 1.0, above=True, support=_POSITIVE)
_LENGTH = Key("number", "m", 0.0, above=True)
# c_rr is a ratio of forces: 0.5 is beyond any road, and separates values in N/kN or kg/t (5 to 12) from it
SECTIONS: dict[str, dict[str, Key]] = {
    "": {
        "name": Key("text"),
        "source": Key("text"),
        "notes": Key("text"),
        "mass_kg": Key("coefficient", "kg", 0.0, above=True, support=_POSITIVE),
    },
    "road": {
        "c_rr": Key("coefficient", "1", 0.0, 0.5, support=_POSITIVE),
        "b_n_per_mps": Key("coefficient", "N·s/m"),
        "cda_m2": Key("coefficient", "m²", 0.0, support=_POSITIVE),
        "rotating_mass_factor": Key("coefficient", "1", 0.0, above=True, support=_POSITIVE),
    },
    "driveline": {
        "efficiency": _EFFICIENCY,
        "regenerating_efficiency": _EFFICIENCY,
        "map": Key("file"),
        "gear_ratios": Key("numbers", "1", 0.0, above=True),
        "final_drive": Key("number", "1", 0.0, above=True),
        "wheel_radius_m": _LENGTH,
        "gear_model": Key("file"),
        "rated_power_w": Key("number", "W", 0.0, above=True),
        "rated_speed_radps": Key("number", "rad/s", 0.0, above=True),
    },
    "machine": {"motoring_efficiency": _EFFICIENCY, "regenerating_efficiency": _EFFICIENCY},
    "battery": {
        "auxiliary_w": Key("coefficient", "W"),
        "nominal_voltage_v": Key("number", "V", 0.0, above=True),
        "capacity_wh": Key("number", "Wh", 0.0, above=True),
    },
}
KEYS: dict[str, Key] = {f"{s}.{k}" if s else k: key for s, keys in SECTIONS.items() for k, key in keys.items()}
_FIELDS = ("value", "sd", "per_vehicle", "estimated", "vehicles")


def effect_key(effect: type[Effect], p: Parameter) -> Key:
    """The key of an effect's parameter. A size may be anything; every other kind keeps to its plausible range."""
    bounds = (-math.inf, math.inf) if isinstance(p, Size) else (p.lower, p.upper)
    across = effect.across is not Effect.across or effect.observe is not Effect.observe
    return Key("coefficient", p.unit, *bounds, support=bounds, by_gear=bool(p.by), across_rows=across or bool(p.by))


def parse(
    where: str, table: Mapping[str, Any], effects: Mapping[str, type[Effect]]
) -> tuple[dict[str, Declared], dict[str, Any]]:
    """Coefficients by path, and whatever else is declared (texts, ratios, the map's file) by path.

    **Raises:** `InputError` that names file, key, what was found and what is accepted.
    """
    coefficients: dict[str, Declared] = {}
    others: dict[str, Any] = {}

    def take(path: str, key: Key, found: Any) -> None:
        if key.kind == "coefficient":
            coefficients[path] = _coefficient(where, path, key, found)
        else:
            others[path] = _other(where, path, key, found)

    for name, found in table.items():
        if name == "effects":
            for path, key, value in _effects(where, found, effects):
                take(path, key, value)
        elif name in SECTIONS[""]:
            take(name, SECTIONS[""][name], found)
        elif name in SECTIONS:
            for k, value in _section(where, name, found).items():
                if k not in SECTIONS[name]:
                    _unknown(where, f"{name}.{k}", k, tuple(SECTIONS[name]))
                take(f"{name}.{k}", SECTIONS[name][k], value)
        else:
            _unknown(where, name, name, (*SECTIONS[""], *(s for s in SECTIONS if s), "effects"))
    if "driveline.efficiency" in coefficients and "driveline.map" in others:
        raise InputError(f"{where}: driveline.efficiency and driveline.map are both there; one of them is accepted")
    if "driveline.regenerating_efficiency" in coefficients and not {"driveline.efficiency", "driveline.map"} & {
        *coefficients, *others
    }:  # fmt: skip
        raise InputError(f"{where}: driveline.regenerating_efficiency: found without an efficiency or map beside it")
    for path in (p for p in coefficients if p.startswith("effects.")):
        _, effect_id, name = path.split(".")
        if (same := effects[effect_id].declared.get(name)) in coefficients:
            raise InputError(f"{where}: {same} and {path} are both there, and are one force; one of them is accepted")
    _say_something(where, coefficients, effects)
    return coefficients, others


def _fail(where: str, path: str, found: Any, expected: str) -> NoReturn:
    raise InputError(f"{where}: {path}: found {_shown(found)}; {expected} is accepted")


def _unknown(where: str, path: str, name: str, choices: tuple[str, ...]) -> NoReturn:
    hint = near(name, choices)
    if not hint:  # in the wrong place?
        homes = [p for p in KEYS if p.rpartition(".")[2] == name]
        hint = f", it stands in [{homes[0].partition('.')[0]}]" if homes and "." in homes[0] else ""
    raise InputError(f"{where}: {path}: unknown key{hint}; accepted are {', '.join(choices)}")


def _shown(x: Any) -> str:
    if isinstance(x, bool):
        return str(x).lower()
    if isinstance(x, str):
        return repr(x)
    if isinstance(x, Mapping):
        return "a table {" + ", ".join(x) + "}"
    if isinstance(x, list):
        return "a list [" + ", ".join(_shown(v) for v in x[:4]) + (", …]" if len(x) > 4 else "]")
    return str(x)[:40]


def _section(where: str, name: str, found: Any) -> Mapping[str, Any]:
    if not isinstance(found, Mapping):
        _fail(where, name, found, f"a section [{name}]")
    return found


def _finite(x: Any) -> float | None:
    """x as a float; None for what is not a finite number (true and false are none)."""
    if isinstance(x, bool) or not isinstance(x, int | float):
        return None
    try:
        value = float(x)
    except OverflowError:
        return None
    return value if math.isfinite(value) else None


def _number(where: str, path: str, key: Key, found: Any) -> float:
    value = _finite(found)
    if value is None or not key.holds(value):
        _fail(where, path, found, key.expected)
    return value


def _other(where: str, path: str, key: Key, found: Any) -> Any:
    if key.kind == "number":
        return _number(where, path, key, found)
    if key.kind == "numbers":
        if not isinstance(found, list) or not found:
            _fail(where, path, found, "a list of numbers above 0, by gear from the first,")
        return tuple(_number(where, f"{path}[{k}]", key, x) for k, x in enumerate(found, start=1))
    if not isinstance(found, str) or (key.kind == "file" and not found.strip()):
        _fail(where, path, found, "the name of a CSV file" if key.kind == "file" else "a text")
    return found


def _coefficient(where: str, path: str, key: Key, found: Any) -> Declared:
    """A number; `{ value, sd, per_vehicle, estimated, vehicles }`; by gear, a table of those."""
    if not isinstance(found, Mapping):
        if _finite(found) is None:
            _fail(where, path, found, f"{key.expected}, or {{ value = …, sd = … }},")
        return Declared(_number(where, path, key, found))
    if key.by_gear and found and all(k.isdecimal() for k in found):
        return Declared(math.nan, groups={str(int(k)): _prior(where, f"{path}.{k}", key, v) for k, v in found.items()})
    for k in found:
        if k not in _FIELDS:
            _unknown(where, f"{path}.{k}", k, _FIELDS)
    if "value" not in found:
        raise InputError(f"{where}: {path}: found {_shown(found)}; {{ value = …, sd = … }} is accepted")
    flags = {}
    for k in ("per_vehicle", "estimated"):
        flags[k] = found.get(k, False)
        if not isinstance(flags[k], bool):
            _fail(where, f"{path}.{k}", flags[k], "true or false")
    if flags["estimated"]:  # what absorbs something may leave the table's range
        key = replace(key, lower=key.support[0], upper=key.support[1])
    value, sd = _prior(where, path, key, {k: v for k, v in found.items() if k in ("value", "sd")})
    vehicles = _section(where, f"{path}.vehicles", found.get("vehicles", {}))
    groups = {name: _prior(where, f"{path}.vehicles.{name}", key, v) for name, v in vehicles.items()}
    if groups and not flags["per_vehicle"]:
        raise InputError(f"{where}: {path}: found vehicles without per_vehicle = true; both are accepted, or neither")
    if flags["per_vehicle"]:
        if key.across_rows:
            raise InputError(f"{where}: {path}: found per_vehicle = true; one value for all vehicles is accepted here")
        if sd is None and not groups:
            raise InputError(
                f"{where}: {path}: found per_vehicle = true without an sd; a number that is estimated, "
                "{ value = …, sd = …, per_vehicle = true }, is accepted"
            )
    return Declared(value, sd, groups=groups, **flags)


def _prior(where: str, path: str, key: Key, found: Any) -> Prior:
    if not isinstance(found, Mapping):
        return _number(where, path, key, found), None
    for k in found:
        if k not in ("value", "sd"):
            _unknown(where, f"{path}.{k}", k, ("value", "sd"))
    if "value" not in found:
        _fail(where, path, found, "a number, or { value = …, sd = … },")
    value = _number(where, f"{path}.value", key, found["value"])
    if "sd" not in found:
        return value, None
    sd = _finite(found["sd"])
    if sd is None or sd <= 0:
        _fail(where, f"{path}.sd", found["sd"], "a number above 0 (leave it out where the value is known)")
    return value, sd


def _effects(where: str, found: Any, effects: Mapping[str, type[Effect]]) -> list[tuple[str, Key, Any]]:
    """(path, key, what was found) of every parameter in [effects.*]."""
    out = []
    for effect_id, section in _section(where, "effects", found).items():
        path = f"effects.{effect_id}"
        if effect_id not in effects:
            raise InputError(
                f"{where}: {path}: unknown effect{near(effect_id, tuple(effects))}; an effect of the library is "
                "accepted (`hdev effects` lists them)"
            )
        parameters = {p.name: p for p in effects[effect_id].parameters}
        for name, value in _section(where, path, section).items():
            if name not in parameters:
                _unknown(where, f"{path}.{name}", name, tuple(parameters))
            out.append((f"{path}.{name}", effect_key(effects[effect_id], parameters[name]), value))
        if not section:
            raise InputError(
                f"{where}: {path}: found no parameter; at least one of {', '.join(parameters)} is accepted"
            )
    return out


def _say_something(where: str, coefficients: dict[str, Declared], effects: Mapping[str, type[Effect]]) -> None:
    """Refuse an effect whose sizes and switches are all known to be null: it would be there in name only."""
    for effect_id in dict.fromkeys(path.split(".")[1] for path in coefficients if path.startswith("effects.")):
        sizes = [p for p in effects[effect_id].parameters if not isinstance(p, Shape)]
        priors = [
            (p, x)
            for p in sizes
            if (d := coefficients.get(f"effects.{effect_id}.{p.name}"))
            for x in [(d.value, d.sd), *d.groups.values()]
            if not math.isnan(x[0])
        ]
        if all(value == p.null and sd is None for p, (value, sd) in priors):
            names = ", ".join(p.name for p in sizes)
            raise InputError(
                f"{where}: effects.{effect_id}: found no value other than that of a vehicle without it; "
                f"a size or switch ({names}) that is not {sizes[0].null:g}, or has an sd, is accepted"
            )
