"""A table under way to the contract's columns: an adapter's rules applied, other columns read by their names."""

from dataclasses import dataclass, replace

import numpy as np

from hdev_jax.errors import InputError
from hdev_jax.logs.adapter import Adapter, Rule, near
from hdev_jax.logs.columns.clocks import Clock, read_clock
from hdev_jax.logs.columns.headers import Header, parse_header
from hdev_jax.logs.columns.numbers import numbers
from hdev_jax.logs.columns.timing import CLOCKS, find_clock
from hdev_jax.logs.expression import Quantity, evaluate
from hdev_jax.logs.ledger import Ledger
from hdev_jax.logs.readers.raw import Raw
from hdev_jax.logs.repair import fill_forward, fill_linear, fill_nearest, increments
from hdev_jax.units import COLUMNS, NEEDED_STEMS, conversion, registry, unit_of

__all__ = ["MEASURED_COLUMNS", "ColumnInfo", "Work"]

MEASURED_COLUMNS = ("battery_power_w", "energy_wh")
_NEEDED = tuple(c for c, s in COLUMNS.items() if s in NEEDED_STEMS)


@dataclass(frozen=True)
class ColumnInfo:
    """A row of `hdev check`: the file's column, the unit it came in, the column it became."""

    source: str
    unit: str
    name: str


