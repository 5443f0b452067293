"""Adapters: a TOML file that says which columns of a foreign log are which of the contract's."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo

from hdev_jax.errors import InputError
from hdev_jax.logs.expression import check_expression, names_in
from hdev_jax.logs.schema import (
    checked,
    flag,
    near,
    not_negative,
    number,
    one_of,
    pair,
    regex,
    span,
    table,
    text,
    texts,
    whole,
)  # fmt: skip
from hdev_jax.textfiles import read_toml
from hdev_jax.units import COLUMNS, conversion, parse_column, unit_of

__all__ = ["FILLS", "FORMATS", "LAYOUTS", "RESAMPLINGS", "Adapter", "Companion", "Long", "Rule", "near"]

FORMATS = ("csv", "parquet", "feather", "jsonl", "xlsx", "mat", "xml", "mf4", "blf", "asc")
LAYOUTS = ("table", "time_value", "long")
FILLS = ("forward", "nearest", "linear")
RESAMPLINGS = ("mean", "sum", "last", "linear")
_TEXT_COLUMNS = ("trip_id", "vehicle_id")
_THOUSANDS = (".", ",", "'", "’", " ", "\u00a0", "\u202f")


@dataclass(frozen=True)
class Rule:
    """How one column comes about: source or `expr` → `valid` → `fill` → `affine` → `unit`.

    `valid` is in the source's numbers: a value outside is missing. Missing values are filled inside a trip (`forward`,
    `nearest`, `linear` over time; before the first value `initial`), then `a + b·x`, then the unit is brought to SI.
    A source that is itself a column made here is taken in SI, after its own fill. Of `alternatives` (in TOML `or`) the
    first that the file has stands in for a source that it lacks. An id, and a clock of date and time, may have several
    sources; `format` is a clock's, in the letters of strptime. Of a `counter`, an odometer or the energy since some
    start, each sample has what was added around it. `resample` says how a channel of another rate is put on the clock;
    without it, its quantity does (`logs/columns/clocked.py`).
    """

    source: str | tuple[str, ...]
    unit: str | None = None
    fill: str | None = None
    initial: float | None = None
    affine: tuple[float, float] | None = None
    valid: tuple[float, float] | None = None
    expr: str | None = None
    format: str | None = None
    alternatives: tuple[str, ...] = ()
    counter: bool = False
    resample: str | None = None

    @property
    def sources(self) -> tuple[str, ...]:
        """The columns that it names."""
        return (self.source,) if isinstance(self.source, str) else self.source


@dataclass(frozen=True)
class Companion:
    """A file beside the log whose columns are joined by the key `on`; it is never a log of its own."""

    suffix: str
    on: str
    optional: bool = False


@dataclass(frozen=True)
class Long:
    """The columns of a table with a row for each value: when, of which channel, how much, in which unit; `clock` is the
    channel at whose times rows are made, of several the first that the file has."""

    time: str
    name: str
    value: str
    unit: str | None = None
    clock: str | tuple[str, ...] | None = None


@dataclass(frozen=True)
class Adapter:
    """What a file of this kind means. `where` names it in messages; without arguments it changes nothing.

    `clock` names the channel at whose times rows are made where channels have rates of their own, of several the first
    that the file has, or is a step [s]; `dbc` the databases of CAN frames. `others` (keep or drop) says what becomes of
    columns without a rule: a table's are kept, signals of a bus are dropped.
    `rows` keeps the rows where that column was measured; `charging` says whether charging at standstill is cut;
    `repeated_stamps = "spread"` spreads rows of one time stamp over the time to the next; `stamp` says where in its
    time a row's stamp is: in the middle of a sample, at the end or at the start of a mean.
    """

    where: str = "adapter"
    preset: str | None = None
    format: str | None = None
    layout: str = "table"
    long: Long | None = None
    header_line: int | None = None
    decimal: str | None = None
    thousands: str | None = None
    trip_id: str | None = None
    vehicle_id: str | None = None
    variable: str | None = None
    companion: Companion | None = None
    edge_trim_s: float = 0.0
    time_zone: str | None = None
    repeated_stamps: str = "drop"
    stamp: str = "middle"
    rows: str | None = None
    charging: str = "cut"
    others: str | None = None
    clock: str | tuple[str, ...] | float | None = None
    dbc: tuple[str, ...] = ()
    columns: Mapping[str, Rule] = field(default_factory=dict)

    @staticmethod
    def load(path: str | Path) -> "Adapter":
        """Read a TOML file. Raises `InputError` for whatever is wrong in it."""
        path = Path(path)
        made = Adapter.from_dict(read_toml(path, "adapter")[0], where=path.name)
        return replace(made, dbc=tuple(str(path.parent / d) for d in made.dbc))

    @staticmethod
    def from_dict(values: Mapping[str, Any], where: str = "adapter") -> "Adapter":
        """Check a table read from TOML. Raises `InputError` naming key, value and what is accepted."""
        known = {
            "preset": text,
            "format": one_of(FORMATS),
            "layout": one_of(LAYOUTS),
            "long": _long,
            "header_line": whole,
            "decimal": one_of((".", ",")),
            "thousands": one_of(_THOUSANDS),
            "trip_id": regex,
            "vehicle_id": regex,
            "variable": regex,
            "companion": _companion,
            "edge_trim_s": not_negative,
            "time_zone": _zone,
            "repeated_stamps": one_of(("drop", "spread")),
            "stamp": one_of(("middle", "end", "start")),
            "rows": text,
            "charging": one_of(("cut", "keep")),
            "others": one_of(("keep", "drop")),
            "clock": _clock,
            "dbc": _files,
            "columns": _columns,
        }
        made = Adapter(where=where, **checked(values, known, where))
        if made.preset is None and (made.long is None) == (made.layout == "long"):
            raise InputError(f'{where}: layout = "long" and a table [long] with time, name and value go together')
        return made

    def over(self, preset: "Adapter") -> "Adapter":
        """This adapter with what it leaves open taken from a preset; its rules go before the preset's."""
        usual = Adapter()
        own = {k: v for k in vars(usual) if (v := getattr(self, k)) != getattr(usual, k)}
        return replace(preset, **own | {"columns": {**preset.columns, **self.columns}})

    def without(self, column: str) -> "Adapter":
        """This adapter without its rule for a column."""
        return replace(self, columns={c: r for c, r in self.columns.items() if c != column})

    def match(self, pattern: str, name: str) -> str | None:
        """First group of the pattern in `name` (the whole match where it has none), None without a match."""
        found = re.search(pattern, name)
        if found is None:
            return None
        return next((g for g in found.groups() if g is not None), found.group(0))

    def is_companion(self, name: str) -> bool:
        """Whether a file of this name goes beside a log."""
        return self.companion is not None and name.endswith(self.companion.suffix)


