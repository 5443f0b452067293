"""How the verbs begin: the library with a user's effects, the logs read, the trips split, the run's configuration."""

import difflib
import hashlib
import importlib.util
import inspect
import shlex
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np

from hdev_jax import progress
from hdev_jax.diagnosis.candidates.candidate import as_seen
from hdev_jax.diagnosis.candidates.facts import Facts, facts_of
from hdev_jax.diagnosis.candidates.plan import plan_of
from hdev_jax.diagnosis.candidates.programs import computed
from hdev_jax.errors import InputError
from hdev_jax.inference import padded
from hdev_jax.inference.sheet import Sheet, augmented_sheet, read_sheet, sheet_of_sections
from hdev_jax.logs import Log, log_from_frame, read_log
from hdev_jax.physics import LIBRARY, Effect, Parameter, at_null, library
from hdev_jax.physics.effect import HOOKS, STAGES
from hdev_jax.physics.library import DECLARED
from hdev_jax.problem import Problem, Split, prepare, split_trips, without_harmful_slope
from hdev_jax.rundir import Run
from hdev_jax.verbs.arguments import names_of, seed_of
from hdev_jax.verbs.result import Result

__all__ = [
    "Effects", "Logs", "Opening", "Vehicles", "chosen_effects", "command_line", "digest", "digest_of_effects",
    "digest_of_vehicle", "known_effects", "log_of", "named", "opened", "sheet_of", "tried",
]  # fmt: skip

Logs = Any  # a path or several, a `Log`, or a table in memory (pandas, polars, pyarrow, a mapping of arrays)
# a sheet's path, a sheet, its sections as a mapping, or a result with a fitted one
Vehicles = str | Path | Sheet | Mapping[str, Any] | Result
Effects = str | Path | Sequence[type[Effect]] | None  # a Python file of a user's own effects, or their classes
ROUNDING = 1e4  # units in the last place of the largest prediction, for two that count as equal


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


def known_effects(file: Effects) -> dict[str, type[Effect]]:
    """The library with a user's own effects: classes, or every `Effect` class that a Python file defines."""
    if file is None:
        return dict(LIBRARY)
    if not isinstance(file, str | Path):
        return _joined(list(file), "effects")
    path = Path(file)
    spec = importlib.util.spec_from_file_location("hdev_user_effects", path)
    if not path.is_file() or spec is None or spec.loader is None:
        raise InputError(f"--effects {file}: no such Python file")
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as e:  # a script that exits was not read to its end
        raise InputError(f"--effects {file}: does not run: {type(e).__name__}: {e}") from e
    own = [
        c for c in vars(module).values()
        if isinstance(c, type) and issubclass(c, Effect) and c.__module__ == module.__name__ and hasattr(c, "id")
    ]  # fmt: skip
    if not own:
        raise InputError(f"--effects {file}: defines no subclass of hdev_jax.physics.Effect with an id")
    return _joined(own, f"--effects {file}")


def _joined(own: Sequence[type[Effect]], where: str) -> dict[str, type[Effect]]:
    for c in own:
        if not (isinstance(c, type) and issubclass(c, Effect) and hasattr(c, "id")):
            raise InputError(f"{where}: {c!r} is no subclass of hdev_jax.physics.Effect with an id")
        if why := _malformed(c):
            raise InputError(f"{where}: class {c.__name__}: {why}")
    try:
        return library(own)
    except ValueError as e:
        raise InputError(f"{where}: {e}") from e


def _malformed(effect: type[Effect]) -> str | None:
    """Why a user's class is no effect, in one phrase; None where it is one."""
    stage, parameters = getattr(effect, "stage", None), effect.parameters
    if not (isinstance(effect.id, str) and effect.id.isascii() and effect.id.isidentifier()):
        return f"id is {effect.id!r}; letters, digits and underscores are expected"
    if effect.id in {c.id for c in DECLARED}:
        return f"id {effect.id!r} is a part of the declared model; give yours a name of its own"
    if stage not in STAGES:
        return f"stage is {stage!r}; one of {', '.join(STAGES)} is expected"
    if not isinstance(getattr(effect, "equation", None), str):
        return "equation is missing; a line of text is expected"
    for name in ("needs", "lacks", "entries"):
        if not _texts(value := getattr(effect, name)):
            return f"{name} is {value!r}; a tuple of names is expected"
    if not effect.entries or set(effect.entries) - {*Effect.entries}:
        return f"entries is {effect.entries!r}; some of {', '.join(Effect.entries)} are expected"
    if effect.searched:
        return f"searched is {effect.searched!r}; only effects of the library have a search of their own"
    if not any(effect.overrides(hook) for hook in HOOKS):
        return f"it overrides none of {', '.join(HOOKS)}, so it does nothing"
    if not (isinstance(parameters, tuple | list) and all(isinstance(p, Parameter) for p in parameters)):
        return "parameters is something else than a tuple of Size, Switch, Shape and Choice (hdev_jax.physics)"
    return _malformed_parameters(effect, parameters)


