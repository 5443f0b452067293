"""The optional libraries that read recordings, imported where a file needs them."""

import importlib
from pathlib import Path
from typing import Any

from hdev_jax.errors import InputError

__all__ = ["library"]


def library(name: str, path: Path, extra: str) -> Any:
    """A module by name. Raises `InputError` that says what to install where it is not there."""
    try:
        return importlib.import_module(name)
    except ImportError:
        raise InputError(
            f"{path}: reading {path.suffix} needs {name.partition('.')[0]}: pip install 'hdev_jax[{extra}]'"
        ) from None
