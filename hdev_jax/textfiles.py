"""Reading a text file, or a TOML one, with one line for whatever is wrong with it; a file's digest."""

import hashlib
import tomllib
from pathlib import Path
from typing import Any

from hdev_jax.errors import InputError

__all__ = ["digest", "read_text", "read_toml"]


def digest(path: Path) -> str:
    """SHA-256 of a file; empty where there is none."""
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else ""


def read_text(path: Path, what: str) -> str:
    """The text of a file. `what` the file is begins the line of an `InputError`: `sheet a.toml: …`."""
    try:
        return path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise InputError(f"{what} {path}: no such file") from None
    except (OSError, UnicodeDecodeError) as e:
        raise InputError(f"{what} {path}: cannot be read as text ({e})") from None


def read_toml(path: Path, what: str) -> tuple[dict[str, Any], str]:
    """The table of a file, and its text. Raises `InputError` as `read_text`."""
    text = read_text(path, what)
    try:
        return tomllib.loads(text), text
    except (ValueError, RecursionError) as e:  # ValueError: also a number of more digits than Python converts
        raise InputError(f"{what} {path}: not a TOML file: {e}") from None
