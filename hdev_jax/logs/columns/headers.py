"""Headers as people write them: a name, and the unit in brackets behind it."""

import re
from dataclasses import dataclass

import numpy as np

from hdev_jax.errors import InputError
from hdev_jax.units import Parsed, conversion, is_unit, known_stem, parse_column

__all__ = ["Header", "parse_header"]

_ONE = np.asarray(1.0)


@dataclass(frozen=True)
class Header:
    """`Vehicle Speed[km/h]` is the name `Vehicle Speed` and the unit `km/h`; `unit` is None where there is none."""

    text: str
    name: str
    unit: str | None

    @staticmethod
    def of(text: str, told: str | None = None) -> "Header":
        """Read a header; `told` is the unit that a row of units has for it."""
        found = re.fullmatch(r"(.*\S)\s*(?:\[([^][]+)\]|\(([^()]+)\))\s*", text)
        if found is not None and is_unit(unit := (found[2] or found[3]).strip()):
            return Header(text, found[1], unit)
        return Header(text, text, told.strip("[]() ") if told else None)


def parse_header(header: Header) -> Parsed:
    """The contract's column of a header: by its suffix, or by its name where the unit stands beside it.

    Raises `InputError` where the unit is none of that quantity, or two units of one column disagree.
    """
    parsed = parse_column(header.text)
    if header.unit is None:
        return parsed
    if parsed.known:  # speed_kmh with a row of units
        told = conversion(parsed.name, header.unit, where=f"column '{header.text}'")
        if float(told.call(_ONE)) != float(parsed.conversion.call(_ONE)):
            raise InputError(f"column '{header.text}': the row of units says {header.unit}; correct one of the two")
        return parsed
    name = known_stem(header.name)
    if name is None:
        return parsed
    return Parsed(name, conversion(name, header.unit, where=f"column '{header.text}'"), True)
