"""Loads that switch: are they found in synthetic logs, with their power, their time on and their energy?

One task is one log: made by the generator, the loads added second by second (`hdev_jax.fleet.switching`, which shares
no code with the kernel), written and read as a customer's would be, and diagnosed. Its result keeps what was said of
the log beside the truth; `switching_tables` scores it. The size of a load is its power over that of the noise: the RMS
of samples, and of segments the RMS of their energy over the median duration of a row.
"""

import tempfile
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from pydantic import Field

from experiments.planted.switching_tables import collect
from experiments.runner.config import Strict
from hdev_jax.diagnosis.diagnose import Outcome, diagnose
from hdev_jax.fleet import SyntheticLog, synthetic_log
from hdev_jax.fleet.noise import root_mean_square
from hdev_jax.fleet.switching import Load, with_loads
from hdev_jax.inference.sheet import read_sheet
from hdev_jax.logs import read_log
from hdev_jax.physics import LIBRARY
from hdev_jax.physics.states import state_channel
from hdev_jax.problem import prepare, split_trips

__all__ = ["SOURCES", "Config", "collect", "run", "tasks"]

SOURCES = ()
APART = 1000  # seeds between one line and the next: more logs of a line leave those of the others as they are
WALK = "random_walk"


class Kind(Strict):
    """A load but for its power; what is left out is `hdev_jax.fleet.switching.Load`'s."""

    kind: Literal["chain", "thermostat", "timer"]
    share: float = 0.4
    dwell_s: float = 90.0
    by_temp: float = 0.0


class Mode(Strict):
    """What a log holds: its entry, its length, and which effects are planted beside a load."""

    entry: Literal["road", "shaft", "wheel"]
    rows_per_trip: int
    beside: list[str] = Field(default_factory=list)


class Config(Strict):
    """One load of each kind and size, two loads, a load beside another effect, and logs with no load."""

    experiment: Literal["planted.switching"]
    artefact: str
    caption: str
    seed: int = Field(0, ge=0)
    trips: int = Field(12, ge=3)
    modes: dict[Literal["samples", "segments"], Mode]
    kinds: dict[str, Kind]
    sizes: list[float]
    logs: int = Field(ge=0)
    two: list[float] = Field(default_factory=lambda: [2.0, 5.0], min_length=2, max_length=2)
    two_logs: int = Field(0, ge=0)
    ratio: float = 1.0  # of the effect beside a load, to the noise
    beside_size: float = 3.0
    beside_logs: int = Field(0, ge=0)
    noises: list[Literal["white", "ar1", "ar1_white", "trip_levels", "student_t", "trip_variance", "random_walk"]]
    noise_logs: int = Field(0, ge=0)
    wanted_false: float = 0.02  # at most, of logs with nothing planted in which a load is named


def tasks(config: Config) -> Iterator[dict[str, Any]]:
    """A log each: the first of every line, then the second of every line, so that what is cut off has all lines."""
    lines = [*_lines(config)]
    for k in range(max(count for count, _ in lines)):
        for at, (count, line) in enumerate(lines):
            if k < count:
                yield {**line, "trips": config.trips, "seed": config.seed + APART * at + k}


def _lines(config: Config) -> Iterator[tuple[int, dict[str, Any]]]:
    """The lines of the table: how many logs each, and what is in them."""
    first = next(iter(config.kinds))
    for mode, own in config.modes.items():

        def line(
            case: str, sizes: dict[str, list[float]], effects: tuple[str, ...] = (), noise: str = "ar1",
            mode: str = mode, own: Mode = own,
        ) -> dict[str, Any]:  # fmt: skip
            loads = [{"size": s, **config.kinds[k].model_dump()} for k, every in sizes.items() for s in every]
            return {
                "case": case, "mode": mode, "entry": own.entry, "rows_per_trip": own.rows_per_trip, "noise": noise,
                "effects": list(effects), "ratio": config.ratio, "kind": "+".join(sizes), "loads": loads,
            }  # fmt: skip

        for kind in config.kinds:
            for size in config.sizes:
                yield config.logs, line("one", {kind: [size]})
        yield config.two_logs, line("two", {first: config.two})
        for effect in own.beside:
            yield config.beside_logs, line("beside", {first: [config.beside_size]}, (effect,))
        for noise in config.noises:
            yield config.noise_logs, line("nothing", {}, noise=noise)


