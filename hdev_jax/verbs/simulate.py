"""The verb `simulate`: a synthetic fleet with known truth."""

import json
import shlex
import time
from pathlib import Path

import jax

from hdev_jax import progress
from hdev_jax.rundir import open_run

__all__ = ["simulate"]


def simulate(config: str | Path, *, out: str | Path) -> str:
    """A synthetic fleet with known truth, from its configuration (a TOML file), into the folder `out`.

    `log.parquet`, `truth.parquet` and `sheets` hold a file for each vehicle; `fleet.json`, a report and figures say
    what is in them. **Returns:** a summary as text. Raises `InputError`. In memory: `hdev_jax.fleet.simulate`.
    """
    from hdev_jax.fleet.config import load_config
    from hdev_jax.fleet.files import write_fleet
    from hdev_jax.report.fleet_page import fleet_summary, fleet_text, write_fleet_report

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
