"""The diagnosis on measured logs: `python -m experiments.measured.logs [PART …] --work DIR`, from a checkout.

Parts: niro (trained on each trip in turn), road (the Niro's force balance), ztbus (three folds of missions), withheld
(a known channel of ZTBus taken out of the log), load (road load with the force as target, and without any force).
Each run is one `hdev diagnose`; a run that is there already is read, not repeated, one that was cut off goes on where
it was, and one of other code, sheet or adapter is made again. With --write the page docs/real_logs.md and its figures
are made from all runs that are kept in DIR; with --kept nothing is run. HDEV_DATA names the data (default
../shared/data).
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
import tomllib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import hdev_jax
from experiments.measured import page as pages
from experiments.measured.road_load import PAIRS
from experiments.measured.withheld import WITHHELD, compare_logs, write_adapter
from experiments.runner.store import sources_of
from hdev_jax.textfiles import digest
from hdev_jax.verbs.predict import correlated_pairs

__all__ = ["Job", "jobs", "kept", "main"]

DATA = Path(os.environ.get("HDEV_DATA", "../shared/data"))
PARTS = ("niro", "road", "ztbus", "withheld", "load")
TRIPS = ("1", "2", "3", "4")
FOLDS = (1, 2, 3)
# Which channel is withheld in which fold. The heat from passengers is small: the fold decides whether it is found.
HELD = (("temperature", 1), ("passengers", 1), ("passengers", 3), ("steering", 1))
CODE = tuple(
    Path(hdev_jax.__file__).parent / p
    for p in ("diagnosis/diagnose.py", "diagnosis/result/stages.py", "verbs/opening.py")
)
ZTBUS = Path("configs/adapters/ztbus.toml")


@dataclass(frozen=True)
class Job:
    """One run of `hdev diagnose`; `test` and `train` are the trips asked for, empty where the command names none."""

    name: str
    logs: tuple[Path, ...]
    vehicle: str
    adapter: Path
    train: tuple[str, ...] = ()
    test: tuple[str, ...] = ()
    target: str | None = None

    @property
    def arguments(self) -> list[str]:
        split = (("--train-trips", self.train), ("--test-trips", self.test))
        return [
            *map(str, self.logs), "--vehicle", self.vehicle, "--adapter", str(self.adapter),
            *(["--target", self.target] if self.target else []),
            *(word for option, trips in split if trips for word in (option, ",".join(trips))),
        ]  # fmt: skip

    @property
    def made_of(self) -> str:
        """Fingerprint of the code that a diagnosis is computed by, of the sheet and of the adapter."""
        files = (Path(self.vehicle), self.adapter)
        return "-".join([sources_of(*CODE), *(digest(p)[:16] for p in files)])


def main(argv: list[str] | None = None) -> int:
    """Run the parts asked for and print, or write, the page of all that is kept."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"of {', '.join(PARTS)}; all where none is named")
    parser.add_argument("--work", type=Path, default=Path("out/real_logs"), help="where the runs are kept")
    parser.add_argument("--kept", action="store_true", help="run nothing: the page of the runs that are there")
    parser.add_argument("--write", action="store_true", help="write real_logs.md and its figures")
    parser.add_argument("--docs", type=Path, default=Path("docs"), help="where --write writes")
    parser.add_argument("--missions", type=int, help="only so many missions of ZTBus, for a quick look")
    options = parser.parse_args(argv)
    if unknown := set(options.parts) - set(PARTS):
        parser.error(f"no part {', '.join(sorted(unknown))}; there are {', '.join(PARTS)}")
    if options.missions and options.write and options.docs == Path("docs"):
        parser.error("a quick look is not written to docs/: name another folder with --docs")
    if not options.kept and not DATA.is_dir():
        print(f"no measured data in {DATA}: set HDEV_DATA; README.md says where it is from", file=sys.stderr)
        return 2
    asked, everything = options.parts or PARTS, jobs(options.work, options.missions)
    todo = [j for part in PARTS for j in everything[part] if part in asked and kept(j, options.work) is None]
    if not options.kept:
        for what, (_, columns) in WITHHELD.items():
            write_adapter(ZTBUS, columns, _adapter(f"ztbus_no_{what}", options.work))
        for pair in PAIRS:
            write_adapter(pair.adapter, pair.columns, _adapter(pair.power, options.work), drop_others=True)
        for k, job in enumerate(todo, 1):
            _run(job, options.work, f"{k} of {len(todo)}")
        if "withheld" in asked:
            _same_rest(everything["withheld"], options.work)
    results = {j.name: r for part in PARTS for j in everything[part] if (r := kept(j, options.work)) is not None}
    if absent := [j.name for part in PARTS for j in everything[part] if j.name not in results]:
        print(f"not on the page, for it was not run: {', '.join(absent)}", file=sys.stderr)
    warm = _temperatures(everything["ztbus"][0], options.work)
    rest = _json(options.work / "same_rest.json").get("rest", {})
    page, figures = pages.page(results, warm=warm, rest=rest)
    print(page)
    if options.write:
        pages.write(options.docs, page, figures)
    return 0


