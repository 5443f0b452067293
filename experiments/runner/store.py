"""Results of tasks, each kept under the fingerprint of the task and of the sources that its result depends on."""

import ast
import hashlib
import importlib
import json
import os
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import hdev_jax
from hdev_jax.errors import InputError
from hdev_jax.rundir import atomic_file

__all__ = ["experiment", "experiments_here", "keep", "place", "read", "sources", "sources_of"]

HERE = Path(__file__).parents[1]
PAGE = Path(__file__).parent / "pages" / "html.py"
PARTS = ("SOURCES", "Config", "tasks", "run", "collect")  # what an experiment is made of
PACKAGES = {"hdev_jax": Path(hdev_jax.__file__).parent, "experiments": HERE}


def experiments_here() -> list[str]:
    """The experiments of this package, as `folder.file`: the modules that say which sources their tasks depend on."""
    files = [p for p in HERE.glob("*/*.py") if "\nSOURCES = " in p.read_text(encoding="utf-8")]
    return sorted(f"{p.parent.name}.{p.stem}" for p in files)


def experiment(name: Any, where: str | Path) -> ModuleType:
    """The module of an experiment: `folder.file` of this package, or by its dotted name one of your own on Python's
    path.

    **Raises:** `InputError` where there is none of that name; `where` is the config that names it.
    """
    if name in experiments_here():
        return importlib.import_module(f"experiments.{name}")
    if isinstance(name, str) and "." in name and all(part.isidentifier() for part in name.split(".")):
        try:
            module = importlib.import_module(name)
        except ModuleNotFoundError as e:
            raise InputError(f"{where}, key experiment: {name} cannot be imported ({e})") from e
        if lacks := [part for part in PARTS if not hasattr(module, part)]:
            raise InputError(f"{where}, key experiment: {name} is no experiment, it has no {', '.join(lacks)}")
        return module
    here = ", ".join(experiments_here())
    raise InputError(
        f"{where}, key experiment: one of {here}, or the dotted name of your own module, is expected, found {name!r}"
    )


def place(module: ModuleType, task: dict[str, Any], store: Path) -> Path:
    """Where the result of a task is kept under `store`."""
    name = hashlib.sha256(json.dumps([task, sources(module)], sort_keys=True).encode()).hexdigest()[:24]
    return store / module.__name__.removeprefix("experiments.") / f"{name}.json"


def keep(at: Path, task: dict[str, Any], result: Any, seconds: float, together: int) -> None:
    """Write a task's result, the task itself, what it took and how many ran in one program with it.

    In one step, so that runs may share a store. **Raises:** `ValueError` where a number is NaN or infinite.
    """
    at.parent.mkdir(parents=True, exist_ok=True)
    with atomic_file(at) as temporary:
        text = json.dumps(
            {"task": task, "seconds": round(seconds, 3), "together": together, "result": result}, allow_nan=False
        )
        Path(temporary).write_text(text)


def read(at: Path) -> dict[str, Any]:
    """What is kept: `task`, `result`, `seconds`, `together`."""
    return json.loads(at.read_text())


def sources(module: ModuleType, *, collect: bool = False) -> str:
    """Fingerprint of the source files that an experiment's results depend on.

    For a task: the module itself, those that it names in `SOURCES`, and every file of the package that these import,
    directly or not, without comments and docstrings: hours of tasks stay kept when a comment is mended. With `collect`,
    for a whole run: whole files, also what they import under `experiments/`, and the page.
    """
    itself = Path(str(module.__file__))
    return _digest((itself, *(Path(os.path.normpath(itself.parent / name)) for name in module.SOURCES)), collect)


def sources_of(*files: Path) -> str:
    """Fingerprint of files and of every file of the package that these import, without comments and docstrings."""
    return _digest(files, False)


@cache
def _digest(starts: tuple[Path, ...], collect: bool) -> str:
    digest = hashlib.sha256()
    for name, path in sorted((_name(p), p) for p in reached((*starts, PAGE) if collect else starts, collect)):
        digest.update(name.encode() + b"\0" + (path.read_bytes() if collect else _code(path)))
    return digest.hexdigest()[:16]


@cache
def _code(path: Path) -> bytes:
    """A file without its comments and docstrings, as this version of Python writes it: another may keep tasks apart."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        documented = isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
        if documented and ast.get_docstring(node, clean=False) is not None:
            node.body = node.body[1:] or [ast.Pass()]
    return ast.unparse(tree).encode()


def _name(path: Path) -> str:
    """The file's place in its package: the same wherever the checkout lies."""
    home = next((p for p in PACKAGES.values() if path.is_relative_to(p)), path.parent)
    return path.relative_to(home.parent).as_posix()


def reached(starts: Iterable[Path], experiments: bool) -> set[Path]:
    """The files themselves and all that they import from the package, and from `experiments` where asked for."""
    found: set[Path] = set()
    todo = list(starts)
    while todo:
        path = todo.pop()
        if path not in found:
            found.add(path)
            todo += [p for p in _imports(path) if experiments or not p.is_relative_to(HERE)]
    return found


@cache
def _imports(path: Path) -> tuple[Path, ...]:
    return tuple(p for name in _names(path) for p in _files(name))


def _names(path: Path) -> Iterator[tuple[str, ...]]:
    """Dotted names that may be modules: `from a.b import c` gives a.b.c, which holds a.b."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (tuple(alias.name.split(".")) for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and not node.level:
            yield from ((*(node.module or "").split("."), alias.name) for alias in node.names)


def _files(name: tuple[str, ...]) -> Iterator[Path]:
    """The file of a module, and those of the packages above it, which are run before it."""
    if name[0] not in PACKAGES or len(name) < 2:
        return
    home, first = PACKAGES[name[0]], PACKAGES[name[0]] / name[1]
    if not (first.is_dir() or first.with_suffix(".py").is_file() or name[1].startswith("__")):
        yield home / "__init__.py"  # a name that the root lends from elsewhere, as in `from hdev_jax import diagnose`
    for depth in range(2, len(name) + 1):
        at = home.joinpath(*name[1:depth])
        yield from (p for p in (at.with_suffix(".py"), at / "__init__.py") if p.is_file())
