"""Physical constants with their source, and conversion to SI at the border (nothing inside the package converts).

In files the unit is part of a column's name (`speed_kmh`); `parse_column` finds the contract's column and the unit,
`to_si` converts. Adapters name units freely (`unit = "km/h"`): `conversion` checks them against the column with pint.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from hdev_jax.errors import InputError

__all__ = [
    "AIR_DENSITY_KGPM3",
    "AIR_GAS_CONSTANT_JPKGK",
    "AIR_PRESSURE_PA",
    "AIR_TEMPERATURE_K",
    "COLUMNS",
    "GRAVITY_MPS2",
    "J_PER_WH",
    "NEEDED_STEMS",
    "UNITS_IN_USE",
    "ZERO_CELSIUS_K",
    "Conversion",
    "Parsed",
    "accepted",
    "canonical_name",
    "conversion",
    "is_unit",
    "known_stem",
    "parse_column",
    "registry",
    "to_si",
    "unit_of",
]

GRAVITY_MPS2 = 9.80665  # standard gravity, 3rd CGPM (1901)
AIR_DENSITY_KGPM3 = 1.225  # ISA at sea level, ISO 2533:1975
AIR_PRESSURE_PA = 101_325.0  # ISA at sea level, ISO 2533:1975
AIR_TEMPERATURE_K = 288.15  # ISA at sea level, ISO 2533:1975
AIR_GAS_CONSTANT_JPKGK = 287.05287  # dry air, ISO 2533:1975
ZERO_CELSIUS_K = 273.15  # definition of the degree Celsius, BIPM SI brochure (2019)
J_PER_WH = 3600.0  # 1 h = 3600 s, exact

# suffix in a header -> unit as pint writes it; the first of each kind is the one used in memory
_SUFFIXES: dict[str, dict[str, str]] = {
    "time": {"s": "second", "ms": "millisecond", "min": "minute", "h": "hour"},
    "length": {"m": "meter", "km": "kilometer", "cm": "centimeter", "mi": "mile", "ft": "foot"},
    "speed": {
        "mps": "meter/second", "kmh": "kilometer/hour", "kph": "kilometer/hour", "mph": "mile/hour", "knots": "knot",
    },
    "accel": {"mps2": "meter/second**2", "g": "standard_gravity"},
    "slope": {"rad": "radian", "pct": "%", "permille": "permille", "deg": "degree", "tan": "tan"},
    "mass": {"kg": "kilogram", "t": "metric_ton", "lb": "pound"},
    "torque": {"nm": "newton*meter", "knm": "kilonewton*meter", "lbft": "foot*force_pound"},
    "rotation": {
        "radps": "radian/second", "rpm": "revolution/minute", "degps": "degree/second", "rps": "revolution/second",
    },
    "force": {"n": "newton", "kn": "kilonewton", "lbf": "force_pound"},
    "temperature": {"c": "degree_Celsius", "k": "kelvin", "f": "degree_Fahrenheit", "degc": "degree_Celsius"},
    "density": {"kgpm3": "kilogram/meter**3"},
    "angle": {"rad": "radian", "deg": "degree"},
    "position": {"deg": "degree", "": "degree", "rad": "radian"},
    "curvature": {"1pm": "1/meter", "1pkm": "1/kilometer"},
    "power": {"w": "watt", "kw": "kilowatt", "hp": "horsepower"},
    "energy": {"wh": "watt*hour", "kwh": "kilowatt*hour", "j": "joule", "kj": "kilojoule", "mj": "megajoule"},
    "voltage": {"v": "volt", "mv": "millivolt", "kv": "kilovolt"},
    "current": {"a": "ampere", "ma": "milliampere", "ka": "kiloampere"},
    "pressure": {
        "pa": "pascal", "hpa": "hectopascal", "kpa": "kilopascal", "mpa": "megapascal", "bar": "bar", "mbar":
        "millibar", "psi": "psi",
    },
    "percent": {"pct": "percent"},
    "fraction": {"": "dimensionless", "pct": "percent"},
    "number": {"": "dimensionless"},
}  # fmt: skip

_STEMS = {
    "time": "time",
    "duration": "time",
    "distance": "length",
    "speed_start": "speed",
    "speed_end": "speed",
    "speed": "speed",
    "accel": "accel",
    "grade": "slope",
    "altitude": "length",
    "mass": "mass",
    "motor_torque": "torque",
    "motor_speed": "rotation",
    "gear": "number",
    "traction_force": "force",
    "ambient_temp": "temperature",
    "air_density": "density",
    "wind_speed": "speed",
    "wind_from": "angle",
    "heading": "angle",
    "latitude": "position",
    "longitude": "position",
    "curvature": "curvature",
    "wet_road": "fraction",
    "battery_temp": "temperature",
    "soc": "fraction",
    "voltage": "voltage",
    "current": "current",
    "hvac_power": "power",
    "brake_pressure": "pressure",
    "brake_pedal": "percent",
    "accelerator": "percent",
    "steering_angle": "angle",
    "articulation_angle": "angle",
    "passengers": "number",
    "door_open": "number",
    "grid_available": "number",
    "halt_brake": "number",
    "energy": "energy",
    "battery_power": "power",
}
# units that people log a quantity in: what a column may have been in whose unit is wrong
UNITS_IN_USE: dict[str, tuple[str, ...]] = {
    "speed_mps": ("m/s", "km/h", "mph", "knot"),
    "grade_rad": ("rad", "tan", "%", "permille", "deg"),
    "battery_power_w": ("W", "kW"),
    "energy_wh": ("Wh", "kWh", "J", "kJ", "MJ"),
}
NEEDED_STEMS = ("time", "duration", "distance", "speed_start", "speed_end", "speed")

# words that follow a stem in other people's headers and are no unit, though pint may know one of that name
_NOT_UNITS = {"min", "max", "mean", "avg", "std", "var", "count", "limit", "target", "set", "point", "id", "flag"}
_NOT_UNITS |= {"dc", "ac", "ref"}
_ALIASES = {
    "C": "degree_Celsius", "°C": "degree_Celsius", "F": "degree_Fahrenheit", "°F": "degree_Fahrenheit",
    "Nm": "newton*meter", "kNm": "kilonewton*meter", "t": "metric_ton", "1/min": "revolution/minute",
    "min-1": "revolution/minute", "m/s^2": "meter/second**2", "m/s²": "meter/second**2", "g0": "standard_gravity",
    "°": "degree", "℃": "degree_Celsius", "℉": "degree_Fahrenheit", "DegC": "degree_Celsius",
    "deg C": "degree_Celsius", "RPM": "revolution/minute", "KMH": "kilometer/hour", "km/hr": "kilometer/hour",
    "KM/H": "kilometer/hour", "MPH": "mile/hour", "mph": "mile/hour", "Ah": "ampere*hour", "‰": "permille",
    "": "dimensionless", "-": "dimensionless", "1": "dimensionless",
}  # fmt: skip
_SLOPE: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "tan": np.arctan,
    "%": lambda x: np.arctan(x / 100.0),
    "percent": lambda x: np.arctan(x / 100.0),
    "permille": lambda x: np.arctan(x / 1000.0),
}


@dataclass(frozen=True)
class Conversion:
    """From a file's unit to the one in memory: `call(x)`; `unit` is what the file has, for the report."""

    unit: str
    call: Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Parsed:
    """A header read: contract name (or the header itself), how to convert, and whether the contract knows it."""

    name: str
    conversion: Conversion
    known: bool


