"""What a simulated fleet is made from: one typed table, read from TOML with one line for whatever is wrong in it."""

import dataclasses
import difflib
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hdev_jax.errors import InputError
from hdev_jax.textfiles import read_toml

__all__ = ["Driving", "FleetConfig", "Gears", "Log", "Truth", "Weather", "load_config", "parse_config"]


def _number(default: float | int, lower: float | int, upper: float | int) -> Any:
    return field(default=default, metadata={"lower": lower, "upper": upper})


@dataclass(frozen=True)
class Driving:
    """Roads, traffic and drivers."""

    traffic: float = _number(1.0, 0.0, 3.0)  # 0: empty roads; 1: as on a working day; 3: jams
    hills: float = _number(1.0, 0.0, 2.5)  # factor on the slopes of the terrain
    comfort: float = _number(1.0, 0.3, 2.0)  # factor on the accelerations that drivers choose


@dataclass(frozen=True)
class Weather:
    """The season. Days are drawn over the year."""

    mean_c: float = _number(9.0, -20.0, 35.0)
    season_c: float = _number(9.5, 0.0, 30.0)  # half of the difference between summer and winter
    day_sd_c: float = _number(4.0, 0.0, 15.0)
    wind_mps: float = _number(3.0, 0.0, 15.0)  # mean at the height of the vehicle
    rain_share: float = _number(0.15, 0.0, 1.0)  # of the routes


@dataclass(frozen=True)
class Gears:
    """The shift program, see `hdev_jax.fleet.shifting`."""

    hysteresis: float = _number(
        0.10, 0.0, 0.5
    )  # speed at which it shifts up less that at which it shifts down, relative
    hysteresis_load: float = _number(0.05, 0.0, 0.5)  # more of it, in proportion to the load
    shift_time_s: float = _number(0.5, 0.0, 3.0)  # without torque
    hold_s: float = _number(2.0, 0.0, 10.0)  # between two shifts


@dataclass(frozen=True)
class Truth:
    """What the vehicles have and their sheets do not declare. Each effect is one of the library, by its id."""

    tabular_error: bool = True  # false: c_rr and C_d·A of the sheet are the true ones
    rolling_temperature: bool = True
    rolling_speed: bool = True
    tyre_warmup: bool = True
    wet_road: bool = True
    road_surface: bool = True
    cornering: bool = True
    headwind: bool = True
    crosswind: bool = True
    air_density: bool = True
    auxiliary_power: bool = True
    hvac_power: bool = True
    regen_limit: bool = True
    regen_cutoff: bool = True
    payload_bias: float = _number(0.03, -0.5, 0.5)  # the true mass is higher than the logged one by this share,
    payload_sd: float = _number(0.03, 0.0, 0.3)  # by trip


@dataclass(frozen=True)
class Log:
    """What the instruments add."""

    energy_noise_wh: float = _number(3.0, 0.0, 1000.0)
    energy_noise_share: float = _number(0.01, 0.0, 0.5)
    speed_noise_mps: float = _number(0.01, 0.0, 1.0)
    grade_noise_rad: float = _number(0.0003, 0.0, 0.02)
    clock_skew_s: float = _number(0.3, 0.0, 5.0)  # sd over the vehicles of the target's delay
    dropout_share: float = _number(0.005, 0.0, 0.5)  # rows that are missing


@dataclass(frozen=True)
class FleetConfig:
    """A fleet. `routes` are shared out evenly over the variants; a row is `SEGMENT_M` of road, or a halt."""

    seed: int = _number(1, 0, 2**32 - 1)
    routes: int = _number(5000, 1, 10**7)
    segments_per_route: int = _number(110, 20, 400)
    variants: tuple[str, ...] = ("all",)
    driving: Driving = field(default_factory=Driving)
    weather: Weather = field(default_factory=Weather)
    gears: Gears = field(default_factory=Gears)
    truth: Truth = field(default_factory=Truth)
    log: Log = field(default_factory=Log)

    def table(self) -> dict[str, Any]:
        """The resolved configuration as plain values."""
        return dataclasses.asdict(self)

    @property
    def chosen(self) -> tuple[Any, ...]:
        """The variants, in the order of the table."""
        from hdev_jax.fleet.variants import VARIANTS

        return VARIANTS if self.variants == ("all",) else tuple(v for v in VARIANTS if v.id in self.variants)


def load_config(path: str | Path) -> FleetConfig:
    """Read a configuration. Raises `InputError`, one line with file, key, what was found and what is accepted."""
    path = Path(path)
    table, _ = read_toml(path, "config")
    return parse_config(table, f"config {path}")


def parse_config(table: Mapping[str, Any], where: str = "config") -> FleetConfig:
    """The configuration in a table of plain values; what is left out has its default, but for the seed. Raises
    `InputError`."""
    if "seed" not in table:
        raise InputError(f"{where}: seed is missing; a whole number is expected (the same seed, the same fleet)")
    config = _parse(FleetConfig, table, where, "")
    _check_variants(config.variants, where)
    return config


def _parse(kind: Any, table: Mapping[str, Any], where: str, prefix: str) -> Any:
    fields = {f.name: f for f in dataclasses.fields(kind)}
    values: dict[str, Any] = {}
    for key, found in table.items():
        path = f"{prefix}{key}"
        if key not in fields:
            near = difflib.get_close_matches(str(key), list(fields), 1)
            hint = f"; did you mean {near[0]!r}?" if near else ""
            raise InputError(f"{where}: {path}: unknown key{hint}; accepted are {', '.join(fields)}")
        values[key] = _value(fields[key], found, where, path)
    return kind(**values)


def _value(f: "dataclasses.Field[Any]", found: Any, where: str, path: str) -> Any:
    if dataclasses.is_dataclass(f.type):
        if not isinstance(found, Mapping):
            raise InputError(f"{where}: {path}: found {found!r}; a section [{path}] is accepted")
        return _parse(f.type, found, where, path + ".")
    if f.type is bool:
        if not isinstance(found, bool):
            raise InputError(f"{where}: {path}: found {found!r}; true or false is accepted")
        return found
    if f.type in (int, float):
        low, high = f.metadata["lower"], f.metadata["upper"]
        whole = f.type is int
        good = isinstance(found, int if whole else int | float) and not isinstance(found, bool)
        if not good or not math.isfinite(found) or not low <= found <= high:
            what = "a whole number" if whole else "a number"
            raise InputError(f"{where}: {path}: found {found!r}; {what} from {low:g} to {high:g} is accepted")
        return f.type(found)
    if not isinstance(found, list | tuple) or not found or not all(isinstance(x, str) for x in found):
        raise InputError(f"{where}: {path}: found {found!r}; a list of names is accepted")
    return tuple(found)


def _check_variants(names: tuple[str, ...], where: str) -> None:
    from hdev_jax.fleet.variants import VARIANTS

    known = [v.id for v in VARIANTS]
    if names == ("all",):
        return
    for name in names:
        if name not in known:
            near = difflib.get_close_matches(name, known, 1)
            hint = f"; did you mean {near[0]!r}?" if near else ""
            raise InputError(
                f'{where}: variants: no variant {name!r}{hint}; accepted are "all" alone, or {", ".join(known)}'
            )
    if len(set(names)) < len(names):
        raise InputError(f"{where}: variants: a name is there twice")
