"""The verb `fleet`: many measured vehicles, each diagnosed, and what they show together."""

import hashlib
import json
import os
import shlex
from collections.abc import Mapping, Sequence
from numbers import Real
from pathlib import Path
from typing import Any
from urllib.parse import quote

import jax
import numpy as np

from hdev_jax import progress
from hdev_jax.diagnosis.candidates.own import known_effects
from hdev_jax.errors import InputError
from hdev_jax.inference.sheet import read_sheet
from hdev_jax.logs.presets import PRESETS, is_preset
from hdev_jax.many import FleetResult, Source, Workers, computed, fleet_result, looking_again, sources, vehicle_record
from hdev_jax.physics import Effect
from hdev_jax.report.many import fleet_page, fleet_text
from hdev_jax.rundir import Run, atomic_file, open_run
from hdev_jax.targets import TARGETS
from hdev_jax.textfiles import digest
from hdev_jax.verbs.arguments import seed_of
from hdev_jax.verbs.energy.result import EnergyResult

__all__ = ["fleet"]


def fleet(
    logs: str | Path | Sequence[str | Path],
    vehicles: str | Path,
    adapter: str | Path | None = None,
    target: str | None = None,
    price: float | None = None,
    fdr: float = 0.05,
    *,
    effects: str | Path | None = None,
    out: str | Path,
    trust: bool = False,
    workers: int = 1,
    scheduler: str | None = None,
    seed: int = 0,
) -> EnergyResult:
    """Check, calibrate and diagnose every vehicle, and say what only a fleet can tell.

    **Arguments:**

    - `logs`: files (one vehicle each, named as the file) and folders of files or of vehicles' folders.
    - `vehicles`: one sheet for all, a folder of sheets NAME.toml, or a CSV table with the columns `vehicle`, `sheet`
      and, if wanted, `type`.
    - `price` of a kWh. `fdr`: the highest adjusted p-value, within each vehicle and over the fleet.
    - `effects`: a Python file of your own effects, which the search tries and a sheet may declare.
    - `trust`: search even where a unit or a sign seems to be wrong.
    - `workers`: processes on this machine; or `scheduler`: the address of a Dask cluster. Both need the extra `fleet`.
    - `out`: a folder for the page, `fleet.json`, tables and `vehicles/NAME.json`; an interrupted run resumes from it.

    **Returns:** an `EnergyResult`. Its `tables` are `fleet`, `effects`, `unlike`, `coefficients`, `ledger` and `about`;
    its `summary` is what `fleet.json` holds. A vehicle whose log is refused is listed with the reason.

    **Raises:** `InputError` where there is no vehicle, or none that can be used.
    """
    if not isinstance(fdr, Real) or not 0.0 < fdr < 1.0:
        raise InputError(f"fdr {fdr!r}: a number between 0 and 1 is expected")
    if price is not None and not (np.isfinite(price) and price >= 0):
        raise InputError(f"--price {price}: the price of a kWh, a number of 0 or more, is expected")
    if target is not None and target not in TARGETS:
        raise InputError(f"--target {target}: accepted: {', '.join(TARGETS)}")
    if workers < 1:
        raise InputError(f"--workers {workers}: 1 or more is expected")
    rules = None if adapter is None or is_preset(adapter) else Path(adapter).resolve()
    if rules is not None and not rules.is_file():
        raise InputError(f"--adapter {adapter}: no such file, and no preset; there are {', '.join(PRESETS)}")
    if not isinstance(effects, str | Path | None):
        raise InputError("effects: a Python file is expected; workers cannot be sent classes")
    library, own = known_effects(effects), None if effects is None else digest(Path(effects))
    seed = seed_of(seed)
    given = [logs] if isinstance(logs, str | Path) else list(logs)
    each, notes = sources(given, vehicles)
    config = {
        "verb": "fleet", "logs": [str(p) for p in given], "vehicles": str(vehicles), "count": len(each),
        "vehicles_sha256": _fingerprint(each, library), "adapter": None if adapter is None else str(adapter),
        "adapter_sha256": None if rules is None else digest(rules), "target": target, "price": price,
        **({} if effects is None else {"effects": str(effects), "effects_sha256": own}),
        "fdr": fdr, **({"trust": True} if trust else {}), "seed": seed, "x64": bool(jax.config.read("jax_enable_x64")),
    }  # fmt: skip
    common = {
        "adapter": None if adapter is None else str(rules or adapter), "target": target, "fdr": fdr, "seed": seed,
        "trust": trust, "effects": None if effects is None else str(Path(effects).resolve()),
        "effects_sha256": own,
    }  # fmt: skip
    with open_run(out, config, seed=seed) as run:
        if run.done:
            return EnergyResult.of_folder("fleet", run.work)
        records = _records(run, each, common, Workers(workers, scheduler))
        if not any(r["status"] in ("done", "suspect") for r in records):
            first = next(r for r in records if r["status"] != "done")
            raise InputError(f"none of {len(records)} vehicles could be used; the first: {first['message']}")
        progress.step("what the vehicles tell together")
        again = looking_again(_tasks(each, common), Workers(workers, scheduler), progress.step)
        result = fleet_result(records, fdr=fdr, seed=seed, price=price, notes=notes, again=again, library=library)
        progress.step("writing the report")
        run.place(run.kept("fleet"))
        answer = _answer(result, _command(config, out), price)
        answer.write(run, out)
    return answer


