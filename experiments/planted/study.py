"""Does the diagnosis name what was planted, and nothing else? Synthetic logs with known truth, rivals on the same logs.

One task is one log: made by the generator (which shares no code with the kernel), written and read as a customer's
would be, diagnosed, and given to the rivals. *Size* is the RMS of what is planted after projecting off the declared
coefficients, over the noise's. *Exactly it* is one entry: the planted id, or a class of at most three that holds it
(`scores`). A log's result keeps what was said of it, not how it scores.

An effect is planted where the log can separate it, but for two that have a twin in every log of road segments
(`scores.TWINS`): of them a class is asked for. A log in which an effect acts in one training trip only (rain, a
limit that is met once) is drawn anew, and the table counts how many were. What no test could tell from it is kept
beside (`oracle.confusable`).
"""

import tempfile
import time
from collections.abc import Iterator
from itertools import product
from typing import Any

import numpy as np

from experiments.planted.config import Config
from experiments.planted.oracle import confusable, noise_rmse, oracle_rmse
from experiments.planted.rivals import comparable, run_rivals
from experiments.planted.tables import collect
from hdev_jax.diagnosis.diagnose import diagnose
from hdev_jax.diagnosis.settings import Settings
from hdev_jax.fleet import PLANTABLE, SyntheticLog, synthetic_log
from hdev_jax.inference.sheet import read_sheet
from hdev_jax.logs import read_log
from hdev_jax.physics import LIBRARY
from hdev_jax.problem import Problem, Split, prepare, split_trips

__all__ = ["SOURCES", "Config", "collect", "run", "tasks", "together"]

SOURCES = ("oracle.py", "rivals.py")

LEAST_TRIPS = 2  # of training, that an effect acts in
SHARE = 0.05  # of an effect's sum of squares, from which on a trip counts
MOST_DRAWS = 20
APART = 1_000_000  # seeds between one draw of a log and the next


def tasks(config: Config) -> Iterator[dict[str, Any]]:
    """One for each log. A log's seed counts on through the whole study, so that no two share their noise."""
    seed = config.seed
    for key, case in config.cases.items():
        sets = config.sets[case.effects] if isinstance(case.effects, str) else case.effects
        asked_sizes = case.sizes if not case.parameters else [None]
        for effects, size, trips, noise in product(sets, asked_sizes, case.trips, case.noises):
            for _ in range(case.logs):
                seed += 1
                if config.only and key not in config.only:
                    continue
                yield {
                    "case": key, "effects": effects, "size": size, "trips": trips, "noise": noise,
                    "parameters": {k: case.parameters.get(k, {}) for k in effects},
                    "seed": seed - 1, "rows_per_trip": case.rows_per_trip, "entry": case.entry, "mode": case.mode,
                    "held": case.held, "table_sd": case.table_sd, "ar_coefficient": config.ar_coefficient,
                    "fdr": config.fdr, "settings": config.settings, "rivals": config.rivals,
                }  # fmt: skip


def together(task: dict[str, Any]) -> str:
    """Logs of the same effects, whose programs are the same; of logs with nothing planted, those of the same noise."""
    return "+".join((task["entry"], *(task["effects"] or (task["noise"], str(task["trips"])))))


def run(task: dict[str, Any]) -> dict[str, Any]:
    """One log through the whole loop."""
    planted = task["effects"]
    for redrawn in range(MOST_DRAWS):
        try:
            synthetic = synthetic_log(
                seed=task["seed"] + redrawn * APART, trips=task["trips"], rows_per_trip=task["rows_per_trip"],
                effects=task["parameters"], ratio=task["size"] if planted else None, noise=task["noise"],
                ar_coefficient=task["ar_coefficient"], entry=task["entry"], mode=task["mode"], held=task["held"],
                table_sd=task["table_sd"],
            )  # fmt: skip
        except ValueError as e:
            if redrawn:
                continue
            return {"skipped": str(e)}
        with tempfile.TemporaryDirectory() as folder:
            files = synthetic.write(folder, truth=False)
            log, sheet = read_log([files["log"]]), read_sheet(files["sheet"])
        if len(log) < len(synthetic.truth):  # noise beyond what vehicles have: the reader left rows out
            continue
        split = split_trips(log)
        problem = prepare(split.log, sheet)
        if all(acts_in(synthetic, problem, split, k) >= LEAST_TRIPS for k in planted):
            break
    else:
        return {"skipped": f"{MOST_DRAWS} draws: {', '.join(planted)} in fewer than {LEAST_TRIPS} training trips"}
    started = time.perf_counter()
    settings = Settings(**{"fdr": task["fdr"], **task["settings"]})
    result = diagnose(problem, split, LIBRARY, settings=settings, seed=0, next_drives=False)
    seconds = time.perf_counter() - started
    summary = result.summary
    parameters = summary["baseline"]["parameters"]
    nearest = {PLANTABLE[k].like or k for k in planted}
    compared = task["rivals"] if comparable(planted) else []
    return {
        "named": [
            {"id": e["id"], "class": [e["id"], *e["indistinguishable_from"]], "class_size": e["class_size"]}
            for e in summary["effects"]
        ],
        "verdict": summary["verdict"],
        "unexplained": summary["unexplained"]["significant"],
        "not_decidable": [{k: c[k] for k in ("id", "clusters_needed")} for c in summary["not_decidable"]],
        "clusters": summary["clusters"]["count"],
        "baseline": {k: {"prior_z": p["prior_z"], "absorbs": p["absorbs"]} for k, p in parameters.items()},
        "why_not": {c["id"]: c["why_not"] for c in summary["candidates"] if c["id"] in nearest},
        "sizes": sizes(synthetic, summary["effects"]),
        "test_rmse": {k: summary[k]["test"]["rmse"] for k in ("before", "after")},
        "oracle_rmse": oracle_rmse(synthetic, problem, split),
        "noise_rmse": noise_rmse(synthetic, problem, split),
        "ratio": synthetic.ratio if planted else 0.0,
        "redrawn": redrawn,
        "seconds": seconds,
        "alike": confusable(planted, synthetic, problem, split),
        "rivals": run_rivals(compared, problem, split),
    }


def acts_in(synthetic: SyntheticLog, problem: Problem, split: Split, effect: str) -> int:
    """How many training trips hold a twentieth or more of an effect's sum of squares."""
    squares = synthetic.truth[f"effect:{effect}"].to_numpy() ** 2
    each = np.array([np.sum(squares[problem.rows([t])]) for t in split.train])
    return int(np.sum((each > 0) & (each >= SHARE * np.sum(each))))


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