class Work:
    """The table under way: what has been translated so far."""

    def __init__(self, raw: Raw, adapter: Adapter, headers: list[str], trip: np.ndarray):
        self.raw: Raw = raw
        self.adapter: Adapter = adapter
        self.headers: list[str] = headers
        self.trip: np.ndarray = trip
        self.parsed: dict[str, Header] = {h: Header.of(h, raw.units.get(h)) for h in headers}
        self.data: dict[str, np.ndarray] = {}
        self.unfilled: dict[str, np.ndarray] = {}
        self.columns: list[ColumnInfo] = []
        self.ledger: Ledger = raw.ledger
        self.absent: set[str] = set()
        self.lacking: list[str] = []

    def note(self, column: str, reason: str, count: int = 0, kind: str = "noted") -> None:
        self.ledger = self.ledger.add(kind, reason, file=self.raw.file, column=column, count=count)

    def numbers(self, header: str, known: bool) -> np.ndarray | None:
        return numbers(self.raw, header, known, lambda why, count: self.note(header, why, count))

    def seconds(self, headers: tuple[str, ...], form: str | None = None) -> np.ndarray:
        how = Clock(form, self.adapter.time_zone, self.adapter.repeated_stamps == "spread")
        shown = " ".join(headers)
        return read_clock(self.raw, headers, self.trip, how, lambda why, count: self.note(shown, why, count))

    def derive(self, name: str, above: tuple[str, ...]) -> np.ndarray | None:
        """A rule's column, after the rules it draws on. None where the file lacks the source of an optional column."""
        if name in ("trip_id", "vehicle_id") or name in self.absent:
            return None
        if name in self.data:
            return self.data[name]
        rule = self.adapter.columns[name]
        if rule.expr is not None:
            x, rule = self._expression(name, rule, above), replace(rule, unit=None)
            chained = False
        else:
            rule = self._chosen(rule)
            first = rule.sources[0]
            chained = first in self.adapter.columns and first != name and first not in above
            x = self.derive(first, (*above, name)) if chained else self._source(name, rule)
        if x is None:
            if chained:
                self.note(name, f"made from {rule.source}, which is absent")
            self.absent.add(name)
            return None
        shown = rule.unit or ("" if rule.affine or chained else _own_unit(name))
        if rule.unit is None and rule.affine is None and rule.expr is None and not chained:
            rule = replace(rule, unit=self._told_unit(name, rule))
            shown = rule.unit or shown
        x = self._apply(name, rule, np.array(x, dtype=np.float64))
        self.data[name] = x
        self.columns.append(ColumnInfo(rule.expr or " ".join(rule.sources), shown, name))
        return x

    def _chosen(self, rule: Rule) -> Rule:
        """The rule with the first of its alternatives, where the file lacks its source."""
        if rule.sources[0] in self.headers or rule.sources[0] in self.adapter.columns:
            return rule
        other = next((a for a in rule.alternatives if a in self.headers), None)
        return rule if other is None else replace(rule, source=other)

    def _told_unit(self, name: str, rule: Rule) -> str | None:
        """What the file itself says about the unit of a source, where the adapter says nothing."""
        header = self.parsed.get(rule.sources[0])
        if header is None or header.unit is None or unit_of(name) in (None, "dimensionless"):
            return None
        try:
            conversion(name, header.unit, where=f"{self.raw.file}: column '{header.text}'")
        except InputError as e:
            raise InputError(f"{e}; say unit or affine in {self.adapter.where}") from None
        return header.unit

    def _expression(self, name: str, rule: Rule, above: tuple[str, ...]) -> np.ndarray | None:
        where = f"{self.adapter.where}: columns.{name}.expr"
        assert rule.expr is not None

        def quantity(source: str) -> Quantity:
            if source in self.adapter.columns and source != name and source not in above:
                x = self.derive(source, (*above, name))
                unit = unit_of(source)
            else:
                x = self._source(name, Rule(source))
                header = self.parsed.get(source)
                unit, parsed = None, parse_header(header) if header else None
                if x is not None and parsed is not None and parsed.known:
                    x, unit = parsed.conversion.call(x), unit_of(parsed.name)
                elif header is not None and header.unit is not None:
                    unit = header.unit
            if x is None:
                raise _AbsentError(source)
            if rule.unit is not None or unit is None:
                return Quantity(x, None)
            return Quantity(x, registry().Unit(unit))

        try:
            if rule.unit is not None:
                x = evaluate(rule.expr, where, quantity, None)
                return np.asarray(conversion(name, rule.unit, where=f"{where}: unit").call(x))
            if (to := unit_of(name)) is None:
                raise InputError(f"{where}: '{name}' names no unit: end the name in one, or give the rule a unit")
            return evaluate(rule.expr, where, quantity, to)
        except _AbsentError as e:
            self.note(name, f"the file has no '{e}'")
            return None

    def _source(self, name: str, rule: Rule) -> np.ndarray | None:
        missing = [s for s in rule.sources if s not in self.headers]
        if not missing:
            if name == "time_s":
                return self.seconds(rule.sources, rule.format)
            return self.numbers(rule.sources[0], known=True)
        claimed = {s for r in self.adapter.columns.values() for s in r.sources}
        free = [h for h in self.headers if h not in claimed]
        hint = near(missing[0], free, 0.75)
        if (name in _NEEDED and self.adapter.preset is None) or (hint and self.adapter.preset is None):
            hint = hint or near(missing[0], self.headers) or f"; it has {_some(self.headers)}"
            raise InputError(f"{self.raw.file}: no column '{missing[0]}' ({name} of {self.adapter.where}){hint}")
        if self.adapter.preset is None:
            self.note(name, f"the file has no '{missing[0]}'")
        else:  # a preset names all that its tool may log
            self.lacking.append(missing[0])
        return None

    def _apply(self, name: str, rule: Rule, x: np.ndarray) -> np.ndarray:
        x[np.isinf(x)] = np.nan
        if rule.valid is not None:
            with np.errstate(invalid="ignore"):
                out = (x < rule.valid[0]) | (x > rule.valid[1])
            if out.any():
                x[out] = np.nan
                self.note(name, f"outside {list(rule.valid)}, taken as missing", int(out.sum()), "clipped")
        if rule.fill is not None and np.isnan(x).any():
            missing = np.isnan(x)
            self.unfilled[name] = x
            time = self.data.get("time_s")
            if rule.fill == "linear":
                steady = time is not None and bool(np.isfinite(time).all())
                x = fill_linear(x, self.trip, time if steady else None)
            else:
                x = {"forward": fill_forward, "nearest": fill_nearest}[rule.fill](x, self.trip)
            done = int((missing & ~np.isnan(x)).sum())
            self.note(name, f"missing, filled ({rule.fill}), {done / len(x):.0%} of the rows", done, "filled")
            if rule.initial is not None and np.isnan(x).any():
                self.note(name, f"before the first value, {rule.initial:g} assumed", int(np.isnan(x).sum()), "filled")
                x = np.where(np.isnan(x), rule.initial, x)
        if rule.affine is not None:
            x = rule.affine[0] + rule.affine[1] * x
        if rule.unit is not None:
            x = np.asarray(conversion(name, rule.unit, where=f"{self.adapter.where}: columns.{name}.unit").call(x))
        if rule.counter:
            x = increments(x, self.trip)
            self.note(name, "what a counter added around each sample", kind="derived")
        return x

    def keep_others(self, taken: set[str]) -> None:
        """Columns that no rule names: the contract's are converted, unknown numbers kept, unknown text left out."""
        claimed = taken | {s for r in self.adapter.columns.values() for s in self._chosen(r).sources}
        claimed |= {self.adapter.companion.on} if self.adapter.companion else set()
        claimed |= {s for c in self.columns if c.name == "time_s" for s in self.headers if s in c.source}
        by_rule = {n for n in self.adapter.columns if n not in self.absent}
        came_from: dict[str, str] = {}
        for header in self.headers:
            if header in claimed or header in ("trip_id", "vehicle_id"):
                continue
            try:
                parsed = parse_header(self.parsed[header])
            except InputError as e:
                raise InputError(f"{self.raw.file}: {e}") from None
            if parsed.name in by_rule:
                self.note(header, f"left out: the adapter makes {parsed.name} itself")
                continue
            if parsed.name in came_from:
                both = f"columns '{came_from[parsed.name]}' and '{header}' are both {parsed.name}"
                raise InputError(f"{self.raw.file}: {both}; remove one")
            if parsed.name == "time_s" and "time_s" in self.data:
                continue
            if header in CLOCKS or header.startswith("unnamed column ") or header == "__index_level_0__":
                continue
            x = self.numbers(header, parsed.known)
            if x is None:
                self.note(header, "text, left out")
                continue
            came_from[parsed.name] = header
            x = np.asarray(parsed.conversion.call(np.where(np.isinf(x), np.nan, x)), dtype=np.float64)
            self.data[parsed.name] = x
            told = parsed.conversion.unit if parsed.known else self.parsed[header].unit
            self.columns.append(ColumnInfo(header, told or "", parsed.name))
            if not parsed.known:
                hint = near(header, [c for c in COLUMNS if c not in self.headers], 0.85)
                if header in COLUMNS.values():
                    hint = "; its name says no unit, so it is not read as a column of the contract"
                self.note(header, f"unknown column, kept under its own name{hint}")

    def note_lacking(self) -> None:
        """One line for what the preset knows and the file does not have."""
        if self.lacking:
            shown = ", ".join(dict.fromkeys(self.lacking))
            self.ledger = self.ledger.add("noted", f"the file has none of {shown}", file=self.raw.file)

    def power_of_voltage_and_current(self) -> None:
        """Where no power and no energy is measured: voltage times current, positive where the current is."""
        if any(c in self.data for c in MEASURED_COLUMNS) or not {"voltage_v", "current_a"} <= self.data.keys():
            return
        self.data["battery_power_w"] = self.data["voltage_v"] * self.data["current_a"]
        self.note("battery_power_w", "voltage_v times current_a, positive out of the battery", kind="derived")
        self.columns.append(ColumnInfo("voltage_v * current_a", "W", "battery_power_w"))

    def clock(self) -> None:
        """Where no rule makes `time_s`: the clock that the file has."""
        found = find_clock(self.raw, self.parsed)
        if found is None:
            return
        shown = " ".join(found.headers)
        if found.reason:
            self.note(shown, found.reason)
        x = found.scale * self.seconds(found.headers)
        self.data["time_s"] = np.where(np.isinf(x), np.nan, x)
        self.columns.append(ColumnInfo(shown, found.unit, "time_s"))


class _AbsentError(Exception):
    """A column of an expression that the file lacks."""


def _own_unit(name: str) -> str:
    """The suffix of a name that ends in a unit."""
    return name.rpartition("_")[2] if unit_of(name) not in (None, "dimensionless") else ""


def _some(names: list[str]) -> str:
    return ", ".join(names[:8]) + (", …" if len(names) > 8 else "")
