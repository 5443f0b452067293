"""Reading a TOML file, with one line for whatever is wrong with it."""

import tomllib
from pathlib import Path
from typing import Any

from hdev_jax.errors import InputError

__all__ = ["read_toml"]


def read_toml(path: Path, what: str) -> tuple[dict[str, Any], str]:
    """The table of a file, and its text. `what` the file is begins the line of an `InputError`: `sheet a.toml: …`."""
    where = f"{what} {path}".strip()
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise InputError(f"{where}: no such file") from None
    except (OSError, UnicodeDecodeError) as e:
        raise InputError(f"{where}: cannot be read as text ({e})") from None
    try:
        return tomllib.loads(text), text
    except (ValueError, RecursionError) as e:  # ValueError: also a number of more digits than Python converts
        raise InputError(f"{where}: not a TOML file: {e}") from None
