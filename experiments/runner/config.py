"""Configs: TOML with `extends`, overrides from the command line, and grids; typed by the experiment that reads them.

Four keys are not the experiment's own:

- `extends = "base.toml"`, a config beside the file that this one is a delta of;
- `ablates = ["key.a", …]`, the keys that a delta changes in its base: exactly those, or it is refused;
- `[tiny]`, dotted key = value: what makes the config small enough for a test (`--tiny`);
- `[sweep]`, dotted key = list of values, or `{ first = 0, count = 16 }` for whole numbers: a grid.
"""

import contextlib
import difflib
import itertools
import re
import tomllib
import typing
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from hdev_jax.errors import InputError
from hdev_jax.textfiles import read_toml

__all__ = [
    "CONFIGS",
    "Strict",
    "artefact",
    "changes",
    "every_config",
    "expanded",
    "listed",
    "resolve",
    "shown",
    "shown_point",
    "typed",
]

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
C = TypeVar("C", bound=BaseModel)


class Strict(BaseModel):
    """A part of a config: an unknown key, a wrong type or what is no number (nan, inf) is refused, and nothing changes
    once it is read.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


def every_config(folder: Path = CONFIGS) -> list[Path]:
    """Every config of an experiment under `folder`; a file whose name begins with `_` is a base that no one runs."""
    found = sorted(folder.rglob("*.toml"))
    return [p for p in found if not p.name.startswith("_") and "experiment" in _layers(p)[-1][1]]


def listed(path: str | Path) -> list[Path] | None:
    """The configs that a list names: `configs = ["paper2/table*.toml", …]`, patterns beside the file; None: no list.

    A pattern may match nothing; table2 comes before table10; a file comes once, whatever names it.

    **Raises:** `InputError` where a name is no file and no pattern, or two files are called the same.
    """
    table = _layers(Path(path))[-1][1]
    if "configs" not in table:
        return None
    names = table["configs"]
    if not isinstance(names, list) or not all(isinstance(n, str) for n in names) or len(table) > 1:
        raise InputError(f"{path}: a list of configs has the one key configs, names or patterns such as paper2/*.toml")
    found: dict[Path, Path] = {}
    for name in names:
        try:
            matches = sorted((p for p in Path(path).parent.glob(name) if not p.is_dir()), key=_natural)
        except (ValueError, IndexError, NotImplementedError) as e:
            raise InputError(f"{path}, key configs: {name!r} is no name and no pattern beside this file ({e})") from e
        if not matches and not set(name) & set("*?["):
            raise InputError(f"{path}, key configs: no such config {name}")
        for p in matches:
            if not p.name.startswith("_") and p.resolve() != Path(path).resolve():
                found.setdefault(p.resolve(), p)
    called: dict[str, Path] = {}
    for p in found.values():
        if (other := called.setdefault(artefact(p), p)) is not p:
            raise InputError(f"{path}, key configs: {other} and {p} are both called {artefact(p)}; rename one")
    return list(found.values())


def _natural(path: Path) -> list[tuple[int, str]]:
    return [
        (int(part), "") if part.isdigit() else (0, part) for part in re.split(r"(\d+)", path.with_suffix("").as_posix())
    ]


def artefact(path: str | Path) -> str:
    """What a config is called: its place under `configs/` without the ending (`paper2/table8`), elsewhere its name."""
    plain = Path(path).resolve().with_suffix("")
    return plain.relative_to(CONFIGS).as_posix() if plain.is_relative_to(CONFIGS) else plain.name


def shown(path: str | Path) -> str:
    """A config's place as a page names it: from the checkout on where it lies in it, on no machine in particular."""
    inside = Path(path).resolve().is_relative_to(CONFIGS)
    return f"configs/{artefact(path)}.toml" if inside else Path(path).as_posix()


def shown_point(delta: Mapping[str, Any]) -> str:
    """A point of a sweep in words."""
    return ", ".join(f"{k} = {v}" for k, v in delta.items())


