"""Paper 2 on its own data: tables IV-X and the studies around them. Every choice is made on trip 1; trips 2-4 are read
for the report alone. One task is one model, so tables that show the same model share its fit.
"""

from collections.abc import Iterator
from typing import Any, Literal

import numpy as np
from pydantic import Field

from experiments.config import Strict
from experiments.paper2_data import kia_trips
from experiments.paper2_fits import evaluated, fitted, step_seconds
from experiments.paper2_tables import collect

__all__ = ["SOURCES", "Config", "Settings", "collect", "run", "tasks"]

SOURCES = ("paper2.py", "paper2_data.py", "paper2_fits.py")


class Settings(Strict):
    """One model. What a kind does not read has no effect on it."""

    kind: Literal["narx", "recurrent", "classical", "persistence"]
    why: str = ""  # what the row is, for the table
    source: Literal["channels", "kernel"] = "channels"
    inputs: list[str] = Field(default_factory=lambda: ["motor_torque_nm", "speed_mps"])
    kernel_order: int = 2
    outputs: int = 3
    lags: list[int] = Field(default_factory=lambda: [0, 1, 2])
    units: int = 5
    seen: Literal["inputs", "all"] = "inputs"
    linear: bool = True
    huber_kw: float = 0.4  # corner of Huber's loss; 0: squares
    ridge_size: float = 1e-6
    ridge_slope: float = 1e-3
    starts: int = 16
    steps: int = 120
    coarse_steps: int = 50
    rtol: float = 1e-5
    simulation: bool = False
    simulation_steps: int = 30
    cell: Literal["lstm", "gru"] = "lstm"
    length: int = 128
    rate: float = 0.02
    decay: float = 0.03
    model: Literal["tree", "boosted", "robust_linear", "support_vectors"] = "tree"
    trials: int = 12


class Config(Strict):
    """One table: its models, and the paper's numbers for them (keys as in `metrics.json`)."""

    experiment: Literal["paper2"]
    artefact: str
    caption: str
    show: list[str]  # what the table compares: keys of the metrics, the first decides which is better
    models: dict[str, Settings]
    order: list[str]  # rows of the table
    paper: dict[str, dict[str, float]] = Field(default_factory=dict)
    reasons: dict[str, str] = Field(default_factory=dict)  # rows that the public data cannot give
    free_run: bool = False  # which of the two configurations the table's columns are of
    notes: list[str] = Field(default_factory=list)
    rows: int = 0  # of each trip; 0: all
    train: str = "1"
    test: list[str] = Field(default_factory=lambda: ["2", "3", "4"])
    seed: int = 0


def tasks(config: Config) -> Iterator[dict[str, Any]]:
    """One for each model of the table."""
    for name in config.order:
        if name in config.models:
            settings = config.models[name].model_dump(mode="json", exclude={"why"})
            yield {
                "name": name, "settings": settings, "rows": config.rows, "train": config.train, "test": config.test,
                "seed": config.seed,
            }  # fmt: skip


def run(task: dict[str, Any]) -> dict[str, Any]:
    """Fit on the training trip, then every trip once; for models of many starts, the spread over them too."""
    trips = kia_trips(task["rows"] or None)
    models, losses, seconds = fitted(task["settings"], trips[task["train"]], task["seed"])
    chosen = models[0]
    key = "free_mse" if task["settings"]["simulation"] else "step_mse"
    spread = [float(np.mean([evaluated(m, trips[t])[key] for t in task["test"]])) for m in models]
    return {
        "trips": {name: evaluated(chosen, trips[name]) for name in (task["train"], *task["test"])},
        "parameters": chosen.parameters,
        "step_seconds": step_seconds(chosen, trips[task["train"]]),
        "fit_seconds": seconds,
        "losses": losses,
        "spread": spread,
        "settings_found": getattr(chosen, "settings", {}),
    }
