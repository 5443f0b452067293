"""The folder of a run: complete or absent, resumed after a kill, never mixed with another run.

Work goes to `DIR.partial`, which is renamed to `DIR` when everything is in it. `config.toml` is written there first: it
says what is running, and so whether a folder may be returned as done, resumed, cleared or must be left alone.
"""

import contextlib
import datetime
import hashlib
import importlib.metadata
import json
import os
import platform
import re
import shutil
import sys
import time
import tomllib
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from hdev_jax.checkpoints import load, packed
from hdev_jax.errors import InputError

try:
    import fcntl
except ImportError:  # Windows: two runs on one folder are not kept apart there
    fcntl = None

__all__ = ["Run", "atomic_file", "config_digest", "is_complete", "open_run"]

_CONFIG, _ENVIRONMENT, _CHECKPOINTS, _DIGEST = "config.toml", "environment.json", ".checkpoints", "config_sha256"


@dataclass(eq=False)
class Run:
    """One run of a command. `open_run` makes it."""

    out: Path  # the folder that the user named
    work: Path  # where files are written: `DIR.partial`, or `out` when `done`
    config: dict[str, Any]  # resolved, plain values, as in `config.toml`
    digest: str  # fingerprint of the configuration
    done: bool  # `out` holds the complete result of this configuration: there is nothing to do

    def path(self, *parts: str) -> Path:
        """A file in the run's folder; the folders above it are made."""
        path = self.work.joinpath(*parts)
        if not self.done:
            path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def kept(self, *parts: str) -> Path:
        """A file, or a folder, that a killed run leaves for the next; `place` puts it where the result has it."""
        return self.path(_CHECKPOINTS, *parts)

    def place(self, kept: Path) -> None:
        """The files under the folder `kept` as the run's own. They stay there too until the run is complete, so that
        one that is killed in between has them still."""
        shutil.copytree(kept, self.work, copy_function=_linked, dirs_exist_ok=True)

    def checkpoint(self, name: str, compute: Callable[[], Any]) -> Any:
        """`compute()`, or what it gave before the run was killed.

        **Arguments:** `name` is the stage (letters, digits, `_`, `-`, `.`); `compute` returns dicts with string keys,
        lists, tuples, strings, numbers, None and arrays, nested at will. Arrays come back as NumPy arrays, the first
        time too, so that a resumed run goes on with the very same values.
        """
        if not re.fullmatch(r"[\w.-]+", name):
            raise ValueError(f"a checkpoint is named by letters, digits, '_', '-' and '.', not {name!r}")
        path = self.path(_CHECKPOINTS, name + ".npz")
        if path.exists():
            with contextlib.suppress(OSError, ValueError, KeyError, zipfile.BadZipFile):
                return load(path)
        if self.done:
            raise ValueError(f"{self.out} is complete: its checkpoints are gone, read its files instead")
        arrays = packed(compute())
        with atomic_file(path) as temporary, open(temporary, "wb") as file:
            np.savez(file, allow_pickle=False, **arrays)
        return load(path)


