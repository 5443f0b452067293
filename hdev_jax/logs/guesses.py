"""What other people call the contract's columns, word by word, with the unit that a header says."""

import re
from collections.abc import Collection
from dataclasses import dataclass

from hdev_jax.errors import InputError
from hdev_jax.logs.columns.headers import Header
from hdev_jax.units import COLUMNS, accepted, conversion, known_stem, unit_of

__all__ = ["Guess", "guess", "words_of"]


@dataclass(frozen=True)
class Guess:
    """A column of the contract that a header may be, and its unit; `sure` where the header itself says the unit."""

    name: str
    unit: str | None
    sure: bool


@dataclass(frozen=True)
class _Words:
    """A header may be `name` where it has a word of each set in `all_of` and none of `none_of`."""

    name: str
    unit: str | None
    all_of: tuple[Collection[str], ...]
    none_of: Collection[str] = ()


_BATTERY = {"battery", "hv", "pack", "traction", "hvb", "bms", "dclink", "dc"}
_MACHINE = {"motor", "machine", "engine", "emotor", "em", "drive"}
_NOT_MEASURED = {
    "limit", "target", "set", "setpoint", "request", "requested", "demand", "max", "min", "maximum", "minimum", "avg",
    "average", "rated", "allowed", "available",
}  # fmt: skip
_SMALL = {"cell", "aux", "auxiliary", "12v", "lv", "charger", "charge"}
_TEMPERATURE = {"temp", "temperature", "t"}
_AIR = {"air", "conditioning", "heater", "hvac", "ac", "climate", "heating", "cooling"}
_MOTION = {"accel", "acceleration", "acc", "velocity", "speed", "force", "g"}  # along and across the vehicle

_LETTERS = {"v": ("speed_mps", "m/s"), "t": ("time_s", "s")}  # alone, as in equations
_NUMBER = {"id", "no", "nr", "number", "name", "num"}
_IDS = {
    "trip_id": {"trip", "drive", "journey", "ride", "run"},
    "vehicle_id": {"vehicle", "veh", "car", "bus", "truck", "vin", "vehid", "vehicleid"},
}

# in this order: the first that fits
_COLUMNS = (
    _Words("motor_torque_nm", "N*m", ({"torque", "trq", "tq"},), _NOT_MEASURED | {"wheel"}),
    _Words("motor_speed_radps", "rpm", ({"rpm"},), {"fan", "wheel"}),
    _Words("motor_speed_radps", "rpm", (_MACHINE, {"speed"}), _NOT_MEASURED),
    _Words("wind_speed_mps", "m/s", ({"wind"}, {"speed"}), _NOT_MEASURED),
    _Words("speed_mps", "km/h", ({"speed", "velocity", "spd"},), _NOT_MEASURED | _MACHINE | {"wheel", "fan"}),
    _Words("duration_s", "s", ({"duration", "dt"},)),
    _Words("time_s", "s", ({"time", "timestamp", "clock", "seconds", "secs", "datetime", "zeit"},), {"zone", "travel"}),
    _Words("distance_m", "m", ({"distance", "dist"},), {"total", "empty", "odo", "odometer"} | _NOT_MEASURED),
    _Words("hvac_power_w", "W", ({"power"}, _AIR)),
    _Words("battery_power_w", "kW", ({"power"}, _BATTERY), _NOT_MEASURED | _SMALL | _AIR),
    _Words("battery_power_w", "kW", ({"power", "kw"},), _NOT_MEASURED | _SMALL | _AIR | {"wheel", "steering"}),
    _Words("energy_wh", "kW*h", ({"energy", "kwh", "wh"},), _NOT_MEASURED | {"total", "cumulative", "counter"}),
    _Words("soc", "%", ({"soc"},)),
    _Words("soc", "%", ({"state"}, {"charge"})),
    _Words("voltage_v", "V", ({"voltage", "volts", "volt"},), _NOT_MEASURED | _SMALL),
    _Words("current_a", "A", ({"current", "amps", "amp", "ampere"},), _NOT_MEASURED | _SMALL | _MACHINE | {"gear"}),
    _Words("ambient_temp_c", "degC", ({"ambient", "amb", "outside", "outdoor", "exterior", "external"}, _TEMPERATURE)),
    _Words("ambient_temp_c", "degC", ({"oat"},)),
    _Words("battery_temp_c", "degC", (_BATTERY, _TEMPERATURE), {"max", "min"}),
    _Words("altitude_m", "m", ({"altitude", "elevation", "alt", "elev", "elv", "height"},)),
    _Words("latitude_deg", "deg", ({"latitude", "lat"},), _MOTION),
    _Words("longitude_deg", "deg", ({"longitude", "lon", "long", "lng"},), _MOTION),
    _Words("grade_rad", "%", ({"grade", "slope", "gradient", "incline", "inclination"},), {"bias"}),
    _Words("mass_kg", "kg", ({"mass", "weight", "gvw", "gcw"},)),
    _Words("gear", None, ({"gear"},), _NOT_MEASURED | {"ratio"}),
    _Words("traction_force_n", "N", ({"force"},), {"brake"}),
    _Words("passengers", None, ({"passengers", "passenger"},)),
)  # fmt: skip


def words_of(header: str) -> list[str]:
    """`hvBatteryVoltage_V` → hv, battery, voltage, v."""
    apart = re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", " ", header)
    return [w.lower() for w in re.findall(r"[^\W_]+", apart)]


def guess(text: str, told: str | None = None) -> Guess | None:
    """The column that a header may be; `told` is the unit that a row of units has for it. None where no word says."""
    header = Header.of(text, told)
    words = set(words_of(header.name))
    for name, called in _IDS.items():
        if words & called and words <= called | _NUMBER and header.unit is None:
            return Guess(name, None, True)
    if len(words) == 1 and (letter := min(words)) in _LETTERS:
        name, usual = _LETTERS[letter]
        return Guess(name, header.unit or usual, header.unit is not None)
    exact = known_stem(header.name)
    found = [w for w in _COLUMNS if all(words & set(s) for s in w.all_of) and not words & set(w.none_of)]
    names = [exact] if exact else [w.name for w in found]
    for name in names:
        usual = next((w.unit for w in found if w.name == name), None)
        if header.unit is not None:
            if unit_of(name) in (None, "dimensionless") or _measures(name, header.unit):
                return Guess(name, header.unit if _measures(name, header.unit) else usual, True)
            continue  # a current in km/h is none
        suffix = _suffix(name, text)
        return Guess(name, suffix or usual, suffix is not None)
    return None


def _measures(name: str, unit: str) -> bool:
    try:
        conversion(name, unit, where=name)
    except InputError:
        return False
    return True


def _suffix(name: str, text: str) -> str | None:
    """The unit at the end of a header, `_time_ms`, where the column accepts it."""
    last = re.split(r"[_\s]", text)[-1].lower()
    stem = COLUMNS.get(name)
    endings = {a.removeprefix(f"{stem}_") for a in accepted(stem) if a != stem} if stem else set()
    return last if len(words_of(text)) > 1 and last in endings else None