def resolve(path: str | Path, sets: Sequence[str] = (), *, tiny: bool = False) -> dict[str, Any]:
    """The config as one table: bases first, then its keys, then `[tiny]` where it is asked for, then `sets`.

    **Arguments:** `sets` are `key.of.table=value`, the value being TOML or, where it is none, a string. Tables are
    merged key by key, everything else is replaced. A `config.toml` that a run left is a config too.

    **Raises:** `InputError` with the place.
    """
    table = _layers(Path(path))[-1][1]
    small = table.pop("tiny", {})
    if not isinstance(small, Mapping):
        raise InputError(f"{path}, key tiny: a table is expected, found {small!r}")
    if tiny and not small:
        raise InputError(f'{path}: has no table [tiny]; give it one, for instance "cases.a.logs" = 1')
    for key, value in small.items() if tiny else ():
        _put(table, key, value, f"{path}, table tiny")
    for text in sets:
        key, value = _override(text)
        _put(table, key, value, f"--set {text!r}")
    return table


def _override(text: str) -> tuple[str, Any]:
    key, found, value = text.partition("=")
    if not found or not key.strip():
        raise InputError(f"--set {text!r}: key=value is expected")
    with contextlib.suppress(tomllib.TOMLDecodeError):
        parsed = tomllib.loads(f"x = {value}")
        if set(parsed) == {"x"}:  # a line break in the value would begin another key
            return key.strip(), parsed["x"]
    return key.strip(), value


def _layers(path: Path, seen: tuple[Path, ...] = ()) -> list[tuple[Path, dict[str, Any]]]:
    """Each file from the first base to `path` itself, with the table as it is after that file."""
    if path.resolve() in seen:
        raise InputError(f"{path}: extends itself")
    table, _ = read_toml(path, "config")
    if "hdev" in table and isinstance(table.get("config"), dict):
        return [(path, table["config"])]
    base, ablates = table.pop("extends", None), table.pop("ablates", None)
    if base is None and ablates is None:
        return [(path, table)]
    if not isinstance(base, str):
        raise InputError(f"{path}, key extends: the name of a config is expected, found {base!r}")
    below = _layers(path.parent / base, (*seen, path.resolve()))
    merged = _merged(below[-1][1], table)
    if ablates is not None:
        _check_ablation(path, base, ablates, _changed(below[-1][1], merged))
    return [*below, (path, merged)]


def _check_ablation(path: Path, base: str, ablates: Any, changed: Mapping[str, Any]) -> None:
    if not isinstance(ablates, list) or not ablates or not all(isinstance(k, str) for k in ablates):
        raise InputError(f"{path}, key ablates: a list of the keys that are changed is expected, found {ablates!r}")
    if set(ablates) != set(changed):
        against = f"{path}, key ablates: names {', '.join(sorted(ablates))}, but against {base} the config changes"
        raise InputError(f"{against} {', '.join(sorted(changed)) or 'nothing'}")


def changes(path: str | Path) -> dict[str, tuple[Any, Any]]:
    """What a config changes in the one that it extends: dotted key → (value there, value here); None is no value.

    A config that extends none changes nothing. `[tiny]` is left out: it is of tests. Raises `InputError`.
    """
    layers = _layers(Path(path))
    return _changed(layers[-2][1], layers[-1][1]) if len(layers) > 1 else {}


