"""Does the diagnosis name what was planted, and nothing else? Synthetic logs with known truth, rivals on the same logs.

One task is one log: made by the generator (which shares no code with the kernel), written and read as a customer's
would be, diagnosed, and given to the rivals. *Size* is the RMS of what is planted after projecting off the declared
coefficients, over the noise's. *Exactly it* is one entry: the planted id, or a class of at most three that holds it.
"""

import tempfile
import time
from collections.abc import Iterator
from itertools import product
from typing import Any, Literal

import numpy as np
from pydantic import Field, model_validator

from experiments.config import Strict
from experiments.planted_tables import collect
from experiments.rivals import run_rivals
from hdev_jax.diagnosis.diagnose import diagnose
from hdev_jax.diagnosis.problem import Problem, prepare
from hdev_jax.diagnosis.split import Split, split_trips
from hdev_jax.fleet import PLANTABLE, SyntheticLog, synthetic_log
from hdev_jax.inference import calibrate, cluster_rows, effect_coefficients, padded
from hdev_jax.inference.sheet import read_sheet
from hdev_jax.logs import read_log
from hdev_jax.physics import LIBRARY, at_null

__all__ = ["SOURCES", "Case", "Config", "collect", "exact", "run", "tasks", "together"]

SOURCES = ("planted.py", "rivals.py")  # that a log's result depends on, beside the package

Noise = Literal["white", "ar1", "ar1_white", "trip_levels", "student_t", "trip_variance"]
Rival = Literal["stlsq", "lasso_cv", "forward_bic", "lightgbm"]


class Case(Strict):
    """A block of logs: every effect set × size × number of trips × noise, `logs` of each."""

    name: str
    effects: list[list[str]] | str = Field(default_factory=lambda: [[]])  # or the name of one of the config's sets
    sizes: list[float] = Field(default_factory=lambda: [1.0])
    trips: list[int] = Field(default_factory=lambda: [24])
    noises: list[Noise] = Field(default_factory=lambda: ["ar1"])
    logs: int = 10
    rows_per_trip: int = 250
    entry: Literal["road", "shaft", "wheel"] = "road"
    mode: Literal["segments", "samples"] = "segments"
    # least share of logs that name exactly what was planted; that name nothing, where the library has no name for it or
    # nothing was planted; that call it absorbed by a declared coefficient, where `absorbed`
    wanted: float | None = None
    wanted_unexplained: float | None = None  # least share of logs in which something is called unexplained
    absorbed: bool = False
    wanted_pooled: float | None = None  # the same over all settings of the case together


class Config(Strict):
    """The study: cases, and what is shared by all of them. `seed` is the first log's; every log has its own."""

    experiment: Literal["planted"]
    cases: dict[str, Case]
    only: list[str] = Field(default_factory=list)  # cases to run; all where none is named
    sets: dict[str, list[list[str]]] = Field(default_factory=dict)
    seed: int = Field(1000, ge=0)
    fdr: float = 0.05

    @model_validator(mode="after")
    def _sets_are_there(self) -> "Config":
        for key, case in self.cases.items():
            if isinstance(case.effects, str) and case.effects not in self.sets:
                raise ValueError(
                    f"cases.{key}.effects: one of {', '.join(self.sets)} is expected, found {case.effects!r}"
                )
        return self

    ar_coefficient: float = 0.97
    rivals: list[Rival] = Field(default_factory=list)


def tasks(config: Config) -> Iterator[dict[str, Any]]:
    """One for each log. A log's seed counts on through the whole study, so that no two share their noise."""
    seed = config.seed
    for key, case in config.cases.items():
        sets = config.sets[case.effects] if isinstance(case.effects, str) else case.effects
        for effects, size, trips, noise in product(sets, case.sizes, case.trips, case.noises):
            for _ in range(case.logs):
                seed += 1
                if config.only and key not in config.only:
                    continue
                yield {
                    "case": case.name, "effects": effects, "size": size, "trips": trips, "noise": noise,
                    "seed": seed - 1, "rows_per_trip": case.rows_per_trip, "entry": case.entry, "mode": case.mode,
                    "ar_coefficient": config.ar_coefficient, "fdr": config.fdr, "rivals": config.rivals,
                }  # fmt: skip


def together(task: dict[str, Any]) -> str:
    """Logs of the same effects, whose programs are the same; of logs with nothing planted, those of the same noise."""
    return "+".join((task["entry"], *(task["effects"] or (task["noise"], str(task["trips"])))))