def _canonical(stem: str) -> str:
    suffix = next(iter(_SUFFIXES[_STEMS[stem]]))
    return f"{stem}_{suffix}" if suffix else stem


COLUMNS: dict[str, str] = {_canonical(stem): stem for stem in _STEMS}
"""Every column of the contract in memory's unit, and its stem."""


@cache
def registry() -> Any:
    """The one pint registry, built at the first conversion; pint's application registry is left alone."""
    import pint

    return pint.UnitRegistry(cache_folder=None)


@cache
def _affine(unit: str, to: str) -> tuple[float, float]:
    """`(offset, factor)` from `unit` to `to`. Raises pint's errors where there is no such conversion."""
    reg = registry()
    zero = float(reg.Quantity(0.0, unit).to(to).magnitude)
    factor = 1.0 if unit == to else float(reg.Quantity(1.0, unit).to(to).magnitude) - zero
    if "degree_" in to or "degree_" in unit:  # with an offset the difference of two readings loses digits: round it off
        factor = float(f"{factor:.12g}")
        zero = float(f"{zero:.12g}")
    return zero, factor


def _linear(unit: str, to: str) -> Callable[[np.ndarray], np.ndarray]:
    if unit == to:
        return lambda x: x
    offset, factor = _affine(unit, to)
    if offset:
        return lambda x: offset + factor * x
    return lambda x: factor * x


def accepted(stem: str) -> list[str]:
    """The names a column of this stem may have, the one in memory's unit first."""
    return [f"{stem}_{s}" if s else stem for s in _SUFFIXES[_STEMS[stem]]]


def _is_unit(word: str) -> bool:
    """Whether a word is a unit of something, by our suffixes or by pint's names."""
    if word in _NOT_UNITS:
        return False
    if any(word in kind for kind in _SUFFIXES.values() if word):
        return True
    try:
        return word in registry()
    except Exception:  # pint parses what it is asked: `in` fails in many ways on words that are no unit
        return False


def _near_suffix(word: str, stem: str) -> bool:
    """A misspelt suffix: one letter more, less or other than an accepted one of two letters or more."""
    from difflib import SequenceMatcher

    spelt = [s for s in _SUFFIXES[_STEMS[stem]] if len(s) > 2] + ["celsius", "kelvin"]
    return any(SequenceMatcher(None, word, s).ratio() >= 0.8 for s in spelt)


