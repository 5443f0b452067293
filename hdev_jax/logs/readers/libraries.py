"""The optional libraries that read files, imported where a file needs them."""

import importlib
from pathlib import Path
from typing import Any

from hdev_jax.errors import InputError

__all__ = ["library"]


def library(name: str, path: Path, extra: str, otherwise: str = "") -> Any:
    """A module by name. Raises `InputError` that says what to install where it is not there, or what to do instead."""
    try:
        return importlib.import_module(name)
    except ImportError:
        needs = f"reading {path.suffix} needs {name.partition('.')[0]}: pip install 'hdev_jax[{extra}]'"
        raise InputError(f"{path}: {needs}{otherwise and f', or {otherwise}'}") from None