def run(task: dict[str, Any]) -> dict[str, Any]:
    """One log through the whole loop."""
    wanted = {k: {} for k in task["effects"]}
    try:
        synthetic = synthetic_log(
            seed=task["seed"], trips=task["trips"], rows_per_trip=task["rows_per_trip"], effects=wanted,
            ratio=task["size"] if wanted else None, noise=task["noise"], ar_coefficient=task["ar_coefficient"],
            entry=task["entry"], mode=task["mode"],
        )  # fmt: skip
    except ValueError as e:
        return {"skipped": str(e)}
    with tempfile.TemporaryDirectory() as folder:
        files = synthetic.write(folder, truth=False)
        log, sheet = read_log([files["log"]]), read_sheet(files["sheet"])
    split = split_trips(log)
    problem = prepare(split.log, sheet)
    started = time.perf_counter()
    result = diagnose(problem, split, LIBRARY, fdr=task["fdr"], seed=0)
    seconds = time.perf_counter() - started
    summary = result.summary
    named = [{"id": e["id"], "class": [e["id"], *e["indistinguishable_from"]]} for e in summary["effects"]]
    return {
        "named": named,
        "exact": exact(task["effects"], [n["class"] for n in named]),
        "verdict": summary["verdict"],
        "unexplained": summary["unexplained"]["significant"],
        "not_decidable": [c["id"] for c in summary["not_decidable"]],
        "absorbed": sorted({a for p in summary["baseline"]["parameters"].values() for a in p["absorbs"]}),
        "why_not": {c["id"]: c["why_not"] for c in summary["candidates"] if c["id"] in task["effects"]},
        "sizes": sizes(synthetic, summary["effects"]),
        "test_rmse": {k: summary[k]["test"]["rmse"] for k in ("before", "after")},
        "oracle_rmse": oracle(synthetic, problem, split),
        "ratio": synthetic.ratio if wanted else 0.0,
        "seconds": seconds,
        "rivals": run_rivals(list(task["rivals"]), problem, split),
    }


def exact(planted: list[str], classes: list[list[str]]) -> bool:
    """Every planted effect has one entry that holds it, and there is no other entry."""
    left = list(planted)
    for names in classes:
        hit = next((p for p in left if p in names), None)
        if hit is None or len(names) > 3:
            return False
        left.remove(hit)
    return not left


def sizes(synthetic: SyntheticLog, found: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Planted and found sizes of what was named itself."""
    out = []
    for e in found:
        planted = synthetic.vehicle.effects.get(e["id"], {})
        size = PLANTABLE[e["id"]].size if planted else ()
        for name, p in e["parameters"].items():
            if name in size and planted.get(name) and p["sd"] > 0:
                low, high = p["interval_90"]
                covered = low <= planted[name] <= high
                both = {"true": planted[name], "found": p["value"], "sd": p["sd"], "covered": covered}
                out.append({"id": e["id"], "name": name, **both})
    return out


def oracle(synthetic: SyntheticLog, problem: Problem, split: Split) -> float | None:
    """Test error of the declared model with what was planted, its sizes refitted on the same training trips.

    Where the library does not hold it in the same form, the noise of the test trips: no model does better.
    """
    test, train = problem.rows(split.test), problem.rows(split.train)
    planted = synthetic.vehicle.effects
    vehicle, table = problem.vehicle, problem.table
    for id_, values in planted.items():
        names = {p.name for p in LIBRARY[id_].parameters} if id_ in LIBRARY else set()
        if not set(values) <= names:
            return float(np.sqrt(np.mean(synthetic.truth["noise"].to_numpy()[test] ** 2)))
        null = at_null(LIBRARY[id_])
        leaves = {p.name: getattr(null, p.name) for p in LIBRARY[id_].parameters}
        limits = {p.name for p in LIBRARY[id_].parameters if p.kind == "limit" and p.name not in values}
        leaves |= {k: np.asarray(float(v)) for k, v in values.items()} | dict.fromkeys(limits)
        effect = LIBRARY[id_](**leaves)
        vehicle = vehicle.plus(effect)
        fitted = [p.name for p in LIBRARY[id_].parameters if p.kind in ("size", "limit") and values.get(p.name)]
        table = table.plus(*effect_coefficients(effect, fitted, shapes=False))
    rows = padded(problem.segments.take(train), problem.measured[train])
    fit = calibrate(vehicle, table, rows, problem.target, cluster_rows(problem.segments.take(train)))
    return float(np.sqrt(np.mean((problem.measured - problem.predict(fit.vehicle))[test] ** 2)))
