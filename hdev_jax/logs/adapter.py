"""Adapters: a TOML file that says which columns of a foreign log are which of the contract's."""

import difflib
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hdev_jax.errors import InputError
from hdev_jax.textfiles import read_toml
from hdev_jax.units import COLUMNS, conversion, parse_column, unit_of

__all__ = ["FILLS", "FORMATS", "LAYOUTS", "Adapter", "Companion", "Rule", "near"]

FORMATS = ("csv", "parquet", "mat")
LAYOUTS = ("table", "time_value")
FILLS = ("forward", "nearest", "linear")
_TEXT_COLUMNS = ("trip_id", "vehicle_id")


def near(name: str, choices: "list[str] | tuple[str, ...]", cutoff: float = 0.6) -> str:
    """`, did you mean 'x'?` for the choice nearest to `name`, or nothing."""
    lower = {c.lower(): c for c in reversed(choices)}
    found = difflib.get_close_matches(name.lower(), list(lower), 1, cutoff)
    return f", did you mean '{lower[found[0]]}'?" if found else ""


@dataclass(frozen=True)
class Rule:
    """How one column comes about: source → `valid` → `fill` → `affine` → `unit`.

    `valid` is in the source's numbers: a value outside is missing. Missing values are filled inside a trip (`forward`,
    `nearest`, `linear`; before the first value `initial`), then `a + b·x`, then the unit is brought to SI.
    A source that is itself a column made here is taken in SI, after its own fill.
    """

    source: str
    unit: str | None = None
    fill: str | None = None
    initial: float | None = None
    affine: tuple[float, float] | None = None
    valid: tuple[float, float] | None = None


@dataclass(frozen=True)
class Companion:
    """A file beside the log whose columns are joined by the key `on`; it is never a log of its own."""

    suffix: str
    on: str
    optional: bool = False


@dataclass(frozen=True)
class Adapter:
    """What a file of this kind means. `where` names it in messages; without arguments it changes nothing."""

    where: str = "adapter"
    format: str | None = None
    layout: str = "table"
    trip_id: str | None = None
    vehicle_id: str | None = None
    variable: str | None = None
    companion: Companion | None = None
    edge_trim_s: float = 0.0
    others: str = "keep"
    columns: Mapping[str, Rule] = field(default_factory=dict)

    @staticmethod
    def load(path: str | Path) -> "Adapter":
        """Read a TOML file. Raises `InputError` for whatever is wrong in it."""
        path = Path(path)
        table, _ = read_toml(path, "adapter")
        return Adapter.from_dict(table, where=path.name)

    @staticmethod
    def from_dict(table: Mapping[str, Any], where: str = "adapter") -> "Adapter":
        """Check a table read from TOML. Raises `InputError` naming key, value and what is accepted."""
        known: dict[str, Callable[[str, Any], Any]] = {
            "format": _one_of(FORMATS),
            "layout": _one_of(LAYOUTS),
            "trip_id": _regex,
            "vehicle_id": _regex,
            "variable": _regex,
            "companion": _companion,
            "edge_trim_s": _not_negative,
            "others": _one_of(("keep", "drop")),
            "columns": _columns,
        }
        return Adapter(where=where, **_checked(table, known, where, ""))

    def match(self, pattern: str, text: str) -> str | None:
        """First group of the pattern in `text` (the whole match where it has none), None without a match."""
        found = re.search(pattern, text)
        if found is None:
            return None
        return next((g for g in found.groups() if g is not None), found.group(0))

    def is_companion(self, name: str) -> bool:
        """Whether a file of this name goes beside a log."""
        return self.companion is not None and name.endswith(self.companion.suffix)


def _checked(
    table: Mapping[str, Any], known: Mapping[str, Callable[[str, Any], Any]], where: str, prefix: str
) -> dict[str, Any]:
    out = {}
    for key, value in table.items():
        if key not in known:
            hint = near(key, list(known))
            raise InputError(f"{where}: unknown key '{prefix}{key}'{hint} accepted: {', '.join(known)}")
        out[key] = known[key](f"{where}: {prefix}{key}", value)
    return out


def _one_of(choices: tuple[str, ...]) -> Callable[[str, Any], str]:
    def check(where: str, value: Any) -> str:
        if value not in choices:
            raise InputError(f"{where} = {value!r}: accepted: {', '.join(choices)}")
        return value

    return check


def _text(where: str, value: Any) -> str:
    if not isinstance(value, str) or not value:
        raise InputError(f"{where} = {value!r}: a text is expected")
    return value


def _regex(where: str, value: Any) -> str:
    try:
        re.compile(_text(where, value))
    except re.error as e:
        raise InputError(f"{where} = {value!r}: not a regular expression ({e})") from None
    return value


def _number(where: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or value != value or abs(value) == float("inf"):
        raise InputError(f"{where} = {value!r}: a finite number is expected")
    return float(value)


def _not_negative(where: str, value: Any) -> float:
    if (x := _number(where, value)) < 0:
        raise InputError(f"{where} = {value!r}: must not be negative")
    return x


def _pair(where: str, value: Any) -> tuple[float, float]:
    if not isinstance(value, list) or len(value) != 2:
        raise InputError(f"{where} = {value!r}: two numbers [a, b] are expected")
    return _number(where, value[0]), _number(where, value[1])


def _range(where: str, value: Any) -> tuple[float, float]:
    lo, hi = _pair(where, value)
    if lo >= hi:
        raise InputError(f"{where} = {value!r}: [low, high] with low < high is expected")
    return lo, hi


def _flag(where: str, value: Any) -> bool:
    if not isinstance(value, bool):
        raise InputError(f"{where} = {value!r}: true or false is expected")
    return value


def _table(where: str, value: Any, keys: tuple[str, ...]) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise InputError(f"{where} = {value!r}: a table is expected")
    for key in keys:
        if key not in value:
            raise InputError(f"{where}: the key '{key}' is missing{near(key, list(value))}")
    return value


def _companion(where: str, value: Any) -> Companion:
    table = _table(where, value, ())
    got = _checked(table, {"suffix": _text, "on": _text, "optional": _flag}, where, "")
    _table(where, value, ("suffix", "on"))
    return Companion(**got)


def _columns(where: str, value: Any) -> dict[str, Rule]:
    rules: dict[str, Rule] = {}
    known = {
        "source": _text,
        "unit": lambda w, v: v if v == "" else _text(w, v),
        "fill": _one_of(FILLS),
        "initial": _number,
        "affine": _pair,
        "valid": _range,
    }
    for name, entry in _table(where, value, ()).items():
        here = f"{where}.{name}"
        if isinstance(entry, str):  # speed_mps = "v": short for { source = "v" }
            entry = {"source": entry}
        table = _table(here, entry, ())
        got = _checked(table, known, here, "")
        _table(here, entry, ("source",))
        rule = Rule(**got)
        if rule.initial is not None and rule.fill is None:
            raise InputError(f"{here}: initial needs a fill (one of {', '.join(FILLS)})")
        target = _target(here, name)
        if target in rules:
            raise InputError(f"{here}: a second rule for {target}")
        if target != name and rule.unit is None and name not in _TEXT_COLUMNS:
            rule = Rule(rule.source, name.rpartition("_")[2], rule.fill, rule.initial, rule.affine, rule.valid)
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
    for start in rules:
        seen, name = {start}, rules[start].source
        while name in rules and name != start and name not in seen:
            seen.add(name)
            if rules[name].source == name:
                break
            name = rules[name].source
        if name == start and len(seen) > 1:
            raise InputError(f"{where}.{start}: its source leads back to itself: {' → '.join(sorted(seen))}")
