"""The presets by name, and which of them a file's header is of."""

import tomllib
from collections.abc import Sequence
from functools import cache
from pathlib import Path

from hdev_jax.errors import InputError
from hdev_jax.logs.adapter import Adapter, near

__all__ = ["PRESETS", "is_preset", "preset", "recognised"]

_FOLDER = Path(__file__).parent
PRESETS = tuple(sorted(p.stem for p in _FOLDER.glob("*.toml")))
"""Their names; `hdev_jax/logs/presets/NAME.toml` says what each reads."""


@cache
def _read(name: str) -> tuple[Adapter, tuple[str, ...]]:
    table = tomllib.loads((_FOLDER / f"{name}.toml").read_text(encoding="utf-8"))
    headers = tuple(table.pop("recognised_by"))
    return Adapter.from_dict({**table, "preset": name}, where=f"preset {name}"), headers


def is_preset(adapter: str | Path) -> bool:
    """Whether an adapter is given by the name of a preset; a file of that name comes first."""
    return str(adapter) in PRESETS and not Path(adapter).is_file()


def preset(name: str, where: str = "adapter") -> Adapter:
    """The adapter of that name. Raises `InputError` with the near name."""
    if name not in PRESETS:
        raise InputError(f"{where}: no preset '{name}'{near(name, PRESETS)} there are {', '.join(PRESETS)}")
    return _read(name)[0]


def recognised(headers: Sequence[str]) -> Adapter | None:
    """The preset whose tool writes every one of these columns; None where no header is known, or several fit."""
    found = [name for name in PRESETS if set(_read(name)[1]) <= set(headers)]
    return _read(found[0])[0] if len(found) == 1 else None
