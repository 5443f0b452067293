"""Checks of a table read from TOML: each says the key, what was found, and what is accepted."""

import difflib
import re
from collections.abc import Callable, Mapping
from typing import Any

from hdev_jax.errors import InputError

__all__ = ["checked", "flag", "near", "not_negative", "number", "one_of", "pair", "regex", "span", "table", "text",
           "texts", "whole"]  # fmt: skip

Check = Callable[[str, Any], Any]


def near(name: str, choices: "list[str] | tuple[str, ...]", cutoff: float = 0.6) -> str:
    """`, did you mean 'x'?` for the choice nearest to `name`, or nothing."""
    lower = {c.lower(): c for c in reversed(choices)}
    found = difflib.get_close_matches(name.lower(), list(lower), 1, cutoff)
    return f", did you mean '{lower[found[0]]}'?" if found else ""


def checked(values: Mapping[str, Any], known: Mapping[str, Check], where: str, prefix: str = "") -> dict[str, Any]:
    """Every value through the check of its key. Raises `InputError` for a key that is not known, with the near one."""
    out = {}
    for key, value in values.items():
        if key not in known:
            hint = near(key, list(known))
            raise InputError(f"{where}: unknown key '{prefix}{key}'{hint} accepted: {', '.join(known)}")
        out[key] = known[key](f"{where}: {prefix}{key}", value)
    return out


def one_of(choices: tuple[str, ...]) -> Callable[[str, Any], str]:
    """A check for one of a few words."""

    def check(where: str, value: Any) -> str:
        if value not in choices:
            raise InputError(f"{where} = {value!r}: accepted: {', '.join(choices)}")
        return value

    return check


def text(where: str, value: Any) -> str:
    """A text that is not empty."""
    if not isinstance(value, str) or not value:
        raise InputError(f"{where} = {value!r}: a text is expected")
    return value


def texts(where: str, value: Any) -> str | tuple[str, ...]:
    """A text, or a list of them."""
    if isinstance(value, list) and value:
        return tuple(text(where, v) for v in value)
    return text(where, value)


def regex(where: str, value: Any) -> str:
    """A regular expression."""
    try:
        re.compile(text(where, value))
    except re.error as e:
        raise InputError(f"{where} = {value!r}: not a regular expression ({e})") from None
    return value


def number(where: str, value: Any) -> float:
    """A finite number."""
    if isinstance(value, bool) or not isinstance(value, int | float) or value != value or abs(value) == float("inf"):
        raise InputError(f"{where} = {value!r}: a finite number is expected")
    return float(value)


def not_negative(where: str, value: Any) -> float:
    """A number that is not below 0."""
    if (x := number(where, value)) < 0:
        raise InputError(f"{where} = {value!r}: must not be negative")
    return x


def whole(where: str, value: Any) -> int:
    """A whole number from 1 on."""
    if isinstance(value, bool) or not isinstance(value, int) or value < 1:
        raise InputError(f"{where} = {value!r}: a whole number from 1 on is expected")
    return value


def pair(where: str, value: Any) -> tuple[float, float]:
    """`[a, b]`."""
    if not isinstance(value, list) or len(value) != 2:
        raise InputError(f"{where} = {value!r}: two numbers [a, b] are expected")
    return number(where, value[0]), number(where, value[1])


def span(where: str, value: Any) -> tuple[float, float]:
    """`[low, high]`."""
    lo, hi = pair(where, value)
    if lo >= hi:
        raise InputError(f"{where} = {value!r}: [low, high] with low < high is expected")
    return lo, hi


def flag(where: str, value: Any) -> bool:
    """`true` or `false`."""
    if not isinstance(value, bool):
        raise InputError(f"{where} = {value!r}: true or false is expected")
    return value


def table(where: str, value: Any, keys: tuple[str, ...]) -> Mapping[str, Any]:
    """A table that has these keys."""
    if not isinstance(value, Mapping):
        raise InputError(f"{where} = {value!r}: a table is expected")
    for key in keys:
        if key not in value:
            raise InputError(f"{where}: the key '{key}' is missing{near(key, list(value))}")
    return value