@contextlib.contextmanager
def open_run(
    out: str | os.PathLike[str],
    config: Mapping[str, Any],
    *,
    seed: int | None = None,
    command: Sequence[str] | None = None,
    environment: Mapping[str, Any] | None = None,
    replace: bool = False,
) -> Iterator[Run]:
    """A run in the folder `out`; when the block ends without an exception, `out` is there and complete.

    ```python
    with open_run("results", {"verb": "diagnose", "logs": ["a.csv"], "log_sha256": "…"}, seed=0) as run:
        if not run.done:
            fit = run.checkpoint("calibrate", lambda: calibrate(…))
            run.path("figures", "before_after.png").write_bytes(…)
    ```

    An exception leaves `DIR.partial` with its checkpoints, to be resumed by the same configuration; an `InputError`
    leaves nothing, as the same command would fail again.

    **Arguments:** `config` is everything that decides the result, fingerprints of the input files included; a None in
    it is left out. `seed`, `command` (default `sys.argv`) and what is in `environment` are recorded in
    `environment.json`. `replace`: a run of another configuration in `out` stays until this one takes its place.

    **Raises:** `InputError` where `out` holds something else, is in use by another process or cannot be written.
    """
    plain = _plain(config)
    if "hdev" in plain:
        raise ValueError("the table [hdev] of config.toml is the run's own")
    version = _version()
    digest = config_digest(plain, version)
    target = Path(os.path.realpath(out))
    partial = target.with_name(target.name + ".partial")
    try:
        done = _is_done(target, digest, out, replace)
        lock = None if done else _claim(partial, digest, out)
    except OSError as e:
        raise InputError(f"--out {out}: cannot be written ({e.strerror or e}); name a folder that you may write") from e
    if done:
        yield Run(target, target, plain, digest, done=True)
        return
    try:
        started = time.time()
        recorded = _environment(seed, list(sys.argv if command is None else command), started)
        recorded |= {**(environment or {}), "resumed": (partial / _CHECKPOINTS).is_dir()}
        _write_text(partial / _ENVIRONMENT, json.dumps({**recorded, "pid": os.getpid()}, indent=2) + "\n")
        head = {"hdev": {"version": version, _DIGEST: digest}}
        _write_text(partial / _CONFIG, tomli_w.dumps({**head, **plain}))
        try:
            yield Run(target, partial, plain, digest, done=False)
        except InputError:
            shutil.rmtree(partial, ignore_errors=True)
            raise
        shutil.rmtree(partial / _CHECKPOINTS, ignore_errors=True)
        recorded |= {"seconds": round(time.time() - started, 3), "files": sorted(_files(partial))}
        _write_text(partial / _ENVIRONMENT, json.dumps(recorded, indent=2) + "\n")
        try:
            if replace and _stamp(target / _CONFIG) is not None:
                shutil.rmtree(target)
            os.replace(partial, target)
        except OSError as e:
            raise InputError(f"--out {out}: changed during the run ({e.strerror}); the result is in {partial}") from e
    finally:
        if lock is not None:
            os.close(lock)


def is_complete(out: str | os.PathLike[str], config: Mapping[str, Any]) -> bool:
    """Whether `out` holds the complete result of this configuration: `open_run` would have nothing to do."""
    target = Path(os.path.realpath(out))
    return _stamp(target / _CONFIG) == config_digest(_plain(config)) and _has_all(target)


