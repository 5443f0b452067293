"""Fleets with something planted: is it found by the fleet, with its date, and nothing else?

**rise**: c_rr of a tenth of the vehicles rises by a twentieth from a trip on. **small**: an effect in all vehicles, so
small that its RMS beyond the declared model is a tenth of the noise. **nothing**: nothing. Each vehicle has trips over
a year and a true c_rr and drag area of its own.
"""

import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from experiments.runner.config import Strict
from experiments.runner.tables import write_tables
from hdev_jax.fleet import synthetic_log
from hdev_jax.many import Source, Workers, computed, fleet_result, looking_again, vehicle_record
from hdev_jax.rundir import Run

__all__ = ["SOURCES", "Config", "collect", "run", "tasks"]

SOURCES = ()
YEAR_S, DAY_S, BEGIN_S = 365 * 86_400.0, 86_400.0, 1.7e9
RISE, SHARE, RATIO = 0.05 * 0.0060, 0.1, 0.1
WEEK_DAYS = 7.0

Kind = Literal["rise", "small", "nothing"]
CASES = {"rise": "c_rr rises", "small": "small effect", "nothing": "nothing planted"}


class Size(Strict):
    """Fleets of one kind: how many, of how many vehicles, with how many trips of so many rows."""

    fleets: int = Field(ge=1)
    vehicles: int = Field(ge=4)
    trips: int = Field(ge=8)
    rows: int = Field(ge=60)


class Config(Strict):
    """A size for each kind of fleet; `effect`, which is planted as small."""

    experiment: Literal["many.study"]
    artefact: str
    caption: str
    kinds: dict[Kind, Size]
    effect: str = "air_density"
    seed: int = Field(0, ge=0)


def tasks(config: Config) -> Iterator[dict[str, Any]]:
    """A fleet each."""
    for kind, size in config.kinds.items():
        for k in range(size.fleets):
            yield {"kind": kind, "fleet": k, "effect": config.effect, "seed": config.seed, "vehicles": size.vehicles,
                   "trips": size.trips, "rows": size.rows}  # fmt: skip


