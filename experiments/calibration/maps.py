"""An efficiency map learned from a log of the synthetic fleet, against the true one, cell by cell of its grid.

The vehicle is the true one but for its map, of which the learner knows the grid. A cell's error is the mean over its
rows of the learned minus the true efficiency at their operating points. Three logs of each vehicle: with noise on the
energy alone, with every instrument as the fleet has it (speed, slope, a target that is late, dropouts), and with a
sheet's vehicle in place of the true one, which lacks what the fleet hides from its sheets.
"""

from collections.abc import Iterator, Sequence
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from pydantic import Field

from experiments.runner.config import Strict
from experiments.runner.figures import save_figure, styled
from experiments.runner.tables import write_tables
from hdev_jax.report.canvas import AFTER, GREY, figure, tidy
from hdev_jax.rundir import Run

__all__ = ["SOURCES", "Config", "collect", "run", "tasks"]

SOURCES = ()
EXACT = {"speed_noise_mps": 0.0, "grade_noise_rad": 0.0, "clock_skew_s": 0.0, "dropout_share": 0.0}
MASS_KNOWN = {"payload_bias": 0.0, "payload_sd": 0.0}
LogName = Literal["noise on the energy", "all instruments", "all instruments, the sheet's vehicle"]
WITHOUT, UNMODELLED = ", the sheet's vehicle", " and effects that the model lacks"
LOGS: dict[LogName, dict[str, Any]] = {
    "noise on the energy": {"log": EXACT, "truth": MASS_KNOWN},
    "all instruments": {"truth": MASS_KNOWN},
    "all instruments, the sheet's vehicle": {},
}


class Config(Strict):
    """Vehicles, the length of their logs, and what is asked of cells of so many rows."""

    experiment: Literal["calibration.maps"]
    artefact: str
    caption: str
    variants: list[str]
    logs: list[LogName] = Field(default_factory=lambda: list(LOGS))
    asked_of: list[LogName] = Field(default_factory=lambda: ["noise on the energy", "all instruments"])
    routes: int = 179  # a vehicle's share of the fleet's 5,000
    least_rows: int = 50
    within: float = 0.01
    seed: int = Field(0, ge=0)


def tasks(config: Config) -> Iterator[dict[str, Any]]:
    """One for each vehicle and log."""
    for variant in config.variants:
        for log in config.logs:
            yield {"variant": variant, "log": log, "routes": config.routes, "least_rows": config.least_rows,
                   "seed": config.seed}  # fmt: skip


def run(task: dict[str, Any]) -> dict[str, Any]:
    """Errors of cells with enough rows, with where they are; errors of their nodes over the claimed sds."""
    from hdev_jax.fleet import simulate
    from hdev_jax.inference.maps.fit import cells_of, learn_map, operating_points
    from hdev_jax.physics import EfficiencyMap

    settings = {"seed": task["seed"] + 1, "routes": task["routes"], "variants": [task["variant"]]}
    vehicle = simulate({**settings, **LOGS[task["log"]]}).vehicles[0]
    gears, padded = vehicle.variant.gears, vehicle.true.driveline.efficiency
    grid = (padded.gears[:gears], padded.speeds_radps, padded.torques_nm)
    truth = EfficiencyMap(*grid, padded.values[:gears])
    car = eqx.tree_at(
        lambda c: (c.driveline.efficiency, c.driveline.gear_ratios),
        vehicle.tabular if "sheet" in task["log"] else vehicle.true,
        (truth, jnp.asarray(vehicle.variant.gear_ratios)),
    )
    start = EfficiencyMap(*grid, jnp.full(truth.values.shape, 0.85))
    s = vehicle.segments
    found = learn_map(car, s, np.asarray(vehicle.energy_wh), start)
    moves = np.asarray(s.distance_m) > 0
    w, t = (np.asarray(x)[moves] for x in operating_points(car, jax.tree.map(jnp.asarray, s)))
    g = np.asarray(s.channels["gear"])[moves]
    learned, true = (
        np.asarray(jax.vmap(m)(jnp.asarray(g), jnp.asarray(w), jnp.asarray(t))) for m in (found.map, truth)
    )
    places = np.stack(cells_of(truth, g, w, t))
    cells, at, count = np.unique(places, axis=1, return_inverse=True, return_counts=True)
    at = np.ravel(at)
    enough = np.flatnonzero(count >= task["least_rows"])
    mean = lambda x: [float(np.mean(x[at == c])) for c in enough]  # noqa: E731
    corners = {(g, i + m, j + n) for g, i, j in cells[:, enough].T for m in (0, 1) for n in (0, 1)}
    nodes = tuple(np.array(sorted(corners)).reshape(-1, 3).T)
    off = (np.asarray(found.map.values) - np.asarray(truth.values))[nodes] / found.sd[nodes]
    return {
        "error": mean(learned - true), "eta": mean(true), "node_z": off.tolist(), "rows": count[enough].tolist(),
        "torque_share": mean(t / float(grid[2][-1])), "power_kw": mean(np.abs(t * w) / 1e3),
        "all_rows": int(moves.sum()), "gears": gears, "noise_wh": found.noise_wh, "instruments": found.instruments,
        "smooth": found.smooth, "converged": found.converged,
    }  # fmt: skip