def _fingerprint(each: Sequence[Source], library: Mapping[str, type[Effect]]) -> str:
    """Of names, sheets and files, the files by size and time: reading all of them twice is too much for a fleet."""
    sha = hashlib.sha256()
    sheets: dict[str, str] = {}
    for s in each:
        stamps = [(f, (stat := os.stat(f)).st_size, stat.st_mtime_ns) for f in s.files]
        if s.sheet is not None and s.sheet not in sheets:
            sheets[s.sheet] = digest(Path(s.sheet)) + _map_digest(s.sheet, library)
        sha.update(repr((s.name, stamps, s.kind, s.missing, sheets.get(s.sheet or ""))).encode())
    return sha.hexdigest()


def _map_digest(sheet: str, library: Mapping[str, type[Effect]]) -> str:
    try:
        path = read_sheet(sheet, library=library).map_path
    except InputError:  # said of each vehicle that has it
        return ""
    return "" if path is None else digest(path)


def _records(run: Run, each: Sequence[Source], common: Mapping[str, Any], where: Workers) -> list[dict[str, Any]]:
    """The record of each vehicle: what a killed run has kept, or worked out now and kept."""
    at = {s.name: run.kept("fleet", "vehicles", f"{quote(s.name, safe=' =+,')}.json") for s in each}
    found: dict[str, dict[str, Any]] = {}
    for name, path in at.items():
        try:
            found[name] = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            continue
    todo = [s for s in each if s.name not in found]
    kept = f", {len(found)} done before" if found else ""
    progress.step(f"{len(each)} vehicles{kept}")
    tasks = _tasks(todo, common)
    for i, record in progress.track(computed(vehicle_record, tasks, where), "diagnosing", total=len(tasks)):
        record["sheet"] = todo[i].sheet
        with atomic_file(at[todo[i].name]) as temporary:
            temporary.write_text(json.dumps(record, allow_nan=False), encoding="utf-8")
        found[todo[i].name] = record
    return [found[s.name] for s in each]


def _tasks(each: Sequence[Source], common: Mapping[str, Any]) -> list[dict[str, Any]]:
    """What a worker is given: paths from the root, as it may run elsewhere."""

    def whole(path: str | None) -> str | None:
        return None if path is None else str(Path(path).resolve())

    return [{**vars(s), "files": [whole(f) for f in s.files], "sheet": whole(s.sheet), **common} for s in each]


def _command(config: Mapping[str, Any], out: str | Path) -> str:
    parts = ["hdev", "fleet", *config["logs"], "--vehicles", config["vehicles"]]
    for option in ("adapter", "target", "effects", "price"):
        if config.get(option) is not None:
            parts += [f"--{option}", str(config[option])]
    parts += ["--fdr", str(config["fdr"])] if config["fdr"] != 0.05 else []
    parts += ["--trust"] if config.get("trust") else []
    return shlex.join([*parts, "--seed", str(config["seed"]), "--out", str(out)])


def _answer(result: FleetResult, command: str, price: float | None) -> EnergyResult:
    kinds = " ".join(r["type"] or "" for r in result.records).lower()
    page = fleet_page(result, command, price=price, synthetic="synthetic" in kinds)
    return EnergyResult("fleet", fleet_text(result), result.summary, result.tables, page)