def _zone(where: str, value: Any) -> str:
    try:
        ZoneInfo(text(where, value))
    except (ValueError, OSError, ModuleNotFoundError, KeyError):
        raise InputError(f"{where} = {value!r}: a place such as 'Europe/Zurich' is expected") from None
    return value


def _companion(where: str, value: Any) -> Companion:
    values = table(where, value, ())
    got = checked(values, {"suffix": text, "on": text, "optional": flag}, where)
    table(where, value, ("suffix", "on"))
    return Companion(**got)


def _clock(where: str, value: Any) -> str | tuple[str, ...] | float:
    if isinstance(value, int | float) and not isinstance(value, bool):
        if (step := number(where, value)) <= 0:
            raise InputError(f"{where} = {value!r}: a step above 0 s is expected, or the name of a channel")
        return step
    return texts(where, value)


def _files(where: str, value: Any) -> tuple[str, ...]:
    names = texts(where, value)
    return (names,) if isinstance(names, str) else names


def _long(where: str, value: Any) -> Long:
    values = table(where, value, ())
    got = checked(values, {"time": text, "name": text, "value": text, "unit": text, "clock": texts}, where)
    table(where, value, ("time", "name", "value"))
    return Long(**got)


def _columns(where: str, value: Any) -> dict[str, Rule]:
    rules: dict[str, Rule] = {}
    known = {
        "source": texts,
        "or": texts,
        "expr": lambda w, v: check_expression(w, text(w, v)),
        "unit": lambda w, v: v if v == "" else text(w, v),
        "fill": one_of(FILLS),
        "initial": number,
        "affine": pair,
        "valid": span,
        "format": text,
        "counter": flag,
        "resample": one_of(RESAMPLINGS),
    }
    for name, entry in table(where, value, ()).items():
        here = f"{where}.{name}"
        if isinstance(entry, str | list):  # speed_mps = "v": short for { source = "v" }
            entry = {"source": entry}
        got = checked(table(here, entry, ()), known, here)
        if "expr" in got:
            if "source" in got:
                raise InputError(f"{here}: source or expr, one of the two")
            got["source"] = names_in(got["expr"], f"{here}.expr")
        table(here, {**entry, **got}, ("source",))
        alternatives = got.pop("or", ())
        rule = Rule(**got, alternatives=(alternatives,) if isinstance(alternatives, str) else alternatives)
        if rule.initial is not None and rule.fill is None:
            raise InputError(f"{here}: initial needs a fill (one of {', '.join(FILLS)})")
        target = _target(here, name)
        if len(rule.sources) > 1 and rule.expr is None and target not in (*_TEXT_COLUMNS, "time_s"):
            raise InputError(f"{here}: several sources are for trip_id, vehicle_id and time_s; use expr to calculate")
        if rule.format is not None and target != "time_s":
            raise InputError(f"{here}: format is for time_s")
        if rule.counter and target not in ("energy_wh", "distance_m"):
            raise InputError(f"{here}: counter is for energy_wh and distance_m, which are sums")
        if target in rules:
            raise InputError(f"{here}: a second rule for {target}")
        if target != name and rule.unit is None and name not in _TEXT_COLUMNS:
            rule = replace(rule, unit=name.rpartition("_")[2])
        if rule.unit is not None:
            conversion(target, rule.unit, where=f"{here}.unit")
        rules[target] = rule
    _no_cycles(where, rules)
    return rules


def _target(where: str, name: str) -> str:
    """The contract's name of a rule's left side; misspelt contract names are refused, names of one's own are not."""
    if name in _TEXT_COLUMNS:
        return name
    try:
        parsed = parse_column(name)
    except InputError as e:
        raise InputError(f"{where}: {e}") from None
    if not parsed.known and unit_of(name) is None:
        choices = [*COLUMNS, *_TEXT_COLUMNS]
        if hint := near(name, choices, 0.8):
            raise InputError(f"{where}: unknown column '{name}'{hint}")
    return parsed.name


def _no_cycles(where: str, rules: Mapping[str, Rule]) -> None:
    """No rule draws on itself by way of others; the file's own column of that name is another thing."""

    def visit(name: str, above: tuple[str, ...]) -> None:
        for source in rules[name].sources:
            if source == name or source not in rules:
                continue
            if source in above:
                raise InputError(f"{where}.{source}: its source leads back to itself: {' → '.join(sorted(above))}")
            visit(source, (*above, source))

    for start in rules:
        visit(start, (start,))