def jobs(work: Path, missions: int | None = None) -> dict[str, list[Job]]:
    """All runs by part. Every third mission of ZTBus is held out, three times."""
    niro, adapter = (DATA / "kia_niro",), Path("configs/adapters/kia_niro.toml")
    files = sorted(p for p in (DATA / "ztbus").glob("B*.csv.gz") if ".grade." not in p.name)
    if missions:
        files = [files[round(k * len(files) / missions)] for k in range(missions)]
    names = [p.name[:24] for p in files]
    sheet = "configs/vehicles/ztbus.toml"
    folds = {k: Job(f"ztbus_{k}", tuple(files), sheet, ZTBUS, test=tuple(names[k - 1 :: 3])) for k in FOLDS}
    power = {p.power: p.sheet for p in PAIRS}
    return {
        "niro": [Job(f"niro_{t}", niro, "configs/vehicles/kia_niro.toml", adapter, train=(t,)) for t in TRIPS],
        "road": [
            Job("niro_road", niro, "configs/vehicles/kia_niro_road.toml", adapter, ("1",), target="traction_force_n")
        ],
        "ztbus": list(folds.values()),
        "withheld": [
            replace(folds[k], name=f"ztbus_{k}_no_{what}", adapter=_adapter(f"ztbus_no_{what}", work))
            for what, k in HELD
        ],
        "load": [
            Job("niro_power", niro, power["niro_power"], _adapter("niro_power", work), ("1",)),
            Job("ztbus_road", tuple(files), power["ztbus_power"], ZTBUS, test=folds[1].test, target="traction_force_n"),
            Job("ztbus_power", tuple(files), power["ztbus_power"], _adapter("ztbus_power", work), test=folds[1].test),
        ],
    }


def _adapter(name: str, work: Path) -> Path:
    return work / "adapters" / f"{name}.toml"


def kept(job: Job, work: Path) -> dict[str, Any] | None:
    """A finished run, its cost and configuration with it; None where there is none, or one by another code, sheet or
    adapter. A folder of a run that was asked for otherwise ends it."""
    out = work / job.name
    result, cost = _json(out / "diagnosis.json"), _json(work / f"{job.name}.cost.json")
    if not result or not _begun(job, work):
        return None
    ran = tomllib.loads((out / "config.toml").read_text(encoding="utf-8"))
    asked: dict[str, Any] = {"vehicle": job.vehicle, "adapter": job.adapter.name}
    if job.target:
        asked["target"] = job.target
    if job.logs:  # where there is no data, the missions are not known by name
        asked |= {"asked_train": list(job.train), "asked_test": list(job.test)}
    there = {**ran, "adapter": Path(ran["adapter"]).name}
    if differs := [k for k, v in asked.items() if (there.get(k) or []) != v]:
        raise SystemExit(f"{out} holds another run ({', '.join(differs)}): name another --work, or remove it")
    covariance = _json(out / "predictive.json").get("covariance")
    if covariance is None:
        raise SystemExit(f"{out} lacks predictive.json: remove the folder, and the run is made again")
    together = correlated_pairs(covariance["names"], np.array(covariance["matrix"]))
    return {**result, "cost": cost, "ran": ran, "together": together, "coefficients": _coefficients(out)}


