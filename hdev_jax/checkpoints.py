"""Nested values as the arrays of one `.npz` file, and back: what a killed run had worked out already."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

__all__ = ["load", "packed"]


def packed(value: Any) -> dict[str, np.ndarray]:
    """Dicts with string keys, lists, tuples, strings, numbers, None and arrays, nested at will, as named arrays.

    **Raises:** `TypeError` for anything else.
    """
    arrays: list[np.ndarray] = []
    tree = json.dumps(_encode(value, arrays))
    columns = {f"a{i}": a for i, a in enumerate(arrays)}
    return {"tree": np.frombuffer(tree.encode(), dtype=np.uint8), **columns}


def _encode(value: Any, arrays: list[np.ndarray]) -> Any:
    """JSON for everything but arrays, which are moved to `arrays`; an object with the one key "a" or "t" is a tag."""
    if isinstance(value, Mapping):
        if any(not isinstance(k, str) for k in value):
            raise TypeError("a checkpoint's dicts have strings for keys")
        return {"d": {k: _encode(v, arrays) for k, v in value.items()}}
    if isinstance(value, tuple):
        return {"t": [_encode(v, arrays) for v in value]}
    if isinstance(value, list):
        return [_encode(v, arrays) for v in value]
    if value is None or type(value) in (bool, int, float, str):
        return value
    if isinstance(value, np.generic):
        return _encode(value.item(), arrays)
    if hasattr(value, "__array__"):
        array = np.asarray(value)
        if array.dtype.kind in "biufcUS":
            arrays.append(array)
            return {"a": len(arrays) - 1}
    raise TypeError(f"a checkpoint holds dicts, lists, strings, numbers and arrays, not {type(value).__name__}")


def load(path: Path) -> Any:
    """What was packed into the file.

    **Raises:** `OSError`, `ValueError`, `KeyError` or `BadZipFile` for a file that is none.
    """
    with np.load(path, allow_pickle=False) as file:
        arrays = {k: file[k] for k in file.files}

    def decode(value: Any) -> Any:
        if isinstance(value, list):
            return [decode(v) for v in value]
        if not isinstance(value, dict):
            return value
        ((tag, content),) = value.items()
        if tag == "a":
            return arrays[f"a{content}"]
        return tuple(decode(v) for v in content) if tag == "t" else {k: decode(v) for k, v in content.items()}

    return decode(json.loads(arrays.pop("tree").tobytes()))
