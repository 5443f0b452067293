"""What the whole diagnosis finds on training routes: of one vehicle, and as the effects of a network's physics."""

import dataclasses
import multiprocessing
import tempfile
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import cache
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments.pinn.data import Data, Member
from hdev_jax.compiling import compile_quickly
from hdev_jax.logs import Log
from hdev_jax.physics import LIBRARY, Vehicle

__all__ = ["diagnosed", "found_effects", "united"]

_OF_TRIPS = ("at_trip", "in_mode")  # parameters that say something of the trips of one log


@cache
def found_effects(data: Data, vehicles: tuple[str, ...]) -> dict[str, dict[str, float]]:
    """Effects that the diagnoses of these vehicles find on their training routes but the last, in the order of how
    often, with the median of each shape; sizes and thresholds are left open.

    What began at some trip, or holds in some, is of one vehicle's log and no part of it.
    """
    chosen = [m for m in data.vehicles if (m.id in vehicles or vehicles == ("all",)) and len(m.where(0))]
    return united([diagnosed(m, seed=0)[1] for m in chosen])


def united(found: Sequence[Mapping[str, Mapping[str, float]]]) -> dict[str, dict[str, float]]:
    """One list of effects from several vehicles' findings (`found_effects`)."""
    out = {}
    for id in sorted({e for f in found for e in f}, key=lambda e: (-sum(e in f for f in found), e)):
        kind = LIBRARY[id]
        if any(p.name in _OF_TRIPS for p in kind.parameters):
            continue
        having = [f[id] for f in found if id in f]
        shapes = [p.name for p in kind.parameters if not p.has_column]
        out[id] = {n: float(np.median([h[n] for h in having if n in h])) for n in shapes if any(n in h for h in having)}
    return out


def diagnosed(m: Member, seed: int) -> tuple[Vehicle, dict[str, dict[str, float]], dict[str, Any]]:
    """The vehicle with the effects that the diagnosis finds on its training routes but the last, what these are, and
    what the declared coefficients became. The whole loop, as `hdev diagnose` runs it on so short a log: in a process
    that compiles quickly, which one where networks are trained does not."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), _quickly) as pool:
        return pool.submit(_diagnosed, m, seed).result()


def _quickly() -> None:
    compile_quickly()
    jax.config.update("jax_enable_x64", True)


def _diagnosed(m: Member, seed: int) -> tuple[Vehicle, dict[str, dict[str, float]], dict[str, Any]]:
    from hdev_jax import progress
    from hdev_jax.diagnosis.diagnose import diagnose
    from hdev_jax.fleet import FleetConfig
    from hdev_jax.fleet.sheets import write_sheet
    from hdev_jax.inference.sheet import read_sheet
    from hdev_jax.problem import prepare, split_trips

    known = np.unique(m.routes[m.where(0)])
    with tempfile.TemporaryDirectory() as folder:
        write_sheet(m.variant, FleetConfig(), Path(folder))
        problem = prepare(_log_of(m, known), read_sheet(Path(folder) / f"{m.id}.toml"))
        # the last is not learnt from: a diagnosis needs a test trip, and what it says of that is not used
        split = split_trips(problem.log, None, [problem.log.trip_names[-1]])
        done = diagnose(problem, split, LIBRARY, seed=seed, tell=progress.step)
    found = {e["id"]: {k: p["value"] for k, p in e["parameters"].items()} for e in done.summary["effects"]}
    values = {c.name: float(x) for c, x in zip(done.fit.table.free, done.fit.values, strict=True)}
    return done.after, found, values


def _log_of(m: Member, routes: np.ndarray) -> Log:
    """The log of these routes of a vehicle."""
    at = np.flatnonzero(np.isin(m.routes, routes))
    names, trip = np.unique(m.routes[at], return_inverse=True)
    segments = dataclasses.replace(m.segments.take(at), trip=trip, vehicle=np.zeros(len(at), int))
    return Log(segments, {"energy_wh": m.energy_wh[at]}, tuple(map(str, names)), (m.id,))
