"""Synthetic logs as files that a customer would send, read back and diagnosed; and the steps on the way there."""

import contextlib
import importlib.util
import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import jax.numpy as jnp
import pandas as pd

from hdev_jax.compiling import make_room
from hdev_jax.diagnosis.candidates.candidate import Candidate
from hdev_jax.diagnosis.competition.refit import refit
from hdev_jax.diagnosis.competition.state import Found, State
from hdev_jax.diagnosis.diagnose import Outcome, diagnose
from hdev_jax.diagnosis.scores.scores import score_all
from hdev_jax.diagnosis.training import Training
from hdev_jax.fleet import SyntheticLog, synthetic_log
from hdev_jax.inference import CHUNK_ROWS, cluster_rows, padded
from hdev_jax.inference.sheet import read_sheet
from hdev_jax.logs import read_log
from hdev_jax.physics import LIBRARY, Effect, Shape, Size, most_group
from hdev_jax.problem import Problem, Split, prepare, split_trips

__all__ = [
    "FEW",
    "ROAD_SIDE",
    "SHORT",
    "FadingStart",
    "breaches",
    "declared",
    "diagnosed",
    "found_in_turn",
    "library_of",
    "named",
    "opened",
    "training",
]

CHECKER = Path(os.environ.get("HDEV_DATA") or Path(__file__).parents[2] / "shared" / "data").parent
CHECKER = CHECKER / "check_diagnosis.py"

# what a sheet of a log that enters at the shaft needs besides, to be asked from the road
ROAD_SIDE = """
[road]
c_rr   = { value = 0.0060, sd = 0.0008 }
cda_m2 = { value = 5.6, sd = 0.5 }
[driveline]
efficiency = 0.91
gear_ratios = [9.16, 5.27, 3.33, 2.16]
final_drive = 4.5
wheel_radius_m = 0.5
"""

# Effects for tests of what stands around a diagnosis: with few, it compiles in a fraction of the time.
FEW = (
    "air_density",
    "auxiliary_power",
    "headwind",
    "mass_scale",
    "power_gain",
    "second_switching_load",
    "switching_load",
)

SHORT = {"trips": 12, "rows_per_trip": 120, "ar_coefficient": 0.97}


@contextlib.contextmanager
def library_of(ids: Iterable[str]) -> Iterator[None]:
    """The library has these effects alone, in this process; afterwards all are there again, in their order."""
    whole, kept = dict(LIBRARY), set(ids)
    for k in whole.keys() - kept:
        del LIBRARY[k]
    try:
        yield
    finally:
        LIBRARY.clear()
        LIBRARY.update(whole)


def diagnosed(problem: Problem, split: Split, library: Mapping[str, type[Effect]] = LIBRARY, **options) -> Outcome:
    """The whole loop, with what a process that compiles for every log has to forget now and then."""
    make_room()
    return diagnose(problem, split, library, **{"seed": 0} | options)


def opened(
    folder: Path, *, road_side: bool = False, change=lambda frame: None, target: str | None = None, **options
) -> tuple[SyntheticLog, Problem, Split]:
    """A short log written and read back, before anything is sought; `change` may alter its table, a pandas frame."""
    synthetic = synthetic_log(**{"trips": 8, "rows_per_trip": 120, "ar_coefficient": 0.97} | options)
    assert isinstance(synthetic.frame, pd.DataFrame)
    change(synthetic.frame)
    files = synthetic.write(folder, truth=False)
    if road_side:
        files["sheet"].write_text(files["sheet"].read_text() + ROAD_SIDE)
    log = read_log([files["log"]])
    split = split_trips(log)
    return synthetic, prepare(split.log, read_sheet(files["sheet"]), target), split


def named(result: Outcome) -> list[str]:
    """Ids of what was found, in order."""
    return [e["id"] for e in result.summary["effects"]]


def training(problem: Problem, ids: Iterable[str] = (), *, chunk_rows: int = CHUNK_ROWS) -> Training:
    """The whole log as training rows, with these effects of the library as candidates."""
    rows, clusters = padded(problem.segments, problem.measured), cluster_rows(problem.segments)
    library = {k: LIBRARY[k] for k in ids}
    return Training(rows, problem.target, clusters, library, most_group(problem.segments), chunk_rows=chunk_rows)


def declared(training: Training, problem: Problem) -> State:
    """The declared model, calibrated."""
    return State(training.calibrate(problem.vehicle, problem.table))


def found_in_turn(training: Training, problem: Problem, ids: Iterable[str], **only: Candidate) -> State:
    """The state as if these had been found one after the other, by the way that scores best; or by that in `only`."""
    state = declared(training, problem)
    for id_ in ids:
        scores = score_all(training, state.fit)
        score = scores.white.score(only[id_]) if id_ in only else scores.best[id_]
        came = refit(training, state, score, scores)
        assert came.fit is not None, id_
        found = Found(id_, came.score, 1e-9, 1.0, (), came.gain)
        state = replace(state, fit=came.fit, found=(*state.found, found))
    return state


class FadingStart(Effect):
    """A user's own, without bounds: a time constant below 0 would make a column that no number holds."""

    id: ClassVar = "fading_start"
    stage: ClassVar = "battery"
    equation: ClassVar = "P·exp(−t/τ)"
    parameters: ClassVar = (
        Size("power_w", "W", 0.0, 1e4),
        Shape("tau_s", "s", 100.0, 100.0, grid=(20.0, 100.0, 400.0)),
    )
    power_w: Any
    tau_s: Any

    def power(self, row, car, point):
        """Power [W]."""
        return self.power_w * jnp.exp(-row.time_s / self.tau_s)


def breaches(diagnosis: Outcome) -> list[str]:
    """What the contract's own checker says of it; nothing where the checker is not at hand."""
    if not CHECKER.exists():
        return []
    spec = importlib.util.spec_from_file_location("check_diagnosis", CHECKER)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.check(diagnosis.summary)
