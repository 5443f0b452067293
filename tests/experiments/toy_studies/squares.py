"""A study for tests of the engine: squares of numbers, drawn with a seed; no task takes longer than it is told to."""

import os
import random
import time
from pathlib import Path

from pydantic import Field

from experiments.runner.config import Strict
from experiments.runner.data import data_folder
from experiments.runner.figures import save_figure, styled
from experiments.runner.tables import write_tables
from hdev_jax.report.canvas import figure

__all__ = ["SOURCES", "Config", "alone", "collect", "run", "run_together", "tasks", "together"]

SOURCES = ()


class Noise(Strict):
    """What is added."""

    scale: float = 0.0


class Config(Strict):
    """So many numbers, `by` which each is divided; `diary`, a folder where tasks say that they have begun."""

    experiment: str
    count: int = 3
    by: float = 1.0
    seed: int = 0
    noise: Noise = Noise()
    wait_s: float = 0.0
    diary: str | None = None
    together: bool = False
    alone: list[int] = Field(default_factory=list)
    needs: str | None = None


def tasks(config):
    if config.needs:
        data_folder(config.needs)
    shared = {"by": config.by, "noise": config.noise.scale, "seed": config.seed, "together": config.together,
              "alone": config.alone}  # fmt: skip
    return [{"n": n, **shared, "wait_s": config.wait_s, "diary": config.diary} for n in range(config.count)]


def run(task):
    if task["diary"]:
        Path(task["diary"], f"{task['n']}-{os.getpid()}").touch()
    time.sleep(task["wait_s"])
    noise = task["noise"] * random.Random(f"{task['seed']} {task['n']}").gauss(0.0, 1.0)
    return {"square": (task["n"] + noise) ** 2 / task["by"], "x64": _x64(), "pid": os.getpid()}


def together(task):
    return "all" if task["together"] else None


def alone(task):
    return task["n"] in task["alone"]


def run_together(tasks):
    return [{**run(task), "beside": len(tasks)} for task in tasks]


def _x64():
    import jax

    return bool(jax.config.jax_enable_x64)


def collect(config, results, run):
    squares = [r["square"] for _, r in results]
    rows = [{"n": t["n"], "square": r["square"], "x64": r["x64"]} for t, r in results]
    write_tables(run, "squares", rows, "Squares of numbers | and what divides them")
    _figure(run, squares)
    total = {"total": sum(squares), "x64": all(r["x64"] for _, r in results)}
    return {
        "artefact": "toy/squares", "data": "none", "synthetic": False, "better_than_paper": 1, "of": 1,
        "rows": [
            {"name": "sum", "paper": {"total": 10.0}, "ours": total},
            {"name": "theirs", "paper": {"total": 1.0}, "ours": None, "reason": "not in the public data"},
        ],
        "beside": max((r.get("beside", 1) for _, r in results), default=0),
    }  # fmt: skip


@styled
def _figure(run, squares):
    fig = figure(3.0, 2.0)
    fig.add_subplot().plot(squares)
    save_figure(run, fig, "squares")