def run(task: dict[str, Any]) -> dict[str, Any]:
    """What is named in one fleet, against what was planted."""
    rng = np.random.default_rng([task["seed"], task["fleet"], len(task["kind"])])
    with tempfile.TemporaryDirectory() as folder:
        each, truth = [], {}
        for k in range(task["vehicles"]):
            name, at = f"V{k:04d}", int(rng.integers(task["trips"] // 4, 3 * task["trips"] // 4))
            rises = task["kind"] == "rise" and k < max(SHARE * task["vehicles"], 1)
            if rises:
                truth[name] = BEGIN_S + at * YEAR_S / task["trips"]
            each.append(_written(Path(folder), name, at if rises else None, task, int(rng.integers(2**31))))
        started = time.perf_counter()
        todo = [{**vars(s), "adapter": None, "target": None, "fdr": 0.05, "seed": 0, "trust": False} for s in each]
        records = [r for _, r in computed(vehicle_record, todo, Workers())]
        result = fleet_result(records, fdr=0.05, seed=0, again=looking_again(todo, Workers()))
    seconds = time.perf_counter() - started
    changed = {e["vehicle"]: e for e in result.summary["unlike"] if e["kind"] == "change"}
    # a vehicle's own diagnosis may have named the step itself, with its trip
    off = [abs(changed[v]["since"] - s) / DAY_S for v, s in truth.items() if v in changed]
    shown = [e["id"] for e in result.summary["effects"] if e["found"]]
    alone = [[e["id"] for e in r["effects"] if e["counts_in_fleet"]] for r in result.records if r["status"] == "done"]
    return {
        "planted": len(truth), "found": len(off), "in_a_week": sum(x <= WEEK_DAYS for x in off), "days_off": off,
        "others": len(set(changed) - set(truth)),
        "unlike": sum(e["kind"] == "level" for e in result.summary["unlike"]), "shown": shown,
        "shown_alone": sum(task["effect"] in e for e in alone), "any_alone": sum(bool(e) for e in alone),
        "not_done": sum(r["status"] != "done" for r in records),
        "seconds_per_vehicle": seconds / len(records),
        "bytes_per_vehicle": float(np.mean([len(str(r)) for r in records])),
    }  # fmt: skip


def _written(folder: Path, name: str, at: int | None, task: dict[str, Any], seed: int) -> Source:
    planted: dict[str, Any] = {}
    if at is not None:
        planted = {"effects": {"step_change": {"c_rr": RISE, "trip": float(at)}}}
    elif task["kind"] == "small":
        planted = {"effects": {task["effect"]: {}}, "ratio": RATIO}
    made = synthetic_log(seed=seed, trips=task["trips"], rows_per_trip=task["rows"], **planted)
    frame = made.frame.drop(columns="vehicle_id")
    place = {t: k for k, t in enumerate(frame["trip_id"].drop_duplicates())}
    trip = np.array([place[t] for t in frame["trip_id"]])
    frame["time_unix"] = BEGIN_S + trip * YEAR_S / task["trips"] + frame.pop("time_s").to_numpy()
    frame.to_parquet(folder / f"{name}.parquet", index=False)
    (folder / "truck.toml").write_text(made.sheet)
    return Source(name, (str(folder / f"{name}.parquet"),), str(folder / "truck.toml"))


def collect(config: Config, results: Sequence[tuple[dict[str, Any], dict[str, Any]]], run: Run) -> dict[str, Any]:
    """Counts over the fleets of each kind."""
    rows, lines = [], []
    for kind, size in config.kinds.items():
        found = [r for t, r in results if t["kind"] == kind]
        total = {k: sum(r[k] for r in found) for k in ("planted", "found", "in_a_week", "others", "unlike",
                                                       "shown_alone", "any_alone", "not_done")}  # fmt: skip
        false = [set(r["shown"]) - ({config.effect} if kind == "small" else set()) for r in found]
        mine = {
            **total,
            "fleets": len(found), "vehicles": size.vehicles * len(found),
            "effect_shown": sum(config.effect in r["shown"] for r in found) if kind == "small" else 0,
            "fleets_with_a_false_effect": sum(map(bool, false)),
            "fleets_with_anything_false": sum(
                bool(f) or r["others"] > 0 or r["unlike"] > 0 or (kind == "nothing" and r["any_alone"] > 0)
                for f, r in zip(false, found, strict=True)
            ),
            "seconds_per_vehicle": float(np.mean([r["seconds_per_vehicle"] for r in found])),
            "bytes_per_vehicle": float(np.mean([r["bytes_per_vehicle"] for r in found])),
        }  # fmt: skip
        rows.append({"name": kind, "paper": None, "ours": mine})
        lines.append({
            "case": CASES.get(kind, kind), "fleets": len(found), "vehicles per fleet": size.vehicles,
            "changed vehicles found": f"{total['found']} of {total['planted']}" if total["planted"] else None,
            "date within a week": total["in_a_week"] if total["planted"] else None,
            "fleets that show the effect": mine["effect_shown"] if kind == "small" else None,
            "vehicles whose own diagnosis shows it": total["shown_alone"] if kind == "small" else None,
            "fleets with anything false": mine["fleets_with_anything_false"],
            "others called changed": total["others"], "called different": total["unlike"],
            "fleets with a false effect of a type": mine["fleets_with_a_false_effect"],
            "trips": size.trips, "rows per trip": size.rows,
            "s per vehicle": mine["seconds_per_vehicle"], "kB per vehicle": mine["bytes_per_vehicle"] / 1e3,
        })  # fmt: skip
    write_tables(run, "many", lines, config.caption)
    return {"artefact": config.artefact, "data": "synthetic", "synthetic": True, "rows": rows,
            "better_than_paper": 0, "of": 0, "findings": [*_findings(rows)]}  # fmt: skip


def _findings(rows: Sequence[dict[str, Any]]) -> Iterator[str]:
    """What each kind of fleet showed."""
    for row in rows:
        o, n = row["ours"], row["ours"]["fleets"]
        false = f"something false is shown in {o['fleets_with_anything_false']} of {n} fleets"
        if o["planted"]:
            yield (f"Of {o['planted']} changed vehicles among {o['vehicles']}, {o['found']} are found, "
                   f"{o['in_a_week']} with the date within a week, and {o['others']} others are named")  # fmt: skip
        elif row["name"] == "small":
            alone = f"in {o['shown_alone']} of their {o['vehicles']} vehicles the vehicle's own diagnosis shows it"
            yield (f"An effect of a tenth of the noise in all vehicles is found in {o['effect_shown']} of {n} fleets; "
                   f"{alone} (adjusted over the fleet); {false}")  # fmt: skip
        else:
            yield f"With nothing planted, {false}"
