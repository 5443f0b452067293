"""One diagnosis of a synthetic log, from the files that a customer would send."""

import importlib.util
import tempfile
from pathlib import Path

import jax

from hdev_jax.diagnosis.diagnose import Diagnosis, diagnose
from hdev_jax.fleet import SyntheticLog, synthetic_log
from hdev_jax.inference.sheet import read_sheet
from hdev_jax.logs import read_log
from hdev_jax.physics import LIBRARY
from hdev_jax.problem import Problem, Split, prepare, split_trips

__all__ = ["ROAD_SIDE", "breaches", "opened", "run"]

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

_runs = 0


def run(seed: int, **options) -> tuple[SyntheticLog, Diagnosis]:
    """Write the log and its sheet, read them back, and run the whole loop on the default split."""
    global _runs
    _runs += 1
    if _runs % 12 == 0:
        jax.clear_caches()  # a process that compiles for every log runs out of memory maps
    synthetic = synthetic_log(seed=seed, **options)
    with tempfile.TemporaryDirectory() as folder:
        files = synthetic.write(folder, truth=False)
        log, sheet = read_log([files["log"]]), read_sheet(files["sheet"])
        problem = prepare(log, sheet)
        return synthetic, diagnose(problem, split_trips(log), LIBRARY, seed=0)


def opened(folder: Path, **options) -> tuple[SyntheticLog, Problem, Split]:
    """A short log written and read back, as the study does it, before anything is sought."""
    synthetic = synthetic_log(**{"trips": 8, "rows_per_trip": 120, "ar_coefficient": 0.97} | options)
    files = synthetic.write(folder, truth=False)
    log = read_log([files["log"]])
    split = split_trips(log)
    return synthetic, prepare(split.log, read_sheet(files["sheet"])), split


def breaches(diagnosis: Diagnosis, shared: Path) -> list[str]:
    """What the contract's own checker says of it; nothing where the checker is not at hand."""
    path = shared / "check_diagnosis.py"
    if not path.exists():
        return []
    spec = importlib.util.spec_from_file_location("check_diagnosis", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.check(diagnosis.summary)