def _coefficients(out: Path) -> dict[str, tuple[float, float]]:
    """Value and standard deviation of each declared coefficient at the end, effects added."""
    sheet = tomllib.loads((out / "augmented_vehicle.toml").read_text(encoding="utf-8"))
    sections = {k: v for k, v in sheet.items() if isinstance(v, dict) and k != "effects"}
    return {
        f"{section}.{key}": (v["value"], v["sd"])
        for section, keys in sections.items() for key, v in keys.items() if isinstance(v, dict) and "sd" in v
    }  # fmt: skip


def _begun(job: Job, work: Path) -> bool:
    """Whether what there is of a run, finished or not, is of this code, sheet and adapter."""
    begun = work / f"{job.name}.begun"
    return begun.exists() and begun.read_text(encoding="utf-8") == job.made_of


def _run(job: Job, work: Path, place: str) -> None:
    """One diagnosis; its wall-clock seconds and peak memory are kept beside it."""
    out = work / job.name
    if not _begun(job, work):  # what there is, is of something else
        for old in (out, out.with_name(f"{job.name}.partial")):
            shutil.rmtree(old, ignore_errors=True)
    out.parent.mkdir(parents=True, exist_ok=True)
    (work / f"{job.name}.begun").write_text(job.made_of, encoding="utf-8")
    print(f"{time.strftime('%H:%M:%S')}  {place}: {job.name} …", file=sys.stderr, flush=True)
    started = time.monotonic()
    command = [sys.executable, "-m", "hdev_jax.cli", "diagnose", *job.arguments, "--out", str(out)]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
        _, status, usage = os.wait4(process.pid, 0)  # this child's own peak, not the largest of all so far
        process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"{job.name}: hdev diagnose ended with status {process.returncode}")
    cost = {"seconds": time.monotonic() - started, "peak_gib": usage.ru_maxrss / 2**20}
    (work / f"{job.name}.cost.json").write_text(json.dumps(cost), encoding="utf-8")
    seconds, gib = cost["seconds"], cost["peak_gib"]
    print(f"{time.strftime('%H:%M:%S')}  {job.name}: {seconds:.0f} s, {gib:.1f} GiB", file=sys.stderr, flush=True)


def _same_rest(withheld: list[Job], work: Path) -> None:
    """Read the log with and without each channel, and keep what differs. Once: it takes about a minute."""
    path = work / "same_rest.json"
    made_of = sorted({j.made_of for j in withheld})
    if _json(path).get("made_of") != made_of:
        print(f"{time.strftime('%H:%M:%S')}  comparing the logs with and without …", file=sys.stderr, flush=True)
        rest = {what: compare_logs(withheld[0].logs, ZTBUS, _adapter(f"ztbus_no_{what}", work)) for what in WITHHELD}
        path.write_text(json.dumps({"made_of": made_of, "rest": rest}, indent=1), encoding="utf-8")


def _temperatures(job: Job, work: Path) -> dict[str, float]:
    """Mean outside temperature [°C] of each mission, kept beside the runs so that the page needs no data."""
    path = work / "temperatures.json"
    if not path.exists() and job.logs:
        import pandas as pd

        column = "temperature_ambient"
        warm = {p.name[:24]: pd.read_csv(p, usecols=[column])[column].mean() - 273.15 for p in job.logs}
        work.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(warm, indent=1), encoding="utf-8")
    return _json(path)


def _json(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}


if __name__ == "__main__":
    sys.exit(main())
