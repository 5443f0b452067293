"""Arguments as people write them: names as text or one by one, a seed of any kind of whole number."""

import argparse
from collections.abc import Iterable
from numbers import Integral
from typing import Any

from hdev_jax.errors import InputError

__all__ = ["count", "names", "names_of", "seed_of", "share"]


def seed_of(given: Any) -> int:
    """A random seed. Raises `InputError` for what is no whole number from 0 to 2³² − 1."""
    if isinstance(given, bool) or not isinstance(given, Integral) or not 0 <= int(given) < 2**32:
        raise InputError(f"seed: a whole number from 0 to 2^32 - 1 is expected, found {given!r}")
    return int(given)


def names_of(given: Any) -> tuple[str, ...] | None:
    """Names as a command line has them, with commas between, or one by one; numbers of trips as text.

    Raises `InputError` for an empty one.
    """
    if given is None:
        return None
    each = given.split(",") if isinstance(given, str) else given if isinstance(given, Iterable) else [given]
    names = tuple(str(x).strip() for x in each)
    if not all(names):
        raise InputError(f"expected names with commas between them, found {given!r}")
    return names


def names(text: str) -> tuple[str, ...]:
    """An option's names with commas between. Raises argparse's error for an empty one."""
    found = tuple(part.strip() for part in text.split(","))
    if not all(found):
        raise argparse.ArgumentTypeError(f"expected names with commas between them, found {text!r}")
    return found


def share(text: str) -> float:
    """An option's number between 0 and 1. Raises argparse's error for another."""
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0.0 < value < 1.0:
        raise argparse.ArgumentTypeError(f"expected a number between 0 and 1, found {text!r}")
    return value


def count(text: str) -> int:
    """An option's whole number from 0 to 2³² − 1. Raises argparse's error for another."""
    if not (text.isascii() and text.isdigit() and int(text) < 2**32):
        raise argparse.ArgumentTypeError(f"expected a whole number from 0 to 2^32 - 1, found {text!r}")
    return int(text)