def parse_column(header: str) -> Parsed:
    """A file's header to the contract's column and its conversion; unknown names are kept as they are.

    Raises `InputError` for a column of the contract with a unit it cannot have (`battery_power_nm`).
    """
    stem, _, suffix = header.rpartition("_")
    if header in _STEMS and "" in _SUFFIXES[_STEMS[header]]:
        return Parsed(_canonical(header), Conversion("", lambda x: x), True)
    if stem in _STEMS:
        kind = _SUFFIXES[_STEMS[stem]]
        if suffix in kind and suffix:
            call = conversion(_canonical(stem), kind[suffix], where=header).call
            return Parsed(_canonical(stem), Conversion(suffix, call), True)
        numbers = _STEMS[stem] == "number"
        if header not in _STEMS and not numbers and (_is_unit(suffix) or _near_suffix(suffix, stem)):
            raise InputError(
                f"column '{header}': '{suffix}' is not a unit of {stem}; accepted: {', '.join(accepted(stem))}"
            )
    return Parsed(header, Conversion("", lambda x: x), False)


def canonical_name(header: str) -> str:
    """The contract's name of a header, or the header itself."""
    return parse_column(header).name


def unit_of(name: str) -> str | None:
    """The unit a column has in memory, as pint writes it, by its name; None where the name does not say."""
    if name in COLUMNS:
        return next(iter(_SUFFIXES[_STEMS[COLUMNS[name]]].values()))
    suffix = name.rpartition("_")[2]
    for kind in _SUFFIXES.values():
        if suffix and suffix in kind and "_" in name:
            return kind[suffix]
    return None


def conversion(name: str, unit: str, *, where: str) -> Conversion:
    """How to bring `unit` (pint's words, `tan` or `%` for slopes, or a header's suffix) to the unit of column `name`.

    Raises `InputError`, opening with `where`, if the two measure different things or the unit is unknown.
    """
    to = unit_of(name)
    stem = COLUMNS.get(name)
    kind = _SUFFIXES[_STEMS[stem]] if stem else {}
    if to is None:
        raise InputError(
            f"{where}: '{name}' names no unit, so '{unit}' cannot be converted: end the name in one (…_rad)"
        )
    slope = stem is not None and _STEMS[stem] == "slope"
    if slope and unit in (*_SLOPE, "pct"):
        return Conversion(unit, _SLOPE[kind.get(unit, unit)])
    try:
        call = _linear(_spelt(unit, kind), to)
    except Exception:  # pint raises a dozen kinds of error for a wrong unit; all mean the same to the user
        choices = [*(s for s in kind if s), *(("m/s", "km/h") if to == "meter/second" else ())]
        choices += _SLOPE if slope else ()
        raise InputError(
            f"{where}: '{unit}' is not a unit of {name}; accepted: {', '.join(dict.fromkeys(choices)) or to}"
        ) from None
    return Conversion(unit, call)


def _spelt(unit: str, kind: dict[str, str]) -> str:
    """A unit as pint writes it, from a header's suffix or from the words that people use."""
    spelt = unit if unit in _ALIASES else kind.get(unit, unit)
    spelt = _ALIASES.get(spelt, spelt).replace("°C", "degree_Celsius")
    if spelt == "%":
        return "percent"
    if spelt == "permille" or spelt in kind.values():  # not asked of pint, whose registry takes a second to load
        return spelt
    return spelt if _parses(spelt) or not _parses(spelt.lower()) else spelt.lower()


@cache
def _parses(unit: str) -> bool:
    try:
        registry().parse_units(unit)
    except Exception:  # pint raises a dozen kinds of error for what is no unit
        return False
    return True


def is_unit(text: str) -> bool:
    """Whether a text is a unit, with or without brackets: `km/h`, `[kW]`, `(°C)`, `%`."""
    plain = text.strip().strip("[]()").strip()
    if not plain or plain in _NOT_UNITS:
        return False
    spelt = _spelt(plain, {})
    return spelt in _SLOPE or _parses(spelt)


def known_stem(words: str) -> str | None:
    """The contract's column of a name without a unit, however it is written: `Motor Torque` → `motor_torque_nm`."""
    stem = "_".join(words.replace("_", " ").lower().split())
    return _canonical(stem) if stem in _STEMS else None


def to_si(values: np.ndarray | float, header: str) -> np.ndarray:
    """Values of a column named with its unit, in memory's unit: `to_si(36.0, "speed_kmh") == 10.0`."""
    return np.asarray(parse_column(header).conversion.call(np.asarray(values, dtype=np.float64)))


assert math.isclose(AIR_PRESSURE_PA / (AIR_GAS_CONSTANT_JPKGK * AIR_TEMPERATURE_K), AIR_DENSITY_KGPM3, rel_tol=1e-4)