def config_digest(config: Mapping[str, Any], version: str | None = None) -> str:
    """SHA-256 of a configuration and of the version that runs it; the order of keys does not matter."""
    text = json.dumps([_plain(config), version or _version()], sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


@contextlib.contextmanager
def atomic_file(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary path beside `path`, with its ending, that takes its place when the block ends without an exception.

    **Raises:** `InputError` where the file cannot be written.
    """
    path = Path(path)
    temporary = path.with_name(f".partial-{os.getpid()}-{path.name}")
    try:
        if path.is_dir():
            raise IsADirectoryError(0, "it is a folder")
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.touch()
    except OSError as e:
        raise InputError(f"{path}: cannot be written ({e.strerror or e}); name a file that you may write") from e
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _claim(partial: Path, digest: str, shown: str | os.PathLike[str]) -> int | None:
    """Make or take over `DIR.partial` and lock it; the lock goes with the process, however that ends."""
    while True:
        partial.mkdir(parents=True, exist_ok=True)
        lock = _lock(partial, shown)
        # The one who held it may have renamed or removed the folder between our mkdir and our lock.
        if lock is None or (partial.exists() and os.path.samestat(os.fstat(lock), os.stat(partial))):
            break
        os.close(lock)
    try:
        _clear(partial, digest, shown)
        probe = partial / ".hdev-probe"
        probe.touch()
        probe.unlink()
    except BaseException:
        if lock is not None:
            os.close(lock)
        raise
    return lock


def _lock(partial: Path, shown: str | os.PathLike[str]) -> int | None:
    """An advisory lock on the folder itself: it survives the rename, and a dead process holds none."""
    if fcntl is None:
        return None
    fd = os.open(partial, os.O_RDONLY)
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as e:
        os.close(fd)
        with contextlib.suppress(OSError, ValueError, KeyError):
            pid = json.loads((partial / _ENVIRONMENT).read_text())["pid"]
            raise InputError(f"--out {shown}: another run (process {pid}) is writing there; wait for it") from e
        raise InputError(f"--out {shown}: another run is writing there; wait for it") from e
    except OSError:  # a file system without locks, some network mounts
        os.close(fd)
        return None
    return fd


def _clear(partial: Path, digest: str, shown: str | os.PathLike[str]) -> None:
    """Empty what a killed run left, but for the checkpoints of this same configuration; refuse what is not ours."""
    found = _stamp(partial / _CONFIG)
    entries = list(partial.iterdir())
    first = (".hdev-", ".partial-", _ENVIRONMENT)  # what is there before config.toml is
    if found is None and not all(e.name.startswith(first) for e in entries):
        raise InputError(f"--out {shown}: {partial.name} beside it holds other files; move them or name another folder")
    for entry in entries:
        if entry.name == _CHECKPOINTS and found == digest:
            continue
        shutil.rmtree(entry) if entry.is_dir() and not entry.is_symlink() else entry.unlink()


def _is_done(target: Path, digest: str, shown: str | os.PathLike[str], replace: bool) -> bool:
    """Whether `target` is the complete result of this configuration; False where it is absent or empty."""
    if target == Path.cwd() or target.parent == target:
        raise InputError(f"--out {shown}: is the current folder; name a new one in it, such as --out result")
    if not target.exists():
        return False
    if not target.is_dir():
        raise InputError(f"--out {shown}: is a file; name a folder")
    if not any(target.iterdir()):
        return False
    found = _stamp(target / _CONFIG)
    if found is None:
        raise InputError(f"--out {shown}: holds other files; name a new or an empty folder")
    if found == digest and _has_all(target):
        return True
    if replace:
        return False
    if found != digest:
        raise InputError(
            f"--out {shown}: holds a run of another configuration (see its {_CONFIG}); name another folder or remove it"
        )
    raise InputError(f"--out {shown}: holds this run, but files of it are missing; remove the folder to run it again")


def _has_all(target: Path) -> bool:
    """Whether every file is there that the run wrote."""
    with contextlib.suppress(OSError, ValueError, KeyError):
        files = json.loads((target / _ENVIRONMENT).read_text())["files"]
        return all((target / f).exists() for f in files)
    return False


def _stamp(config: Path) -> str | None:
    """The digest of a `config.toml` that we wrote, recomputed from its content; None where it is not ours."""
    try:
        content = tomllib.loads(config.read_text(encoding="utf-8"))
        head = content.pop("hdev")
        digest = config_digest(content, head["version"])
        return digest if head[_DIGEST] == digest else "edited by hand"
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None


def _plain(value: Any) -> Any:
    """The value in TOML's types: paths as they were typed, tuples as lists, NumPy scalars as numbers, no None."""
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items() if v is not None}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, bool | int | float | str):
        return value
    raise TypeError(f"a configuration holds numbers, strings, lists and tables, not {type(value).__name__}: {value!r}")


def _linked(source: str, target: str) -> None:
    try:
        os.link(source, target)
    except OSError:  # a file system without links
        shutil.copy2(source, target)


def _environment(seed: int | None, command: list[str], started: float) -> dict[str, Any]:
    packages = {}
    with contextlib.suppress(importlib.metadata.PackageNotFoundError):
        for requirement in importlib.metadata.requires("hdev_jax") or []:
            name = re.split(r"[^\w.-]", requirement, maxsplit=1)[0]
            with contextlib.suppress(importlib.metadata.PackageNotFoundError):
                packages[name] = importlib.metadata.version(name)
    return {
        "command": command,
        "seed": seed,
        "started": datetime.datetime.fromtimestamp(started, datetime.UTC).isoformat(timespec="seconds"),
        "hdev_jax": _version(),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "cpu_count": os.cpu_count(),
        "xla_flags": os.environ.get("XLA_FLAGS", ""),
        "packages": packages,
    }


def _version() -> str:
    from hdev_jax import __version__

    return __version__


def _files(folder: Path) -> list[str]:
    return [p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()]


def _write_text(path: Path, text: str) -> None:
    with atomic_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
