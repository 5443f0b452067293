"""The verb `simulate`: a synthetic fleet with known truth."""

import json
import shlex
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, overload

import jax

from hdev_jax import progress
from hdev_jax.errors import InputError
from hdev_jax.fleet import Fleet
from hdev_jax.fleet import simulate as in_memory
from hdev_jax.rundir import open_run

__all__ = ["simulate"]


@overload
def simulate(config: str | Path | Mapping[str, Any], *, out: None = None) -> Fleet: ...
@overload
def simulate(config: str | Path, *, out: str | Path) -> str: ...
def simulate(config: str | Path | Mapping[str, Any], *, out: str | Path | None = None) -> str | Fleet:
    """A synthetic fleet with known truth, from its configuration (a TOML file).

    **Arguments:** `config`: a TOML file; without `out` it may also be a mapping. `out`: a folder. In it `log.parquet`,
    `truth.parquet` and `sheets` are folders with one file per vehicle; `fleet.json`, a report and figures describe
    them.

    **Returns:** a summary as text; without `out`, the fleet in memory:
    `simulate({"seed": 1, "routes": 60})["A"].frame`. **Raises:** `InputError`.
    """
    if out is None and isinstance(config, str | Path | Mapping):
        return in_memory(config)
    if out is None or not isinstance(config, str | Path):
        other = " or, in memory, a mapping" if out is None else ""
        raise InputError(f"config: the path of a TOML file{other} is expected, found {type(config).__name__}")
    from hdev_jax.fleet.config import load_config
    from hdev_jax.fleet.files import write_fleet
    from hdev_jax.report.fleet import fleet_summary, fleet_text, write_fleet_report

    started = time.time()
    wanted = load_config(config)
    resolved = {"verb": "simulate", **wanted.table(), "x64": bool(jax.config.read("jax_enable_x64"))}
    with open_run(out, resolved, seed=wanted.seed) as run:
        if run.done:
            return (run.work / "answer.txt").read_text()
        progress.step(f"{wanted.routes} routes of {len(wanted.chosen)} vehicles")
        fleet = write_fleet(wanted, run, progress.step)
        progress.step("writing the report")
        summary = fleet_summary(fleet, wanted)
        run.path("fleet.json").write_text(json.dumps(summary, indent=1, allow_nan=False) + "\n")
        command = shlex.join(["hdev", "simulate", str(config), "--out", str(run.out)])
        write_fleet_report(fleet, wanted, command, time.time() - started, run.work)
        answer = fleet_text(summary, Path(out))
        run.path("answer.txt").write_text(answer)
    return answer
