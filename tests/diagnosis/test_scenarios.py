"""Short synthetic logs whose truth is known: what is planted is named with its size, and nothing where nothing is.

The logs are the generator's (12 trips, AR(1) noise, nuisance channels); it shares no code with the kernel. The effect's
column, after projecting off the declared coefficients, has so many times the RMS of the noise.
"""

from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from planted import SHORT, breaches, diagnosed, named, opened

from hdev_jax.diagnosis.diagnose import Outcome
from hdev_jax.diagnosis.gates.rejection import Kind
from hdev_jax.fleet import SyntheticLog
from hdev_jax.physics import LIBRARY

# What is planted, with the rivals that come nearest; some scenarios have the whole library against them.
WHOLE = (*LIBRARY,)
STEADY = tuple(k for k in LIBRARY if k not in ("switching_load", "second_switching_load"))
DRIVE = (
    "driveline_drag", "gear_efficiency", "battery_resistance", "part_load", "regen_efficiency", "power_gain",
    "mass_scale", "speed_scale", "auxiliary_power",
)  # fmt: skip
MACHINE = ("copper_loss", "iron_loss", "part_load", "time_skew", "sampling_filter", "power_gain")
BY_TRIP = ("periodic_load", "mode_change", "auxiliary_power", "standstill_load", "efficiency_scale", "part_load")
CYCLE = (*BY_TRIP, "switching_load", "second_switching_load")
LOADS = ("hvac_power", "auxiliary_power", "cabin_warmup", "standstill_load", "battery_resistance", "power_gain")
HUMID = (*LOADS, "air_density", "wet_road", "passenger_heat", "headwind", "rolling_temperature")
SHAFT = {"entry": "shaft", "mode": "samples"}
OUTSIDE = {"outside_humidity_load": {}}
# a constant power a trip, under levels of the trips as large as it
BETWEEN = {
    "ratio": 0.7, "mode": "samples", "rows_per_trip": 120, "noise": "trip_levels", "ar_coefficient": 0.9,
    "held": ["ambient_temp_c"],
}  # fmt: skip


@dataclass(frozen=True)
class Scenario:
    """What is planted in a log of one seed, and what is to be said of it: the names (of a class, any member first)."""

    seed: int
    effects: dict[str, dict[str, float]]
    names: tuple[str, ...]
    options: dict[str, Any] = field(default_factory=dict)
    alike: tuple[str, ...] = ()
    depends_on: str = ""
    undecided: str = ""
    library: tuple[str, ...] = DRIVE


def one(seed: int, effect: str, *alike: str, library: tuple[str, ...] = DRIVE, **options) -> Scenario:
    said = (effect, *alike) if alike else ()
    return Scenario(seed, {effect: {}}, (effect,), {"ratio": 1.0} | options, said, library=library)


SCENARIOS = {
    "nothing": Scenario(7101, {}, (), library=WHOLE),
    "driveline": one(7102, "driveline_drag"),
    "battery": one(7102, "battery_resistance", "part_load"),
    "machine": one(7101, "copper_loss", library=MACHINE, **SHAFT),
    "sensor": one(7102, "time_skew", "sampling_filter", library=MACHINE, **SHAFT),
    "cycle": one(7102, "periodic_load", library=CYCLE, ratio=0.7),
    "mode": one(7101, "mode_change", library=BY_TRIP, ratio=0.7),
    # one of them on the road, which stands for that stage as well
    "two": Scenario(
        7101, {"headwind": {}, "standstill_load": {}}, ("headwind", "standstill_load"), {"ratio": 1.0}, library=STEADY
    ),
    "class": Scenario(
        7103,
        {"power_gain": {}},
        ("power_gain",),
        {"ratio": 1.0},
        ("power_gain", "mass_scale", "speed_scale"),
        library=WHOLE,
    ),
    "outside the library": Scenario(7102, OUTSIDE, (), {"ratio": 1.0}, depends_on="humidity_pct", library=HUMID),
    "levels of trips": Scenario(
        7101, {}, (), {"noise": "trip_levels", "ar_coefficient": 0.9}, depends_on="trip_id", library=WHOLE
    ),
    "only between trips": Scenario(7401, {"hvac_power": {}}, (), BETWEEN, undecided="hvac_power", library=LOADS),
}


@cache
def outcome(name: str) -> tuple[SyntheticLog, Outcome]:
    s = SCENARIOS[name]
    with TemporaryDirectory() as folder:
        synthetic, problem, split = opened(Path(folder), seed=s.seed, effects=s.effects, **SHORT | s.options)
    return synthetic, diagnosed(problem, split, {k: LIBRARY[k] for k in s.library})


@pytest.mark.parametrize("name", SCENARIOS)
def test_what_is_planted_is_named_with_its_size(name):
    s = SCENARIOS[name]
    synthetic, result = outcome(name)
    summary = result.summary
    assert breaches(result) == []
    assert {c["kind"] for c in summary["candidates"]} <= {*Kind}
    if s.alike:
        (found,) = summary["effects"]
        shown = {found["id"], *found["indistinguishable_from"]}
        assert {*s.names} <= shown <= {*s.alike}
        assert (found["verdict"], found["class_size"]) == ("one_of_class", len(s.alike))
    else:
        assert sorted(named(result)) == sorted(s.names)
        assert all(e["verdict"] == "found" and not e["indistinguishable_from"] for e in summary["effects"])
    left = summary["unexplained"]
    verdict = {
        (False, False): "nothing_missing", (True, False): "effects_found", (False, True): "unexplained_structure",
    }[bool(s.names), bool(s.depends_on)]  # fmt: skip
    assert summary["verdict"] == verdict, left["signature"]
    if s.depends_on:
        assert s.depends_on in left["depends_on"], left["signature"]
        assert np.isfinite(left["noise_floor_rmse"])
    if s.undecided:
        needed = {c["id"]: c["clusters_needed"] for c in summary["not_decidable"]}
        assert needed[s.undecided] > summary["clusters"]["count"]
    for e in summary["effects"]:
        assert 0.0 <= e["q_value"] <= 0.05
        truth = synthetic.vehicle.effects.get(e["id"], {})
        for p, told in e["parameters"].items():
            if p in truth and "interval_90" in told:
                # 90 % intervals of some thirty numbers: each is given the room that one in a hundred asks for
                assert abs(told["value"] - truth[p]) <= max(3.0 * told["sd"], 1e-3 * abs(truth[p])), (p, told, truth[p])
    if s.names:
        assert summary["after"]["train"]["rmse"] < 0.97 * summary["before"]["train"]["rmse"]


def test_phases_of_a_cycle_are_those_of_the_trips():
    """Each training trip has its own, and a trip that nobody has fitted the mean of all."""
    synthetic, result = outcome("cycle")
    duty = synthetic.vehicle.effects["periodic_load"]["duty"]
    phases = np.asarray(result.after.effect("periodic_load").phase.values)
    middle = np.array(synthetic.vehicle.phase) - duty / 2  # the truth counts from where the load goes on
    apart = (phases[: len(middle)] - middle + 0.5) % 1.0 - 0.5
    assert np.count_nonzero(np.isfinite(apart)) == len(result.summary["split"]["train_trips"])
    assert np.nanmax(np.abs(apart)) < 0.08
    assert np.isnan(phases[-1])