def _changed(base: Mapping[str, Any], table: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    before, after = (dict(_leaves({k: v for k, v in t.items() if k != "tiny"})) for t in (base, table))
    keys = [*after, *(k for k in before if k not in after)]
    return {k: (before.get(k), after.get(k)) for k in keys if before.get(k) != after.get(k)}


def _leaves(table: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    for k, v in table.items():
        if isinstance(v, Mapping) and v:
            yield from _leaves(v, f"{above}{k}.")
        else:
            yield above + k, v


def _merged(base: Mapping[str, Any], delta: Mapping[str, Any]) -> dict[str, Any]:
    out = dict(base)
    for k, v in delta.items():
        old = out.get(k)
        out[k] = _merged(old if isinstance(old, Mapping) else {}, v) if isinstance(v, Mapping) else v
    return out


def _put(table: dict[str, Any], key: str, value: Any, where: str) -> None:
    """Set a dotted key; the tables on the way are copied, so that nobody else's change."""
    first, _, rest = key.partition(".")
    # a key of [sweep] is a dotted key itself
    keys = [first, rest] if first == "sweep" and rest else key.split(".")
    for k in keys[:-1]:
        inner = table.get(k, {})
        if not isinstance(inner, Mapping):
            raise InputError(f"{where}: {k} is no table")
        table[k] = table = dict(inner)
    table[keys[-1]] = value


def expanded(table: Mapping[str, Any], where: str | Path) -> Iterator[tuple[dict[str, Any], dict[str, Any]]]:
    """`(delta, config)` for each point of the grid `[sweep]`; one, with no delta, where there is none.

    **Raises:** `InputError` where a key of the grid has no values.
    """
    plain = {k: v for k, v in table.items() if k != "sweep"}
    sweep = table.get("sweep", {})
    grid = {k: _values(v) for k, v in sweep.items()} if isinstance(sweep, Mapping) else {"sweep": None}
    values: list[list[Any]] = [v for v in grid.values() if v]
    if len(values) < len(grid):
        raise InputError(
            f'{where}, table sweep: each key has a list of values, for instance "lambda" = [1.0, 0.1], '
            "or { first = 0, count = 16 }"
        )
    for point in itertools.product(*values):
        delta, config = dict(zip(grid, point, strict=True)), dict(plain)
        for key, value in delta.items():
            _put(config, key, value, f"{where}, table sweep")
        yield delta, config


def _values(v: Any) -> list[Any] | None:
    if isinstance(v, list):
        return v
    if isinstance(v, Mapping) and set(v) == {"first", "count"} and all(type(n) is int for n in v.values()):
        return list(range(v["first"], v["first"] + v["count"]))
    return None


def typed(model: type[C], table: Mapping[str, Any], where: str | Path, sets: Sequence[str] = ()) -> C:
    """The config as the experiment wants it.

    **Arguments:** `where` and `sets` are what the table was resolved from: they give the place of what is wrong.

    **Raises:** `InputError`: one line with the key, where it was given, what was expected and what came.
    """
    try:
        return model.model_validate(table)
    except ValidationError as e:
        first = e.errors()[0]
        loc, words, found = [str(k) for k in first["loc"]], first["msg"], f", found {first['input']!r:.60}"
        if first["type"] == "value_error":  # a config's own check: "key: why"
            own, _, words = words.removeprefix("Value error, ").partition(": ")
            loc, found = [*loc, own], ""
        key = ".".join(loc) or "config"
        more = f" ({e.error_count() - 1} more)" if e.error_count() > 1 else ""
        hint = ""
        if first["type"] == "extra_forbidden":
            known = _known(model, first["loc"][:-1])
            near = difflib.get_close_matches(str(first["loc"][-1]), known, 1)
            hint = f"; did you mean {near[0]}?" if near else ""
            hint += f"; known keys: {', '.join(known)}" if known else ""
        place = _place(key, where, sets)
        raise InputError(f"{place}, key {key}: {words}{found}{hint}{more}") from e


def _place(key: str, where: str | Path, sets: Sequence[str]) -> str:
    """Which `--set`, or which of the files that a config is made of, gave a key; `where` itself if none did."""

    def under(a: str, b: str) -> bool:
        return f"{a}.".startswith(f"{b}.") or f"{b}.".startswith(f"{a}.")

    for text in reversed(sets):
        if under(key, _override(text)[0].removeprefix("sweep.")):
            return f"--set {text!r}"
    layers = _layers(Path(where)) if Path(where).is_file() else []
    for (_, before), (path, after) in reversed(list(itertools.pairwise([(where, {}), *layers]))):
        if any(under(key, k.removeprefix("sweep.")) for k in _changed(before, after)):
            return str(path)
    return str(where)


def _known(model: Any, loc: Sequence[int | str]) -> list[str]:
    """The keys of the table at `loc`: what is declared under the fields, dicts, lists and unions that lead there."""
    if not loc:
        fields = getattr(model, "model_fields", None)
        if fields is not None:
            return list(fields)
        return next((k for m in typing.get_args(model) if (k := _known(m, loc))), [])
    fields = getattr(model, "model_fields", {})
    if loc[0] in fields:
        return _known(fields[loc[0]].annotation, loc[1:])
    inner = typing.get_args(model)
    if typing.get_origin(model) in (dict, list, tuple):
        return _known(inner[-1], loc[1:])
    # a union has its member's name in the path, or not
    return next((k for m in inner for rest in (loc, loc[1:]) if (k := _known(m, rest))), [])
