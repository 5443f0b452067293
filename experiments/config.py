"""Configs: TOML with `extends`, overrides from the command line, and grids; typed by the experiment that reads them."""

import itertools
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from hdev_jax.errors import InputError

__all__ = ["Strict", "expanded", "resolve", "typed"]


C = TypeVar("C", bound=BaseModel)


class Strict(BaseModel):
    """A part of a config: an unknown key or a wrong type is refused, and nothing changes once it is read."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


def resolve(path: str | Path, sets: Sequence[str] = ()) -> dict[str, Any]:
    """The config as one table: bases first (`extends = "base.toml"`, beside the file), then its keys, then `sets`.

    Tables are merged key by key, everything else is replaced. `sets` are `key.of.table=value`, the value being TOML or,
    where it is none, a string. Raises `InputError` with the place.
    """
    table = _read(Path(path), ())
    for text in sets:
        key, found, value = text.partition("=")
        if not found or not key.strip():
            raise InputError(f"--set {text!r}: key=value is expected")
        try:
            parsed = tomllib.loads(f"x = {value}")["x"]
        except tomllib.TOMLDecodeError:
            parsed = value
        _put(table, key.strip().split("."), parsed, f"--set {text!r}")
    return table


def _read(path: Path, seen: tuple[Path, ...]) -> dict[str, Any]:
    if path.resolve() in seen:
        raise InputError(f"{path}: extends itself")
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as e:
        raise InputError(f"{path}: no such config ({e.strerror})") from e
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as e:
        raise InputError(f"{path}: is not TOML: {e}") from e
    base = table.pop("extends", None)
    if base is None:
        return table
    if not isinstance(base, str):
        raise InputError(f"{path}, key extends: the name of a config is expected, found {base!r}")
    return _merged(_read(path.parent / base, (*seen, path.resolve())), table)


def _merged(base: Mapping[str, Any], delta: Mapping[str, Any]) -> dict[str, Any]:
    out = dict(base)
    for k, v in delta.items():
        out[k] = _merged(out[k], v) if isinstance(v, Mapping) and isinstance(out.get(k), Mapping) else v
    return out


def _put(table: dict[str, Any], keys: Sequence[str], value: Any, where: str) -> None:
    for k in keys[:-1]:
        table = table.setdefault(k, {})
        if not isinstance(table, dict):
            raise InputError(f"{where}: {k} is no table")
    table[keys[-1]] = value


def expanded(table: Mapping[str, Any], where: str | Path) -> Iterator[tuple[dict[str, Any], dict[str, Any]]]:
    """`(delta, config)` for each point of the grid `[sweep]` (dotted key → list of values); one where there is none."""
    plain = {k: v for k, v in table.items() if k != "sweep"}
    sweep = table.get("sweep", {})
    if not isinstance(sweep, Mapping) or any(not isinstance(v, list) or not v for v in sweep.values()):
        raise InputError(f'{where}, table sweep: each key has a list of values, for instance "lambda" = [1.0, 0.1]')
    for values in itertools.product(*sweep.values()):
        delta = dict(zip(sweep, values, strict=True))
        config = _merged(plain, {})
        for key, value in delta.items():
            parts = key.split(".")
            for depth in range(1, len(parts)):  # tables on the way are copies: points of the grid share none
                _put(config, parts[:depth], dict(_at(config, parts[:depth])), str(where))
            _put(config, parts, value, str(where))
        yield delta, config


def _at(table: Mapping[str, Any], keys: Sequence[str]) -> Mapping[str, Any]:
    for k in keys:
        table = table.get(k, {})
    return table


def typed(model: type[C], table: Mapping[str, Any], where: str | Path) -> C:
    """The config as the experiment wants it. Raises `InputError`: one line with the key and what was expected."""
    try:
        return model.model_validate(table)
    except ValidationError as e:
        first = e.errors()[0]
        key = ".".join(str(k) for k in first["loc"]) or "config"
        more = f" ({e.error_count() - 1} more)" if e.error_count() > 1 else ""
        known = ", ".join(model.model_fields) if first["type"] == "extra_forbidden" and len(first["loc"]) == 1 else ""
        hint = f"; known keys: {known}" if known else ""
        raise InputError(f"{where}, key {key}: {first['msg']}, found {first['input']!r:.60}{hint}{more}") from e