def _malformed_parameters(effect: type[Effect], parameters: Sequence[Parameter]) -> str | None:
    names = [p.name for p in parameters]
    if twice := {n for n in names if names.count(n) > 1}:
        return f"two parameters are called {min(twice)}"
    for p in parameters:
        if not (p.has_column or len(p.grid) or p.mean_of):  # some of the library's have a search of their own
            return f"parameter {p.name!r}: a {type(p).__name__} without a grid is never tried; give it values to try"
        if p.of and p.of not in names:
            return f"parameter {p.name!r}: of is {p.of!r}; one of {', '.join(names)} is expected"
    if all(not p.has_column for p in parameters):
        return "parameters has no size and no switch, so it could not be found"
    if not (isinstance(effect.variants, tuple | list) and all(map(_texts, effect.variants))):
        return f"variants is {effect.variants!r}; a tuple of tuples of names is expected"
    if odd := [n for variant in effect.variants for n in variant if n not in names]:
        return f"variants has {odd[0]!r}; sets of {', '.join(names)} are expected"
    try:
        made = at_null(effect)
    except Exception as e:
        return f"cannot be made with its parameters ({', '.join(names)}): {type(e).__name__}: {e}"
    if odd := [x for x in jax.tree.leaves(made) if not eqx.is_array_like(x)]:
        return f"has a field that holds {odd[0]!r}, no number; make it a ClassVar or equinox.field(static=True)"
    return None


def _texts(names: Any) -> bool:
    return isinstance(names, tuple | list) and all(isinstance(n, str) for n in names)


def tried(problem: Problem, known: Mapping[str, type[Effect]], file: Effects, *candidates: str) -> None:
    """Compute the columns of a user's own effects on every row of the log, before anything is fitted: of those that
    are `candidates` or that the vehicle has.

    Raises `InputError` that names the class, for one that fails there, is not finite in every row, or changes
    the prediction while all of its sizes are null.
    """
    own = [c for k, c in known.items() if k not in LIBRARY and (k in candidates or problem.vehicle.has(k))]
    if not own:
        return
    car = problem.vehicle.minus(*(c.id for c in own if problem.vehicle.has(c.id)))
    rows, facts = padded(problem.segments, problem.measured), facts_of(problem.segments)
    plain = problem.predict(car)
    for c in own:
        where = f"{f'--effects {file}' if isinstance(file, str | Path) else 'effects'}: class {c.__name__}"
        bad = np.zeros(rows.rows, dtype=bool)
        try:
            plan = plan_of(car, [c], facts, problem.target, searched=True)
            for _, column in computed(plan.recipes, rows.segments, problem.target):
                bad |= ~np.isfinite(column[: rows.rows])
            null = plain if c.id in plan.left_out else problem.predict(car.plus(_idle(c, facts)))
        except Exception as e:
            hint = "; every channel that it reads belongs in its needs" if isinstance(e, KeyError) else ""
            raise InputError(f"{where}: fails on this log: {type(e).__name__}: {e}{hint}") from e
        if bad.any():
            first = int(np.argmax(bad))
            trip, at = problem.log.trip_names[problem.log.trip[first]], problem.segments.time_s[first]
            raise InputError(
                f"{where}: it or its derivative is not finite in {bad.sum()} of {rows.rows} rows, the first in trip "
                f"{trip} at {at:g} s; it must be finite in every row, in every branch"
            )
        if not np.allclose(null, plain, rtol=0.0, atol=ROUNDING * np.finfo(plain.dtype).eps * np.max(np.abs(plain))):
            raise InputError(
                f"{where}: changes the prediction by up to {np.max(np.abs(null - plain)):.3g} {problem.unit} while its "
                "sizes are null; it must add 0 there"
            )


def _idle(effect: type[Effect], facts: Facts) -> Effect:
    """With its sizes null and each shape at a value that is tried."""
    null = as_seen(at_null(effect, gears=facts.gears), facts)
    values = {p.name: getattr(null, p.name) for p in effect.parameters}
    tried = {p.name: np.asarray(float(p.grid[0])) for p in effect.parameters if not p.has_column and len(p.grid)}
    return effect(**(values | tried))


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


def digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else ""


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
