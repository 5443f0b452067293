"""How the verbs begin: the library with a user's effects, the logs read, the trips split, the run's configuration."""

import difflib
import hashlib
import inspect
import shlex
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax

from hdev_jax import progress
from hdev_jax.diagnosis.candidates.own import Effects, tried
from hdev_jax.errors import InputError
from hdev_jax.inference.sheet import Sheet, augmented_sheet, read_sheet, sheet_of_sections
from hdev_jax.logs import Log, log_from_frame, read_log
from hdev_jax.physics import Effect
from hdev_jax.problem import Problem, Split, prepare, split_trips, without_harmful_slope
from hdev_jax.rundir import Run
from hdev_jax.textfiles import digest
from hdev_jax.verbs.arguments import names_of, seed_of
from hdev_jax.verbs.result import Result

__all__ = [
    "Logs", "Opening", "Vehicles", "chosen_effects", "command_line", "digest_of_effects",
    "digest_of_vehicle", "log_of", "named", "opened", "sheet_of",
]  # fmt: skip

Logs = Any  # a path or several, a `Log`, or a table in memory (pandas, polars, pyarrow, a mapping of arrays)
# a sheet's path, a sheet, its sections as a mapping, or a result with a fitted one
Vehicles = str | Path | Sheet | Mapping[str, Any] | Result


def log_of(logs: Logs, adapter: str | Path | None = None) -> Log:
    """The log in files, in memory, or as it is. Raises `InputError`, or `TypeError` for what is none of these."""
    if isinstance(logs, Log):
        return logs
    if isinstance(logs, str | Path):
        return read_log(logs, adapter)
    if isinstance(logs, Sequence) and not isinstance(logs, bytes):
        if odd := [type(p).__name__ for p in logs if not isinstance(p, str | Path)]:
            raise InputError(f"logs: a list of paths is expected, found {odd[0]}; concatenate tables first")
        return read_log(list(logs), adapter)
    return log_from_frame(logs, adapter=adapter)


def sheet_of(vehicle: Vehicles, library: Mapping[str, type[Effect]]) -> Sheet:
    """The sheet in a file, from Python, or as a result fitted it. Raises `InputError`."""
    if isinstance(vehicle, str) and "\n" in vehicle:
        raise InputError("vehicle: found the text of a sheet; give its path, a Sheet or a result")
    if isinstance(vehicle, Mapping):
        return sheet_of_sections(vehicle, library=library)
    if not isinstance(vehicle, str | Path | Sheet | Result):
        kind = type(vehicle).__name__
        raise InputError(f"vehicle: a sheet's path, a Sheet, its sections or a result is expected, found {kind}")
    if isinstance(vehicle, Result):
        return Sheet(library=library, path="fitted sheet", **tomllib.loads(vehicle.sheet))
    if isinstance(vehicle, Sheet):
        return vehicle.knowing(library)
    return read_sheet(vehicle, library=library)


def chosen_effects(
    known: Mapping[str, type[Effect]], only: Sequence[str] | None, exclude: Sequence[str] | None
) -> dict[str, type[Effect]]:
    """The effects that are tried. Raises `InputError` for an unknown name, or if none is left."""
    for name in (*(only or ()), *(exclude or ())):
        if name not in known:
            near = difflib.get_close_matches(name, list(known), 1)
            hint = f"; did you mean {near[0]!r}?" if near else "; `hdev effects` lists them"
            raise InputError(f"no effect {name!r} in the library{hint}")
    chosen = {k: c for k, c in known.items() if (only is None or k in only) and k not in (exclude or ())}
    if not chosen:
        raise InputError("--only and --exclude leave no candidate")
    return chosen


def named(given: Any) -> str:
    """What a configuration calls an argument: a path as given, a thing in memory by its kind."""
    return str(given) if isinstance(given, str | Path) else type(given).__name__


def digest_of_vehicle(vehicle: Vehicles, sheet: Sheet) -> str:
    if isinstance(vehicle, str | Path):
        return digest(Path(vehicle))
    return hashlib.sha256(augmented_sheet(sheet, {}, {}).encode()).hexdigest()