def collect(config: Config, results: Sequence[tuple[dict[str, Any], dict[str, Any]]], run: Run) -> dict[str, Any]:
    """How many cells are within what is asked, by vehicle and log."""
    lines, missed = [], []
    for task, r in results:
        error, name = np.abs(r["error"]), f"{task['variant']}, {task['log']}"
        said = _said(name)
        if not len(error):
            missed.append(f"{said}: no cell of {config.least_rows} rows")
            continue
        ours = {
            "gears": r["gears"], "rows": r["all_rows"], "cells": len(error),
            "within": float(np.mean(error < config.within)),
            "median_error_percent": 100 * float(np.median(error)), "worst_percent": 100 * float(np.max(error)),
            "worst_at_kw": r["power_kw"][int(np.argmax(error))],
            "nodes_in_90": float(np.mean(np.abs(r["node_z"]) < 1.645)),
            "noise_wh": r["noise_wh"], "slope_noise_mrad": 1e3 * r["instruments"]["grade_rad"],
        }  # fmt: skip
        lines.append({"name": name, "paper": None, "ours": ours})
        if task["log"] in config.asked_of and ours["within"] < 1.0:
            missed.append(f"{said}: worst cell {ours['worst_percent']:.2f} %, target {100 * config.within:g}")
        if not r["converged"]:
            missed.append(f"{said}: not converged")
    write_tables(run, "maps", [_shown(r) for r in lines], config.caption)
    _figure(run, results, config.within)
    return {
        "artefact": config.artefact, "data": "synthetic fleet", "synthetic": True, "rows": lines, "missed": missed,
        "better_than_paper": 0, "of": 0,
        "notes": [
            f"Targets: every fit converges; every cell is within {100 * config.within:g} percentage point on logs with "
            f"{' and with '.join(map(_said, config.asked_of))}",
            f"A cell of the map's grid (gear, speed, torque) counts from {config.least_rows} rows; its error is the "
            "mean over its rows of learned minus true efficiency, in percentage points",
            "The fit knows the mass of each trip, the map's grid and all of the vehicle but its map; where it "
            "says so, the model also lacks the effects that the fleet hides, and the map absorbs them",
        ],
        "findings": _findings(config, lines),
    }  # fmt: skip


def _said(name: str) -> str:
    return name.replace("_", " ").replace(WITHOUT, UNMODELLED)


def _shown(row: dict[str, Any]) -> dict[str, Any]:
    """A line of the table: errors are in percentage points of efficiency."""
    o = row["ours"]
    return {
        "vehicle and log": _said(row["name"]),
        "gears": o["gears"], "rows": o["rows"], "cells": o["cells"], "share of cells within the target": o["within"],
        "median error [points]": o["median_error_percent"], "largest error [points]": o["worst_percent"],
        "power there [kW]": o["worst_at_kw"], "share of nodes in 90 % intervals": o["nodes_in_90"],
        "noise [Wh]": o["noise_wh"], "noise of the slope [mrad]": o["slope_noise_mrad"],
    }  # fmt: skip


def _findings(config: Config, lines: Sequence[dict[str, Any]]) -> list[str]:
    """The largest error of a cell, by kind of log."""
    worst = {log: [r["ours"]["worst_percent"] for r in lines if r["name"].endswith(f", {log}")] for log in config.logs}
    words = {
        "noise on the energy": "with noise on the energy only",
        "all instruments": "with the noise of all instruments",
    }
    said = [f"{max(v):.1f} {words.get(log, 'if the model also lacks effects')}" for log, v in worst.items() if v]
    return [f"The largest error of a cell, in percentage points, is {', '.join(said)}"] if said else []


@styled
def _figure(run: Run, results: Any, within: float) -> None:
    logs = list(dict.fromkeys(t["log"] for t, _ in results))
    fig = figure(9.0, 3.0)
    for k, log in enumerate(logs, start=1):
        ax = fig.add_subplot(1, len(logs), k)
        ax.axhspan(-100 * within, 100 * within, color=GREY, alpha=0.25, linewidth=0)
        for t, r in results:
            if t["log"] == log:
                ax.plot(100 * np.array(r["torque_share"]), 100 * np.array(r["error"]), ".", markersize=4, alpha=0.6,
                        label=t["variant"].replace("_", " "))  # fmt: skip
        ax.set_xlabel("motor torque, % of the highest")
        ax.set_title(log.replace(WITHOUT, f"\n{UNMODELLED.strip()}"))
        if k == 1:
            ax.set_ylabel("learned minus true efficiency [% points]")
        if k == len(logs):
            ax.legend(fontsize=6, loc="upper left", bbox_to_anchor=(1.0, 1.0))
        ax.axhline(0.0, color=AFTER, linewidth=0.6)
        tidy(ax)
    save_figure(run, fig, "maps")