def run(task: dict[str, Any]) -> dict[str, Any]:
    """What the diagnosis says of one log, beside the truth; with an effect beside, of the log without the load too."""
    try:
        bare = synthetic_log(
            seed=task["seed"], trips=task["trips"], rows_per_trip=task["rows_per_trip"], mode=task["mode"],
            entry=task["entry"], effects={k: {} for k in task["effects"]},
            ratio=task["ratio"] if task["effects"] else None, noise="ar1" if task["noise"] == WALK else task["noise"],
        )  # fmt: skip
    except ValueError as e:
        return {"skipped": str(e)}
    if task["noise"] == WALK:
        bare = _with_walk(bare, task["seed"])
    kinds = [{k: v for k, v in load.items() if k != "size"} for load in task["loads"]]
    loads = [Load(x["size"] * noise_w(bare), **k) for x, k in zip(task["loads"], kinds, strict=True)]
    log = with_loads(bare, loads, seed=task["seed"]) if loads else bare
    out = _compared(_diagnosed(log, task["seed"]), log, loads)
    if task["effects"]:
        out["without"] = _compared(_diagnosed(bare, task["seed"]), bare, [])
    return out


def noise_w(log: SyntheticLog) -> float:
    """The noise of a row as a power [W]."""
    if log.target != "energy_wh":
        return 1e3 * log.noise_rms
    return 3600.0 * log.noise_rms / float(np.median(np.asarray(log.drive.columns["duration_s"])))


def _with_walk(log: SyntheticLog, seed: int) -> SyntheticLog:
    """The log with a random walk in each trip beside its noise, of the same RMS."""
    rng = np.random.default_rng([seed, 7])
    steps = rng.standard_normal(len(log.frame))
    walk = np.empty(len(steps))
    trip = log.frame["trip_id"].to_numpy()
    for name in np.unique(trip):
        walk[trip == name] = np.cumsum(steps[trip == name])
    frame = log.frame.copy()
    frame[log.target] += log.noise_rms * walk / root_mean_square(walk)
    return replace(log, frame=frame)


def _diagnosed(log: SyntheticLog, seed: int) -> Outcome:
    with tempfile.TemporaryDirectory() as folder:
        files = log.write(folder, truth=False)
        read, sheet = read_log([files["log"]]), read_sheet(files["sheet"])
    split = split_trips(read)
    return diagnose(prepare(split.log, sheet), split, LIBRARY, seed=seed)


def _compared(result: Outcome, log: SyntheticLog, loads: list[Load]) -> dict[str, Any]:
    """What was named, and each decoded load against each planted one: rows whose state is right, trips whose energy
    lies in its 90 % interval."""
    problem, summary = result.problem, result.summary
    seconds = np.asarray(problem.segments.duration_s)
    if len(seconds) != len(log.truth):
        return {"skipped": f"{len(log.truth) - len(seconds)} rows were dropped"}
    train = problem.rows(result.split.train)
    on = [log.truth[f"on:{j}"].to_numpy() for j in range(len(loads))]
    trips = {name: problem.rows([t]) for t, name in enumerate(problem.log.trip_names)}
    kwh = [
        {name: x.power_w * float(np.sum((s * seconds)[rows])) / 3.6e6 for name, rows in trips.items()}
        for x, s in zip(loads, on, strict=True)
    ]
    found = []
    for e in summary["effects"]:
        if "state" in e and result.given is not None:
            decoded = np.asarray(result.given.segments.channels[state_channel(e["id"])])
            by_trip = e["state"]["kwh_by_trip"]
            found.append({
                "id": e["id"], "power_w": e["parameters"]["power_w"]["value"],
                "interval_90": e["parameters"]["power_w"]["interval_90"], "share": e["state"]["mean_share_on"],
                "right": [float(np.mean((decoded > 0.5) == (s > 0.5))) for s in on],
                "covered": [sum(low <= k[t] <= high for t, (_, low, high) in by_trip.items()) for k in kwh],
            })  # fmt: skip
    return {
        "named": [
            {"id": e["id"], "class": [e["id"], *e["indistinguishable_from"]], "class_size": e["class_size"]}
            for e in summary["effects"]
        ],
        "found": found,
        "loads": [
            {"power_w": x.power_w, "share": float(np.average(s[train], weights=seconds[train]))}
            for x, s in zip(loads, on, strict=True)
        ],
        "trips": len(trips),
        "why_not": {c["id"]: c["why_not"] for c in summary["candidates"] if c["id"] == "switching_load"},
        "unexplained": summary["unexplained"]["significant"],
    }