def digest_of_effects(effects: Effects) -> str | None:
    """Of the file, or of the files that hold the classes; raises `InputError` for a class that stands in none."""
    if effects is None or isinstance(effects, str | Path):
        return None if effects is None else digest(Path(effects))
    each = []
    for c in effects:
        try:
            each.append(f"{c.__qualname__} {digest(Path(inspect.getfile(c)))}")
        except (OSError, TypeError) as e:
            why = "with out=… its source is needed, and there is none; put the class in a file: effects='mine.py'"
            raise InputError(f"effects: class {c.__name__}: {why}") from e
    return hashlib.sha256(" ".join(each).encode()).hexdigest()


@dataclass(frozen=True)
class Opening:
    """What `diagnose` and `calibrate` start from: the log in its trips, the vehicle, the configuration."""

    sheet: Sheet
    problem: Problem
    split: Split
    config: dict[str, Any]

    @property
    def read(self) -> str:
        """What was read, for the first line of progress, when the input is accepted."""
        return f"read {len(self.problem.log)} rows of {len(self.problem.log.trip_names)} trips"


def opened(
    verb: str,
    logs: Logs,
    vehicle: Vehicles,
    adapter: str | Path | None,
    target: str | None,
    train_trips: Sequence[str] | None,
    test_trips: Sequence[str] | None,
    effects: Effects,
    seed: int,
    known: Mapping[str, type[Effect]],
    *candidates: str,
    kept: bool = True,
) -> Opening:
    """Read the logs and the sheet, bring them together and split the trips. Raises `InputError`.

    **Arguments:** `known`, the library with those of the file `effects`; `candidates`, ids of those that are tried;
    `kept`, whether the run is kept in a folder, which compares what it was made of.
    """
    seed, train_trips, test_trips = seed_of(seed), names_of(train_trips), names_of(test_trips)
    sheet = sheet_of(vehicle, known)
    with progress.busy("reading the logs"):
        log = log_of(logs, adapter)
        split = split_trips(log, train_trips, test_trips)
        problem = without_harmful_slope(prepare(split.log, sheet, target), split)
    tried(problem, known, effects, *candidates)
    config = {
        "verb": verb,
        "logs": [named(p) for p in (logs if isinstance(logs, list | tuple) else [logs])],
        "log_sha256": problem.log.fingerprint(),
        "vehicle": named(vehicle),
        "vehicle_sha256": digest_of_vehicle(vehicle, sheet),
        "map_sha256": None if sheet.map_path is None else digest(sheet.map_path),
        "adapter": None if adapter is None else str(adapter),
        "target": problem.target,
        "train_trips": split.names(split.train),
        "test_trips": split.names(split.test),
        "asked_train": None if train_trips is None else list(train_trips),
        "asked_test": None if test_trips is None else list(test_trips),
        "effects_file": None if effects is None else named(effects),
        "effects_sha256": digest_of_effects(effects) if kept else None,
        "seed": seed,
        "x64": bool(jax.config.read("jax_enable_x64")),
    }
    return Opening(sheet, problem, split, config)


def command_line(verb: str, run: Run | None) -> str:
    """The command that makes this run again: the split as the user gave it, and options that are not defaults; the
    function, where there is no folder."""
    if run is None:
        return f"hdev_jax.{verb}(log, sheet)"
    c = run.config
    parts = ["hdev", verb, *c["logs"], "--vehicle", c["vehicle"], "--target", c["target"]]
    lists = {"train-trips": "asked_train", "test-trips": "asked_test", "only": "only", "exclude": "exclude"}
    for option, key in lists.items():
        if c.get(key):
            parts += [f"--{option}", ",".join(c[key])]
    single = {"adapter": "adapter", "effects": "effects_file", "fdr": "fdr", "method": "method", "noise": "noise"}
    usual = {"fdr": 0.05, "method": "map", "noise": "normal"}
    for option, key in single.items():
        if c.get(key) is not None and c[key] != usual.get(key):
            parts += [f"--{option}", str(c[key])]
    parts += ["--trust"] if c.get("trust") else []
    return shlex.join([*parts, "--seed", str(c["seed"]), "--out", str(run.out)])
