"""One log of the study: which vehicle, what it drives, what is changed, what is written."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from experiments.simulators import with_fastsim, with_sumo
from experiments.simulators.logs import SimulatedLog, simulated_log
from experiments.simulators.plants import PLANTS
from experiments.simulators.vehicles import Vehicle, drawn

__all__ = ["SIMULATORS", "make"]

SIMULATORS: Mapping[str, Any] = {"fastsim": with_fastsim, "sumo": with_sumo}


def make(task: Mapping[str, Any]) -> tuple[SimulatedLog, Vehicle, Vehicle]:
    """The log, the vehicle as it is declared, and as it was.

    A seed draws vehicle and trips, whatever is changed; a channel to be missing is still there. Raises `ValueError`
    where the vehicle cannot drive them.
    """
    simulator = SIMULATORS[task["simulator"]]
    own, roads, noises = (np.random.default_rng(s) for s in np.random.SeedSequence(task["seed"]).spawn(3))
    declared = drawn(own, simulator.VEHICLES[task["vehicle"]]())
    true = declared.planted(task["plant"], PLANTS[task["plant"]].size)
    trips = simulator.simulate(true, simulator.drives(declared, roads, task["trips"], task["seconds"]))
    log = simulated_log(
        declared, trips, noises, rows=task["rows"], measured=task["measured"], noise=task["noise"],
        ar_coefficient=task["ar_coefficient"],
    )  # fmt: skip
    return log, declared, true
